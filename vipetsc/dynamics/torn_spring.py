"""The spring that no longer pulls back, where a run fails."""

from typing import NamedTuple

import numpy as np

from vipetsc.dynamics.observers import Setup
from vipetsc.lattice import nonlinear_numbers
from vipetsc.lattice.chain import Chain
from vipetsc.parallel import on_every_rank


class _Torn(NamedTuple):
    """A spring whose ``elongation`` z in m is beyond the ``limit`` at which its force vanishes, and where it is.

    ``ratio``, z over the limit, comes first: the largest of several records is the spring that is farthest beyond.
    """

    ratio: float
    cell: int
    number: int
    elongation: float
    limit: float


def torn_spring(setup: Setup) -> str:
    """A clause on the nonlinear spring that is farthest beyond the point where its force vanishes; empty if none is.

    Beyond such a point the force k z + q z^2 + c z^3 pushes the masses further apart, and nothing need hold them. All
    ranks must call it, at the state at which the run has failed; a spring whose elongation is not finite is not judged.
    """
    layout = setup.layout
    chain = setup.model.chain
    places = nonlinear_numbers(chain)
    if not len(places):
        return ""

    state = setup.engine.state
    state.ghostUpdate()
    with state.localForm() as local:
        y = local.array_r.copy()
    # The first rank has the springs to the wall on the left, too, whose cell is -1.
    first = layout.start - (layout.start == 0)
    here = places[(places[:, 0] >= first) & (places[:, 0] < layout.stop)]
    worst_here = on_every_rank(layout.comm, lambda: _worst(chain, here, _elongations(setup, here, y)))
    worst_of_ranks = [worst for worst in layout.comm.allgather(worst_here) if worst]
    if not worst_of_ranks:
        return ""
    worst = max(worst_of_ranks)
    place = "at the left wall"
    if worst.cell >= 0:
        place = f"of cell {worst.cell + 1}"
    return (
        f"spring {worst.number + 1} {place} is at the elongation {worst.elongation:.4g} m, beyond"
        f" {worst.limit:.4g} m, from where on its force k z + quadratic z^2 + cubic z^3 pushes its masses further apart"
    )


def _elongations(setup: Setup, places: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Elongations (spring,) in m of this rank's springs at ``places`` (spring, 2), from its state ``y`` with ghosts."""
    layout = setup.layout
    cell = setup.model.chain.cell
    # The displacements of a wall on the left, of the owned cells, and of the next cell or a wall. A spring that begins
    # in the cell on the left belongs to that cell, and so to the rank that owns it, unless that is a wall.
    u = np.zeros((layout.owned + 2, layout.dofs))
    u[1:-1] = y[: layout.dofs * layout.owned].reshape(layout.dofs, layout.owned).T
    left, right = layout.neighbours()
    if right is not None:
        ghost = layout.size + layout.ghost_rows * (left is not None)
        u[-1] = y[ghost : ghost + layout.dofs]

    rows = places[:, 0] - layout.start + 1
    springs = [cell.springs[number] for number in places[:, 1].tolist()]
    start = np.array([spring.start for spring in springs], np.int64)
    end = np.array([spring.end for spring in springs], np.int64)
    next_cell = np.array([spring.next_cell for spring in springs], np.int64)
    return u[rows + next_cell, end] - u[rows, start]


def _worst(chain: Chain, places: np.ndarray, elongations: np.ndarray) -> _Torn | None:
    """The spring at one of ``places`` (spring, 2) that is farthest beyond the zero of its force; None if none is.

    ``elongations`` (spring,) are in m.
    """
    torn = []
    for (cell, number), z in zip(places.tolist(), elongations.tolist(), strict=True):
        spring = chain.spring(cell, number)
        # The force over z, k + q z + c z^2, is positive at rest: up to its first zero on that side it pulls back.
        if spring.stiffness + (spring.quadratic + spring.cubic * z) * z >= 0 or not np.isfinite(z):
            continue
        zeros = np.roots([spring.cubic, spring.quadratic, spring.stiffness])
        passed = [float(zero.real) for zero in zeros if zero.imag == 0 and 0 < zero.real / z < 1]
        # A spring that pushes from rest on has no such zero.
        if passed:
            limit = min(passed, key=abs)
            torn.append(_Torn(ratio=z / limit, cell=cell, number=number, elongation=z, limit=limit))
    return max(torn, default=None)
