"""Rows of the powers of which free motion consists: what a mass's Taylor coefficients take from the cells near it.

Let c be the row vector that picks a mass from all displacements u, and H the step in s. The term of order 2m of the
series of c u in t/H is c (-A)^m u/(2m)! with A = H^2 M^-1 K (sec. 1 of the derivation in the package's docstring): a
row c (-A)^m says what this term takes from every displacement. With dashpots the rows c P_k and c Q_k say what the term
of order k takes from displacements and from velocities times H (sec. 7). Rows are multiplied by one power after another
from the right, each time for many cells at once, and each time they grow by a cell on either side. Where cells differ
(sec. 8) every row takes the masses, springs and dashpots that lie near its own cell. ``Bounds`` has what no cell
exceeds: the largest frequency, from Gershgorin's circles, decides how many powers count, the largest entries how far
the rows reach.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from vipetsc.lattice.cell import GROUND
from vipetsc.lattice.chain import Chain
from vipetsc.lattice.topology import NOTHING
from vipetsc.lattice.variation import Coefficients

# Cells whose coefficients are looked at together, some MB: a lattice of millions is not copied as a whole.
CHUNK = 65_536
RowMap = Callable[[np.ndarray], np.ndarray]


class PowerRecursion(NamedTuple):
    """How rows (..., dof, cell) are multiplied: by - H^2 M^-1 K, and by - H M^-1 C (None without dashpots)."""

    by_stiffness: RowMap
    by_damping: RowMap | None


def power_rows(first: np.ndarray, terms: int, recursion: PowerRecursion) -> np.ndarray:
    """Return the rows (..., term, dof, cell) of ``terms`` powers from the zeroth, ``first`` (..., dof, cell), on.

    With dashpots (..., 2 term, 2 dof, cell): of each power of time, from displacements and from H times velocities.
    """
    by_stiffness, by_damping = recursion
    if by_damping is None:
        rows = [first]
        while len(rows) < terms:
            rows.append(by_stiffness(rows[-1]))
        return np.stack(rows, axis=-3)

    # P_(k+1) = -Q_k H^2 M^-1 K and Q_(k+1) = P_k - Q_k H M^-1 C, from P_0 = 1 and Q_0 = 0.
    pairs = []
    p = first
    q = np.zeros_like(first)
    for _ in range(2 * terms):
        pairs.append(np.concatenate((p, q), axis=-2))
        next_q = p + by_damping(q)
        p = by_stiffness(q)
        q = next_q
    return np.stack(pairs, axis=-3)


class _Neighbourhoods(NamedTuple):
    """Cells on either side of each of some cells: ``masses`` (cell, 1, dof, neighbour) in kg.

    ``exists`` (cell, 1, 1, neighbour) marks the neighbours that the lattice has, ``acts`` (cell, 1, neighbour) those
    whose springs to the next cell it has.
    """

    chain: Chain
    masses: np.ndarray
    exists: np.ndarray
    acts: np.ndarray


def local_recursion(chain: Chain, interval: float, cells: np.ndarray, exists: np.ndarray, near: int) -> PowerRecursion:
    """Return the recursion for rows of the masses of ``cells``, with the coefficients of cells on either side.

    ``exists`` (cell, neighbour), the cell itself in the middle, marks those that the lattice has; there must be more
    neighbours on either side than powers. Neighbours further away than ``near`` are taken to be as the reference cell,
    the one that the case describes before any cell is varied: sec. 8 bounds what that leaves out. The step is of
    ``interval`` in s.
    """
    width = exists.shape[1] // 2
    masses, grounding, stiffness, damping = _coefficients_near(chain, cells, width, min(near, width))

    # No power reaches the outermost neighbours: what np.roll carries across them is zero.
    acts = np.ones_like(exists)
    if chain.topology.neighbour(-1) == NOTHING:
        acts = exists & np.roll(exists, -1, axis=-1)
    neighbours = _Neighbourhoods(chain=chain, masses=masses[:, None], exists=exists[:, None, None], acts=acts[:, None])

    h = np.longdouble(interval)
    by_stiffness = partial(_multiply, neighbours, h**2 * stiffness, None)
    by_damping = None
    if chain.is_damped:
        by_damping = partial(_multiply, neighbours, h * damping, h * grounding[:, None])
    return PowerRecursion(by_stiffness, by_damping)


def _coefficients_near(chain: Chain, cells: np.ndarray, width: int, near: int) -> Coefficients:
    """Return coefficients (cell, mass or spring, neighbour) of ``width`` neighbours on both sides of ``cells``.

    They are those of the reference cell beyond the ``near`` ones. Grounding is that of dashpots to the ground. They
    have extended precision: the entries of P(H) are sums of high powers of them, must be good to double precision, and
    are used in every step.
    """
    # A chain without variation has the reference cell wherever it is asked, also beyond its ends.
    reference = Chain(chain.cell, 1).coefficients(-1, 0)
    shape = (len(cells), 2 * width + 1, 1)
    arrays: list[np.ndarray] = [np.tile(array, shape).astype(np.longdouble) for array in reference]

    if chain.variation is not None:
        for i, cell in enumerate(cells.tolist()):
            for array, varied in zip(arrays, chain.coefficients(cell - near, cell + near + 1), strict=True):
                array[i, width - near : width + near + 1] = varied
    return Coefficients(*(array.swapaxes(1, 2) for array in arrays))


def _multiply(
    neighbours: _Neighbourhoods, springs: np.ndarray, ground: np.ndarray | None, rows: np.ndarray
) -> np.ndarray:
    """Return ``rows`` (cell, row, dof, neighbour) times - M^-1 V, V of ``springs`` (cell, spring, neighbour).

    ``ground`` (cell, 1, dof, neighbour) is added to V's diagonal. V is symmetric: -x V is the force of the springs on
    masses that are displaced by the row x.
    """
    x = rows / neighbours.masses
    out = np.zeros_like(rows)
    if ground is not None:
        out = -ground * x
    for spring, value in zip(neighbours.chain.cell.springs, springs.swapaxes(0, 1)[:, :, None], strict=True):
        end = x[:, :, spring.end]
        if spring.start == GROUND:
            out[:, :, spring.end] -= end * value
            continue
        start = x[:, :, spring.start]
        if spring.offset:
            pull = (np.roll(end, -1, axis=-1) - start) * (value * neighbours.acts)
            out[:, :, spring.start] += pull
            out[:, :, spring.end] -= np.roll(pull, 1, axis=-1)
        else:
            pull = (end - start) * value
            out[:, :, spring.start] += pull
            out[:, :, spring.end] -= pull
    # Walls do not move: cells that do not exist take up nothing.
    return np.where(neighbours.exists, out, 0)


class Bounds(NamedTuple):
    """Bounds that no cell of a lattice exceeds.

    ``frequency`` of a mode in rad/s and its ``damping``, a rate in 1/s, are by Gershgorin's circles of M^-1/2 K M^-1/2
    and of M^-1/2 C M^-1/2. ``by_stiffness`` and ``by_damping`` (3, dof, dof) are the largest magnitudes in any cell of
    the entries of K M^-1 and C M^-1, where the other mass is in the cell before, in the same one, in the next one.
    These are the transposes of M^-1 K and M^-1 C, by which rows are multiplied as columns.
    """

    frequency: float
    damping: float
    by_stiffness: np.ndarray
    by_damping: np.ndarray

    @property
    def rate(self) -> float:
        """Bound in 1/s on the norm of the system's matrix in the norm of the state's energy: see sec. 7."""
        if not self.damping:
            return self.frequency
        return (self.damping + np.hypot(self.damping, 2 * self.frequency)) / 2

    def recursion(self, interval: float) -> PowerRecursion:
        """Return the recursion, for steps of ``interval`` in s, of rows at least as large as any cell's."""
        by_damping = None
        if self.damping:
            by_damping = partial(_multiply_magnitudes, interval * self.by_damping)
        return PowerRecursion(partial(_multiply_magnitudes, interval**2 * self.by_stiffness), by_damping)


def _multiply_magnitudes(entries: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return a matrix with ``entries`` (3, dof, dof) of ``Bounds`` in every cell, times ``rows`` (..., dof, cell)."""
    total = np.zeros_like(rows)
    for offset in (-1, 0, 1):
        total = total + entries[1 + offset] @ np.roll(rows, -offset, axis=-1)
    return total


def bounds_of(chain: Chain) -> Bounds:
    """Return the bounds of all cells of ``chain``."""
    # Without variation one cell has the bounds of all; at a free or fixed end a mass has no more springs than inside.
    if chain.variation is None:
        chain = Chain(chain.cell, 1)
    stiffness = []
    damping = []
    for start in range(0, chain.cells, CHUNK):
        stop = min(start + CHUNK, chain.cells)
        coefficients = chain.coefficients(start - 1, stop + 1)
        no_ground = np.zeros_like(coefficients.grounding)
        stiffness.append(_matrix_bounds(chain, coefficients.masses, coefficients.stiffness, no_ground))
        damping.append(_matrix_bounds(chain, coefficients.masses, coefficients.damping, coefficients.grounding))

    # Gershgorin's circles of M^-1/2 K M^-1/2 bound the square of the frequency.
    return Bounds(
        frequency=float(np.sqrt(max(circle for circle, _ in stiffness))),
        damping=max(circle for circle, _ in damping),
        by_stiffness=np.max([entries for _, entries in stiffness], axis=0),
        by_damping=np.max([entries for _, entries in damping], axis=0),
    )


def _matrix_bounds(
    chain: Chain, masses: np.ndarray, springs: np.ndarray, ground: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the largest circle of M^-1/2 V M^-1/2, and largest entries (3, dof, dof) of V M^-1 in magnitude.

    V is the matrix of ``springs`` (cell, spring), ``ground`` (cell, dof) on its diagonal; all arrays have one cell more
    on either side than are looked at.
    """
    cells = len(masses) - 2
    inner = slice(1, cells + 1)
    root = 1 / np.sqrt(masses)
    # Magnitudes, since a spring or a dashpot may be negative.
    diagonal = np.abs(ground[inner]) / masses[inner]
    circles = diagonal.copy()
    entries = np.zeros((3, chain.cell.dofs, chain.cell.dofs))
    for mass, offset, other, _, _, spring, _ in chain.cell.couplings():
        near = slice(1 + offset, cells + 1 + offset)
        # A spring to the cell before is stored with that cell.
        value = np.abs(springs[1 + min(offset, 0) :][:cells, spring])
        diagonal[:, mass] += value / masses[inner, mass]
        if other == GROUND:
            circles[:, mass] += value / masses[inner, mass]
            continue
        circles[:, mass] += value * root[inner, mass] * (root[inner, mass] + root[near, other])
        entries[1 + offset, mass, other] += (value / masses[near, other]).max()
    entries[1] += np.diag(diagonal.max(axis=0))
    return float(circles.max()), entries
