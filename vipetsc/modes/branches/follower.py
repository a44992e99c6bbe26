"""Follow a branch of a case, save it as it grows, resume it at its end.

A *branch* is a curve of periodic motions along which one parameter changes: a nonlinear normal mode (NNM), whose energy
and frequency change, or a nonlinear frequency response curve (NFRC), whose parameter is the drive's frequency or
another key of the case. Its *points* are single motions. Those of the continuation are regular, and their ``index``
counts the steps from the start, which has 0; *special* points lie between them, where something changes: a fold of the
energy or of the frequency, a change of stability, a contact that grazes. A ``Method`` gives the equations of a case's
branches and their starts, ``Continuation`` makes the steps; this module is the loop around them, with its files. Steps,
tangents and charts are explained in ``continuation.arclength``.

**Two parts.** An NNM may be followed from its start both to larger and to smaller energies. The part *below the start*,
towards smaller energies, is computed first, as a branch of its own with the name ``<name>-down``. Then its points are
put before the start in reverse order, from the far end on, and the part *above* is followed.

**Failures.** What has failed is tried again when the branch is resumed, from the last point before the failure: the
case may have got other steps, bounds or numbers of Newton steps. That holds for both parts. A part below that fails
does not stop the part above, whose points do not depend on it; the branch is then not complete, its ending says that it
failed below the start, and ``Branch.failure_below`` keeps what is needed to go on there.

Phases of this loop are audit events ``vipetsc.<phase>`` of Python, which cost nothing unless a hook listens: the tests
raise errors and signals there (chapter `trust` of the manual).
"""

import logging
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.case import NnmCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.branches.branch import Branch, FailureBelow
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

logger = logging.getLogger(__name__)
BranchCase = NnmCase | NfrcCase
Listener = Callable[[Branch[Any], Any], None]


def method_of(case: BranchCase) -> type[Method[Any]]:
    """The method that finds the branches of a ``case``."""
    if isinstance(case, NfrcCase):
        return ResponseMethod
    if case.krylov:
        return LatticeMethod
    if case.condensed:
        return CondensedMethod
    return ShootingMethod


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
        # Members of a sweep have the same audit event: hooks count what a case consists of.
        sys.audit("vipetsc.member", job + 1)
        branch = self._begun(self.method.name(job))
        if not branch.complete:
            self._save(branch, lambda: self._follow(branch, job))
        # A branch that has points has been written with those below its start: that part's own files, with which a
        # killed command would have gone on, can go. Before that they must stay: a kill leaves at least one of the two.
        if branch.points:
            self._remove(_name_below(branch))
        return [branch, *self._further(branch)]

    def _remove(self, name: str) -> None:
        """Remove the files of the branch of that ``name``, if there are any."""
        if self.folder:
            for suffix in ("h5", "csv"):
                path = self.folder / f"branch-{name}.{suffix}"
                on_root(self.comm, partial(path.unlink, missing_ok=True))

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
                start = branch.regular()[-1]
                # A branch is saved with points of its own only once the part below its start is among them.
                if branch.failure_below is not None:
                    self._retry_below(branch, problem)
            else:
                start = method.start(problem, job)
                if method.has_lower_part:
                    below = self._begun(_name_below(branch))
                    branch.failure_below = self._grow_below(below, problem, start)
                    _put_below(branch, below, above=[])

            self._follow_above(branch, problem, start)
        except interruptions:
            if method.finishes_interrupted and branch.points:
                method.finish(problem, branch)
            raise
        method.finish(problem, branch)

    def _follow_above(self, branch: Branch[Any], problem: PeriodicProblem[Any], start: Any) -> None:
        """Follow the part above the start from its point ``start`` on, unless only the part below had failed.

        Raises ContinuationError if the part below has failed, after the part above has been followed.
        """
        failure = branch.failure_below
        if not branch.complete and not (failure and failure.complete_above):
            self.grow(branch, problem, start, self.method.rule, self.method.direction)
            if failure:
                failure = failure._replace(ending_above=branch.ending, complete_above=branch.complete)
        if failure:
            branch.failure_below = failure
            branch.complete = False
            raise ContinuationError(failure.finding)

    def _grow_below(self, below: Branch[Any], problem: PeriodicProblem[Any], start: Any) -> FailureBelow | None:
        """Continue the part ``below`` the ``start`` of a branch to its end; returns its failure, if it fails.

        Raises StoppedError on request.
        """
        if below.points:
            start = below.regular()[-1]
        if below.complete:
            return None
        try:
            self.grow(below, problem, start, self.method.rule, direction=-1)
        except self.method.failures as error:
            return FailureBelow(why=str(error), next_step=below.next_step)
        # From now on, until the whole branch is written, a kill does not take the part away.
        self.write(below)
        return None

    def _retry_below(self, branch: Branch[Any], problem: PeriodicProblem[Any]) -> None:
        """Continue the part of a branch below its start, which has failed before; raises StoppedError on request."""
        before = branch.failure_below
        assert before is not None
        first = next(i for i, p in enumerate(branch.points) if p.kind == "regular" and p.index == 0)
        above = branch.points[first + 1 :]
        # Crossing branches are numbered from the far end below on: new special points there shift their names.
        crossing_names = [crossing.name for crossing in self.method.further(branch, [])]

        # There are files of the part only if a command was killed that tried it again.
        below = self._begun(_name_below(branch))
        if not below.points:
            below.points = [_reversed(p) for p in reversed(branch.points[: first + 1])]
            below.next_step = before.next_step
        branch.findings = [finding for finding in branch.findings if finding != before.finding]
        specials = sum(p.kind != "regular" for p in branch.points[:first])
        try:
            after = self._grow_below(below, problem, below.points[0])
        except StoppedError:
            branch.failure_below = before._replace(next_step=below.next_step)
            _put_below(branch, below, above)
            raise

        if after is None:
            branch.failure_below = None
            branch.ending = before.ending_above
            branch.complete = before.complete_above
        else:
            branch.failure_below = before._replace(why=after.why, next_step=after.next_step)
        _put_below(branch, below, above)
        if sum(p.kind != "regular" for p in below.points) > specials:
            for name in crossing_names:
                self._remove(name)

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
        its start. A ``start`` with a tangent is continued along it. From one without, a branch goes towards growing
        energy (of an NFRC, its parameter) if the ``direction`` is 1, towards falling energy if it is -1. The branch is
        saved every ``SAVE_EVERY`` seconds.

        Raises ContinuationError, FlowError or another of the method's ``failures`` if it cannot go on, StoppedError
        on request; the branch holds the points so far.
        """
        method = self.method
        # Points of an earlier run, and of the part below the start, count against the number that a branch may have;
        # its start does not.
        regular = branch.regular()
        done = max(len(regular) - 1, 0)
        rule = rule_of(problem, start, done)
        # ``next_step`` is 0 of a branch without points: its first step is then the rule's.
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
        why_ended = None
        saved = time.monotonic()
        if not branch.points:
            branch.points = [method.assess(problem, last)]

        try:
            for point in continuation:
                sys.audit("vipetsc.step")
                if method.locates:
                    missed: list[str] = []
                    # The step's own end, ``passed``: the rule may have moved ``point`` back to the end of a range, and
                    # special points of the whole step are wanted.
                    special = locate(
                        problem,
                        left=last,
                        right=continuation.passed,
                        chart=rule.chart,
                        grazing=method.locates_grazing,
                        before=one_before_last,
                        missed=missed,
                    )
                    branch.findings += missed
                    # As in regular points, ``next_step`` is that of the step after the one that found them.
                    branch.points += [method.assess(problem, replace(p, next_step=point.next_step)) for p in special]
                assessed = method.assess(problem, point)
                branch.points.append(assessed)
                branch.next_step = continuation.step
                if self.listener is not None and self.comm.rank == 0:
                    self.listener(branch, assessed)
                why_ended = check(assessed)
                if why_ended is not None:
                    branch.findings.append(why_ended)
                    break

                # Agreed on by all: a signal reaches ranks at different points, and they stop at the same one.
                stopped = self.stop.agreed(self.comm) and not continuation.finished
                # One rank's clock decides for all: writing is collective.
                is_due = self.comm.bcast(time.monotonic() - saved > SAVE_EVERY)
                # A branch that has ended is written as complete, later: it would go on beyond its end after a kill.
                if stopped or (is_due and not continuation.finished):
                    self.write(branch)
                    saved = time.monotonic()
                if stopped:
                    raise StoppedError(f"stopped on request after point {assessed.index}; continue with --resume")
                one_before_last = last
                last = point
        # Where two points may lie on different branches (``Method.jumps``). A branch that fails or is stopped is looked
        # at as well; one that is resumed finds the same jumps again.
        finally:
            jumps = method.jumps(problem, branch.regular())
            branch.findings += [jump for jump in jumps if jump not in branch.findings]
        branch.ending = why_ended or continuation.ending
        branch.complete = why_ended is not None or continuation.finished

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
                # The case's bounds may be new, and what a file holds of a whole branch, ``extra``, is computed again.
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


def _name_below(branch: Branch[Any]) -> str:
    """The name under which the part of a branch below its start is followed."""
    return f"{branch.name}-down"


def _reversed(point: Any) -> Any:
    """A ``point`` with the tangent of the branch followed in the other direction."""
    return replace(point, tangent=-point.tangent, energy_tangent=-point.energy_tangent)


def _put_below(branch: Branch[Any], below: Branch[Any], above: list[Any]) -> None:
    """Give a ``branch`` the points and findings of the part ``below`` its start, and then the points ``above`` it.

    The start is the first point of the part below, which was followed away from it. In the file's order, from the far
    end on, its tangents are reversed.
    """
    branch.points = [_reversed(p) for p in reversed(below.points)] + above
    new_findings = list(below.findings)
    if branch.failure_below is not None:
        new_findings.append(branch.failure_below.finding)
    branch.findings += [finding for finding in new_findings if finding not in branch.findings]
