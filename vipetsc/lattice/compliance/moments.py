r"""Compliance far above the pass bands, from moments: no waves are solved for, and nothing is lost to rounding.

With b = 1 at a resonator and -1 at its host, b^T (K - omega^2 M)^-1 b = -sum_n b^T (M^-1 K)^n M^-1 b / omega^(2n + 2).
The series converges where omega is above all linear modes, which lie below the top of the highest band. Term n reaches
n cells to either side of b.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.lattice.chain import Chain
from vipetsc.lattice.compliance.by_waves import WaveCompliance

# The series is used above FAST_FROM times the top of the bands, where each term is at most a quarter of the last: after
# 28 terms 4^-28 is below rounding.
FAST_FROM = 2.0
TERMS = 28


@dataclass(frozen=True)
class SeriesCompliance(WaveCompliance):
    """Compliance of a finite lattice between its sites: by the series where it converges fast, else by waves.

    Contacts join the pair of their cell.
    """

    def at(self, omegas: ArrayLike) -> np.ndarray:
        """Return the compliance (omega, pair, pair) in m/N at frequencies in rad/s, real or complex."""
        omega = np.atleast_1d(omegas)
        high = np.abs(omega) > FAST_FROM * self.highest
        compliance = np.zeros((len(omega), self.pairs, self.pairs), omega.dtype if np.iscomplexobj(omega) else float)
        if not high.all():
            compliance[~high] = super().at(omega[~high])
        ratio = (self.highest / omega[high]) ** 2
        powers = ratio ** np.arange(1, TERMS + 1)[:, None]
        compliance[high] = -np.einsum("nij,nw->wij", self._moments, powers)
        return compliance

    @cached_property
    def _moments(self) -> np.ndarray:
        """b^T (M^-1 K)^n M^-1 b (terms, pair, pair) over top^(2n + 2), in cells near the sites alone."""
        chain = self.chain
        d = chain.cell.dofs
        moments = np.zeros((TERMS, len(chain.sites), len(chain.sites)))
        for group in self._groups():
            first, piece = self._piece(group)
            rows = np.zeros((piece.cells * d, len(group)))
            for j, number in enumerate(group):
                start = (chain.sites.cells[number] - first) * d
                rows[start + chain.cell.resonator, j] = 1.0
                rows[start + chain.cell.host, j] = -1.0

            # Scaled by the top of the bands, terms neither grow nor vanish.
            scale = 1 / (piece.masses()[:, None] * self.highest**2)
            stiffness = piece.stiffness_matrix()
            moved = rows * scale
            for n in range(TERMS):
                moments[n][np.ix_(group, group)] = rows.T @ moved
                moved = scale * (stiffness @ moved)
        return moments

    def _piece(self, group: np.ndarray) -> tuple[int, Chain]:
        """Return first cell, and the chain, of what the series of a ``group`` of sites reaches: a cell each term."""
        chain = self.chain
        first = int(chain.sites.cells[group[0]]) - TERMS
        last = int(chain.sites.cells[group[-1]]) + TERMS
        if not chain.topology.is_ring:
            first = max(first, 0)
            last = min(last, chain.cells - 1)
        if last - first + 1 >= chain.cells:
            first = 0
            last = chain.cells - 1
        return first, Chain(chain.cell, last - first + 1, chain.ends)

    def _groups(self) -> list[np.ndarray]:
        """Return the sites' numbers in the chain's list, together where their pieces overlap; a ring's all together."""
        sites = self.chain.sites.cells
        order = np.argsort(sites, kind="stable")
        if self.chain.topology.is_ring:
            return [order]
        return np.split(order, np.flatnonzero(np.diff(sites[order]) > 2 * TERMS) + 1)
