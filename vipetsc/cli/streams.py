"""Text streams whose errors in writing decide the exit code, and drop what cannot be written until then."""

import errno
import io
import os
import select
import signal
import sys
from collections.abc import Iterable
from typing import Any

CUT_OFF = 128 + signal.SIGPIPE  # exit code that a shell reports for a program that wrote into a closed pipe


class CheckedStream(io.TextIOWrapper):
    """Text stream on a file ``descriptor``, called ``title`` in messages, that keeps its first ``error``.

    Writing raises nothing: what comes after the error is dropped, so that a computation goes on to its end. Characters
    that the encoding lacks are written as escapes.
    """

    def __init__(self, descriptor: int, title: str, encoding: str) -> None:
        self._raw = _CheckedFile(descriptor)
        self.title = title
        super().__init__(io.BufferedWriter(self._raw), encoding, errors="backslashreplace", line_buffering=True)

    @property
    def error(self) -> OSError | None:
        """The first error in writing."""
        return self._raw.error


class _CheckedFile(io.RawIOBase):
    """Unbuffered file that keeps its first error in writing, and drops what comes after it."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self.error: OSError | None = None

    def fileno(self) -> int:
        """The descriptor."""
        return self.descriptor

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        return os.isatty(self.descriptor)

    def writable(self) -> bool:
        """Always."""
        return True

    def close(self) -> None:
        """Close the descriptor, unless it is one of the standard streams, into which others write as well."""
        if not self.closed and self.descriptor > 2:
            try:
                os.close(self.descriptor)
            except OSError as error:
                self.error = self.error or error
        super().close()

    def write(self, data: Any) -> int:
        """Write part of ``data``; returns its length, that of all ``data`` where nothing can be written."""
        while self.error is None:
            try:
                return os.write(self.descriptor, data)
            except BlockingIOError:
                # The reader of a pipe has set it not to wait: wait here.
                select.select([], [self.descriptor], [])
            except OSError as error:
                self.error = error
        return len(data)


def check_standard_streams() -> None:
    """Replace stdout and stderr by checked streams, unless a caller put streams of its own there."""
    # A number that the caller has closed would be given to the next file that is opened, and messages written into it.
    # Reading from nowhere keeps the number, and writing to it remains an error.
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDONLY)

    if sys.stdout is sys.__stdout__:
        sys.stdout = CheckedStream(1, "stdout", getattr(sys.stdout, "encoding", "utf-8"))
    if sys.stderr is sys.__stderr__:
        sys.stderr = CheckedStream(2, "stderr", getattr(sys.stderr, "encoding", "utf-8"))


def report_unwritten(streams: Iterable[Any]) -> int:
    """Report on stderr which of the checked ``streams`` lost output; returns an exit code, 0 if none."""
    errors = {stream.title: stream.error for stream in streams if isinstance(stream, CheckedStream) and stream.error}
    # A reader that closes the pipe, as `head` does, needs no message.
    complaints = {title: error for title, error in errors.items() if error.errno != errno.EPIPE}
    for title, error in complaints.items():
        note = "some output was lost; the result files are complete"
        print(f"vipetsc: {title}: {error.strerror}; {note}", file=sys.stderr)
    if complaints:
        return 1
    return CUT_OFF if errors else 0
