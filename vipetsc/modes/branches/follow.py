"""Follow the branches of a case, one a rank or all ranks together; save them as they grow, resume them at their end.

A *branch* is a curve of periodic motions along which one parameter changes: a nonlinear normal mode (NNM), whose energy
and frequency change, or a nonlinear frequency response curve (NFRC), whose parameter is the drive's frequency or
another key of the case. Its *points* are single motions. Those of the continuation are regular; *special* points lie
between them, where something changes: a fold of the energy or of the frequency, a change of stability, a contact that
grazes. A ``Method`` gives the equations of a case's branches and their starts, ``Continuation`` makes the steps; this
module is the loop around them, with its files.

Phases of this loop are audit events ``vipetsc.<phase>`` of Python, which cost nothing unless a hook listens: the tests
raise errors and signals there (chapter `trust` of the manual).
"""

import logging
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.case import NnmCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.io.folder import BRANCHES, Claim, claimed, provenance
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.condensed import CondensedMethod
from vipetsc.modes.branches.files import read_branch, restore_table, write_branch
from vipetsc.modes.branches.lattices import LatticeMethod
from vipetsc.modes.branches.method import CrossingBranch, Method
from vipetsc.modes.branches.orbits import ShootingMethod
from vipetsc.modes.branches.responses import ResponseMethod
from vipetsc.modes.continuation.arclength import Continuation, StepRule
from vipetsc.modes.continuation.special import locate
from vipetsc.modes.problem import ContinuationError, PeriodicProblem
from vipetsc.parallel import StoppedError, StopRequest, on_root

# Seconds between two writings of a growing branch.
SAVE_EVERY = 10.0
# What a finding begins with where the part of a branch below its start has failed.
FAILED_BELOW = "below the start: "

logger = logging.getLogger(__name__)
BranchCase = NnmCase | NfrcCase
Listener = Callable[[Branch[Any], Any], None]


def claim_branches(
    case: BranchCase, folder: Path, comm: MPI.Comm, force: bool = False, resume: bool = False
) -> AbstractContextManager[Claim]:
    """Claim ``folder`` for the branches of ``case``, as ``claimed``.

    With ``resume`` the case may differ from the earlier one in where branches end, and in nothing of their physics.
    """

    def difference(earlier: str) -> str | None:
        # The whole case need not be the same: a branch that has used up its points is resumed with more of them.
        if type(case).from_toml(earlier).physics() == case.physics():
            return None
        return f"--resume needs {case.kept_by_resume}"

    text = case.to_toml()
    if not resume:
        return claimed(comm, folder, BRANCHES, text, force=force)
    return claimed(comm, folder, BRANCHES, text, force=force, resume=True, difference=difference)


def method_of(case: BranchCase) -> type[Method[Any]]:
    """The method that finds the branches of a ``case``."""
    if isinstance(case, NfrcCase):
        return ResponseMethod
    if case.krylov:
        return LatticeMethod
    if case.condensed:
        return CondensedMethod
    return ShootingMethod


def follow_all(
    case: BranchCase,
    folder: Path | None,
    comm: MPI.Comm,
    resume: bool = False,
    listener: Listener | None = None,
    stop: StopRequest | None = None,
) -> list[Branch[Any]]:
    """All branches of ``case``, written into ``folder`` if there is one; rank r follows every size-th one, from r on.

    Each branch is computed on one rank, so that its bits do not depend on the number of ranks, or on all ranks together
    where a lattice is shot without dense matrices. A branch that fails is written as far as it came and says why in its
    ``ending``, and the others go on. Where the part below its start fails, the part above is followed all the same. A
    ``stop`` ends each branch at its next point, with an ending that begins with "stopped"; ``resume`` goes on from
    there, to the same bits. Returns all branches on rank 0, in the order of the case; an empty list on the others.
    """
    follower = partial(Follower, case, folder, provenance(comm), listener, stop, resume)
    jobs = method_of(case).jobs(case)
    # Collective calls inside: every rank follows the same branches in the same order.
    if method_of(case).shared:
        together = follower(comm)
        branches = [branch for job in jobs for branch in together.follow(job)]
        if comm.rank > 0:
            return []
        return branches

    # Neighbours in the list fall to different ranks; no rank waits for another until all are followed.
    followed: dict[int, list[Branch[Any]]] = {}
    numbers = range(comm.rank, len(jobs), comm.size)
    if numbers:
        alone = follower(comm=MPI.COMM_SELF)
        followed = {number: alone.follow(jobs[number]) for number in numbers}
    # ``gather`` returns None on the other ranks.
    by_number: dict[int, list[Branch[Any]]] = {}
    for of_rank in comm.gather(followed) or []:
        by_number |= of_rank
    return [branch for number in sorted(by_number) for branch in by_number[number]]


class Follower:
    """Follows the branches of a case on the ranks ``comm``, into a folder or, without one, in memory alone.

    ``about`` are attributes of the files. ``listener(branch, point)`` is called on rank 0 after each regular point.
    """

    def __init__(
        self,
        case: BranchCase,
        folder: Path | None,
        about: dict[str, Any],
        listener: Listener | None = None,
        stop: StopRequest | None = None,
        resume: bool = False,
        comm: MPI.Comm = MPI.COMM_SELF,
    ) -> None:
        sys.audit("vipetsc.set-up", case.name)
        self.case = case
        self.folder = folder
        self.about = about
        self.listener = listener
        self.stop = stop or StopRequest()
        self.resume = resume
        self.comm = comm
        self.method: Method[Any] = method_of(case)(case, comm)

    def follow(self, job: int) -> list[Branch[Any]]:
        """The branch of a ``job``, one of ``Method.jobs``, then those that cross it, if asked for."""
        sys.audit("vipetsc.member", job + 1)
        branch = self._begun(self.method.name(job))
        if not branch.complete:
            self._save(branch, lambda: self._follow(branch, job))
        # The branch's file now holds the part below the start. That part's own files are removed only after it is
        # written: a kill leaves at least one of them.
        if branch.points and self.folder:
            for suffix in ("h5", "csv"):
                part = self.folder / f"branch-{branch.name}-down.{suffix}"
                on_root(self.comm, partial(part.unlink, missing_ok=True))
        return [branch, *self._further(branch)]

    def _save(self, branch: Branch[Any], follow: Callable[[], None]) -> None:
        """Follow a branch and write it, with the reason if it is stopped or fails."""
        try:
            follow()
        except StoppedError as stopped:
            branch.ending = str(stopped)
        except self.method.failures as error:
            branch.ending = f"failed: {error}"
        # A branch that was stopped before its first point has nothing to say, and is begun when it is resumed.
        if branch.points or (self.method.keeps_empty and not branch.ending.startswith("stopped")):
            self.write(branch)

    def write(self, branch: Branch[Any]) -> None:
        """Write a branch into the folder; one that ranks follow together is written by one of them."""
        folder = self.folder
        if folder:
            on_root(self.comm, lambda: write_branch(branch, folder, self.about))

    def _follow(self, branch: Branch[Any], job: int) -> None:
        """Compute the points of a branch, then what its file holds of the whole branch (``Method.finish``)."""
        method = self.method
        problem = method.problem(job)
        interruptions: tuple[type[Exception], ...] = (StoppedError, *method.failures)
        try:
            if branch.points:
                # A branch that is resumed has its lower part already, or it would have no points.
                start = branch.regular()[-1]
            else:
                start = method.start(problem, job)
                if method.has_lower_part:
                    self._follow_down(branch, problem, start)
            self.grow(branch, problem, start, method.rule, method.direction)
            # A branch lacks its far end where its lower part failed, also if it was stopped and resumed since.
            for finding in branch.findings:
                if finding.startswith(FAILED_BELOW):
                    raise ContinuationError(finding)
        except interruptions:
            if method.finishes_failed and branch.points:
                method.finish(problem, branch)
            raise
        method.finish(problem, branch)

    def _follow_down(self, branch: Branch[Any], problem: PeriodicProblem[Any], start: Any) -> None:
        """Begin a branch with its part below the start, from the far end on; raises StoppedError on request."""
        down = self._begun(f"{branch.name}-down")
        if down.points:
            start = down.regular()[-1]
        if not down.complete:
            try:
                self.grow(down, problem, start, self.method.rule, direction=-1)
            # The points so far belong to the branch, whose part above the start does not depend on them.
            except self.method.failures as error:
                down.findings.append(f"{FAILED_BELOW}{error}")
        # The part was followed away from the start: in the order of the branch its tangents are reversed.
        for p in reversed(down.points):
            branch.points.append(replace(p, tangent=-p.tangent, energy_tangent=-p.energy_tangent))
        branch.findings += down.findings

    def grow(
        self,
        branch: Branch[Any],
        problem: PeriodicProblem[Any],
        start: Any,
        rule_of: Callable[[PeriodicProblem[Any], Any, int], StepRule[Any]],
        direction: int = 1,
    ) -> None:
        """Continue ``branch`` from the motion ``start`` until it ends, and locate its special points.

        ``rule_of(problem, start, done)`` gives the steps and the end of a branch that has ``done`` regular points after
        its start. A ``direction`` of 1 leaves a start that has no tangent towards growing energy, -1 towards falling
        energy. The branch is saved every ``SAVE_EVERY`` seconds.

        Raises ContinuationError, FlowError or another of the method's ``failures`` if it cannot go on, StoppedError
        on request; the branch holds the points so far.
        """
        method = self.method
        # The branch may have points already, from an earlier run or from its part below the start. They count against
        # the number that it may have; its start does not.
        regular = branch.regular()
        rule = rule_of(problem, start, max(len(regular) - 1, 0))
        # The step of a branch that begins is 0, and the rule's first step is taken.
        continuation = Continuation(problem, start, rule, direction, branch.next_step or None)
        check = method.monitor(problem)
        # The monitor compares a point with all earlier ones, and says so where the branch retraces itself or returns to
        # the linear mode. A resumed branch has to be judged as one that never stopped.
        for point in regular:
            check(point)
        # The last two points: a special point between the newest two may need the direction of the one before them.
        one_before_last = None
        if len(regular) > 1:
            one_before_last = regular[-2]
        last = continuation.point
        finding = None
        saved = time.monotonic()
        if not branch.points:
            branch.points = [method.assess(problem, last)]

        try:
            for point in continuation:
                sys.audit("vipetsc.step")
                if method.locates:
                    special = locate(
                        problem,
                        left=last,
                        right=continuation.passed,
                        chart=rule.chart,
                        grazing=method.grazing,
                        before=one_before_last,
                        missed=branch.findings,
                    )
                    branch.points += [method.assess(problem, replace(p, next_step=point.next_step)) for p in special]
                assessed = method.assess(problem, point)
                branch.points.append(assessed)
                branch.next_step = continuation.step
                if self.listener is not None and self.comm.rank == 0:
                    self.listener(branch, assessed)
                finding = check(assessed)
                if finding is not None:
                    branch.findings.append(finding)
                    break

                # Agreed on by all: a signal reaches ranks at different points, and they stop at the same one.
                stopped = self.stop.agreed(self.comm) and not continuation.finished
                # One rank's clock decides for all: writing is collective.
                if stopped or self.comm.bcast(time.monotonic() - saved > SAVE_EVERY):
                    self.write(branch)
                    saved = time.monotonic()
                if stopped:
                    raise StoppedError(f"stopped on request after point {assessed.index}; continue with --resume")
                one_before_last = last
                last = point
        # A branch that fails or is stopped is checked as well; one that is resumed finds the same jumps again.
        finally:
            jumps = method.jumps(problem, branch.regular())
            branch.findings += [jump for jump in jumps if jump not in branch.findings]
        branch.ending = finding or continuation.ending
        branch.complete = finding is not None or continuation.finished

    def _begun(self, name: str) -> Branch[Any]:
        """The branch as it is in its file when results are resumed, else one without points."""
        fresh = self.method.new_branch(name)
        folder = self.folder
        if folder is None:
            return fresh
        path = folder / f"branch-{name}.h5"
        if self.resume and on_root(self.comm, path.exists):
            try:
                # Read by one rank: the others must not find another file, or none.
                stored = on_root(self.comm, lambda: read_branch(path))
                branch = replace(stored, case=fresh.case, about=fresh.about, extra=fresh.extra)
                # A branch that is complete is not computed again, and its table would stay away.
                on_root(self.comm, lambda: restore_table(branch, folder))
                return branch
            except OSError as error:
                logger.warning("vipetsc: warning: %s; computed again", error)
        return fresh

    def _further(self, branch: Branch[Any]) -> list[Branch[Any]]:
        """The branches that cross ``branch``, and isolated ones near it, as far as they are asked for."""
        branches: list[Branch[Any]] = []
        for crossing in self.method.further(branch, branches):
            other = self._begun(crossing.name)
            branches.append(other)
            if not other.complete:
                self._save(other, partial(self._cross, other, crossing))
        return branches

    def _cross(self, branch: Branch[Any], crossing: CrossingBranch) -> None:
        """Follow a ``branch`` that crosses another one, or an isolated one near it."""
        sys.audit("vipetsc.switch", branch.name)
        problem, begin = crossing.start()
        if branch.points:
            begin = branch.regular()[-1]
        self.grow(branch, problem, begin, crossing.rule)
