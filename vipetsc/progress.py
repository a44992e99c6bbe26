"""Progress of long work, reported on rank 0: a bar on a terminal or in a notebook, elsewhere lines."""

from __future__ import annotations

import logging
import sys
import time
from typing import TYPE_CHECKING, Any

from vipetsc.process import has_log, say

if TYPE_CHECKING:
    from mpi4py import MPI

BAR = "vipetsc.bar"  # the logger whose level switches bars off
LINE_EVERY = 5.0  # s between lines where there is no bar
LAYOUT = "{percentage:3.0f}%|{bar}| {n:.4g}/{total:.4g} {unit} [{elapsed}<{remaining}]"


class Progress:
    """Progress of a run, on rank 0: a bar on a terminal or in a notebook, otherwise a line every five seconds.

    Rates and times left count from the first report on, before which kernels are loaded or compiled. In a script
    without a log the end is a line, too, so that work of a few seconds says something.
    """

    def __init__(self, comm: MPI.Comm, total: float, unit: str, show: bool = True) -> None:
        self._total = total
        self._unit = unit
        # Monotonic: a clock that is set back would silence the lines.
        self._start = time.monotonic()
        self._last = self._start
        self._begin: float | None = None
        self._first = 0.0
        self._done = 0.0
        self._show = show and comm.rank == 0

        self._bar: Any = None
        has_bars = logging.getLogger(BAR).level < logging.CRITICAL
        if self._show and has_bars and (in_notebook() or sys.stderr.isatty()):
            # A notebook has bars of its own, if ipywidgets is there.
            from tqdm.auto import tqdm

            self._bar = tqdm(total=total, unit=unit, bar_format=LAYOUT, file=sys.stderr)

    def start_at(self, done: float) -> None:
        """Count from ``done``, where a resumed run begins."""
        self._first = done
        self._done = done
        if self._bar is not None:
            # Not by an update: the bar would take what an earlier run has done for work of this instant, predict too
            # short a time, and wait for another step of that size before it is drawn again.
            self._bar.initial = done
            self._bar.n = done
            self._bar.last_print_n = done
            self._bar.refresh()

    def update(self, done: float) -> None:
        """Report that ``done`` of the total is reached."""
        now = time.monotonic()
        self._done = done
        if self._begin is None:
            self._begin = now
            self._first = done
        if self._bar is not None:
            self._bar.update(done - self._bar.n)
        elif self._show and now - self._last >= LINE_EVERY:
            left = ""
            if done > self._first:
                left = f", {(self._total - done) * (now - self._begin) / (done - self._first):.0f} s left"
            say(f"{self._position()}{left}")
            self._last = now

    def close(self) -> None:
        """End the bar, or the lines of a script."""
        if self._bar is not None:
            self._bar.close()
        elif self._show and not has_log():
            say(f"{self._position()} in {time.monotonic() - self._start:.1f} s")

    def _position(self) -> str:
        """Return how much of the total is done."""
        percent = 100.0
        if self._total:
            percent = 100 * self._done / self._total
        return f"{percent:3.0f} %  {self._done:.4g} of {self._total:.4g} {self._unit}"


def in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook, whose stderr is no terminal."""
    return "ipykernel" in sys.modules
