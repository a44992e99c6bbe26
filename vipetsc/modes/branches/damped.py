"""Branches of damped modes: ``nnm.method = "damped"``."""

from dataclasses import replace

import numpy as np

from vipetsc.case import NnmCase
from vipetsc.case.nnm import MOST_OF_DAMPED, NnmTable
from vipetsc.io.branch_kinds import DAMPED
from vipetsc.modes.balance.damped import DampedBalance
from vipetsc.modes.balance.free_motions import FEWEST, FreeMotions, forces_of_system
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.branches.losses import dissipation_of
from vipetsc.modes.branches.orbits import NnmMethod
from vipetsc.modes.point import Point
from vipetsc.modes.problem import PeriodicProblem
from vipetsc.modes.system import System
from vipetsc.parallel import StopRequest


class DampedModes(FreeMotions[DampedBalance]):
    """Branches of damped modes of a ``system`` (``DampedBalance``), which begin at its linear ``mode``, from 0."""

    def __init__(self, system: System, damping: np.ndarray, forces: SiteForces, control: NnmTable, mode: int) -> None:
        super().__init__(forces, control)
        self.system = system
        self.damping = damping
        self.mode = mode

    def new_equations(self, order: int) -> DampedBalance:
        """Return the equations of modes with harmonics up to ``order``."""
        return DampedBalance(self.system, self.damping, self.forces, order, self.mode)

    def start(self, energy: float) -> Point:
        """Return the motion of about an ``energy`` in J near the linear mode; raises ContinuationError without one."""
        frequencies, shapes = self.system.linear_modes()
        omega = float(frequencies[self.mode])
        shape = shapes[:, self.mode]
        u = np.zeros((self.system.dofs, FEWEST + 1), complex)
        u[:, 1] = shape * np.sqrt(2 * energy) / omega
        zeta = float(shape @ self.damping @ shape) / (2 * omega)
        return self.refined(self.guess(np.append(zeta, self.balance(FEWEST).pack(u)), omega))


class DampedMethod(NnmMethod):
    """Branches of ``DampedModes``."""

    kind = DAMPED
    system: System

    def __init__(self, case: NnmCase) -> None:
        super().__init__(case)
        self.system = System.from_case(case)
        self.unknowns = len(self.system.contacts) + len(self.system.springs)

    def problem(self, job: int) -> DampedModes:
        """Return the equations of the case, for the mode of a branch."""
        dissipation = dissipation_of(self.case)
        damping = np.zeros((self.system.dofs, self.system.dofs))
        if dissipation.damping.nnz:
            damping = dissipation.damping.toarray()
        forces = forces_of_system(self.system, dissipation.laws)
        most = min(self.options.harmonics, MOST_OF_DAMPED)
        return DampedModes(self.system, damping, forces, self.options.model_copy(update={"harmonics": most}), mode=job)

    def start(self, problem: PeriodicProblem[Point], job: int, stop: StopRequest | None = None) -> Point:
        """Return the motion of a linear mode at a small energy."""
        assert isinstance(problem, DampedModes)
        return problem.start(self.energy_of_mode(job))

    def assess(self, problem: PeriodicProblem[Point], point: Point) -> Point:
        """Return the point with its damping ratio and its loss."""
        assert isinstance(problem, DampedModes)
        loss = problem.balance(point.order).loss(point.x, 2 * np.pi / point.period)
        return replace(point, zeta=float(point.x[0]), loss=loss)
