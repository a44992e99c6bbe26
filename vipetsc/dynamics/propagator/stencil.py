"""The propagator P(H) on a rank's cells: one stencil, and rows of their own for the cells near the ends."""

from __future__ import annotations

import numpy as np

from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator import linear_kernel
from vipetsc.dynamics.propagator.series import StepSeries


class Stencil:
    """P(H) as compiled passes over a rank's cells.

    ``stretches`` are the cells (first, number) that it reads through patches: around the rank's borders and at the
    lattice's ends. ``place`` must be told where they lie before ``apply``.
    """

    def __init__(self, series: StepSeries, layout: Layout) -> None:
        r, n, start, stop = series.reach, layout.cells, layout.start, layout.stop
        self._start = start
        self._terms = _terms(series)
        self.stretches: list[tuple[int, int]] = []
        self._ends = []
        first, last = start, stop
        if not layout.periodic:
            first, last = max(start, r), min(stop, n - r)
            for right, a, b in ((False, start, min(stop, r)), (True, max(start, n - r), stop)):
                if a < b:
                    rows = series.end(right)  # (cell, 2 dof, 2 dof, cell)
                    block = rows.transpose(2, 3, 1, 0).reshape(rows.shape[2], 2 * r, -1)
                    wanted = np.array([a - (n - r if right else 0), b - a])
                    total = np.empty(block.shape[2])
                    self._ends.append((np.ascontiguousarray(block), a - start, total, wanted))
                    self.stretches.append((n - 2 * r if right else 0, 2 * r))
        # Cells that see only this rank's read the state itself.
        inner = max(first, start + r), min(last, stop - r)
        self._inner = None
        pieces = [(first, last)]
        if inner[0] < inner[1]:
            self._inner = (inner[0] - start, inner[1] - inner[0])
            pieces = [(first, inner[0]), (inner[1], last)]
        self._pieces = [(a - start, b - a) for a, b in pieces if a < b]
        self.stretches += [(a - r, b - a + 2 * r) for a, b in pieces if a < b]
        self._reach = r
        self._columns: list[int] = []

    @property
    def nonzeros(self) -> int:
        """Entries of P in one cell's rows."""
        return int(np.count_nonzero(self._terms[3]))

    def place(self, columns: list[int]) -> None:
        """Say at which columns of the patches the stretches begin."""
        self._columns = columns

    def apply(self, state: np.ndarray, patches: np.ndarray, out: np.ndarray) -> None:
        """``out`` = P times the lattice, for the owned cells (2 dof, cell)."""
        columns = self._columns
        for (block, at, total, wanted), first in zip(self._ends, columns, strict=False):
            linear_kernel.end_cells(patches, first, block, out, at, total, wanted)
        if self._inner:
            at, count = self._inner
            linear_kernel.stencil(state, at, out, at, count, *self._terms)
        for (at, count), first in zip(self._pieces, columns[len(self._ends) :], strict=True):
            linear_kernel.stencil(patches, first + self._reach, out, at, count, *self._terms)


def _terms(series: StepSeries) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """P's interior rows as ``linear_kernel.stencil`` takes them: starts, rows, offsets, values."""
    entries = series.interior()
    kept = series.significant(entries)
    starts, rows, offsets, values = [0], [], [], []
    group = linear_kernel.GROUP
    for o in range(len(entries)):
        at = np.argwhere(kept[o])
        missing = -len(at) % group
        rows += at[:, 0].tolist() + [0] * missing
        offsets += (at[:, 1] - series.reach).tolist() + [0] * missing
        values += entries[o][kept[o]].tolist() + [0.0] * missing
        starts.append(len(rows))
    return np.array(starts), np.array(rows), np.array(offsets), np.array(values)
