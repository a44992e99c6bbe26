"""P(H) on a rank's cells, and the cells of this and other ranks that a step reads.

One stencil serves the interior, rows of their own the cells near the lattice's ends. States are arrays (2 dof, cell),
displacements before velocities. Every sum runs in an order that depends on the cell alone, so that results have the
same bits on any partition.
"""

from typing import NamedTuple

from petsc4py import PETSc

import numpy as np

from vipetsc.compiled import njit
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.series import StepSeries

# Cells in one pass: what a pass reads stays in the first-level cache.
CHUNK = 512
# Terms that one pass over a chunk adds.
GROUP = 8


class HaloRegions:
    """Copies of ranges of cells that a rank reads, its own and those of other ranks, side by side.

    ``add`` the ranges and call ``bind_columns`` once; after every step, ``exchange`` fills ``columns`` (2 dof, column).
    Cells beyond an end of a lattice that is not periodic are replaced by its last one.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._ranges: list[np.ndarray] = [np.zeros(0, int)]

    def add(self, first: int, count: int) -> int:
        """Add ``count`` cells from ``first`` on; returns the column of the first one."""
        self._ranges.append(np.arange(first, first + count))
        return sum(map(len, self._ranges[:-1]))

    def bind_columns(self) -> None:
        """Give every cell of the ranges its column; all ranks must call it."""
        layout, rows, cells = self._layout, 2 * self._layout.dofs, np.concatenate(self._ranges)
        cells = cells % layout.cells if layout.periodic else np.clip(cells, 0, layout.cells - 1)
        self.columns = np.zeros((rows, len(cells)))
        self._vector = PETSc.Vec().createWithArray(self.columns, comm=PETSc.COMM_SELF)
        indices = np.array([layout.state_indices(int(cell)) for cell in cells], PETSc.IntType)
        # By component, as the rows of ``columns`` are.
        wanted = PETSc.IS().createGeneral(indices.reshape(-1, rows).T.ravel(), comm=layout.comm)
        like = layout.create_vector()
        self._scatter = PETSc.Scatter().create(like, wanted, self._vector, None)
        like.destroy()
        wanted.destroy()

    def exchange(self, state: PETSc.Vec) -> None:
        """Bring the columns up to date with ``state``; collective."""
        self._scatter.scatter(state, self._vector, PETSc.InsertMode.INSERT_VALUES)

    def destroy(self) -> None:
        """Free the PETSc objects."""
        self._scatter.destroy()
        self._vector.destroy()


class Stencil(NamedTuple):
    """P(H) on the cells of one rank, as ``apply_propagator`` reads it.

    The terms of output row o are ``starts[o]`` to ``starts[o + 1]``, a multiple of ``GROUP`` padded with zeros:
    ``values`` times the row ``rows`` at the cell ``offsets`` away. ``pieces`` (piece, 4) are the interior cells:
    whether they are read from the halo's columns, their first column there, the first owned cell, their number.
    ``ends`` (cell, 2 dof, 2 reach, 2 dof) are dense rows of cells near an end of the lattice; ``end_cells`` (cell, 2)
    has the halo's first column for each and the owned cell that it is.
    """

    starts: np.ndarray
    rows: np.ndarray
    offsets: np.ndarray
    values: np.ndarray
    pieces: np.ndarray
    ends: np.ndarray
    end_cells: np.ndarray


def create_stencil(series: StepSeries, layout: Layout, halo: HaloRegions) -> Stencil:
    """P(H) on the cells of ``layout``; adds to ``halo`` the cells around the rank's borders and at the ends."""
    r, n, start, stop = series.reach, layout.cells, layout.start, layout.stop
    first, last = (start, stop) if layout.periodic else (max(start, r), min(stop, n - r))
    # Cells that see only this rank's read the state itself.
    left, right = max(first, start + r), min(last, stop - r)
    pieces = [(0, left - start, left - start, right - left)] if left < right else []
    for a, b in ((first, left), (right, last)) if left < right else ((first, last),):
        if a < b:
            pieces.append((1, halo.add(a - r, b - a + 2 * r) + r, a - start, b - a))
    ends, end_cells = [], []
    for begin, a, b in ((0, start, min(stop, first)), (n - 2 * r, max(start, last), stop)):
        at = halo.add(begin, 2 * r if a < b else 0)
        ends += [series.stencil(series.rows(cell, begin, 2 * r)).transpose(1, 2, 0) for cell in range(a, b)]
        end_cells += [(at, cell - start) for cell in range(a, b)]
    starts, terms = [0], []  # (row, offset, value)
    for entry in series.interior():
        row, column = np.nonzero(entry)
        terms += [*zip(row, column - r, entry[row, column], strict=True)] + [(0, 0, 0.0)] * (-len(row) % GROUP)
        starts.append(len(terms))
    rows, offsets, values = map(np.array, zip(*terms, strict=True))
    return Stencil(
        np.array(starts),
        rows,
        offsets,
        values,
        pieces=np.array(pieces, np.int64).reshape(-1, 4),
        ends=np.array(ends).reshape(-1, 2 * layout.dofs, 2 * r, 2 * layout.dofs),
        end_cells=np.array(end_cells, np.int64).reshape(-1, 2),
    )


@njit(error_model="numpy")
def _add_group(out: np.ndarray, x: np.ndarray, column: int, places: np.ndarray, values: np.ndarray) -> None:
    """Add to the cells ``out`` eight ``values`` times ``x`` from ``column`` + ``places`` (modulo 2^64) on."""
    # Unsigned: numba makes no provision for negative places then, and the loop is vectorised.
    a, b, c = places, np.uint64(column), values
    a0, a1, a2, a3, a4, a5, a6, a7 = b + a[0], b + a[1], b + a[2], b + a[3], b + a[4], b + a[5], b + a[6], b + a[7]
    c0, c1, c2, c3, c4, c5, c6, c7 = c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7]
    for i in range(np.uint64(out.size)):
        out[i] = (
            out[i] + c0 * x[a0 + i] + c1 * x[a1 + i] + c2 * x[a2 + i] + c3 * x[a3 + i] + c4 * x[a4 + i]
            + c5 * x[a5 + i] + c6 * x[a6 + i] + c7 * x[a7 + i]
        )  # fmt: skip


@njit(error_model="numpy")
def apply_propagator(stencil: Stencil, state: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
    """``out`` (2 dof, owned cell) = P(H) times the lattice's ``state``, whose halo is ``columns``."""
    for piece in range(stencil.pieces.shape[0]):
        from_halo, first, at, count = stencil.pieces[piece]
        x = columns if from_halo == 1 else state
        flat, places = x.reshape(-1), (stencil.rows * x.shape[1] + stencil.offsets).astype(np.uint64)
        for a in range(0, count, CHUNK):
            n = min(CHUNK, count - a)
            for o in range(out.shape[0]):
                y = out[o, at + a : at + a + n]
                y[:] = 0.0
                for g in range(stencil.starts[o], stencil.starts[o + 1], GROUP):
                    _add_group(y, flat, first + a, places[g : g + GROUP], stencil.values[g : g + GROUP])
    for cell in range(stencil.ends.shape[0]):
        rows, (column, at) = stencil.ends[cell], stencil.end_cells[cell]
        total = np.zeros(out.shape[0])
        for i in range(rows.shape[0]):
            for k in range(rows.shape[1]):
                for o in range(total.size):
                    total[o] += columns[i, column + k] * rows[i, k, o]
        out[:, at] = total
