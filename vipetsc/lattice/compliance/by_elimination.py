"""Compliance of a finite lattice of any cells and dashpots, by elimination at each frequency.

It is R^T (K + i omega C - omega^2 M)^-1 L for loads in the columns of L and motions that those of R pick.
``ModalCompliance`` computes all modes, which takes a minute for a thousand masses with dashpots; here each frequency
takes a few milliseconds, and time in proportion to the number of cells.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import diags
from scipy.sparse.linalg import splu

from vipetsc.lattice.compliance.base import ChainCompliance

# Of the orders of elimination the one that keeps its digits in a ring, see ``Chain.wave_scale``.
ORDER = "MMD_AT_PLUS_A"


@dataclass(frozen=True)
class DirectCompliance(ChainCompliance):
    """Compliance of the contact pairs of a finite ``chain`` whose cells may differ and have dashpots.

    Frequencies lie below the real axis, where no mode makes the matrix singular.
    """

    def response(self, omegas: ArrayLike) -> np.ndarray:
        """Return the motions of ``ChainCompliance.response``; they are complex."""
        return self.motion(omegas, self.loads[:, : self.pairs])

    def motion(self, omegas: ArrayLike, rows: np.ndarray) -> np.ndarray:
        """Return motions (omega, row, pair and point) in m/N, picked by ``rows`` (dofs, row) as by ``loads``."""
        chain = self.chain
        stiffness = chain.stiffness_matrix()
        damping = chain.damping_rows(0, chain.cells).tocsc()
        masses = diags(chain.masses()).tocsc()

        motions = []
        for omega in np.atleast_1d(np.asarray(omegas, complex)):
            dynamic = (stiffness + 1j * omega * damping - omega**2 * masses).tocsc()
            motions.append(rows.T @ splu(dynamic, permc_spec=ORDER).solve(self.loads.astype(complex)))
        return np.array(motions)
