"""Jobs shared over teams of ranks: a job may fail, a request to stop and a full disk end them all."""

import errno
import sys
import time
from collections.abc import Callable, Hashable, Sequence
from typing import TypeVar

from mpi4py import MPI

from vipetsc.parallel import Progress, SharedCounter, StoppedError, StopRequest, on_root, wait_for_all

FULL = errno.ENOSPC, errno.EDQUOT, errno.EFBIG  # no other member could be written either
BLOCKS = 100  # that each team draws, at least, so that none waits long for the last
PATIENCE = 5.0  # s that a rank whose member failed waits for the rest of its team to have failed as well
MADE, UNMADE, LEFT, ENDED = range(4)  # how a job ended; the later counts if ranks differ

Job = TypeVar("Job", bound=Hashable)


class TaskPool:
    """Teams of ranks that draw jobs until none are left, or until some rank got a request to stop (``stopped``).

    ``busy`` is the time in s that this rank worked on them. A job may end in ``failures``; other exceptions end
    all jobs, as a full disk does.
    """

    def __init__(
        self, comm: MPI.Comm, team: MPI.Comm, stop: StopRequest, failures: tuple[type[Exception], ...] = (Exception,)
    ) -> None:
        self.comm, self.team, self.stop, self.failures = comm, team, stop, failures
        self.stopped, self.busy = False, 0.0

    def run(
        self,
        jobs: Sequence[Job],
        work: Callable[[Job], None],
        progress: Progress | None = None,
        fail: Callable[[Job, str], None] = lambda job, reason: None,
    ) -> int:
        """Do all ``jobs``, those that come first first; returns how many came out. Collective.

        ``fail`` is called on the first rank of a team with a job that failed, and why. Raises OSError on all ranks when
        the disk is full, or after an exception that is no failure.
        """
        drawn, ended = SharedCounter(self.comm), SharedCounter(self.comm)
        block = max(len(jobs) * self.team.size // (BLOCKS * self.comm.size), 1)  # many small jobs are drawn together
        leader, ending, reason, made, end, number = self.team.rank == 0, MADE, "", 0, 0, 0
        while not (self.stopped or self.stop.agreed(self.team)):
            if number == end:
                number = self.team.bcast(drawn.draw(block) if leader else None)
                end = min(number + block, len(jobs))
            if number >= len(jobs):
                break
            begin = time.perf_counter()
            ending, reason = self._end(jobs[number], work, fail)
            self.busy += time.perf_counter() - begin
            if ending in (LEFT, ENDED):
                break
            made, number = made + (ending == MADE), number + 1
            done = ended.draw(1 if leader else 0)
            if progress:
                progress.update(done + 1)
        else:
            ending = LEFT
        if ending in (LEFT, ENDED):
            drawn.draw(len(jobs))  # so that no team begins another block
        wait_for_all(self.comm)
        shares = self.comm.allgather((ending, reason, made if leader else 0))
        self.stopped = any(ending == LEFT for ending, *_ in shares)
        if progress:
            progress.close()
        drawn.free()
        ended.free()

        def check() -> None:
            if full := next((reason for ending, reason, _ in shares if ending == ENDED), ""):
                raise OSError(full)

        on_root(self.comm, check)
        return sum(made for *_, made in shares)

    def _end(self, job: Job, work: Callable[[Job], None], fail: Callable[[Job, str], None]) -> tuple[int, str]:
        """Do a ``job`` with the whole team: how it ended, and why.

        A rank that fails alone leaves the others in the midst of it, where they wait for ever: its exception is raised.
        """
        ending, failure = (MADE, ""), None
        try:
            sys.audit("vipetsc.member", str(job))
            work(job)
        except StoppedError:
            ending = LEFT, ""
        except Exception as error:
            failure, text = error, str(error)
            named = text if isinstance(error, RuntimeError) else f"{type(error).__name__}: {text}"
            over = not isinstance(error, self.failures) or getattr(error, "errno", None) in FULL
            ending = (ENDED, text if isinstance(error, OSError) else named) if over else (UNMADE, named)
        met, since = self.team.Ibarrier(), time.monotonic()
        while not met.Test():
            if failure and time.monotonic() - since > PATIENCE:
                raise failure
            time.sleep(1e-3)
        ending = max(self.team.allgather(ending))
        if ending[0] == UNMADE:
            try:
                on_root(self.team, lambda: fail(job, ending[1]))
            except OSError as error:
                return ENDED, str(error)
        return ending
