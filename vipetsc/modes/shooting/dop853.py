"""The compiled flow: steps of Dormand and Prince's pair (``dop853_step``), landing on every contact change."""

import math
from typing import Any

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.modes.problem import FlowError
from vipetsc.modes.shooting import flow
from vipetsc.modes.shooting.dop853_step import STAGES, Stepper, advance, grown, shortened, tried
from vipetsc.modes.shooting.flow import Advance, Flow
from vipetsc.modes.shooting.landing import CROSSING, EXTREMUM, MOST_ATTEMPTS, NONE, Change, correct
from vipetsc.modes.system import System

# Outcomes of a flow: the time is covered; a step is too small; there are more changes than can be listed; the steps
# that were allowed are done, and the flow can go on.
DONE, STUCK, FULL, PAUSED = range(4)
# Contact changes of one arc beyond which a flow gives up: thirty times as many as the in-phase branch of the paper's
# model (bilinear) has in a quarter period up to 5 J, 67.
MOST_CHANGES = 2000
# A step shorter than this fraction of the arc's time is taken as it was tried if its search for a contact change finds
# one at the step's very beginning: a contact at rest at its clearance hardly moves in it, and rounding decides.
SHORT = 1e-6
COUNTS = [(name, np.int64) for name in ("interval", "has_begun", "steps", "pause", "changes")]
PROGRESS = np.dtype([*COUNTS, ("time", float), ("length", float), ("closed", float)])
"""How far a flow has come: the number of its present interval, and 1 if that has begun; the steps tried so far, and how
many are allowed; in that interval the changes, the time in s, the next step's in s, the seconds with a contact closed.
"""


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

    Returns the new length, and whether there is a change at its end; otherwise the gap (``landing``) has a largest
    value there, not above zero. The ``orbit``, a stepper without variations, makes the attempts. The ``stepper`` makes
    one step, of the length that is found, with the variations.
    """
    step = orbit.step
    _take_orbit(orbit, stepper)
    for _ in range(MOST_ATTEMPTS):
        # Each attempt is a whole step from the start: its end has the order of the pair, an interpolant has not.
        length = change.length
        advance(orbit, length)
        flow.observe(step, orbit.end, orbit.end_rates, step.end)
        # A root is sought to the rounding of the arc's time; an extremum, near which the gap is flat, to that of h.
        floor = 1e-16 * (t + h)
        if change.extremum:
            floor = 1e-15 * h
        change, outcome = correct(change, step.end[change.contact], floor)
        if outcome != NONE:
            break
    advance(stepper, length)
    return length, outcome != EXTREMUM


@kernel
def _end_on_change(stepper: Stepper, orbit: Stepper, t: float, h: float, duration: float) -> tuple[float, Change, int]:
    """Let a step of length ``h`` at time ``t``, which is made, end on its first change.

    Returns the new length, the change, and how the step ends: without a change (NONE), on the change (CROSSING), or
    where a gap is largest and not above zero (EXTREMUM).
    """
    step = stepper.step
    flow.observe(step, stepper.end, stepper.end_rates, step.end)
    change = flow.first_change(step, h)
    if change.contact < 0:
        return h, change, NONE

    length, changed = _land(stepper, orbit, t, h, change)
    if changed:
        return length, change, CROSSING
    # The landing has shortened the step to nothing: rounding took the step's beginning for an extremum.
    if t + length == t and h <= SHORT * duration:
        advance(stepper, h)
        flow.observe(step, stepper.end, stepper.end_rates, step.end)
        return h, change, NONE
    return length, change, EXTREMUM


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
def _fill_event(event: np.ndarray, t: float, change: Change, kind: int) -> None:
    """Fill a row of the events: time, contact, side and kind (1 onset, -1 separation)."""
    event[0] = t
    event[1] = change.contact
    event[2] = change.side
    event[3] = kind


@kernel
def _begin(stepper: Stepper, length: float, progress: Any) -> None:
    """Begin a flow at the ``start`` of a stepper, with a first step of ``length`` s."""
    progress.has_begun = 1
    progress.changes = 0
    progress.time = 0.0
    progress.length = length
    progress.closed = 0.0

    step = stepper.step
    flow.close(step.system, stepper.start, step.side)
    flow.observe(step, stepper.start, stepper.stages[0], step.start)


@kernel
def _flow(stepper: Stepper, orbit: Stepper, duration: float, events: np.ndarray, progress: Any) -> int:
    """Advance the ``start`` in place over ``duration`` seconds; the ``orbit`` is a stepper for its first column alone.

    ``progress`` is a record of dtype ``PROGRESS``, from which the flow goes on. Its changes are in as many rows of
    ``events`` (capacity, 4): time, contact, side and kind (1 onset, -1 separation). Returns the outcome.
    """
    step = stepper.step
    # At most a radian of the fastest motion: beyond, the quintic that is searched for changes would miss some.
    largest = 1.0 / stepper.omega_ref
    if progress.has_begun == 0:
        _begin(stepper, min(0.1 * largest, duration), progress)
    t = progress.time
    h = progress.length
    outcome = DONE

    while t < duration:
        if progress.steps >= progress.pause:
            outcome = PAUSED
            break
        progress.steps += 1
        last = t + h >= duration * (1.0 - 1e-15)
        if last:
            h = duration - t
        elif h < flow.SMALLEST_STEP * duration:
            outcome = STUCK
            break

        error = tried(stepper, h)
        if not error < 1.0:
            # After an overflow: see ``_take_orbit``.
            if not error < 1e300:
                stepper.stages[1:] = 0.0
            h = shortened(h, error)
            continue
        next_length = grown(h, error, largest)

        h, change, end = _end_on_change(stepper, orbit, t, h, duration)
        if end == EXTREMUM and t + h == t:
            outcome = STUCK
            break

        _begin_at_end(stepper, end == NONE)
        if np.any(step.side):
            progress.closed += h
        t += h
        # The end is set exactly: a sum of steps is rounded.
        if last and end == NONE:
            t = duration
        h = next_length
        if end == CROSSING:
            if progress.changes >= events.shape[0]:
                outcome = FULL
                break
            _fill_event(events[progress.changes], t, change, flow.switch(step, change))
            progress.changes += 1
        if end != NONE:
            flow.observe(step, stepper.start, stepper.stages[0], step.start)

    progress.time = t
    progress.length = h
    return outcome


def _padded(rows: int, columns: int) -> tuple[int, int]:
    """The least numbers of rows and columns with a multiple of 8 entries: sums over them then have no remainder."""
    more_rows = -(-rows // 8) * 8, columns
    least = 8 // math.gcd(rows, 8)
    more_columns = rows, -(-columns // least) * least
    return min(more_rows, more_columns, key=math.prod)


@kernel
def _flow_through(
    stepper: Stepper, orbit: Stepper, interval: float, states: np.ndarray, events: np.ndarray, so_far: np.ndarray
) -> int:
    """Advance by the ``interval`` in s as often as there are ``states`` (count, 2n), which are those of the orbit.

    The flow goes on from ``so_far`` (1,) of dtype ``PROGRESS``. Returns the outcome of the last interval, or of the
    first that is not covered.
    """
    progress = so_far[0]
    outcome = DONE
    while progress.interval < states.shape[0]:
        outcome = _flow(stepper, orbit, interval, events, progress)
        if outcome != DONE:
            break
        for i in range(states.shape[1]):
            states[progress.interval, i] = stepper.start[i, 0]
        progress.interval += 1
        progress.has_begun = 0
    return outcome


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

    def _advance(self, y: np.ndarray, duration: float, period: float) -> Advance:
        # The flow takes a step for each radian at least.
        self.limits.refuse(self.omega_ref(period) * duration)
        state = self._stepper.start[: len(y), : self._columns]
        state[:] = y
        progress = self._flow_through(self._stepper, duration, self._end, period)
        events = self._events[: progress["changes"]].copy()
        return Advance(state=state, events=events, closed=float(progress["closed"]), steps=int(progress["steps"]))

    def states(self, start: np.ndarray, interval: float, count: int, period: float) -> np.ndarray:
        """The states that ``Flow.states`` describes, computed without variations."""
        states = np.empty((1 + count, 2 * self.system.dofs))
        states[0] = start
        self._alone.start[: states.shape[1], 0] = start
        self._flow_through(self._alone, interval, states[1:], period)
        return states

    def _flow_through(self, stepper: Stepper, interval: float, states: np.ndarray, period: float) -> np.void:
        """Advance a ``stepper`` by an ``interval`` in s for each of the ``states``, which are filled.

        Returns how far it has come, a record of dtype ``PROGRESS``. Raises FlowError if the time cannot be covered.
        """
        stepper = stepper._replace(omega_ref=self.omega_ref(period))
        # Contacts that are closed in a step are so for both.
        orbit = self._orbit._replace(step=stepper.step)
        progress = np.zeros(1, PROGRESS)
        outcome = PAUSED
        while outcome == PAUSED:
            progress["pause"] = self.limits.check(int(progress["steps"][0]))
            outcome = _flow_through(stepper, orbit, interval, states, self._events, progress)
        self.limits.check(int(progress["steps"][0]))
        if outcome != DONE:
            why = {STUCK: "the step became too small", FULL: f"more than {MOST_CHANGES} contact changes"}
            count = progress["changes"][0]
            raise FlowError(f"the flow stopped after {count} contact changes in {interval:.6g} s: {why[outcome]}")
        return progress[0]
