"""Messages on stdout, on stderr and in the log: --quiet, --verbose, --log, the help of every verb, and progress."""

from __future__ import annotations

import logging
import os
import pty
import re
import shlex
import sys
import termios
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import pytest

import vipetsc as package
from vipetsc import progress as reports
from vipetsc.cli.main import _parser
from vipetsc.cli.verbs.verb_list import VERBS
from vipetsc.progress import BAR, Progress

ROOT = Path(package.__file__).parents[1]
TINY = ("--set", "lattice.cells=12", "--set", "contacts.sites=[4]", "--set", "drive.cycles=3",
        "--set", "time.end=0.02", "--set", "time.engine=propagator", "--set", "output.figures=false",
        "--set", "contacts.clearance=2e-4")  # fmt: skip
STAMP = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3}"


def test_every_verb_has_an_example_that_it_takes(in_process):
    """The example in each verb's help is understood by the parser, and its case file exists."""
    for verb in VERBS.values():
        # The shell, not the program, reads a redirection of the output.
        words = shlex.split(verb.example.partition(" > ")[0])
        options = _parser().parse_args(words)
        assert options.verb == verb.name
        if getattr(options, "case", None):
            assert (ROOT / options.case).exists(), verb.example

    shown = in_process("law", "--help")
    assert shown.returncode == 0
    assert "example: vipetsc law runs/examples/law.toml" in shown.stdout


def test_quiet_prints_warnings_alone(in_process, tmp_path):
    """With --quiet stderr has warnings and refusals only; stdout has the answer of a verb that is called for one."""
    ended = in_process("run", *TINY, "--out", tmp_path / "run", "--quiet")
    assert ended.returncode == 0
    assert (tmp_path / "run/run.h5").exists()
    assert ended.stdout == ""
    assert all(line.startswith("vipetsc: warning: ") for line in ended.stderr.splitlines())

    other = in_process("run", *TINY, "--out", tmp_path / "run", "--quiet", "--set", "drive.amplitude=3")
    assert other.returncode == 2
    assert "contains another run" in other.stderr

    assert "GB per rank" in in_process("validate", "--quiet").stdout


def test_the_log_holds_all_messages_with_their_times(in_process, tmp_path):
    """The log has results and warnings with their times, also with --quiet, and later calls add to it."""
    log = tmp_path / "run.log"
    first = in_process("run", *TINY, "--out", tmp_path / "run", "--log", log, "--quiet")
    assert first.returncode == 0, first.stderr
    text = log.read_text()
    assert re.search(rf"^{STAMP} INFO complete: 101 samples", text, flags=re.M)

    second = in_process("run", *TINY, "--out", tmp_path / "run", "--set", "drive.amplitude=3", "--log", log)
    assert second.returncode == 2
    # The second call has added to the log, which holds the history of a folder.
    assert log.read_text().startswith(text)
    assert re.search(rf"^{STAMP} WARNING vipetsc: .*contains another run", log.read_text(), flags=re.M)
    # A handler that stays would write messages of later calls in this process to the log.
    assert not logging.getLogger("vipetsc").handlers


def test_what_ends_a_verb_stands_in_its_log(in_process, tmp_path, monkeypatch):
    """An exception that ends a verb is in the log with the level CRITICAL."""

    def fail(*arguments: object) -> int:
        raise RuntimeError("the disk is on fire")

    monkeypatch.setitem(VERBS, "doctor", replace(VERBS["doctor"], function=fail))

    with pytest.raises(RuntimeError):
        in_process("doctor", "--log", tmp_path / "log")

    assert re.search(rf"^{STAMP} CRITICAL vipetsc: the disk is on fire", (tmp_path / "log").read_text(), flags=re.M)


def test_verbose_prints_phases_and_statistics(in_process, tmp_path):
    """--verbose prints the phases of one call and the integrator's statistics, and has no effect on the next call."""
    ended = in_process("run", *TINY, "--out", tmp_path / "run", "--verbose")
    for text in ("set-up four-band", "claim ", "analyse", 'statistics {"samples": 101'):
        assert re.search(rf"^{re.escape(text)}", ended.stderr, flags=re.M), text

    after = in_process("run", *TINY, "--out", tmp_path / "more")
    assert "set-up" not in after.stderr


@pytest.mark.parametrize(("quiet", "bar"), [(False, True), (True, False)])
def test_a_bar_on_a_terminal_unless_quiet(monkeypatch, quiet, bar):
    """On a terminal, progress is shown as a bar, but not with --quiet."""
    outer, inner = pty.openpty()
    # A new terminal has no width, and a bar on it would have no length.
    termios.tcsetwinsize(inner, (24, 80))

    with os.fdopen(inner, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        monkeypatch.setattr(logging.getLogger(BAR), "level", logging.CRITICAL if quiet else logging.NOTSET)
        progress = Progress(MPI.COMM_SELF, 1.0, "s")
        progress.update(0.5)
        progress.close()

        # A terminal has no end of file: it is read up to a mark.
        terminal.write("end")
        terminal.flush()
        shown = b""
        while not shown.endswith(b"end"):
            shown += os.read(outer, 10_000)
    os.close(outer)

    assert (b" 50%|" in shown) == bar


def test_lines_elsewhere_come_every_five_seconds(monkeypatch, caplog):
    """Where stderr is no terminal, progress is one line every five seconds of the clock."""
    now = [0.0]
    # The test sets the time of this clock.
    monkeypatch.setattr(reports.time, "monotonic", lambda: now[0])
    with caplog.at_level(logging.INFO, logger="vipetsc"):
        progress = Progress(MPI.COMM_SELF, 20.0, "s")
        for second in range(20):
            now[0] = float(second)
            progress.update(float(second))

    assert [record.getMessage().split("  ")[0].strip() for record in caplog.records] == ["25 %", "50 %", "75 %"]
