"""Ranks that work, fail and end together.

MPI is imported where it is needed, here and in verbs: the import starts it, which takes a fifth of a second, and verbs
that only look at a case or at the program run without it, in a process that is `ALONE`.
"""

import logging
import os
import pickle
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar, cast

import numpy as np

from vipetsc.process import STOP_SIGNALS, end_now
from vipetsc.wording import of_system

if TYPE_CHECKING:
    from mpi4py import MPI

T = TypeVar("T")
logger = logging.getLogger(__name__)


class OneProcess:
    """A process without MPI, where a communicator is asked for: the functions here send no message from one rank."""

    rank = 0
    size = 1


ALONE = cast("MPI.Comm", OneProcess())


def install_abort_hook(comm: "MPI.Comm | None" = None) -> None:
    """Let a rank that raises end all ranks of ``comm``, by default all there are, with one message.

    Otherwise the others wait for it for ever. The front door calls it; a script that starts ranks of its own may.
    """
    if comm is None:
        from mpi4py import MPI

        comm = MPI.COMM_WORLD

    def hook(kind: type[BaseException], error: BaseException, trace: Any) -> None:
        if comm.rank and getattr(error, "from_root", False):
            time.sleep(2)  # rank 0 raised the same: its message is enough, and it ends this rank
        where = f"rank {comm.rank}: " if comm.size > 1 else ""
        # A full disk or too little memory is the machine's matter: the trace would hide the message.
        if isinstance(error, OSError):
            text = of_system(error)
        elif isinstance(error, MemoryError):
            text = str(error) or "out of memory"
        else:
            text = "".join(traceback.format_exception(kind, error, trace))
        logger.critical("vipetsc: %s%s", where, text.rstrip())

        sys.stdout.flush()
        if comm.size > 1:
            comm.Abort(1)
        # Without Python's functions at exit: that of HDF5 crashes after a full disk.
        os._exit(1)

    sys.excepthook = hook


def wait_for_all(comm: "MPI.Comm") -> None:
    """Wait for all ranks of ``comm``, asleep after a millisecond: those that still work need the cores."""
    barrier = comm.Ibarrier()
    begin = time.monotonic()
    while not barrier.Test():
        # Shorter waits are not slept through: a sleep would lengthen them.
        if time.monotonic() - begin > 1e-3:
            time.sleep(1e-3)


def all_meet(comm: "MPI.Comm", patience: float) -> bool:
    """Return whether all ranks of ``comm`` call this within ``patience`` s: one that was killed never does."""
    if comm.size == 1:
        return True
    barrier = comm.Ibarrier()
    deadline = time.monotonic() + patience
    while not barrier.Test():
        if time.monotonic() > deadline:
            return False
        time.sleep(1e-3)
    return True


def on_one_machine(comm: "MPI.Comm") -> bool:
    """Return whether all ranks of ``comm`` are on one machine, and see its temporary folders; all must call it."""
    from mpi4py import MPI

    machine = comm.Split_type(MPI.COMM_TYPE_SHARED)
    size = machine.size
    machine.Free()
    return bool(comm.allreduce(size == comm.size, MPI.LAND))


def on_root(comm: "MPI.Comm", function: Callable[[], T]) -> T:
    """Return the value of ``function`` called on rank 0, on all ranks; what it raises is raised on all ranks."""
    # A rank alone keeps the value as it is: a copy of a case, as messages make, would be resolved again.
    if comm.size == 1:
        return _value_or_raise(_attempt(function))
    attempt = None
    if comm.rank == 0:
        attempt = _sendable(_attempt(function))
    wait_for_all(comm)  # before the broadcast, in which ranks would wait at full speed
    return _value_or_raise(comm.bcast(attempt))


def on_every_rank(comm: "MPI.Comm", function: Callable[[], T]) -> T:
    """Return value of ``function`` called on each rank; what it raises on one, the lowest, is raised on all ranks."""
    attempt = _attempt(function)
    if comm.size == 1:
        return _value_or_raise(attempt)
    wait_for_all(comm)
    errors = [error for error in comm.allgather(_sendable(attempt).error) if error is not None]
    if not errors:
        return _value_or_raise(attempt)
    # A second name: the attempt, whose traceback holds the open files of ``function``, has to outlive the error that is
    # raised, since HDF5 crashes where it frees a file that a full disk kept it from closing.
    agreed = _Attempt(value=None, error=errors[0])
    return _value_or_raise(agreed)


def divided(comm: "MPI.Comm", jobs: Sequence[Callable[[], T]]) -> list[T]:
    """Return the values of all ``jobs``, of which each rank computes every ``comm.size``-th, on all ranks.

    What the first job that fails raises is raised on all. All ranks must call it with the same number of jobs.
    """
    attempts = {number: _attempt(jobs[number]) for number in range(comm.rank, len(jobs), comm.size)}
    if comm.size > 1:
        wait_for_all(comm)
        for from_rank in comm.allgather({number: _sendable(attempt) for number, attempt in attempts.items()}):
            attempts |= from_rank
    return [_value_or_raise(attempts[number]) for number in range(len(jobs))]


def smallest(comm: "MPI.Comm", *numbers: float) -> list[float]:
    """Return smallest value that each of the ``numbers`` has on any rank, in one reduction; all ranks must call it."""
    if comm.size == 1:
        return [*numbers]
    from mpi4py import MPI

    reduced = np.array(numbers)
    comm.Allreduce(MPI.IN_PLACE, reduced, MPI.MIN)
    return [float(number) for number in reduced]


class _Attempt(NamedTuple):
    """The ``value`` of a call, or the ``error`` that it raised."""

    value: Any
    error: Exception | None


def _attempt(function: Callable[[], T]) -> _Attempt:
    """Call ``function``, and keep what it raises."""
    try:
        return _Attempt(value=function(), error=None)
    except SystemExit as error:
        # A user's module may leave by ``sys.exit``, on one rank perhaps: the others must not wait for it.
        return _Attempt(value=None, error=RuntimeError(f"sys.exit({error.code!r}) was called"))
    except Exception as error:
        return _Attempt(value=None, error=error)


def _sendable(attempt: _Attempt) -> _Attempt:
    """Return an ``attempt`` whose error other ranks can raise: where it cannot be copied, a RuntimeError with its text.

    An exception whose constructor takes other arguments than it passes on cannot be made again from these.
    """
    error = attempt.error
    if error is None:
        return attempt
    try:
        copied = type(pickle.loads(pickle.dumps(error))) is type(error)
    except Exception:
        copied = False
    if copied:
        return attempt
    return _Attempt(value=None, error=RuntimeError(f"{type(error).__name__}: {error}"))


def _value_or_raise(attempt: _Attempt) -> Any:
    """Return the value of an ``attempt`` that all ranks have; raises its error on all of them."""
    if attempt.error is not None:
        attempt.error.from_root = True  # type: ignore[attr-defined]  # rank 0 raises it too, and reports it for all
        raise attempt.error
    return attempt.value


class SharedCounter:
    """A count that all ranks of ``comm`` draw from, one-sided: no rank has to wait on another to hand out work."""

    def __init__(self, comm: "MPI.Comm") -> None:
        from mpi4py import MPI

        self._window = MPI.Win.Allocate(8 if comm.rank == 0 else 0, 8, comm=cast("MPI.Intracomm", comm))
        if comm.rank == 0:
            np.frombuffer(self._window.tomemory(), np.int64)[:] = 0  # type: ignore[call-overload]
        comm.Barrier()

    def draw(self, step: int = 1) -> int:
        """Return the count before ``step`` is added to it."""
        from mpi4py import MPI

        value = np.empty(1, np.int64)
        added = np.array([step], np.int64)
        self._window.Lock(0, MPI.LOCK_SHARED)
        self._window.Fetch_and_op(added, value, 0, 0, MPI.SUM)
        self._window.Unlock(0)
        return int(value[0])

    def free(self) -> None:
        """Give the window back; all ranks must call it."""
        self._window.Free()

    @classmethod
    @contextmanager
    def within(cls, comm: "MPI.Comm") -> Iterator[Self]:
        """Yield a counter for a block that all ranks leave together; one that leaves by an error must not wait."""
        counter = cls(comm)
        try:
            yield counter
        except BaseException as error:
            if getattr(error, "from_root", False):
                counter.free()
            raise
        counter.free()


class StoppedError(Exception):
    """Work was left on request; the message says how to go on with it."""


class StudyError(RuntimeError):
    """A study that cannot be finished: the message says which of its runs failed, and why."""


class StopRequest:
    """A request to stop, by a signal: ``requested`` once this rank has got one.

    One rank must not leave the others: a loop that all ranks go through asks whether it is ``agreed``, or calls
    ``check``; work that one rank does alone looks at ``requested``, and the ranks agree when they meet again.
    """

    requested = False
    _is_listening = False

    def agreed(self, comm: "MPI.Comm") -> bool:
        """Return whether any rank of ``comm`` got a request; all must call it."""
        if comm.size == 1:
            return self.requested
        return any(comm.allgather(self.requested))

    def check(self, comm: "MPI.Comm") -> None:
        """Raise StoppedError on all ranks of ``comm`` if any got a request; all must call it."""
        if self.agreed(comm):
            raise StoppedError("stopped on request; the same command continues")

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Let a request end the process within the block, in which nothing has to be saved: files are whole or absent.

        A process that is not ``listening``, such as a user's script, keeps its own handlers of signals.
        """
        if not self._is_listening:
            yield
            return
        with _handled_by(end_now):
            yield

    @contextmanager
    def listening(self) -> Iterator[Self]:
        """Take SIGTERM, SIGINT, SIGHUP and SIGUSR1 for requests within the block; a second ends the process."""

        def receive(number: int, frame: FrameType | None) -> None:
            self.requested = True
            # `timeout` sends its signal twice: the second, if it comes at once, is not a wish to end the process.
            time.sleep(0.1)
            for number in STOP_SIGNALS:
                if signal.getsignal(number) == receive:
                    signal.signal(number, signal.SIG_DFL)

        with _handled_by(receive):
            self._is_listening = True
            try:
                yield self
            finally:
                self._is_listening = False


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Have ``handler`` called for requests to stop within the block, but for signals that nohup has set aside."""
    handlers = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    earlier = {number: former for number, former in handlers.items() if former != signal.SIG_IGN}
    for number in earlier:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, former in earlier.items():
            signal.signal(number, former)
