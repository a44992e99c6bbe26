"""Follow all branches of a case, distributed over ranks: each is saved as it grows and resumed at its end.

A *branch* is a curve of periodic motions along which one parameter changes: a nonlinear normal mode (NNM), whose energy
and frequency change, or a nonlinear frequency response curve (NFRC), whose parameter is the drive's frequency or
another key of the case. Its *points* are single motions. Those of the continuation are regular, and their ``index``
counts the steps from the start, which has 0; *special* points lie between them, where something changes: a fold of the
energy or of the frequency, a change of stability, a contact that grazes. A ``Method`` gives the equations of a case's
branches and their starts, ``Continuation`` makes the steps. Around it each regular point is *assessed*
(``Method.assess`` adds the quantities of its file that continuation does not need), compared with all earlier ones by
the method's *monitor*, shown to a listener, and written from time to time. A step of the length s solves H(xi) = 0 with
t . (xi - xi_0) = s for the unknowns xi of the next point, with those of the last one, xi_0, and the unit tangent t of
the branch there; charts, which scale the unknowns, are explained with it in ``vipetsc.modes.continuation.arclength``.

**Directions.** An NNM that is followed both ways from its start makes two branches: ``<name>`` towards larger energies
and ``<name>-down`` towards smaller ones. Both begin with the start.

**Files.** A branch has the files ``branch-<name>.h5`` and ``.csv``. Every ``SAVE_EVERY`` seconds, where it is stopped
and where it ends, a growing branch is written whole. A resumed command reads a branch that is complete, and goes on
from the last point of one that was stopped, failed, or has used up its points; one that failed at its start is tried
again. In between the steps, the bounds, and the numbers of points and of Newton steps in the case may have been
changed, but not the physics. ``Branch`` explains ``ended``, ``complete`` and ``findings``.

**Branches that cross** a branch at its special points, or are isolated near it, are followed after it, each with files
of its own. They have the variables of their points alone (``Method.finish`` is not called for them). Their names have
the number of the special point, counted from the start on.

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
from vipetsc.endings import Ended, Ending
from vipetsc.io.branch_kinds import DOWN
from vipetsc.io.folder import Claim, claimed, provenance
from vipetsc.io.kinds import BRANCHES
from vipetsc.io.netcdf import root_attributes
from vipetsc.modes.branches.balance import BalanceMethod
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.damped import DampedMethod
from vipetsc.modes.branches.files import read_branch, restore_table, write_branch
from vipetsc.modes.branches.method import CrossingBranch, Method, Monitor
from vipetsc.modes.branches.orbits import ShootingMethod
from vipetsc.modes.branches.responses import ResponseMethod
from vipetsc.modes.continuation.arclength import Continuation, StepRule, locate
from vipetsc.modes.problem import PeriodicProblem
from vipetsc.modes.shared_frequencies import check_modes_alone
from vipetsc.parallel import StoppedError, StopRequest, on_every_rank, on_root
from vipetsc.sources import source_key

logger = logging.getLogger(__name__)
# Seconds between two writings of a growing branch: what a kill may lose.
SAVE_EVERY = 10.0

BranchCase = NnmCase | NfrcCase
Listener = Callable[[Branch[Any], Any], None]
RuleOf = Callable[[PeriodicProblem[Any], Any, int], StepRule[Any]]


def method_of(case: BranchCase) -> type[Method[Any]]:
    """Return the method that finds the branches of a ``case``."""
    if isinstance(case, NfrcCase):
        return ResponseMethod
    if case.nnm.method == "damped":
        return DampedMethod
    if case.by_balance:
        return BalanceMethod
    return ShootingMethod


class Follower:
    """Follows branches of a case on one rank, into a folder or, without one, in memory alone.

    ``about`` are attributes of the files. ``listener(branch, point)`` is called after each regular point.
    """

    def __init__(
        self,
        case: BranchCase,
        folder: Path | None,
        about: dict[str, Any],
        listener: Listener | None = None,
        stop: StopRequest | None = None,
        resume: bool = False,
    ) -> None:
        sys.audit("vipetsc.set-up", case.name)
        self.case = case
        self.folder = folder
        self.about = about
        self.stop = stop or StopRequest()
        self.resume = resume
        self.method: Method[Any] = method_of(case)(case)
        self.listener = listener

    def follow(self, job: int) -> list[Branch[Any]]:
        """Return the branches of a ``job``, one for each direction, each with those that cross it, if asked for.

        A job is a number from ``Method.jobs``, counted from 0: that of a mode, of a start frequency, or of a curve.
        """
        # Members of a sweep have the same audit event: hooks count what a case consists of.
        sys.audit("vipetsc.member", job + 1)
        branches: list[Branch[Any]] = []
        for direction in self.method.directions:
            name = self.method.name(job)
            if direction < 0 < max(self.method.directions):
                name += DOWN
            branch = self._stored_or_new(name)
            if not branch.complete:
                self._follow_and_write(branch, partial(self._follow_one, branch, job, direction))
            branches += [branch, *self._follow_crossing(branch)]
        return branches

    def _follow_and_write(self, branch: Branch[Any], follow: Callable[[], None]) -> None:
        """Call ``follow`` for a branch, and write it; how it ``ended`` says why it was stopped or failed."""
        try:
            follow()
        except StoppedError as stopped:
            branch.ended = Ended(Ending.STOPPED, str(stopped))
        except self.method.failures as error:
            branch.ended = Ending.FAILED.with_numbers(reason=error)
        # A branch that was stopped before its first point has nothing to say, and is begun when it is resumed.
        if branch.points or (self.method.keeps_empty and branch.ended.ending is not Ending.STOPPED):
            self.write(branch)

    def write(self, branch: Branch[Any]) -> None:
        """Write a branch into the folder."""
        if self.folder:
            write_branch(branch, self.folder, self.about)

    def _follow_one(self, branch: Branch[Any], job: int, direction: int) -> None:
        """Compute the points of a branch, then what its file holds of the whole branch (``Method.finish``)."""
        method = self.method
        points = method.computed(job)
        if points is not None:
            branch.points = points
            branch.findings += method.findings(job, points)
            branch.ended = Ending.END_OF_RANGE.with_numbers(end=method.case.nfrc.range[1])
            return
        problem = method.problem(job)
        try:
            if branch.points:
                start = branch.regular()[-1]
            else:
                with problem.stopped_by(self.stop):
                    start = method.start(problem, job, self.stop)
            self._grow(branch, problem, start, method.rule, direction)
        finally:
            # Runs may begin with the states in the file: a branch that was stopped or failed has them, too.
            if branch.points and (self.folder or not method.finishes_files_alone):
                method.finish(problem, branch)

    def _grow(
        self, branch: Branch[Any], problem: PeriodicProblem[Any], start: Any, rule_of: RuleOf, direction: int = 1
    ) -> None:
        """Continue ``branch`` from the motion ``start`` until it ends, and set how it ``ended``.

        Special points are located between the regular ones.

        ``rule_of(problem, start, done)`` gives the steps and the end of a branch that has ``done`` regular points after
        its start. A ``start`` with a tangent is continued along it. From one without, a branch goes towards growing
        energy (of an NFRC, its parameter) if the ``direction`` is 1, towards falling energy if it is -1.

        Raises ContinuationError, FlowError or another of the method's ``failures`` if it cannot go on, StoppedError
        on request; the branch holds the points so far.
        """
        regular = branch.regular()
        # Points of an earlier run count against the number that a branch may have; its start does not.
        done = max(len(regular) - 1, 0)
        # A closed curve ends where it began, also if it is resumed elsewhere.
        first = start
        if regular:
            first = regular[0]
        rule = rule_of(problem, first, done)
        # The ending of a branch that has used up its points tells their number as its case counts them.
        counted = done + int(self.method.counts_start)
        # ``next_step`` is 0 of a branch without points: its first step is then the rule's.
        continuation = Continuation(
            problem, start, rule, direction, step=branch.next_step or None, points_before=counted
        )
        monitor = self.method.monitor(problem)
        # The monitor compares each point with all earlier ones, to see whether the branch retraces itself or returns to
        # the linear mode. A resumed branch must be judged as one that was not interrupted: that one began without
        # points, so that its monitor has not seen the start.
        for point in regular[1:]:
            monitor(point)
        if not branch.points:
            branch.points = [self.method.assess(problem, continuation.point)]

        try:
            with problem.stopped_by(self.stop):
                seen = self._steps(branch, problem, continuation, rule.chart, monitor)
        except StoppedError:
            # A step in which the branch was stopped is left out, and repeated by a resumed branch.
            self.write(branch)
            last = branch.regular()[-1]
            stopped = Ending.STOPPED.with_numbers(where=f"after point {last.index}; continue with --resume")
            raise StoppedError(stopped.sentence) from None
        branch.ended = seen or continuation.ended

    def _steps(
        self,
        branch: Branch[Any],
        problem: PeriodicProblem[Any],
        continuation: Continuation[Any],
        chart: str,
        monitor: Monitor[Any],
    ) -> Ended | None:
        """Add all points to the ``branch``; returns its ending if the ``monitor`` has ended it, else None.

        ``chart`` is the name of the unknowns in which steps are taken (``Continuation``).
        """
        last = continuation.point
        chosen = self.method.chosen(problem)
        # A special point between the newest two points may need the direction of the one before them.
        one_before_last = None
        regular = branch.regular()
        if len(regular) > 1:
            one_before_last = regular[-2]

        saved = time.monotonic()
        for point in continuation:
            sys.audit("vipetsc.step")
            special: list[Any] = []
            missed: list[str] = []
            if self.method.locates:
                special = locate(
                    problem,
                    left=last,
                    # The end of the step itself. It is ``point``, unless the rule has moved that back to the end of a
                    # range: special points of the whole step are wanted.
                    right=continuation.passed,
                    chart=chart,
                    grazing=self.method.locates_grazing,
                    before=one_before_last,
                    missed=missed,
                    chosen=chosen,
                )

            # As in regular points, ``next_step`` is that of the step after the one that found them.
            special = [replace(p, next_step=point.next_step) for p in special]
            new_points = [self.method.assess(problem, p) for p in [*special, point]]
            # A step is taken as a whole, or not at all where an assessment fails: a resumed branch repeats the step.
            branch.findings += missed
            branch.points += new_points
            assessed = new_points[-1]
            branch.next_step = continuation.step
            if self.listener is not None:
                self.listener(branch, assessed)
            ended = monitor(assessed)
            if ended is not None:
                branch.findings.append(ended.sentence)
                return ended

            if self.stop.requested and not continuation.finished:
                raise StoppedError
            is_due = time.monotonic() - saved > SAVE_EVERY
            # A branch that has ended is written later, as complete: after a kill it would go on beyond its end.
            if is_due and not continuation.finished:
                self.write(branch)
                saved = time.monotonic()
            one_before_last = last
            last = point
        return None

    def _stored_or_new(self, name: str) -> Branch[Any]:
        """Return the branch of that ``name`` as it is in its file when results are resumed, else one without points.

        The ``extra`` variables of the file are not read: those of a branch that is not complete are computed again.
        """
        new = self.method.new_branch(name)
        folder = self.folder
        if folder is None:
            return new
        path = folder / f"branch-{name}.h5"
        if not (self.resume and path.exists()):
            return new

        try:
            stored = read_branch(path)
            source = root_attributes(path, "branch").get("source")
        except OSError as error:
            logger.warning("vipetsc: warning: %s; computed again", error)
            return new
        if not stored.complete and source != source_key():
            logger.warning("vipetsc: warning: %s was begun by other sources of vipetsc; computed again", path)
            return new
        # The case's bounds may be new.
        branch = replace(stored, case=new.case, about=new.about, extra=new.extra)
        try:
            # A branch that is complete is not written again, and a table that is missing would stay away.
            restore_table(branch, folder)
        except OSError as error:
            logger.warning("vipetsc: warning: the table of branch %s is not written: %s", name, error)
        return branch

    def _follow_crossing(self, branch: Branch[Any]) -> list[Branch[Any]]:
        """Return the branches that cross ``branch``, and isolated ones near it, as far as they are asked for."""
        branches: list[Branch[Any]] = []
        # ``further`` looks at ``branches`` whenever it is asked for the next one: no branch is begun twice.
        for crossing in self.method.further(branch, branches):
            other = self._stored_or_new(crossing.name)
            branches.append(other)
            if not other.complete:
                self._follow_and_write(other, partial(self._cross, other, crossing))
        return branches

    def _cross(self, branch: Branch[Any], crossing: CrossingBranch) -> None:
        """Follow a ``branch`` that crosses another one, or an isolated one near it."""
        sys.audit("vipetsc.switch", branch.name)
        problem, start = crossing.start()
        if branch.points:
            start = branch.regular()[-1]
        self._grow(branch, problem, start, crossing.rule)


def claim_branches(
    case: BranchCase, folder: Path, comm: MPI.Comm, force: bool = False, resume: bool = False
) -> AbstractContextManager[Claim]:
    """Claim ``folder`` for the branches of ``case``, as ``claimed``.

    With ``resume`` the case must have the physics of the earlier one (``physics`` of its class). It may differ in what
    does not move a branch: steps, bounds, and numbers of points and of Newton steps. A branch that reached a bound is
    complete: a wider bound does not lengthen it. Raises CaseError, before anything is written, for a mode that shares
    its frequency with others.
    """
    if isinstance(case, NnmCase):
        on_root(comm, lambda: check_modes_alone(case))

    def difference(earlier: str) -> str | None:
        # A branch that has used up its points is resumed with a case that allows more of them.
        if type(case).from_toml(earlier).physics() == case.physics():
            return None
        return f"--resume needs {case.kept_by_resume}"

    text = case.to_toml()
    if not resume:
        return claimed(comm, folder, BRANCHES, text, force=force)
    return claimed(comm, folder, BRANCHES, text, force=force, resume=True, difference=difference)


def follow_all(
    case: BranchCase,
    folder: Path | None,
    comm: MPI.Comm,
    resume: bool = False,
    listener: Listener | None = None,
    stop: StopRequest | None = None,
) -> list[Branch[Any]]:
    """Return all branches of ``case``, written into ``folder`` if there is one.

    Each branch is computed on one rank, so that its bits do not depend on the number of ranks: rank r of n follows the
    branches r, r + n, r + 2n and so on.

    A branch that fails, by one of ``Method.failures``, is written as far as it came and says why (``Branch.ended``),
    and the others go on. A ``stop`` ends each branch at its next point, or earlier if an orbit's search takes long
    (``Flow.limited``); of branches that are not begun yet each still computes its start, unless that takes long or has
    steps of its own, and one point. With ``resume`` branches that were stopped go on to the same bits, and branches
    that failed or have used up their points go on from their last point. Returns all branches on rank 0, in the order
    of the case; an empty list on the others.

    Any other error of one rank, as where a file cannot be written, is raised on all ranks once the others have followed
    their branches.
    """
    if not isinstance(case, BranchCase):
        raise TypeError(f"follow_all takes a case of the class NnmCase or NfrcCase, not {type(case).__name__}")
    about = provenance(comm)
    jobs = method_of(case).jobs(case)
    # Neighbours in the list fall to different ranks; no rank waits for another until all are followed.
    numbers = range(comm.rank, len(jobs), comm.size)

    def follow_alone() -> dict[int, list[Branch[Any]]]:
        if not numbers:
            return {}
        alone = Follower(case, folder, about, listener, stop, resume)
        return {number: alone.follow(jobs[number]) for number in numbers}

    followed = on_every_rank(comm, follow_alone)
    # ``gather`` returns None on the other ranks.
    by_number: dict[int, list[Branch[Any]]] = {}
    for of_rank in comm.gather(followed) or []:
        by_number |= of_rank
    return [branch for number in sorted(by_number) for branch in by_number[number]]
