"""The loss of free motion in a step as a quadratic form of the state, half of it a stencil.

Free motion from the state y loses y^T S y in a step, S = integral of V^T C V, where the rows V(s) take the velocities
from the state (sec. 10 of the derivation in the package's docstring). S is symmetric, so that each cell multiplies
itself and those to its right alone, these twice: the stencil takes the state to what its cells are to be multiplied by.
"""

from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.dashpots import NO_DASHPOTS, DashpotRows
from vipetsc.dynamics.propagator.loss_modes import mode_count
from vipetsc.dynamics.propagator.nodes import gauss
from vipetsc.dynamics.propagator.stencil import HaloRegions, Stencil, in_fours, ranges_of, sparse_rows
from vipetsc.dynamics.vectors import LANES

# Entries below this fraction of a table's largest one are left out. With this fraction the error of the energy
# balance of the example ``damped`` is 3e-13 of the work, with 1e-10 it is 3e-10, with all entries 1.5e-13.
SMALL = 1e-12


class _Gramian:
    """Tables of S (2 dof, 2 dof, cell), from a cell to itself and to those on its right, by the kinds near it."""

    def __init__(self, dashpots: DashpotRows) -> None:
        self._dashpots = dashpots
        # The product of two rates has the degrees below ``mode_count``, but for what is left out, and Gauss's rule with
        # n nodes integrates degrees up to 2 n - 1: half as many nodes as modes are enough.
        count = -(-mode_count(dashpots.series.omega_max_h) // 2)
        nodes, weights = gauss(count)
        seconds = weights * dashpots.series.interval
        self._powers = nodes[:, None] ** np.arange(dashpots.powers) * np.sqrt(seconds)[:, None]
        self._rates = lru_cache(maxsize=2 * dashpots.width)(self._compute_rates)

    def _compute_rates(self, kind: int) -> np.ndarray:
        """Rates at the nodes (rate and node, 2 dof, cell) of dashpots of a ``kind``."""
        rows = np.tensordot(self._powers, self._dashpots.rows(kind), axes=(1, 1))
        return rows.reshape(-1, *rows.shape[2:])

    def table(self, kinds: np.ndarray) -> np.ndarray:
        """The table of a cell, from the ``kinds`` of those from ``reach`` + 1 before it to ``reach`` after it."""
        width = self._dashpots.width
        rows = 2 * self._dashpots.chain.cell.dofs
        out = np.zeros((rows, rows, width))
        for k, kind in enumerate(kinds.tolist()):
            if kind == NO_DASHPOTS:
                continue
            # The later the dashpot's cell, the earlier the column of the cell in its rows.
            column = width - 1 - k
            rates = self._rates(kind)
            from_cell = rates[:, :, column].T
            to_right = rates[:, :, column:].reshape(len(rates), -1)
            out[:, :, : width - column] += (from_cell @ to_right).reshape(rows, rows, -1)

        # Each pair of cells counts once, with twice its entry. So do pairs of masses of one cell that lie in different
        # blocks of the stencil (``sparse_rows``): the earlier block has them, with the factor 2, the later one with 0.
        # Within a block both orders of a pair are there.
        out[:, :, 1:] *= 2
        block = np.arange(rows) % (rows // 2) // 2
        out[:, :, 0] *= 1 + np.sign(block - block[:, None])
        return self._without_small(out)

    def _without_small(self, entries: np.ndarray) -> np.ndarray:
        """The ``entries`` with zeros for small ones, a velocity measured as omega u."""
        series = self._dashpots.series
        d = self._dashpots.chain.cell.dofs
        scale = np.ones(2 * d)
        scale[d:] = (series.omega_max_h or 1.0) / series.interval
        sizes = np.abs(entries) * scale[:, None, None] * scale[:, None]
        return np.where(sizes > SMALL * sizes.max(), entries, 0.0)


def create_loss_stencil(dashpots: DashpotRows, layout: Layout, halo: HaloRegions) -> Stencil:
    """Create the stencil on the cells of ``layout``; adds to ``halo`` the cells that it reads."""
    reach = dashpots.series.reach
    gramian = _Gramian(dashpots)
    # One more, so that a rank without cells has a window, too.
    kinds = dashpots.kinds(np.arange(layout.start - reach - 1, layout.stop + reach + 1))
    # How many cells before each one are not interior, and how many have dashpots: the number in a window of cells is a
    # difference of two entries.
    others = np.append(0, np.cumsum((kinds != dashpots.interior) | (kinds == NO_DASHPOTS)))
    damped = np.append(0, np.cumsum(kinds != NO_DASHPOTS))
    width = dashpots.width
    is_interior = (others[width:] == others[:-width])[: layout.owned]
    is_damped = (damped[width:] > damped[:-width])[: layout.owned]

    # Cells whose windows have interior cells alone, and whose stencil stays among the rank's own. Vectors of cells need
    # so many in a row; the others have dense rows, if there is a dashpot near them.
    cells = np.arange(layout.start, layout.stop)
    interior = gramian.table(np.full(width, dashpots.interior))
    columns_read = _columns(interior)
    is_own = cells + columns_read <= layout.stop
    ranges = ranges_of(is_interior & is_own, layout.start)
    ranges = ranges[ranges @ [-1, 1] >= LANES]

    is_dense = is_damped.copy()
    for start, stop in ranges - layout.start:
        is_dense[start:stop] = False
    windows = sliding_window_view(kinds, width)[: layout.owned][is_dense]
    examples, table = np.unique(windows, axis=0, return_inverse=True)
    tables = np.array([gramian.table(example) for example in examples]).reshape(-1, *interior.shape)
    read = max([columns_read, *map(_columns, tables)])

    columns = [np.zeros(0, np.int64)]
    for start, stop in ranges_of(is_dense, layout.start).tolist():
        columns.append(int(halo.add(start, stop - start + read - 1)) + np.arange(stop - start))
    sparse = sparse_rows(interior, layout, 0)
    if layout.dofs % 2:
        # The last mass is there twice, and counts once.
        sparse.values[sparse.starts[-2] :, 2:] = 0.0
    # Columns before rows: the sums of ``apply_propagator`` run over one cell's outputs at a time.
    borders = in_fours(np.ascontiguousarray(tables[..., :read].transpose(0, 2, 3, 1)))
    return Stencil(
        interior=ranges - layout.start,
        blocks=sparse.blocks,
        starts=sparse.starts,
        places=sparse.places,
        values=sparse.values,
        borders=borders,
        border_cells=np.column_stack([np.concatenate(columns), cells[is_dense] - layout.start, table.ravel()]),
        total=np.zeros(borders.shape[3]),
    )


def _columns(entries: np.ndarray) -> int:
    """How many cells ``entries`` (2 dof, 2 dof, cell) have before zeros alone follow, one at least."""
    return int(np.flatnonzero(entries.any(axis=(0, 1))).max(initial=0)) + 1
