"""Motion of the lattice without contacts as a Taylor series: what the propagator P(H) is made of.

Without forces M u'' = -K u, so that every displacement is the series in t/H with the coefficients
(-H^2 M^-1 K)^m u / (2m)! and H (-H^2 M^-1 K)^m u' / (2m+1)!. A power of K reaches one spring further: cut where
its terms fall below the tolerance, the series is local, and the same in every cell far enough from the ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np

from vipetsc.lattice.cell import UnitCell
from vipetsc.lattice.chain import Chain

# Terms grow as (omega H)^k / k! before they fall: beyond this omega H rounding would show.
LONGEST = 3.2
MOST_TERMS = 24


def top_frequency(cell: UnitCell) -> float:
    """Bound in rad/s on the frequencies of any lattice of ``cell``, by Gershgorin's circles."""
    root = 1 / np.sqrt(np.asarray(cell.masses))
    rows = np.zeros(cell.dofs)
    for mass, _, other, stiffness in cell.couplings():
        rows[mass] += stiffness * root[mass] * (root[mass] + root[other])
    return float(np.sqrt(rows.max()))


@dataclass(frozen=True)
class StepSeries:
    """Series of a chain's motion over a step of ``interval`` H in s, to a relative ``tolerance``.

    Rows are arrays (..., term, dof, cell): what a displacement's coefficients take from the displacements around
    it; the same rows, times H, give those of the velocities.
    """

    chain: Chain
    interval: float
    tolerance: float

    @cached_property
    def top(self) -> float:
        """Bound on omega H of the lattice's modes."""
        return top_frequency(self.chain.cell) * self.interval

    @cached_property
    def terms(self) -> int:
        """Powers of K that are kept, the zeroth included."""
        terms = 1
        while terms < MOST_TERMS and self._rest(terms) > self.tolerance / 4:
            terms += 1
        return terms

    def _rest(self, terms: int) -> float:
        """Largest velocity that the series of so many terms leaves out, of one of unit velocity amplitude."""
        k = 2 * terms - 1
        return self.top**k / factorial(k) * (1 + self.top)

    @cached_property
    def _far(self) -> int:
        """Cells each way that no kept power of K reaches."""
        return self.terms + 1

    @cached_property
    def _interior(self) -> np.ndarray:
        """Rows (dof, term, dof, cell) of an interior cell's masses over all cells that they reach."""
        d, far = self.chain.cell.dofs, self._far
        start = np.zeros((d, d, 2 * far + 1))
        start[np.arange(d), np.arange(d), far] = 1.0
        return self._rows(start, None, None)

    @cached_property
    def reach(self) -> int:
        """Cells each way beyond which the propagator's entries sum to less than the tolerance."""
        share = self._share(self.stencil(self._interior)).sum(axis=1)
        beyond = np.array([share[:, np.abs(np.arange(-self._far, self._far + 1)) > r].sum(axis=1).max()
                           for r in range(self._far + 1)])  # fmt: skip
        return max(int(np.argmax(beyond <= self.tolerance / 2)), 1)

    @cached_property
    def truncation(self) -> float:
        """Bound on the relative error of one step: entries left out and the rest of the series."""
        share = self._share(self.stencil(self._interior)).sum(axis=1)
        outside = np.abs(np.arange(-self._far, self._far + 1)) > self.reach
        inside = self.interior()
        small = np.where(self.significant(inside), 0.0, self._share(inside)).sum(axis=(1, 2)).max()
        return float(share[:, outside].sum(axis=1).max() + small + self._rest(self.terms))

    def significant(self, stencil: np.ndarray) -> np.ndarray:
        """Which of P's entries are worth their cost."""
        return self._share(stencil) > 1e-3 * self.tolerance

    def _share(self, stencil: np.ndarray) -> np.ndarray:
        """Magnitudes of P's entries between states in which a velocity counts as omega times a displacement."""
        n = self.chain.cell.dofs
        scale = np.ones((2 * n, 2 * n, 1))
        omega = self.top / self.interval
        scale[:n, n:] *= omega
        scale[n:, :n] /= omega
        return np.abs(stencil) * scale

    def _rows(self, start: np.ndarray, left: str | None, right: str | None) -> np.ndarray:
        """Rows (batch, term, dof, cell) of linear forms ``start`` (batch, dof, cell) on a stretch of the chain.

        ``left`` and ``right`` are its ends, None where the chain goes on beyond what the rows reach.
        """
        cell = self.chain.cell
        masses = np.asarray(cell.masses, np.longdouble)[:, None]
        squared = np.longdouble(self.interval) ** 2
        width = start.shape[-1]
        form = start.astype(np.longdouble)
        rows = [form]
        for _ in range(self.terms - 1):
            u = form / masses
            form = np.zeros_like(u)
            for mass, offset, other, stiffness in cell.couplings():
                neighbour = np.zeros_like(u[:, other])
                inside = slice(max(-offset, 0), width - max(offset, 0))
                neighbour[:, inside] = u[:, other, max(offset, 0) : width - max(-offset, 0)]
                force = neighbour - u[:, mass]
                if offset < 0 and left == "free":
                    force[:, 0] = 0
                if offset > 0 and right == "free":
                    force[:, -1] = 0
                form[:, mass] += squared * np.longdouble(stiffness) * force
            rows.append(form)
        return np.stack(rows, axis=1)

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
        middle = slice(self._far - self.reach, self._far + self.reach + 1)
        return self.stencil(self._interior)[:, :, middle]

    def end(self, right: bool) -> np.ndarray:
        """P's rows (reach, 2 dof, 2 dof, 2 reach) of the first or last ``reach`` cells over the first or last 2 reach.

        Raises ValueError if the chain is shorter than that.
        """
        d, r, n = self.chain.cell.dofs, self.reach, self.chain.cells
        if n < 2 * r + 1:
            raise ValueError(f"{n} cells are fewer than {2 * r + 1}")
        width = min(n, 2 * r + self._far)
        first = n - width if right else 0
        own = range(n - r, n) if right else range(r)
        columns = slice(width - 2 * r, width) if right else slice(0, 2 * r)
        rows = self._placed([(c, mass) for c in own for mass in range(d)], first, width)
        rows = rows.reshape(r, d, *rows.shape[1:])
        return np.stack([self.stencil(each)[:, :, columns] for each in rows])

    def _placed(self, forms: list[tuple[int, int]], first: int, width: int) -> np.ndarray:
        """Rows of single masses (cell, mass) on the cells from ``first`` on, with the chain's own ends there."""
        start = np.zeros((len(forms), self.chain.cell.dofs, width))
        for i, (cell, mass) in enumerate(forms):
            start[i, mass, cell - first] = 1.0
        ends = self.chain.ends
        left = ends if first == 0 and ends != "periodic" else None
        right = ends if first + width == self.chain.cells and ends != "periodic" else None
        return self._rows(start, left, right)

    def around(self, cell: int) -> np.ndarray:
        """Rows (dof, term, dof, 2 reach + 1) of the masses of ``cell`` over the cells within ``reach``.

        Cells that the chain does not have get zeros.
        """
        d, r, n, far = self.chain.cell.dofs, self.reach, self.chain.cells, self._far
        if self.is_interior(cell):
            return self._interior[..., far - r : far + r + 1].astype(float)
        first, last = max(cell - far - r, 0), min(cell + far + r, n - 1)
        rows = self._placed([(cell, mass) for mass in range(d)], first, last - first + 1)
        found = np.zeros((d, self.terms, d, 2 * r + 1))
        for k in range(2 * r + 1):
            at = cell - r + k
            if 0 <= at < n:
                found[..., k] = rows[..., at - first]
        return found

    def is_interior(self, cell: int) -> bool:
        """Whether the ends lie outside the reach of ``cell``."""
        return self.chain.ends == "periodic" or self.reach <= cell < self.chain.cells - self.reach
