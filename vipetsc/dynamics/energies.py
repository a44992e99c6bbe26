"""Energies of a distributed state, as sums of integers.

Each cell's energy is a whole number of a unit and a rest in multiples of unit/2^40; both are summed as integers, so
that neither the order nor the partition shows in the result.
"""

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.compiled import kernel, njit
from vipetsc.contact.law import elastic_energy
from vipetsc.dynamics.layout import LatticeRecord, Layout, create_record
from vipetsc.dynamics.ts.right_hand_side import relative_motion
from vipetsc.dynamics.ts.springs import CHUNK, add_smooth_energies, add_squares, displacement, is_varied

_FINE = 2.0**40  # multiples of the finer rest in one unit
LARGEST = 2.0**50
PARTS = 5  # that are summed
_KINETIC, _SPRING, _CONTACT, _DISSIPATED, _DAMPING = range(PARTS)


@kernel
def _add(sums: np.ndarray, part: int, energies: np.ndarray, unit: float) -> None:
    """Add energies in J to ``sums`` (part, 2) as multiples of ``unit`` and of unit/2^40."""
    whole_sum = fine_sum = np.int64(0)
    for i in range(energies.size):
        multiple = energies[i] * (1.0 / unit)
        whole = np.rint(multiple)
        # Not finite or far beyond the scale: the guard sees a runaway energy.
        is_small = abs(whole) < LARGEST
        whole_sum += np.int64(whole if is_small else LARGEST)
        fine_sum += np.int64(np.rint((multiple - whole) * _FINE) if is_small else 0.0)
    sums[part, 0] += whole_sum
    sums[part, 1] += fine_sum


@kernel
def _kinetic_energies(y: np.ndarray, lattice: LatticeRecord, first: int, energies: np.ndarray) -> None:
    """Kinetic energies of the cells from ``first`` on."""
    energies[:] = 0.0
    for mass in range(lattice.shape.dofs):
        begin = (lattice.shape.dofs + mass) * lattice.shape.cells + first
        inverse_mass = lattice.masses[mass].inverse_mass
        v = y[begin : begin + energies.size]
        if is_varied(lattice):
            inverse_masses = lattice.inverse_masses[mass * lattice.shape.cells + first :]
            for i in range(energies.size):
                energies[i] += 0.5 * v[i] * v[i] / inverse_masses[i]
            continue
        for i in range(energies.size):
            energies[i] += 0.5 * v[i] * v[i] / inverse_mass


@kernel
def _spring_energies(y: np.ndarray, lattice: LatticeRecord, first: int, energies: np.ndarray) -> None:
    """Spring energies of the cells from ``first`` on: springs to the next cell, and the first one's to a left wall."""
    shape, n = lattice.shape, lattice.shape.cells
    energies[:] = 0.0
    if is_varied(lattice):
        add_squares(y, lattice, first, 0, lattice.stiffness, energies)
        energies *= 0.5
        return
    for s in range(lattice.springs.size):
        spring = lattice.springs[s]
        leaves = spring.next_cell == 1 and first + energies.size == n
        inside = energies.size - leaves
        begin, end = spring.start * n + first, spring.end * n + first + spring.next_cell
        here, other = y[begin : begin + inside], y[end : end + inside]
        for i in range(inside):
            stretch = other[i] - here[i]
            energies[i] += 0.5 * spring.stiffness * stretch * stretch
        if leaves and not shape.right_free:
            stretch = displacement(y, lattice, n, spring.end) - y[spring.start * n + n - 1]
            energies[inside] += 0.5 * spring.stiffness * stretch * stretch
        if spring.next_cell == 1 and first == 0 and shape.left_ghost < 0 and not shape.left_free:
            energies[0] += 0.5 * spring.stiffness * y[spring.end * n] * y[spring.end * n]


@njit(error_model="numpy")
def measure(y: np.ndarray, lattice: LatticeRecord, unit: float) -> np.ndarray:
    """Kinetic, spring, contact energy, that dissipated in contacts and in dashpots, (5, 2): see ``_add``."""
    shape, contacts, sites = lattice.shape, lattice.contacts, 0
    sums, elastic = np.zeros((PARTS, 2), np.int64), np.empty(lattice.places.size)
    energies = np.empty(min(CHUNK, shape.cells))
    for first in range(0, shape.cells, CHUNK):
        of_cells = energies[: shape.cells - first]
        _kinetic_energies(y, lattice, first, of_cells)
        _add(sums, _KINETIC, of_cells, unit)
        _spring_energies(y, lattice, first, of_cells)
        if lattice.smooth.size > 0:
            add_smooth_energies(y, lattice, first, of_cells)
        _add(sums, _SPRING, of_cells, unit)
    for i in range(lattice.places.size):
        if lattice.places[i].ledger < 0:
            continue
        w, site = relative_motion(y, lattice, i)[0], contacts[i]
        elastic[sites] = elastic_energy(site.elastic, max(w - site.clearance, -w - site.clearance_minus))
        if site.preload != 0.0:  # beyond that of the static state, under the load that holds it
            elastic[sites] -= (
                elastic_energy(site.elastic, -min(site.clearance, site.clearance_minus)) + site.preload * w
            )
        sites += 1
    _add(sums, _CONTACT, elastic[:sites], unit)
    _add(sums, _DISSIPATED, y[shape.dissipated : shape.dissipated + sites], unit)
    if shape.damping >= 0:
        _add(sums, _DAMPING, y[shape.damping : shape.damping + shape.cells], unit)
    return sums


@njit(error_model="numpy")
def add_energy(sums: np.ndarray, energy: float, unit: float) -> None:
    """Add an ``energy`` in J to the springs' in the ``sums`` of ``measure``."""
    _add(sums, _SPRING, np.array([energy]), unit)


@dataclass(frozen=True)
class Energies:
    """Energies in J of samples, arrays (sample,): kinetic, spring and contact energy, work of the drives, dissipated.

    The work begins with the energy of the initial state. ``dissipated`` is that of contacts; that of dashpots is
    ``balanced`` where it is what the other energies leave, which then no residual tells anything of.
    """

    kinetic: np.ndarray
    spring: np.ndarray
    contact: np.ndarray
    work: np.ndarray
    dissipated: np.ndarray
    dissipated_by_damping: np.ndarray
    balanced: bool = False

    @property
    def total(self) -> np.ndarray:
        """Kinetic, spring and contact energy together."""
        return self.kinetic + self.spring + self.contact

    @property
    def residual(self) -> np.ndarray:
        """Work - dissipated - total: zero for an exact solution; NaN where dashpots are ``balanced``."""
        return self.work - self.dissipated - self.dissipated_by_damping - self.total + (np.nan if self.balanced else 0)


class EnergyMeter:
    """Measures the energies of a distributed state.

    They are summed as integers, whose sums do not depend on their order: multiples of ``unit`` in J, a power of two
    far below the run's energy scale, and a finer rest.
    """

    def __init__(self, model: Model, layout: Layout) -> None:
        self.comm, self._balanced = layout.comm, model.chain.is_damped and not layout.damped
        self.lattice = create_record(model, layout)
        speed = model.scale * model.drive.frequency
        # Cells that the packet covers; of an initial state, perhaps all.
        burst = (
            model.chain.cells
            if model.initial
            else min(max(drive.waveform.duration for drive in model.drives), model.end) * model.speed
        )
        scale = sum(model.chain.cell.masses) * speed**2 * max(burst, 1.0)
        self.unit = float(2.0 ** (np.floor(np.log2(scale)) - 36))
        self.largest = self.unit * LARGEST  # energy in J from which on the sums saturate

    def total(self, sums: np.ndarray, work: np.ndarray) -> Energies:
        """Energies of all ranks' shares: ``sums`` (sample, part, 2) of ``measure``, ``work`` (sample, drive) in J.

        All ranks must call it.
        """
        whole, fine = sums.T  # (part, sample) each
        # Carrying leaves every number below 2^53: their sums over ranks, as floats, are exact.
        carried = fine >> 40
        total = np.vstack([whole + carried, fine - (carried << 40), work.T])
        self.comm.Allreduce(MPI.IN_PLACE, total, MPI.SUM)
        *stored, lost, damping = total[:PARTS] * self.unit + total[PARTS : 2 * PARTS] * (self.unit / _FINE)
        kinetic, spring, contact, work = *stored, total[2 * PARTS :].sum(axis=0)
        if self._balanced:
            damping = work - lost - (kinetic + spring + contact)
        return Energies(kinetic, spring, contact, work, lost, damping, self._balanced)
