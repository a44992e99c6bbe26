"""Stretches of cells that a rank reads, its own cells and other ranks', fetched once a step."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator import linear_kernel


class Patches:
    """Copies of stretches of cells side by side: ``columns`` (2 dof, column), displacements before velocities.

    Parameters
    ----------
    layout
        Who owns which cells.
    stretches
        Pairs (first cell, number of cells). Cells beyond an end of a lattice that is not periodic are replaced
        by its last one.

    ``starts`` holds each stretch's first column.
    """

    def __init__(self, layout: Layout, stretches: list[tuple[int, int]]) -> None:
        self.layout = layout
        ranges = [np.arange(first, first + count) for first, count in stretches]
        cells = np.concatenate(ranges) if ranges else np.zeros(0, int)
        cells = cells % layout.cells if layout.periodic else np.clip(cells, 0, layout.cells - 1)
        self.starts = np.concatenate([[0], np.cumsum([count for _, count in stretches])]).astype(int)[:-1]
        own = (cells >= layout.start) & (cells < layout.stop)
        others = np.unique(cells[~own])
        self._where = np.where(own, cells - layout.start, layout.owned + np.searchsorted(others, cells))
        self.columns = np.zeros((2 * layout.dofs, len(cells)))
        self._halo = np.zeros((2 * layout.dofs, len(others)))
        self._scatter: PETSc.Scatter | None = None
        self._objects: tuple = ()
        if layout.comm.allreduce(len(others)):
            found = [layout.state_indices(int(cell)) for cell in others]
            # By component, as the halo's rows are.
            indices = np.asarray(found, PETSc.IntType).reshape(-1, 2 * layout.dofs).T.ravel()
            wanted = PETSc.IS().createGeneral(indices, comm=layout.comm)
            self._fetched = PETSc.Vec().createWithArray(self._halo, comm=PETSc.COMM_SELF)
            like = layout.create_vector()
            self._scatter = PETSc.Scatter().create(like, wanted, self._fetched, None)
            like.destroy()
            wanted.destroy()
            self._objects = (self._scatter, self._fetched)

    def fetch(self, state: PETSc.Vec, owned: np.ndarray) -> None:
        """Bring the columns up to date with ``state``, whose own cells are ``owned`` (2 dof, cell).

        All ranks must call it.
        """
        if self._scatter is not None:
            self._scatter.scatter(state, self._fetched, PETSc.InsertMode.INSERT_VALUES)
        linear_kernel.gather(owned, self._halo, self._where, self.columns)

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for thing in self._objects:
            thing.destroy()
