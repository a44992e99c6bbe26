"""Follow a branch of a case, save it as it grows, resume it at its end.

A *branch* is a curve of periodic motions along which one parameter changes: a nonlinear normal mode (NNM), whose energy
and frequency change, or a nonlinear frequency response curve (NFRC), whose parameter is the drive's frequency or
another key of the case. Its *points* are single motions. Those of the continuation are regular, and their ``index``
counts the steps from the start, which has 0; *special* points lie between them, where something changes: a fold of the
energy or of the frequency, a change of stability, a contact that grazes. A ``Method`` gives the equations of a case's
branches and their starts, and ``Growth`` continues a branch from one motion to its end. This module says from which
motions, and keeps the files. A step of the length s solves H(xi) = 0 with t . (xi - xi_0) = s for the unknowns xi of
the next point, with those of the last one, xi_0, and the unit tangent t of the branch there; charts, which scale the
unknowns, are explained with it in ``vipetsc.modes.continuation.arclength``.

**Two parts.** Where ``Method.has_lower_part`` says so, an NNM is followed from its start both to larger and to smaller
energies. The part *below the start*, towards smaller energies, is computed first, as a branch of its own with the name
``<name>-down``. Then its points are put before the start in reverse order, from the far end on, and the part *above*,
towards larger energies, is followed. In both parts the index counts the steps from the start: 3, 2, 1, 0, 1, 2. It is
not negative, and only the start has 0. ``nnm.points`` limits both parts together.

**Files.** A branch has the files ``branch-<name>.h5`` and ``.csv``. Every ``SAVE_EVERY`` seconds, where it is stopped
and where it ends, a growing branch is written whole. What is in the folder, and what a resumed command does:

    State                                   -down             <name>                      Resumed
    the part below is followed, or stopped  points so far     none                        the part below goes on
    the part above is followed              the whole part    none, then both parts       the part above goes on
    the same, after a failure below         its points        none, then both parts,      the part below goes on, then
                                                              ``failure_below``           the part above
    stopped or out of points above          none              both parts, not complete    the part above goes on
    failed or out of points below           none              both parts, not complete,   the part below goes on, then
                                                              ``failure_below``           the part above
    the part below is followed again        points so far     as before                   the part below goes on
    failed at the start                     none              no points                   tried again
    complete                                none              both parts, complete        read

A branch with one part has the states of the part above. A kill leaves one of these states, or a whole branch next to
the part below that it already contains, which the same command then removes. ``Branch`` explains ``ending``,
``complete`` and ``findings``.

**Failures.** A part that has failed goes on from its last point when the branch is resumed. In between the steps, the
bounds, and the numbers of points and of Newton steps in the case may have been changed, but not the physics. If the
part below fails, the part above is followed all the same, since its points do not depend on it. A part that has used up
its points goes on in the same way.

**Branches that cross** a branch at its special points, or are isolated near it, are followed after it, each with files
of its own. They have one part, and the variables of their points alone (``Method.finish`` is not called for them).
Their names have the number of the special point, counted from the far end below the start on.

Phases of this loop are audit events ``vipetsc.<phase>`` of Python, which cost nothing unless a hook listens: the tests
raise errors and signals there (chapter `trust` of the manual).
"""

import logging
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.case import NnmCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.io.netcdf import root_attributes
from vipetsc.modes.branches.branch import Branch, FailureBelow
from vipetsc.modes.branches.condensed import CondensedMethod
from vipetsc.modes.branches.files import read_branch, restore_table, write_branch
from vipetsc.modes.branches.growth import Growth, Listener
from vipetsc.modes.branches.lattices import LatticeMethod
from vipetsc.modes.branches.method import CrossingBranch, Method
from vipetsc.modes.branches.orbits import ShootingMethod
from vipetsc.modes.branches.responses import ResponseMethod
from vipetsc.modes.problem import ContinuationError, PeriodicProblem
from vipetsc.parallel import StoppedError, StopRequest, on_root
from vipetsc.sources import source_key

logger = logging.getLogger(__name__)
BranchCase = NnmCase | NfrcCase


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

    ``about`` are attributes of the files. ``listener(branch, point)`` is called after each regular point on rank 0 of
    ``comm``: of ``follow_all`` that is every rank with its own branches, unless all follow one together. All ranks of
    ``comm`` call ``follow`` with the same jobs in the same order.
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
        self.stop = stop or StopRequest()
        self.resume = resume
        self.comm = comm
        self.method: Method[Any] = method_of(case)(case, comm)
        self.growth = Growth(self.method, comm, self.write, listener, self.stop)

    def follow(self, job: int) -> list[Branch[Any]]:
        """The branch of a ``job``, then those that cross it, if asked for.

        A job is a number from ``Method.jobs``, counted from 0: that of a mode, of a start frequency, or of a curve.
        """
        # Members of a sweep have the same audit event: hooks count what a case consists of.
        sys.audit("vipetsc.member", job + 1)
        branch = self._stored_or_new(self.method.name(job))
        if not branch.complete:
            self._follow_and_write(branch, lambda: self._follow_parts(branch, job))
        # The file of a branch that has points holds the part below the start, too: that part's own files can go. Not
        # earlier: a kill must leave one of the two.
        if branch.points:
            self._remove(_name_below(branch))
        return [branch, *self._follow_crossing(branch)]

    def _remove(self, name: str) -> None:
        """Remove the files of the branch of that ``name``, if there are any."""
        if self.folder:
            for suffix in ("h5", "csv"):
                path = self.folder / f"branch-{name}.{suffix}"
                on_root(self.comm, partial(path.unlink, missing_ok=True))

    def _follow_and_write(self, branch: Branch[Any], follow: Callable[[], None]) -> None:
        """Call ``follow`` for a branch, and write it; its ending says why if it is stopped or fails."""
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

    def _follow_parts(self, branch: Branch[Any], job: int) -> None:
        """Compute the points of a branch, then what its file holds of the whole branch (``Method.finish``)."""
        method = self.method
        problem = method.problem(job)
        interruptions: tuple[type[Exception], ...] = (StoppedError, *method.failures)
        try:
            if branch.points:
                start = branch.regular()[-1]
                # A branch is saved with points of its own only once the part below its start is among them.
                if branch.failure_below is not None:
                    self._resume_below(branch, problem)
            else:
                with method.stopped_by(problem, self.stop):
                    start = method.start(problem, job, self.stop)
                if method.has_lower_part:
                    below = self._stored_or_new(_name_below(branch))
                    branch.failure_below = self._grow_below(below, problem, start)
                    _put_below(branch, below, above=[])

            self._follow_above(branch, problem, start)
        except interruptions:
            if method.finishes_interrupted and branch.points:
                method.finish(problem, branch)
            raise
        method.finish(problem, branch)

    def _follow_above(self, branch: Branch[Any], problem: PeriodicProblem[Any], start: Any) -> None:
        """Follow the part above the start from its point ``start`` on.

        Nothing is followed if that part was already complete. Raises ContinuationError if the part below has failed,
        after the part above has been followed.
        """
        below = branch.failure_below
        if not branch.complete and not (below and below.complete_above):
            # If the branch has a part below its start as well, the direction is 1.
            self.growth.run(branch, problem, start, self.method.rule, self.method.direction)
            if below:
                below = below._replace(ending_above=branch.ending, complete_above=branch.complete)
        if below:
            branch.failure_below = below
            branch.complete = False
            if below.failed:
                raise ContinuationError(below.finding)
            branch.ending = below.finding

    def _grow_below(
        self, below: Branch[Any], problem: PeriodicProblem[Any], start: Any, points_above: int = 0
    ) -> FailureBelow | None:
        """Continue the part ``below`` the ``start`` of a branch; returns why it is not complete, or None if it is.

        ``points_above`` are the regular points above the start, which count against those that a branch may have.
        Raises StoppedError on request.
        """
        if below.points:
            start = below.regular()[-1]
        if below.complete:
            return None
        failure: FailureBelow | None = None
        try:
            self.growth.run(below, problem, start, self.method.rule, direction=-1, points_elsewhere=points_above)
        except self.method.failures as error:
            failure = FailureBelow(why=str(error), next_step=below.next_step)
        else:
            if not below.complete:
                failure = FailureBelow(why=below.ending, next_step=below.next_step, failed=False)

        # From now on, until the whole branch is written, a kill does not take the part away. After that, until it is
        # removed, this file has all points of the part that the file of the branch has: ``_resume_below`` relies on it.
        if below.points:
            self.write(below)
        return failure

    def _resume_below(self, branch: Branch[Any], problem: PeriodicProblem[Any]) -> None:
        """Continue the part of a branch below its start, which is not complete; raises StoppedError on request."""
        before = branch.failure_below
        assert before is not None
        first = next(i for i, p in enumerate(branch.points) if p.kind == "regular" and p.index == 0)
        above = branch.points[first + 1 :]
        points_above = sum(p.kind == "regular" for p in above)

        # There are files of the part only if a command was killed before it could remove them. They have all points of
        # the part that the branch has, or more.
        below = self._stored_or_new(_name_below(branch))
        # The findings of the part below come first, and the failure is the last of them (``_put_below``).
        end = branch.findings.index(before.finding)
        if not below.points:
            below.points = [_reversed(p) for p in reversed(branch.points[: first + 1])]
            below.next_step = before.next_step
            below.findings = branch.findings[:end]
        branch.findings = branch.findings[end + 1 :]
        try:
            after = self._grow_below(below, problem, below.points[0], points_above)
        except StoppedError:
            branch.failure_below = before._replace(next_step=below.next_step)
            self._lengthen_below(branch, below, above)
            raise

        if after is None:
            branch.failure_below = None
            branch.ending = before.ending_above
            branch.complete = before.complete_above
        else:
            branch.failure_below = before._replace(why=after.why, next_step=after.next_step, failed=after.failed)
        self._lengthen_below(branch, below, above)

    def _lengthen_below(self, branch: Branch[Any], below: Branch[Any], above: list[Any]) -> None:
        """Put the part ``below`` into its ``branch``, before the points ``above``, in the place of a shorter one.

        Names of crossing branches count special points from the far end below on. New ones there rename all: the files
        that have the earlier names are removed, before the branch is written.
        """
        # ``further`` is asked for names alone: nothing that it yields is followed here.
        earlier_names = [crossing.name for crossing in self.method.further(branch, [])]
        specials = _count_special(branch.points)
        _put_below(branch, below, above)
        if _count_special(branch.points) > specials:
            for name in earlier_names:
                self._remove(name)

    def _stored_or_new(self, name: str) -> Branch[Any]:
        """The branch of that ``name`` as it is in its file when results are resumed, else one without points.

        The ``extra`` variables of the file are not read: those of a branch that is not complete are computed again.
        """
        new = self.method.new_branch(name)
        folder = self.folder
        if folder is None:
            return new
        path = folder / f"branch-{name}.h5"
        if not (self.resume and on_root(self.comm, path.exists)):
            return new

        try:
            # Read by one rank: the others must not find another file, or none.
            stored = on_root(self.comm, lambda: read_branch(path))
            source = on_root(self.comm, lambda: root_attributes(path, "branch").get("source"))
        except OSError as error:
            self._warn(f"{error}; computed again")
            return new
        if not stored.complete and source != source_key():
            self._warn(f"{path} was begun by other sources of vipetsc; computed again")
            return new
        # The case's bounds may be new.
        branch = replace(stored, case=new.case, about=new.about, extra=new.extra)
        try:
            # A branch that is complete is not written again, and a table that is missing would stay away.
            on_root(self.comm, lambda: restore_table(branch, folder))
        except OSError as error:
            self._warn(f"the table of branch {name} is not written: {error}")
        return branch

    def _warn(self, text: str) -> None:
        """Log a warning that all ranks have, on one of them."""
        if self.comm.rank == 0:
            logger.warning("vipetsc: warning: %s", text)

    def _follow_crossing(self, branch: Branch[Any]) -> list[Branch[Any]]:
        """The branches that cross ``branch``, and isolated ones near it, as far as they are asked for."""
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
        self.growth.run(branch, problem, start, crossing.rule)


def _name_below(branch: Branch[Any]) -> str:
    """The name under which the part of a branch below its start is followed."""
    return f"{branch.name}-down"


def _count_special(points: list[Any]) -> int:
    """The number of special points among ``points``."""
    return sum(p.kind != "regular" for p in points)


def _reversed(point: Any) -> Any:
    """A ``point`` with the tangent of the branch followed in the other direction."""
    return replace(point, tangent=-point.tangent, energy_tangent=-point.energy_tangent)


def _put_below(branch: Branch[Any], below: Branch[Any], above: list[Any]) -> None:
    """Give a ``branch`` the points and findings of the part ``below`` its start, and then the points ``above`` it.

    The start is the first point of the part below, which was followed away from it. In the file's order, from the far
    end on, its tangents are reversed. Findings of the part below, the last of which is its failure, come before those
    that the branch has.
    """
    branch.points = [_reversed(p) for p in reversed(below.points)] + above
    of_below = list(below.findings)
    if branch.failure_below is not None:
        of_below.append(branch.failure_below.finding)
    branch.findings = of_below + branch.findings
