"""Program of the process that ``SecondProcess`` starts: it draws the requests one after the other."""

import gc
import json
import os
import socket
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any

from vipetsc.figures.common_turns import CommonTurns
from vipetsc.figures.loading import load_matplotlib
from vipetsc.process import collect_seldom


def serve(turns: int) -> None:
    """Answer each request, a line on the socket that is this process's standard input; end with the process that asks.

    ``turns`` is the descriptor of the file of turns.
    """
    collect_seldom()
    channel = socket.socket(fileno=0)
    requests: SimpleQueue[str] = SimpleQueue()
    Thread(target=_receive, args=(channel, requests), daemon=True).start()
    # Before the first request, as the process that asks is still computing.
    load_matplotlib()
    from vipetsc.figures.registry import draw

    gc.freeze()
    while True:
        request = json.loads(requests.get())
        options = request["options"]
        options["folders"] = [Path(folder) for folder in options["folders"]]
        if request["divided"]:
            options["turns"] = CommonTurns(turns)

        answer: Any = None
        # The process that asks draws by itself where this fails, and says what is wrong.
        with suppress(Exception):
            answer = [str(path) for path in draw(**options)]
        channel.sendall(f"{json.dumps(answer)}\n".encode())


def _receive(channel: socket.socket, requests: SimpleQueue[str]) -> None:
    """Pass on the lines that come through ``channel``; end the process when the other end is closed."""
    with channel.makefile(encoding="utf-8") as lines:
        for line in lines:
            requests.put(line)
    # At once, in the middle of a picture too: nobody waits for it any more.
    os._exit(0)
