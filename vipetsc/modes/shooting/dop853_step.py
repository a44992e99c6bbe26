"""Steps of DOP853, Dormand and Prince's pair of order 8(5,3), for an orbit and its variations together.

Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, 2nd ed. 1993, sec. II.5 and II.10, and the
authors' code DOP853. Stage s is y + h sum_r A[s, r] k_r, the new state y + h sum_r B[r] k_r; E5 and E3 give the
estimates of orders 5 and 3, which II.10 combines into err5^2 / sqrt(err5^2 + err3^2 / 100).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.modes.shooting import flow

# Errors allowed per step, relative to the size of the orbit and of each variation.
RTOL = 1e-13
RTOL_SENSITIVITY = 1e-11
STAGES = 12
_TABLEAU = np.loadtxt(Path(__file__).with_name("dop853.csv"), delimiter=",")
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
    columns are padded with zeros (``dop853``). Sums over stages are done on ``flat``: stages, errors, start and end
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
def advance(stepper: Stepper, h: float) -> None:
    """One step of length ``h`` from the start, whose rates are the first stage."""
    step = stepper.step
    for s in range(1, STAGES):
        _combine(stepper, A[s], h)
        flow.rates(step.system, step.side, stepper.end, stepper.stages[s])
    _combine(stepper, B, h)


@kernel
def tried(stepper: Stepper, h: float) -> float:
    """Make a step of length ``h``, and return its scaled error."""
    advance(stepper, h)
    return _scaled_error(stepper, h)


@kernel
def shortened(h: float, error: float) -> float:
    """The length to try after a step of length ``h`` whose scaled ``error`` is not below 1."""
    # A number that has overflowed says nothing of the next length.
    if not error < 1e300:
        return h * 0.1
    return h * max(LEAST_FACTOR, SAFETY * error ** (-0.125))


@kernel
def grown(h: float, error: float, largest: float) -> float:
    """The length of the next step, at most ``largest``, after one of length ``h`` whose scaled ``error`` is below 1."""
    return min(largest, h * min(MOST_FACTOR, SAFETY * max(error, SMALLEST_ERROR) ** (-0.125)))
