"""States of a lattice at phase 0, where all is at rest, as variables of a branch's file: runs can begin with them."""

from collections.abc import Sequence

import numpy as np

from vipetsc.io.netcdf import Variables, variable
from vipetsc.modes.point import Point


def stored_states(points: list[Point], cells: Sequence[int], u: np.ndarray) -> Variables:
    """Displacements ``u`` (point, cell, dof) in m of ``cells``, from 0, at phase 0."""
    # Velocities of zero are stored because ``io.state`` reads any state alike, as displacement and velocity.
    axes = "orbit", "states/cell", "states/mass"
    return {
        "orbit": variable("orbit", np.arange(1, len(points) + 1), "1", "stored motion"),
        "states/cell": variable("states/cell", np.array(cells) + 1, "1", "cell, from 1"),
        "states/mass": variable("states/mass", np.arange(1, u.shape[2] + 1), "1", "mass of the cell, from 1"),
        "states/displacement": variable(axes, u, "m", "displacement at phase 0; cells left out are at rest"),
        "states/velocity": variable(axes, 0 * u, "m/s", "velocity at phase 0"),
        "states/energy": variable("orbit", [p.energy for p in points], "J", "energy"),
        "states/period": variable("orbit", [p.period for p in points], "s", "period"),
        "states/number": variable("orbit", [p.index for p in points], "1", "number of the regular point"),
    }
