"""What is told: answers on stdout, progress and warnings on stderr, all of it in a file if ``--log`` names one."""

import argparse
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from mpi4py import MPI

from vipetsc.io.lock import FolderError
from vipetsc.parallel import BAR, on_root

logger, answers = logging.getLogger("vipetsc"), logging.getLogger("vipetsc.answers")
OFTEN = {"vipetsc.step", "vipetsc.landing", "vipetsc.read"}  # phases that --verbose leaves out


def echo(comm: MPI.Comm, text: str, stream: TextIO | None = None) -> None:
    """Tell ``text`` on rank 0, as an answer; with stderr as the ``stream`` as a warning."""
    if comm.rank == 0:
        (answers.info if stream is None else logger.warning)("%s", text)


@contextmanager
def told(comm: MPI.Comm, options: argparse.Namespace, asked: bool) -> Iterator[None]:
    """Tell within the block what ``options`` (quiet, verbose, log) want; what was ``asked`` for also when quiet.

    All ranks must call it. Raises FolderError if the file cannot be written.
    """
    out, err = logging.StreamHandler(sys.stdout), logging.StreamHandler(sys.stderr)
    handlers: list[logging.Handler] = [out, err]
    out.addFilter(lambda record: record.name == answers.name and (asked or not options.quiet))
    err.addFilter(lambda record: record.name != answers.name)
    err.setLevel(logging.WARNING if options.quiet else logging.DEBUG)
    if options.log:
        on_root(comm, lambda: _writable(options.log))
        if comm.rank == 0:
            file = logging.FileHandler(options.log, encoding="utf-8")
            file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
            handlers.append(file)
    level, logger.propagate = logger.level, False
    logger.setLevel(logging.DEBUG if options.verbose and comm.rank == 0 else logging.INFO)
    logging.getLogger(BAR).setLevel(logging.CRITICAL if options.quiet else logging.NOTSET)
    for handler in handlers:
        logger.addHandler(handler)
    if options.verbose and comm.rank == 0:
        sys.addaudithook(_tell_phase)
    try:
        yield
    except Exception as error:
        for handler in handlers[2:]:  # on stderr the process's own hook tells it
            handler.handle(logger.makeRecord(logger.name, logging.CRITICAL, "", 0, f"vipetsc: {error}", (), None))
        raise
    finally:
        for handler in handlers:
            logger.removeHandler(handler)
            handler.close()
        logger.propagate = True
        logger.setLevel(level)


def _writable(path: Path) -> None:
    try:
        path.open("a").close()
    except OSError as error:
        raise FolderError(f"--log {path}: {error.strerror}; name a file that can be written") from error


def _tell_phase(event: str, arguments: tuple[Any, ...]) -> None:
    """A hook for Python's audit events, which stays for good: what a verb begins, while somebody wants to know."""
    if event.startswith("vipetsc.") and event not in OFTEN and logger.isEnabledFor(logging.DEBUG):
        logger.debug("%s %s", event.removeprefix("vipetsc."), " ".join(map(str, arguments)))
