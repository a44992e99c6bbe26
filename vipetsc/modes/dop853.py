"""The compiled flow: DOP853, Dormand and Prince's pair of order 8(5,3), landing on every contact change.

Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, 2nd ed. 1993, sec. II.5 and II.10, and the
authors' code DOP853. Stage s is y + h sum_r A[s, r] k_r, the new state y + h sum_r B[r] k_r; E5 and E3 give the
estimates of orders 5 and 3, which II.10 combines into err5^2 / sqrt(err5^2 + err3^2 / 100).
"""

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
# fmt: off
# Row s = 1, ..., 11: A[s, 0], then the last of A[s, 1], ..., A[s, s - 1]; those between are zero.
_ROWS = (
    (0.05260015195876773,),
    (0.0197250569845379, 0.0591751709536137),
    (0.02958758547680685, 0.08876275643042054),
    (0.2413651341592667, -0.8845494793282861, 0.924834003261792),
    (0.037037037037037035, 0.17082860872947386, 0.12546768756682242),
    (0.037109375, 0.17025221101954405, 0.06021653898045596, -0.017578125),
    (0.03709200011850479, 0.17038392571223998, 0.10726203044637328, -0.015319437748624402, 0.008273789163814023),
    (0.6241109587160757, -3.3608926294469414, -0.868219346841726, 27.59209969944671, 20.154067550477894,
     -43.48988418106996),
    (0.47766253643826434, -2.4881146199716677, -0.590290826836843, 21.230051448181193, 15.279233632882423,
     -33.28821096898486, -0.020331201708508627),
    (-0.9371424300859873, 5.186372428844064, 1.0914373489967295, -8.149787010746927, -18.52006565999696,
     22.739487099350505, 2.4936055526796523, -3.0467644718982196),
    (2.273310147516538, -10.53449546673725, -2.0008720582248625, -17.9589318631188, 27.94888452941996,
     -2.8589982771350235, -8.87285693353063, 12.360567175794303, 0.6433927460157636),
)
# Weights of stages 0 and 5, ..., 11; the others are zero.
_WEIGHTS = (0.054293734116568765, 4.450312892752409, 1.8915178993145003, -5.801203960010585, 0.3111643669578199,
            -0.1521609496625161, 0.20136540080403034, 0.04471061572777259)
_ERROR_5 = (0.01312004499419488, -1.2251564463762044, -0.4957589496572502, 1.6643771824549864, -0.35032884874997366,
            0.3341791187130175, 0.08192320648511571, -0.022355307863886294)
# The third-order method's, of stages 0, 8 and 11.
_THIRD = (0.2440944881889764, 0.7338466882816118, 0.022058823529411766)
# fmt: on
_FIRST_AND_LAST = [0, *range(5, STAGES)]
A, B, E5 = np.zeros((STAGES, STAGES)), np.zeros(STAGES), np.zeros(STAGES)
for _stage, (_first, *_last) in enumerate(_ROWS, 1):
    A[_stage, 0], A[_stage, _stage - len(_last) : _stage] = _first, _last
B[_FIRST_AND_LAST], E5[_FIRST_AND_LAST] = _WEIGHTS, _ERROR_5
E3 = B.copy()
E3[[0, 8, 11]] -= _THIRD


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
