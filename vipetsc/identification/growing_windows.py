"""The fit over windows that grow, from one start."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from vipetsc.case import CaseError
from vipetsc.identification.misfit import Misfit
from vipetsc.identification.motion import MotionError

# While windows grow, what the data do not tell yet stays: a deviation of one of a coordinate weighs as one datum that
# misses by its noise. The last fit has no such rows.
PRIOR = 1.0
# Noise that is not given, over the size of a channel, until residuals tell.
ASSUMED_NOISE = 0.01
# Smallest noise over the size of a channel.
LEAST_NOISE = 1e-9
# A clearance that the model does not reach has no derivative: it is tried at this fraction of what is reached.
WITHIN_REACH = 0.98
TOLERANCE = 1e-12
# ... of the cost and of the step, while windows grow.
ROUGH_COST = 1e-2
ROUGH_STEP = 1e-3
# A window is repeated at half its growth if its misfit is so many times that of the one before, and that of noise,
# until it grows by less than this fraction of the record.
RISE = 2.0
SHORTEST = 0.01
# First window of records without contact, over the last one.
FIRST_LINEAR = 0.1
REWEIGHTINGS = 2
# Further passes through all windows.
REPETITIONS = 1


class Window(NamedTuple):
    """A fit over one window: the largest time of the records' clocks in s, the model's contacts, the misfit.

    ``misfit`` is the root of the mean square of the residuals over the noise; ``coordinates`` (parameter,).
    """

    end: float
    impacts: int
    misfit: float
    coordinates: np.ndarray


class Precision(NamedTuple):
    """How a fit ends: after so many ``steps`` (None: those of the case), with a prior, by rough tolerances."""

    steps: int | None = None
    has_prior: bool = False
    is_rough: bool = False


GROWING = Precision(has_prior=True, is_rough=True)
FINAL = Precision()


class Fit(NamedTuple):
    """The fit from one start: ``coordinates`` (parameter,), ``deviance``, and the ``windows`` in their order.

    ``noise`` has one array (sensor,) a record: given, or estimated from the residuals.
    """

    coordinates: np.ndarray
    deviance: float
    windows: list[Window]
    noise: list[np.ndarray]


class GrowingWindows:
    """Fits a ``misfit`` over windows; ``check`` is called before every evaluation, and may raise."""

    def __init__(self, misfit: Misfit, check: Callable[[], None] = lambda: None) -> None:
        self.misfit = misfit
        self.check = check
        options = misfit.plan.options
        self.last = [float(record.times[-1]) for record in misfit.records]
        self._is_given = []
        for number, table in enumerate(options.records):
            given = np.array([sensor.noise is not None for sensor in table.sensors])
            sizes = misfit.noise[number]
            noise = [sensor.noise or ASSUMED_NOISE * size for sensor, size in zip(table.sensors, sizes, strict=True)]
            self._is_given.append(given)
            misfit.noise[number] = np.array(noise)
        self._sizes = [np.sqrt(np.mean(record.values**2, axis=0)) for record in misfit.records]
        self.low, self.high = np.array(
            [(p.to_coordinate(p.low), p.to_coordinate(p.high)) for p in misfit.plan.parameters]
        ).T

    def fit(self, z: np.ndarray) -> Fit:
        """Fit from the coordinates ``z`` (parameter,) on."""
        z = np.clip(z, self.low, self.high)
        windows: list[Window] = []
        best = self._pass(self._fit_linear_parts(z, windows), windows)
        # Where noise has led the first windows into a valley next to the right one, they now begin near the right one,
        # with weights that are those of the noise.
        for _ in range(REPETITIONS):
            repeated = self._pass(best.coordinates, windows)
            if repeated.deviance < best.deviance:
                best = repeated
        self.misfit.noise = best.noise
        return best._replace(windows=windows)

    def _pass(self, z: np.ndarray, windows: list[Window]) -> Fit:
        """Fit all parameters over growing windows, then over all data with the noise that they show."""
        z = self._fit_contacts(z, windows)
        for _ in range(REWEIGHTINGS if not all(map(all, self._is_given)) else 0):
            self._estimate_noise(z)
            z = self.solve(z, self.last, self._every())
        windows.append(self._window(z, self.last))
        return Fit(z, self.deviance(z), windows, self.misfit.noise.copy())

    def deviance(self, z: np.ndarray) -> float:
        """Minus twice the logarithm of the likelihood but for a constant: fits with other noise can be compared."""
        total = float(np.sum(self.misfit.residuals(z, self.last) ** 2))
        for record, noise in zip(self.misfit.records, self.misfit.noise, strict=True):
            total += 2 * len(record.times) * float(np.sum(np.log(noise)))
        return total

    def _every(self) -> list[int]:
        """The numbers of all parameters."""
        return list(range(len(self.misfit.plan.parameters)))

    def _fit_linear_parts(self, z: np.ndarray, windows: list[Window]) -> np.ndarray:
        """Fit what motion without contact depends on to the records without contact, if there are any."""
        plan = self.misfit.plan
        silent = [not record.contact for record in plan.options.records]
        active = []
        for number, parameter in enumerate(plan.parameters):
            is_own = parameter.quantity == "offset" and silent[parameter.members[0]]
            if parameter.is_linear or is_own:
                active.append(number)
        if not any(silent) or not active:
            return z

        fraction = FIRST_LINEAR
        while fraction:
            ends = []
            for record, end, is_silent in zip(self.misfit.records, self.last, silent, strict=True):
                first = float(record.times[0])
                ends.append(first + fraction * (end - first) if is_silent else -np.inf)
            z = self.solve(z, ends, active, GROWING if fraction < 1 else FINAL)
            windows.append(self._window(z, ends))
            fraction = 0.0 if fraction == 1 else min(fraction * plan.options.growth, 1.0)
        return z

    def _fit_contacts(self, z: np.ndarray, windows: list[Window]) -> np.ndarray:
        """Fit all parameters over windows with more and more of the model's contacts."""
        options = self.misfit.plan.options
        impacts = float(options.impacts)
        begin = self._first()
        least = 1.0
        ends = self._ends(z, int(impacts))
        while True:
            is_last = ends == self.last
            precision = FINAL if is_last else GROWING
            fitted = self.solve(z, ends, self._every(), precision)
            nearer = self._within_reach(fitted, ends)
            if nearer is not None:
                fitted = self.solve(nearer, ends, self._every(), precision)
            window = self._window(fitted, ends)

            # A misfit that rises shows that the window has grown past the reach of the last fit: it is made shorter.
            shorter = [(a + b) / 2 for a, b in zip(begin, ends, strict=True)]
            grown = max((b - a) / (c - a0) for a, b, c, a0 in zip(begin, ends, self.last, self._first(), strict=True))
            if window.misfit > RISE * least and grown > SHORTEST:
                ends = shorter
                continue

            windows.append(window)
            z = fitted
            least = max(1.0, window.misfit)
            if is_last:
                return z
            begin = ends
            impacts = max(options.growth * window.impacts, window.impacts + 1)
            ends = [max(a, b) for a, b in zip(ends, self._ends(z, int(impacts)), strict=True)]
            if ends == begin:
                ends = self.last

    def _first(self) -> list[float]:
        """The first time in s of each record's clock."""
        return [float(record.times[0]) for record in self.misfit.records]

    def _ends(self, z: np.ndarray, impacts: int) -> list[float]:
        """Times in s of the records' clocks before the model's contact number ``impacts`` + 1, or their last times."""
        ends = []
        for number, last in enumerate(self.last):
            onsets = self._onsets(z, number)
            if len(onsets) > impacts:
                last = min(last, float(onsets[impacts]) + self.misfit.offset(z, number))
            ends.append(last)
        return ends

    def _onsets(self, z: np.ndarray, number: int) -> np.ndarray:
        """The onsets in s of the model's contacts in a record."""
        try:
            return np.asarray(self.misfit.respond(z, number, self.last[number]).episodes["onset"])
        except (CaseError, MotionError):
            return np.zeros(0)

    def _window(self, z: np.ndarray, ends: Sequence[float]) -> Window:
        """The window up to ``ends`` with its misfit."""
        impacts = 0
        for number, end in enumerate(ends):
            if end > -np.inf:
                impacts += int(np.sum(self._onsets(z, number) <= end - self.misfit.offset(z, number)))
        residuals = self.misfit.residuals(z, ends)
        return Window(max(ends), impacts, float(np.sqrt(np.mean(residuals**2))), z.copy())

    def reached(self, z: np.ndarray, ends: Sequence[float]) -> np.ndarray:
        """The largest |w| (site,) in m that any record reaches in the model up to ``ends``, and 0 where it closes."""
        largest = np.zeros(len(self.misfit.plan.base.model().chain.sites))
        for number, (table, end) in enumerate(zip(self.misfit.plan.options.records, ends, strict=True)):
            if table.contact and (self.misfit.records[number].times <= end).any():
                response = self.misfit.respond(z, number, end)
                largest = np.maximum(largest, response.reached.max(axis=1))
                touched = np.unique(response.episodes["site"])
                largest[touched] = np.inf
        return np.where(np.isfinite(largest), largest, 0.0)

    def _within_reach(self, z: np.ndarray, ends: Sequence[float]) -> np.ndarray | None:
        """Coordinates with clearances just within reach of the motion, if that lowers the misfit; else None."""
        try:
            reached = self.reached(z, ends)
        except (CaseError, MotionError):
            return None
        best = None
        least = float(np.sum(self.misfit.residuals(z, ends) ** 2))
        for number, parameter in enumerate(self.misfit.plan.parameters):
            if parameter.quantity != "clearance":
                continue
            wanted = WITHIN_REACH * max(reached[member] for member in parameter.members)
            if not all(reached[member] for member in parameter.members) or wanted < parameter.low:
                continue
            moved = z.copy() if best is None else best.copy()
            moved[number] = parameter.to_coordinate(wanted)
            cost = float(np.sum(self.misfit.residuals(moved, ends) ** 2))
            if cost < least:
                best = moved
                least = cost
        return best

    def solve(
        self, z: np.ndarray, ends: Sequence[float], active: Sequence[int], precision: Precision = FINAL
    ) -> np.ndarray:
        """The coordinates with the least squares over a window, by a trust region within the bounds."""
        active = list(active)
        start = z[active].copy()
        weight = float(precision.has_prior) / PRIOR

        def whole(x: np.ndarray) -> np.ndarray:
            full = z.copy()
            full[active] = x
            return full

        def residuals(x: np.ndarray) -> np.ndarray:
            self.check()
            data = self.misfit.residuals(whole(x), ends)
            return np.concatenate([data, weight * (x - start)])

        def jacobian(x: np.ndarray) -> np.ndarray:
            data = self.misfit.jacobian(whole(x), ends, active)
            return np.concatenate([data, weight * np.eye(len(active))])

        solution = least_squares(
            residuals,
            # A start on a bound is moved inside by the method, and a start outside is refused.
            np.clip(start, self.low[active], self.high[active]),
            jac=jacobian,
            bounds=(self.low[active], self.high[active]),
            method="trf",
            x_scale=1.0,
            xtol=ROUGH_STEP if precision.is_rough else TOLERANCE,
            ftol=ROUGH_COST if precision.is_rough else TOLERANCE,
            gtol=TOLERANCE,
            max_nfev=precision.steps or self.misfit.plan.options.steps,
        )
        return whole(solution.x)

    def _estimate_noise(self, z: np.ndarray) -> None:
        """Estimate the noise of the channels for which none is given from their residuals."""
        count = sum(record.values.size for record in self.misfit.records)
        free = max(count - len(self.misfit.plan.parameters), 1) / count
        for number, record in enumerate(self.misfit.records):
            values, _ = self.misfit.predicted(z, number, self.last[number])
            variance = np.mean((values - record.values) ** 2, axis=0) / free
            estimated = np.maximum(np.sqrt(variance), LEAST_NOISE * self._sizes[number])
            self.misfit.noise[number] = np.where(self._is_given[number], self.misfit.noise[number], estimated)
