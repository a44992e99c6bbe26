"""Messages: results on stdout, progress and warnings on stderr, all of them in a file if ``--log`` names one.

What a verb was asked to print is an "answer", as opposed to progress and warnings about it.
"""

import argparse
import logging
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from mpi4py import MPI

from vipetsc.cli.streams import CheckedStream
from vipetsc.io.lock import FolderError
from vipetsc.parallel import on_root
from vipetsc.progress import BAR

logger = logging.getLogger("vipetsc")
answers = logging.getLogger("vipetsc.answers")
OFTEN = {"vipetsc.step", "vipetsc.landing", "vipetsc.read"}  # audit events too frequent for --verbose


def echo(comm: MPI.Comm, text: str, stream: TextIO | None = None) -> None:
    """Print ``text`` on rank 0, as an answer; with stderr as the ``stream`` as a warning."""
    if comm.rank != 0:
        return
    if stream is None:
        answers.info("%s", text)
    else:
        logger.warning("%s", text)


def echo_paths(comm: MPI.Comm, paths: Iterable[Path]) -> None:
    """Print on rank 0 which files were written."""
    for path in paths:
        echo(comm, f"  {path}")


def echo_warnings(comm: MPI.Comm, warnings: Iterable[str]) -> None:
    """Print warnings about a case or a result on rank 0."""
    for warning in warnings:
        echo(comm, f"vipetsc: warning: {warning}", sys.stderr)


@contextmanager
def reporting(comm: MPI.Comm, options: argparse.Namespace, is_answer: bool) -> Iterator[list[TextIO]]:
    """Print messages within the block as ``options`` ask for (quiet, verbose, log).

    With ``is_answer``, answers are printed even with --quiet. The value of the block is the list of the streams that
    must take all output, for ``report_unwritten``. All ranks must call it. Raises FolderError if the file of ``--log``
    cannot be opened.
    """
    handlers = _stream_handlers(quiet=options.quiet, is_answer=is_answer)
    streams = [sys.stdout]
    if options.log:
        # All ranks must raise the error: otherwise they would wait for rank 0 in the first collective call.
        on_root(comm, lambda: streams.append(_open_log(options.log)))
        handlers += [_log_handler(stream) for stream in streams[1:]]

    # Messages do not go on to the root logger: the handler that `__main__` gives it would print everything again.
    is_verbose = options.verbose and comm.rank == 0
    level = logger.level
    logger.propagate = False
    logger.setLevel(logging.DEBUG if is_verbose else logging.INFO)
    # Progress bars write to stderr themselves, and look at the level of a logger of their own.
    logging.getLogger(BAR).setLevel(logging.CRITICAL if options.quiet else logging.NOTSET)
    for handler in handlers:
        logger.addHandler(handler)
    if is_verbose:
        sys.addaudithook(_report_phase)

    try:
        yield streams
    except Exception as error:
        # The error goes into the file alone: on stderr the exception hook of the process reports it.
        for handler in handlers:
            if handler.stream in streams[1:]:
                handler.handle(logger.makeRecord(logger.name, logging.CRITICAL, "", 0, f"vipetsc: {error}", (), None))
        raise
    finally:
        for handler in handlers:
            logger.removeHandler(handler)
            handler.close()
        for stream in streams[1:]:
            stream.close()
        logger.propagate = True
        logger.setLevel(level)


def _stream_handlers(quiet: bool, is_answer: bool) -> "list[logging.StreamHandler[TextIO]]":
    """The handlers of stdout, for answers, and of stderr, for everything else."""
    out = logging.StreamHandler(sys.stdout)
    out.addFilter(lambda record: record.name == answers.name and (is_answer or not quiet))
    err = logging.StreamHandler(sys.stderr)
    err.addFilter(lambda record: record.name != answers.name)
    err.setLevel(logging.WARNING if quiet else logging.DEBUG)
    return [out, err]


def _open_log(path: Path) -> CheckedStream:
    """The file of ``--log``, to whose end messages are added."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    except OSError as error:
        raise FolderError(f"--log {path}: {error.strerror}; name a file that can be written") from error
    return CheckedStream(descriptor, f"--log {path}", encoding="utf-8")


def _log_handler(stream: TextIO) -> "logging.StreamHandler[TextIO]":
    handler = logging.StreamHandler(stream)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    return handler


def _report_phase(event: str, arguments: tuple[Any, ...]) -> None:
    """Log the phase that a verb begins (a hook for audit events, which stays installed until the process ends)."""
    # Python removes no audit hook: after the block the level silences this one.
    if event.startswith("vipetsc.") and event not in OFTEN and logger.isEnabledFor(logging.DEBUG):
        logger.debug("%s %s", event.removeprefix("vipetsc."), " ".join(map(str, arguments)))
