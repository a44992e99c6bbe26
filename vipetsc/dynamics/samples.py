"""Samples of the state: arrays that an engine fills in compiled code, and the blocks that observers see."""

from dataclasses import dataclass
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.contact.law import contact_force
from vipetsc.dynamics.drives import drive_force, lost_power, select_piece, wall_energy
from vipetsc.dynamics.energies import DAMPING, LARGEST, SPRING, Energies, add_one, add_powers, measure
from vipetsc.dynamics.equation import acceleration
from vipetsc.dynamics.lattice_record import LatticeRecord
from vipetsc.dynamics.site_dofs import relative_motion


class Samples(NamedTuple):
    """Arrays for consecutive samples of a rank, the first of which has the ``number``; empty arrays take nothing.

    Energies: ``sums`` (sample, energy, 2) as ``measure`` gives them, ``work`` (sample, drive) of all drives and
    ``losses`` (sample, owned site) in J. ``fields`` (recorded sample, field, dof, cell) are those of the samples whose
    numbers ``stride`` divides: velocities where ``moving`` (field,), else displacements, of every n-th owned cell from
    ``first_cell`` on, n = ``every``. ``interval`` in s is that of all samples. ``forces`` (sample, owned site) in N are
    those of the contacts, and ``motion`` (sample, 3, point) displacement, velocity and acceleration of the masses
    ``watched`` (point, 2), an owned cell and a mass of it, on which the contacts ``pushes`` (push, 3) act
    (``points.PointMotion``).
    """

    number: int
    sums: np.ndarray
    work: np.ndarray
    losses: np.ndarray
    fields: np.ndarray
    moving: np.ndarray
    first_cell: int
    every: int
    stride: int
    lattice: LatticeRecord
    unit: float
    interval: float
    forces: np.ndarray
    motion: np.ndarray
    watched: np.ndarray
    pushes: np.ndarray

    def recorded_rows(self, samples: int) -> int:
        """Return how many of the first ``samples`` samples have recorded fields."""
        # The stride divides ceil(n/stride) of the numbers below n.
        return -(-(self.number + samples) // self.stride) + -self.number // self.stride


@kernel
def take_sample(y: np.ndarray, k: int, samples: Samples, contacts: np.ndarray, places: np.ndarray) -> bool:
    """Store the rank's part ``y`` (component,) of the state, ghosts up to date, as sample ``k``; whether it is finite.

    ``contacts`` of dtype ``SITE`` have the modes of the sites; ``places`` (site,) are those of ``Layout.acting_sites``.
    """
    shape = samples.lattice.shape
    drives = samples.lattice.drives
    number = samples.number + k
    measure(y, samples.lattice, samples.unit, samples.sums[k])
    # Where no engine integrates what dashpots dissipate, the sample has their power instead.
    if shape.damping < 0 and samples.lattice.damping.size > 0:
        add_powers(y, samples.lattice, samples.interval, samples.unit, samples.sums[k])

    for i in range(drives.rows.size):
        drive = drives.rows[i]
        samples.work[k, drive.number] = y[shape.work + i]
        time = number * samples.interval
        # The state's work is that of the force k U; the further work of a moving wall is stored in its spring.
        if drive.stiffness != 0.0:
            energy = wall_energy(drives, i, time, y[drive.target - shape.dofs * shape.cells])
            samples.work[k, drive.number] += energy
            add_one(samples.sums[k], SPRING, energy, samples.unit)
        if drive.damping != 0.0 and shape.damping < 0:
            select_piece(drives, i, time)
            lost = lost_power(drives, i, drive_force(drives, i, time), y[drive.target])
            add_one(samples.sums[k], DAMPING, samples.interval * lost, samples.unit)
    for i in range(samples.losses.shape[1]):
        samples.losses[k, i] = y[shape.dissipated + i]

    # By the number in the run, not in the block: blocks may begin anywhere, and a resumed run records the same samples.
    if number % samples.stride == 0:
        _record_fields(y, number, samples)
    if samples.forces.shape[0] > 0:
        _record_forces(y, k, samples, contacts, places)
    if samples.watched.shape[0] > 0:
        _record_points(y, k, samples, contacts, places)
    return _is_finite(samples, k)


@kernel
def _is_finite(samples: Samples, k: int) -> bool:
    """Return whether all energies of sample ``k`` are numbers, and below where their sums saturate."""
    finite = True
    for i in range(samples.sums.shape[1]):
        finite &= samples.sums[k, i, 0] < LARGEST
    for i in range(samples.work.shape[1]):
        finite &= abs(samples.work[k, i]) < np.inf
    return finite


@kernel
def _record_fields(y: np.ndarray, number: int, samples: Samples) -> None:
    """Record the fields of the sample with the ``number``, which the stride divides."""
    shape = samples.lattice.shape
    row = number // samples.stride - (samples.number + samples.stride - 1) // samples.stride
    for i in range(samples.fields.shape[1]):
        for mass in range(shape.dofs):
            out = samples.fields[row, i, mass]
            first = (mass + shape.dofs * samples.moving[i]) * shape.cells + samples.first_cell
            for c in range(out.size):
                out[c] = y[first + c * samples.every]


@kernel
def _record_forces(y: np.ndarray, k: int, samples: Samples, contacts: np.ndarray, places: np.ndarray) -> None:
    """Record the contact forces of sample ``k``; ``contacts`` and their ``places`` are as in ``take_sample``."""
    lattice = samples.lattice
    for i in range(lattice.site_dofs.size):
        column = lattice.site_dofs[i].ledger - lattice.shape.dissipated
        if column >= 0:
            w, rate = relative_motion(y, lattice.site_dofs, i)
            samples.forces[k, column] = contact_force(contacts, places[i], w, rate)[0]


@kernel
def _record_points(y: np.ndarray, k: int, samples: Samples, contacts: np.ndarray, places: np.ndarray) -> None:
    """Record the motion of the watched masses at sample ``k``, ``contacts`` and ``places`` as in ``take_sample``."""
    lattice = samples.lattice
    n = lattice.shape.cells
    t = (samples.number + k) * samples.interval
    for i in range(lattice.drives.rows.size):
        select_piece(lattice.drives, i, t)
    # The contacts' forces beyond those of the static state come first: there are few, and each is at a known point.
    samples.motion[k] = 0.0
    for j in range(samples.pushes.shape[0]):
        site = samples.pushes[j, 1]
        w, rate = relative_motion(y, lattice.site_dofs, site)
        force = contact_force(contacts, places[site], w, rate)[0] - contacts[places[site]].preload
        samples.motion[k, 2, samples.pushes[j, 0]] += samples.pushes[j, 2] * force

    for i in range(samples.watched.shape[0]):
        cell = samples.watched[i, 0]
        mass = samples.watched[i, 1]
        samples.motion[k, 0, i] = y[mass * n + cell]
        samples.motion[k, 1, i] = y[(lattice.shape.dofs + mass) * n + cell]
        samples.motion[k, 2, i] = acceleration(t, y, lattice, cell, mass, samples.motion[k, 2, i])


@dataclass(frozen=True)
class Block:
    """Consecutive samples of a run: ``times`` (sample,) in s, the number ``first`` of the first one, from 0.

    ``energies`` are those of the whole lattice, arrays (sample,). ``samples`` are what this rank took, where ``losses``
    and ``fields`` begin with these samples. ``state`` is the last one that the engine came to, ordered as ``Layout``
    says, ghosts up to date; it changes with the next block.
    """

    first: int
    times: np.ndarray
    energies: Energies
    samples: Samples
    state: PETSc.Vec

    def __len__(self) -> int:
        return len(self.times)
