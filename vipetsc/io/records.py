"""Records of a long task: lines of JSON, appended one by one, each with a checksum.

A kill loses at most the line that is being written. A line with a wrong checksum counts as if it had not been written.
"""

import json
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

from vipetsc.io.atomic import atomic_write, unwritten

Record = dict[str, Any]
CHECK = b', "crc32": "%08x"}\n'  # the end of a line, with the CRC-32 of the record as JSON without this entry
CHECK_LENGTH = len(CHECK % 0)


class Line(NamedTuple):
    """Place of a record: the ``path`` of its file, its first byte there (``start``), and how many bytes it takes."""

    path: Path
    start: int
    length: int

    def record(self) -> Record:
        """Return the record, read from the file."""
        with self.path.open("rb") as file:
            file.seek(self.start)
            return _parsed(file.read(self.length))


def _parsed(line: bytes) -> Record:
    """Return the record in a ``line``, without its checksum."""
    return cast(Record, json.loads(line[:-CHECK_LENGTH] + b"}"))


class RecordFile:
    """Appends records to the file ``path``, which is created with the first one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: Any = None

    def append(self, record: Record) -> None:
        """Write ``record`` after the last one; raises OSError that names the file."""
        text = json.dumps(record).encode()
        # The line in one call of ``write``: a kill leaves it whole, absent or cut off.
        line = memoryview(text[:-1] + CHECK % zlib.crc32(text))
        try:
            sys.audit("vipetsc.append", str(self.path))
            if self._file is None:
                self._file = self.path.open("a+b", buffering=0)
                self._end_last_line()
            # A disk that is nearly full takes a part of the line; the call for the rest then raises the error.
            while line:
                line = line[self._file.write(line) :]
        except OSError as error:
            raise unwritten(self.path, error) from error

    def _end_last_line(self) -> None:
        """Begin a new line if the last one was cut off, which would spoil the record that is appended to it."""
        if not self._file.tell():
            return
        self._file.seek(-1, 2)
        if self._file.read(1) != b"\n":
            self._file.write(b"\n")

    def close(self) -> None:
        """Close the file until the next record."""
        if self._file is not None:
            self._file.close()
            self._file = None


def read_records(path: Path, damaged: Callable[[str], None]) -> Iterator[tuple[Record, Line]]:
    """Yield the records in ``path`` and their places in the file.

    For a line that is cut off or damaged ``damaged`` is called with a message, and the line is passed over. Raises
    OSError if the file cannot be read.
    """
    sys.audit("vipetsc.read", str(path))
    start = 0
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            if line.endswith(CHECK % zlib.crc32(line[:-CHECK_LENGTH] + b"}")):
                yield _parsed(line), Line(path=path, start=start, length=len(line))
            else:
                damaged(f"{path}, line {number}: truncated or damaged; its results are computed again")
            start += len(line)


def merge_records(path: Path, lines: Iterable[Line], merged: Iterable[Path]) -> None:
    """Write the records at ``lines`` to ``path`` in that order, whole or not at all; then remove the ``merged`` files.

    Raises OSError if a file cannot be read or written.
    """
    with atomic_write(path) as aside, aside.open("wb") as file, ExitStack() as stack:
        sources: dict[Path, BinaryIO] = {}
        for line in lines:
            if line.path not in sources:
                sources[line.path] = stack.enter_context(line.path.open("rb"))
            sources[line.path].seek(line.start)
            file.write(sources[line.path].read(line.length))

    # Removed last: a kill before that leaves records in two files, of which readers use one, and loses none.
    for old in merged:
        old.unlink(missing_ok=True)
