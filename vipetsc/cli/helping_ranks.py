"""Ranks that draw pictures while rank 0 simulates and measures alone, where more ranks would not simulate faster.

Rank 0 computes as a process that was started without mpirun, and the others are what the second process is there: they
load the tools for pictures during the simulation, draw while rank 0 measures what their pictures do not show, and take
turns with it at the others. All of them would otherwise load and wait at the same times.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from mpi4py import MPI

from vipetsc.figures.loading import load_matplotlib
from vipetsc.parallel import SharedCounter, StopRequest, on_root

T = TypeVar("T")
TAG = 1  # of all messages here
LOOK_EVERY = 1e-3  # s between two looks for a message: ranks that wait at full speed would keep cores from others


class DrawRequest(NamedTuple):
    """Pictures for ``vipetsc.figures.registry.draw``, by its ``options``; rank 0 draws some of those ``divided``."""

    divided: bool
    options: dict[str, Any]


class AnswerRequest:
    """The request for the answer to all requests before it: the files, or the error that a picture raised."""


class HelpingRanks:
    """The other ranks of ``comm`` as rank 0 sees them; ``turns`` are numbers of pictures that all ranks draw."""

    def __init__(self, comm: MPI.Comm, turns: Iterator[int]) -> None:
        self.turns = turns
        self.is_asked = False
        self._comm = comm
        self._ranks = range(1, comm.size)

    def ask(self, source: str, folders: Sequence[Path], divided: bool = False, **options: Any) -> None:
        """Ask for what ``vipetsc.figures.registry.draw`` draws with these arguments; returns at once.

        Of pictures that are ``divided`` they draw those whose turns rank 0 does not take.
        """
        self.is_asked = True
        self._send(DrawRequest(divided, options | {"source": source, "folders": folders}))

    def drawn(self) -> list[Path]:
        """Wait for all that was asked for; returns the files, and raises what one of the ranks raised."""
        self._send(AnswerRequest())
        answers = [_received(self._comm, rank) for rank in self._ranks]
        self.is_asked = False
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
        return [path for files in answers for path in files]

    def dismiss(self) -> None:
        """Let them go, whether or not they have been asked for an answer."""
        self._send(None)

    def _send(self, request: DrawRequest | AnswerRequest | None) -> None:
        """Send a request to each of them."""
        for rank in self._ranks:
            self._comm.send(request, rank, TAG)


def with_helping_ranks(comm: MPI.Comm, stop: StopRequest, work: Callable[[HelpingRanks], T]) -> T:
    """Value of ``work``, on all ranks of ``comm``; rank 0 calls it alone, and the others draw what it asks them for.

    A request to ``stop`` that another rank gets counts as one of rank 0. All ranks must call it; what ``work`` raises
    is raised on all of them.
    """
    with SharedCounter.within(comm) as pictures, stop.passed_on(comm):
        turns = iter(pictures.draw, None)
        helpers = HelpingRanks(comm, turns)

        def work_and_dismiss() -> T:
            try:
                return work(helpers)
            finally:
                helpers.dismiss()

        if comm.rank:
            _help(comm, stop, turns)
        return on_root(comm, work_and_dismiss)


def _help(comm: MPI.Comm, stop: StopRequest, turns: Iterator[int]) -> None:
    """Draw what rank 0 asks for until it dismisses this rank."""
    # What cannot be loaded is reported where it is needed.
    with suppress(Exception):
        load_matplotlib()
        import vipetsc.figures.registry  # noqa: F401

    files: list[Path] = []
    failure: Exception | None = None
    while request := _received(comm, 0, stop):
        if isinstance(request, AnswerRequest):
            comm.send(failure or files, 0, TAG)
            continue
        # Pictures that rank 0 leaves to the helpers are shared by rank.
        own_turns = turns if request.divided else count(comm.rank - 1, comm.size - 1)
        try:
            # The run is saved: a request to stop ends all ranks.
            with stop.at_once():
                files += _drawn(request.options, own_turns)
        except Exception as error:
            failure = failure or error


def _drawn(options: dict[str, Any], turns: Iterator[int]) -> list[Path]:
    """Draw as ``vipetsc.figures.registry.draw``."""
    from vipetsc.figures.registry import draw

    return draw(**options, turns=turns)


def _received(comm: MPI.Comm, rank: int, stop: StopRequest | None = None) -> Any:
    """The next message of ``rank``, for which this one waits asleep; it passes on a request to ``stop`` meanwhile."""
    while not comm.Iprobe(rank, TAG):
        if stop:
            stop.pass_on()
        time.sleep(LOOK_EVERY)
    return comm.recv(source=rank, tag=TAG)
