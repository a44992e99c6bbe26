"""The compiled flow: DOP853, Dormand and Prince's pair of order 8(5,3), landing on every contact change.

Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, 2nd ed. 1993, sec. II.5 and II.10, and the
authors' code DOP853. Stage s is y + h sum_r A[s, r] k_r, the new state y + h sum_r B[r] k_r; E5 and E3 give the
estimates of orders 5 and 3, which II.10 combines into err5^2 / sqrt(err5^2 + err3^2 / 100).
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.modes.problem import FlowError
from vipetsc.modes.shooting import flow
from vipetsc.modes.shooting.flow import Flow
from vipetsc.modes.shooting.landing import EXTREMUM, MOST_ATTEMPTS, NONE, Change, correct
from vipetsc.modes.system import System

# Outcomes of a flow: the time is covered; a step is too small; there are more changes than can be listed.
DONE, STUCK, FULL = range(3)
# Errors allowed per step, relative to the size of the orbit and of each variation.
RTOL = 1e-13
RTOL_SENSITIVITY = 1e-11
# Contact changes of one arc beyond which a flow gives up: thirty times as many as the in-phase branch of the paper's
# model (bilinear) has in a quarter period up to 5 J, 67.
MOST_CHANGES = 2000
# A step shorter than this fraction of the arc's time is taken as it was tried if its search for a contact change finds
# one at the step's very beginning: a contact at rest at its clearance hardly moves in it, and rounding decides.
SHORT = 1e-6
STAGES = 12
_TABLEAU = np.loadtxt(Path(__file__).with_suffix(".csv"), delimiter=",")
A = _TABLEAU[:STAGES]
B, E3, E5 = _TABLEAU[STAGES:]
# The new step is this fraction of the one that would have the error allowed, and within these factors of the last. The
# fraction and the largest factor are those of the authors' code, whose smallest factor is 1/3.
SAFETY = 0.9
LEAST_FACTOR = 0.2
MOST_FACTOR = 6.0
# Lower bound of the error in the formula of the new step, which divides by it; the largest factor is met long before.
SMALLEST_ERROR = 1e-12


class Stepper(NamedTuple):
    """Arrays of a step: rates at its ``stages`` (STAGES, rows, 1 + m), states at its ``start`` and ``end``.

    Velocities count as displacements over a radian of ``omega_ref`` (rad/s), and a step is at most one radian. Rows or
    columns are padded with zeros (``_padded``). Sums over stages are done on ``flat``: stages, errors, start and end
    with one dimension in place of two. ``errors`` (2, rows, 1 + m): of orders 3 and 5, over h.
    """

    step: flow.FlowStep
    omega_ref: float
    stages: np.ndarray
    errors: np.ndarray
    start: np.ndarray
    end: np.ndarray
    end_rates: np.ndarray
    flat: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@kernel
def _combine(stepper: Stepper, weights: np.ndarray, h: float) -> None:
    """Put the start plus ``h`` times the weighted sum of the rates of all stages into the end.

    ``weights`` (STAGES,) are 0 for stages that are not known yet: a loop over all of them has a length that the
    compiler knows.
    """
    k, _, y, end = stepper.flat
    for e in range(end.size):
        total = 0.0
        for r in range(STAGES):
            total += weights[r] * k[r, e]
        end[e] = y[e] + h * total


@kernel
def _scaled_error(stepper: Stepper, h: float) -> float:
    """The largest error of a column over what is allowed; infinite if the step overflowed."""
    y = stepper.start
    end = stepper.end
    errors = stepper.errors

    # 0 times a number that is not finite is NaN, which makes the sum differ from zero. A test of each number would cost
    # a branch in the loop.
    zero = 0.0
    for value in stepper.flat[3]:
        zero += 0.0 * value
    if zero != 0.0:
        return np.inf

    k, estimates, _, _ = stepper.flat
    for e in range(estimates.shape[1]):
        e3 = 0.0
        e5 = 0.0
        for r in range(STAGES):
            e3 += E3[r] * k[r, e]
            e5 += E5[r] * k[r, e]
        estimates[0, e] = e3
        estimates[1, e] = e5

    # The orbit and each variation are judged by themselves: a variation may be many times as large as another one.
    n = stepper.step.system.inverse_mass.size
    error = 0.0
    for j in range(y.shape[1]):
        fifth = 0.0
        third = 0.0
        scale = 0.0
        for i in range(2 * n):
            unit = 1.0
            if i >= n:
                unit = 1.0 / stepper.omega_ref
            fifth = max(fifth, abs(errors[1, i, j]) * unit)
            third = max(third, abs(errors[0, i, j]) * unit)
            scale = max(scale, abs(end[i, j]) * unit, abs(y[i, j]) * unit)
        if fifth > 0.0:
            allowed = RTOL_SENSITIVITY * scale
            if j == 0:
                allowed = RTOL * scale
            error = max(error, h * fifth * fifth / np.sqrt(fifth * fifth + 0.01 * third * third) / allowed)
    return error


@kernel
def _advance(stepper: Stepper, h: float) -> None:
    """One step of length ``h`` from the start, whose rates are the first stage."""
    step = stepper.step
    for s in range(1, STAGES):
        _combine(stepper, A[s], h)
        flow.rates(step.system, step.side, stepper.end, stepper.stages[s])
    _combine(stepper, B, h)


@kernel
def _tried(stepper: Stepper, h: float) -> float:
    """Make a step of length ``h``, and return its scaled error."""
    _advance(stepper, h)
    return _scaled_error(stepper, h)


@kernel
def _take_orbit(orbit: Stepper, stepper: Stepper) -> None:
    """Let the ``orbit`` begin where the ``stepper`` begins, without the variations."""
    # Rates that an earlier attempt has left infinite or NaN would stay in the sums, even with the weight 0.
    orbit.stages[1:] = 0.0
    for i in range(2 * stepper.step.system.inverse_mass.size):
        orbit.start[i, 0] = stepper.start[i, 0]
        orbit.stages[0, i, 0] = stepper.stages[0, i, 0]


@kernel
def _land(stepper: Stepper, orbit: Stepper, t: float, h: float, change: Change) -> tuple[float, bool]:
    """Repeat the step of length ``h`` at time ``t`` so that it ends on a ``change``.

    Returns the new length, and whether there is a change at its end; otherwise the gap has a largest value there, not
    above zero. The ``orbit``, a stepper without variations, makes the attempts. The ``stepper`` makes one step, of the
    length that is found, with the variations.
    """
    step = orbit.step
    _take_orbit(orbit, stepper)
    for _ in range(MOST_ATTEMPTS):
        # Each attempt is a whole step from the start: its end has the order of the pair, an interpolant has not.
        length = change.length
        _advance(orbit, length)
        flow.observe(step, orbit.end, orbit.end_rates, step.end)
        # A root is sought to the rounding of the arc's time; an extremum, near which the gap is flat, to that of h.
        floor = 1e-16 * (t + h)
        if change.extremum:
            floor = 1e-15 * h
        change, outcome = correct(change, step.end[change.contact], floor)
        if outcome != NONE:
            break
    _advance(stepper, length)
    return length, outcome != EXTREMUM


@kernel
def _begin_at_end(stepper: Stepper, smooth: bool) -> None:
    """Begin the next step at the end of the last one; after a ``smooth`` one, without a change, its rates are known."""
    _, _, start, end = stepper.flat
    for e in range(end.size):
        start[e] = end[e]
    if not smooth:
        return

    # The same contacts are closed: rates and motions are those of the end.
    rows, columns = stepper.end_rates.shape
    for i in range(rows):
        for j in range(columns):
            stepper.stages[0, i, j] = stepper.end_rates[i, j]
    step = stepper.step
    for c in range(step.side.size):
        for k in range(3):
            step.start[c, k] = step.end[c, k]


@kernel
def _shortened(h: float, error: float) -> float:
    """The length to try after a step of length ``h`` whose scaled ``error`` is not below 1."""
    # A number that has overflowed says nothing of the next length.
    if not error < 1e300:
        return h * 0.1
    return h * max(LEAST_FACTOR, SAFETY * error ** (-0.125))


@kernel
def _fill_event(event: np.ndarray, t: float, change: Change, kind: int) -> None:
    """Fill a row of the events: time, contact, side and kind (1 onset, -1 separation)."""
    event[0] = t
    event[1] = change.contact
    event[2] = change.side
    event[3] = kind


@kernel
def _flow(stepper: Stepper, orbit: Stepper, duration: float, events: np.ndarray) -> tuple[int, int, float]:
    """Advance the ``start`` in place over ``duration`` seconds; the ``orbit`` is a stepper for its first column alone.

    Returns the outcome (DONE, STUCK or FULL), the number of ``events`` (capacity, 4) filled with time, contact, side
    and kind (1 onset, -1 separation), and the seconds with a contact closed.
    """
    step = stepper.step
    # At most a radian of the fastest motion: beyond, the quintic that is searched for changes would miss some.
    largest = 1.0 / stepper.omega_ref
    t = 0.0
    closed = 0.0
    count = 0
    h = min(0.1 * largest, duration)
    flow.close(step.system, stepper.start, step.side)
    flow.observe(step, stepper.start, stepper.stages[0], step.start)

    while t < duration:
        last = t + h >= duration * (1.0 - 1e-15)
        if last:
            h = duration - t
        elif h < flow.SMALLEST_STEP * duration:
            return STUCK, count, closed

        error = _tried(stepper, h)
        if not error < 1.0:
            # After an overflow: see ``_take_orbit``.
            if not error < 1e300:
                stepper.stages[1:] = 0.0
            h = _shortened(h, error)
            continue
        grown = min(largest, h * min(MOST_FACTOR, SAFETY * max(error, SMALLEST_ERROR) ** (-0.125)))

        flow.observe(step, stepper.end, stepper.end_rates, step.end)
        change = flow.first_change(step, h)
        smooth = change.contact < 0
        changed = False
        whole = h
        if not smooth:
            h, changed = _land(stepper, orbit, t, h, change)
        # The landing has shortened the step to nothing: rounding took the step's beginning for an extremum.
        if not smooth and not changed and t + h == t:
            if whole > SHORT * duration:
                return STUCK, count, closed
            h = whole
            smooth = True
            _advance(stepper, h)
            flow.observe(step, stepper.end, stepper.end_rates, step.end)

        _begin_at_end(stepper, smooth)
        if np.any(step.side):
            closed += h
        t += h
        # The end is set exactly: a sum of steps is rounded.
        if last and smooth:
            t = duration
        h = grown
        if changed:
            if count >= events.shape[0]:
                return FULL, count, closed
            _fill_event(events[count], t, change, flow.switch(step, change))
            count += 1
        if not smooth:
            flow.observe(step, stepper.start, stepper.stages[0], step.start)
    return DONE, count, closed


def _padded(rows: int, columns: int) -> tuple[int, int]:
    """The least numbers of rows and columns with a multiple of 8 entries: sums over them then have no remainder."""
    more_rows = -(-rows // 8) * 8, columns
    least = 8 // math.gcd(rows, 8)
    more_columns = rows, -(-columns // least) * least
    return min(more_rows, more_columns, key=math.prod)


@kernel
def _flow_through(
    stepper: Stepper, orbit: Stepper, interval: float, states: np.ndarray, events: np.ndarray
) -> tuple[int, int, float]:
    """Advance by the ``interval`` in s as often as there are ``states`` (count, 2n), which are those of the orbit.

    Returns what ``_flow`` gives for the last interval, or for the first that is not covered.
    """
    outcome = DONE
    count = 0
    closed = 0.0
    for number in range(states.shape[0]):
        outcome, count, closed = _flow(stepper, orbit, interval, events)
        if outcome != DONE:
            break
        for i in range(states.shape[1]):
            states[number, i] = stepper.start[i, 0]
    return outcome, count, closed


class Dop853Flow(Flow):
    """Dormand and Prince's 8(5,3) pair, landing on every contact change."""

    name = "compiled"

    def __init__(self, system: System) -> None:
        super().__init__(system)
        self._columns = 1 + 2 * system.dofs
        self._stepper = self._allocate(self._columns)
        self._orbit = self._allocate(1)
        # The orbit where no variations are asked for, and its end.
        self._alone = self._allocate(1)
        self._end = np.empty((1, 2 * system.dofs))
        self._events = np.empty((MOST_CHANGES, 4))

    def _allocate(self, columns: int) -> Stepper:
        """The arrays for steps of the orbit and its variations, in ``columns`` columns together."""
        shape = _padded(2 * self.system.dofs, columns)
        block = np.zeros((STAGES + 5, *shape))
        flat = block.reshape(len(block), -1)
        stages, errors, (start, end, end_rates) = np.split(block, [STAGES, STAGES + 2])
        sums = flat[:STAGES], flat[STAGES : STAGES + 2], flat[STAGES + 2], flat[STAGES + 3]
        step = flow.begin(self.compiled, start)
        return Stepper(step, 1.0, stages, errors, start, end, end_rates, sums)

    def _advance(self, y: np.ndarray, duration: float, period: float) -> tuple[np.ndarray, np.ndarray, float]:
        state = self._stepper.start[: len(y), : self._columns]
        state[:] = y
        count, closed = self._flow_through(self._stepper, duration, self._end, period)
        return state, self._events[:count].copy(), closed

    def states(self, start: np.ndarray, interval: float, count: int, period: float) -> np.ndarray:
        """The states that ``Flow.states`` describes, computed without variations."""
        states = np.empty((1 + count, 2 * self.system.dofs))
        states[0] = start
        self._alone.start[: states.shape[1], 0] = start
        self._flow_through(self._alone, interval, states[1:], period)
        return states

    def _flow_through(self, stepper: Stepper, interval: float, states: np.ndarray, period: float) -> tuple[int, float]:
        """Advance a ``stepper`` by an ``interval`` in s for each of the ``states``, which are filled.

        Returns the number of changes in the last interval, and its seconds with a contact closed.
        """
        stepper = stepper._replace(omega_ref=self.omega_ref(period))
        # Contacts that are closed in a step are so for both.
        orbit = self._orbit._replace(step=stepper.step)
        outcome, count, closed = _flow_through(stepper, orbit, interval, states, self._events)
        if outcome != DONE:
            why = {STUCK: "the step became too small", FULL: f"more than {MOST_CHANGES} contact changes"}
            raise FlowError(f"the flow stopped after {count} contact changes in {interval:.6g} s: {why[outcome]}")
        return count, closed
