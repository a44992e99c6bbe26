"""Messages: results on stdout, progress and warnings on stderr, all of them in a file if ``--log`` names one.

What a verb was asked to print is an "answer", as opposed to progress and warnings about it.
"""

import argparse
import errno
import logging
import os
import signal
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from vipetsc.io.lock import FolderError
from vipetsc.parallel import on_root
from vipetsc.progress import BAR
from vipetsc.wording import shortened

if TYPE_CHECKING:
    from mpi4py import MPI

logger = logging.getLogger("vipetsc")
answers = logging.getLogger("vipetsc.answers")
CUT_OFF = 128 + signal.SIGPIPE  # exit code that a shell reports for a program that wrote into a closed pipe
OFTEN = {"vipetsc.step", "vipetsc.landing", "vipetsc.read"}  # audit events too frequent for --verbose


class Output(logging.StreamHandler[TextIO]):
    """A handler that writes to a ``stream``, called ``title`` in messages, and keeps its first ``error`` in writing.

    What comes after an error is dropped: a closed pipe or a full disk must not cost a run that is saved elsewhere.
    """

    def __init__(self, stream: TextIO, title: str) -> None:
        super().__init__(stream)
        self.title = title
        self.error: OSError | None = None

    def emit(self, record: logging.LogRecord) -> None:
        """Write a message, unless an earlier one could not be written."""
        if self.error is None:
            super().emit(record)

    def handleError(self, record: logging.LogRecord) -> None:
        """Keep an error of the system; others are defects, and are reported as such."""
        error = sys.exc_info()[1]
        if isinstance(error, OSError):
            self.error = error
            discard(self.stream)
        else:
            super().handleError(record)


def discard(stream: TextIO) -> None:
    """Let what is written to ``stream`` go nowhere, also what is left in its buffer, which Python writes at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def code_of(title: str, error: OSError | None) -> int:
    """Return the exit code for an ``error`` in writing the stream ``title``, which is reported; 0 without an error."""
    if error is None:
        return 0
    # A reader that closes the pipe, as `head` does, needs no message.
    if error.errno == errno.EPIPE:
        return CUT_OFF
    logger.critical("vipetsc: %s: %s; some output was lost; the result files are complete", title, error.strerror)
    return 1


def echo(comm: "MPI.Comm", text: str, stream: TextIO | None = None) -> None:
    """Print ``text`` on rank 0, as an answer; with stderr as the ``stream`` as a warning."""
    if comm.rank != 0:
        return
    if stream is None:
        answers.info("%s", text)
    else:
        logger.warning("%s", text)


def echo_paths(comm: "MPI.Comm", paths: Iterable[Path]) -> None:
    """Print on rank 0 which files were written."""
    for path in paths:
        echo(comm, f"  {path}")


def echo_warnings(comm: "MPI.Comm", warnings: Iterable[str]) -> None:
    """Print warnings about a case or a result on rank 0."""
    for warning in warnings:
        echo(comm, f"vipetsc: warning: {warning}", sys.stderr)


@contextmanager
def reporting(comm: "MPI.Comm", options: argparse.Namespace, is_answer: bool) -> Iterator[list[Output]]:
    """Print messages within the block as ``options`` ask for (quiet, verbose, log).

    With ``is_answer``, answers are printed even with --quiet. The value of the block is the list of the outputs that
    must take all messages, for ``code_of``. All ranks must call it. Raises FolderError if the file of ``--log`` cannot
    be opened.
    """
    out = Output(sys.stdout, "stdout")
    out.addFilter(lambda record: record.name == answers.name and (is_answer or not options.quiet))
    err = Output(sys.stderr, "stderr")
    err.addFilter(lambda record: record.name != answers.name)
    err.setLevel(logging.WARNING if options.quiet else logging.DEBUG)
    logs: list[Output] = []
    if options.log:
        # All ranks must raise the error: otherwise they would wait for rank 0 in the first collective call.
        on_root(comm, lambda: logs.append(_open_log(options.log)))

    # Messages do not go on to the root logger: the handler that `__main__` gives it would print everything again.
    is_verbose = options.verbose and comm.rank == 0
    level = logger.level
    logger.propagate = False
    logger.setLevel(logging.DEBUG if is_verbose else logging.INFO)
    # Progress bars write to stderr themselves, and look at the level of a logger of their own.
    logging.getLogger(BAR).setLevel(logging.CRITICAL if options.quiet else logging.NOTSET)
    for handler in (out, err, *logs):
        logger.addHandler(handler)
    if is_verbose:
        sys.addaudithook(_report_phase)

    try:
        yield [out, *logs]
    except Exception as error:
        # The error goes into the file alone: on stderr the exception hook of the process reports it.
        for log in logs:
            log.handle(logger.makeRecord(logger.name, logging.CRITICAL, "", 0, f"vipetsc: {error}", (), None))
        raise
    finally:
        for handler in (out, err, *logs):
            logger.removeHandler(handler)
            handler.close()
        for log in logs:
            log.stream.close()
        logger.propagate = True
        logger.setLevel(level)


def _open_log(path: Path) -> Output:
    """Return the file of ``--log``, to whose end messages are added."""
    try:
        stream = path.open("a", encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise FolderError(f"--log {path}: {error.strerror}; name a file that can be written") from error
    log = Output(stream, f"--log {path}")
    log.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    return log


def _report_phase(event: str, arguments: tuple[Any, ...]) -> None:
    """Log the phase that a verb begins (a hook for audit events, which stays installed until the process ends)."""
    # Python removes no audit hook: after the block the level silences this one.
    if event.startswith("vipetsc.") and event not in OFTEN and logger.isEnabledFor(logging.DEBUG):
        logger.debug("%s %s", event.removeprefix("vipetsc."), " ".join(map(str, arguments)))


def table(rows: Sequence[tuple[str, str]]) -> str:
    """Return the ``rows`` (name, value) in two columns; a row with an empty value is left out."""
    width = max(len(name) for name, value in rows if value)
    return "\n".join(f"  {name:<{width}}  {value}" for name, value in rows if value)


def first_few(items: Sequence[object]) -> str:
    """Return the first ``items``, and how many there are if these are not all; "none" of an empty list."""
    return shortened(items) or "none"


def duration(seconds: float) -> str:
    """Return a time as text: seconds in two digits or, from two minutes on, minutes in three, without powers of ten."""
    # It is rounded first, since the format "g" alone writes 110 in two digits as 1.1e+02.
    if seconds < 120:
        return f"{float(f'{seconds:.2g}'):g} s"
    return f"{float(f'{seconds / 60:.3g}'):g} min"
