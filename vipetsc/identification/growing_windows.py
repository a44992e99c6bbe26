"""The fit over windows that grow, from one start.

A window is the beginning of every record up to some time; the last one is all of the records. The fits are:

1. parameters of the linear lattice, to windows of the records without contact;
2. all parameters, to windows with more and more of the model's contacts;
3. all parameters, to the whole records with noise that is estimated from the residuals where none is given, twice;
4. steps 2 and 3 once more from there.

Section 2 of the package's docstring says why windows grow.

Each fit is one of least squares (``least_squares``).

**Clearances** (``other_contacts``). The misfit does not depend on a clearance that is larger than the motion, and its
valley of values without contact is apart from those of values with contact: no derivative leads from one to the other.
Clearances are therefore tried one by one at some fractions of the largest motion without their stop.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from vipetsc.case import CaseError
from vipetsc.case.identify import IdentifyCase, SoughtParameter
from vipetsc.case.quantities import differs_by_side
from vipetsc.identification.least_squares import CLOSE, FINAL, GROWING, Minimum, Precision, least_residuals
from vipetsc.identification.misfit import NARROW, WIDTH, Misfit
from vipetsc.identification.motion import MotionError

# Clearances that are tried, over the largest motion without the stop. The first is out of reach, so that nothing
# touches. At the second the first impact grazes. The others are further in: a fit that begins at a graze may not reach
# a valley there.
OF_REACH = (1.02, 0.98, 0.8, 0.6, 0.4)
# A contact that lowers the sum of squares over the noise by less than this is not needed: one datum's worth of noise.
NEEDED = 1.0
# Sides on which a clearance has its stops: 0 is that of w > 0, 1 that of w < 0.
SIDES = {"clearance": [0], "clearance_minus": [1]}


def reached_by(misfit: Misfit, z: np.ndarray, ends: Sequence[float]) -> np.ndarray:
    """Return the largest w and -w (site, 2) in m of any record in the model up to ``ends``; NaN where a stop is met.

    ``z`` (coordinate,) are the model's coordinates, ``ends`` (record,) times of the records' clocks in s. Raises
    CaseError, MotionError.
    """
    largest = np.zeros((len(misfit.plan.base.model().chain.sites), 2))
    for number, (table, end) in enumerate(zip(misfit.plan.options.records, ends, strict=True)):
        if table.contact and (misfit.records[number].times <= end).any():
            response = misfit.motion(z, number, end)
            largest = np.maximum(largest, response.reached)
            sides = (response.side < 0).astype(int)
            # It stays NaN, whatever later records reach: the maximum of NaN and a number is NaN.
            largest[response.site, sides] = np.nan
    return largest


def largest_towards(plan: IdentifyCase, parameter: SoughtParameter, reached: np.ndarray) -> float:
    """Return the largest motion in m towards the stops of a clearance if none of them is met, else NaN.

    ``reached`` (site, 2) is that of ``reached_by``. The result is NaN for other parameters than clearances.
    """
    if parameter.quantity not in SIDES:
        return np.nan
    base = plan.base
    gaps = base.model().chain.sites.gaps
    sides = SIDES[parameter.quantity]
    if parameter.quantity == "clearance" and not differs_by_side(base.contacts):
        sides = [0, 1]  # one clearance for both

    # A site with a stop on one side has an infinite gap on the other. The largest of values with a NaN is NaN: one stop
    # that is met is enough.
    towards = [reached[i, side] for i in parameter.members for side in sides if np.isfinite(gaps[i, side])]
    return float(np.max(towards, initial=0.0))


def motion_without(misfit: Misfit, z: np.ndarray, number: int, ends: Sequence[float], highest: np.ndarray) -> float:
    """Return the largest motion in m towards the stops of a clearance, where the record does not need them; else NaN.

    The record is explained as well with the clearance ``number`` at its upper bound in ``highest`` (coordinate,) as at
    ``z`` (coordinate,), where a contact may just graze. The result is NaN for other parameters than clearances.
    """
    parameter = misfit.plan.parameters[number]
    if parameter.quantity not in SIDES:
        return np.nan
    free = z.copy()
    free[number] = highest[number]
    if misfit.cost(free, ends) > misfit.cost(z, ends) + NEEDED:
        return np.nan
    return largest_towards(misfit.plan, parameter, reached_by(misfit, free, ends))


def other_contacts(misfit: Misfit, z: np.ndarray, ends: Sequence[float], highest: np.ndarray) -> np.ndarray | None:
    """Return the coordinates (coordinate,) with those clearances, of the ones tried, that lower the misfit, or None.

    The search begins at ``z`` (coordinate,), with windows up to ``ends`` (record,) in s; ``highest`` (coordinate,) are
    the upper bounds.
    """
    best = None
    least = misfit.cost(z, ends)
    for number, parameter in enumerate(misfit.plan.parameters):
        if parameter.quantity not in SIDES:
            continue
        # As far away as it may be: the motion without this stop.
        free = z.copy()
        free[number] = highest[number]
        for moved in _clearances_tried(misfit, z, free, number, ends):
            cost = misfit.cost(moved, ends)
            if cost < least:
                best = moved
                least = cost
        # The next clearance is tried together with what has lowered the misfit so far.
        if best is not None:
            z = best
    return best


def _clearances_tried(
    misfit: Misfit, z: np.ndarray, free: np.ndarray, number: int, ends: Sequence[float]
) -> list[np.ndarray]:
    """Return the coordinates ``z`` (coordinate,) with other values of the clearance ``number``, a list of arrays.

    The values are fractions of the motion at ``free`` (coordinate,), where the clearance is at its upper bound.
    """
    parameter = misfit.plan.parameters[number]
    # A case or a motion that is impossible without this stop says nothing of other clearances.
    try:
        reached = reached_by(misfit, free, ends)
    except (CaseError, MotionError):
        return []

    # A stop that is met even at its upper bound has NaN: how far the motion without it would go is unknown. Comparisons
    # with NaN are false, and nothing is tried.
    beyond = largest_towards(misfit.plan, parameter, reached)
    tried = []
    for fraction in OF_REACH:
        if parameter.low <= fraction * beyond <= parameter.high:
            moved = z.copy()
            moved[number] = parameter.to_coordinate(fraction * beyond)
            tried.append(moved)
    return tried


# While windows grow, a change of a coordinate by PRIOR from its last value weighs as one datum missed by its noise.
PRIOR = 1.0
# Noise that is not given, over the size of a channel, until residuals show it.
ASSUMED_NOISE = 0.01
# Smallest noise over the size of a channel: computed records have none, and residuals over it must stay finite.
LEAST_NOISE = 1e-9
# Least weight of the prior over the norm of the Jacobian. Where a clearance is not reached, a column of the Jacobian is
# zero; without full rank, SciPy makes every step as long as the trust region is, and does not converge.
RIDGE = 1e-10
# A window is repeated at half its growth if its misfit is more than RISE times that of the window before (at least 1,
# that of noise), until it grows by less than SHORTEST of the record.
RISE = 2.0
SHORTEST = 0.01
# Length over that of the record of the first window of a record without contact, or whose initial state is estimated.
FIRST = 0.1
# Samples of a window, at least, before it is shortened (RISE); every record has twice as many.
LEAST_SAMPLES = 4
# Data of a first window, at least, for each number that is unknown: with one for each, noise would be fitted exactly.
DATA_EACH = 1.5
# Fits with noise that is estimated from the fit before.
REWEIGHTINGS = 2
# Further passes through all windows.
REPETITIONS = 1


class Window(NamedTuple):
    """A fit over one window: its latest ``end`` by the records' clocks in s, and the model's contacts in it.

    ``impacts`` are those of all records together, ``most_impacts`` those of the record with the most. ``misfit`` is the
    root mean square of the residuals over the noise, ``coordinates`` (coordinate,) are the solution.
    """

    end: float
    impacts: int
    most_impacts: int
    misfit: float
    coordinates: np.ndarray


class Fit(NamedTuple):
    """The fit from one start: ``coordinates`` (coordinate,), their ``deviance``, and the ``windows`` in their order.

    ``misfit`` is that of the whole records, as of a ``Window``. ``windows`` are those of all passes, also of one that
    did not lead to these coordinates. ``noise`` has one array (sensor,) a record, in SI units: given, or estimated from
    the residuals.
    """

    coordinates: np.ndarray
    deviance: float
    misfit: float
    windows: list[Window]
    noise: list[np.ndarray]


class GrowingWindows:
    """Fits of a ``misfit`` over windows; ``check`` is called before every evaluation, and may raise to end the fit.

    ``keep`` is called with the number and the solution (coordinate,) of every least-squares problem. A later fit that
    is given the solutions as ``solved`` takes them as they are and goes on with the next problem, to the same bits. The
    ``noise`` of the misfit is set here, and stays that of the fit.

    ``last`` (record) are the last times of the records' clocks in s, the ends of the window of all data; ``low`` and
    ``high`` (coordinate,) are the bounds.
    """

    def __init__(
        self,
        misfit: Misfit,
        check: Callable[[], None] = lambda: None,
        solved: Sequence[Sequence[float]] = (),
        keep: Callable[[int, np.ndarray], None] = lambda number, z: None,
    ) -> None:
        self.misfit = misfit
        self.check = check
        self.keep = keep
        self._solved = [np.array(z) for z in solved]
        self._solutions = 0
        self.last = [float(record.times[-1]) for record in misfit.records]

        self._sizes = misfit.sizes
        tables = misfit.plan.options.records
        self._is_given = [np.array([sensor.noise is not None for sensor in table.sensors]) for table in tables]
        misfit.noise = []
        for table, sizes in zip(tables, self._sizes, strict=True):
            noise = [sensor.noise or ASSUMED_NOISE * size for sensor, size in zip(table.sensors, sizes, strict=True)]
            misfit.noise.append(np.array(noise))

        # Coordinates of initial states have no bounds, only a prior.
        bounds = [(p.to_coordinate(p.low), p.to_coordinate(p.high)) for p in misfit.plan.parameters]
        bounds += [(-np.inf, np.inf)] * (misfit.size - misfit.count)
        self.low, self.high = np.array(bounds).T

    def fit(self, z: np.ndarray) -> Fit:
        """Fit from the coordinates ``z`` (coordinate,) on. Raises CaseError, MotionError, and what ``check`` raises."""
        z = np.clip(z, self.low, self.high)
        windows: list[Window] = []
        best = self._pass(self._fit_linear_parts(z, windows), windows)
        # Noise may have led the first windows into a valley next to the right one. Now they begin nearer to the right
        # one, and residuals are weighted by the noise that was found. The better of both fits counts.
        for _ in range(REPETITIONS):
            repeated = self._pass(best.coordinates, windows)
            if repeated.deviance < best.deviance:
                best = repeated
        self.misfit.noise = best.noise
        return self._fit_at(self.solve(best.coordinates, self.last, self._every(), FINAL), windows)

    def _pass(self, z: np.ndarray, windows: list[Window]) -> Fit:
        """Fit all coordinates from ``z`` (coordinate,) on over growing windows, then with the noise of the residuals.

        The windows are appended to ``windows``.
        """
        z = self._fit_contacts(z, windows)
        if not all(map(all, self._is_given)):
            for _ in range(REWEIGHTINGS):
                self._estimate_noise(z)
                z = self.solve(z, self.last, self._every(), CLOSE)
        return self._fit_at(z, windows)

    def _fit_at(self, z: np.ndarray, windows: list[Window]) -> Fit:
        """Return the fit to the whole records that has come to ``z`` (coordinate,); its window goes to ``windows``."""
        window = self._window(z, self.last)
        windows.append(window)
        return Fit(
            coordinates=z,
            deviance=self.deviance(z),
            misfit=window.misfit,
            windows=windows,
            noise=self.misfit.noise.copy(),
        )

    def deviance(self, z: np.ndarray) -> float:
        """Return minus twice the log-likelihood at ``z`` (coordinate,) up to a constant: the lower fit is better.

        It is the sum of squared residuals over the noise, plus 2 log(noise) for every datum, plus the initial states'
        prior.
        """
        total = self.misfit.cost(z, self.last)
        for record, noise in zip(self.misfit.records, self.misfit.noise, strict=True):
            total += 2 * len(record.times) * float(np.sum(np.log(noise)))
        return total

    def _every(self) -> list[int]:
        """Return the numbers of all coordinates."""
        return list(range(self.misfit.size))

    def _fit_linear_parts(self, z: np.ndarray, windows: list[Window]) -> np.ndarray:
        """Fit what motion without contact depends on to the records without contact, if there are any.

        Returns the coordinates (coordinate,); windows are appended to ``windows``.
        """
        plan = self.misfit.plan
        silent = [not record.contact for record in plan.options.records]
        active = []
        for number, parameter in enumerate(plan.parameters):
            is_own = parameter.quantity == "offset" and silent[parameter.members[0]]
            if parameter.acts_without_contact or is_own:
                active.append(number)
        for number, state in self.misfit.states.items():
            if silent[number]:
                active += state.indices
        if not any(silent) or not active:
            return z

        # Windows grow here as well: over many periods of a wrong frequency the misfit has many valleys, too.
        fraction = FIRST
        while True:
            ends = []
            for first, last, is_silent in zip(self._first(), self.last, silent, strict=True):
                # An end before all samples leaves a record out.
                end = -np.inf
                if is_silent:
                    end = first + fraction * (last - first)
                ends.append(end)
            precision = CLOSE
            if fraction < 1:
                precision = GROWING
            z = self.solve(z, ends, active, precision)
            windows.append(self._window(z, ends))
            if fraction == 1:
                return z
            fraction = min(fraction * plan.options.growth, 1.0)

    def _fit_contacts(self, z: np.ndarray, windows: list[Window]) -> np.ndarray:
        """Fit all coordinates from ``z`` (coordinate,) on over windows with more and more of the model's contacts.

        Returns the coordinates (coordinate,); windows are appended to ``windows``.
        """
        options = self.misfit.plan.options
        first = self._first()
        # The ends of the window before this one, and its misfit, at least that of noise.
        begin = first
        misfit_before = 1.0
        ends = self._ends(z, options.impacts, self._first_lengths())
        while True:
            is_last = ends == self.last
            precision = GROWING
            if is_last:
                precision = CLOSE
            fitted = self.solve(z, ends, self._every(), precision)
            window = self._window(fitted, ends)
            other = None
            # Below 1 the misfit is explained by the noise alone, and no contact is missing.
            if window.misfit > 1 or is_last:
                other = other_contacts(self.misfit, fitted, ends, self.high)
            if other is not None:
                fitted = self.solve(other, ends, self._every(), precision)
                window = self._window(fitted, ends)

            # A misfit that rises shows that the window has grown beyond the valley in which the fit began.
            growths = []
            for record_first, record_last, before, end in zip(first, self.last, begin, ends, strict=True):
                growths.append((end - before) / (record_last - record_first))
            if window.misfit > RISE * misfit_before and max(growths) > SHORTEST:
                ends = [(before + end) / 2 for before, end in zip(begin, ends, strict=True)]
                continue

            windows.append(window)
            z = fitted
            misfit_before = max(1.0, window.misfit)
            if is_last:
                return z
            begin = ends
            # Contacts of each record, as ``_ends`` counts them; at least one more, if the growth does not give one.
            impacts = int(max(options.growth * window.most_impacts, window.most_impacts + 1))
            lengths = [options.growth * (end - start) for start, end in zip(first, ends, strict=True)]
            # No end moves back: with the new parameters a contact may come earlier.
            ends = [max(end, later) for end, later in zip(ends, self._ends(z, impacts, lengths), strict=True)]
            # The next contact lies beyond the window, so that an end moves. If none moves, the fit still ends.
            if ends == begin:
                ends = self.last

    def _first(self) -> list[float]:
        """Return the first time in s of each record's clock."""
        return [float(record.times[0]) for record in self.misfit.records]

    def _first_lengths(self) -> list[float]:
        """Return the longest first windows (record) in s in each record: longer if the unknowns need more data.

        ``_ends`` keeps to them in records whose initial state is estimated.
        """
        lengths = []
        for number, record in enumerate(self.misfit.records):
            unknowns = self.misfit.count
            state = self.misfit.states.get(number)
            if state:
                unknowns += len(state.indices)
            fraction = min(max(FIRST, DATA_EACH * unknowns / record.values.size), 1.0)
            lengths.append(fraction * float(record.times[-1] - record.times[0]))
        return lengths

    def _ends(self, z: np.ndarray, impacts: int, lengths: Sequence[float]) -> list[float]:
        """Return times in s of the records' clocks at the model's contact number ``impacts`` + 1, or the last times.

        A window of a record whose initial state is estimated has its length of ``lengths`` (record,) in s at most: as
        long as that state is not found, the model has few contacts or none.
        """
        ends = []
        for number, (first, last, length) in enumerate(zip(self._first(), self.last, lengths, strict=True)):
            if number in self.misfit.states:
                last = min(last, first + length)
            onsets = self.onsets(z, number, self.last[number])
            if len(onsets) > impacts:
                last = min(last, float(onsets[impacts]))
            # Contacts may follow each other within a sample: a window must have data.
            ends.append(max(last, float(self.misfit.records[number].times[LEAST_SAMPLES - 1])))
        return ends

    def onsets(self, z: np.ndarray, number: int, end: float) -> np.ndarray:
        """Return the onsets (episode,) in s of the model's contacts in record ``number``, by its clock.

        They are those from the record's first sample to its time ``end``; none where the model has no motion.
        """
        try:
            onset = self.misfit.motion(z, number, end).onset
        except (CaseError, MotionError):
            return np.zeros(0)
        return onset[onset > self.misfit.records[number].times[0]]

    def _window(self, z: np.ndarray, ends: Sequence[float]) -> Window:
        """Return the window up to ``ends`` (record,) in s with its misfit at ``z``."""
        impacts = []
        for number, (record, end) in enumerate(zip(self.misfit.records, ends, strict=True)):
            if end >= record.times[0]:
                impacts.append(len(self.onsets(z, number, end)))
        residuals = self.misfit.residuals(z, ends)
        return Window(
            end=max(ends),
            impacts=sum(impacts),
            most_impacts=max(impacts),
            misfit=float(np.sqrt(np.mean(residuals**2))),
            coordinates=z.copy(),
        )

    def solve(self, z: np.ndarray, ends: Sequence[float], active: Sequence[int], precision: Precision) -> np.ndarray:
        """Return coordinates (coordinate,) with the least squares over a window, by a trust region within the bounds.

        The fit begins at ``z`` (coordinate,), of which the ``active`` coordinates are fitted, to data up to ``ends``
        (record,) in s. Raises CaseError, MotionError, and what ``check`` raises.
        """
        number = self._solutions
        self._solutions += 1
        if number < len(self._solved):
            return self._solved[number].copy()
        solution = self.minimum(z, ends, active, precision).coordinates
        self.keep(number, solution)
        return solution

    def minimum(
        self,
        z: np.ndarray,
        ends: Sequence[float],
        active: Sequence[int],
        precision: Precision,
        slopes: np.ndarray | None = None,
    ) -> Minimum:
        """Return the solution that ``solve`` records, with all of its coordinates (coordinate,).

        The fit begins with ``slopes`` (datum, active), derivatives of the residuals of data near ``z``, if it is given
        them; those of the result are derivatives of the same residuals.
        """
        active = list(active)
        start = z[active].copy()
        # While windows grow, parameters have a prior about the start of this fit; states always have one about rest.
        is_parameter = np.array(active) < self.misfit.count
        weights = np.where(is_parameter, 0.0, 1 / WIDTH)
        if precision.has_prior:
            weights = np.where(is_parameter, 1 / PRIOR, 1 / NARROW)
        centre = np.where(is_parameter, start, 0.0)

        def whole(x: np.ndarray) -> np.ndarray:
            full = z.copy()
            full[active] = x
            return full

        def residuals(x: np.ndarray) -> np.ndarray:
            self.check()
            data = self.misfit.residuals(whole(x), ends)
            return np.concatenate([data, weights * (x - centre)])

        def with_prior(data: np.ndarray) -> np.ndarray:
            # The first Jacobian sets the weights: it is asked for at the start, where the residuals of the prior are
            # zero with any weight.
            weights[is_parameter] = np.maximum(weights[is_parameter], RIDGE * np.linalg.norm(data))
            return np.concatenate([data, np.diag(weights)])

        def jacobian(x: np.ndarray) -> np.ndarray:
            return with_prior(self.misfit.jacobian(whole(x), ends, active, precision.is_rough))

        if slopes is not None:
            slopes = with_prior(slopes)
        bounds = (self.low[active], self.high[active])
        steps = precision.steps or self.misfit.plan.options.steps
        minimum = least_residuals(residuals, jacobian, start, bounds, precision, steps, slopes)
        return Minimum(whole(minimum.coordinates), minimum.slopes[: len(minimum.slopes) - len(active)])

    def _estimate_noise(self, z: np.ndarray) -> None:
        """Estimate the noise of the channels for which none is given from their residuals at ``z`` (coordinate,)."""
        # A fit of m numbers to n data makes the mean square of the residuals smaller by 1 - m/n.
        count = sum(record.values.size for record in self.misfit.records)
        free = self.freedom(z) / count
        for number, record in enumerate(self.misfit.records):
            values = self.misfit.predicted(z, number, self.last[number])
            variance = np.mean((values - record.values) ** 2, axis=0) / free
            estimated = np.maximum(np.sqrt(variance), LEAST_NOISE * self._sizes[number])
            self.misfit.noise[number] = np.where(self._is_given[number], self.misfit.noise[number], estimated)

    def freedom(self, z: np.ndarray) -> float:
        """Return degrees of freedom of the residuals at ``z`` (coordinate,): data less what is fitted, at least 1."""
        count = sum(record.values.size for record in self.misfit.records)
        return max(count - self._fitted(z), 1.0)

    def noise_freedom(self, z: np.ndarray) -> float:
        """Return the degrees of freedom of the noise at ``z`` (coordinate,); inf if all noise is given."""
        if all(map(all, self._is_given)):
            return np.inf
        return self.freedom(z)

    def _fitted(self, z: np.ndarray) -> float:
        """Return how many numbers are fitted to the data at ``z``: one a parameter, less than one a state's coordinate.

        The prior holds a state in part.
        """
        if not self.misfit.states:
            return float(self.misfit.count)
        # In the linear problem fitted data are H times data. With J = Q R, which has the rows of the prior too, H is
        # Q_d Q_d^T, Q_d being the rows of data, and its trace is the number that is sought.
        jacobian = self.misfit.whole_jacobian(z, self.last)
        orthogonal, _ = np.linalg.qr(jacobian)
        return float(np.sum(orthogonal[: len(jacobian) - len(self.misfit.prior())] ** 2))
