"""The compiled flow: DOP853, Dormand and Prince's pair of order 8(5,3), landing on every contact change.

Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, 2nd ed. 1993, sec. II.5 and II.10, and the
authors' code DOP853. Stage s is y + h sum_r A[s, r] k_r, the new state y + h sum_r B[r] k_r; E5 and E3 give the
estimates of orders 5 and 3, which II.10 combines into err5^2 / sqrt(err5^2 + err3^2 / 100).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from vipetsc.compiled import njit
from vipetsc.modes import flow
from vipetsc.modes.changes import EXTREMUM, MOST_ATTEMPTS, NONE, Change, correct
from vipetsc.modes.flow import Flow, FlowError

# Outcomes of a flow: the time is covered; a step is too small; there are more changes than can be listed.
DONE, STUCK, FULL = range(3)
# Errors allowed per step, relative to the size of the orbit and of each variation.
RTOL, RTOL_SENSITIVITY = 1e-13, 1e-11
# Contact changes of one arc beyond which a flow gives up.
MOST_CHANGES = 2000
STAGES = 12
_TABLEAU = np.loadtxt(Path(__file__).with_suffix(".csv"), delimiter=",")
A, (B, E3, E5) = _TABLEAU[:STAGES], _TABLEAU[STAGES:]


class Stepper(NamedTuple):
    """What a step reads and writes: rates at its ``stages`` (STAGES, 2n, 1 + m), state and rates at its end.

    Velocities count as displacements over a radian of ``omega_ref`` (rad/s), and a step is at most one radian.
    """

    step: flow.Step
    omega_ref: float
    stages: np.ndarray
    end: np.ndarray
    end_rates: np.ndarray


@njit
def _scaled_error(stepper: Stepper, y: np.ndarray, h: float) -> float:
    """The new state from the stages, and the largest error of a column over what is allowed."""
    k, out = stepper.stages, stepper.end
    size, columns = y.shape
    error = 0.0
    for j in range(columns):
        fifth, third, scale = 0.0, 0.0, 0.0
        for i in range(size):
            total, e5, e3 = 0.0, 0.0, 0.0
            for r in range(STAGES):
                total += B[r] * k[r, i, j]
                e5 += E5[r] * k[r, i, j]
                e3 += E3[r] * k[r, i, j]
            out[i, j] = y[i, j] + h * total
            unit = 1.0 if i < size // 2 else 1.0 / stepper.omega_ref
            fifth = max(fifth, abs(e5) * unit)
            third = max(third, abs(e3) * unit)
            scale = max(scale, abs(out[i, j]) * unit, abs(y[i, j]) * unit)
        if fifth > 0.0:
            allowed = (RTOL if j == 0 else RTOL_SENSITIVITY) * scale
            error = max(error, h * fifth * fifth / np.sqrt(fifth * fifth + 0.01 * third * third) / allowed)
    return error


@njit
def _advance(stepper: Stepper, y: np.ndarray, h: float) -> float:
    """One step of length ``h`` from ``y``, whose rates are the first stage; returns the scaled error."""
    step, k, out = stepper.step, stepper.stages, stepper.end
    size, columns = y.shape
    for s in range(1, STAGES):
        for i in range(size):
            for j in range(columns):
                total = 0.0
                for r in range(s):
                    total += A[s, r] * k[r, i, j]
                out[i, j] = y[i, j] + h * total
        flow.rates(step.system, step.side, out, k[s])
    error = _scaled_error(stepper, y, h)
    flow.observe(step, out, stepper.end_rates, step.end)
    return error


@njit
def _land(stepper: Stepper, y: np.ndarray, t: float, h: float, change: Change) -> tuple[float, bool]:
    """Repeat the step of length ``h`` at time ``t`` so that it ends on a change: its length, whether it is one."""
    for _ in range(MOST_ATTEMPTS):
        length = change.length
        _advance(stepper, y, length)
        floor = 1e-15 * h if change.extremum else 1e-16 * (t + h)
        change, outcome = correct(change, stepper.step.end[change.contact], floor)
        if outcome != NONE:
            break
    return length, outcome != EXTREMUM


@njit
def _flow(stepper: Stepper, y: np.ndarray, duration: float, events: np.ndarray) -> tuple[int, int, float]:
    """Advance ``y`` (2n, 1 + m) in place over ``duration`` seconds.

    Returns the outcome (DONE, STUCK or FULL), the number of ``events`` (capacity, 4) filled with time, contact, side
    and kind (1 onset, -1 separation), and the seconds with a contact closed.
    """
    step, largest = stepper.step, 1.0 / stepper.omega_ref
    t, closed, count = 0.0, 0.0, 0
    h = min(0.1 * largest, duration)
    while t < duration:
        flow.observe(step, y, stepper.stages[0], step.start)
        last = t + h >= duration * (1.0 - 1e-15)
        if last:
            h = duration - t
        elif h < flow.SMALLEST_STEP * duration:
            return STUCK, count, closed
        error = _advance(stepper, y, h)
        if not error < 1.0:
            h *= max(0.2, 0.9 * error ** (-0.125)) if error < 1e300 else 0.1
            continue
        grown = min(largest, h * min(6.0, 0.9 * max(error, 1e-12) ** (-0.125)))
        change = flow.first_change(step, h)
        changed = change.contact >= 0
        if changed:
            h, changed = _land(stepper, y, t, h, change)
        y[:] = stepper.end
        closed += h if np.any(step.side != 0) else 0.0
        t = duration if last and change.contact < 0 else t + h
        h = grown
        if changed:
            if count >= events.shape[0]:
                return FULL, count, closed
            events[count, 0], events[count, 1] = t, change.contact
            events[count, 2], events[count, 3] = change.side, flow.switch(step, change)
            count += 1
    return DONE, count, closed


class Dop853Flow(Flow):
    """Dormand and Prince's 8(5,3) pair, landing on every contact change."""

    name = "compiled"

    def _advance(self, y: np.ndarray, duration: float, period: float) -> tuple[np.ndarray, np.ndarray, float]:
        events, stages = np.empty((MOST_CHANGES, 4)), np.empty((STAGES, *y.shape))
        step, omega = flow.begin(self.compiled, y), self.omega_ref(period)
        stepper = Stepper(step, omega, stages, np.empty_like(y), np.empty_like(y))
        outcome, count, closed = _flow(stepper, y, duration, events)
        if outcome != DONE:
            why = {STUCK: "the step became too small", FULL: f"more than {MOST_CHANGES} contact changes"}
            raise FlowError(f"the flow stopped after {count} contact changes in {duration:.6g} s: {why[outcome]}")
        return y, events[:count].copy(), closed
