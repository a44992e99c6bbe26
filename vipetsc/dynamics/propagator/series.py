"""The Taylor series of free motion: how many powers count, how far they reach, which cells share their rows.

Within a step nothing but linear springs and dashpots acts on most of the lattice, and its motion is a power series in
s = (t - t_0)/H whose coefficients are rows of ``rows`` times the state (sec. 1 and 7 of the derivation in the package's
docstring). ``StepSeries`` cuts it off where the remainder is below the tolerance, in powers as in cells, and sums what
is left out into ``truncation``, a bound on the relative error of a step. Cells far from the ends and from cells that
differ share one set of rows; others get their own (sec. 8). ``taylor`` evaluates such a series.

**Notation.** M, K and C are the lattice's matrices of masses, springs and dashpots; H is the step in s;
A = H^2 M^-1 K; P = P(H) takes the state at a step's beginning to that at its end in free motion. A *term* is a power
(-A)^m, which moves displacements by s^2m/(2m)! and velocities by H s^(2m+1)/(2m+1)!: one for two powers of time.

**Scaling.** H^2m is in the rows already, which are those of (-A)^m. What is left for ``factors`` is 1/k! for the power
s^k, and one more H where it multiplies a velocity: H^(k mod 2)/k!.

**The remainder** after n terms (``_remainder``). With theta = omega_max H, and displacements u measured as omega u, the
power s^k adds at most theta^k/k! to a state of unit amplitude. Kept are k < 2n, and in the velocity, the series'
derivative, k < 2n - 1. The first power left out is 2n - 1, each later one is at most theta/(2n) times the one before,
and their sum is at most theta^(2n-1)/(2n-1)! times 1/(1 - theta/(2n)). That factor is at most 1 + theta as long as
theta <= 2n - 1, which holds wherever the bound is below 1.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import factorial

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.dynamics.propagator.rows import Bounds, bounds_of, local_recursion, power_rows
from vipetsc.lattice.chain import Chain

# The engine's longest step, omega H = 3.2, needs 15 terms at its finest tolerance, 1e-15; these 24 reach omega H = 8 at
# that tolerance. The series of a longer step, which the engine refuses, is cut off here, and ``truncation`` has the
# larger remainder.
MOST_TERMS = 24
# Cells whose rows are computed together: they take about 100 kB each, too much for all cells at once. 16 and 256 take
# the same time in a lattice in which no two cells are alike; with dashpots 256 take 0.1 GB more.
BATCH = 64
# Cells whose rows are kept: members of a sweep ask again for those near the same few contacts and ends.
KEPT = 32
# Entries of P below this fraction of the tolerance are dropped; ``truncation`` counts them.
SMALL_ENTRY = 1e-3


@dataclass(frozen=True)
class StepSeries:
    """Series of the motion of ``chain`` over a step of ``interval`` H in s, to a relative ``tolerance``.

    Rows are arrays (..., term, dof, cell): what the term (-A)^m of a displacement takes from every displacement in the
    cells near it, for an even power of time; the same rows times H say what the next, odd power takes from the
    velocities. With dashpots rows are (..., 2 term, 2 dof, cell), one for each power of time: what it takes from
    displacements (P_k, the first dof) and from H times velocities (Q_k). A chain must have at least ``width`` cells.
    With ``spans_cells`` forces act between masses of two cells, also if no contact of ``chain`` joins cells.
    """

    chain: Chain
    interval: float
    tolerance: float
    spans_cells: bool = False

    @cached_property
    def bounds(self) -> Bounds:
        """The largest frequency, damping and matrix entries of any cell."""
        return bounds_of(self.chain)

    @property
    def is_damped(self) -> bool:
        """Whether rows are those with dashpots: also where the cell has one, and all of the lattice have damping 0."""
        return self.chain.is_damped

    @property
    def omega_max_h(self) -> float:
        """Bound theta on omega H of the modes of any lattice of these cells; with dashpots that of sec. 7."""
        return self.bounds.rate * self.interval

    @cached_property
    def terms(self) -> int:
        """Number of powers of K in the series, the zeroth included; with dashpots half the powers of time."""
        # The tolerance is divided: a quarter is for the remainder, half for what ``reach`` leaves out, and the last
        # quarter for the small entries that ``interior`` drops, which only a test holds to it.
        return next((m for m in range(2, MOST_TERMS) if self._remainder(m) <= self.tolerance / 4), MOST_TERMS)

    def _remainder(self, terms: int) -> float:
        """Return bound on what ``terms`` terms leave out of a state of unit amplitude: see the module's docstring."""
        # The first power of time that the velocity's series leaves out.
        k = 2 * terms - 1
        # Of a step that is far too long the power overflows: no number of terms is enough.
        with np.errstate(over="ignore"):
            power = np.float64(self.omega_max_h) ** k
        return float(power / factorial(k) * (1 + self.omega_max_h))

    @property
    def _outermost(self) -> int:
        """Distance in cells that no power in the series reaches: each of them is a product with K or C, a cell more."""
        return (1 + self.is_damped) * self.terms + 1

    @cached_property
    def _zeroth(self) -> np.ndarray:
        """The zeroth power's rows (1, dof, dof, cell) over all cells within ``_outermost``.

        Those of displacements alone, with dashpots, too: ``power_rows`` begins with P_0 = 1 and adds Q_0 = 0 itself.
        """
        n = self.chain.cell.dofs
        rows = np.zeros((1, n, n, 2 * self._outermost + 1), np.longdouble)
        rows[..., self._outermost] = np.eye(n)
        return rows

    @cached_property
    def _interior_rows(self) -> np.ndarray:
        """Rows (dof, term, dof, cell) of an interior cell over all cells within ``_outermost``."""
        uniform = replace(self.chain, variation=None)
        exists = np.ones((1, 2 * self._outermost + 1), bool)
        recursion = local_recursion(uniform, self.interval, np.zeros(1, int), exists, near=0)
        return power_rows(self._zeroth, self.terms, recursion)[0]

    def _magnitudes(self, rows: np.ndarray) -> np.ndarray:
        """Return magnitudes of P's entries (2 dof, 2 dof, cell) for ``rows``; a velocity counts as omega times u."""
        n = self.chain.cell.dofs
        # A lattice without springs has no omega; any rate serves.
        omega = (self.omega_max_h or 1.0) / self.interval
        magnitudes = np.abs(self.stencil(rows))
        magnitudes[:n, n:] *= omega
        magnitudes[n:, :n] /= omega
        return magnitudes

    @cached_property
    def _interior_magnitudes(self) -> np.ndarray:
        """Magnitudes of P's entries for an interior cell."""
        return self._magnitudes(self._interior_rows)

    @cached_property
    def _largest_magnitudes(self) -> np.ndarray:
        """Magnitudes of P's entries that no cell's exceed."""
        if self.chain.variation is None:
            return self._interior_magnitudes
        return self._magnitudes(power_rows(self._zeroth, self.terms, self.bounds.recursion(self.interval))[0])

    def _sum_beyond(self, distance: int) -> float:
        """Return the largest sum of P's magnitudes over the cells further away than ``distance``."""
        is_beyond = np.abs(np.arange(-self._outermost, self._outermost + 1)) > distance
        left_out = float(self._largest_magnitudes.sum(axis=1)[:, is_beyond].sum(axis=1).max())
        if self.chain.variation is None:
            return left_out
        # Rows are computed as if the cells beyond were the reference cell. What that changes in them is at most what is
        # left out, since its influence went there and back: sec. 8.
        return 2 * left_out

    @cached_property
    def reach(self) -> int:
        """Distance in cells beyond which the propagator's entries sum to less than half the tolerance."""
        return next(r for r in range(1, self._outermost + 1) if self._sum_beyond(r) <= self.tolerance / 2)

    @property
    def width(self) -> int:
        """How many cells the rows of a DoF span: its own, the reach on both sides, one more if forces join cells."""
        return 2 * self.reach + 1 + (self.spans_cells or self.chain.sites.join_cells)

    @cached_property
    def truncation(self) -> float:
        """Bound on the relative error of one step: entries left out and the remainder of the series."""
        within = slice(self._outermost - self.reach, self._outermost + self.reach + 1)
        dropped = np.where(self.interior() == 0.0, self._interior_magnitudes[:, :, within], 0.0)
        small = float(dropped.sum(axis=(1, 2)).max())
        return self._sum_beyond(self.reach) + small + self._remainder(self.terms)

    def power_rows(self, cells: ArrayLike) -> Iterator[np.ndarray]:
        """Yield rows (dof, term, dof, cell) of the masses of ``cells``, over all cells within ``_outermost`` of each.

        Near an end, cells beyond it get zeros. A cell whose reach ends before the end gets the rows that it would have
        in an endless chain, as all of a periodic chain do: its neighbours are numbered on beyond the last cell, and
        what it takes from them, beyond its reach, is left out in the end. Rows are computed in batches, and do not
        depend on which cells a batch holds.
        """
        cells = np.asarray(cells, np.int64)
        if len(cells) <= KEPT:
            for cell in cells.tolist():
                yield self._kept_rows(cell)
        else:
            yield from self._compute_rows(cells)

    @cached_property
    def _kept_rows(self) -> Callable[[int], np.ndarray]:
        """The rows of a cell, of which the last ``KEPT`` are kept; nobody may write to them."""

        def compute(cell: int) -> np.ndarray:
            (rows,) = self._compute_rows(np.array([cell]))
            rows.flags.writeable = False
            return rows

        return lru_cache(maxsize=KEPT)(compute)

    def _compute_rows(self, cells: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the rows of each of ``cells``, see ``rows``."""
        distances = np.arange(-self._outermost, self._outermost + 1)
        for batch in np.split(cells, range(BATCH, len(cells), BATCH)):
            is_inside = self.chain.topology.neighbour(batch[:, None], distances) >= 0
            exists = is_inside | ~self.is_near_end(batch)[:, None]
            # One cell more than the reach: the spring that enters the leftmost cell is stored with the cell before.
            recursion = local_recursion(self.chain, self.interval, batch, exists, self.reach + 1)
            yield from power_rows(np.repeat(self._zeroth, len(batch), axis=0), self.terms, recursion)

    def cut(self, rows: np.ndarray, first: int, count: int) -> np.ndarray:
        """Return columns of ``count`` cells of ``rows`` (dof, term, dof, cell), from ``first`` after the row's own on.

        A ``first`` below 0 lies before it. Columns that ``rows`` do not have are zero.
        """
        # Padded by ``count`` on both sides, where the row's own cell has the column ``_outermost`` + ``count``.
        begin = first + self._outermost + count
        return np.pad(rows, [(0, 0), (0, 0), (0, 0), (count, count)])[..., begin : begin + count]

    def factors(self) -> np.ndarray:
        """Return the factors of powers of s, H^(k mod 2)/k!; with dashpots 1/k!, then H/k! of velocities."""
        h = self.interval
        powers = range(2 * self.terms)
        if self.is_damped:
            return np.array([h**i / factorial(k) for i in range(2) for k in powers])
        return np.array([h ** (k % 2) / factorial(k) for k in powers])

    def is_near_end(self, cells: ArrayLike) -> np.ndarray:
        """Return whether an end lies within the reach of each of ``cells``."""
        topology = self.chain.topology
        return np.asarray((topology.neighbour(cells, -self.reach) < 0) | (topology.neighbour(cells, self.reach) < 0))

    @cached_property
    def _differing_before(self) -> np.ndarray:
        """Entry i counts the cells before cell i - ``reach`` - 1 that differ from the reference cell.

        How many of a window of cells differ is then a difference of two entries.
        """
        near = self.reach + 1
        cells = self.chain.topology.neighbour(np.arange(-near, self.chain.cells + near))
        differs = self.chain.differs[np.maximum(cells, 0)] & (cells >= 0)
        return np.append(0, np.cumsum(differs))

    def is_interior(self, cells: ArrayLike) -> np.ndarray:
        """Return whether each of ``cells`` (cell,) is far from all that differs, (cell,): it has the interior's rows.

        No end of the lattice lies within its reach, and no cell that differs there or one further.
        """
        cells = np.asarray(cells, np.int64)
        is_far = ~self.is_near_end(cells)
        if self.chain.variation is None:
            return is_far
        window = 2 * (self.reach + 1) + 1
        return is_far & (self._differing_before[cells + window] == self._differing_before[cells])

    def representatives(self, cells: ArrayLike) -> np.ndarray:
        """Return the first of ``cells`` (cell,), counted from 0, that has the same rows as each of them, (cell,)."""
        cells = np.array(cells, np.int64)
        interior = self.is_interior(cells)
        cells[interior] = cells[interior][:1]

        # Rows near an end are like no others; elsewhere equal coefficients near a cell make equal rows.
        near = self.reach + 1
        first: dict[bytes, int] = {}
        for i in np.flatnonzero(~interior & ~self.is_near_end(cells)):
            coefficients = self.chain.coefficients(cells[i] - near, cells[i] + near + 1)
            key = b"".join(array.tobytes() for array in coefficients)
            cells[i] = first.setdefault(key, int(cells[i]))
        return cells

    def own_rows(self) -> tuple[int, int]:
        """Return how many cells do not share the interior's rows, those near an end too, and how many tables they need.

        (0, 0) in a lattice in which no cell differs.
        """
        if self.chain.variation is None:
            return 0, 0
        cells = np.arange(self.chain.cells)
        differing = cells[~self.is_interior(cells)]
        return len(differing), len(np.unique(self.representatives(differing)))

    def stencil(self, rows: np.ndarray) -> np.ndarray:
        """Return P's rows (2 dof, 2 dof, cell), displacements before velocities, of masses with ``rows``.

        ``rows`` are (dof, term, dof, cell).
        """
        n = rows.shape[0]
        h = np.longdouble(self.interval)
        inverse = 1 / np.array([factorial(k) for k in range(2 * self.terms)], np.longdouble)
        p = np.zeros((2 * n, 2 * n, rows.shape[-1]), np.longdouble)

        # The velocity is the derivative by t: each coefficient times its power, one power lower, over H.
        # Not by ``is_damped``: where only cells that differ have dashpots, the interior's rows are those without.
        if rows.shape[1] > self.terms:
            p[:n] = np.einsum("m,imjc->ijc", inverse, rows)
            p[n:] = np.einsum("m,imjc->ijc", inverse[:-1], rows[:, 1:]) / h
            p[:, n:] *= h
        else:
            even = inverse[::2]
            odd = inverse[1::2]
            p[:n, :n] = np.einsum("m,imjc->ijc", even, rows)
            p[n:, n:] = p[:n, :n]
            p[:n, n:] = h * np.einsum("m,imjc->ijc", odd, rows)
            p[n:, :n] = np.einsum("m,imjc->ijc", odd[:-1], rows[:, 1:]) / h
        return p.astype(float)

    def interior(self) -> np.ndarray:
        """Return P's rows (2 dof, 2 dof, 2 reach + 1) of a cell ``reach`` or more from both ends."""
        is_large = self._interior_magnitudes > SMALL_ENTRY * self.tolerance
        entries = np.where(is_large, self.stencil(self._interior_rows), 0.0)
        return entries[:, :, self._outermost - self.reach : self._outermost + self.reach + 1]
