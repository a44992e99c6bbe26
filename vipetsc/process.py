"""The process before MPI is started: whether it is the first of its job, and requests to stop."""

import os
import signal
from types import FrameType

STOP_SIGNALS = signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1
# What launchers tell a process of its rank: Open MPI's, those with PMI (MPICH, Intel MPI, Slurm's), Slurm's own.
RANKS = "OMPI_COMM_WORLD_RANK", "PMI_RANK", "PMIX_RANK", "SLURM_PROCID"


def launched_rank() -> int | None:
    """The rank of this process in its job; None if it was not launched as one of several."""
    ranks = [os.environ[name] for name in RANKS if os.environ.get(name, "").isdigit()]
    return int(ranks[0]) if ranks else None


def end_on_request() -> None:
    """Let a request to stop end the process at once, with exit code 75, as long as nothing has begun."""
    for number in STOP_SIGNALS:
        # What nohup has set stays.
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _end)


def _end(number: int, frame: FrameType | None) -> None:
    # A launcher sends the signal to all ranks, when one of them was killed as well: it is the one to say what happened.
    if launched_rank() is None:
        os.write(2, b"vipetsc: stopped on request\n")
    # Without unwinding: modules that are being loaded would swallow an exception, or report one of their own.
    os._exit(os.EX_TEMPFAIL)
