"""A second process that draws pictures from files while this one computes, where a core would be idle."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from vipetsc.figures.common_turns import CommonTurns
from vipetsc.io.atomic import remove_abandoned

# The program of the second process. It finds modules where this process does: a module that the case names may be in
# the working folder.
SERVE = "import sys; sys.path[:] = {path!r}; from vipetsc.figures.draw_requests import serve; serve({turns})"


class SecondProcess:
    """A process that draws what it is asked for, as ``vipetsc.figures.registry.draw``, one request after the other.

    It loads the tools for pictures while this process computes. It holds no lock and no open file of this process, and
    ends with it, however that ends. It gives no message if anything fails: `drawn` then returns None, and the caller,
    who draws by itself, meets the error. ``turns`` are the numbers of the pictures of a request that both processes
    share.
    """

    def __init__(self) -> None:
        self._file = os.memfd_create("turns")
        self.turns = CommonTurns(self._file)
        self._channel, its_end = socket.socketpair()
        self._folders: set[Path] = set()
        self._asked = 0
        with its_end:
            self._process = subprocess.Popen(
                [sys.executable, "-c", SERVE.format(path=sys.path, turns=self._file)],
                stdin=its_end.fileno(),
                pass_fds=(self._file,),
                # Signals of the terminal are for the process that asks.
                process_group=0,
            )

    @staticmethod
    def is_useful() -> bool:
        """Whether a second process saves time: there is an idle core, and the tools for pictures are not loaded here.

        If they are loaded, as in a test or a notebook, this process has drawn before a second one could begin. If other
        work takes all cores, a second process that loads the program takes time from the first.
        """
        # macOS has neither affinities nor files in memory (``os.memfd_create``).
        if not sys.platform.startswith("linux"):
            return False
        has_idle_core = len(os.sched_getaffinity(0)) > 1 and os.getloadavg()[0] < (os.cpu_count() or 1)
        return has_idle_core and "matplotlib" not in sys.modules

    @property
    def is_asked(self) -> bool:
        """Whether the process was asked for anything for which `drawn` has not waited."""
        return self._asked > 0

    def ask(self, source: str, folders: Sequence[Path], divided: bool = False, **options: Any) -> None:
        """Ask for what ``vipetsc.figures.registry.draw`` draws with these arguments; return at once.

        If the pictures are ``divided``, the process draws those whose ``turns`` this process does not take.
        """
        self._folders |= {*folders}
        self._asked += 1
        options |= {"source": source, "folders": [str(folder) for folder in folders]}
        text = json.dumps({"divided": divided, "options": options})
        # If the process has ended, `drawn` will find no answer.
        with suppress(OSError):
            self._channel.sendall(f"{text}\n".encode())

    def drawn(self) -> list[Path] | None:
        """Wait for all that was asked for, and return the files; None if anything failed."""
        with self._channel.makefile(encoding="utf-8") as answers:
            try:
                lines = [answers.readline() for _ in range(self._asked)]
            except OSError:
                return None
        self._asked = 0

        files: list[Path] = []
        for line in lines:
            # An empty line means that the process has ended, null that a picture has failed.
            names = json.loads(line or "null")
            if names is None:
                return None
            files += map(Path, names)
        return files

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the process, at once even if it draws."""
        self._channel.close()
        os.close(self._file)
        self._process.kill()
        self._process.wait()
        # It may have been writing a picture.
        for folder in self._folders:
            remove_abandoned(folder / "figures")
