"""The equation of motion of one mass, compiled: what ``ts`` asks at its sites, and a sample at named points.

    m a = sum over springs of k (u_other - u) and their nonlinear parts + dashpots + drives + contacts,

summed in one order, so that the number of ranks does not show in the bits.
"""

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.dynamics.drives import drive_force
from vipetsc.dynamics.lattice_record import LatticeRecord
from vipetsc.dynamics.springs import inverse_mass, nonlinear_force_on, spring_acceleration


@kernel
def acceleration(t: float, y: np.ndarray, lattice: LatticeRecord, cell: int, mass: int, force: float) -> float:
    """Return the acceleration in m/s^2 of a ``mass`` of a ``cell`` at t in s by springs, a contact ``force``, drives.

    ``y`` (component,) is the rank's part of the state, with ghosts. Of each drive the piece acts that is on.
    """
    per_mass = inverse_mass(lattice, cell, mass)
    total = spring_acceleration(y, lattice, cell, mass) + force * per_mass
    if lattice.spring_laws.size > 0:
        total += nonlinear_force_on(y, lattice, cell, mass) * per_mass
    for i in range(lattice.drives.rows.size):
        if lattice.drives.rows[i].target == (lattice.shape.dofs + mass) * lattice.shape.cells + cell:
            total += drive_force(lattice.drives, i, t) * per_mass
    return total
