"""Compiled energies of a rank's part of the lattice, as sums of integers.

Each cell's energy is a whole number of a unit and a rest in multiples of unit/2^40; both are summed as integers, so
that neither the order nor the partition shows in the result.
"""

from __future__ import annotations

import numpy as np

from vipetsc.compiled import njit
from vipetsc.contact.law import elastic_energy
from vipetsc.dynamics.records import LatticeRecord
from vipetsc.dynamics.ts.right_hand_side import CHUNK, displacement

# Parts of a sum, two integers each: kinetic, spring, contact, dissipated.
KINETIC, SPRING_ENERGY, CONTACT_ENERGY, DISSIPATED = 0, 2, 4, 6
PARTS = 4

FINE = 2.0**40
"""Multiples of the finer rest in one unit."""

_LARGEST = 2.0**50


@njit(error_model="numpy")
def _add_exactly(sums: np.ndarray, part: int, values: np.ndarray, unit: float) -> None:
    """Add energies in J to ``sums[part]`` in units and to the next entry in units of unit/2^40."""
    coarse, fine = np.int64(0), np.int64(0)
    for i in range(values.size):
        multiple = values[i] * (1.0 / unit)
        whole = np.rint(multiple)
        if abs(whole) < _LARGEST:
            coarse += np.int64(whole)
            fine += np.int64(np.rint((multiple - whole) * FINE))
        else:  # not finite or far beyond the scale: the guard sees a runaway energy
            coarse += np.int64(_LARGEST)
    sums[part] += coarse
    sums[part + 1] += fine


@njit(error_model="numpy")
def _add_kinetic(out: np.ndarray, v: np.ndarray, inverse_mass: float) -> None:
    for i in range(out.size):
        out[i] += 0.5 * v[i] * v[i] / inverse_mass


@njit(error_model="numpy")
def _add_spring(out: np.ndarray, end: np.ndarray, start: np.ndarray, stiffness: float) -> None:
    for i in range(out.size):
        stretch = end[i] - start[i]
        out[i] += 0.5 * stiffness * stretch * stretch


@njit(error_model="numpy")
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
def _add_cells(sums: np.ndarray, y: np.ndarray, lattice: LatticeRecord, unit: float) -> None:
    """Add the kinetic and spring energies of all owned cells."""
    n, d = lattice.shape.cells, lattice.shape.dofs
    kinetic, stretched = np.empty(CHUNK), np.empty(CHUNK)
    for a in range(0, n, CHUNK):
        b = min(a + CHUNK, n)
        held, springs = kinetic[: b - a], stretched[: b - a]
        held[:] = 0.0
        springs[:] = 0.0
        for mass in range(d):
            _add_kinetic(held, y[(d + mass) * n + a : (d + mass) * n + b], lattice.masses[mass].inverse_mass)
        for s in range(lattice.springs.size):
            spring = lattice.springs[s]
            ahead = spring.next_cell
            start, end = spring.start * n, spring.end * n + ahead
            last = min(b, n - ahead)
            _add_spring(springs[: last - a], y[end + a : end + last], y[start + a : start + last], spring.stiffness)
        for cell in (0, n - 1):
            if a <= cell < b:
                held[cell - a], springs[cell - a] = _cell_energies(y, lattice, cell)
        _add_exactly(sums, KINETIC, held, unit)
        _add_exactly(sums, SPRING_ENERGY, springs, unit)


@njit(error_model="numpy")
def measure(y: np.ndarray, lattice: LatticeRecord, unit: float, total: np.ndarray) -> None:
    """Kinetic, spring, contact and dissipated energy (2 whole numbers each) and the work (J) into ``total`` (9,).

    Carrying leaves every number below 2^53: their sums over ranks, as floats, are exact.
    """
    shape, contacts = lattice.shape, lattice.contacts
    sums = np.zeros(2 * PARTS, np.int64)
    _add_cells(sums, y, lattice, unit)
    stored = np.zeros(lattice.site_cells.size)
    for i in range(stored.size):
        cell = lattice.site_cells[i]
        w = y[shape.resonator * shape.cells + cell] - y[shape.host * shape.cells + cell]
        stored[i] = elastic_energy(contacts.law, abs(w) - contacts.sites[i].clearance)
    _add_exactly(sums, CONTACT_ENERGY, stored, unit)
    _add_exactly(sums, DISSIPATED, y[shape.dissipated : shape.dissipated + stored.size], unit)
    for part in range(PARTS):
        carried = sums[2 * part + 1] >> 40
        total[2 * part] = sums[2 * part] + carried
        total[2 * part + 1] = sums[2 * part + 1] - (carried << 40)
    total[2 * PARTS] = y[shape.work] if shape.work >= 0 else 0.0
