"""P(H) on a rank's cells, and the cells of this and other ranks that a step reads.

The exact step of the linear lattice is the product of its state with the banded matrix P(H) (sec. 1 of the derivation
in the package's docstring). Far from ends and from cells that differ all cells have the same rows of P, one stencil,
which runs over consecutive cells in vectors of the processor; the others have dense rows of their own (sec. 8). What a
rank's rows read of other ranks comes with one exchange a step, into the columns of a ``Halo`` (sec. 6). States are
arrays (2 dof, cell), displacements before velocities. Every sum runs in an order that depends on the cell alone, so
that results have the same bits on any partition.
"""

from collections.abc import Sequence
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.compiled import kernel
from vipetsc.dynamics import native
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.records import Record

# Fewest consecutive cells for which the stencil is used, one vector of the processor.
SHORTEST = 8
# Most cells that it runs over at a time: four sums of each, and what they read, stay in the processor's first cache.
CHUNK = 320


class HaloRegions:
    """Ranges of cells that a rank reads, its own and those of other ranks, to be copied side by side.

    ``add`` the ranges and call ``bind_columns`` once; ``exchange`` then fills the columns of its ``Halo``. Cells beyond
    an end of the lattice are replaced by its last one.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._ranges: list[np.ndarray] = [np.zeros(0, np.int64)]
        self._count = 0

    def add(self, firsts: ArrayLike, count: int) -> np.ndarray:
        """Add ``count`` cells from each of ``firsts`` (...) on; returns the columns (...) at which they begin."""
        firsts = np.asarray(firsts, np.int64)
        self._ranges.append(np.add.outer(firsts, np.arange(count)).ravel())
        columns = self._count + count * np.arange(firsts.size).reshape(firsts.shape)
        self._count += count * firsts.size
        return columns

    def bind_columns(self, states: Sequence[PETSc.Vec]) -> Record:
        """Return the columns of all ranges, to be filled from one of the ``states``; all ranks must call it."""
        layout = self._layout
        wanted = np.concatenate(self._ranges)
        cells = layout.topology.neighbour(wanted)
        cells = np.where(cells < 0, np.clip(wanted, 0, layout.cells - 1), cells)
        columns = np.zeros((2 * layout.dofs, len(cells)))

        # One rank has all cells in memory and copies them; its handles stay 0.
        scatter = 0
        vector = 0
        if layout.comm.size > 1:
            self._vector = PETSc.Vec().createWithArray(columns, comm=PETSc.COMM_SELF)
            # By component, as the rows of ``columns`` are.
            indices = PETSc.IS().createGeneral(layout.state_indices(cells).T.ravel(), comm=layout.comm)
            self._scatter = PETSc.Scatter().create(states[0], indices, self._vector, None)
            indices.destroy()
            scatter = self._scatter.handle
            vector = self._vector.handle
        native.bind_symbols()
        handles = np.array([state.handle for state in states], np.int64)
        return Record(Halo(columns=columns, cells=cells, scatter=scatter, vector=vector, states=handles))

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


@kernel
def exchange(halo: Halo, which: int, state: np.ndarray) -> int:
    """Bring the columns up to date with the owned cells ``state`` (2 dof, cell) of the state ``which``; collective.

    Returns PETSc's error code.
    """
    if halo.scatter != 0:
        insert = native.INSERT_VALUES
        forward = native.FORWARD
        error = native.scatter_begin(halo.scatter, halo.states[which], halo.vector, insert, forward)
        return error or native.scatter_end(halo.scatter, halo.states[which], halo.vector, insert, forward)
    for row in range(state.shape[0]):
        for column in range(halo.cells.size):
            halo.columns[row, column] = state[row, halo.cells[column]]
    return 0


class Stencil(NamedTuple):
    """P(H) on the cells of one rank, as ``apply_propagator`` reads it.

    Owned cells in the ranges ``interior`` (range, 2), half open, read only owned ones, far from the ends and from cells
    that differ: output rows are summed four at a time. For cell 0, and with the state as one row of numbers, the
    outputs of block b go to the places ``blocks`` (block, 4). Two that are there twice have a negative place: their
    second sums go to ``spare`` (4, cell), since sums that are formed together must not be the same numbers. The terms
    of block b, ``starts[b]`` to ``starts[b + 1]``, a multiple of four, are ``values`` (term, 4) times the numbers at
    ``places`` (term,). Cell i is i places further.

    ``borders`` (table, 2 dof, 2 reach + 1, output) are dense rows of the other cells, with zeros for more outputs than
    2 dof up to a multiple of four; ``border_cells`` (cell, 3) has the halo's first column for each, the owned cell that
    it is and its table. ``total`` (output,) is workspace for one of them.
    """

    interior: np.ndarray
    blocks: np.ndarray
    starts: np.ndarray
    places: np.ndarray
    values: np.ndarray
    spare: np.ndarray
    borders: np.ndarray
    border_cells: np.ndarray
    total: np.ndarray


def create_stencil(series: StepSeries, layout: Layout, halo: HaloRegions) -> Record:
    """Create P(H) on the cells of ``layout``; adds to ``halo`` the cells that dense rows read."""
    reach = series.reach

    # Cells whose stencil stays among the rank's own.
    cells = np.arange(layout.start, layout.stop)
    is_own = (cells >= layout.start + reach) & (cells < layout.stop - reach)
    interior = ranges_of(series.is_interior(cells) & is_own, layout.start)
    # Shorter ranges are left to the dense rows, which take less time for them.
    interior = interior[interior @ [-1, 1] >= SHORTEST]

    # Consecutive dense cells have one part of the halo in common.
    is_dense = np.ones(len(cells), bool)
    for start, stop in interior - layout.start:
        is_dense[start:stop] = False
    columns = [np.zeros(0, np.int64)]
    for start, stop in ranges_of(is_dense, layout.start).tolist():
        columns.append(int(halo.add(start - reach, stop - start + 2 * reach)) + np.arange(stop - start))

    dense = cells[is_dense]
    borders, table = _dense_rows(series, dense)
    stencil = Stencil(
        interior=interior - layout.start,
        **_sparse_rows(series.interior(), layout, reach),
        spare=np.empty((4, CHUNK)),
        borders=borders,
        border_cells=np.column_stack([np.concatenate(columns), dense - layout.start, table]),
        total=np.zeros(borders.shape[3]),
    )
    return Record(stencil)


def _sparse_rows(entries: np.ndarray, layout: Layout, reach: int) -> dict[str, np.ndarray]:
    """Return ``blocks``, ``starts``, ``places`` and ``values`` of a ``Stencil``.

    ``entries`` (2 dof, 2 dof, cell) are rows of an interior cell, from ``-reach`` on.
    """
    # Two masses a block, each with its displacement and its velocity: these read almost the same cells. Where the
    # number of masses is odd, the last one is there twice, and its second copy has no place.
    dofs = layout.dofs
    masses = np.minimum(np.arange(dofs + dofs % 2), dofs - 1)
    blocks = np.column_stack([masses, masses + dofs]).reshape(-1, 4)

    starts = [0]
    places = []
    values = []
    for block in blocks:
        row, column = np.nonzero(entries[block].any(axis=0))
        # Up to a multiple of four, the last number is read again, times zero.
        extra = -len(row) % 4
        starts.append(starts[-1] + len(row) + extra)
        places.append(np.pad(row * layout.owned + column - reach, (0, extra), mode="edge"))
        values.append(np.pad(entries[block][:, row, column].T, [(0, extra), (0, 0)]))
    to = blocks * layout.owned
    if dofs % 2:
        to[-1, 2:] = -1
    return {
        "blocks": to,
        "starts": np.array(starts),
        "places": np.concatenate(places),
        "values": np.concatenate(values),
    }


def ranges_of(is_in: np.ndarray, first: int) -> np.ndarray:
    """Return ranges (range, 2), half open, of the numbers from ``first`` on that are in."""
    return np.flatnonzero(np.diff(np.concatenate([[False], is_in, [False]]))).reshape(-1, 2) + first


def _dense_rows(series: StepSeries, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tables of P's rows, as ``Stencil.borders`` are, and which of them is that of each of ``cells`` (cell,)."""
    reach = series.reach
    outputs = 2 * series.chain.cell.dofs
    band = 2 * reach + 1
    examples, table = np.unique(series.representatives(cells), return_inverse=True)
    tables = np.zeros((len(examples), outputs, band, outputs + -outputs % 4))

    # Columns before rows: the sums of ``apply_propagator`` run over one cell's outputs at a time.
    is_shared = series.is_interior(examples)
    tables[is_shared, :, :, :outputs] = series.interior().transpose(1, 2, 0)
    for i, rows in zip(np.flatnonzero(~is_shared), series.power_rows(examples[~is_shared]), strict=True):
        tables[i, :, :, :outputs] = series.stencil(series.cut(rows, -reach, band)).transpose(1, 2, 0)
    return tables, table


@kernel
def _add_terms(
    x: np.ndarray,
    places: np.ndarray,
    values: np.ndarray,
    begin: int,
    sum0: np.ndarray,
    sum1: np.ndarray,
    sum2: np.ndarray,
    sum3: np.ndarray,
) -> None:
    """Put the sum of ``values`` (term, 4) times ``x`` at ``places`` (term,) + ``begin`` into four sums (cell,).

    There is a multiple of four terms, which are added in their order. Cell i has its ``x`` i places further.
    """
    # Indices without a sign: numba counts negative ones from the end, and would ask for the sign in each loop.
    cells = np.uint64(sum0.size)
    sum0[:] = 0.0
    sum1[:] = 0.0
    sum2[:] = 0.0
    sum3[:] = 0.0

    # Four terms of four sums at a time: a number is read once for all sums, a sum once for all terms. The factors have
    # names, not an array, so that they stay in the processor's registers.
    for t in range(0, places.size, 4):
        a = np.uint64(places[t] + begin)
        a0 = values[t, 0]
        a1 = values[t, 1]
        a2 = values[t, 2]
        a3 = values[t, 3]

        b = np.uint64(places[t + 1] + begin)
        b0 = values[t + 1, 0]
        b1 = values[t + 1, 1]
        b2 = values[t + 1, 2]
        b3 = values[t + 1, 3]

        c = np.uint64(places[t + 2] + begin)
        c0 = values[t + 2, 0]
        c1 = values[t + 2, 1]
        c2 = values[t + 2, 2]
        c3 = values[t + 2, 3]

        d = np.uint64(places[t + 3] + begin)
        d0 = values[t + 3, 0]
        d1 = values[t + 3, 1]
        d2 = values[t + 3, 2]
        d3 = values[t + 3, 3]

        for i in range(cells):
            xa = x[a + i]
            xb = x[b + i]
            xc = x[c + i]
            xd = x[d + i]
            sum0[i] = sum0[i] + a0 * xa + b0 * xb + c0 * xc + d0 * xd
            sum1[i] = sum1[i] + a1 * xa + b1 * xb + c1 * xc + d1 * xd
            sum2[i] = sum2[i] + a2 * xa + b2 * xb + c2 * xc + d2 * xd
            sum3[i] = sum3[i] + a3 * xa + b3 * xb + c3 * xc + d3 * xd


@kernel
def _output(y: np.ndarray, place: int, begin: int, size: int, spare: np.ndarray) -> np.ndarray:
    """Return ``size`` outputs of ``y`` from ``place`` + ``begin`` on; of ``spare`` for an output without a place."""
    if place < 0:
        return spare[:size]
    return y[place + begin :][:size]


@kernel
def apply_propagator(stencil: Stencil, state: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
    """Put P(H) times the lattice's ``state``, whose halo is ``columns``, into ``out`` (2 dof, owned cell)."""
    # On flat arrays, in which row r of cell i is at r cells + i.
    x = state.reshape(-1)
    y = out.reshape(-1)
    to = stencil.blocks
    places = stencil.places
    values = stencil.values

    # So many neighbouring cells at once: all have the same rows of P.
    for first, stop in stencil.interior:
        # Parts of equal size, in whole vectors if the cells suffice; the last one may overlap the one before.
        count = stop - first
        parts = (count + CHUNK - 1) // CHUNK
        size = (count + parts - 1) // parts
        size = min((size + SHORTEST - 1) // SHORTEST * SHORTEST, count)
        for part in range(parts):
            begin = min(first + part * size, stop - size)
            for b in range(to.shape[0]):
                terms = slice(stencil.starts[b], stencil.starts[b + 1])
                _add_terms(
                    x,
                    places[terms],
                    values[terms],
                    begin,
                    _output(y, to[b, 0], begin, size, stencil.spare[0]),
                    _output(y, to[b, 1], begin, size, stencil.spare[1]),
                    _output(y, to[b, 2], begin, size, stencil.spare[2]),
                    _output(y, to[b, 3], begin, size, stencil.spare[3]),
                )

    for column, cell, table in stencil.border_cells:
        multiply_dense(stencil.borders[table], columns, column, stencil.total)
        for output in range(out.shape[0]):
            out[output, cell] = stencil.total[output]


@kernel
def multiply_dense(rows: np.ndarray, columns: np.ndarray, column: int, total: np.ndarray) -> None:
    """Put the dense ``rows`` (2 dof, cell, output) times the halo's ``columns`` from ``column`` on into ``total``.

    ``total`` (output,) has a multiple of four numbers.
    """
    for output in range(0, total.size, 4):
        # Names, not an array: the sums stay in registers.
        sum0 = 0.0
        sum1 = 0.0
        sum2 = 0.0
        sum3 = 0.0
        for row in range(rows.shape[0]):
            for k in range(rows.shape[1]):
                x = columns[row, column + k]
                sum0 += x * rows[row, k, output]
                sum1 += x * rows[row, k, output + 1]
                sum2 += x * rows[row, k, output + 2]
                sum3 += x * rows[row, k, output + 3]
        total[output] = sum0
        total[output + 1] = sum1
        total[output + 2] = sum2
        total[output + 3] = sum3
