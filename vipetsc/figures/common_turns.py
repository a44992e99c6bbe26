"""Numbers that processes take in turn, as each of them becomes free."""

import fcntl
import os
from collections.abc import Iterator


class CommonTurns(Iterator[int]):
    """The numbers 0, 1, 2, ..., of which each goes to one of the processes that have a file open.

    ``file`` is its descriptor. The file is empty at first, and then holds the next number, in 8 bytes.
    """

    def __init__(self, file: int) -> None:
        self._file = file

    def __next__(self) -> int:
        # ``lockf``, not ``flock``: a child process inherits the open file, and with it a lock by ``flock``. This one
        # belongs to the process, and ends with it.
        fcntl.lockf(self._file, fcntl.LOCK_EX)
        try:
            number = int.from_bytes(os.pread(self._file, 8, 0), "little")
            os.pwrite(self._file, (number + 1).to_bytes(8, "little"), 0)
        finally:
            fcntl.lockf(self._file, fcntl.LOCK_UN)
        return number
