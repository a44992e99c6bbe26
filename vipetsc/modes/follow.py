"""Follow the branches of a case: one by one or shared over ranks, saved as they grow, resumed where they ended."""

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.case import NnmCase
from vipetsc.case.nnm import NnmTable
from vipetsc.io.folder import BRANCHES, claim_folder, provenance
from vipetsc.modes.audit import BranchMonitor, compare, jumps, sampled
from vipetsc.modes.branch import Branch
from vipetsc.modes.continuation import Continuation, ContinuationError
from vipetsc.modes.dop853 import Dop853Flow
from vipetsc.modes.flow import Flow, FlowError
from vipetsc.modes.point import Point, linear_start
from vipetsc.modes.reference import FiniteDifferences, Newmark, Tsrk
from vipetsc.modes.shooting import MAPS, Shooting
from vipetsc.modes.special import locate, switch
from vipetsc.modes.system import System

# The flows by their names in case files.
FLOWS: dict[str, type[Flow]] = {flow.name: flow for flow in (Dop853Flow, Tsrk, Newmark)}
# Points between two writings of a growing branch.
SAVE_EVERY = 500
FAILURES = (ContinuationError, FlowError, ValueError)

Listener = Callable[[Branch, Point], None]


def prepare_folder(case: NnmCase, folder: Path, force: bool, resume: bool) -> None:
    """Make ``folder`` ready for the branches of ``case`` (rank 0 only); raises FolderError if it is not ours."""

    def difference(earlier: str) -> str | None:
        same = NnmCase.from_toml(earlier).physics() == case.physics()
        return None if same else "--resume needs the system, map and flow that its branches were begun with"

    claim_folder(folder, BRANCHES, case.to_toml(), force=force, resume=resume, difference=difference)


def follow_all(
    case: NnmCase, folder: Path, comm: MPI.Comm, resume: bool = False, listener: Listener | None = None
) -> list[Branch]:
    """All branches of ``case``, written into ``folder``; rank r follows every size-th one, from r on.

    Each branch is computed on one rank, so that its bits do not depend on their number. A branch that fails is
    written as far as it came, says why in its ``ending``, and the others go on. Returns all branches on rank 0, in the
    order of ``nnm.modes``; an empty list on the others.
    """
    mine = {}
    for job in range(comm.rank, len(case.nnm.modes), comm.size):
        mine[job] = Follower(case, folder, provenance(comm), listener).follow(case.nnm.modes[job] - 1, resume)
    branches = {job: group for part in comm.gather(mine) or [] for job, group in part.items()}
    return [branch for job in sorted(branches) for branch in branches[job]]


class Follower:
    """Follows the branches of a case into a folder; ``about`` are attributes of the files."""

    def __init__(self, case: NnmCase, folder: Path, about: dict[str, Any], listener: Listener | None = None) -> None:
        self.case, self.options, self.folder, self.about, self.listener = case, case.nnm, folder, about, listener
        sys.audit("vipetsc.set-up", case.name)
        options, self.system = case.nnm, System.from_case(case)
        flow: Flow = FLOWS[options.flow](self.system)
        automatic = "quarter" if self.system.odd else "half"
        flow = FiniteDifferences(flow) if options.jacobian == "differences" else flow
        shooting_map = MAPS[automatic if options.map == "auto" else options.map]
        self.problem = Shooting(flow, shooting_map, options.tolerance, options.max_newton)

    def follow(self, mode: int, resume: bool = False) -> list[Branch]:
        """The branch of ``mode`` (0-based), then the branches that cross it if the case asks for them."""
        sys.audit("vipetsc.member", mode + 1)
        name, options = self.system.branch_name(mode), self.options
        branch, path = self._empty(name), self.folder / f"branch-{name}.h5"
        if resume and path.exists():
            branch = Branch.read(path)
            branch.case = self.case.to_toml()
            if branch.complete:
                return [branch]
        try:
            start = branch.regular()[-1] if branch.points else self._start(mode)
            if options.direction == "both" and not branch.points:
                down = self._empty(name)
                self.grow(down, self.problem, start, options, -1)
                # from the far end towards the start, with the tangents turned round
                branch.points = [
                    replace(p, tangent=-p.tangent, energy_tangent=-p.energy_tangent) for p in reversed(down.points)
                ]
                branch.findings += down.findings
            direction = -1 if options.direction == "down" else 1
            self.grow(branch, self.problem, start, options, direction, save=True)
            branch.extra = sampled(self.problem, self._typical(branch))
            for flow in options.compare:
                branch.extra |= compare(self.problem, branch.regular(), FLOWS[flow](self.system))
        except FAILURES as error:
            branch.ending = f"failed: {error}"
        branch.write(self.folder, self.about)
        return [branch, *self._crossing(branch)]

    def grow(
        self, branch: Branch, problem: Shooting, start: Point, control: NnmTable, direction: int = 1, save: bool = False
    ) -> None:
        """Continue ``branch`` from ``start`` until it ends; its special points are located on the way.

        Raises ContinuationError or FlowError if it cannot go on; the branch holds the points so far.
        """
        control = control.model_copy(update={"points": max(control.points - max(len(branch.regular()) - 1, 0), 0)})
        points = Continuation(problem, start, control, direction, branch.next_step or None)
        monitor = BranchMonitor(self.system)
        for point in branch.regular():
            monitor.check(point)
        last, finding = points.point, None
        branch.points = branch.points or [last]
        try:
            for point in points:
                sys.audit("vipetsc.step")
                if self.options.locate:
                    branch.points += locate(problem, last, point, control.chart, self.options.locate_grazing)
                branch.points.append(point)
                branch.next_step = points.step
                if self.listener is not None:
                    self.listener(branch, point)
                finding = monitor.check(point)
                if finding is not None:
                    branch.findings.append(finding)
                    break
                if save and point.index % SAVE_EVERY == 0:
                    branch.write(self.folder, self.about)
                last = point
        finally:
            branch.findings += [
                jump for jump in jumps(branch.regular(), problem, control) if jump not in branch.findings
            ]
        branch.ending, branch.complete = finding or points.ending, finding is not None or points.finished

    def _empty(self, name: str) -> Branch:
        return Branch(name, self.case.to_toml(), self.system.dofs)

    def _start(self, mode: int) -> Point:
        if self.options.start_energy != "auto":
            return linear_start(self.problem, mode, self.options.start_energy)
        graze = self.system.grazing_energy(mode)
        energy = graze / 100 if math.isfinite(graze) else 1e-3
        return linear_start(self.problem, mode, max(energy, self.options.energy[0] * 1.001))

    def _typical(self, branch: Branch) -> list[Point]:
        """The regular points in the middle of every region, and at the energies asked for."""
        regular = [(p, at) for p, at in zip(branch.points, branch.regions(), strict=True) if p.kind == "regular"]
        groups = ([p for p, at in regular if at == region] for region in range(5))
        chosen = [group[len(group) // 2] for group in groups if group]
        for energy in self.options.orbits_at:
            chosen.append(min(branch.regular(), key=lambda p: abs(math.log(p.energy / energy))))
        return chosen

    def _crossing(self, branch: Branch) -> list[Branch]:
        """The branches that cross ``branch`` at the kinds of special points asked for."""
        control = self.options.model_copy(update={"points": self.options.switch_points, "chart": "relative"})
        branches = []
        for kind in self.options.switch:
            for number, point in enumerate((p for p in branch.points if p.kind == kind), 1):
                crossing = self._empty(f"{branch.name}-{kind}-{number}")
                sys.audit("vipetsc.switch", crossing.name)
                try:
                    problem, first = switch(self.problem, point, self.options.switch_amplitude)
                    self.grow(crossing, problem, first, control)
                except FAILURES as error:
                    crossing.ending = f"failed: {error}"
                crossing.write(self.folder, self.about)
                branches.append(crossing)
        return branches
