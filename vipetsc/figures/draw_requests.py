"""Program of the process that ``SecondProcess`` starts: it draws what it is asked for, one request after the other.

At the first request it makes copies of itself, so that pictures are drawn on several cores. The process and each copy
have a socket of their own, on which requests and answers are messages in JSON. A request has the ``source``, the
``folders``, the ``names`` and further ``options`` of ``vipetsc.figures.registry.draw``, and the ``number`` of its
turns. The answer has the ``files`` that were drawn, and the ``reasons`` why figures are left out; or it is null if
drawing failed.
"""

import gc
import json
import os
import socket
from collections.abc import Mapping, Sequence
from contextlib import suppress
from fcntl import F_SETFL, F_SETOWN, fcntl
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vipetsc.figures.common_turns import CommonTurns
from vipetsc.figures.loading import load_matplotlib
from vipetsc.process import collect_seldom

if TYPE_CHECKING:
    from vipetsc.figures.sweep_members import Files

LONGEST = 100_000  # bytes of a message


def serve(alive: int, turns: int, channels: Sequence[int]) -> None:
    """Answer requests until the process that asks ends.

    The arguments are descriptors. ``alive`` is a pipe that only the process that asks can write to, ``turns`` the file
    of `CommonTurns`, by which all processes share the pictures of a request, and ``channels`` are the sockets.
    """
    # When the pipe is closed, the system sends this process and its copies a signal, which ends them at once, even in
    # the middle of a picture, for which nobody waits any more.
    fcntl(alive, F_SETOWN, -os.getpgrp())
    fcntl(alive, F_SETFL, os.O_ASYNC)

    collect_seldom()
    # Loaded before the first request, while the process that asks is still computing.
    load_matplotlib()
    from vipetsc.figures.sweep_members import Files

    sockets = [socket.socket(fileno=number) for number in channels]
    with Files() as files:
        # The results are opened, and their case is checked, before there are copies, which need not do so again.
        with suppress(Exception):
            _reasons(json.loads(sockets[0].recv(LONGEST, socket.MSG_PEEK)), files)

        channel = _channel_of_copy(sockets)
        while message := channel.recv(LONGEST):
            answer: Any = None
            # If this fails, the process that asks draws by itself, and reports the error.
            with suppress(Exception):
                answer = _drawn(json.loads(message), turns, files)
            channel.send(json.dumps(answer).encode())


def _channel_of_copy(sockets: Sequence[socket.socket]) -> socket.socket:
    """Make copies of this process, one for each of the ``sockets`` but the first; returns the socket of each."""
    # What is loaded stays to the end: no collection need look at it, and the copies share its memory.
    gc.freeze()
    first, *others = sockets
    channel = first
    for other in others:
        if os.fork() == 0:
            channel = other
            break

    # A socket is closed when the only process ends that has it: nobody waits for its answers then.
    for other in sockets:
        if other is not channel:
            other.close()
    return channel


def _drawn(request: Mapping[str, Any], turns: int, files: "Files") -> dict[str, Any]:
    """Draw the pictures of a ``request`` whose numbers are taken from its turns; returns the answer."""
    from vipetsc.figures.registry import draw

    drawn = draw(
        request["source"],
        [Path(folder) for folder in request["folders"]],
        request["names"],
        turns=CommonTurns(turns, request["number"]),
        files=files,
        **request["options"],
    )
    return {"files": [str(path) for path in drawn], "reasons": _reasons(request, files)}


def _reasons(request: Mapping[str, Any], files: "Files") -> dict[str, str]:
    """The reasons why figures of a ``request`` are left out, by their names."""
    from vipetsc.figures.without_picture import reasons_without_pictures

    folders = [Path(folder) for folder in request["folders"]]
    return reasons_without_pictures(request["source"], folders, files, request["names"])
