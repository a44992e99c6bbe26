"""Program of the process that ``SecondProcess`` starts: it draws what it is asked for, one request after the other.

Requests and answers are lines of JSON on a socket. A request has the arguments of ``vipetsc.figures.registry.draw`` in
``options``, and ``divided``; the answer is the list of the files, or null if drawing failed.
"""

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
    """Answer the requests from the socket that is this process's standard input, until the process that asks ends.

    ``turns`` is the descriptor of the file of `CommonTurns`, by which both processes share the pictures of a request
    that is divided.
    """
    collect_seldom()
    channel = socket.socket(fileno=0)
    requests: SimpleQueue[str] = SimpleQueue()
    Thread(target=_receive, args=(channel, requests), daemon=True).start()
    # Loaded before the first request, while the process that asks is still computing.
    load_matplotlib()
    from vipetsc.figures.registry import draw

    # What is loaded stays to the end: no collection need look at it.
    gc.freeze()
    while True:
        request = json.loads(requests.get())
        options = request["options"]
        options["folders"] = [Path(folder) for folder in options["folders"]]
        if request["divided"]:
            options["turns"] = CommonTurns(turns)

        answer: Any = None
        # If this fails, the process that asks draws by itself, and reports the error.
        with suppress(Exception):
            answer = [str(path) for path in draw(**options)]
        channel.sendall(f"{json.dumps(answer)}\n".encode())


def _receive(channel: socket.socket, requests: SimpleQueue[str]) -> None:
    """Pass on the lines that come through ``channel``; end the process when the other end is closed."""
    with channel.makefile(encoding="utf-8") as lines:
        for line in lines:
            requests.put(line)
    # At once, even in the middle of a picture, for which nobody waits any more.
    os._exit(0)
