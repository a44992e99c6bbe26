"""Envelopes of signals about a frequency over the time of a run, and the spectra of these envelopes."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vipetsc.studies.response import DECAY


@dataclass(frozen=True)
class SpectralLine:
    """A grid of the frequencies within ``half`` rad/s of a middle, and of the instants of envelopes about it.

    A signal about the frequency middle in rad/s is Re a exp(i middle t) with the envelope a. ``length`` in s is twice
    the time of the run: in its second half responses die away that the transform, which is periodic, would otherwise
    fold back into the run.
    """

    half: float
    length: float

    @cached_property
    def most(self) -> int:
        """Number of frequencies above the middle, and of those below it."""
        return int(np.ceil(self.half * self.length / (2 * np.pi)))

    @cached_property
    def offset(self) -> np.ndarray:
        """The frequencies (offset,) in rad/s, relative to the middle."""
        return 2 * np.pi * np.arange(-self.most, self.most + 1) / self.length

    @cached_property
    def time(self) -> np.ndarray:
        """The instants (time,) in s of envelopes, as many as there are frequencies."""
        return np.arange(len(self.offset)) * self.length / len(self.offset)

    @property
    def decay(self) -> float:
        """Rate in 1/s of the window exp(-decay t) of envelopes: spectra are at the frequencies offset - i decay."""
        return DECAY / self.length

    def forward(self, a: np.ndarray) -> np.ndarray:
        """Return the spectrum (..., offset) of an envelope ``a`` (..., time): a sum, without the step in s."""
        return np.asarray(np.fft.fftshift(np.fft.fft(a * np.exp(-self.decay * self.time)), axes=-1))

    def backward(self, spectrum: np.ndarray) -> np.ndarray:
        """Return the envelope (..., time) of a spectrum (..., offset)."""
        return np.asarray(np.fft.ifft(np.fft.ifftshift(spectrum, axes=-1)) * np.exp(self.decay * self.time))
