"""Standard streams on which an error in writing is kept for the exit code, instead of ending a computation.

What cannot be written is dropped: a closed pipe or a full disk must not cost a run that is saved elsewhere.
"""

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
    """A text stream on a file ``descriptor``, called ``title`` in messages, that keeps its first ``error`` in writing.

    Writing never raises OSError; what comes after the first error is dropped. Characters that the ``encoding`` lacks
    are written as escapes.
    """

    def __init__(self, descriptor: int, title: str, encoding: str) -> None:
        self._raw = _CheckedFile(descriptor)
        self.title = title
        super().__init__(io.BufferedWriter(self._raw), encoding, errors="backslashreplace", line_buffering=True)

    @property
    def error(self) -> OSError | None:
        """The first error in writing; None without any."""
        return self._raw.error


class _CheckedFile(io.RawIOBase):
    """An unbuffered file that keeps its first error in writing, and drops what comes after it."""

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
        """Write a part of ``data``; returns its number of bytes, after an error that of all ``data``."""
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
    """Replace stdout and stderr by checked streams, unless a caller has put streams of its own there."""
    # If the caller has closed one of the numbers 0 to 2, the next file that is opened gets it, and messages would be
    # written into that file. /dev/null takes the number; opened for reading, it refuses what is written.
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
    """Report on stderr which of the ``streams`` lost output; returns an exit code, 0 if none did.

    For a closed pipe the code is that of a program that SIGPIPE has ended, and there is no message; else it is 1.
    """
    errors = {stream.title: stream.error for stream in streams if isinstance(stream, CheckedStream) and stream.error}
    # A reader that closes the pipe, as `head` does, needs no message.
    complaints = {title: error for title, error in errors.items() if error.errno != errno.EPIPE}
    for title, error in complaints.items():
        note = "some output was lost; the result files are complete"
        print(f"vipetsc: {title}: {error.strerror}; {note}", file=sys.stderr)
    if complaints:
        # Who closes both streams wants to hear nothing, and has the results.
        unheard = isinstance(sys.stderr, CheckedStream) and sys.stderr.error
        if unheard and {error.errno for error in (*complaints.values(), unheard)} == {errno.EBADF}:
            return 0
        return 1
    return CUT_OFF if errors else 0
