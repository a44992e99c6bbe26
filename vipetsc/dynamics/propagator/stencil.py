"""P(H) on a rank's cells, and the cells of this and other ranks that a step reads.

One stencil serves the interior, rows of their own the cells near the lattice's ends. States are arrays (2 dof, cell),
displacements before velocities. Every sum runs in an order that depends on the cell alone, so that results have the
same bits on any partition.
"""

from collections.abc import Sequence
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.compiled import njit
from vipetsc.dynamics import native
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.vectors import LANES, add_product, prefetch, store, zeros


class HaloRegions:
    """Copies of ranges of cells that a rank reads, its own and those of other ranks, side by side.

    ``add`` the ranges and call ``bind_columns`` once; ``exchange`` then fills the columns of its ``Halo``. Cells beyond
    an end of a lattice that is not periodic are replaced by its last one.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._ranges: list[np.ndarray] = [np.zeros(0, np.int64)]
        self._count = 0

    def add(self, firsts: ArrayLike, count: int) -> np.ndarray:
        """Add ``count`` cells from each of ``firsts`` on; returns the columns of these, in the same shape."""
        firsts = np.asarray(firsts, np.int64)
        self._ranges.append(np.add.outer(firsts, np.arange(count)).ravel())
        columns = self._count + count * np.arange(firsts.size).reshape(firsts.shape)
        self._count += count * firsts.size
        return columns

    def bind_columns(self, states: Sequence[PETSc.Vec]) -> "Halo":
        """The columns of all ranges, to be filled from one of the ``states``; all ranks must call it."""
        layout, rows, cells = self._layout, 2 * self._layout.dofs, np.concatenate(self._ranges)
        cells = cells % layout.cells if layout.periodic else np.clip(cells, 0, layout.cells - 1)
        columns, scatter, vector = np.zeros((rows, len(cells))), 0, 0
        if layout.comm.size > 1:
            self._vector = PETSc.Vec().createWithArray(columns, comm=PETSc.COMM_SELF)
            # By component, as the rows of ``columns`` are.
            wanted = PETSc.IS().createGeneral(layout.state_indices(cells).T.ravel(), comm=layout.comm)
            self._scatter = PETSc.Scatter().create(states[0], wanted, self._vector, None)
            wanted.destroy()
            scatter, vector = self._scatter.handle, self._vector.handle
        native.bind_symbols()
        return Halo(columns, cells, scatter, vector, np.array([state.handle for state in states]))

    def destroy(self) -> None:
        """Free the PETSc objects."""
        if self._layout.comm.size > 1:
            self._scatter.destroy()
            self._vector.destroy()


class Halo(NamedTuple):
    """Copies ``columns`` (2 dof, column) of the ``cells`` (column,), for compiled code.

    ``scatter``, ``vector`` and ``states`` are handles of PETSc; without a ``scatter`` the rank owns all cells.
    """

    columns: np.ndarray
    cells: np.ndarray
    scatter: int
    vector: int
    states: np.ndarray


@njit(error_model="numpy")
def exchange(halo: Halo, which: int, state: np.ndarray) -> int:
    """Bring the columns up to date with the owned cells ``state`` (2 dof, cell) of the state ``which``; collective.

    Returns PETSc's error code.
    """
    if halo.scatter != 0:
        error = native.scatter_begin(halo.scatter, halo.states[which], halo.vector, 1, 0)
        return error or native.scatter_end(halo.scatter, halo.states[which], halo.vector, 1, 0)
    for row in range(state.shape[0]):
        for column in range(halo.cells.size):
            halo.columns[row, column] = state[row, halo.cells[column]]
    return 0


class Stencil(NamedTuple):
    """P(H) on the cells of one rank, as ``apply_propagator`` reads it.

    The ``interior`` owned cells from ``first`` on see only owned ones, far from the ends: output rows are summed four
    at a time, ``blocks`` (block, 4), of which one may be there twice. The terms of block b are ``starts[b]`` to
    ``starts[b + 1]``: ``values`` (term, 4) times the row ``rows`` at the cell ``offsets`` away. ``borders`` (cell,
    2 dof, 2 reach + 1, 2 dof) are dense rows of the other cells; ``border_cells`` (cell, 2) has the halo's first
    column for each and the owned cell that it is.
    """

    first: int
    interior: int
    blocks: np.ndarray
    starts: np.ndarray
    rows: np.ndarray
    offsets: np.ndarray
    values: np.ndarray
    borders: np.ndarray
    border_cells: np.ndarray


def create_stencil(series: StepSeries, layout: Layout, halo: HaloRegions) -> Stencil:
    """P(H) on the cells of ``layout``; adds to ``halo`` the cells around the rank's borders and at the ends."""
    r, n, start, stop, entries = series.reach, layout.cells, layout.start, layout.stop, series.interior()
    first, last = (start, stop) if layout.periodic else (max(start, r), min(stop, n - r))
    left, right = max(first, start + r), min(last, stop - r)
    if right - left < LANES:
        left = right = last
    borders, border_cells = [], []
    for a, b in ((first, left), (right, last)):
        at = int(halo.add(a - r, b - a + 2 * r if a < b else 0))
        borders += [entries.transpose(1, 2, 0)] * (b - a)
        border_cells += [(at + cell - a, cell - start) for cell in range(a, b)]
    for begin, a, b in ((0, start, min(stop, first)), (n - 2 * r, max(start, last), stop)):
        at = int(halo.add(begin, 2 * r + 1 if a < b else 0))
        of_cells = [series.stencil(series.rows(cell, begin, 2 * r)) for cell in range(a, b)]
        borders += [np.pad(rows, [(0, 0), (0, 0), (0, 1)]).transpose(1, 2, 0) for rows in of_cells]
        border_cells += [(at, cell - start) for cell in range(a, b)]
    # A mass's displacement and velocity together: they read almost the same cells.
    masses = np.minimum(np.arange(layout.dofs + layout.dofs % 2), layout.dofs - 1)
    blocks = np.column_stack([masses, masses + layout.dofs]).reshape(-1, 4)
    terms = [np.nonzero(entries[block].any(axis=0)) for block in blocks]
    rows, columns = np.hstack(terms)
    return Stencil(
        left - start,
        right - left,
        blocks,
        np.cumsum([0, *(len(of_block) for of_block, _ in terms)]),
        rows,
        columns - r,
        np.hstack([entries[block][:, *term] for block, term in zip(blocks, terms, strict=True)]).T.copy(),
        np.array(borders).reshape(-1, 2 * layout.dofs, 2 * r + 1, 2 * layout.dofs),
        np.array(border_cells, np.int64).reshape(-1, 2),
    )


@njit(error_model="numpy")
def apply_propagator(stencil: Stencil, state: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
    """``out`` (2 dof, owned cell) = P(H) times the lattice's ``state``, whose halo is ``columns``."""
    cells, x, y, values = state.shape[1], state.reshape(-1), out.reshape(-1), stencil.values
    to, places = stencil.blocks * cells, stencil.rows * cells + stencil.offsets
    for a in range(0, stencil.interior, LANES):
        # The last vector overlaps the one before.
        i = stencil.first + min(a, stencil.interior - LANES)
        for b in range(to.shape[0]):
            for k in range(4):
                prefetch(x, to[b, k] + i + 2 * LANES)
            sum0 = sum1 = sum2 = sum3 = zeros()
            for t in range(stencil.starts[b], stencil.starts[b + 1]):
                sum0 = add_product(sum0, values[t, 0], x, places[t] + i)
                sum1 = add_product(sum1, values[t, 1], x, places[t] + i)
                sum2 = add_product(sum2, values[t, 2], x, places[t] + i)
                sum3 = add_product(sum3, values[t, 3], x, places[t] + i)
            store(sum0, y, to[b, 0] + i)
            store(sum1, y, to[b, 1] + i)
            store(sum2, y, to[b, 2] + i)
            store(sum3, y, to[b, 3] + i)
    total = np.empty(out.shape[0])
    for cell in range(stencil.borders.shape[0]):
        rows, (column, at) = stencil.borders[cell], stencil.border_cells[cell]
        total[:] = 0.0
        for row in range(rows.shape[0]):
            for k in range(rows.shape[1]):
                for o in range(total.size):
                    total[o] += columns[row, column + k] * rows[row, k, o]
        out[:, at] = total
