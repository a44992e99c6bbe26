"""A lattice of the plane: its cell, its bands, and the wide cell of a strip that is cut out of it.

Cell (i, j) lies at i a_1 + j a_2. A spring K of the direction n joins mass p of a cell to mass q of the cell (i, j)
further. In a wave with the phases k_1, k_2 from cell to cell it pulls at p with K n n^T (U_p - U_q exp(i k . (i, j)));
for motion out of the plane n n^T is 1. Such rows make up the dynamical matrix of the wave vector (k_1, k_2).

A strip of ``rows`` cells side by side along a_2 **is** a chain of wide cells along a_1: a spring of the plane is one
within a wide cell or to the next one. Mass s of row j has the number (j - 1) d + s in it, both from 1. In the plane
a mass moves in two directions, x and y, which are two degrees of freedom one after the other; there the matrix
K n n^T of a spring is one of scalar springs, some of them negative (``vipetsc.lattice.cell``).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from vipetsc.lattice.cell import GROUND, Spring

Edges = Literal["free", "fixed", "periodic"]
Vector = tuple[float, float]

# Sums of stiffnesses that are smaller than this times their terms are rounding.
ROUNDING = 1e-12


@dataclass(frozen=True)
class PlaneSpring:
    """A spring from mass ``start`` (0-based; ``GROUND``) to mass ``end`` of the cell ``offset`` (i, j) further.

    ``direction`` (x, y) is its unit vector, of which motion in the plane asks. The other numbers are those of
    ``Spring``.
    """

    start: int
    end: int
    stiffness: float
    offset: tuple[int, int] = (0, 0)
    direction: Vector = (1.0, 0.0)
    damping: float = 0.0
    quadratic: float = 0.0
    cubic: float = 0.0


@dataclass(frozen=True)
class PlaneCell:
    """``masses`` in kg, ``springs``, the vectors a_1 and a_2, and the ``positions`` of the masses in the cell.

    ``in_plane``: masses move along x and y, instead of out of the plane. Lengths are in any unit.
    """

    masses: tuple[float, ...]
    springs: tuple[PlaneSpring, ...]
    vectors: tuple[Vector, Vector] = ((1.0, 0.0), (0.0, 1.0))
    positions: tuple[Vector, ...] = ((0.0, 0.0),)
    in_plane: bool = False

    @property
    def components(self) -> int:
        """Number of directions in which a mass moves."""
        return 2 if self.in_plane else 1

    @property
    def dofs(self) -> int:
        """Number of degrees of freedom of the cell."""
        return self.components * len(self.masses)

    def frequencies(self, k1: ArrayLike, k2: ArrayLike) -> np.ndarray:
        """Return the angular frequencies (..., dofs) in rad/s of waves with phases ``k1``, ``k2`` (...) in rad/cell."""
        return np.sqrt(np.maximum(np.linalg.eigvalsh(self._dynamical(k1, k2)), 0.0))

    def waves(self, k1: ArrayLike, k2: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return frequencies as ``frequencies`` does, and shapes (..., dofs, branch) of the amplitudes M^(1/2) U."""
        squared, shapes = np.linalg.eigh(self._dynamical(k1, k2))
        return np.sqrt(np.maximum(squared, 0.0)), shapes

    @property
    def roots(self) -> np.ndarray:
        """Roots of the masses (dofs,) in kg^(1/2) of the degrees of freedom."""
        return np.sqrt(np.repeat(self.masses, self.components))

    def _dynamical(self, k1: ArrayLike, k2: ArrayLike) -> np.ndarray:
        """Return the dynamical matrix (..., dofs, dofs) in (rad/s)^2 at the phases ``k1`` and ``k2`` (...)."""
        k1, k2 = np.broadcast_arrays(np.asarray(k1, float), np.asarray(k2, float))
        matrix = np.zeros((*k1.shape, self.dofs, self.dofs), complex)
        for spring in self.springs:
            block = spring.stiffness * self._projector(spring)
            end = self._place(spring.end)
            matrix[..., end, end] += block
            if spring.start == GROUND:
                continue
            start = self._place(spring.start)
            phase = np.exp(1j * (k1 * spring.offset[0] + k2 * spring.offset[1]))[..., None, None]
            matrix[..., start, start] += block
            matrix[..., start, end] -= block * phase
            matrix[..., end, start] -= block * phase.conj()
        root = 1 / self.roots
        return np.asarray(matrix * (root[:, None] * root))

    def across(self, shapes: np.ndarray, kappa: ArrayLike, edges: Edges) -> np.ndarray:
        """Return the wave number (..., branch) in rad/row across a strip that has most of the energy of each wave.

        ``shapes`` (..., dof of the wide cell, branch) are amplitudes M^(1/2) U of waves along the strip with the phases
        ``kappa`` (...) in rad/cell. Between free edges there are n half-waves on the rows, n = 0, 1, ..., between fixed
        ones on the rows and one more.
        """
        rows = shapes.shape[-2] // self.dofs
        fields = shapes.reshape(*shapes.shape[:-2], rows, self.dofs, shapes.shape[-1])
        # Along a_2 the lattice may lean: what is a standing wave between two edges has a phase from row to row.
        (x1, y1), (x2, y2) = self.vectors
        lean = (x1 * x2 + y1 * y2) / (x1**2 + y1**2)
        phase = np.asarray(kappa, float)[..., None] * lean * np.arange(rows)
        standing = fields * np.exp(-1j * phase)[..., None, None]
        if edges == "periodic":
            waves = 2 * np.pi * np.abs(fft.fftfreq(rows))
            parts = fft.fft(fields, axis=-3)
        elif edges == "free":
            waves = np.pi * np.arange(rows) / rows
            parts = fft.dct(standing, axis=-3, norm="ortho")
        else:
            waves = np.pi * np.arange(1, rows + 1) / (rows + 1)
            parts = fft.dst(standing, type=1, axis=-3, norm="ortho")
        energy = np.sum(np.abs(parts) ** 2, axis=-2)
        return np.asarray(waves[energy.argmax(axis=-2)])

    def wide_masses(self, rows: int) -> list[float]:
        """Return the masses (rows dofs,) in kg of the wide cell, in the order of its degrees of freedom."""
        return np.tile(np.repeat(self.masses, self.components), rows).tolist()

    def wide_springs(self, rows: int, edges: Edges) -> list[Spring]:
        """Return the springs of the wide cell of ``rows`` cells between two ``edges``.

        Free edges cut the springs that cross them, fixed ones hold these, periodic ones join the last row to the first.
        """
        springs = [spring for _, _, parts in self._all_wide(rows, edges) for spring in parts]
        return self._merged(springs) if self.in_plane else springs

    def owners(self, rows: int, edges: Edges) -> list[tuple[int, int]]:
        """Return for each of ``wide_springs`` out of the plane its number in the cell and the row where it begins."""
        return [(number, row) for number, row, parts in self._all_wide(rows, edges) for _ in parts]

    def _all_wide(self, rows: int, edges: Edges) -> Iterator[tuple[int, int, list[Spring]]]:
        """Yield the number of each spring, the row where it begins, and the springs of the wide cell that it is."""
        for number, spring in enumerate(self.springs):
            across = spring.offset[1]
            for row in range(min(0, -across), max(rows, rows - across)):
                yield number, row, self._wide(spring, row, row + across, rows, edges)

    def _projector(self, spring: PlaneSpring) -> np.ndarray:
        """Return the matrix n n^T (components, components) of a spring; 1 out of the plane."""
        if not self.in_plane:
            return np.ones((1, 1))
        return np.outer(spring.direction, spring.direction)

    def _place(self, mass: int) -> slice:
        """Return the degrees of freedom of a ``mass`` in the cell."""
        return slice(self.components * mass, self.components * (mass + 1))

    def _wide(self, spring: PlaneSpring, row: int, other: int, rows: int, edges: Edges) -> list[Spring]:
        """Return the springs of the wide cell that a ``spring`` from ``row`` to ``other`` is; these may lie outside."""
        if edges == "periodic":
            # Each spring once, from the row in which it begins.
            if not 0 <= row < rows:
                return []
            other %= rows
        begins = 0 <= row < rows
        ends = 0 <= other < rows
        start = row * len(self.masses) + spring.start
        end = other * len(self.masses) + spring.end

        if spring.start == GROUND:
            return self._to_ground(spring, end)
        if begins and ends and spring.offset[0] < 0:
            return self._between(self._turned(spring), end, start, -spring.offset[0])
        if begins and ends:
            return self._between(spring, start, end, spring.offset[0])
        if edges == "fixed" and begins:
            return self._to_ground(self._turned(spring), start)
        if edges == "fixed" and ends:
            return self._to_ground(spring, end)
        return []

    @staticmethod
    def _turned(spring: PlaneSpring) -> PlaneSpring:
        """Return the numbers of a ``spring`` seen from its other end, from which its elongation has the other sign."""
        return replace(spring, start=spring.end, end=spring.start, quadratic=-spring.quadratic)

    def _between(self, spring: PlaneSpring, start: int, end: int, offset: int) -> list[Spring]:
        """Return the scalar springs between two masses of the wide cell, or of it and the next one (``offset`` 1)."""
        if start == end and not offset:
            return []  # a ring of one row joins a mass to itself
        if not self.in_plane:
            return [self._scalar(spring, start, end, 1.0, offset)]
        block = self._projector(spring)
        springs = []
        for a, b in np.argwhere(np.abs(block) > ROUNDING).tolist():
            springs.append(self._scalar(spring, 2 * start + a, 2 * end + b, block[a, b], offset))
        # The rows of K n n^T at each end: what couples x and y there.
        for mass in (start, end):
            springs.append(self._scalar(spring, 2 * mass, 2 * mass + 1, -block[0, 1], 0))
        return springs

    def _to_ground(self, spring: PlaneSpring, mass: int) -> list[Spring]:
        """Return the scalar springs of a mass whose spring is held at the other end."""
        if not self.in_plane:
            return [self._scalar(spring, GROUND, mass, 1.0, 0)]
        block = self._projector(spring)
        springs = [self._scalar(spring, GROUND, 2 * mass + a, block[a].sum(), 0) for a in range(2)]
        return [*springs, self._scalar(spring, 2 * mass, 2 * mass + 1, -block[0, 1], 0)]

    @staticmethod
    def _scalar(spring: PlaneSpring, start: int, end: int, factor: float, offset: int) -> Spring:
        """Return a spring of the wide cell with ``factor`` times the stiffness and the dashpot of a ``spring``."""
        return Spring(
            start=start,
            end=end,
            stiffness=factor * spring.stiffness,
            offset=offset,
            damping=factor * spring.damping,
            quadratic=spring.quadratic,
            cubic=spring.cubic,
        )

    @staticmethod
    def _merged(springs: list[Spring]) -> list[Spring]:
        """Return the sums of ``springs`` between the same degrees of freedom, without those that cancel."""
        sums: dict[tuple[int, int, int], list[Spring]] = {}
        for spring in springs:
            sums.setdefault((spring.start, spring.end, spring.offset), []).append(spring)
        merged = []
        for (start, end, offset), parts in sums.items():
            stiffness = sum(part.stiffness for part in parts)
            damping = sum(part.damping for part in parts)
            if abs(stiffness) > ROUNDING * sum(abs(part.stiffness) for part in parts):
                merged.append(Spring(start=start, end=end, stiffness=stiffness, offset=offset, damping=damping))
        return merged


def square(mass: float, stiffness: float, across: float) -> PlaneCell:
    """Return the square lattice of a ``mass`` in kg, with stiffnesses in N/m along a_1 and ``across``."""
    springs = PlaneSpring(0, 0, stiffness, (1, 0), (1.0, 0.0)), PlaneSpring(0, 0, across, (0, 1), (0.0, 1.0))
    return PlaneCell((mass,), springs)


TRIANGULAR: tuple[Vector, Vector] = ((1.0, 0.0), (0.5, np.sqrt(0.75)))
"""Vectors a_1 and a_2 of triangular and honeycomb lattices, at 60 degrees."""


def triangular(mass: float, stiffness: float, across: float) -> PlaneCell:
    """Return the triangular lattice, as ``square``; two of the three springs of a mass run ``across``."""
    half = np.sqrt(0.75)
    springs = (
        PlaneSpring(0, 0, stiffness, (1, 0), (1.0, 0.0)),
        PlaneSpring(0, 0, across, (0, 1), (0.5, half)),
        PlaneSpring(0, 0, across, (1, -1), (0.5, -half)),
    )
    return PlaneCell((mass,), springs, TRIANGULAR)


def honeycomb(mass: float, stiffness: float, across: float) -> PlaneCell:
    """Return the honeycomb lattice of two masses a cell, as ``square``; one of three springs goes to the next row."""
    # The second mass is as far from the first one as from those of the next cells along a_1 and along a_2.
    third = np.sqrt(1 / 12)
    springs = (
        PlaneSpring(0, 1, stiffness, (0, 0), (np.sqrt(0.75), 0.5)),
        PlaneSpring(1, 0, stiffness, (1, 0), (np.sqrt(0.75), -0.5)),
        PlaneSpring(1, 0, across, (0, 1), (0.0, 1.0)),
    )
    return PlaneCell((mass, mass), springs, TRIANGULAR, ((0.0, 0.0), (0.5, third)))


KINDS = {"square": square, "triangular": triangular, "honeycomb": honeycomb}
"""The lattices that have a name."""
