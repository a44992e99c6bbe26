"""Energies of a distributed state, as sums of integers.

Each cell's energy is a whole number of a unit and a rest in multiples of unit/2^40; both are summed as integers, so
that neither the order nor the partition shows in the result.
"""

from dataclasses import dataclass

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from vipetsc.case import Model
from vipetsc.compiled import njit
from vipetsc.contact.law import elastic_energy
from vipetsc.dynamics.layout import LatticeRecord, Layout, create_record
from vipetsc.dynamics.ts.right_hand_side import displacement, relative_motion

_FINE = 2.0**40  # multiples of the finer rest in one unit
_LARGEST = 2.0**50
_KINETIC, _SPRING, _CONTACT, _DISSIPATED = range(4)


@njit(error_model="numpy", forceinline=True)
def _add(sums: np.ndarray, part: int, energy: float, unit: float) -> None:
    """Add an energy in J to ``sums`` (part, 2) as multiples of ``unit`` and of unit/2^40."""
    multiple = energy * (1.0 / unit)
    whole = np.rint(multiple)
    if abs(whole) < _LARGEST:
        sums[part, 0] += np.int64(whole)
        sums[part, 1] += np.int64(np.rint((multiple - whole) * _FINE))
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
def measure(y: np.ndarray, lattice: LatticeRecord, unit: float) -> np.ndarray:
    """Kinetic, spring, contact and dissipated energy (4, 2), as multiples of ``unit`` and of unit/2^40."""
    shape, contacts = lattice.shape, lattice.contacts
    sums = np.zeros((4, 2), np.int64)
    for cell in range(shape.cells):
        kinetic, spring = _cell_energies(y, lattice, cell)
        _add(sums, _KINETIC, kinetic, unit)
        _add(sums, _SPRING, spring, unit)
    for i in range(lattice.site_cells.size):
        w, _ = relative_motion(y, lattice, i)
        _add(sums, _CONTACT, elastic_energy(contacts.law, abs(w) - contacts.sites[i].clearance), unit)
        _add(sums, _DISSIPATED, y[shape.dissipated + i], unit)
    return sums


@dataclass(frozen=True)
class Energies:
    """Energies in J at one time: kinetic, spring and contact energy, work of the drive, dissipated energy."""

    kinetic: float
    spring: float
    contact: float
    work: float
    dissipated: float

    @property
    def total(self) -> float:
        """Kinetic, spring and contact energy together."""
        return self.kinetic + self.spring + self.contact

    @property
    def residual(self) -> float:
        """Work - dissipated - total: zero for an exact solution."""
        return self.work - self.dissipated - self.total


class EnergyMeter:
    """Measures the energies of a distributed state.

    They are summed as integers, whose sums do not depend on their order: multiples of ``unit`` in J, a power of two
    far below the run's energy scale, and a finer rest.
    """

    def __init__(self, model: Model, layout: Layout) -> None:
        self.comm = layout.comm
        self._lattice = create_record(model, layout)
        speed = model.scale * model.drive.frequency
        burst = model.drive.duration * model.speed  # cells that the packet covers
        scale = sum(model.chain.cell.masses) * speed**2 * max(burst, 1.0)
        self.unit = float(2.0 ** (np.floor(np.log2(scale)) - 36))
        self.largest = self.unit * _LARGEST  # energy in J from which on the sums saturate

    def measure(self, state: PETSc.Vec) -> Energies:
        """Energies of ``state``, whose ghosts must be up to date; all ranks must call it."""
        with state.localForm() as local:
            whole, fine = measure(local.array, self._lattice, self.unit).T
            work = local.array[self._lattice.shape.work] if self._lattice.shape.work >= 0 else 0.0
        # Carrying leaves every number below 2^53: their sums over ranks, as floats, are exact.
        carried = fine >> 40
        total = np.hstack([whole + carried, fine - (carried << 40), work])
        self.comm.Allreduce(MPI.IN_PLACE, total, MPI.SUM)
        kinetic, spring, contact, dissipated = (total[:4] * self.unit + total[4:8] * (self.unit / _FINE)).tolist()
        return Energies(kinetic, spring, contact, float(total[8]), dissipated)
