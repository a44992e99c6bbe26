"""The Taylor series of free motion: how many powers count, how far they reach, which cells share their rows.

Sec. 1, 2, 7 and 8 of the derivation in the package's docstring.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from math import factorial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.compiled import kernel
from vipetsc.contact.changes import LANDED_W
from vipetsc.contact.law import gap_of
from vipetsc.dynamics.propagator.rows import Bounds, bounds_of, power_rows, recursion_around
from vipetsc.lattice.chain import Chain

MOST_TERMS = 24
# Cells whose rows are computed together.
BATCH = 64
# Shares of a step below this are rounding.
ROUNDING = 1e-15


@dataclass(frozen=True)
class StepSeries:
    """Series of the motion of ``chain`` over a step of ``interval`` H in s, to a relative ``tolerance``.

    Rows are arrays (..., term, dof, cell): what a displacement's coefficients take from the displacements around
    it; the same rows, times H, give those of the velocities. With dashpots (..., 2 term, 2 dof, cell): what the
    coefficient of each power of time takes from displacements and from H times velocities. A chain must have
    at least ``width`` cells.
    """

    chain: Chain
    interval: float
    tolerance: float

    @cached_property
    def bounds(self) -> Bounds:
        """What no cell exceeds."""
        return bounds_of(self.chain)

    @property
    def is_damped(self) -> bool:
        """Whether there is a dashpot."""
        return self.bounds.damping > 0

    @property
    def omega_max_h(self) -> float:
        """Bound on omega H of the modes of any lattice of these cells; with dashpots on the norm of what turns them."""
        return self.bounds.rate * self.interval

    @cached_property
    def terms(self) -> int:
        """Number of powers of K in the series, the zeroth included; with dashpots half the powers of time."""
        return next((m for m in range(2, MOST_TERMS) if self._remainder(m) <= self.tolerance / 4), MOST_TERMS)

    def _remainder(self, terms: int) -> float:
        """Largest velocity that the series of so many terms leaves out, of one of unit velocity amplitude."""
        k = 2 * terms - 1
        return self.omega_max_h**k / factorial(k) * (1 + self.omega_max_h)

    @property
    def _width(self) -> int:
        """Cells each way that no power in the series reaches."""
        return (1 + self.is_damped) * self.terms + 1

    @cached_property
    def _first(self) -> np.ndarray:
        """The zeroth power's rows (1, dof, dof, cell) over all cells within ``_width``."""
        n = self.chain.cell.dofs
        rows = np.zeros((1, n, n, 2 * self._width + 1), np.longdouble)
        rows[..., self._width] = np.eye(n)
        return rows

    @cached_property
    def _interior(self) -> np.ndarray:
        """Rows (dof, term, dof, cell) of an interior cell over all cells within ``_width``."""
        alone = replace(self.chain, variation=None)
        turns = recursion_around(alone, self.interval, np.zeros(1, int), np.ones((1, 2 * self._width + 1), bool), 0)
        return power_rows(self._first, self.terms, turns)[0]

    def _magnitudes(self, rows: np.ndarray) -> np.ndarray:
        """Magnitudes of P's entries (2 dof, 2 dof, cell) for it, a velocity counted as omega times a displacement."""
        n, omega = self.chain.cell.dofs, (self.omega_max_h or 1.0) / self.interval  # 1.0: no springs
        share = np.abs(self.stencil(rows))
        share[:n, n:] *= omega
        share[n:, :n] /= omega
        return share

    @cached_property
    def _share(self) -> np.ndarray:
        """Those of an interior cell."""
        return self._magnitudes(self._interior)

    @cached_property
    def _largest_share(self) -> np.ndarray:
        """Those that no cell's exceed."""
        if self.chain.variation is None:
            return self._share
        return self._magnitudes(power_rows(self._first, self.terms, self.bounds.turns(self.interval))[0])

    def _beyond(self, distance: int) -> float:
        """Largest sum of these magnitudes over the cells further away than ``distance``; twice where cells differ."""
        is_beyond = np.abs(np.arange(-self._width, self._width + 1)) > distance
        left_out = float(self._largest_share.sum(axis=1)[:, is_beyond].sum(axis=1).max())
        return left_out * (1 if self.chain.variation is None else 2)

    @cached_property
    def reach(self) -> int:
        """Cells each way beyond which the propagator's entries sum to less than the tolerance."""
        return next(r for r in range(1, self._width + 1) if self._beyond(r) <= self.tolerance / 2)

    @property
    def width(self) -> int:
        """Cells that a mass reaches, or a contact: it may have a mass in the next cell."""
        return 2 * self.reach + 1 + self.chain.is_joined

    @cached_property
    def truncation(self) -> float:
        """Bound on the relative error of one step: entries left out and the remainder of the series."""
        share = self._share[:, :, self._width - self.reach : self._width + self.reach + 1]
        small = float(np.where(self.interior() == 0.0, share, 0.0).sum(axis=(1, 2)).max())
        return self._beyond(self.reach) + small + self._remainder(self.terms)

    def rows(self, cells: ArrayLike) -> Iterator[np.ndarray]:
        """Rows (dof, term, dof, 2 width + 1) of the masses of each of ``cells``, centred on it.

        Computed in batches, to the same bits in any. Cells beyond an end of the chain get zeros; those of a periodic
        chain count on beyond it.
        """
        cells, around = np.asarray(cells, np.int64), np.arange(-self._width, self._width + 1)
        for part in np.split(cells, range(BATCH, len(cells), BATCH)):
            beside = part[:, None] + around
            exists = (beside >= 0) & (beside < self.chain.cells) | ~self._is_near_end(part)[:, None]
            turns = recursion_around(self.chain, self.interval, part, exists, self.reach + 1)
            yield from power_rows(np.repeat(self._first, len(part), axis=0), self.terms, turns)

    def cut(self, rows: np.ndarray, first: int, count: int) -> np.ndarray:
        """The part of ``rows`` over ``count`` cells from the one ``first`` cells away on, zero where they end."""
        begin = first + self._width + count
        return np.pad(rows, [(0, 0), (0, 0), (0, 0), (count, count)])[..., begin : begin + count]

    def factors(self) -> np.ndarray:
        """Those of the tables: H^(k mod 2)/k!; with dashpots 1/k! for displacements, then H/k! for velocities."""
        h, powers = self.interval, range(2 * self.terms)
        if self.is_damped:
            return np.array([h**i / factorial(k) for i in range(2) for k in powers])
        return np.array([h ** (k % 2) / factorial(k) for k in powers])

    def _is_near_end(self, cells: ArrayLike) -> np.ndarray:
        """Whether an end lies within the reach of each of ``cells``."""
        beyond = np.asarray(cells) - self.reach
        return ((beyond < 0) | (beyond >= self.chain.cells - 2 * self.reach)) & (self.chain.ends != "periodic")

    @cached_property
    def _differing(self) -> np.ndarray:
        """How many cells differ from the reference cell before each one, from ``reach`` + 1 before the first on."""
        near, differs = self.reach + 1, self.chain.differs.astype(int)
        around = np.pad(differs, near, mode="wrap") if self.chain.ends == "periodic" else np.pad(differs, near)
        return np.append(0, np.cumsum(around))

    def is_interior(self, cells: ArrayLike) -> np.ndarray:
        """Whether each of ``cells`` has no end within its reach, and no cell that differs there or one further."""
        cells = np.asarray(cells, np.int64)
        is_far = ~self._is_near_end(cells)
        if self.chain.variation is None:
            return is_far
        return is_far & (self._differing[cells + 2 * self.reach + 3] == self._differing[cells])

    def like(self, cells: ArrayLike) -> np.ndarray:
        """For each of ``cells`` the first one of them that has the same rows."""
        cells, near, first = np.array(cells, np.int64), self.reach + 1, dict[bytes, int]()
        interior = self.is_interior(cells)
        cells[interior] = cells[interior][:1]
        for i in np.flatnonzero(~interior & ~self._is_near_end(cells)):
            around = self.chain.coefficients(cells[i] - near, cells[i] + near + 1)
            cells[i] = first.setdefault(b"".join(array.tobytes() for array in around), int(cells[i]))
        return cells

    def own_rows(self) -> tuple[int, int]:
        """How many cells have rows of their own since cells differ, and how many tables these are."""
        every = np.arange(0 if self.chain.variation is None else self.chain.cells)
        differing = every[~self.is_interior(every)]
        return len(differing), len(np.unique(self.like(differing)))

    def stencil(self, rows: np.ndarray) -> np.ndarray:
        """P's rows (2 dof, 2 dof, cell), displacements before velocities, of masses with ``rows``.

        ``rows`` are (dof, term, dof, cell).
        """
        n, terms = rows.shape[0], self.terms
        inverse = 1 / np.array([factorial(k) for k in range(2 * terms)], np.longdouble)
        even, odd, h = inverse[::2], inverse[1::2], np.longdouble(self.interval)
        p = np.zeros((2 * n, 2 * n, rows.shape[-1]), np.longdouble)
        if rows.shape[1] > terms:
            p[:n] = np.einsum("m,imjc->ijc", inverse, rows)
            p[n:] = np.einsum("m,imjc->ijc", inverse[:-1], rows[:, 1:]) / h
            p[:, n:] *= h
        else:
            p[:n, :n] = p[n:, n:] = np.einsum("m,imjc->ijc", even, rows)
            p[:n, n:] = h * np.einsum("m,imjc->ijc", odd, rows)
            p[n:, :n] = np.einsum("m,imjc->ijc", odd[:-1], rows[:, 1:]) / h
        return p.astype(float)

    def interior(self) -> np.ndarray:
        """P's rows (2 dof, 2 dof, 2 reach + 1) of a cell at least ``reach`` from both ends; small entries are zero."""
        entries = np.where(self._share > 1e-3 * self.tolerance, self.stencil(self._interior), 0.0)
        return entries[:, :, self._width - self.reach : self._width + self.reach + 1]


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
