"""Branches of periodic orbits by shooting."""

import itertools
import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import cast

import numpy as np

from vipetsc.case import NnmCase
from vipetsc.case.nnm import NnmTable
from vipetsc.io.branch_kinds import ORBITS
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.branch_checks import BranchMonitor, sampled
from vipetsc.modes.branches.losses import dissipation_of, with_orbits_loss
from vipetsc.modes.branches.method import CrossingBranch, Method, Monitor, value_kind
from vipetsc.modes.branches.regions import regions
from vipetsc.modes.continuation.arclength import GuardedSteps, OrbitProblem, StepRule, at_energy
from vipetsc.modes.continuation.switching import switch
from vipetsc.modes.flow import MAPS, Dop853Flow, ShootingMap, map_between_impacts
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError, NoMotionError, PeriodicProblem, SpecialKind
from vipetsc.modes.shared_frequencies import check_start
from vipetsc.modes.shooting import Shooting, linear_start
from vipetsc.modes.system import System
from vipetsc.parallel import StopRequest

# What divides the energy at which a mode first touches a contact, and the largest force of springs that are not linear
# over the linear force: a branch begins below both, almost linear. A mode that feels neither is linear at every energy,
# and begins at the last number in J.
BELOW_TOUCH = 100
NONLINEAR_FORCE = 1e-4
LINEAR_ENERGY = 1e-3
# How far above the lowest energy asked for a branch begins at least.
ABOVE_LOWEST = 1.001


class NnmMethod(Method[Point]):
    """Base of the methods for normal modes, with the options of [nnm] that all of them have.

    ``unknowns`` are as many as a branch's file counts of each point; ``system`` is that whose modes begin branches.
    """

    case: NnmCase
    unknowns: int
    system: System | None

    def __init__(self, case: NnmCase) -> None:
        super().__init__(case)
        self.options = case.nnm
        self.locates = case.nnm.locate

    def new_branch(self, name: str) -> Branch[Point]:
        """Return a branch without points."""
        return Branch(name, self.case.to_toml(), self.unknowns, self.kind)

    def name(self, job: int) -> str:
        """Return the name of the branch of a mode."""
        assert self.system is not None
        return self.system.branch_name(job)

    def energy_of_mode(self, job: int) -> float:
        """Return the energy in J at which a branch by harmonics begins; raises ContinuationError for a linear mode."""
        system = self.system
        assert system is not None
        if not system.moves(job).any():
            raise ContinuationError(
                f"mode {job + 1} has a node at every contact and nonlinear spring, and is linear at all energies: "
                "choose another one (nnm.modes)"
            )
        energy = start_energy(self.options, system, job)
        check_start(system, job, energy)
        return energy

    def rule(self, problem: PeriodicProblem[Point], start: Point, done: int) -> StepRule[Point]:
        """Return guarded steps to the end of the ranges."""
        return guarded_steps(problem, self.options, done)

    def chosen(self, problem: PeriodicProblem[Point]) -> list[SpecialKind[Point]]:
        """Return the points at the values ``nnm.points_at``."""

        def quantity(name: str, point: Point) -> float:
            # Points have their frequency in Hz, keys in rad/s.
            if name == "frequency":
                return 2 * np.pi / point.period
            return float(getattr(point, name))

        return [
            value_kind(name, value, partial(quantity, name))
            for name, values in self.options.points_at.items()
            for value in values
        ]

    @property
    def directions(self) -> tuple[int, ...]:
        """The directions of ``nnm.direction``: 1 towards growing energy, -1 towards falling energy."""
        return {"up": (1,), "down": (-1,), "both": (1, -1)}[self.options.direction]

    def asked(self, problem: PeriodicProblem[Point], branch: Branch[Point]) -> Iterator[Point]:
        """Yield the orbits at the energies ``nnm.orbits_at``, wherever the branch passes one.

        The ``branch`` says which are ``missing``.
        """
        # A branch that was stopped or had used up its points has such sentences already, which may no longer be true.
        branch.missing = []
        for energy in self.options.orbits_at:
            passed = False
            for left, right in itertools.pairwise(branch.regular()):
                if (left.energy < energy) == (right.energy < energy):
                    continue
                passed = True
                try:
                    yield at_energy(problem, left, right, energy, self.options.chart)
                # The branch itself is complete; what it lacks stands in its file as a finding.
                except NoMotionError as error:
                    branch.missing.append(f"the orbit of {energy:g} J after point {left.index} is not found: {error}")
            if not passed:
                branch.missing.append(f"the branch has no orbit of {energy:g} J")


def guarded_steps(problem: PeriodicProblem[Point], control: NnmTable, done: int) -> GuardedSteps:
    """Return steps by [nnm] of a branch that has ``done`` points after its start."""
    # ``points`` limits the whole branch, so that one that is resumed ends where an unbroken one would.
    remaining = control.model_copy(update={"points": max(control.points - done, 0)})
    # The problems of normal modes say when contacts act, which the method's type does not tell.
    return GuardedSteps(cast(OrbitProblem, problem), remaining)


def map_of(system: System) -> ShootingMap:
    """Return the part of the period that is shot."""
    if system.has_rigid_stops:
        return map_between_impacts(system.odd)
    # The quarter map assumes u(t + T/2) = -u(t), which holds for forces that change sign with the displacement.
    if system.odd:
        return MAPS["quarter"]
    return MAPS["half"]


def start_energy(options: NnmTable, system: System, mode: int) -> float:
    """Return energy in J of the first point of the branch of ``mode`` (from 0): well below a touch, almost linear."""
    if options.start_energy != "auto":
        return options.start_energy
    energy = min(system.grazing_energy(mode) / BELOW_TOUCH, system.nonlinear_energy(mode, NONLINEAR_FORCE))
    if not math.isfinite(energy):
        energy = LINEAR_ENERGY
    return max(energy, options.energy[0] * ABOVE_LOWEST)


class ShootingMethod(NnmMethod):
    """Branches of orbits by ``Shooting``, with the checks that half-traces allow."""

    kind = ORBITS
    system: System

    def __init__(self, case: NnmCase) -> None:
        super().__init__(case)
        options = case.nnm
        self.system = System.from_case(case)
        self.unknowns = self.system.dofs
        self.dissipation = dissipation_of(case)
        self.locates_grazing = options.locate_grazing
        self.crossing_options = options.model_copy(update={"points": options.switch_points, "chart": "relative"})

        flow = Dop853Flow(self.system)
        self.shooting = Shooting(flow, map_of(self.system), options.tolerance, options.max_newton)

    def problem(self, job: int) -> Shooting:
        """Return the shooting equations of the case."""
        return self.shooting

    def start(self, problem: PeriodicProblem[Point], job: int, stop: StopRequest | None = None) -> Point:
        """Return the orbit of a linear mode at a small energy."""
        return linear_start(self.shooting, job, start_energy(self.options, self.system, job))

    def assess(self, problem: PeriodicProblem[Point], point: Point) -> Point:
        """Return the point with its loss, if anything dissipates."""
        if not self.dissipation.acts:
            return point
        # A branch that crosses another one may have another map, and with it other initial values.
        assert isinstance(problem, Shooting)
        return with_orbits_loss(problem, self.dissipation, point)

    def monitor(self, problem: PeriodicProblem[Point]) -> Monitor[Point]:
        """Return the check of every new point: whether the branch retraces itself, stands still or is another one."""
        assert isinstance(problem, Shooting)
        return BranchMonitor(problem, self.options.guards).check

    def finish(self, problem: PeriodicProblem[Point], branch: Branch[Point]) -> None:
        """Add the orbits of a branch."""
        orbits = [*self._typical(branch), *self.asked(problem, branch)]
        branch.extra = sampled(self.shooting, orbits)

    def _typical(self, branch: Branch[Point]) -> list[Point]:
        """Return the regular points in the middle of every region."""
        by_region: dict[int, list[Point]] = {}
        for point, region in zip(branch.points, regions(branch).tolist(), strict=True):
            if point.kind == "regular":
                by_region.setdefault(region, []).append(point)
        groups = [by_region[region] for region in sorted(by_region)]
        return [group[len(group) // 2] for group in groups]

    def further(self, branch: Branch[Point], followed: Sequence[Branch[Point]]) -> Iterator[CrossingBranch]:
        """Yield the branches that cross at the kinds of special points in ``nnm.switch``."""
        for kind in self.options.switch:
            special = [p for p in branch.points if p.kind == kind]
            for number, point in enumerate(special, 1):
                start = partial(switch, self.shooting, point)
                yield CrossingBranch(name=f"{branch.name}-{kind}-{number}", start=start, rule=self._crossing_rule)

    def _crossing_rule(self, problem: PeriodicProblem[Point], start: Point, done: int) -> StepRule[Point]:
        """Return the steps by [nnm] in the relative chart: the crossing branch has its own contacts at its start."""
        return guarded_steps(problem, self.crossing_options, done)
