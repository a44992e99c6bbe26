"""Taylor series of free motion in compiled code: their values, their shift, the first onset of contact (sec. 2).

A series has its coefficients by rising powers of s = (t - t_0)/H; ``series`` says how many of them count.
"""

from typing import Any

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.contact.law import gap_of

# Lengths below this fraction of the step are rounding: positions in a step are numbers from 0 to 1 with a rounding of
# 1e-16, and a length is the difference of two that are sums of several.
ROUNDING = 1e-15


@kernel
def copy(source: np.ndarray, target: np.ndarray) -> None:
    """Fill all rows of ``target`` (row, column) with the first ones of ``source``."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@kernel
def shift(taylor: np.ndarray, s: float, out: np.ndarray) -> None:
    """Expand series ``taylor`` (dof, coefficient) about ``s`` instead of 0, into ``out``, which may be ``taylor``."""
    dofs, coefficients = taylor.shape
    copy(taylor, out[:dofs])
    # Horner's scheme, a + x q(x) for each coefficient a from the last but one down, with the q so far by powers of
    # (x - s): as x = s + (x - s), each coefficient is the one before it in q (at first a) plus s times its own in q.
    for j in range(dofs):
        for k in range(coefficients - 2, -1, -1):
            before = out[j, k]
            for i in range(k, coefficients - 1):
                after = out[j, i + 1]
                out[j, i] = before + s * after
                before = after


@kernel
def evaluate(series: np.ndarray, s: float) -> tuple[float, float]:
    """Return the value and slope at ``s`` of a ``series`` (coefficient,) by rising powers of s, by Horner's scheme."""
    value = 0.0
    slope = 0.0
    for k in range(series.size - 1, -1, -1):
        slope = slope * s + value
        value = value * s + series[k]
    return value, slope


@kernel
def curvature(series: np.ndarray, s: float) -> float:
    """Return second derivative at ``s`` of a ``series`` (coefficient,) by rising powers of s."""
    value = 0.0
    for k in range(series.size - 1, 1, -1):
        value = value * s + k * (k - 1) * series[k]
    return value


@kernel
def _onset_on_side(series: np.ndarray, site: Any, side: int, change: float, curvature: float, length: float) -> float:
    """Return the first s in [0, length] at which w is on the clearance of one ``side`` and grows; 2 if there is none.

    ``change`` in m bounds how far w goes from its start over the length. ``curvature`` bounds |w''| there, so that a
    parabola bounds w towards this side: up to where that meets the clearance nothing can have happened.
    """
    tolerance = site.tolerance
    clearance = gap_of(site, side)
    # No stop on this side.
    if clearance == np.inf:
        return 2.0
    # What stays within the tolerance strikes no rigid stop (``contact.changes.first_change``).
    if site.rigid and abs(side * series[0] - clearance) + change <= tolerance:
        return 2.0

    s = 0.0
    while s <= length:
        w, rate = evaluate(series, s)
        gap = clearance - side * w
        closing = side * rate
        if gap < 0.5 * tolerance and closing > 0.0:
            # A Newton step, where the curvature changes it by less than the tolerance.
            newton = gap / closing
            if curvature * newton * newton < tolerance:
                s = max(s + newton, 0.0)
            return s

        # The root of curvature/2 d^2 + closing d = gap, without cancellation. The gap is taken larger by the
        # tolerance: so far beyond the clearance an onset is still met. Without curvature a site that does not close
        # never meets it: the step is then infinite, or NaN if the site rests, and both end the loop.
        gap += tolerance
        root = np.sqrt(max(closing * closing + 2.0 * curvature * gap, 0.0))
        if closing > 0.0:
            step = 2.0 * gap / (closing + root)
        else:
            step = (root - closing) / curvature
        s += max(step, ROUNDING)
    return 2.0


@kernel
def first_onset(series: np.ndarray, site: Any, length: float) -> float:
    """Return the first s in [0, length] at which w comes to a clearance of the ``site``, to rounding; 2 for none.

    ``series`` (coefficient,) in m is w by powers of s in units of the step, whose length is 1: 2 is beyond any s.
    """
    # On 0 <= s <= length the sum of |a_k| length^k bounds |w|, that of k (k - 1) |a_k| length^(k-2) bounds |w''|.
    bound = 0.0
    curvature = 0.0
    scale = 1.0
    for k in range(series.size):
        bound += abs(series[k]) * scale
        if k >= 2:
            curvature += k * (k - 1) * abs(series[k]) * scale / (length * length)
        scale *= length

    # Most sites keep away from both clearances: no search.
    tolerance = site.tolerance
    if bound < min(site.clearance, site.clearance_minus) - tolerance:
        return 2.0

    plus = _onset_on_side(series, site, 1, bound - abs(series[0]), curvature, length)
    minus = _onset_on_side(series, site, -1, bound - abs(series[0]), curvature, length)
    return min(plus, minus)
