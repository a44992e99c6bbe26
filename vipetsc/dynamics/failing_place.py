"""Where a run fails: the cell that moves fastest, and a spring that no longer pulls back."""

import numpy as np

from vipetsc.dynamics.observers import Setup
from vipetsc.dynamics.torn_spring import torn_spring
from vipetsc.lattice.chain import cells_between


def failing_place(setup: Setup) -> str:
    """The place of a failure in words, at the engine's state; all ranks must call it."""
    return "; ".join(filter(None, [_fastest_cell(setup), torn_spring(setup)]))


def _fastest_cell(setup: Setup) -> str:
    """The cell that moves fastest, or is not finite, and the site nearest to it; all ranks must call it."""
    layout = setup.layout
    u, v = setup.engine.state.array_r[: 2 * layout.dofs * layout.owned].reshape(2, layout.dofs, layout.owned)
    speed = np.where(np.isfinite(u) & np.isfinite(v), np.abs(v), np.inf)
    local = (-1.0, layout.start)
    if layout.owned:
        local = float(speed.max()), layout.start + int(speed.max(axis=0).argmax())
    # The first of equally fast cells is taken: it does not depend on where ranks divide the lattice.
    _, fastest = max(layout.comm.allgather(local), key=lambda of_rank: of_rank[0])

    cell = f"cell {fastest + 1}"
    chain = setup.model.chain
    if not chain.sites:
        return cell
    nearest = int(np.argmin(cells_between(chain.sites, fastest, chain.cells, chain.ends)))
    return f"{cell}, nearest site {nearest + 1} in cell {chain.sites[nearest] + 1}"
