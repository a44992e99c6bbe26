"""Where a run fails, in words."""

import numpy as np

from vipetsc.dynamics.observers import Setup


def failing_place(setup: Setup) -> str:
    """Return the place of a failure in words, at the engine's state; all ranks must call it.

    It is the cell that moves fastest, or is not finite, with the site nearest to it.
    """
    layout = setup.layout
    u, v = setup.engine.state.array_r[: 2 * layout.dofs * layout.owned].reshape(2, layout.dofs, layout.owned)
    speed = np.where(np.isfinite(u) & np.isfinite(v), np.abs(v), np.inf)
    local = (-1.0, layout.start)
    if layout.owned:
        local = float(speed.max()), layout.start + int(speed.max(axis=0).argmax())
    # The first of equally fast cells is taken: it does not depend on where ranks divide the lattice.
    _, fastest = max(layout.comm.allgather(local), key=lambda of_rank: of_rank[0])

    chain = setup.model.chain
    place = f"cell {fastest + 1}"
    nearest = chain.topology.nearest_index(chain.sites.cells, fastest)
    if nearest is not None:
        place += f", nearest site {nearest + 1} in cell {chain.sites[nearest].cell + 1}"

    # Beyond such an elongation the force pushes the masses further apart, and nothing need hold them.
    limits = [chain.spring(fastest, number).without_force for number in range(len(chain.cell.springs))]
    limit = min(limits, key=abs, default=np.inf)
    if np.isfinite(limit):
        place += f"; its spring {limits.index(limit) + 1} no longer pulls back beyond an elongation of {limit:.4g} m"
    return place
