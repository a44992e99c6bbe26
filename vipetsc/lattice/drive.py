"""The drive: a windowed tone burst on one mass, Eq. (3) of the paper."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

Envelope = Literal["paper", "hann"]


@dataclass(frozen=True)
class ToneBurst:
    """F(t) = A [1 - cos(Om t/Nc)] sin(Om t) for 0 < t < 2 pi Nc/Om.

    ``amplitude`` A in N, ``frequency`` Om in rad/s, ``cycles`` Nc. The paper's envelope peaks at 2A; the
    authors' code has a factor 1/2 before it, here ``envelope = "hann"``.
    """

    amplitude: float
    frequency: float
    cycles: int
    envelope: Envelope = "paper"

    @property
    def duration(self) -> float:
        """Length of the burst in s."""
        return 2 * np.pi * self.cycles / self.frequency

    @property
    def window_amplitude(self) -> float:
        """The factor in N before 1 - cos."""
        return self.amplitude if self.envelope == "paper" else self.amplitude / 2

    def force(self, t: ArrayLike) -> np.ndarray:
        """Force in N at time t in s."""
        t = np.asarray(t, float)
        phase = self.frequency * t
        burst = self.window_amplitude * (1 - np.cos(phase / self.cycles)) * np.sin(phase)
        return np.where((t > 0) & (t < self.duration), burst, 0.0)
