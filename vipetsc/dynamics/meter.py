"""Energies of a distributed state, to the same bits for every partition."""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from vipetsc.case import Model
from vipetsc.dynamics.energies import FINE, measure
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.records import create_record


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
        self._total = np.zeros(9)

    @property
    def largest(self) -> float:
        """Energy in J from which on the sums saturate."""
        return self.unit * 2.0**50

    def measure(self, state: PETSc.Vec) -> Energies:
        """Energies of ``state``, whose ghosts must be up to date; all ranks must call it."""
        total = self._total
        with state.localForm() as local:
            measure(local.array, self._lattice, self.unit, total)
        self.comm.Allreduce(MPI.IN_PLACE, total, MPI.SUM)
        *pairs, work = total.tolist()
        sums = [a * self.unit + b * (self.unit / FINE) for a, b in zip(pairs[::2], pairs[1::2], strict=True)]
        kinetic, spring, contact, dissipated = sums
        return Energies(kinetic, spring, contact, work, dissipated)
