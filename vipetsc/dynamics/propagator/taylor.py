"""Taylor series in s = t/H: shifting, evaluation, and the guaranteed search for the first onset.

Sec. 2 of the derivation in the package's docstring.
"""

from __future__ import annotations

import numpy as np

from vipetsc.compiled import njit
from vipetsc.contact.changes import LANDED_W

# Shares of a step below this are rounding.
ROUNDING = 1e-15


@njit(error_model="numpy")
def shift(taylor: np.ndarray, s: float, out: np.ndarray) -> None:
    """Series ``taylor`` (dof, coefficient) expanded about ``s`` instead of 0 into ``out``, which may be ``taylor``."""
    # Coefficient by coefficient, so that the innermost loop runs over contiguous DoFs.
    series = np.ascontiguousarray(taylor.T)
    last, dofs = series.shape[0] - 1, series.shape[1]
    for k in range(last):
        for i in range(last - 1, k - 1, -1):
            for j in range(dofs):
                series[i, j] += s * series[i + 1, j]
    out[:] = series.T


@njit(error_model="numpy")
def evaluate(series: np.ndarray, s: float) -> tuple[float, float]:
    """Value and slope of a ``series`` at ``s``, by Horner's scheme."""
    value = slope = 0.0
    for k in range(series.size - 1, -1, -1):
        slope = slope * s + value
        value = value * s + series[k]
    return value, slope


@njit(error_model="numpy")
def first_onset(series: np.ndarray, clearance: float, length: float) -> float:
    """First s in [0, length] at which |w| comes within rounding of the clearance and grows; 2 if none does.

    |w''| has a bound over the whole length, so that a parabola bounds |w| from above: up to where that meets the
    clearance nothing can have happened.
    """
    bound = curvature = 0.0
    scale = 1.0
    for k in range(series.size):
        bound += abs(series[k]) * scale
        if k >= 2:
            curvature += k * (k - 1) * abs(series[k]) * scale / (length * length)
        scale *= length
    tolerance = LANDED_W * clearance
    if bound < clearance - tolerance:
        return 2.0
    first = 2.0
    for side in (1.0, -1.0):
        s = 0.0
        while s <= length:
            w, rate = evaluate(series, s)
            gap, closing = clearance - side * w, side * rate
            if gap < 0.5 * tolerance and closing > 0.0:
                newton = gap / closing
                first = min(first, max(s + newton, 0.0) if curvature * newton * newton < tolerance else s)
                break
            gap += tolerance
            root = np.sqrt(max(closing * closing + 2.0 * curvature * gap, 0.0))
            # The root of curvature/2 d^2 + closing d = gap, without cancellation.
            step = 2.0 * gap / (closing + root) if closing > 0.0 else (root - closing) / curvature
            s += max(step, ROUNDING)
    return first
