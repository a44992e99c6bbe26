"""Jobs done by teams of ranks: a single job may fail; a request to stop or an error of the file system ends all."""

import sys
import time
from collections.abc import Callable, Hashable, Sequence
from enum import IntEnum
from typing import NamedTuple, TypeVar

from mpi4py import MPI

from vipetsc.parallel import SharedCounter, StoppedError, StopRequest, on_root, wait_for_all
from vipetsc.plugins import PROGRAMMING, PartFailure
from vipetsc.progress import Progress
from vipetsc.register import PartError
from vipetsc.wording import of_system

BLOCKS = 100  # that each team draws, at least: none then waits for the last longer than 1 % of the whole
# Time in s that a rank whose job failed waits for the rest of its team to have failed as well. Ranks that fail together
# come within the time of a message, or as late as other programs hold them up. A rank that gives up ends all jobs: too
# short a time takes such ranks for those that wait for ever, a longer one only delays the end where they do.
PATIENCE = 5.0

Job = TypeVar("Job", bound=Hashable)


class JobEnding(IntEnum):
    """JobEnding of a job; where the ranks of a team differ, the largest counts."""

    DONE = 0
    FAILED = 1
    STOPPED = 2
    FATAL = 3  # ends all jobs
    PART = 4  # a part of a user's module is wrong: ends all jobs


class JobEnd(NamedTuple):
    """JobEnding of a job, and the reason if it was not done."""

    ending: JobEnding
    reason: str = ""


class TeamReport(NamedTuple):
    """Report of one rank to the others when it draws no more jobs: the end of its last job, and how many it counts."""

    last: JobEnd
    done: int


class TaskPool:
    """Teams of ranks that draw jobs until none are left, or until some rank got a request to stop (``stopped``).

    ``busy`` is the time in s that this rank worked on them. A job may end in ``failures``; other exceptions end
    all jobs, as those of the file system (OSError) and errors of a program (``PROGRAMMING``) do.
    """

    def __init__(
        self, comm: MPI.Comm, team: MPI.Comm, stop: StopRequest, failures: tuple[type[Exception], ...] = (Exception,)
    ) -> None:
        self.comm = comm
        self.team = team
        self.stop = stop
        self.failures = failures
        self.stopped = False
        self.busy = 0.0

    def run(
        self,
        jobs: Sequence[Job],
        work: Callable[[Job], None],
        progress: Progress | None = None,
        fail: Callable[[Job, str], None] = lambda job, reason: None,
    ) -> int:
        """Do all ``jobs``, begun in their order; returns how many were done. Collective.

        ``fail`` is called on the first rank of a team with a job that failed, and why. Raises OSError on all ranks when
        a file cannot be read or written, or after an exception that is no failure; PartError if a part of a user's
        module is wrong.
        """
        reports = self.comm.allgather(self._draw_jobs(jobs, work, progress, fail))
        self.stopped = any(report.last.ending == JobEnding.STOPPED for report in reports)
        if progress:
            progress.close()

        def check() -> None:
            for report in reports:
                if report.last.ending == JobEnding.PART:
                    raise PartError(report.last.reason)
            for report in reports:
                if report.last.ending == JobEnding.FATAL and report.last.reason:
                    raise OSError(report.last.reason)

        on_root(self.comm, check)
        return sum(report.done for report in reports)

    def _draw_jobs(
        self,
        jobs: Sequence[Job],
        work: Callable[[Job], None],
        progress: Progress | None,
        fail: Callable[[Job, str], None],
    ) -> TeamReport:
        """Draw ``jobs`` with this team and do them, until none are left or one ends all. Collective."""
        drawn = SharedCounter(self.comm)
        ended = SharedCounter(self.comm)
        # A communicator of its own: on that of the job, a rank whose job failed would meet the others in the midst of
        # their work.
        meeting = self.team.Dup()
        # Many small jobs are drawn together: a draw and its broadcast may take longer than one of them.
        block = max(len(jobs) * self.team.size // (BLOCKS * self.comm.size), 1)
        leads = self.team.rank == 0
        last = JobEnd(JobEnding.DONE)
        done = 0
        number = 0
        block_end = 0

        while True:
            if self.stopped or self.stop.agreed(self.team):
                last = JobEnd(JobEnding.STOPPED)
                break
            if number == block_end:
                # One rank draws for its team, whose ranks must work on the same job.
                if leads:
                    number = drawn.draw(block)
                number = self.team.bcast(number)
                block_end = min(number + block, len(jobs))
            if number >= len(jobs):
                break

            begin = time.perf_counter()
            last = self._do(jobs[number], work, fail, meeting)
            self.busy += time.perf_counter() - begin
            if last.ending > JobEnding.FAILED:
                break

            number += 1
            if leads and last.ending == JobEnding.DONE:
                done += 1
            # Every rank asks for the count, which moves the bar of rank 0 also when another team has ended a job.
            count = ended.draw(int(leads))
            if progress:
                progress.update(count + 1)

        if last.ending > JobEnding.FAILED:
            drawn.draw(len(jobs))  # so that no team begins another block
        # No team may draw any more when the counters go. Ranks that wait here sleep: the others need the cores.
        wait_for_all(self.comm)
        drawn.free()
        ended.free()
        meeting.Free()
        return TeamReport(last, done)

    def _do(self, job: Job, work: Callable[[Job], None], fail: Callable[[Job, str], None], meeting: MPI.Comm) -> JobEnd:
        """Do a ``job`` with the whole team, whose ranks agree on its end on the communicator ``meeting``.

        A rank that fails alone leaves the others in the midst of it, where they wait for ever: its exception is raised.
        """
        end = JobEnd(JobEnding.DONE)
        failure = None
        try:
            sys.audit("vipetsc.member", str(job))
            work(job)
        except StoppedError:
            end = JobEnd(JobEnding.STOPPED)
        except Exception as error:
            failure = error
            end = self._judge(error)

        # Non-blocking: a rank whose job failed must be able to give up waiting for its team.
        met = meeting.Ibarrier()
        since = time.monotonic()
        while not met.Test():
            if failure and time.monotonic() - since > PATIENCE:
                raise failure
            time.sleep(1e-3)

        end = max(meeting.allgather(end))
        if end.ending == JobEnding.FAILED:
            try:
                on_root(self.team, lambda: fail(job, end.reason))
            except OSError as error:  # the failure could not be recorded
                return JobEnd(JobEnding.FATAL, of_system(error))
        return end

    def _judge(self, error: Exception) -> JobEnd:
        """Return whether an ``error`` is a failure of its job alone or ends all jobs, and how it is reported."""
        is_failure = isinstance(error, self.failures) and not isinstance(error, PROGRAMMING)
        if isinstance(error, PartError) and not (isinstance(error, PartFailure) and is_failure):
            return JobEnd(JobEnding.PART, str(error))
        # A file that cannot be read or written says nothing about the job, which may succeed in the next call.
        if isinstance(error, OSError):
            return JobEnd(JobEnding.FATAL, of_system(error))
        if is_failure:
            return JobEnd(JobEnding.FAILED, reason_of(error))
        return JobEnd(JobEnding.FATAL, reason_of(error))


def reason_of(error: Exception) -> str:
    """Return why a job failed, in words: its ``error``'s message, after the type where another program worded it."""
    # RuntimeErrors of this program are sentences; of others the type says what they are about.
    if isinstance(error, RuntimeError):
        return str(error)
    return f"{type(error).__name__}: {error}"
