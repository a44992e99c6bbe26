"""Envelopes over a run of signals about a frequency, and their spectra."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vipetsc.studies.response import DECAY


@dataclass(frozen=True)
class SpectralLine:
    """Frequencies within ``half`` rad/s of the middle of a line; ``length`` in s is twice that of the run.

    The second half of the time is padding for what the transform would fold back.
    """

    half: float
    length: float

    @cached_property
    def most(self) -> int:
        """Number of frequencies above the middle, which is the same below."""
        return int(np.ceil(self.half * self.length / (2 * np.pi)))

    @cached_property
    def offset(self) -> np.ndarray:
        """The frequencies (offset,) in rad/s, relative to the middle."""
        return 2 * np.pi * np.arange(-self.most, self.most + 1) / self.length

    @cached_property
    def time(self) -> np.ndarray:
        """The instants (time,) in s of envelopes."""
        return np.arange(len(self.offset)) * self.length / len(self.offset)

    @property
    def decay(self) -> float:
        """Rate in 1/s of the envelopes' decay: less the imaginary part of all frequencies."""
        return DECAY / self.length

    def forward(self, a: np.ndarray) -> np.ndarray:
        """Spectrum (..., offset) of an envelope (..., time)."""
        return np.asarray(np.fft.fftshift(np.fft.fft(a * np.exp(-self.decay * self.time)), axes=-1))

    def backward(self, spectrum: np.ndarray) -> np.ndarray:
        """Envelope (..., time) of a spectrum (..., offset)."""
        return np.asarray(np.fft.ifft(np.fft.ifftshift(spectrum, axes=-1)) * np.exp(self.decay * self.time))
