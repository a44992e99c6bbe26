"""The cosine transform (DCT-I) of many columns, by complex transforms of half the length of their even continuation.

Of samples x_0 to x_N the transform is F_m = (x_0 + (-1)^m x_N)/2 + sum of x_j cos(pi j m/N) over the j between. Let

    y_j = (x_j + x_(N-j))/2 - sin(pi j/N) (x_j - x_(N-j)),  0 <= j < N.

The first term is even about N/2 and has a real transform, the second is odd and has an imaginary one:

    sum of y_j e^(-2 pi i j k/N) over all j = F_(2k) + i (F_(2k-1) - F_(2k+1)),

so that each odd F follows from the one before; F_1 is summed. Their rounding grows as the square root of N (Press et
al., Numerical Recipes, 3rd ed., 12.4.2).

The y of two columns are the real and imaginary parts of one complex column with the transform Z; their transforms are
(Z_k + conj Z_(N-k))/2 and (Z_k - conj Z_(N-k))/2i. That takes as long as a real transform of each where N has small
factors alone, and half as long where it has a large one: such a transform is a convolution of complex numbers, even if
its column is real (Bluestein 1970, IEEE Trans. Audio Electroacoust. 18, 451).
"""

from functools import lru_cache

import numpy as np
from scipy import fft

from vipetsc.compiled import kernel


class CosineTransform:
    """The transform of records of ``rows`` samples, two or more, up to ``most`` of them at a time.

    It works in memory of its own, which takes less time than new memory for each call.
    """

    def __init__(self, rows: int, most: int) -> None:
        self._waves = _half_waves(rows - 1)
        shape = rows, most + most % 2
        # The kernels get whole arrays alone, which are contiguous: for arrays of another layout they would be compiled
        # once more.
        self._columns = np.zeros(shape)
        self._combined = np.zeros((rows - 1, shape[1]))
        self._out = np.zeros(shape)

    def __call__(self, columns: np.ndarray) -> np.ndarray:
        """Return ``scipy.fft.dct(columns, type=1, axis=0)`` of ``columns`` (t, column): twice the F of each column.

        The array that is returned is filled anew by the next call.
        """
        count = columns.shape[1]
        width = count + count % 2
        self._columns[:, :count] = columns
        # An odd number of columns has one of zeros as the partner of its last one.
        self._columns[:, count:width] = 0.0

        _combine(self._columns, self._waves, width, self._combined, self._out)
        used = self._combined[:, :width].view(complex)
        used[:] = fft.fft(used, axis=0, overwrite_x=True)
        _separate(self._combined, width, self._out)
        return self._out[:, :count]


@lru_cache(maxsize=32)
def _half_waves(last: int) -> np.ndarray:
    """Return cosine and sine (2, j) of pi j/``last``, for j below ``last``."""
    angle = np.pi * np.arange(last) / last
    return np.stack([np.cos(angle), np.sin(angle)])


@kernel
def _combine(columns: np.ndarray, waves: np.ndarray, width: int, combined: np.ndarray, out: np.ndarray) -> None:
    """Fill ``width`` columns of ``combined`` (j, column) with the y of ``columns`` (t, column).

    Row 1 of ``out`` (m, column) gets twice F_1. ``waves`` (2, j) are those of ``_half_waves``.
    """
    last = columns.shape[0] - 1
    for c in range(width):
        out[1, c] = columns[0, c] - columns[last, c]
        combined[0, c] = 0.5 * (columns[0, c] + columns[last, c])
    for j in range(1, last):
        cosine = 2.0 * waves[0, j]
        sine = waves[1, j]
        for c in range(width):
            here = columns[j, c]
            mirrored = columns[last - j, c]
            out[1, c] += cosine * here
            combined[j, c] = 0.5 * (here + mirrored) - sine * (here - mirrored)


@kernel
def _separate(transformed: np.ndarray, width: int, out: np.ndarray) -> None:
    """Fill ``width`` columns of ``out`` (m, column), whose row 1 is there, from the transform Z of pairs of columns.

    ``transformed`` (k, column) has the real and the imaginary part of the Z of a pair in its two columns.
    """
    last = out.shape[0] - 1
    for k in range(last // 2 + 1):
        opposite = (last - k) % last
        for c in range(width):
            out[2 * k, c] = transformed[k, c] + transformed[opposite, c]
        if k > 0 and 2 * k < last:
            # The imaginary parts of the transforms of y: of the first column (Im Z_k - Im Z_(N-k))/2, of the second
            # one (Re Z_(N-k) - Re Z_k)/2.
            for c in range(0, width, 2):
                out[2 * k + 1, c] = out[2 * k - 1, c] - (transformed[k, c + 1] - transformed[opposite, c + 1])
                out[2 * k + 1, c + 1] = out[2 * k - 1, c + 1] + (transformed[k, c] - transformed[opposite, c])
