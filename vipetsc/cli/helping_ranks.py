"""Ranks that draw pictures while rank 0 simulates and measures alone, where more ranks would not simulate faster.

Rank 0 computes like a process that was started without mpirun. The other ranks do what `SecondProcess` does there: they
load matplotlib during the simulation, draw the pictures that need no measures while rank 0 measures, and share those
that are left with it. If all ranks worked on the simulation, they would then all load matplotlib at the same time.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from mpi4py import MPI

from vipetsc.figures.loading import load_matplotlib
from vipetsc.figures.second_process import Drawn, DrawRequest
from vipetsc.parallel import SharedCounter, StopRequest, on_root

T = TypeVar("T")
MOST_REQUESTS = 2  # of rank 0: for pictures that need no measures, and for the others
TAG = 1  # of all messages of this module
LOOK_EVERY = 1e-3  # s between two looks for a message; MPI's own wait would keep a core busy


class DrawMessage(NamedTuple):
    """A call of ``vipetsc.figures.registry.draw`` with ``options``, for the request with this ``number``, from 0."""

    number: int
    options: dict[str, Any]


class AnswerRequest:
    """A request for the outcome of the requests since the last such one: the files, or the error of a picture."""


class HelpingRanks:
    """The other ranks of ``comm``, as rank 0 uses them.

    ``turns`` are ``MOST_REQUESTS`` sequences of picture numbers (see ``vipetsc.figures.style.draw_each``), one for each
    request, which all ranks share: each number goes to one rank. ``requests`` are those for which ``drawn`` has not
    waited: rank 0 draws pictures that are left of them when it has computed.
    """

    draws_alone = False

    def __init__(self, comm: MPI.Comm, turns: Sequence[Iterator[int]]) -> None:
        self.requests: list[DrawRequest] = []
        self._comm = comm
        self._ranks = range(1, comm.size)
        self._turns = enumerate(turns)

    def ask(self, source: str, folders: Sequence[Path], **options: Any) -> None:
        """Ask for what ``vipetsc.figures.registry.draw`` draws with these arguments; returns at once."""
        options |= {"source": source, "folders": folders}
        number, turns = next(self._turns)
        self.requests.append(DrawRequest(options, turns))
        self._send(DrawMessage(number, options))

    def drawn(self) -> Drawn:
        """Wait for what the other ranks draw; raises the error of a rank whose picture failed."""
        self._send(AnswerRequest())
        answers = [_received(self._comm, rank) for rank in self._ranks]
        self.requests.clear()
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
        return Drawn([path for files in answers for path in files], reasons={})

    def dismiss(self) -> None:
        """End the helpers' wait for requests, whether or not `drawn` was called."""
        self._send(None)

    def _send(self, request: DrawMessage | AnswerRequest | None) -> None:
        """Send a request to every helper."""
        for rank in self._ranks:
            self._comm.send(request, rank, TAG)


def with_helping_ranks(comm: MPI.Comm, stop: StopRequest, work: Callable[[HelpingRanks], T]) -> T:
    """Call ``work`` on rank 0 alone, while the others draw what it asks them for; its value on all ranks of ``comm``.

    A request to ``stop`` that another rank gets is passed on to rank 0. All ranks must call it; what ``work`` raises is
    raised on all of them.
    """
    with ExitStack() as stack:
        counters = [stack.enter_context(SharedCounter.within(comm)) for _ in range(MOST_REQUESTS)]
        stack.enter_context(stop.passed_on(comm))
        turns = [iter(counter.draw, None) for counter in counters]
        helpers = HelpingRanks(comm, turns)

        def work_and_dismiss() -> T:
            try:
                return work(helpers)
            finally:
                helpers.dismiss()

        if comm.rank:
            _help(comm, stop, turns)
        return on_root(comm, work_and_dismiss)


def _help(comm: MPI.Comm, stop: StopRequest, turns: Sequence[Iterator[int]]) -> None:
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
            files = []
            failure = None
            continue
        try:
            # The run is saved by now: a request to stop may end the picture, and all ranks.
            with stop.at_once():
                files += _drawn(request.options, turns[request.number])
        except Exception as error:
            failure = failure or error


def _drawn(options: dict[str, Any], turns: Iterator[int]) -> list[Path]:
    """Draw the pictures with the numbers ``turns``; ``options`` are those of ``vipetsc.figures.registry.draw``."""
    from vipetsc.figures.registry import draw

    return draw(**options, turns=turns)


def _received(comm: MPI.Comm, rank: int, stop: StopRequest | None = None) -> Any:
    """Wait asleep for the next message of ``rank``; requests to ``stop`` that come meanwhile are passed on."""
    while not comm.Iprobe(rank, TAG):
        if stop:
            stop.pass_on()
        time.sleep(LOOK_EVERY)
    return comm.recv(source=rank, tag=TAG)
