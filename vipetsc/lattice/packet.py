"""The wave packet that a tone burst makes in an infinite lattice: its band and how fast its parts travel."""

from functools import lru_cache

import numpy as np

from vipetsc.lattice.bands import bloch
from vipetsc.lattice.cell import UnitCell
from vipetsc.lattice.chain import ToneBurst

WAVENUMBERS = np.linspace(0, np.pi, 8001)[1:-1]


@lru_cache
def packet_speeds(cell: UnitCell, burst: ToneBurst, mass: int, beyond: float = 1e-3) -> tuple[int, float, float]:
    """Band (from 0) that takes most of the energy, and the speeds in cells/s of its slow and of its fast waves.

    A force F on one ``mass`` (0-based) gives the Bloch wave of frequency w and mass-normalised vector u an energy in
    proportion to |F^(w)|^2 |u_mass|^2; all but a share ``beyond`` of the band's is faster than the slow speed, all but
    such a share slower than the fast one.
    """
    point = bloch(cell, WAVENUMBERS)
    weights = np.abs(burst.spectrum(point.frequency) * point.vectors[:, mass]) ** 2
    band = int(np.argmax(weights.sum(axis=0)))
    speed, weight = np.abs(point.group_velocity[:, band]), weights[:, band]
    order = np.argsort(speed)
    slow, fast = np.interp([beyond, 1 - beyond], np.cumsum(weight[order]) / weight.sum(), speed[order])
    return band, float(slow), float(fast)
