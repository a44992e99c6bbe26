"""Motion of named points at every sample: displacement, velocity, and acceleration from the equation of motion.

The rank that owns a point's cell samples it (``dynamics.equation``), since it knows the neighbours of its cells at each
sample; rank 0 gathers the samples.
"""

import numpy as np

from vipetsc.case.points import PointTable
from vipetsc.dynamics.layout import Layout
from vipetsc.io.chunks import MOTION
from vipetsc.lattice import Chain, contacts


class PointMotion:
    """The motion of ``points`` of a ``chain``.

    ``watched`` (own point, 2) are cell and mass of those in this rank's cells, which are counted from its first one on.
    ``pushes`` (push, 3) say which contacts act on them: the own point, its place among ``Layout.acting_sites``, and
    1 where the point is its host, -1 where it is its resonator.
    """

    def __init__(self, points: list[PointTable], chain: Chain, layout: Layout) -> None:
        cells = np.array([point.cell - 1 for point in points], np.int64)
        masses = np.array([point.mass - 1 for point in points], np.int64)
        is_own = (cells >= layout.start) & (cells < layout.stop)
        self._numbers = np.flatnonzero(is_own)
        self.watched = np.column_stack([cells - layout.start, masses])[is_own]
        self._comm = layout.comm

        acting = contacts(chain)
        own_contacts = np.array(layout.acting_sites, np.int64)
        pushes = []
        for point, place in enumerate((cells * layout.dofs + masses)[is_own].tolist()):
            for sign, ends in ((1, acting.start), (-1, acting.end)):
                pushes += [(point, row, sign) for row in np.flatnonzero(ends[own_contacts] == place).tolist()]
        self.pushes = np.array(pushes, np.int64).reshape(-1, 3)

    def gather(self, motion: np.ndarray) -> dict[str, np.ndarray]:
        """Return displacement, velocity and acceleration (t, point) by name, on rank 0; none elsewhere. Collective.

        ``motion`` (t, 3, own point) are the samples of this rank.
        """
        parts = self._comm.gather((self._numbers, motion))
        if parts is None:
            return {}
        numbers, motions = zip(*parts, strict=True)
        every_motion = np.concatenate(motions, axis=2)[:, :, np.argsort(np.concatenate(numbers))]
        return dict(zip(MOTION, every_motion.swapaxes(0, 1), strict=True))
