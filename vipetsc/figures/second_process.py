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

# With the places where this process finds modules: a module of a case may be next to it.
SERVE = "import sys; sys.path[:] = {path!r}; from vipetsc.figures.draw_requests import serve; serve({turns})"


class SecondProcess:
    """A process that draws what it is asked to as ``vipetsc.figures.registry.draw``, one request after the other.

    It loads what it needs while this process computes. It holds no lock and no open file of this process, and ends
    with it, however that ends. Whatever fails there fails without a message: who asks draws then by itself, and meets
    the error. ``turns`` are for pictures that both processes draw.
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
        """Whether there is an idle core for it, and this process would load the tools for pictures too.

        Where they are loaded, as in a test or a notebook, pictures are drawn before a second process could begin. Where
        other work takes all cores, loading the program twice would take its time from both.
        """
        # macOS has neither affinities nor files in memory.
        if not sys.platform.startswith("linux"):
            return False
        has_idle_core = len(os.sched_getaffinity(0)) > 1 and os.getloadavg()[0] < (os.cpu_count() or 1)
        return has_idle_core and "matplotlib" not in sys.modules

    @property
    def is_asked(self) -> bool:
        """Whether it was asked for anything that `drawn` has not waited for."""
        return self._asked > 0

    def ask(self, source: str, folders: Sequence[Path], divided: bool = False, **options: Any) -> None:
        """Ask for what ``vipetsc.figures.registry.draw`` draws with these arguments; returns at once.

        Of pictures that are ``divided`` it draws those whose turns this process does not take.
        """
        self._folders |= {*folders}
        self._asked += 1
        options |= {"source": source, "folders": [str(folder) for folder in folders]}
        text = json.dumps({"divided": divided, "options": options})
        # If it has ended, `drawn` will find no answer.
        with suppress(OSError):
            self._channel.sendall(f"{text}\n".encode())

    def drawn(self) -> list[Path] | None:
        """Wait for all that was asked for; returns the files, or None if anything failed."""
        with self._channel.makefile(encoding="utf-8") as answers:
            try:
                lines = [answers.readline() for _ in range(self._asked)]
            except OSError:
                return None
        self._asked = 0

        files: list[Path] = []
        for line in lines:
            # Without an answer it has ended, with null a picture has failed.
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
        # Of a picture that it was drawing.
        for folder in self._folders:
            remove_abandoned(folder / "figures")
