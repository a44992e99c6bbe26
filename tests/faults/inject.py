"""Call the program with a fault at one phase: ``python -m tests.faults.inject PHASE NUMBER RANK KIND -- ARGUMENTS``.

ARGUMENTS are the program's own. The fault comes at the NUMBER-th time (from 1) that world rank RANK reaches PHASE. KIND
is ``exception``, ``memory`` (MemoryError), ``full-disk`` (OSError), ``sigterm`` or ``sigkill``.
"""

from __future__ import annotations

import argparse
import errno
import os
import signal
import sys
import time
from collections import Counter
from pathlib import Path

from tests.faults.phases import PREFIX

KINDS = ("exception", "memory", "full-disk", "sigterm", "sigkill")


class InjectedError(Exception):
    """An exception that no part of the program expects."""


class Injector:
    """Counts the phases that this rank reaches, and causes a fault once, at the phase that it is armed for."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.armed: tuple[str, int, str] | None = None
        self.mark: Path | None = None
        sys.addaudithook(self._hook)

    def arm(self, phase: str, number: int, kind: str, mark: Path | None = None) -> None:
        """Cause a fault of ``kind`` when ``phase`` is reached for the ``number``-th time from now on.

        The time of the fault, in s since the epoch, is written to ``mark``.
        """
        self.counts.clear()
        self.armed = (phase, number, kind)
        self.mark = mark

    def disarm(self) -> Counter[str]:
        """Cause no fault; returns how often each phase has been reached since the last call of this or of ``arm``."""
        counts = self.counts
        self.counts = Counter()
        self.armed = None
        return counts

    def _hook(self, event: str, arguments: tuple) -> None:
        # Python itself raises audit events too.
        if not event.startswith(PREFIX):
            return

        phase = event.removeprefix(PREFIX)
        self.counts[phase] += 1
        if self.armed and self.armed[:2] == (phase, self.counts[phase]):
            kind = self.armed[2]
            # The injector is disarmed first, because the clean-up after the fault reaches phases too.
            self.armed = None
            if self.mark:
                self.mark.write_text(str(time.time()))
            strike(kind, phase)


def strike(kind: str, where: str) -> None:
    """Raise the exception of a ``kind`` of fault, or send this process the signal."""
    if kind == "exception":
        raise InjectedError(f"a fault at {where}")
    if kind == "memory":
        raise MemoryError(f"Unable to allocate 1.00 TiB at {where}")
    if kind == "full-disk":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), where)

    signals = {"sigterm": signal.SIGTERM, "sigkill": signal.SIGKILL}
    os.kill(os.getpid(), signals[kind])


def main() -> int:
    """Arm the injector on the chosen rank, then call the program; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.inject", description=__doc__)
    parser.add_argument("phase")
    parser.add_argument("number", type=int)
    parser.add_argument("rank", type=int)
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("arguments", nargs="*", help="after --: what vipetsc is called with")
    options = parser.parse_args()

    # MPI is not initialised yet: the rank comes from mpirun's environment variable.
    injector = Injector()
    if int(os.environ.get("OMPI_COMM_WORLD_RANK", "0")) == options.rank:
        injector.arm(options.phase, options.number, options.kind)

    from vipetsc.__main__ import main as vipetsc

    return vipetsc(options.arguments)


if __name__ == "__main__":
    sys.exit(main())
