"""Failing calls of the file system, by the library ``failing_calls.c``: see there."""

from __future__ import annotations

import ctypes
import errno
import subprocess
from pathlib import Path

# Errors of the system, and the end of the process at the call.
KINDS = ("EIO", "ENOSPC", "EACCES", "EMFILE", "ESTALE", "sigkill")


def build(folder: Path) -> Path:
    """Compile the library into ``folder``; return its path, for LD_PRELOAD."""
    library = folder / "failing_calls.so"
    source = Path(__file__).with_suffix(".c")
    subprocess.run(["cc", "-O1", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    return library


class FailingCalls:
    """The library in this process; without it nothing is counted, and nothing fails."""

    def __init__(self) -> None:
        process = ctypes.CDLL(None)
        self._is_loaded = hasattr(process, "fail_at")
        if self._is_loaded:
            self._fail_at = process.fail_at
            self._fail_at.argtypes = [ctypes.c_long, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p]
            self._counted = process.calls_counted
            self._counted.restype = ctypes.c_long

    def arm(self, number: int, kind: str, folder: Path, mark: Path | None = None) -> None:
        """Let call ``number`` (from 1; 0 for none) that changes files in ``folder`` fail; ``mark`` gets the time."""
        if self._is_loaded:
            self._fail_at(number, getattr(errno, kind, 0), bytes(folder), str(mark or "").encode())

    def disarm(self) -> int:
        """Let no call fail; returns the number of calls since ``arm``."""
        if not self._is_loaded:
            return 0
        count = int(self._counted())
        self._fail_at(0, 0, b"", b"")
        return count
