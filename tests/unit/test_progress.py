"""Progress in scripts and notebooks, without a log and a terminal."""

from __future__ import annotations

import logging
from collections.abc import Callable

from mpi4py import MPI

import pytest

from vipetsc import process
from vipetsc import progress as progress_module
from vipetsc.progress import Progress

pytestmark = pytest.mark.parallel(1)


@pytest.fixture
def written(monkeypatch, capsys) -> Callable[[], str]:
    """Make this a process without a log, as a script or a notebook, and return a function that yields its stderr."""
    monkeypatch.setattr(process.logger, "hasHandlers", lambda: False)
    monkeypatch.setattr(logging.getLogger("vipetsc"), "level", logging.NOTSET)
    monkeypatch.setattr(logging.getLogger(), "level", logging.WARNING)
    # Loggers cache levels.
    logging.getLogger("vipetsc").manager._clear_cache()
    return lambda: capsys.readouterr().err


def test_a_script_has_lines_and_an_end(written, monkeypatch):
    """Without a log, lines go to stderr every five seconds and at the end."""
    now = [0.0]
    monkeypatch.setattr(progress_module.time, "monotonic", lambda: now[0])
    progress = Progress(MPI.COMM_SELF, 20.0, "s")
    for second in range(1, 13):
        now[0] = float(second)
        progress.update(float(second))
    progress.close()

    lines = written().splitlines()
    assert lines == [" 25 %  5 of 20 s, 15 s left", " 50 %  10 of 20 s, 10 s left", " 60 %  12 of 20 s in 12.0 s"]


class Clock:
    """A clock in place of the machine's, which a test moves."""

    def __init__(self, monkeypatch) -> None:
        self.now = 100.0
        monkeypatch.setattr(progress_module.time, "monotonic", lambda: self.now)


def test_the_time_left_counts_from_the_first_report(written, monkeypatch):
    """A minute in which kernels are compiled does not count in the rate."""
    clock = Clock(monkeypatch)
    progress = Progress(MPI.COMM_SELF, 20.0, "s")
    clock.now += 60.0
    progress.update(1.0)
    clock.now += 8.0
    progress.update(5.0)
    progress.close()
    assert written().splitlines() == ["  5 %  1 of 20 s", " 25 %  5 of 20 s, 30 s left", " 25 %  5 of 20 s in 68.0 s"]
