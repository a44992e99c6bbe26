"""A second process that draws pictures from files while this one computes, where a core would be idle."""

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from vipetsc.figures.common_turns import CommonTurns
from vipetsc.figures.draw_requests import LONGEST
from vipetsc.io.atomic import remove_abandoned

# The program of the second process. It finds modules where this process does: a module that the case names may be in
# the working folder.
SERVE = (
    "import sys; sys.path[:] = {path!r};"
    " from vipetsc.figures.draw_requests import serve; serve({alive}, {turns}, {channels})"
)
MOST_CORES = 4  # to draw on: a run has seven pictures, and each core needs 60 MB for them


class DrawRequest(NamedTuple):
    """A call of ``vipetsc.figures.registry.draw`` with ``options``.

    The processes that draw share its pictures: each takes the next number from ``turns`` when it has become free.
    """

    options: Mapping[str, Any]
    turns: Iterator[int]


class Drawn(NamedTuple):
    """The ``files`` of pictures, and the ``reasons`` why figures were left out, by name, if the helper knows them."""

    files: list[Path]
    reasons: Mapping[str, str]


class SecondProcess:
    """A process that draws what it is asked for, as ``vipetsc.figures.registry.draw``, one request after the other.

    It loads the tools for pictures while this process computes, and then draws on every idle core, by copies of itself.
    It holds no lock and no open file of this process, and all copies end with it, however that ends. They give no
    message if anything fails: `drawn` then returns None, and the caller, who draws by itself, meets the error.

    ``requests`` are those for which `drawn` has not waited: the caller may draw some of their pictures, by their turns.
    If the process ``draws_alone``, the caller only waits in `drawn`, and a further copy draws on its core meanwhile.
    Results in the folders must not change after the first request, but for files that are added.
    """

    def __init__(self, draws_alone: bool) -> None:
        self.draws_alone = draws_alone
        self.requests: list[DrawRequest] = []
        self._messages: list[bytes] = []
        self._numbers = count()
        self._folders: set[Path] = set()

        # Messages arrive whole, as they were sent.
        cores = _cores()
        copies = cores if draws_alone else cores - 1
        pairs = [socket.socketpair(type=socket.SOCK_SEQPACKET) for _ in range(copies)]
        self._channels = [ours for ours, _ in pairs]
        # Until it waits, this process computes on one of the cores: the copy for that core gets its requests then.
        self._early = self._channels[: cores - 1]
        self._late = self._channels[cores - 1 :]

        self._file = os.memfd_create("turns")
        alive, self._alive = os.pipe()
        theirs = [channel.fileno() for _, channel in pairs]
        program = SERVE.format(path=sys.path, alive=alive, turns=self._file, channels=theirs)
        self._process = subprocess.Popen(
            [sys.executable, "-c", program],
            stdin=subprocess.DEVNULL,
            pass_fds=(alive, self._file, *theirs),
            # Signals of the terminal are for the process that asks; a signal to the group ends all copies.
            process_group=0,
        )
        os.close(alive)
        for _, channel in pairs:
            channel.close()

    @staticmethod
    def is_useful() -> bool:
        """Whether a second process saves time: there is an idle core, and the tools for pictures are not loaded here.

        If they are loaded, as in a test or a notebook, this process is done with a picture before a second one could
        begin. If other work takes all cores, a second process that loads the program takes time from the first.
        """
        # macOS has neither affinities nor files in memory (``os.memfd_create``).
        if not sys.platform.startswith("linux"):
            return False
        has_idle_core = _cores() > 1 and os.getloadavg()[0] < (os.cpu_count() or 1)
        return has_idle_core and "matplotlib" not in sys.modules

    def ask(self, source: str, folders: Sequence[Path], names: Sequence[str] | None = None, **options: Any) -> None:
        """Ask for what ``vipetsc.figures.registry.draw`` draws with these arguments; return at once."""
        number = next(self._numbers)
        turns = CommonTurns(self._file, number)
        self.requests.append(DrawRequest({"source": source, "folders": folders, "names": names} | options, turns))
        self._folders |= {*folders}

        paths = [str(folder) for folder in folders]
        request = {"source": source, "folders": paths, "names": names, "options": options, "number": number}
        self._messages.append(json.dumps(request).encode())
        for channel in self._early:
            _send(channel, self._messages[-1:])

    def drawn(self) -> Drawn | None:
        """Wait for all that was asked for, and return it; None if anything failed."""
        for channel in self._late:
            _send(channel, self._messages)
        answers = [_received(channel) for channel in self._channels for _ in self._messages]
        self.requests.clear()
        self._messages.clear()

        if None in answers:
            return None
        # The last request was for all figures, also where some had been drawn before.
        return Drawn([Path(name) for answer in answers for name in answer["files"]], answers[-1]["reasons"])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the process and its copies, at once even if they draw."""
        # There is no process to be found if the system has killed them all.
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        os.close(self._alive)
        os.close(self._file)
        for channel in self._channels:
            # Copies are no children of this process, which would be waited for: one has ended when its socket has.
            with channel, suppress(ConnectionError):
                while channel.recv(LONGEST):
                    pass

        # Some may have been writing a picture.
        for folder in self._folders:
            remove_abandoned(folder / "figures")


def _cores() -> int:
    """The number of cores that this process and the copies may use."""
    return min(len(os.sched_getaffinity(0)), MOST_CORES)


def _send(channel: socket.socket, messages: Sequence[bytes]) -> None:
    """Send ``messages`` through a ``channel``; if its process has ended, there will be no answer."""
    with suppress(ConnectionError):
        for message in messages:
            channel.send(message)


def _received(channel: socket.socket) -> Any:
    """The next answer from a ``channel``; None if the request has failed, or the process has ended."""
    with suppress(ConnectionError):
        return json.loads(channel.recv(LONGEST) or "null")
    return None
