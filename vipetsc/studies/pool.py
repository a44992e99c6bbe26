"""Jobs shared over teams of ranks: a job may fail, a request to stop and a full disk end them all."""

import errno
import sys
import time
from collections.abc import Callable, Hashable, Sequence
from typing import TypeVar

from mpi4py import MPI

from vipetsc.parallel import Progress, SharedCounter, StoppedError, StopRequest, on_root

FULL = errno.ENOSPC, errno.EDQUOT, errno.EFBIG  # no other member could be written either
PATIENCE = 5.0  # s that a rank whose member failed waits for the rest of its team to have failed as well
MADE, UNMADE, LEFT, ENDED = range(4)  # how a job ended; the later counts if ranks differ

Job = TypeVar("Job", bound=Hashable)


class TaskPool:
    """Teams of ranks that draw jobs until none are left, or until some rank got a request to stop (``stopped``).

    ``busy`` is the time in s that this rank worked on them.
    """

    def __init__(self, comm: MPI.Comm, team: MPI.Comm, stop: StopRequest) -> None:
        self.comm, self.team, self.stop = comm, team, stop
        self.stopped, self.busy = False, 0.0

    def share(
        self, jobs: Sequence[Job], work: Callable[[Job], None], progress: Progress | None = None
    ) -> dict[Job, str]:
        """Do all ``jobs``; returns for each one done the reason why it failed, "" if it did not. Collective.

        Raises OSError on all ranks when the disk is full.
        """
        drawn, ended = SharedCounter(self.comm), SharedCounter(self.comm)
        reasons: dict[Job, str] = {}
        leader, ending, reason = self.team.rank == 0, MADE, ""
        while not (self.stopped or self.stop.agreed(self.team)):
            number = self.team.bcast(drawn.draw() if leader else None)
            if number >= len(jobs):
                break
            job, begin = jobs[number], time.perf_counter()
            ending, reason = self._end(job, work)
            self.busy += time.perf_counter() - begin
            if ending in (LEFT, ENDED):
                break
            reasons[job] = reason
            done = ended.draw(1 if leader else 0)
            if progress:
                progress.update(done + 1)
        else:
            ending = LEFT
        if ending in (LEFT, ENDED):
            drawn.draw(len(jobs))  # so that no team begins another
        shares = self.comm.allgather((ending, reason, reasons))
        self.stopped = any(ending == LEFT for ending, *_ in shares)
        if progress:
            progress.close()
        drawn.free()
        ended.free()

        def check() -> None:
            if full := next((reason for ending, reason, _ in shares if ending == ENDED), ""):
                raise OSError(full)

        on_root(self.comm, check)
        return {job: reason for *_, share in shares for job, reason in share.items()}

    def _end(self, job: Job, work: Callable[[Job], None]) -> tuple[int, str]:
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
            ending = (ENDED, text) if getattr(error, "errno", None) in FULL else (UNMADE, named)
        met, since = self.team.Ibarrier(), time.monotonic()
        while not met.Test():
            if failure and time.monotonic() - since > PATIENCE:
                raise failure
            time.sleep(1e-3)
        return max(self.team.allgather(ending))
