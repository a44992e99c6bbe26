"""The Taylor series of P(H): rows of the powers of -H^2 K M^-1, how many count, and how far they reach.

Sec. 1 of the derivation in the package's docstring.
"""

from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np

from vipetsc.lattice.chain import Chain

# Terms grow as (omega H)^k / k! before they fall: beyond this omega H rounding would show.
LARGEST_OMEGA_H = 3.2
MOST_TERMS = 24


@dataclass(frozen=True)
class StepSeries:
    """Series of the motion of ``chain`` over a step of ``interval`` H in s, to a relative ``tolerance``.

    Rows are arrays (..., term, dof, cell): what a displacement's coefficients take from the displacements around
    it; the same rows, times H, give those of the velocities. A chain that is not periodic must have more than
    2 ``reach`` cells.
    """

    chain: Chain
    interval: float
    tolerance: float

    @cached_property
    def omega_max_h(self) -> float:
        """Bound on omega H of the modes of any lattice of this cell, by Gershgorin's circles."""
        cell = self.chain.cell
        root = 1 / np.sqrt(np.asarray(cell.masses))
        rows = np.zeros(cell.dofs)
        for mass, _, other, stiffness in cell.couplings():
            rows[mass] += stiffness * root[mass] * (root[mass] + root[other])
        return float(np.sqrt(rows.max())) * self.interval

    @cached_property
    def terms(self) -> int:
        """Number of powers of K in the series, the zeroth included."""
        return next((m for m in range(1, MOST_TERMS) if self._remainder(m) <= self.tolerance / 4), MOST_TERMS)

    def _remainder(self, terms: int) -> float:
        """Largest velocity that the series of so many terms leaves out, of one of unit velocity amplitude."""
        k = 2 * terms - 1
        return self.omega_max_h**k / factorial(k) * (1 + self.omega_max_h)

    @property
    def _width(self) -> int:
        """Cells each way that no power of K in the series reaches."""
        return self.terms + 1

    @cached_property
    def _interior(self) -> np.ndarray:
        """Rows (dof, term, dof, cell) of an interior cell over all cells within ``_width``."""
        return self._powers()

    @cached_property
    def _share(self) -> np.ndarray:
        """Magnitudes of P's entries (2 dof, 2 dof, cell) for it, a velocity counted as omega times a displacement."""
        n, omega = self.chain.cell.dofs, self.omega_max_h / self.interval
        share = np.abs(self.stencil(self._interior))
        share[:n, n:] *= omega
        share[n:, :n] /= omega
        return share

    def _beyond(self, distance: int) -> float:
        """Largest sum of these magnitudes over the cells further away than ``distance``."""
        is_beyond = np.abs(np.arange(-self._width, self._width + 1)) > distance
        return float(self._share.sum(axis=1)[:, is_beyond].sum(axis=1).max())

    @cached_property
    def reach(self) -> int:
        """Cells each way beyond which the propagator's entries sum to less than the tolerance."""
        return next(r for r in range(1, self._width + 1) if self._beyond(r) <= self.tolerance / 2)

    @cached_property
    def truncation(self) -> float:
        """Bound on the relative error of one step: entries left out and the remainder of the series."""
        share = self._share[:, :, self._width - self.reach : self._width + self.reach + 1]
        small = float(np.where(self.interior() == 0.0, share, 0.0).sum(axis=(1, 2)).max())
        return self._beyond(self.reach) + small + self._remainder(self.terms)

    def _powers(self, exists: np.ndarray | bool = True) -> np.ndarray:
        """Rows (dof, term, dof, 2 width + 1) of a cell's masses; which of the cells around it ``exists``."""
        unit, width = self.chain.cell, self._width
        masses = np.asarray(unit.masses, np.longdouble)[:, None]
        squared = np.longdouble(self.interval) ** 2
        rows = [np.zeros((unit.dofs, unit.dofs, 2 * width + 1), np.longdouble)]
        rows[0][:, :, width] = np.eye(unit.dofs)
        for _ in range(self.terms - 1):
            u, form = rows[-1] / masses, np.zeros_like(rows[0])
            for mass, offset, other, stiffness in unit.couplings():
                # No power reaches the last cells: what is rolled past them is zero.
                force = np.roll(u[:, other], -offset, axis=-1) - u[:, mass]
                acts = exists & np.roll(exists, -offset) if self.chain.ends == "free" else exists
                form[:, mass] += squared * np.longdouble(stiffness) * np.where(acts, force, 0)
            rows.append(form)
        return np.stack(rows, axis=1)

    def rows(self, cell: int, first: int, count: int) -> np.ndarray:
        """Rows (dof, term, dof, count) of the masses of ``cell`` over ``count`` cells from ``first`` on.

        Cells beyond an end of the chain get zeros; those of a periodic chain count on beyond it.
        """
        cells = np.arange(cell - self._width, cell + self._width + 1)
        powers = self._interior if self.is_interior(cell) else self._powers((cells >= 0) & (cells < self.chain.cells))
        begin = first - cells[0] + count
        return np.pad(powers, [(0, 0), (0, 0), (0, 0), (count, count)])[..., begin : begin + count]

    def is_interior(self, cell: int) -> bool:
        """Whether the ends lie outside the reach of ``cell``."""
        return self.chain.ends == "periodic" or self.reach <= cell < self.chain.cells - self.reach

    def stencil(self, rows: np.ndarray) -> np.ndarray:
        """P's rows (2 dof, 2 dof, cell), displacements before velocities, of masses with ``rows``.

        ``rows`` are (dof, term, dof, cell).
        """
        n, terms = rows.shape[0], rows.shape[1]
        even = np.array([1 / np.longdouble(factorial(2 * m)) for m in range(terms)])
        odd = np.array([1 / np.longdouble(factorial(2 * m + 1)) for m in range(terms)])
        h = np.longdouble(self.interval)
        p = np.zeros((2 * n, 2 * n, rows.shape[-1]), np.longdouble)
        p[:n, :n] = p[n:, n:] = np.einsum("m,imjc->ijc", even, rows)
        p[:n, n:] = h * np.einsum("m,imjc->ijc", odd, rows)
        p[n:, :n] = np.einsum("m,imjc->ijc", odd[:-1], rows[:, 1:]) / h
        return p.astype(float)

    def interior(self) -> np.ndarray:
        """P's rows (2 dof, 2 dof, 2 reach + 1) of a cell at least ``reach`` from both ends; small entries are zero."""
        entries = np.where(self._share > 1e-3 * self.tolerance, self.stencil(self._interior), 0.0)
        return entries[:, :, self._width - self.reach : self._width + self.reach + 1]
