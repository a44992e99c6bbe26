"""Ranges of cells that a rank reads, of its own and of other ranks, fetched once a step."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from vipetsc.compiled import njit
from vipetsc.dynamics.layout import Layout


@njit(error_model="numpy")
def _gather(owned: np.ndarray, fetched: np.ndarray, sources: np.ndarray, out: np.ndarray) -> None:
    """Columns ``sources`` of ``owned`` and, numbered on behind them, of ``fetched`` into ``out``."""
    count = owned.shape[1]
    for i in range(out.shape[0]):
        for k in range(sources.size):
            c = sources[k]
            out[i, k] = owned[i, c] if c < count else fetched[i, c - count]


class HaloRegions:
    """Copies of ranges of cells side by side in ``columns`` (2 dof, column), displacements before velocities.

    ``add`` the ranges, call ``bind_columns`` once and ``fetch`` after every step. Cells beyond an end of a lattice
    that is not periodic are replaced by its last one.
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.cell_ranges: list[tuple[int, int]] = []
        self.columns = np.zeros((2 * layout.dofs, 0))
        self._scatter: PETSc.Scatter | None = None

    def add(self, first: int, count: int) -> int:
        """Add ``count`` cells from ``first`` on; returns the column of the first one."""
        self.cell_ranges.append((first, count))
        return sum(count for _, count in self.cell_ranges[:-1])

    def bind_columns(self) -> None:
        """Give every cell of the ranges its column and its source; all ranks must call it."""
        layout, rows = self.layout, 2 * self.layout.dofs
        ranges = [np.arange(first, first + count) for first, count in self.cell_ranges]
        cells = np.concatenate([np.zeros(0, int), *ranges])
        cells = cells % layout.cells if layout.periodic else np.clip(cells, 0, layout.cells - 1)
        owned = (cells >= layout.start) & (cells < layout.stop)
        others = np.unique(cells[~owned])
        self._sources = np.where(owned, cells - layout.start, layout.owned + np.searchsorted(others, cells))
        self.columns = np.zeros((rows, len(cells)))
        self._fetched = np.zeros((rows, len(others)))
        if layout.comm.allreduce(len(others)):
            # By component, as the rows of ``_fetched`` are.
            indices = np.array([layout.state_indices(int(cell)) for cell in others], PETSc.IntType)
            wanted = PETSc.IS().createGeneral(indices.reshape(-1, rows).T.ravel(), comm=layout.comm)
            self._vector = PETSc.Vec().createWithArray(self._fetched, comm=PETSc.COMM_SELF)
            like = layout.create_vector()
            self._scatter = PETSc.Scatter().create(like, wanted, self._vector, None)
            like.destroy()
            wanted.destroy()

    def fetch(self, state: PETSc.Vec, owned: np.ndarray) -> None:
        """Bring the columns up to date with ``state``, whose own cells are ``owned`` (2 dof, cell); collective."""
        if self._scatter is not None:
            self._scatter.scatter(state, self._vector, PETSc.InsertMode.INSERT_VALUES)
        _gather(owned, self._fetched, self._sources, self.columns)

    def destroy(self) -> None:
        """Free the PETSc objects."""
        if self._scatter is not None:
            self._scatter.destroy()
            self._vector.destroy()
