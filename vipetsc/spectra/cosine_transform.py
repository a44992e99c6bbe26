"""The cosine transform (DCT-I) of many columns, by real transforms of half the length of their even continuation.

Of samples x_0 to x_N the transform is F_m = (x_0 + (-1)^m x_N)/2 + sum of x_j cos(pi j m/N) over the j between. Let

    y_j = (x_j + x_(N-j))/2 - sin(pi j/N) (x_j - x_(N-j)),  0 <= j < N.

The first term is even about N/2 and has a real transform, the second is odd and has an imaginary one:

    sum of y_j e^(-2 pi i j k/N) over all j = F_(2k) + i (F_(2k-1) - F_(2k+1)),

so that the odd F follow one from another, from F_1 on, which is summed. Their rounding grows as the square root of N
(Press et al., Numerical Recipes, 3rd ed., 12.4.2).
"""

from functools import lru_cache

import numpy as np
from scipy import fft

from vipetsc.compiled import kernel


def cosine_transform(columns: np.ndarray) -> np.ndarray:
    """``scipy.fft.dct(columns, type=1, axis=0)`` of two rows or more (t, column): twice the F of each column."""
    last = len(columns) - 1
    count = columns.shape[1]
    waves = _half_waves(last)
    combined = np.empty((last, count))
    out = np.zeros((last + 1, count))
    _combine(columns, waves, combined, out)
    _separate(fft.rfft(combined, axis=0, overwrite_x=True).view(float), out)
    return out


@lru_cache(maxsize=32)
def _half_waves(last: int) -> np.ndarray:
    """Cosine and sine (2, j) of pi j/``last``, for j below ``last``."""
    angle = np.pi * np.arange(last) / last
    return np.stack([np.cos(angle), np.sin(angle)])


@kernel
def _combine(columns: np.ndarray, waves: np.ndarray, combined: np.ndarray, out: np.ndarray) -> None:
    """Fill ``combined`` (j, column) with twice y, and row 1 of ``out``, of zeros, with twice F_1."""
    last = columns.shape[0] - 1
    for c in range(columns.shape[1]):
        out[1, c] = columns[0, c] - columns[last, c]
        combined[0, c] = columns[0, c] + columns[last, c]
    for j in range(1, last):
        cosine = 2.0 * waves[0, j]
        sine = 2.0 * waves[1, j]
        for c in range(columns.shape[1]):
            here = columns[j, c]
            mirrored = columns[last - j, c]
            out[1, c] += cosine * here
            combined[j, c] = (here + mirrored) - sine * (here - mirrored)


@kernel
def _separate(pairs: np.ndarray, out: np.ndarray) -> None:
    """Fill ``out`` from the transform of 2 y, real and imaginary parts in turn along the rows of ``pairs``."""
    last = out.shape[0] - 1
    for k in range(pairs.shape[0]):
        for c in range(out.shape[1]):
            out[2 * k, c] = pairs[k, 2 * c]
        if k > 0 and 2 * k < last:
            for c in range(out.shape[1]):
                out[2 * k + 1, c] = out[2 * k - 1, c] - pairs[k, 2 * c + 1]
