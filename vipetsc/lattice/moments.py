r"""Compliance far above the pass bands, from moments: no waves are solved for, and nothing is lost to rounding.

b^T (K - omega^2 M)^-1 b = -sum_n b^T (M^-1 K)^n M^-1 b / omega^(2n + 2) converges where omega is above all linear
modes, which lie below the top of the highest band; a term reaches one cell further than the last.
"""

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.lattice.bands import pass_bands
from vipetsc.lattice.chain import Chain
from vipetsc.lattice.compliance import WaveCompliance

# Frequencies above this times the top of the bands, and terms of the series: 4^-28 is below rounding.
FROM, TERMS = 2.0, 28


class SeriesCompliance:
    """``compliance`` of a finite lattice between its sites, with the series where it converges fast."""

    def __init__(self, compliance: WaveCompliance) -> None:
        self.compliance, self.chain = compliance, compliance.chain
        self.top = pass_bands(self.chain.cell)[-1].high

    def at(self, omegas: ArrayLike) -> np.ndarray:
        """Compliance (omega, pair, pair) in m/N at frequencies in rad/s, real or complex."""
        omega = np.atleast_1d(omegas)
        high, pairs = np.abs(omega) > FROM * self.top, len(self.chain.sites)
        out = np.zeros((len(omega), pairs, pairs), omega.dtype if np.iscomplexobj(omega) else float)
        if not high.all():
            out[~high] = self.compliance.at(omega[~high])
        ratio = (self.top / omega[high]) ** 2
        out[high] = -np.einsum("nij,nw->wij", self._moments, ratio ** np.arange(1, TERMS + 1)[:, None])
        return out

    @cached_property
    def _moments(self) -> np.ndarray:
        """b^T (M^-1 K)^n M^-1 b (terms, pair, pair) over top^(2n + 2), in cells near the sites alone."""
        chain, moments = self.chain, np.zeros((TERMS, len(self.chain.sites), len(self.chain.sites)))
        for group in self._groups():
            first, last = chain.sites[group[0]] - TERMS, chain.sites[group[-1]] + TERMS
            if chain.ends != "periodic":
                first, last = max(first, 0), min(last, chain.cells - 1)
            if last - first + 1 >= chain.cells:
                first, last = 0, chain.cells - 1
            piece, d = Chain(chain.cell, last - first + 1, chain.ends), chain.cell.dofs
            rows = np.zeros((piece.cells * d, len(group)))
            for j, site in enumerate(group):
                at = (chain.sites[site] - first) * d
                rows[at + chain.cell.resonator, j], rows[at + chain.cell.host, j] = 1.0, -1.0
            scale = 1 / (piece.masses()[:, None] * self.top**2)
            stiffness, moved = piece.stiffness_matrix(), rows * scale
            for n in range(TERMS):
                moments[np.ix_([n], group, group)] = rows.T @ moved
                moved = scale * (stiffness @ moved)
        return moments

    def _groups(self) -> list[list[int]]:
        """Sites (places in the chain's list) whose cells near them overlap, in order; a ring's all together."""
        order = np.argsort(self.chain.sites, kind="stable").tolist()
        if self.chain.ends == "periodic":
            return [order]
        groups = [[order[0]]]
        for site in order[1:]:
            if self.chain.sites[site] - self.chain.sites[groups[-1][-1]] <= 2 * TERMS:
                groups[-1].append(site)
            else:
                groups.append([site])
        return groups
