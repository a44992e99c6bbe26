"""Ranks that work, fail and end together; progress and messages from rank 0."""

import logging
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self, TypeVar, cast

from mpi4py import MPI

import numpy as np
from tqdm import tqdm

T = TypeVar("T")
logger = logging.getLogger(__name__)
BAR = "vipetsc.bar"  # the logger whose level switches bars off
STOP_SIGNALS = signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1


def install_abort_hook(comm: MPI.Comm = MPI.COMM_WORLD) -> None:
    """Let a rank that raises end all ranks, with one message; otherwise the others wait for it for ever."""

    def hook(kind: type[BaseException], error: BaseException, trace: Any) -> None:
        if comm.rank and getattr(error, "from_root", False):
            time.sleep(2)  # rank 0 raised the same: its message is enough, and it ends this rank
        where = f"rank {comm.rank}: " if comm.size > 1 else ""
        # A full disk or too little memory is the machine's matter: the trace would hide the message.
        machine = isinstance(error, OSError | MemoryError)
        lines = [str(error) or "out of memory"] if machine else traceback.format_exception(kind, error, trace)
        logger.critical("vipetsc: %s%s", where, "".join(lines).rstrip())
        sys.stdout.flush()
        if comm.size > 1:
            comm.Abort(1)
        # Without the usual farewell: HDF5 crashes in its own after a full disk.
        os._exit(1)

    sys.excepthook = hook


def wait_for_all(comm: MPI.Comm) -> None:
    """Wait for all ranks of ``comm``, asleep after a moment: those that still work need the cores."""
    met, begin = comm.Ibarrier(), time.monotonic()
    while not met.Test():
        if time.monotonic() - begin > 1e-3:
            time.sleep(1e-3)


def on_root(comm: MPI.Comm, function: Callable[[], T]) -> T:
    """Value of ``function`` called on rank 0, on all ranks; what it raises is raised on all ranks."""
    attempt = _attempt(function) if comm.rank == 0 else None
    wait_for_all(comm)
    return _agreed(*comm.bcast(attempt))


def on_every_rank(comm: MPI.Comm, function: Callable[[], T]) -> T:
    """Value of ``function`` called on each rank; what it raises on one, the lowest, is raised on all ranks."""
    value, error = _attempt(function)
    wait_for_all(comm)
    return _agreed(value, next((e for e in comm.allgather(error) if e is not None), None))


def _attempt(function: Callable[[], T]) -> tuple[T | None, Exception | None]:
    try:
        return function(), None
    except Exception as error:
        return None, error


def _agreed(value: T | None, error: Exception | None) -> T:
    if error is not None:
        error.from_root = True  # type: ignore[attr-defined]  # rank 0 raises it as well, and reports it for all
        raise error
    return cast(T, value)


def sort_over_ranks(comm: MPI.Comm, rows: np.ndarray, keys: Sequence[str]) -> tuple[np.ndarray, int, int]:
    """Sort the ``rows`` of all ranks by their ``keys``: this rank's part of them, how many come before it, all.

    The parts are about as large; rows that agree in the first key stay together. All ranks must call it.
    """
    total, backwards = comm.allreduce(len(rows)), keys[::-1]
    rows = rows[np.lexsort([rows[key] for key in backwards])]
    if comm.size > 1 and total:
        first = rows[keys[0]]
        some = np.sort(np.concatenate(comm.allgather(first[:: total // (64 * comm.size) + 1])))
        cuts = np.searchsorted(first, some[np.arange(1, comm.size) * len(some) // comm.size])
        rows = np.concatenate(comm.alltoall(np.split(rows, cuts)))
        rows = rows[np.lexsort([rows[key] for key in backwards])]
    return rows, sum(comm.allgather(len(rows))[: comm.rank]), total


class SharedCounter:
    """A count that all ranks of ``comm`` draw from, one-sided: no rank has to wait on another to hand out work."""

    def __init__(self, comm: MPI.Comm) -> None:
        self._window = MPI.Win.Allocate(8 if comm.rank == 0 else 0, 8, comm=cast(MPI.Intracomm, comm))
        if comm.rank == 0:
            np.frombuffer(self._window.tomemory(), np.int64)[:] = 0  # type: ignore[call-overload]
        comm.Barrier()

    def draw(self, step: int = 1) -> int:
        """The count before ``step`` is added to it."""
        value, added = np.empty(1, np.int64), np.array([step], np.int64)
        self._window.Lock(0, MPI.LOCK_SHARED)
        self._window.Fetch_and_op(added, value, 0, 0, MPI.SUM)
        self._window.Unlock(0)
        return int(value[0])

    def free(self) -> None:
        """Give the window back; all ranks must call it."""
        self._window.Free()


class StoppedError(Exception):
    """Work was left on request, to be gone on with; says how."""


class StopRequest:
    """A request to stop: ``requested`` once this rank has got one, which is not yet a reason to leave the others.

    A loop that all ranks go through asks whether it is ``agreed``, or calls ``check``; work that one rank does alone
    looks at ``requested``, and the ranks agree when they meet again.
    """

    requested = False

    def agreed(self, comm: MPI.Comm) -> bool:
        """Whether any rank of ``comm`` got a request; all must call it."""
        return bool(comm.allreduce(self.requested, MPI.LOR))

    def check(self, comm: MPI.Comm) -> None:
        """Raise StoppedError on all ranks of ``comm`` if any got a request; all must call it."""
        if self.agreed(comm):
            raise StoppedError("stopped on request; the same command goes on")

    @contextmanager
    def listening(self, at_once: bool = False) -> Iterator[Self]:
        """Take SIGTERM, SIGINT, SIGHUP and SIGUSR1 for requests within the block; a second ends the process.

        ``at_once``: the first one ends the work where it is, for what has nothing to save: StoppedError is raised.
        """

        def receive(number: int, frame: FrameType | None) -> None:
            self.requested = True
            signal.pthread_sigmask(signal.SIG_BLOCK, earlier)
            signal.sigtimedwait(earlier, 0.1)  # ``timeout`` sends its signal twice
            for number in earlier:
                signal.signal(number, signal.SIG_DFL)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, earlier)
            if at_once and MPI.COMM_WORLD.size > 1:
                MPI.COMM_WORLD.Abort(os.EX_TEMPFAIL)  # the others may wait for this rank
            if at_once:
                raise StoppedError("stopped on request")

        # What nohup has set stays.
        taken = [number for number in STOP_SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
        earlier = {number: signal.signal(number, receive) for number in taken}
        try:
            yield self
        finally:
            for number, handler in earlier.items():
                signal.signal(number, handler)


class Progress:
    """How far a run is, on rank 0: a bar on a terminal, otherwise a line of the log every five seconds."""

    def __init__(self, comm: MPI.Comm, total: float, unit: str, show: bool = True) -> None:
        self._total, self._unit = total, unit
        self._begin = self._last = time.monotonic()
        self._first = 0.0
        self._show = show and comm.rank == 0
        terminal = self._show and sys.stderr.isatty() and logging.getLogger(BAR).level < logging.CRITICAL
        layout = "{percentage:3.0f}%|{bar}| {n:.4g}/{total:.4g} {unit} [{elapsed}<{remaining}]"
        self._bar = tqdm(total=total, unit=unit, bar_format=layout, file=sys.stderr) if terminal else None

    def start_at(self, done: float) -> None:
        """Count from ``done``, where a resumed run begins."""
        self._first = done
        if self._bar is not None:
            self._bar.update(done)

    def update(self, done: float) -> None:
        """Report that ``done`` of the total is reached."""
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(done - self._bar.n)
        elif self._show and now - self._last >= 5.0:
            rate = (done - self._first) / (now - self._begin)
            left = (self._total - done) / rate if rate > 0 else float("inf")
            share = f"{100 * done / self._total:3.0f} %  {done:.4g} of {self._total:.4g} {self._unit}"
            logger.info("%s, %.0f s left", share, left)
            self._last = now

    def close(self) -> None:
        """End the bar, if there is one."""
        if self._bar is not None:
            self._bar.close()
