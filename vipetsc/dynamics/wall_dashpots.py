"""What the dashpots to moving walls would dissipate if their masses stood still: the integral of c U'^2.

The work of a wall through a dashpot is the integral of c (U' - v) U'. An engine integrates c U' v, as of any force; the
rest follows from the wall's motion alone.
"""

import numpy as np
from numpy.polynomial.legendre import leggauss

from vipetsc.case import Model
from vipetsc.lattice import Waveform

# Of Gauss's quadrature between two samples or breaks. A sample interval resolves the lattice's highest frequency: the
# square of a sine of that frequency is integrated to rounding.
NODES, WEIGHTS = leggauss(12)


class WallDashpots:
    """The integrals of a ``model``, sample after sample: those of any block have the same bits."""

    def __init__(self, model: Model) -> None:
        self._interval = model.sample_interval
        self._waveforms = [(i, drive.damping, drive.waveform) for i, drive in enumerate(model.drives) if drive.damping]
        # The first sample of the last block, and the integrals up to it.
        self._number = 0
        self._spent = np.zeros(len(model.drives))

    def spent(self, number: int, count: int) -> np.ndarray:
        """Return the integrals (sample, drive) in J from t = 0 to ``count`` samples from ``number`` on."""
        spent = np.zeros((count, len(self._spent)))
        if not self._waveforms or not count:
            return spent
        # A run that is repeated from a checkpoint before that.
        if number < self._number:
            self._number = 0
            self._spent[:] = 0.0

        before = number - self._number
        times = self._interval * np.arange(self._number, number + count)
        for i, damping, waveform in self._waveforms:
            sums = np.cumsum([self._spent[i], *_integrals(damping, waveform, times)])
            spent[:, i] = sums[before:]
            self._spent[i] = sums[before]
        self._number = number
        return spent


def _integrals(damping: float, waveform: Waveform, times: np.ndarray) -> np.ndarray:
    """Return the integrals (interval,) in J between each two of the ``times`` (interval + 1,) in s."""
    breaks = waveform.breaks
    ends = np.union1d(times, breaks[(breaks > times[0]) & (breaks < times[-1])])
    if len(ends) < 2:
        return np.zeros(0)
    half = np.diff(ends)[:, None] / 2
    rate = waveform.rate(ends[:-1, None] + half * (1 + NODES))
    parts = damping * (half * WEIGHTS * rate**2).sum(axis=1)
    return np.asarray(np.add.reduceat(parts, np.searchsorted(ends, times[:-1])))
