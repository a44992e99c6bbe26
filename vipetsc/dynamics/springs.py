"""Compiled accelerations by springs and dashpots, and the energies and powers of these.

A mass m feels from each spring of the stiffness k, with a dashpot c parallel to it, the force k (u_other - u) + c
(v_other - v), from its dashpot to the ground -c_g v, and from the nonlinear parts of springs what
``dynamics.spring_law`` gives; ``spring_accelerations`` divides the sum of the linear parts by m. The energies are sums
of k z^2/2 over the elongations z, the powers of c z'^2.

A cell's sums run over its springs in the cell's order, whichever rank owns it and wherever in the loop it falls: the
result does not depend on the partition, to the last bit. Where all cells are alike and undamped, a mass and a spring
have one number each; else (``is_varied``) each cell has its own, and the sums are the same. Where a spring leaves the
rank's cells, its ``COUPLING`` says whether its other end is a ghost, in a wall or nowhere.
"""

from typing import Any

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.dynamics.lattice_record import CHUNK, LatticeRecord
from vipetsc.dynamics.spring_law import nonlinear_energy, nonlinear_force
from vipetsc.lattice.topology import NOTHING, WALL


@kernel
def is_varied(lattice: LatticeRecord) -> bool:
    """Return whether each cell has its own masses, springs and dashpots."""
    return lattice.inverse_masses.size > 0


@kernel
def inverse_mass(lattice: LatticeRecord, cell: int, mass: int) -> float:
    """Return 1/m in 1/kg of a ``mass`` in an owned ``cell``."""
    if is_varied(lattice):
        return lattice.inverse_masses[mass * lattice.shape.cells + cell]
    return lattice.masses[mass].inverse_mass


@kernel
def _table_entry(lattice: LatticeRecord, coupling: Any, cell: int) -> int:
    """Return where ``stiffness`` and ``damping`` have the spring of a ``coupling`` of the owned ``cell``."""
    # A spring between two cells is listed with the left one. Each spring's row of the tables therefore begins with the
    # cell before the first owned one, whose springs reach it.
    left = cell + min(coupling.offset, 0)
    return coupling.spring * (lattice.shape.cells + 1) + 1 + left


@kernel
def _stiffness(lattice: LatticeRecord, coupling: Any, cell: int) -> float:
    """Return the stiffness in N/m of the spring of a ``coupling`` of the owned ``cell``."""
    if is_varied(lattice):
        return lattice.stiffness[_table_entry(lattice, coupling, cell)]
    return coupling.stiffness


@kernel
def _other_end(lattice: LatticeRecord, coupling: Any, cell: int) -> tuple[int, int]:
    """Return where the state has displacement and velocity of the other mass of a ``coupling`` of the owned ``cell``.

    ``WALL`` or ``NOTHING`` where there is no mass. Ghosts have velocities only where there are dashpots or contacts
    join cells (``Layout.ghost_rows``).
    """
    n = lattice.shape.cells
    other_cell = cell + coupling.offset
    if coupling.other >= 0 and 0 <= other_cell < n:
        u = coupling.other * n + other_cell
        return u, u + lattice.shape.dofs * n
    return coupling.outside_u, coupling.outside_v


@kernel
def _value(y: np.ndarray, component: int) -> float:
    """Return the displacement or velocity that ``y`` has at a ``component``; zero in a wall."""
    if component < 0:
        return 0.0
    return y[component]


@kernel
def spring_acceleration(y: np.ndarray, lattice: LatticeRecord, cell: int, mass: int) -> float:
    """Return the acceleration in m/s^2 of one mass of an owned ``cell`` by its springs and dashpots.

    ``y`` (component,) is the rank's part of the state, with ghosts. The sums are those of the chunked loops, bit for
    bit.
    """
    n = lattice.shape.cells
    here = y[mass * n + cell]
    rate = y[(lattice.shape.dofs + mass) * n + cell]
    is_damped = lattice.damping.size > 0

    # Sum of k (u_other - u) + c (v_other - v) over the springs and the dashpots parallel to them.
    force = 0.0
    for s in range(lattice.masses[mass].first, lattice.masses[mass].last):
        coupling = lattice.couplings[s]
        u, v = _other_end(lattice, coupling, cell)
        if u == NOTHING:
            continue
        force += _stiffness(lattice, coupling, cell) * (_value(y, u) - here)
        if is_damped:
            force += lattice.damping[_table_entry(lattice, coupling, cell)] * (_value(y, v) - rate)

    if is_damped:
        force -= lattice.grounding[mass * n + cell] * rate
    return force * inverse_mass(lattice, cell, mass)


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
def _others(y: np.ndarray, lattice: LatticeRecord, coupling: Any, begin: int, size: int) -> np.ndarray:
    """Return what ``y`` has of the other masses of a ``coupling`` in so many cells, all owned; zeros of the ground.

    ``begin`` is the first cell, for velocities behind all displacements.
    """
    if coupling.other < 0:
        return lattice.zeros[:size]
    return y[coupling.other * lattice.shape.cells + coupling.offset + begin :][:size]


@kernel
def _add_varied_forces(forces: np.ndarray, y: np.ndarray, lattice: LatticeRecord, mass: int, first: int) -> None:
    """Add to the ``forces`` (cell,) in N on a mass those of its springs and dashpots, in cells from ``first`` on.

    Each cell has its own; all neighbours of the cells are owned.
    """
    n = lattice.shape.cells
    velocities = lattice.shape.dofs * n
    is_damped = lattice.damping.size > 0
    begin = mass * n + first
    here = y[begin : begin + forces.size]
    rate = y[velocities + begin : velocities + begin + forces.size]
    for s in range(lattice.masses[mass].first, lattice.masses[mass].last):
        coupling = lattice.couplings[s]
        entry = _table_entry(lattice, coupling, first)
        others = _others(y, lattice, coupling, first, forces.size)
        _add_varied_springs(forces, others, here, lattice.stiffness[entry:])
        if is_damped:
            others = _others(y, lattice, coupling, velocities + first, forces.size)
            _add_varied_springs(forces, others, rate, lattice.damping[entry:])
    if is_damped:
        _add_varied_springs(forces, lattice.zeros, rate, lattice.grounding[begin:])


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

        # Forces first, as sums over the springs in the cell's order.
        out[:] = 0.0
        if is_varied(lattice):
            _add_varied_forces(out, y, lattice, mass, first)
            inverse_masses = lattice.inverse_masses[mass * n + first :]
            for i in range(out.size):
                out[i] *= inverse_masses[i]
            continue

        # Those of a mass are equal in all cells.
        for s in range(row.first, row.last):
            coupling = lattice.couplings[s]
            others = _others(y, lattice, coupling, first, out.size)
            _add_equal_springs(out, others, here[first:stop], coupling.stiffness)
        for i in range(out.size):
            out[i] *= inverse

    # The first and the last cell have neighbours among the ghosts, or walls, or none.
    if n > 0:
        acceleration[0] = spring_acceleration(y, lattice, 0, mass)
    if n > 1:
        acceleration[n - 1] = spring_acceleration(y, lattice, n - 1, mass)


@kernel
def _elongation(y: np.ndarray, lattice: LatticeRecord, coupling: Any, cell: int) -> float:
    """Return the elongation in m of the spring of a ``coupling`` of the owned ``cell``; 0 of one beyond a free end."""
    other, _ = _other_end(lattice, coupling, cell)
    if other == NOTHING:
        return 0.0
    return coupling.sign * (_value(y, other) - y[coupling.mass * lattice.shape.cells + cell])


@kernel
def nonlinear_force_on(y: np.ndarray, lattice: LatticeRecord, cell: int, mass: int) -> float:
    """Return the force in N on one mass of an owned ``cell`` by the nonlinear parts of its springs.

    ``y`` (component,) is the rank's part of the state, with ghosts.
    """
    total = 0.0
    for s in range(lattice.masses[mass].first, lattice.masses[mass].last):
        coupling = lattice.couplings[s]
        if coupling.law >= 0:
            law = lattice.spring_laws[coupling.law + coupling.stride * cell]
            total += coupling.sign * nonlinear_force(law, _elongation(y, lattice, coupling, cell))
    return total


@kernel
def add_nonlinear_accelerations(y: np.ndarray, lattice: LatticeRecord, mass: int, acceleration: np.ndarray) -> None:
    """Add to the accelerations (cells,) of a mass those by the nonlinear parts of its springs."""
    n = acceleration.size
    row = lattice.masses[mass]
    # As ``nonlinear_force_on``, but all neighbours are owned.
    forces = np.empty(min(CHUNK, n))
    for first in range(1, n - 1, CHUNK):
        out = acceleration[first : min(first + CHUNK, n - 1)]
        here = y[mass * n + first :][: out.size]
        forces[:] = 0.0
        for s in range(row.first, row.last):
            coupling = lattice.couplings[s]
            if coupling.law < 0:
                continue
            laws = lattice.spring_laws[coupling.law + coupling.stride * first :]
            stride = coupling.stride
            sign = coupling.sign
            others = _others(y, lattice, coupling, first, out.size)
            for i in range(out.size):
                forces[i] += sign * nonlinear_force(laws[stride * i], sign * (others[i] - here[i]))
        for i in range(out.size):
            out[i] += forces[i] * inverse_mass(lattice, first + i, mass)

    if n > 0:
        acceleration[0] += nonlinear_force_on(y, lattice, 0, mass) * inverse_mass(lattice, 0, mass)
    if n > 1:
        acceleration[n - 1] += nonlinear_force_on(y, lattice, n - 1, mass) * inverse_mass(lattice, n - 1, mass)


@kernel
def spring_energies(y: np.ndarray, lattice: LatticeRecord, first: int, energies: np.ndarray) -> None:
    """Put the energies in J of the springs of the owned cells from ``first`` on into ``energies`` (cell,).

    ``y`` (component,) is the rank's part of the state, with ghosts. A spring belongs to the cell of its start. One that
    starts on the ground or in the wall on the left belongs to that of its end.
    """
    energies[:] = 0.0
    for s in lattice.spring_ends:
        _add_squares(y, lattice, lattice.couplings[s], first, False, energies)
    for i in range(energies.size):
        energies[i] *= 0.5
    if lattice.spring_laws.size == 0:
        return

    for s in lattice.spring_ends:
        coupling = lattice.couplings[s]
        if coupling.law < 0:
            continue
        for i in range(_cells_with(coupling, first, energies.size)):
            law = lattice.spring_laws[coupling.law + coupling.stride * (first + i)]
            energies[i] += nonlinear_energy(law, _elongation(y, lattice, coupling, first + i))


@kernel
def _cells_with(coupling: Any, first: int, cells: int) -> int:
    """Return how many of so many ``cells`` from ``first`` on have the energy of the spring of a ``coupling``.

    A spring is there twice, once for each of its masses. It counts at its start, and at its end if it starts on the
    ground, or in the wall on the left, next to which there is the first cell.
    """
    if coupling.sign > 0 or coupling.other < 0:
        return cells
    if first == 0 and coupling.offset < 0 and coupling.outside_u == WALL:
        return min(cells, 1)
    return 0


@kernel
def _add_squares(
    y: np.ndarray, lattice: LatticeRecord, coupling: Any, first: int, of_dashpots: bool, sums: np.ndarray
) -> None:
    """Add k z^2 of the spring of a ``coupling`` to the ``sums`` (cell,) of cells from ``first`` on.

    If ``of_dashpots``, it is c z'^2 of the dashpot. ``y`` (component,) is the rank's part of the state, with ghosts.
    """
    n = lattice.shape.cells
    half = 0
    values = lattice.stiffness
    outside = coupling.outside_u
    if of_dashpots:
        half = lattice.shape.dofs * n
        values = lattice.damping
        outside = coupling.outside_v
    count = _cells_with(coupling, first, sums.size)
    here = y[half + coupling.mass * n + first :][:count]

    # The other end of a spring that leaves the rank's cells is among the ghosts, in a wall or nowhere.
    inside = count
    if coupling.other < 0 or coupling.offset < 0:
        inside = 0
    elif coupling.offset > 0 and first + count == n:
        inside -= 1
    other = y[half + coupling.other * n + first + coupling.offset :][:inside]
    factor = coupling.stiffness
    if values.size > 0:
        factors = values[_table_entry(lattice, coupling, first) :]
        for i in range(inside):
            elongation = other[i] - here[i]
            sums[i] += factors[i] * elongation * elongation
    else:
        for i in range(inside):
            elongation = other[i] - here[i]
            sums[i] += factor * elongation * elongation

    if outside == NOTHING:
        return
    for i in range(inside, count):
        if values.size > 0:
            factor = values[_table_entry(lattice, coupling, first + i)]
        elongation = _value(y, outside) - here[i]
        sums[i] += factor * elongation * elongation


@kernel
def damping_powers(y: np.ndarray, lattice: LatticeRecord, first: int, powers: np.ndarray) -> None:
    """Put the power in W that the dashpots of the owned cells from ``first`` on dissipate into ``powers`` (cell,).

    ``y`` (component,) is the rank's part of the state, with ghosts.
    """
    n = lattice.shape.cells
    d = lattice.shape.dofs
    # A rank without cells has no first and no last one, with dashpots to walls.
    if n == 0:
        return

    # c (v_other - v)^2 of the dashpots parallel to springs, then c v^2 of those to the ground.
    powers[:] = 0.0
    for s in lattice.spring_ends:
        _add_squares(y, lattice, lattice.couplings[s], first, True, powers)
    for mass in range(d):
        rate = y[(d + mass) * n + first :][: powers.size]
        ground = lattice.grounding[mass * n + first :][: powers.size]
        for i in range(powers.size):
            powers[i] += ground[i] * rate[i] * rate[i]
