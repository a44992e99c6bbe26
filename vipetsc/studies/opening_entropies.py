"""Entropies of the snapshots before the first contact of a run, from those of its linear run."""

from typing import NamedTuple

import numpy as np

from vipetsc import spectra
from vipetsc.spectra.entropies import LocalEntropy

Computed = dict[tuple[int, int, int], LocalEntropy]
"""Entropies of a linear run by the mass in the cell, the stride of samples, and the stride of cells."""


class OpeningEntropies(NamedTuple):
    """Entropies of the first ``samples`` of a run, which are those of a linear run times a ``factor``.

    Entropies do not depend on the amplitude. Those of all snapshots of the linear run, with the ``velocity`` (t, cell,
    dof) in m/s, are ``computed`` for the first run that asks for them, and stay for others that begin with it.
    """

    velocity: np.ndarray
    computed: Computed
    samples: int
    factor: float

    def first(self, dof: int, every: int, stride: int) -> LocalEntropy:
        """The entropies of every ``every``-th of the first samples, of the mass ``dof`` at every ``stride``-th cell."""
        key = dof, every, stride
        if key not in self.computed:
            self.computed[key] = spectra.local_entropy(self.velocity[::every, :, dof], stride)

        whole = self.computed[key]
        count = -(-self.samples // every)
        return LocalEntropy(whole.local[:count], whole.weight[:count] * self.factor**2)
