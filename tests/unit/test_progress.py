"""Progress in scripts and notebooks: what is written where there is no log and no terminal."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable

from mpi4py import MPI

import pytest

from vipetsc import progress as reports
from vipetsc.progress import Progress, say

pytestmark = pytest.mark.parallel(1)


@pytest.fixture
def written(monkeypatch, capsys) -> Callable[[], str]:
    """Make this a process that has set up no log, as a script or a notebook; returns what it writes to stderr."""
    monkeypatch.setattr(reports.logger, "hasHandlers", lambda: False)
    monkeypatch.setattr(logging.getLogger("vipetsc"), "level", logging.NOTSET)
    monkeypatch.setattr(logging.getLogger(), "level", logging.WARNING)
    # Loggers remember the levels that they have asked for.
    logging.getLogger("vipetsc").manager._clear_cache()
    return lambda: capsys.readouterr().err


def test_a_script_has_lines_and_an_end(written, monkeypatch):
    """Without a log the lines go to stderr every five seconds, and the end is one."""
    now = [0.0]
    monkeypatch.setattr(reports.time, "monotonic", lambda: now[0])
    progress = Progress(MPI.COMM_SELF, 20.0, "s")
    for second in range(1, 13):
        now[0] = float(second)
        progress.update(float(second))
    progress.close()

    lines = written().splitlines()
    assert lines == [" 25 %  5 of 20 s, 15 s left", " 50 %  10 of 20 s, 10 s left", " 60 %  12 of 20 s in 12.0 s"]


def test_nothing_is_written_that_was_not_asked_for(written):
    """Progress that is not shown writes nothing, and a level above WARNING silences every line."""
    quiet = Progress(MPI.COMM_SELF, 1.0, "s", show=False)
    quiet.update(1.0)
    quiet.close()
    assert written() == ""

    logger = logging.getLogger("vipetsc")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        say("a line")
    finally:
        logger.setLevel(level)
    assert written() == ""


def test_a_notebook_has_a_bar(written, monkeypatch):
    """The kernel of a notebook, whose stderr is no terminal, gets a bar from tqdm.auto."""
    monkeypatch.setitem(sys.modules, "ipykernel", object())
    progress = Progress(MPI.COMM_SELF, 2.0, "runs")
    progress.update(1.0)
    progress.close()
    assert " 50%|" in written()
