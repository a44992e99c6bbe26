"""Squares of sums of cosines of neighbouring frequencies, as functions of time, from as few values as determine them.

The sum v of a_k cos((l + k) theta) over k from 0 to W, with theta = pi t/T in a record of length T, is the real part of
exp(i l theta) g, with g the sum of a_k exp(i k theta). Hence

    v^2 = |g|^2 / 2 + Re[exp(2 i l theta) g^2] / 2,

where |g|^2 has the frequencies from -W to W, and g^2 those from 0 to 2 W. Both are determined by the values of g at
2 W + 1 or more even points of the circle, whatever l is. One real transform of that length gives these values: the a_k
are real, so that half of the values are conjugates of the others. |g|^2 and g^2 are summed over all signals at these
points; transformed back once, the sums are the amplitudes of the cosines of which the sum of all v^2 consists.
"""

from typing import NamedTuple, Self

import numpy as np
from scipy import fft


class Cosines(NamedTuple):
    """A sum of cosines with ``wave`` (wave,) half waves in the record, each with its ``amplitude`` (wave, ...).

    A number of half waves may occur twice.
    """

    wave: np.ndarray
    amplitude: np.ndarray


class CosineSquares(NamedTuple):
    """Weighted sums of squares of signals whose cosines have ``low`` to ``high`` half waves in the record.

    ``square`` and ``product`` (point, column) are the sums of |g|^2 and of g^2, g as in the module's docstring, at the
    first half of ``length`` points of the circle. There is one column for all signals, or one for each. With high < low
    there is no cosine, and the sums are those of nothing.
    """

    low: int
    high: int
    length: int
    square: np.ndarray
    product: np.ndarray

    @classmethod
    def zeros(cls, low: int, high: int, columns: int = 1) -> Self:
        """Return the sums of no signals."""
        length = fft.next_fast_len(max(2 * (high - low) + 1, 1), real=True)
        shape = (length // 2 + 1, columns)
        return cls(low, high, length, np.zeros(shape), np.zeros(shape, complex))

    def of_columns(self, columns: int) -> Self:
        """Return the sums of no signals, of the same cosines, in so many ``columns``."""
        return self.zeros(self.low, self.high, columns)

    def add(self, spectrum: np.ndarray, weight: float) -> None:
        """Add the squares of signals ``spectrum`` (wave from 0, signal), ``weight`` times, to one column."""
        signals = self._signals(spectrum)
        parts = signals.view(float)
        self.square[:, 0] += weight * np.einsum("pn,pn->p", parts, parts)
        self.product[:, 0] += weight * np.einsum("pn,pn->p", signals, signals)

    def add_to_columns(self, spectrum: np.ndarray, weight: float, columns: slice) -> None:
        """Add the squares of signals (wave, signal) as ``add`` does, of each to its own of the ``columns``."""
        signals = self._signals(spectrum)
        self.square[:, columns] += weight * (signals.real**2 + signals.imag**2)
        self.product[:, columns] += weight * signals**2

    def add_columns_of(self, other: Self) -> None:
        """Add all columns of ``other`` to the one of these sums."""
        self.square[:, 0] += other.square.sum(axis=1)
        self.product[:, 0] += other.product.sum(axis=1)

    def _signals(self, spectrum: np.ndarray) -> np.ndarray:
        """Return the g (point, signal) of signals."""
        return fft.rfft(spectrum[self.low : self.high + 1], self.length, axis=0)

    def cosines(self) -> Cosines:
        """Return the cosines (wave, column) of the sums."""
        width = self.high - self.low
        # Of |g|^2/2 = c_0/2 + sum of c_n cos(n theta) the c_n are real, and c_-n = c_n: only c_0 is halved.
        of_squares = fft.irfft(self.square, self.length, axis=0)[: width + 1]
        of_squares[:1] *= 0.5
        of_products = fft.irfft(self.product, self.length, axis=0)[: max(2 * width + 1, 0)]

        wave = np.concatenate([np.arange(len(of_squares)), 2 * self.low + np.arange(len(of_products))])
        return Cosines(wave, np.concatenate([of_squares, 0.5 * of_products]))
