"""Where a run fails: the cell that moves fastest, and whether its springs can lose their force."""

import numpy as np

from vipetsc.dynamics.observers import Setup
from vipetsc.lattice import Chain


def failing_place(setup: Setup) -> str:
    """The place of a failure in words, at the engine's state; all ranks must call it.

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
    nearest = chain.topology.nearest_index(chain.sites, fastest)
    if nearest is not None:
        place += f", nearest site {nearest + 1} in cell {chain.sites[nearest] + 1}"
    limits = _elongations_without_force(chain, fastest)
    if limits:
        number, z = min(limits.items(), key=lambda spring: abs(spring[1]))
        place += f"; its spring {number + 1} no longer pulls back beyond an elongation of {z:.4g} m"
    return place


def _elongations_without_force(chain: Chain, cell: int) -> dict[int, float]:
    """The elongation z in m, by the numbers of the springs of a ``cell``, at which k z + q z^2 + c z^3 first vanishes.

    Beyond it the force pushes the masses further apart, and nothing need hold them. Most springs have none.
    """
    limits = {}
    for number in range(len(chain.cell.springs)):
        spring = chain.spring(cell, number)
        roots = np.roots([spring.cubic, spring.quadratic, spring.stiffness])
        real = roots[np.isreal(roots)].real
        if real.size:
            limits[number] = float(real[np.abs(real).argmin()])
    return limits
