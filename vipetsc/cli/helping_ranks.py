"""Ranks that draw pictures while rank 0 simulates and measures alone, where more ranks would not simulate faster.

Rank 0 computes like a process that was started without mpirun. The other ranks do what `SecondProcess` does there: they
load matplotlib during the simulation, draw the pictures that need no measures while rank 0 measures, and share the
other pictures with it. If all ranks worked on the simulation, they would then all load matplotlib at the same time.
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
TAG = 1  # of all messages of this module
LOOK_EVERY = 1e-3  # s between two looks for a message: MPI's own wait would keep a core busy


class DrawRequest(NamedTuple):
    """A call of ``vipetsc.figures.registry.draw`` with ``options``; rank 0 draws a part of it if it is ``divided``."""

    divided: bool
    options: dict[str, Any]


class AnswerRequest:
    """A request for the outcome of all requests before it: the files, or the error that a picture raised."""


class HelpingRanks:
    """The other ranks of ``comm``, as rank 0 uses them.

    ``turns`` are numbers of pictures to draw; all ranks take from the same ones. ``is_asked`` says whether anything was
    asked for that ``drawn`` has not waited for.
    """

    def __init__(self, comm: MPI.Comm, turns: Iterator[int]) -> None:
        self.turns = turns
        self.is_asked = False
        self._comm = comm
        self._ranks = range(1, comm.size)

    def ask(self, source: str, folders: Sequence[Path], divided: bool = False, **options: Any) -> None:
        """Ask for what ``vipetsc.figures.registry.draw`` draws with these arguments; returns at once.

        The other ranks draw all of it, or, if ``divided``, the pictures whose numbers they take from ``turns``.
        """
        self.is_asked = True
        self._send(DrawRequest(divided, options | {"source": source, "folders": folders}))

    def drawn(self) -> list[Path]:
        """Wait for all that was asked for; returns the files, or raises the error of a rank whose picture failed."""
        self._send(AnswerRequest())
        answers = [_received(self._comm, rank) for rank in self._ranks]
        self.is_asked = False
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
        return [path for files in answers for path in files]

    def dismiss(self) -> None:
        """End the helpers' wait for requests, whether or not `drawn` was called."""
        self._send(None)

    def _send(self, request: DrawRequest | AnswerRequest | None) -> None:
        """Send a request to every helper."""
        for rank in self._ranks:
            self._comm.send(request, rank, TAG)


def with_helping_ranks(comm: MPI.Comm, stop: StopRequest, work: Callable[[HelpingRanks], T]) -> T:
    """Call ``work`` on rank 0 alone, while the others draw what it asks them for; its value on all ranks of ``comm``.

    A request to ``stop`` that another rank gets is passed on to rank 0. All ranks must call it; what ``work`` raises is
    raised on all of them.
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
    # Loaded while rank 0 simulates. An error is not reported here but at the first picture.
    with suppress(Exception):
        load_matplotlib()
        import vipetsc.figures.registry  # noqa: F401

    files: list[Path] = []
    failure: Exception | None = None
    while request := _received(comm, 0, stop):
        if isinstance(request, AnswerRequest):
            comm.send(failure or files, 0, TAG)
            continue
        # Those that are not divided with rank 0 are divided between the helpers, by their ranks.
        own_turns = turns if request.divided else count(comm.rank - 1, comm.size - 1)
        try:
            # The run is saved by now: a request to stop may end the picture, and all ranks.
            with stop.at_once():
                files += _drawn(request.options, own_turns)
        except Exception as error:
            failure = failure or error


def _drawn(options: dict[str, Any], turns: Iterator[int]) -> list[Path]:
    """Draw the pictures of these ``turns``; ``options`` are those of ``vipetsc.figures.registry.draw``."""
    from vipetsc.figures.registry import draw

    return draw(**options, turns=turns)


def _received(comm: MPI.Comm, rank: int, stop: StopRequest | None = None) -> Any:
    """Wait asleep for the next message of ``rank``; requests to ``stop`` that come meanwhile are passed on."""
    while not comm.Iprobe(rank, TAG):
        if stop:
            stop.pass_on()
        time.sleep(LOOK_EVERY)
    return comm.recv(source=rank, tag=TAG)
