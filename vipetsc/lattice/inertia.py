"""Number of eigenvalues of a symmetric band matrix below a bound, by Sylvester's law of inertia.

A - s = L D L^T has as many negative pivots in D as A has eigenvalues below s (Parlett, The Symmetric Eigenvalue
Problem, 1998, section 3.3), at a cost that grows as the rows.
"""

import sys
from collections.abc import Callable
from functools import cache

import numpy as np

# Rows times squared width up to which Python is sooner done with 50 counts (0.2 s) than numba is loaded (0.5 s).
FEW = 20_000


def count_below(band: np.ndarray, shift: float, smallest: float) -> int:
    """Return the number of eigenvalues below ``shift``, as ``_count`` does; the result is the same to the bit."""
    rows, width = band.shape
    if rows * width**2 <= FEW and "numba" not in sys.modules:
        return _count(band, shift, smallest)
    return _compiled()(band, shift, smallest)


@cache
def _compiled() -> Callable[[np.ndarray, float, float], int]:
    """Return ``_count``, compiled."""
    from vipetsc.compiled import kernel

    compiled: Callable[[np.ndarray, float, float], int] = kernel(_count)
    return compiled


def _count(band: np.ndarray, shift: float, smallest: float) -> int:
    """Return the number of eigenvalues below ``shift``; ``band`` (n, width + 1), A[j + k, j] at [j, k], is overwritten.

    A pivot smaller than ``smallest`` is taken for minus that.
    """
    n = band.shape[0]
    count = 0
    for j in range(n):
        pivot = band[j, 0] - shift
        width = min(band.shape[1], n - j)
        # Without an exchange of rows a pivot may vanish: moved by less than rounding, the count stays right.
        if abs(pivot) < smallest:
            pivot = -smallest
        count += pivot < 0.0
        for i in range(1, width):
            factor = band[j, i] / pivot
            for k in range(i, width):
                band[j + i, k - i] -= factor * band[j, k]
    return count
