"""The energy ledger: work of the drive, what contacts dissipated, what the lattice holds."""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from vipetsc.case import Model
from vipetsc.dynamics.energies import FINE, measure
from vipetsc.dynamics.operator import LatticeOperator

# A ledger that misses by this share of the largest work is no longer a solution but an instability.
RUNAWAY = 0.1


@dataclass(frozen=True)
class Energies:
    """Energies in J at one time: kinetic, spring and contact energy, work of the drive, dissipated energy."""

    kinetic: float
    spring: float
    contact: float
    work: float
    dissipated: float

    @property
    def residual(self) -> float:
        """Work - dissipated - (kinetic + spring + contact): zero for an exact solution."""
        return self.work - self.dissipated - (self.kinetic + self.spring + self.contact)


class Ledger:
    """Measures the energies of a distributed state; the sums are the same bits for every partition.

    Energies are summed as integers: multiples of a unit far below the run's energy scale, and a finer rest.
    """

    def __init__(self, model: Model, operator: LatticeOperator) -> None:
        self.operator = operator
        self.comm = operator.layout.comm
        speed = model.scale * model.drive.frequency
        burst = model.drive.duration * model.speed  # cells that the packet covers
        scale = sum(model.chain.cell.masses) * speed**2 * max(burst, 1.0)
        self.unit = float(2.0 ** (np.floor(np.log2(scale)) - 36))
        self.worst = 0.0
        self.most_work = 0.0
        self._total = np.zeros(9)

    def measure(self, state: PETSc.Vec) -> Energies:
        """Energies of ``state``, whose ghosts must be up to date; all ranks must call it."""
        total = self._total
        with state.localForm() as local:
            measure(local.array, self.operator.lattice, self.unit, total)
        self.comm.Allreduce(MPI.IN_PLACE, total, MPI.SUM)
        *parts, work = total.tolist()
        held = [a * self.unit + b * (self.unit / FINE) for a, b in zip(parts[::2], parts[1::2], strict=True)]
        kinetic, spring, contact, dissipated = held
        return Energies(kinetic, spring, contact, work, dissipated)

    def check(self, energies: Energies) -> str | None:
        """What is wrong with a state of these energies, or None; keeps the largest residual and work."""
        saturated = self.unit * 2.0**50
        total = energies.kinetic + energies.spring + energies.contact
        if not (np.isfinite(energies.work) and total < saturated):
            return "the state is not finite"
        self.most_work = max(self.most_work, abs(energies.work))
        if abs(energies.residual) > RUNAWAY * self.most_work and total > 1e-12 * saturated:
            return f"the energy runs away: {total:.4g} J in the lattice, {energies.work:.4g} J of work done"
        self.worst = max(self.worst, abs(energies.residual))
        return None

    @property
    def error(self) -> float:
        """Largest residual so far over the largest work."""
        return self.worst / self.most_work if self.most_work else 0.0
