"""Numbers that processes take in turn, as each of them becomes free."""

import fcntl
import os
from collections.abc import Iterator


class CommonTurns(Iterator[int]):
    """The numbers 0, 1, 2, ..., each for one of the processes that have a ``file`` (a descriptor) open, empty at first.

    It holds the next number. It is locked by the process, whose end releases it, not by the open file, which the
    processes may have inherited.
    """

    def __init__(self, file: int) -> None:
        self._file = file

    def __next__(self) -> int:
        fcntl.lockf(self._file, fcntl.LOCK_EX)
        try:
            number = int.from_bytes(os.pread(self._file, 8, 0), "little")
            os.pwrite(self._file, (number + 1).to_bytes(8, "little"), 0)
        finally:
            fcntl.lockf(self._file, fcntl.LOCK_UN)
        return number
