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

    Owned cells in the ranges ``interior`` (range, 2), half open, see only owned ones, far from the ends and from cells
    that differ: output rows are summed four at a time, ``blocks`` (block, 4), of which one may be there twice. The
    terms of block b are ``starts[b]`` to ``starts[b + 1]``: ``values`` (term, 4) times the row ``rows`` at the cell
    ``offsets`` away. ``borders`` (table, 2 dof, 2 reach + 1, 2 dof) are dense rows of the other cells; ``border_cells``
    (cell, 3) has the halo's first column for each, the owned cell that it is and its table.
    """

    interior: np.ndarray
    blocks: np.ndarray
    starts: np.ndarray
    rows: np.ndarray
    offsets: np.ndarray
    values: np.ndarray
    borders: np.ndarray
    border_cells: np.ndarray


def create_stencil(series: StepSeries, layout: Layout, halo: HaloRegions) -> Stencil:
    """P(H) on the cells of ``layout``; adds to ``halo`` what borders, ends and cells that differ need around them."""
    r, n, start, stop, entries = series.reach, layout.cells, layout.start, layout.stop, series.interior()
    first, last = (start, stop) if layout.periodic else (max(start, r), min(stop, n - r))
    inner = np.arange(first, max(first, last))
    interior = _ranges(series.is_interior(inner) & (inner >= start + r) & (inner < stop - r), first)
    interior = interior[interior @ [-1, 1] >= LANES]
    is_border, columns = np.ones(len(inner), bool), [np.zeros(0, np.int64)]
    for a, b in interior - first:
        is_border[a:b] = False
    for a, b in _ranges(is_border, first).tolist():
        columns.append(int(halo.add(a - r, b - a + 2 * r)) + np.arange(b - a))
    ends = []
    for begin, a, b in ((0, start, min(stop, first)), (n - 2 * r, max(start, last), stop)):
        columns.append(np.repeat(halo.add(begin, 2 * r + 1 if a < b else 0), max(b - a, 0)))
        ends += [(begin, cell) for cell in range(a, b)]
    borders, table = _dense_rows(series, inner[is_border], ends)
    cells = np.append(inner[is_border], [cell for _, cell in ends]).astype(np.int64)
    # A mass's displacement and velocity together: they read almost the same cells.
    masses = np.minimum(np.arange(layout.dofs + layout.dofs % 2), layout.dofs - 1)
    blocks = np.column_stack([masses, masses + layout.dofs]).reshape(-1, 4)
    terms = [np.nonzero(entries[block].any(axis=0)) for block in blocks]
    rows, offsets = np.hstack(terms)
    return Stencil(
        interior - start,
        blocks,
        np.cumsum([0, *(len(of_block) for of_block, _ in terms)]),
        rows,
        offsets - r,
        np.hstack([entries[block][:, *term] for block, term in zip(blocks, terms, strict=True)]).T.copy(),
        borders,
        np.column_stack([np.concatenate(columns), cells - start, table]),
    )


def _ranges(is_in: np.ndarray, first: int) -> np.ndarray:
    """Ranges (range, 2), half open, of the numbers from ``first`` on that are in."""
    return np.flatnonzero(np.diff(np.concatenate([[False], is_in, [False]]))).reshape(-1, 2) + first


def _dense_rows(series: StepSeries, cells: np.ndarray, ends: list[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """Tables of P's rows (table, 2 dof, 2 reach + 1, 2 dof) and which of them is that of each cell.

    ``cells`` have the cells around them, ``ends`` are (first cell of those it has, cell).
    """
    r, d = series.reach, series.chain.cell.dofs
    examples, table = np.unique(series.like(cells), return_inverse=True)
    tables = np.zeros((len(examples) + len(ends), 2 * d, 2 * r + 1, 2 * d))
    is_shared = series.is_interior(examples)
    tables[: len(examples)][is_shared] = series.interior().transpose(1, 2, 0)
    for i, rows in zip(np.flatnonzero(~is_shared), series.rows(examples[~is_shared]), strict=True):
        tables[i] = series.stencil(series.cut(rows, -r, 2 * r + 1)).transpose(1, 2, 0)
    for i, rows in enumerate(series.rows([cell for _, cell in ends])):
        begin, cell = ends[i]
        tables[len(examples) + i, :, : 2 * r] = series.stencil(series.cut(rows, begin - cell, 2 * r)).transpose(1, 2, 0)
    return tables, np.append(table, len(examples) + np.arange(len(ends)))


@njit(error_model="numpy")
def apply_propagator(stencil: Stencil, state: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
    """``out`` (2 dof, owned cell) = P(H) times the lattice's ``state``, whose halo is ``columns``."""
    cells, x, y, values = state.shape[1], state.reshape(-1), out.reshape(-1), stencil.values
    to, places = stencil.blocks * cells, stencil.rows * cells + stencil.offsets
    for first, stop in stencil.interior:
        for a in range(first, stop, LANES):
            # The last vector overlaps the one before.
            i = min(a, stop - LANES)
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
    for column, at, table in stencil.border_cells:
        rows = stencil.borders[table]
        total[:] = 0.0
        for row in range(rows.shape[0]):
            for k in range(rows.shape[1]):
                for o in range(total.size):
                    total[o] += columns[row, column + k] * rows[row, k, o]
        out[:, at] = total
