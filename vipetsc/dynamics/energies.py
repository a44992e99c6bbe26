"""Compiled energies of a rank's part of the lattice, as sums of integers.

Each cell's energy is a whole number of a unit and a rest in multiples of unit/2^40; both are summed as integers, so
that neither the order nor the partition shows in the result.
"""

import numpy as np

from vipetsc.compiled import njit
from vipetsc.contact.law import elastic_energy
from vipetsc.dynamics.records import LatticeRecord
from vipetsc.dynamics.ts.right_hand_side import displacement, relative_motion

FINE = 2.0**40
"""Multiples of the finer rest in one unit."""

_LARGEST = 2.0**50
_KINETIC, _SPRING, _CONTACT, _DISSIPATED, _WORK = range(5)


@njit(error_model="numpy", forceinline=True)
def _add(sums: np.ndarray, part: int, energy: float, unit: float) -> None:
    """Add an energy in J to ``sums`` (part, 2) as multiples of ``unit`` and of unit/2^40."""
    multiple = energy * (1.0 / unit)
    whole = np.rint(multiple)
    if abs(whole) < _LARGEST:
        sums[part, 0] += np.int64(whole)
        sums[part, 1] += np.int64(np.rint((multiple - whole) * FINE))
    else:  # not finite or far beyond the scale: the guard sees a runaway energy
        sums[part, 0] += np.int64(_LARGEST)


@njit(error_model="numpy", forceinline=True)
def _cell_energies(y: np.ndarray, lattice: LatticeRecord, cell: int) -> tuple[float, float]:
    """Kinetic and spring energy of one cell, its springs to the next cell and a wall on its left included."""
    shape = lattice.shape
    n, d = shape.cells, shape.dofs
    kinetic = energy = 0.0
    for mass in range(d):
        v = y[(d + mass) * n + cell]
        kinetic += 0.5 * v * v / lattice.masses[mass].inverse_mass
    for s in range(lattice.springs.size):
        spring = lattice.springs[s]
        if not (spring.next_cell == 1 and cell == n - 1 and shape.right_free):
            stretch = displacement(y, lattice, cell + spring.next_cell, spring.end) - y[spring.start * n + cell]
            energy += 0.5 * spring.stiffness * stretch * stretch
        if spring.next_cell == 1 and cell == 0 and shape.left_ghost < 0 and not shape.left_free:
            energy += 0.5 * spring.stiffness * y[spring.end * n] * y[spring.end * n]
    return kinetic, energy


@njit(error_model="numpy")
def measure(y: np.ndarray, lattice: LatticeRecord, unit: float, total: np.ndarray) -> None:
    """Kinetic, spring, contact and dissipated energy (2 whole numbers each) and the work (J) into ``total`` (9,).

    Carrying leaves every number below 2^53: their sums over ranks, as floats, are exact.
    """
    shape, contacts = lattice.shape, lattice.contacts
    sums = np.zeros((_WORK, 2), np.int64)
    for cell in range(shape.cells):
        kinetic, spring = _cell_energies(y, lattice, cell)
        _add(sums, _KINETIC, kinetic, unit)
        _add(sums, _SPRING, spring, unit)
    for i in range(lattice.site_cells.size):
        w, _ = relative_motion(y, lattice, i)
        _add(sums, _CONTACT, elastic_energy(contacts.law, abs(w) - contacts.sites[i].clearance), unit)
        _add(sums, _DISSIPATED, y[shape.dissipated + i], unit)
    for part in range(_WORK):
        carried = sums[part, 1] >> 40
        total[2 * part] = sums[part, 0] + carried
        total[2 * part + 1] = sums[part, 1] - (carried << 40)
    total[2 * _WORK] = y[shape.work] if shape.work >= 0 else 0.0
