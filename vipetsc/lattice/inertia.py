"""Number of eigenvalues of a symmetric band matrix below a bound, by Sylvester's law of inertia.

A - s = L D L^T has as many negative pivots in D as A has eigenvalues below s (Parlett, The Symmetric Eigenvalue
Problem, 1998, section 3.3), at a cost that grows as the rows.
"""

import numpy as np

from vipetsc.compiled import kernel


@kernel
def count_below(band: np.ndarray, shift: float, smallest: float) -> int:
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
