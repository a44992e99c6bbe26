"""Rows of the powers that free motion consists of, cell by cell: sec. 1, 7 and 8 of the derivation in the package."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vipetsc.lattice.chain import Chain
from vipetsc.lattice.variation import Coefficients

# Cells of a lattice that are looked at together.
CHUNK = 65_536
RowMap = Callable[[np.ndarray], np.ndarray]


class PowerRecursion(NamedTuple):
    """How rows (..., dof, cell) go on by one power: times - H^2 M^-1 K, times - H M^-1 C (None without dashpots)."""

    by_stiffness: RowMap
    by_damping: RowMap | None


def power_rows(first: np.ndarray, terms: int, turns: PowerRecursion) -> np.ndarray:
    """The rows (..., term, dof, cell) of ``terms`` powers from the zeroth, ``first`` (..., dof, cell), on.

    With dashpots (..., 2 term, 2 dof, cell): of each power of time, from displacements and from H times velocities.
    """
    by_stiffness, by_damping = turns
    if by_damping is None:
        rows = [first]
        while len(rows) < terms:
            rows.append(by_stiffness(rows[-1]))
        return np.stack(rows, axis=-3)
    pairs, p, q = [], first, np.zeros_like(first)
    for _ in range(2 * terms):
        pairs.append(np.concatenate((p, q), axis=-2))
        p, q = by_stiffness(q), p + by_damping(q)
    return np.stack(pairs, axis=-3)


def recursion_around(chain: Chain, interval: float, cells: np.ndarray, exists: np.ndarray, near: int) -> PowerRecursion:
    """Those of the cells around each of ``cells`` that ``exists`` (cell, around) tells of, for steps of ``interval``.

    Those further away than ``near`` are taken to be as the reference cell.
    """
    width, unit = exists.shape[1] // 2, Chain(chain.cell, 1).coefficients(-1, 0)
    around = [np.tile(array, (len(cells), exists.shape[1], 1)).astype(np.longdouble) for array in unit]
    near = min(near, width)
    for i, cell in enumerate(() if chain.variation is None else cells.tolist()):
        for array, varied in zip(around, chain.coefficients(cell - near, cell + near + 1), strict=True):
            array[i, width - near : width + near + 1] = varied
    # (cell, mass or spring, around)
    masses, grounding, stiffness, damping = Coefficients(*(array.swapaxes(1, 2) for array in around))
    masses, exists, h = masses[:, None], exists[:, None], np.longdouble(interval)
    # No power reaches the last cells: what is rolled past them is zero.
    acts = exists & np.roll(exists, -1, axis=-1) if chain.ends == "free" else np.ones_like(exists)

    def turn(values: np.ndarray, ground: np.ndarray | None) -> RowMap:
        def forces(rows: np.ndarray) -> np.ndarray:
            x = rows / masses
            out = np.zeros_like(rows) if ground is None else -ground * x
            for spring, value in zip(chain.cell.springs, values.swapaxes(0, 1)[:, :, None], strict=True):
                other = x[:, :, spring.end]
                pull = (np.roll(other, -1, axis=-1) if spring.next_cell else other) - x[:, :, spring.start]
                pull *= value * acts if spring.next_cell else value
                out[:, :, spring.start] += pull
                out[:, :, spring.end] -= np.roll(pull, 1, axis=-1) if spring.next_cell else pull
            return np.where(exists[:, :, None], out, 0)

        return forces

    by_damping = turn(h * damping, h * grounding[:, None]) if chain.is_damped else None
    return PowerRecursion(turn(h**2 * stiffness, None), by_damping)


class Bounds(NamedTuple):
    """What no cell of a lattice exceeds.

    ``frequency`` of a mode in rad/s and its ``damping``, a rate in 1/s, by Gershgorin's circles of M^-1/2 K M^-1/2 and
    of M^-1/2 C M^-1/2; the magnitudes of the entries of K M^-1 and C M^-1, ``by_stiffness`` and ``by_damping`` (3, dof,
    dof), where the other mass is in the cell before, in the same one, in the next one.
    """

    frequency: float
    damping: float
    by_stiffness: np.ndarray
    by_damping: np.ndarray

    @property
    def rate(self) -> float:
        """Norm in 1/s of what turns the state, in the norm of its energy."""
        return self.frequency if not self.damping else (self.damping + np.hypot(self.damping, 2 * self.frequency)) / 2

    def turns(self, interval: float) -> PowerRecursion:
        """Those of rows that are no smaller than the magnitudes of any cell's."""

        def turn(entries: np.ndarray) -> RowMap:
            return lambda rows: sum(entries[1 + o] @ np.roll(rows, -o, axis=-1) for o in (-1, 0, 1))

        by_damping = turn(interval * self.by_damping) if self.damping else None
        return PowerRecursion(turn(interval**2 * self.by_stiffness), by_damping)


def bounds_of(chain: Chain) -> Bounds:
    """The bounds of all cells of ``chain``."""
    if chain.variation is None:
        chain = Chain(chain.cell, 1)
    of_chunks = [_bounds(chain, at, min(at + CHUNK, chain.cells)) for at in range(0, chain.cells, CHUNK)]
    squared, rate, by_stiffness, by_damping = (np.max(part, axis=0) for part in zip(*of_chunks, strict=True))
    return Bounds(float(np.sqrt(squared)), float(rate), by_stiffness, by_damping)


def _bounds(chain: Chain, start: int, stop: int) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Those of the cells ``start`` to ``stop``, the first one squared."""
    masses, grounding, stiffness, damping = chain.coefficients(start - 1, stop + 1)
    root, n, circles, entries = (
        1 / np.sqrt(masses),
        stop - start,
        [],
        np.zeros((2, 3, chain.cell.dofs, chain.cell.dofs)),
    )
    for values, ground, passed in zip((stiffness, damping), (0 * grounding, grounding), entries, strict=True):
        diagonal = ground[1:-1] / masses[1:-1]
        rows = diagonal.copy()
        for mass, offset, other, _, _, spring in chain.cell.couplings():
            value, near = values[1 + min(offset, 0) :][:n, spring], slice(1 + offset, n + 1 + offset)
            rows[:, mass] += value * root[1:-1, mass] * (root[1:-1, mass] + root[near, other])
            diagonal[:, mass] += value / masses[1:-1, mass]
            passed[1 + offset, mass, other] += (value / masses[near, other]).max()
        passed[1] += np.diag(diagonal.max(axis=0))
        circles.append(float(rows.max()))
    return *circles, *entries
