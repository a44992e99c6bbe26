"""Branches of damped modes: ``nnm.method = "damped"``."""

import numpy as np

from vipetsc.case import NnmCase
from vipetsc.case.nnm import MOST_OF_DAMPED
from vipetsc.io.branch_kinds import DAMPED
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.branches.losses import dissipation_of
from vipetsc.modes.branches.orbits import NnmMethod, start_energy
from vipetsc.modes.damped_modes import DampedModes
from vipetsc.modes.point import Point
from vipetsc.modes.problem import PeriodicProblem, StartError
from vipetsc.modes.shared_frequencies import check_start
from vipetsc.modes.system import System
from vipetsc.parallel import StopRequest


class DampedMethod(NnmMethod):
    """Branches of ``DampedModes``."""

    kind = DAMPED
    system: System

    def __init__(self, case: NnmCase) -> None:
        super().__init__(case)
        self.system = System.from_case(case)
        self.unknowns = self.problem(0).size + 1

    def problem(self, job: int) -> DampedModes:
        """Return the equations of the case, for the mode of a branch."""
        dissipation = dissipation_of(self.case)
        damping = np.zeros((self.system.dofs, self.system.dofs))
        if dissipation.damping.nnz:
            damping = dissipation.damping.toarray()
        pairs = zip(self.system.contacts, dissipation.laws, strict=True)
        stops = [pair.stops._replace(law=law, spring=pair.stops.slope_at_rest) for pair, law in pairs]
        forces = SiteForces(stops, [spring.law for spring in self.system.springs])
        order = min(self.options.harmonics, MOST_OF_DAMPED)
        return DampedModes(
            self.system, damping, forces, order, self.options.tolerance, self.options.max_newton, mode=job
        )

    def start(self, problem: PeriodicProblem[Point], job: int, stop: StopRequest | None = None) -> Point:
        """Return the motion of a linear mode at a small energy."""
        if not self.system.moves(job).any():
            raise StartError(
                f"mode {job + 1} has a node at every contact and nonlinear spring: its frequency and damping are those "
                "of the linear mode at all energies; choose another one (nnm.modes)"
            )
        energy = start_energy(self.options, self.system, job)
        check_start(self.system, job, energy)
        assert isinstance(problem, DampedModes)
        return problem.start(energy)
