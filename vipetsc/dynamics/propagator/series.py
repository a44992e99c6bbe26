"""The Taylor series of free motion: the rows of the powers of -H^2 M^-1 K, how many count, and how far they reach.

With them, the free motion of the contact DoFs and, by Maxwell's reciprocity, what impulses on these leave in the
lattice: sec. 1, 2 and 5 of the derivation in the package's docstring.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from math import factorial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.compiled import kernel, njit
from vipetsc.contact.changes import LANDED_W
from vipetsc.contact.law import gap_of
from vipetsc.lattice.chain import Chain

MOST_TERMS = 24
# Shares of a step below this are rounding.
ROUNDING = 1e-15


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
        for mass, _, other, stiffness, *_ in cell.couplings():
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
    def _near_end(self) -> Callable[[int], np.ndarray]:
        """As ``_interior``, of a cell near an end; each is computed once."""

        def powers(cell: int) -> np.ndarray:
            cells = np.arange(cell - self._width, cell + self._width + 1)
            return self._powers((cells >= 0) & (cells < self.chain.cells))

        return cache(powers)

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
            for mass, offset, other, stiffness, *_ in unit.couplings():
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
        powers = self._interior if self.is_interior(cell) else self._near_end(int(cell))
        begin = first - cell + self._width + count
        return np.pad(powers, [(0, 0), (0, 0), (0, 0), (count, count)])[..., begin : begin + count]

    def is_interior(self, cells: ArrayLike) -> np.ndarray:
        """Whether the ends lie outside the reach of each of ``cells``."""
        beyond = np.asarray(cells) - self.reach
        return (beyond >= 0) & (beyond < self.chain.cells - 2 * self.reach) | (self.chain.ends == "periodic")

    def stencil(self, rows: np.ndarray) -> np.ndarray:
        """P's rows (2 dof, 2 dof, cell), displacements before velocities, of masses with ``rows``.

        ``rows`` are (dof, term, dof, cell).
        """
        n, terms = rows.shape[0], rows.shape[1]
        inverse = 1 / np.array([factorial(k) for k in range(2 * terms)], np.longdouble)
        even, odd, h = inverse[::2], inverse[1::2], np.longdouble(self.interval)
        p = np.zeros((2 * n, 2 * n, rows.shape[-1]), np.longdouble)
        p[:n, :n] = p[n:, n:] = np.einsum("m,imjc->ijc", even, rows)
        p[:n, n:] = h * np.einsum("m,imjc->ijc", odd, rows)
        p[n:, :n] = np.einsum("m,imjc->ijc", odd[:-1], rows[:, 1:]) / h
        return p.astype(float)

    def interior(self) -> np.ndarray:
        """P's rows (2 dof, 2 dof, 2 reach + 1) of a cell at least ``reach`` from both ends; small entries are zero."""
        entries = np.where(self._share > 1e-3 * self.tolerance, self.stencil(self._interior), 0.0)
        return entries[:, :, self._width - self.reach : self._width + self.reach + 1]


class DofTables(NamedTuple):
    """The contact DoFs of a rank, cluster by cluster, and what joins them to the dofs.

    ``column`` (dof,) is the first column in the halo of the cells that a DoF reaches, ``owned`` (dof, cell) which of
    the rank's cells they are, -1 for cells of other ranks. ``table`` (dof,) numbers its rows in ``rows`` (table,
    mass, cell, term); ``factors`` (2 term,) are H^(k mod 2)/k!; ``inverse_masses`` (mass,) are in 1/kg. ``clearance``
    (dof,) in m is that of a site, inf for the DoF ``driven``, the driven mass (-1 where it is out of reach). The DoFs
    of cluster c are ``first[c]`` to ``first[c + 1]``, those with an energy in the rank's ledger are in ``ledger``.
    """

    column: np.ndarray
    owned: np.ndarray
    table: np.ndarray
    rows: np.ndarray
    factors: np.ndarray
    inverse_masses: np.ndarray
    clearance: np.ndarray
    driven: int
    first: np.ndarray
    ledger: np.ndarray


@njit(error_model="numpy")
def expand_free_motion(dofs: DofTables, c: int, columns: np.ndarray, taylor: np.ndarray) -> bool:
    """Expand the free motion of the DoFs of cluster ``c`` in powers of t/H; whether a site may reach its clearance.

    Coefficients in m go into ``taylor`` (dof, 2 term); ``columns`` (2 mass, column) hold the lattice's state at the
    beginning of the step.
    """
    _, masses, width, terms = dofs.rows.shape
    even, odd, may_touch = np.empty(terms), np.empty(terms), False
    for i in range(dofs.first[c], dofs.first[c + 1]):
        rows, first, bound = dofs.rows[dofs.table[i]], dofs.column[i], 0.0
        even[:] = odd[:] = 0.0
        for j in range(masses):
            for k in range(width):
                u, v = columns[j, first + k], columns[masses + j, first + k]
                row = rows[j, k]
                for m in range(terms):
                    even[m] += u * row[m]
                    odd[m] += v * row[m]
        for m in range(terms):
            taylor[i, 2 * m] = even[m] * dofs.factors[2 * m]
            taylor[i, 2 * m + 1] = odd[m] * dofs.factors[2 * m + 1]
            bound += abs(taylor[i, 2 * m]) + abs(taylor[i, 2 * m + 1])
        may_touch |= not bound < dofs.clearance[i]
    return may_touch


@njit(error_model="numpy")
def apply_impulses(dofs: DofTables, first: int, moments: np.ndarray, out: np.ndarray) -> None:
    """Add to the owned cells ``out`` (2 mass, cell) what forces within the step leave there at its end.

    Row i of ``moments`` (dof, 2 term) belongs to the DoF ``first`` + i: integrals of its force times (1 - t/H)^k dt.
    """
    masses, width, terms = dofs.rows.shape[1:]
    for i in range(moments.shape[0]):
        if not moments[i].any():
            continue
        dof = first + i
        for k in range(width):
            c = dofs.owned[dof, k]
            if c < 0:
                continue
            for j in range(masses):
                u = v = 0.0
                row = dofs.rows[dofs.table[dof], j, k]
                for m in range(terms):
                    v += row[m] * dofs.factors[2 * m] * moments[i, 2 * m]
                    u += row[m] * dofs.factors[2 * m + 1] * moments[i, 2 * m + 1]
                out[j, c] += u * dofs.inverse_masses[j]
                out[masses + j, c] += v * dofs.inverse_masses[j]


@kernel
def copy(source: np.ndarray, target: np.ndarray) -> None:
    """Fill all rows of ``target`` (row, column) with the first ones of ``source``."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@kernel
def shift(taylor: np.ndarray, s: float, out: np.ndarray) -> None:
    """Series ``taylor`` (dof, coefficient) expanded about ``s`` instead of 0 into ``out``, which may be ``taylor``."""
    dofs, coefficients = taylor.shape
    copy(taylor, out[:dofs])
    for j in range(dofs):
        for k in range(coefficients - 1):
            for i in range(coefficients - 2, k - 1, -1):
                out[j, i] += s * out[j, i + 1]


@kernel
def evaluate(series: np.ndarray, s: float) -> tuple[float, float]:
    """Value and slope of a ``series`` at ``s``, by Horner's scheme."""
    value = slope = 0.0
    for k in range(series.size - 1, -1, -1):
        slope = slope * s + value
        value = value * s + series[k]
    return value, slope


@kernel
def first_onset(series: np.ndarray, site: Any, length: float) -> float:
    """First s in [0, length] at which w comes within rounding of a clearance of the ``site`` and grows; 2 if none does.

    |w''| has a bound over the whole length, so that a parabola bounds |w| from above: up to where that meets the
    clearance nothing can have happened.
    """
    bound = curvature = 0.0
    scale = 1.0
    for k in range(series.size):
        bound += abs(series[k]) * scale
        if k >= 2:
            curvature += k * (k - 1) * abs(series[k]) * scale / (length * length)
        scale *= length
    tolerance = LANDED_W * site.scale
    if bound < min(site.clearance, site.clearance_minus) - tolerance:
        return 2.0
    first = 2.0
    for side in (1.0, -1.0):
        s, clearance = 0.0, gap_of(site, side)
        if clearance == np.inf:
            continue
        while s <= length:
            w, rate = evaluate(series, s)
            gap, closing = clearance - side * w, side * rate
            if gap < 0.5 * tolerance and closing > 0.0:
                newton = gap / closing
                first = min(first, max(s + newton, 0.0) if curvature * newton * newton < tolerance else s)
                break
            gap += tolerance
            root = np.sqrt(max(closing * closing + 2.0 * curvature * gap, 0.0))
            # The root of curvature/2 d^2 + closing d = gap, without cancellation.
            step = 2.0 * gap / (closing + root) if closing > 0.0 else (root - closing) / curvature
            s += max(step, ROUNDING)
    return first
