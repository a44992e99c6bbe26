"""Compiled accelerations by springs and dashpots, and sums of their squares.

A cell's sums run over its springs in the cell's order, whichever rank owns it and wherever in the loop it falls: the
result does not depend on the partition, to the last bit. Where all cells are alike and undamped, a mass and a spring
have one number each; else (``is_varied``) each cell has its own, and the same sums are made with them.
"""

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.dynamics.layout import LatticeRecord

# Cells in one pass: what a pass touches stays in the first-level cache.
CHUNK = 512


@kernel
def displacement(y: np.ndarray, lattice: LatticeRecord, cell: int, mass: int) -> float:
    """Displacement in m of ``mass`` in an owned ``cell`` or in one next to them (-1, cells); zero in a wall.

    Of a ``mass`` counted on behind the cell's, where ghosts have velocities: its velocity in m/s.
    """
    shape = lattice.shape
    if cell < 0:
        return y[shape.left_ghost + mass] if shape.left_ghost >= 0 else 0.0
    if cell >= shape.cells:
        return y[shape.right_ghost + mass] if shape.right_ghost >= 0 else 0.0
    return y[mass * shape.cells + cell]


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
def _varied_acceleration(y: np.ndarray, lattice: LatticeRecord, cell: int, mass: int) -> float:
    """As ``spring_acceleration``, with the cell's own numbers and dashpots."""
    shape = lattice.shape
    n, d, total = shape.cells, shape.dofs, 0.0
    for s in range(lattice.masses[mass].first, lattice.masses[mass].last):
        coupling = lattice.couplings[s]
        c, of_spring = cell + coupling.offset, coupling.spring * (n + 1) + 1 + cell + min(coupling.offset, 0)
        if (c < 0 and shape.left_free) or (c >= n and shape.right_free):
            continue
        total += lattice.stiffness[of_spring] * (displacement(y, lattice, c, coupling.other) - y[mass * n + cell])
        if shape.damping >= 0:
            rate = displacement(y, lattice, c, d + coupling.other) - y[(d + mass) * n + cell]
            total += lattice.damping[of_spring] * rate
    if shape.damping >= 0:
        total -= lattice.grounding[mass * n + cell] * y[(d + mass) * n + cell]
    return total * lattice.inverse_masses[mass * n + cell]


@kernel
def spring_acceleration(y: np.ndarray, lattice: LatticeRecord, cell: int, mass: int) -> float:
    """Acceleration in m/s^2 of one mass by its springs and dashpots; the sums of the chunked loops, bit for bit."""
    if is_varied(lattice):
        return _varied_acceleration(y, lattice, cell, mass)
    shape = lattice.shape
    here = y[mass * shape.cells + cell]
    total = 0.0
    for s in range(lattice.masses[mass].first, lattice.masses[mass].last):
        coupling = lattice.couplings[s]
        c = cell + coupling.offset
        if (c < 0 and shape.left_free) or (c >= shape.cells and shape.right_free):
            continue
        total += coupling.stiffness * (displacement(y, lattice, c, coupling.other) - here)
    return total * lattice.masses[mass].inverse_mass


@kernel
def _add_spring(out: np.ndarray, other: np.ndarray, here: np.ndarray, stiffness: float) -> None:
    for i in range(out.size):
        out[i] += stiffness * (other[i] - here[i])


@kernel
def _add_springs(out: np.ndarray, other: np.ndarray, here: np.ndarray, factors: np.ndarray) -> None:
    for i in range(out.size):
        out[i] += factors[i] * (other[i] - here[i])


@kernel
def _varied_accelerations(y: np.ndarray, lattice: LatticeRecord, mass: int, a: int, out: np.ndarray) -> None:
    """Accelerations of a mass in the cells from ``a`` on, whose neighbours are all owned."""
    n, m, velocities, row = lattice.shape.cells, out.size, lattice.shape.dofs * lattice.shape.cells, mass
    out[:] = 0.0
    here, rate = y[row * n + a :][:m], y[velocities + row * n + a :][:m]
    for s in range(lattice.masses[mass].first, lattice.masses[mass].last):
        coupling = lattice.couplings[s]
        first, of_spring = coupling.other * n + coupling.offset + a, coupling.spring * (n + 1) + 1 + a
        of_spring += min(coupling.offset, 0)
        _add_springs(out, y[first:][:m], here, lattice.stiffness[of_spring:])
        if lattice.shape.damping >= 0:
            _add_springs(out, y[velocities + first :][:m], rate, lattice.damping[of_spring:])
    if lattice.shape.damping >= 0:
        for i in range(m):
            out[i] -= lattice.grounding[mass * n + a + i] * rate[i]
    for i in range(m):
        out[i] *= lattice.inverse_masses[mass * n + a + i]


@kernel
def spring_accelerations(y: np.ndarray, lattice: LatticeRecord, mass: int, acceleration: np.ndarray) -> None:
    """Accelerations (cells,) of a mass by its springs and dashpots, in chunks of cells whose neighbours are owned."""
    n = acceleration.size
    here = y[mass * n : (mass + 1) * n]
    row, inverse = lattice.masses[mass], lattice.masses[mass].inverse_mass
    for a in range(1, n - 1, CHUNK):
        b = min(a + CHUNK, n - 1)
        out = acceleration[a:b]
        if is_varied(lattice):
            _varied_accelerations(y, lattice, mass, a, out)
            continue
        out[:] = 0.0
        for s in range(row.first, row.last):
            coupling = lattice.couplings[s]
            first = coupling.other * n + coupling.offset
            _add_spring(out, y[first + a : first + b], here[a:b], coupling.stiffness)
        for i in range(out.size):
            out[i] *= inverse
    if n > 0:
        acceleration[0] = spring_acceleration(y, lattice, 0, mass)
    if n > 1:
        acceleration[n - 1] = spring_acceleration(y, lattice, n - 1, mass)


@kernel
def _elongation(y: np.ndarray, lattice: LatticeRecord, s: int, cell: int) -> float:
    """What the other mass of the ``smooth`` coupling ``s`` of a ``cell`` is ahead, in m; 0 beyond a free end."""
    coupling, c, shape = lattice.smooth[s], cell + lattice.smooth[s].offset, lattice.shape
    if (c < 0 and shape.left_free) or (c >= shape.cells and shape.right_free):
        return 0.0
    return displacement(y, lattice, c, coupling.other) - y[coupling.mass * shape.cells + cell]


@kernel
def smooth_force(y: np.ndarray, lattice: LatticeRecord, cell: int, mass: int) -> float:
    """Force in N on one mass by the parts of its springs that are not linear."""
    total = 0.0
    for s in range(lattice.smooth.size):
        if lattice.smooth[s].mass == mass:
            z = _elongation(y, lattice, s, cell)
            total += z * z * (lattice.smooth[s].quadratic + lattice.smooth[s].cubic * z)
    return total


@kernel
def add_smooth_energies(y: np.ndarray, lattice: LatticeRecord, first: int, energies: np.ndarray) -> None:
    """Add the energies of those parts in the cells from ``first`` on, and in a spring to a wall on the left."""
    for s in range(lattice.smooth.size):
        coupling, starts = lattice.smooth[s], s % 2 == 0
        for i in range(energies.size):
            at_wall = first + i + coupling.offset < 0 and lattice.shape.left_ghost < 0
            if starts or at_wall:
                z = _elongation(y, lattice, s, first + i)
                energies[i] += z * z * z * (coupling.quadratic / 3.0 + 0.25 * coupling.cubic * z)


@kernel
def add_squares(
    y: np.ndarray, lattice: LatticeRecord, first: int, half: int, values: np.ndarray, sums: np.ndarray
) -> None:
    """Add to ``sums`` those over the springs of the cells from ``first`` on of a value times the stretch squared.

    ``values`` is the table ``stiffness`` with ``half`` 0, or ``damping`` with ``half`` = dofs: of velocities. A spring
    to a wall on the left is the first cell's.
    """
    shape, n = lattice.shape, lattice.shape.cells
    for s in range(lattice.springs.size):
        spring, factors = lattice.springs[s], values[s * (n + 1) + 1 + first :]
        leaves = spring.next_cell == 1 and first + sums.size == n
        inside, start, end = sums.size - leaves, half + spring.start, half + spring.end
        here, other = y[start * n + first :][:inside], y[end * n + first + spring.next_cell :][:inside]
        for i in range(inside):
            stretch = other[i] - here[i]
            sums[i] += factors[i] * stretch * stretch
        if leaves and not shape.right_free:
            stretch = displacement(y, lattice, n, end) - y[start * n + n - 1]
            sums[inside] += factors[inside] * stretch * stretch
        if spring.next_cell == 1 and first == 0 and shape.left_ghost < 0 and not shape.left_free:
            sums[0] += values[s * (n + 1)] * y[end * n] * y[end * n]


@kernel
def damping_powers(y: np.ndarray, lattice: LatticeRecord, powers: np.ndarray) -> None:
    """Power in W that the dashpots of each owned cell dissipate."""
    n, d = lattice.shape.cells, lattice.shape.dofs
    powers[:] = 0.0
    add_squares(y, lattice, 0, d, lattice.damping, powers)
    for mass in range(d):
        rate, ground = y[(d + mass) * n :][:n], lattice.grounding[mass * n :][:n]
        for i in range(n):
            powers[i] += ground[i] * rate[i] * rate[i]
