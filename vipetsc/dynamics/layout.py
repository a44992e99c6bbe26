"""The partition of cells over ranks, the order of a rank's part of the state, and its ghosts.

A rank's part of the state holds, one after another: displacements by mass (all owned cells of mass 1, then of
mass 2, ...), velocities likewise, then its ledger components (work of the drive if it owns the driven cell,
dissipated energy of each owned site). Behind them lie the ghosts: displacements of the neighbouring cell on
the left, then on the right. Mass by mass keeps every inner loop contiguous.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Self

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from vipetsc.case import Model


@dataclass(frozen=True)
class Layout:
    """The share of a lattice that one rank owns: cells ``start`` to ``stop`` (0-based, half open)."""

    comm: MPI.Comm
    cells: int
    dofs: int
    start: int
    stop: int
    periodic: bool
    sites: tuple[int, ...]
    owns_drive: bool
    ranges: tuple[tuple[int, int], ...]
    offsets: tuple[int, ...]

    @classmethod
    def of(cls, model: Model, comm: MPI.Comm) -> Self:
        """Cells in equal blocks, the first ranks one more where they do not divide; a rank may be empty."""
        cells, dofs = model.chain.cells, model.chain.cell.dofs
        cuts = [r * (cells // comm.size) + min(r, cells % comm.size) for r in range(comm.size + 1)]
        ranges = tuple(pairwise(cuts))
        sizes = []
        for a, b in ranges:
            extras = (a <= model.drive_cell < b) + sum(a <= c < b for c in model.chain.sites)
            sizes.append(2 * dofs * (b - a) + extras)
        start, stop = ranges[comm.rank]
        return cls(
            comm=comm,
            cells=cells,
            dofs=dofs,
            start=start,
            stop=stop,
            periodic=model.chain.ends == "periodic",
            sites=tuple(i for i, c in enumerate(model.chain.sites) if start <= c < stop),
            owns_drive=start <= model.drive_cell < stop,
            ranges=ranges,
            offsets=tuple(int(x) for x in np.concatenate([[0], np.cumsum(sizes)])),
        )

    @property
    def owned(self) -> int:
        """Number of cells on this rank."""
        return self.stop - self.start

    @property
    def size(self) -> int:
        """Number of state components on this rank."""
        return self.offsets[self.comm.rank + 1] - self.offsets[self.comm.rank]

    @property
    def work(self) -> int:
        """Local index of the work of the drive, or -1 where another rank owns it."""
        return 2 * self.dofs * self.owned if self.owns_drive else -1

    @property
    def dissipated(self) -> int:
        """Local index of the first owned site's dissipated energy."""
        return 2 * self.dofs * self.owned + self.owns_drive

    def neighbours(self) -> tuple[int | None, int | None]:
        """Cells to the left and to the right of this rank's; None beyond an end, or on an empty rank."""
        if not self.owned:
            return None, None
        left, right = self.start - 1, self.stop
        if self.periodic:
            return left % self.cells, right % self.cells
        return (left if left >= 0 else None), (right if right < self.cells else None)

    def state_indices(self, cell: int) -> list[int]:
        """Global indices of the displacements and then of the velocities of ``cell``, mass by mass."""
        rank = next(r for r, (a, b) in enumerate(self.ranges) if a <= cell < b)
        a, b = self.ranges[rank]
        return [self.offsets[rank] + i * (b - a) + cell - a for i in range(2 * self.dofs)]

    def create_vector(self, array: np.ndarray | None = None) -> PETSc.Vec:
        """A zero state with ghosts for the neighbouring cells' displacements, in ``array`` if one is given."""
        cells = [cell for cell in self.neighbours() if cell is not None]
        indices = np.array([self.state_indices(cell)[: self.dofs] for cell in cells], PETSc.IntType).ravel()
        size = (self.size, PETSc.DETERMINE)
        if array is not None:
            return PETSc.Vec().createGhostWithArray(indices, array, size=size, comm=self.comm)
        vector = PETSc.Vec().createGhost(indices, size=size, comm=self.comm)
        vector.set(0.0)
        return vector
