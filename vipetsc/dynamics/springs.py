"""Compiled accelerations by springs and dashpots, and the energies and powers of these.

A mass m feels from each spring of the stiffness k, with a dashpot c parallel to it, the force k (u_other - u) + c
(v_other - v), and from its dashpot to the ground -c_g v; ``spring_accelerations`` divides the sum by m. ``add_squares``
sums k z^2, twice the energy, and c z'^2, the power, over the elongations z. The nonlinear parts of springs have
functions of their own (``dynamics.spring_law``).

A cell's sums run over its springs in the cell's order, whichever rank owns it and wherever in the loop it falls: the
result does not depend on the partition, to the last bit. Where all cells are alike and undamped, a mass and a spring
have one number each; else (``is_varied``) each cell has its own, and the sums are the same.
"""

from typing import Any

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.dynamics.lattice_record import LatticeRecord
from vipetsc.dynamics.spring_law import nonlinear_energy, nonlinear_force

# Cells in one pass: a pass over the springs of a mass touches a row of each of its neighbours and one of the result,
# 4 kB each of so many cells, which stay in a first-level cache of 32 kB. Not sharp where the second level is near: 256
# to 2048 take the same CPU time of ``ts`` at 20,000 cells, to the 7 % of its scatter, and give the same bits.
CHUNK = 512


@kernel
def displacement(y: np.ndarray, lattice: LatticeRecord, cell: int, mass: int) -> float:
    """Displacement in m of ``mass`` in an owned ``cell`` or in one next to them (-1, cells); zero in a wall.

    A ``mass`` of dofs + j stands for the velocity in m/s of mass j, which lies there in ``y`` (component,). Ghosts have
    velocities only where there are dashpots or contacts join cells (``Layout.ghost_rows``).
    """
    shape = lattice.shape
    if 0 <= cell < shape.cells:
        return y[mass * shape.cells + cell]

    # The rank's first component of the neighbouring cell; a lattice ends without one, in a wall.
    ghost = shape.left_ghost
    if cell >= shape.cells:
        ghost = shape.right_ghost
    if ghost < 0:
        return 0.0
    return y[ghost + mass]


@kernel
def _far_end(y: np.ndarray, lattice: LatticeRecord, coupling: Any, cell: int, half: int) -> float:
    """Displacement in m of the other end of a ``coupling`` of ``cell``, with ``half`` = dofs its velocity in m/s."""
    if coupling.other < 0:
        return 0.0
    return displacement(y, lattice, cell + coupling.offset, half + coupling.other)


@kernel
def is_varied(lattice: LatticeRecord) -> bool:
    """Whether each cell has its own masses, springs and dashpots."""
    return lattice.inverse_masses.size > 0


@kernel
def inverse_mass(lattice: LatticeRecord, cell: int, mass: int) -> float:
    """1/m in 1/kg of a ``mass`` in an owned ``cell``."""
    if is_varied(lattice):
        return lattice.inverse_masses[mass * lattice.shape.cells + cell]
    return lattice.masses[mass].inverse_mass


@kernel
def _is_beyond_free_end(lattice: LatticeRecord, cell: int) -> bool:
    """Whether a ``cell`` next to the owned ones does not exist, so that no spring goes there."""
    shape = lattice.shape
    return (cell < 0 and shape.left_free) or (cell >= shape.cells and shape.right_free)


@kernel
def _table_entry(lattice: LatticeRecord, coupling: Any, cell: int) -> int:
    """Where ``stiffness`` and ``damping`` have the spring of a ``coupling`` of the owned ``cell``."""
    # A spring between two cells is listed with the left one. Each spring's row of the tables therefore begins with the
    # cell before the first owned one, whose springs reach it.
    left = cell + min(coupling.offset, 0)
    return coupling.spring * (lattice.shape.cells + 1) + 1 + left


@kernel
def _varied_acceleration(y: np.ndarray, lattice: LatticeRecord, cell: int, mass: int) -> float:
    """Acceleration of one mass as by ``spring_acceleration``, with the cell's own numbers and dashpots."""
    shape = lattice.shape
    n = shape.cells
    d = shape.dofs
    is_damped = lattice.damping.size > 0

    # Sum of k (u_other - u) + c (v_other - v) over the springs and the dashpots parallel to them.
    force = 0.0
    for s in range(lattice.masses[mass].first, lattice.masses[mass].last):
        coupling = lattice.couplings[s]
        other_cell = cell + coupling.offset
        if _is_beyond_free_end(lattice, other_cell):
            continue
        entry = _table_entry(lattice, coupling, cell)
        difference = _far_end(y, lattice, coupling, cell, 0) - y[mass * n + cell]
        force += lattice.stiffness[entry] * difference
        if is_damped:
            rate = _far_end(y, lattice, coupling, cell, d) - y[(d + mass) * n + cell]
            force += lattice.damping[entry] * rate

    if is_damped:
        force -= lattice.grounding[mass * n + cell] * y[(d + mass) * n + cell]
    return force * lattice.inverse_masses[mass * n + cell]


@kernel
def spring_acceleration(y: np.ndarray, lattice: LatticeRecord, cell: int, mass: int) -> float:
    """Acceleration in m/s^2 of one mass of an owned ``cell`` by its springs and dashpots.

    ``y`` (component,) is the rank's part of the state, with ghosts. The sums are those of the chunked loops, bit for
    bit.
    """
    if is_varied(lattice):
        return _varied_acceleration(y, lattice, cell, mass)

    here = y[mass * lattice.shape.cells + cell]
    force = 0.0
    for s in range(lattice.masses[mass].first, lattice.masses[mass].last):
        coupling = lattice.couplings[s]
        other_cell = cell + coupling.offset
        if _is_beyond_free_end(lattice, other_cell):
            continue
        force += coupling.stiffness * (_far_end(y, lattice, coupling, cell, 0) - here)
    return force * lattice.masses[mass].inverse_mass


@kernel
def _add_equal_springs(forces: np.ndarray, other: np.ndarray, here: np.ndarray, stiffness: float) -> None:
    """Add to the ``forces`` in N those of one spring, k (u_other - u), in consecutive cells."""
    for i in range(forces.size):
        forces[i] += stiffness * (other[i] - here[i])


@kernel
def _add_varied_springs(forces: np.ndarray, other: np.ndarray, here: np.ndarray, factors: np.ndarray) -> None:
    """Add to the ``forces`` as ``_add_equal_springs``, with a factor of each cell: stiffness, or damping of rates."""
    for i in range(forces.size):
        forces[i] += factors[i] * (other[i] - here[i])


@kernel
def _add_equal_ground(forces: np.ndarray, here: np.ndarray, stiffness: float) -> None:
    """Add to the ``forces`` in N those of one spring to the ground, -k u, in consecutive cells."""
    for i in range(forces.size):
        forces[i] -= stiffness * here[i]


@kernel
def _add_varied_ground(forces: np.ndarray, here: np.ndarray, factors: np.ndarray) -> None:
    """Add to the ``forces`` as ``_add_equal_ground``, with a factor of each cell: stiffness, or damping of rates."""
    for i in range(forces.size):
        forces[i] -= factors[i] * here[i]


@kernel
def _varied_accelerations(y: np.ndarray, lattice: LatticeRecord, mass: int, first: int, out: np.ndarray) -> None:
    """Accelerations of a mass in the cells from ``first`` on, whose neighbours are all owned."""
    n = lattice.shape.cells
    count = out.size
    is_damped = lattice.damping.size > 0
    # Components of the state: the mass's displacements in these cells, and its velocities, all displacements later.
    begin = mass * n + first
    velocities = lattice.shape.dofs * n
    here = y[begin:][:count]
    rate = y[velocities + begin :][:count]

    # Forces first, as sums over the springs in the cell's order.
    out[:] = 0.0
    for s in range(lattice.masses[mass].first, lattice.masses[mass].last):
        coupling = lattice.couplings[s]
        other = coupling.other * n + coupling.offset + first
        entry = _table_entry(lattice, coupling, first)
        if coupling.other < 0:
            _add_varied_ground(out, here, lattice.stiffness[entry:])
            if is_damped:
                _add_varied_ground(out, rate, lattice.damping[entry:])
            continue
        _add_varied_springs(out, y[other:][:count], here, lattice.stiffness[entry:])
        if is_damped:
            _add_varied_springs(out, y[velocities + other :][:count], rate, lattice.damping[entry:])

    if is_damped:
        for i in range(count):
            out[i] -= lattice.grounding[begin + i] * rate[i]
    for i in range(count):
        out[i] *= lattice.inverse_masses[begin + i]


@kernel
def spring_accelerations(y: np.ndarray, lattice: LatticeRecord, mass: int, acceleration: np.ndarray) -> None:
    """Accelerations (cells,) of a mass by its springs and dashpots, in chunks of cells whose neighbours are owned."""
    n = acceleration.size
    here = y[mass * n : (mass + 1) * n]
    row = lattice.masses[mass]
    inverse = lattice.masses[mass].inverse_mass
    for first in range(1, n - 1, CHUNK):
        stop = min(first + CHUNK, n - 1)
        out = acceleration[first:stop]
        if is_varied(lattice):
            _varied_accelerations(y, lattice, mass, first, out)
            continue

        # Forces first, as sums over the springs in the cell's order; those of a mass are equal in all cells.
        out[:] = 0.0
        for s in range(row.first, row.last):
            coupling = lattice.couplings[s]
            if coupling.other < 0:
                _add_equal_ground(out, here[first:stop], coupling.stiffness)
                continue
            others = coupling.other * n + coupling.offset
            _add_equal_springs(out, y[others + first : others + stop], here[first:stop], coupling.stiffness)
        for i in range(out.size):
            out[i] *= inverse

    # The first and the last cell have neighbours among the ghosts, or walls, or none.
    if n > 0:
        acceleration[0] = spring_acceleration(y, lattice, 0, mass)
    if n > 1:
        acceleration[n - 1] = spring_acceleration(y, lattice, n - 1, mass)


@kernel
def _elongation(y: np.ndarray, lattice: LatticeRecord, s: int, cell: int) -> float:
    """Elongation in m of the ``nonlinear`` spring ``s`` of a ``cell``; 0 of one beyond a free end."""
    coupling = lattice.nonlinear[s]
    other_cell = cell + coupling.offset
    if _is_beyond_free_end(lattice, other_cell):
        return 0.0
    here = y[coupling.mass * lattice.shape.cells + cell]
    return coupling.sign * (_far_end(y, lattice, coupling, cell, 0) - here)


@kernel
def nonlinear_force_on(y: np.ndarray, lattice: LatticeRecord, cell: int, mass: int) -> float:
    """Force in N on one mass of an owned ``cell`` by the nonlinear parts of its springs.

    ``y`` (component,) is the rank's part of the state, with ghosts.
    """
    total = 0.0
    for s in range(lattice.nonlinear.size):
        coupling = lattice.nonlinear[s]
        if coupling.mass == mass:
            law = lattice.spring_laws[coupling.law + coupling.stride * cell]
            total += coupling.sign * nonlinear_force(law, _elongation(y, lattice, s, cell))
    return total


@kernel
def add_nonlinear_energies(y: np.ndarray, lattice: LatticeRecord, first: int, energies: np.ndarray) -> None:
    """Add energies in J of springs beyond their linear parts to ``energies`` (cell,), of the cells from ``first`` on.

    ``y`` (component,) is the rank's part of the state, with ghosts. A spring to a wall on the left is the first cell's.
    """
    for s in range(lattice.nonlinear.size):
        coupling = lattice.nonlinear[s]
        for i in range(energies.size):
            # ``nonlinear`` has a spring twice, once for each of its masses. It counts at its start (sign +), and if it
            # starts in the wall on the left, where no cell is, or in the ground, at its end.
            at_wall = first + i + coupling.offset < 0 and lattice.shape.left_ghost < 0
            if coupling.sign > 0.0 or at_wall or coupling.other < 0:
                law = lattice.spring_laws[coupling.law + coupling.stride * (first + i)]
                energies[i] += nonlinear_energy(law, _elongation(y, lattice, s, first + i))


@kernel
def add_squares(
    y: np.ndarray, lattice: LatticeRecord, first: int, half: int, values: np.ndarray, sums: np.ndarray
) -> None:
    """Add to ``sums`` (cell,), of cells from ``first`` on, value times elongation squared of each of their springs.

    ``y`` (component,) is the rank's part of the state, with ghosts. ``values`` (spring and cell,) is the lattice's
    table ``stiffness`` in N/m with ``half`` 0, or ``damping`` in N s/m with ``half`` = dofs: the square is then that of
    the elongation's rate. A spring to a wall on the left is the first cell's.
    """
    shape = lattice.shape
    n = lattice.shape.cells
    for s in range(lattice.springs.size):
        spring = lattice.springs[s]
        start = half + spring.start
        end = half + spring.end
        factors = values[s * (n + 1) + 1 + first :]
        if spring.start < 0:
            moved = y[end * n + first :][: sums.size]
            for i in range(sums.size):
                sums[i] += factors[i] * moved[i] * moved[i]
            continue

        # The spring of the last cell to the next one ends among the ghosts, in a wall or nowhere.
        leaves = spring.offset == 1 and first + sums.size == n
        inside = sums.size - leaves
        here = y[start * n + first :][:inside]
        other = y[end * n + first + spring.offset :][:inside]

        for i in range(inside):
            elongation = other[i] - here[i]
            sums[i] += factors[i] * elongation * elongation
        if leaves and not shape.right_free:
            elongation = displacement(y, lattice, n, end) - y[start * n + n - 1]
            sums[inside] += factors[inside] * elongation * elongation
        if spring.offset == 1 and first == 0 and shape.left_ghost < 0 and not shape.left_free:
            sums[0] += values[s * (n + 1)] * y[end * n] * y[end * n]


@kernel
def damping_powers(y: np.ndarray, lattice: LatticeRecord, first: int, powers: np.ndarray) -> None:
    """Put the power in W that the dashpots of the owned cells from ``first`` on dissipate into ``powers`` (cell,).

    ``y`` (component,) is the rank's part of the state, with ghosts.
    """
    n = lattice.shape.cells
    d = lattice.shape.dofs
    # A rank without cells has no first and no last one, to which ``add_squares`` would add dashpots to walls.
    if n == 0:
        return

    # c (v_other - v)^2 of the dashpots parallel to springs, then c v^2 of those to the ground.
    powers[:] = 0.0
    add_squares(y, lattice, first, d, lattice.damping, powers)
    for mass in range(d):
        rate = y[(d + mass) * n + first :][: powers.size]
        ground = lattice.grounding[mass * n + first :][: powers.size]
        for i in range(powers.size):
            powers[i] += ground[i] * rate[i] * rate[i]
