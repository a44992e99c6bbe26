"""Numbers that processes take in turn, as each of them becomes free."""

import fcntl
import os
from collections.abc import Iterator

SIZE = 8  # bytes of a number in the file


class CommonTurns(Iterator[int]):
    """The numbers 0, 1, 2, ..., of which each goes to one of the processes that have a file open.

    ``file`` is its descriptor. The file is empty at first, and then holds the next number. One file can serve several
    such sequences, which ``place`` tells apart: 0, 1, ...
    """

    def __init__(self, file: int, place: int = 0) -> None:
        self._file = file
        self._offset = SIZE * place

    def __next__(self) -> int:
        # ``lockf``, not ``flock``: a child process inherits the open file, and with it a lock by ``flock``. This one
        # belongs to the process, and ends with it.
        fcntl.lockf(self._file, fcntl.LOCK_EX)
        try:
            number = int.from_bytes(os.pread(self._file, SIZE, self._offset), "little")
            os.pwrite(self._file, (number + 1).to_bytes(SIZE, "little"), self._offset)
        finally:
            fcntl.lockf(self._file, fcntl.LOCK_UN)
        return number
