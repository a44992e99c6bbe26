"""The Taylor series of P(H): rows of the powers of -H^2 K M^-1, how many count, and how far they reach.

Sec. 1 of the derivation in the package's docstring.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np

from vipetsc.lattice.cell import UnitCell
from vipetsc.lattice.chain import Chain

# Terms grow as (omega H)^k / k! before they fall: beyond this omega H rounding would show.
LARGEST_OMEGA_H = 3.2
MOST_TERMS = 24


def frequency_bound(cell: UnitCell) -> float:
    """Bound in rad/s on the frequencies of any lattice of ``cell``, by Gershgorin's circles."""
    root = 1 / np.sqrt(np.asarray(cell.masses))
    rows = np.zeros(cell.dofs)
    for mass, _, other, stiffness in cell.couplings():
        rows[mass] += stiffness * root[mass] * (root[mass] + root[other])
    return float(np.sqrt(rows.max()))


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
        """Bound on omega H of the lattice's modes."""
        return frequency_bound(self.chain.cell) * self.interval

    @cached_property
    def terms(self) -> int:
        """Number of powers of K in the series, the zeroth included."""
        terms = 1
        while terms < MOST_TERMS and self._remainder(terms) > self.tolerance / 4:
            terms += 1
        return terms

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
        return self._powers(self._width, 2 * self._width + 1)

    @cached_property
    def reach(self) -> int:
        """Cells each way beyond which the propagator's entries sum to less than the tolerance."""
        share, distance = self._far_entries()
        beyond = np.array([share[:, distance > r].sum(axis=1).max() for r in range(self._width + 1)])
        return max(int(np.argmax(beyond <= self.tolerance / 2)), 1)

    @cached_property
    def truncation(self) -> float:
        """Bound on the relative error of one step: entries left out and the remainder of the series."""
        share, distance = self._far_entries()
        stencil = self.interior()
        small = np.where(self.significant(stencil), 0.0, self._share(stencil)).sum(axis=(1, 2)).max()
        return float(share[:, distance > self.reach].sum(axis=1).max() + small + self._remainder(self.terms))

    def _far_entries(self) -> tuple[np.ndarray, np.ndarray]:
        """Magnitudes of P's rows (2 dof, cell), summed over the state of each cell, and the cells' distances."""
        return self._share(self.stencil(self._interior)).sum(axis=1), np.abs(np.arange(-self._width, self._width + 1))

    def significant(self, stencil: np.ndarray) -> np.ndarray:
        """Which of P's entries are worth their cost."""
        return self._share(stencil) > 1e-3 * self.tolerance

    def _share(self, stencil: np.ndarray) -> np.ndarray:
        """Magnitudes of P's entries between states in which a velocity counts as omega times a displacement."""
        n = self.chain.cell.dofs
        scale = np.ones((2 * n, 2 * n, 1))
        omega = self.omega_max_h / self.interval
        scale[:n, n:] *= omega
        scale[n:, :n] /= omega
        return np.abs(stencil) * scale

    def _powers(self, cell: int, width: int, free_left: bool = False, free_right: bool = False) -> np.ndarray:
        """Rows (dof, term, dof, width) of the masses of ``cell`` on a chain of ``width`` cells.

        Walls hold its ends unless they are free.
        """
        unit, d = self.chain.cell, self.chain.cell.dofs
        masses = np.asarray(unit.masses, np.longdouble)[:, None]
        squared = np.longdouble(self.interval) ** 2
        form = np.zeros((d, d, width), np.longdouble)
        form[np.arange(d), np.arange(d), cell] = 1
        rows = [form]
        for _ in range(self.terms - 1):
            u = form / masses
            form = np.zeros_like(u)
            for mass, offset, other, stiffness in unit.couplings():
                neighbour = np.zeros_like(u[:, other])
                inside = slice(max(-offset, 0), width - max(offset, 0))
                neighbour[:, inside] = u[:, other, max(offset, 0) : width - max(-offset, 0)]
                force = neighbour - u[:, mass]
                if offset < 0 and free_left:
                    force[:, 0] = 0
                if offset > 0 and free_right:
                    force[:, -1] = 0
                form[:, mass] += squared * np.longdouble(stiffness) * force
            rows.append(form)
        return np.stack(rows, axis=1)

    def rows(self, cell: int, first: int, count: int) -> np.ndarray:
        """Rows (dof, term, dof, count) of the masses of ``cell`` over ``count`` cells from ``first`` on.

        Cells beyond an end of the chain get zeros; those of a periodic chain count on beyond it.
        """
        last, free = self.chain.cells - 1, self.chain.ends == "free"
        begin, end = cell - self._width, cell + self._width
        if self.is_interior(cell):
            powers = self._interior
        else:
            begin, end = max(begin, 0), min(end, last)
            powers = self._powers(cell - begin, end - begin + 1, free and begin == 0, free and end == last)
        rows = np.zeros((*powers.shape[:-1], count), powers.dtype)
        a, b = max(first, begin), min(first + count - 1, end) + 1
        rows[..., a - first : b - first] = powers[..., a - begin : b - begin]
        return rows

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
        """P's rows (2 dof, 2 dof, 2 reach + 1) of a cell at least ``reach`` away from both ends."""
        middle = slice(self._width - self.reach, self._width + self.reach + 1)
        return self.stencil(self._interior)[:, :, middle]

    def end(self, right: bool) -> np.ndarray:
        """P's rows (cell, 2 dof, 2 dof, 2 reach) of the first or last ``reach`` cells, over twice as many cells."""
        n, r = self.chain.cells, self.reach
        first, cells = (n - 2 * r, range(n - r, n)) if right else (0, range(r))
        return np.stack([self.stencil(self.rows(cell, first, 2 * r)) for cell in cells])
