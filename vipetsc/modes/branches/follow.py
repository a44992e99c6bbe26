"""Follow the branches of a case: one by one or shared over ranks, saved as they grow, resumed where they ended."""

import itertools
import logging
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.case import NnmCase
from vipetsc.case.nnm import NnmTable
from vipetsc.io.folder import BRANCHES, Claim, claimed, provenance
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.branch_checks import BranchMonitor, compare, jumps, sampled
from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.continuation.special import at_energy, locate, switch
from vipetsc.modes.point import Point, linear_start
from vipetsc.modes.problem import ContinuationError, FlowError
from vipetsc.modes.shooting.dop853 import Dop853Flow
from vipetsc.modes.shooting.flow import Flow
from vipetsc.modes.shooting.reference import FiniteDifferences, Newmark, Tsrk
from vipetsc.modes.shooting.shooting import MAPS, Shooting
from vipetsc.modes.system import System
from vipetsc.parallel import StoppedError, StopRequest, on_root

# The flows by their names in case files.
FLOWS: dict[str, type[Flow]] = {flow.name: flow for flow in (Dop853Flow, Tsrk, Newmark)}
# Seconds between two writings of a growing branch.
SAVE_EVERY = 10.0
FAILURES = (ContinuationError, FlowError, ValueError)

logger = logging.getLogger(__name__)
Listener = Callable[[Branch, Point], None]


def claim_branches(
    case: NnmCase, folder: Path, comm: MPI.Comm, force: bool = False, resume: bool = False
) -> AbstractContextManager[Claim]:
    """Claim ``folder`` for the branches of ``case``, as ``claimed``; to ``resume`` them, their ends may be others."""

    def difference(earlier: str) -> str | None:
        same = NnmCase.from_toml(earlier).physics() == case.physics()
        return None if same else "--resume needs the system, map and flow that its branches were begun with"

    further = difference if resume else None
    return claimed(comm, folder, BRANCHES, case.to_toml(), force=force, resume=resume, difference=further)


def follow_all(
    case: NnmCase,
    folder: Path,
    comm: MPI.Comm,
    resume: bool = False,
    listener: Listener | None = None,
    stop: StopRequest | None = None,
    kind: "type[Follower] | None" = None,
) -> list[Branch]:
    """All branches of ``case``, written into ``folder``; rank r follows every size-th one, from r on.

    Each branch is computed on one rank, so that its bits do not depend on their number, or on all ranks together, as
    the ``kind`` of follower says. A branch that fails is
    written as far as it came, says why in its ``ending``, and the others go on. A ``stop`` ends each branch at its next
    point, with an ending that begins with "stopped"; ``resume`` goes on from there, to the same bits. Returns all
    branches on rank 0, in the order of ``nnm.modes``; an empty list on the others.
    """
    kind, mine = kind or Follower, {}
    starts = range(len(case.nnm.start_frequency)) if case.nnm.start_frequency else [m - 1 for m in case.nnm.modes]
    if kind.shared:
        together = kind(case, folder, provenance(comm), listener, stop, resume, comm)
        every = [branch for start in starts for branch in together.follow(start)]
        return every if comm.rank == 0 else []
    for job in range(comm.rank, len(starts), comm.size):
        follower = kind(case, folder, provenance(comm), listener, stop, resume)
        mine[job] = follower.follow(starts[job])
    branches = {job: group for part in comm.gather(mine) or [] for job, group in part.items()}
    return [branch for job in sorted(branches) for branch in branches[job]]


class Follower:
    """Follows the branches of a case into a folder; ``about`` are attributes of the files, ``comm`` has who follows."""

    continuation: type[Continuation] = Continuation
    branch_type: type[Branch] = Branch
    shared = False  # whether all ranks follow a branch together
    failures: tuple[type[Exception], ...] = FAILURES  # that end a branch, not the program

    def __init__(
        self,
        case: NnmCase,
        folder: Path,
        about: dict[str, Any],
        listener: Listener | None = None,
        stop: StopRequest | None = None,
        resume: bool = False,
        comm: MPI.Comm = MPI.COMM_SELF,
    ) -> None:
        sys.audit("vipetsc.set-up", case.name)
        self.case, self.options, self.folder, self.about, self.listener = case, case.nnm, folder, about, listener
        self.stop, self.resume, self.comm = stop or StopRequest(), resume, comm
        self.dofs: int
        self.set_up()

    def set_up(self) -> None:
        """Make the problem of the case, and count the unknowns of an orbit."""
        options, self.system = self.options, System.from_case(self.case)
        flow: Flow = FLOWS[options.flow](self.system)
        automatic = "quarter" if self.system.odd else "half"
        flow = FiniteDifferences(flow) if options.jacobian == "differences" else flow
        shooting_map = MAPS[automatic if options.map == "auto" else options.map]
        self.problem: Any = Shooting(flow, shooting_map, options.tolerance, options.max_newton)
        self.dofs = self.system.dofs

    def name_of(self, mode: int) -> str:
        """The name of the branch of ``mode`` (0-based)."""
        return self.system.branch_name(mode)

    def follow(self, mode: int) -> list[Branch]:
        """The branch of ``mode`` (0-based), then the branches that cross it if the case asks for them."""
        sys.audit("vipetsc.member", mode + 1)
        branch = self._begun(self.name_of(mode))
        if not branch.complete:
            self._save(branch, lambda: self._follow(branch, mode))
        if branch.points:
            for suffix in ("h5", "csv"):  # of its beginning, which the whole has
                half = self.folder / f"branch-{branch.name}-down.{suffix}"
                on_root(self.comm, partial(half.unlink, missing_ok=True))
        return [branch, *self._crossing(branch)]

    def _save(self, branch: Branch, follow: Callable[[], None]) -> None:
        """Follow a branch and write it, with the reason if it is stopped or fails."""
        try:
            follow()
        except StoppedError as stopped:
            branch.ending = str(stopped)
        except self.failures as error:
            branch.ending = f"failed: {error}"
        if branch.points or not branch.ending.startswith("stopped"):
            self.write(branch)

    def write(self, branch: Branch) -> None:
        """Write a branch; one that ranks follow together is written by one of them."""
        on_root(self.comm, lambda: branch.write(self.folder, self.about))

    def judged(self, point: Point) -> Point:
        """The point with what else is to be known of it."""
        return point

    def _follow(self, branch: Branch, mode: int) -> None:
        """The branch itself, its orbits and what other flows make of it."""
        options = self.options
        start = branch.regular()[-1] if branch.points else self._start(mode)
        if options.direction == "both" and not branch.points:
            down = self._begun(f"{branch.name}-down")
            if not down.complete:
                self.grow(down, self.problem, down.regular()[-1] if down.points else start, options, -1)
            # from the far end towards the start, with the tangents turned round
            branch.points = [
                replace(p, tangent=-p.tangent, energy_tangent=-p.energy_tangent) for p in reversed(down.points)
            ]
            branch.findings += down.findings
        self.grow(branch, self.problem, start, options, -1 if options.direction == "down" else 1)
        self.finish(branch)

    def finish(self, branch: Branch) -> None:
        """Add the orbits of a branch, and what other flows make of it."""
        branch.extra = sampled(self.problem, [*self._typical(branch), *self.asked(branch)])
        for flow in self.options.compare:
            branch.extra |= compare(self.problem, branch.regular(), FLOWS[flow](self.system))

    def grow(self, branch: Branch, problem: Shooting, start: Point, control: NnmTable, direction: int = 1) -> None:
        """Continue ``branch`` from ``start`` until it ends; its special points are located on the way.

        It is saved every ``SAVE_EVERY`` seconds. Raises ContinuationError or FlowError if it cannot go on, StoppedError
        on request; the branch holds the points so far.
        """
        control = control.model_copy(update={"points": max(control.points - max(len(branch.regular()) - 1, 0), 0)})
        points = self.continuation(problem, start, control, direction, branch.next_step or None)
        check = self.monitored(problem, control)
        for point in branch.regular():
            check(point)
        before, last, finding, saved = next(iter(branch.regular()[-2:-1]), None), points.point, None, time.monotonic()
        branch.points = branch.points or [self.judged(last)]
        try:
            for point in points:
                sys.audit("vipetsc.step")
                if self.options.locate:
                    special = self.located(problem, control, last, point, before, branch.findings)
                    branch.points += map(self.judged, special)
                branch.points.append(point := self.judged(point))
                branch.next_step = points.step
                if self.listener is not None and self.comm.rank == 0:
                    self.listener(branch, point)
                finding = check(point)
                if finding is not None:
                    branch.findings.append(finding)
                    break
                stopped = self.stop.agreed(self.comm) and not points.finished
                if stopped or self.comm.bcast(time.monotonic() - saved > SAVE_EVERY):
                    self.write(branch)
                    saved = time.monotonic()
                if stopped:
                    raise StoppedError(f"stopped on request after point {point.index}; resume goes on")
                before, last = last, point
        finally:
            jumped = self.jumps(branch.regular(), problem, control)
            branch.findings += [jump for jump in jumped if jump not in branch.findings]
        branch.ending, branch.complete = finding or points.ending, finding is not None or points.finished

    def monitored(self, problem: Shooting, control: NnmTable) -> Callable[[Point], str | None]:
        """What tells of every point whether its branch does what it should not."""
        return BranchMonitor(problem, control.guards).check

    def located(
        self, problem: Shooting, control: NnmTable, left: Point, right: Point, before: Point | None, missed: list[str]
    ) -> list[Point]:
        """The special points between two points."""
        return locate(problem, left, right, control.chart, self.options.locate_grazing, before, missed)

    def jumps(self, points: list[Point], problem: Shooting, control: NnmTable) -> Iterator[str]:
        """Sentences about jumps between ``points``."""
        return jumps(points, problem, control)

    def _begun(self, name: str) -> Branch:
        """The branch as it is in its file when results are resumed, else one without points."""
        path = self.folder / f"branch-{name}.h5"
        if self.resume and on_root(self.comm, path.exists):
            try:
                branch = on_root(self.comm, lambda: self.branch_type.read(path))
                branch.case = self.case.to_toml()
                return branch
            except OSError as error:
                logger.warning("vipetsc: warning: %s; made again", error)
        return self.branch_type(name, self.case.to_toml(), self.dofs)

    def _start(self, mode: int) -> Point:
        return linear_start(self.problem, mode, self.start_energy(mode))

    def start_energy(self, mode: int) -> float:
        """Energy in J of the first point."""
        if self.options.start_energy != "auto":
            return self.options.start_energy
        graze = self.system.grazing_energy(mode)
        energy = graze / 100 if math.isfinite(graze) else 1e-3
        return max(energy, self.options.energy[0] * 1.001)

    def _typical(self, branch: Branch) -> list[Point]:
        """The regular points in the middle of every region."""
        regular = [(p, at) for p, at in zip(branch.points, branch.regions(), strict=True) if p.kind == "regular"]
        groups = ([p for p, at in regular if at == region] for region in range(5))
        return [group[len(group) // 2] for group in groups if group]

    def asked(self, branch: Branch) -> Iterator[Point]:
        """The orbits at the energies asked for, wherever the branch passes one."""
        for energy in self.options.orbits_at:
            pairs = itertools.pairwise(branch.regular())
            steps = [(a, b) for a, b in pairs if (a.energy < energy) != (b.energy < energy)]
            if not steps:
                branch.findings.append(f"the branch has no orbit of {energy:g} J")
            for left, right in steps:
                try:
                    yield self.at_energy(left, right, energy)
                except ArithmeticError as error:
                    branch.findings.append(f"the orbit of {energy:g} J after point {left.index} is not found: {error}")

    def at_energy(self, left: Point, right: Point, energy: float) -> Point:
        """The orbit of an ``energy`` in J between two points on both sides of it."""
        return at_energy(self.problem, left, right, energy, self.options.chart)

    def _crossing(self, branch: Branch) -> list[Branch]:
        """The branches that cross ``branch`` at the kinds of special points asked for."""
        control = self.options.model_copy(update={"points": self.options.switch_points, "chart": "relative"})
        branches = []
        for kind in self.options.switch:
            for number, point in enumerate((p for p in branch.points if p.kind == kind), 1):
                crossing = self._begun(f"{branch.name}-{kind}-{number}")
                branches.append(crossing)
                if not crossing.complete:
                    self._save(crossing, partial(self._cross, crossing, point, control))
        return branches

    def _cross(self, crossing: Branch, point: Point, control: NnmTable) -> None:
        """The branch that crosses at a special ``point``."""
        sys.audit("vipetsc.switch", crossing.name)
        problem, first = switch(self.problem, point, self.options.switch_amplitude)
        self.grow(crossing, problem, crossing.regular()[-1] if crossing.points else first, control)
