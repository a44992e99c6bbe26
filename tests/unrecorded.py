"""Samples that an engine of linear steps passes without storing any."""

import numpy as np

from vipetsc.dynamics.energies import ENERGY_SUMS
from vipetsc.dynamics.lattice_record import LatticeRecord
from vipetsc.dynamics.samples import Samples


def unrecorded_samples(lattice: LatticeRecord, goal: int) -> Samples:
    """Samples with which ``Propagator.fill`` advances to the sample ``goal``, counted from 0, and stores none.

    ``lattice`` is that of the engine. With room for k samples from ``number`` on, the engine goes to the sample
    number + k - 1. Here all arrays are empty, k = 0, and ``number`` is goal + 1. What describes samples (``every``,
    ``unit``, ``interval`` and so on) is never read.
    """
    return Samples(
        number=goal + 1,
        sums=np.zeros((0, ENERGY_SUMS, 2), np.int64),
        work=np.zeros((0, 0)),
        losses=np.zeros((0, 0)),
        fields=np.zeros((0, 0, 0, 0)),
        moving=np.zeros(0, np.int64),
        first_cell=0,
        every=1,
        stride=1,
        lattice=lattice,
        unit=1.0,
        interval=1.0,
        forces=np.zeros((0, 0)),
        motion=np.zeros((0, 0, 0)),
        watched=np.zeros((0, 2), np.int64),
        pushes=np.zeros((0, 3), np.int64),
    )
