"""The process itself: its rank and requests to stop before MPI is started, its log."""

import logging
import os
import signal
import sys
from functools import cache
from types import FrameType

logger = logging.getLogger(__name__)
STOP_SIGNALS = signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1
# What launchers tell a process of its rank: Open MPI's, those with PMI (MPICH, Intel MPI, Slurm's), Slurm's own.
RANKS = "OMPI_COMM_WORLD_RANK", "PMI_RANK", "PMIX_RANK", "SLURM_PROCID"


def launched_rank() -> int | None:
    """Return the rank of this process in its job; None if it was not launched as one of several."""
    for name in RANKS:
        rank = os.environ.get(name, "")
        if rank.isdigit():
            return int(rank)
    return None


def end_on_request() -> None:
    """Let a request to stop end the process at once, with exit code 75, as long as nothing has begun."""
    for number in STOP_SIGNALS:
        # A signal that nohup has set to be ignored stays ignored.
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, end_now)


def end_now(number: int, frame: FrameType | None) -> None:
    """Handle a signal by ending the process with exit code 75."""
    # A launcher sends the signal to all ranks, also when one of them was killed. It says what happened, once.
    if launched_rank() is None:
        os.write(2, b"vipetsc: stopped on request\n")
    # Without unwinding: modules that are being loaded would swallow an exception, or report one of their own.
    os._exit(os.EX_TEMPFAIL)


def has_log() -> bool:
    """Return whether a log takes the lines of this process, as that of the command line does."""
    return logger.isEnabledFor(logging.INFO) and logger.hasHandlers()


def say(text: str) -> None:
    """Report ``text`` in the log where one takes it, else on stderr.

    Scripts and notebooks seldom set up a log. A level above WARNING of the logger ``vipetsc`` silences both.
    """
    if has_log():
        logger.info("%s", text)
    elif logger.isEnabledFor(logging.WARNING):
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()


@cache
def announce(text: str) -> None:
    """Report ``text`` once, on one rank, before code of a user's module begins.

    Where that code never returns, or ends the process, this is the last line.
    """
    if not launched_rank():
        say(f"vipetsc: {text}")
