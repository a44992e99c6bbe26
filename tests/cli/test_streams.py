"""Output and logs that cannot be written: the exit code tells the failure, and results are complete nevertheless."""

from __future__ import annotations

import os
import subprocess
import sys

import h5py
import numpy as np
import pytest

from tests.conftest import clean_environment

TINY = ("run", "--set", "lattice.cells=12", "--set", "contacts.sites=[4]", "--set", "drive.cycles=3",
        "--set", "time.end=0.02", "--set", "time.engine=propagator", "--set", "output.figures=false",
        "--set", "contacts.clearance=2e-4", "--out", "out")  # fmt: skip


@pytest.fixture
def by_shell(tmp_path):
    """Call the program in a temporary folder, with its streams redirected by ``redirection``, as typed in a shell."""

    def call(words: tuple[str, ...], redirection: str) -> subprocess.CompletedProcess:
        command = [
            "bash",
            "-c",
            f'set -o pipefail; "$@" {redirection}',
            "bash",
            sys.executable,
            "-m",
            "vipetsc",
            *words,
        ]
        return subprocess.run(
            command, cwd=tmp_path, env=clean_environment(), capture_output=True, text=True, timeout=300, check=False
        )

    return call


@pytest.fixture
def with_stdout(in_process, monkeypatch, tmp_path):
    """Call the program in this process, in a temporary folder, with its stdout on a ``descriptor``, which is closed."""

    def call(words: tuple[str, ...], descriptor: int) -> subprocess.CompletedProcess:
        with open(descriptor, "w") as stream, monkeypatch.context() as context:
            context.setattr(sys, "stdout", stream)
            return in_process(*words, cwd=tmp_path)

    return call


def assert_full_device_is_reported(ended: subprocess.CompletedProcess, title: str) -> None:
    """The exit code is 1, and one sentence says that the device is full."""
    assert ended.returncode == 1, ended.stderr
    assert ended.stderr.count(f"vipetsc: {title}: No space left on device") == 1
    assert "Traceback" not in ended.stderr and "Logging error" not in ended.stderr


@pytest.mark.parametrize("answer", [TINY, ("schema",), ("manual", "case-file"), ("validate",)])
def test_an_answer_that_a_full_device_does_not_take_is_a_failure(with_stdout, answer, tmp_path):
    """A verb whose stdout is a full device ends with 1 and a sentence; a run keeps its results."""
    assert_full_device_is_reported(with_stdout(answer, os.open("/dev/full", os.O_WRONLY)), "stdout")
    assert (tmp_path / "out/run.h5").exists() == (answer is TINY)


def test_the_log_of_a_run_on_a_full_device_is_a_failure(in_process, tmp_path):
    """A run whose log is a full device prints its answer, says once that the log failed, and ends with 1."""
    ended = in_process(*TINY, "--log", "/dev/full", cwd=tmp_path)
    assert_full_device_is_reported(ended, "--log /dev/full")
    assert "complete: " in ended.stdout


def test_help_that_cannot_be_printed_is_a_failure(by_shell):
    """Help for a full device ends with 1 and a sentence; for a pipe without a reader it ends in silence."""
    assert_full_device_is_reported(by_shell(("law", "--help"), ">/dev/full"), "stdout")
    assert_reader_hears_nothing_more(by_shell(("law", "--help"), "| true"))


def test_closed_streams_are_no_failure(by_shell, tmp_path):
    """A run with closed streams ends with 0, and its results are whole: nothing was printed into a file of them."""
    ended = by_shell(TINY, "<&- >&- 2>&-")
    assert ended.returncode == 0
    with h5py.File(tmp_path / "out/run.h5") as file:
        assert np.isfinite(file["velocity"][...]).all()


def test_an_error_without_stderr_is_not_an_answer(by_shell):
    """Bad input ends with 2 also where its sentence cannot be printed; stdout stays empty."""
    for words in (("rnu",), ("run", "--nonsense")):
        ended = by_shell(words, "2>&-")
        assert (ended.returncode, ended.stdout) == (2, "")


def assert_reader_hears_nothing_more(ended: subprocess.CompletedProcess) -> None:
    """The exit code is 141 (128 + SIGPIPE), and nothing is said."""
    assert ended.returncode == 141
    for complaint in ("stdout", "Traceback", "Broken"):
        assert complaint not in ended.stderr


def test_a_reader_that_has_seen_enough_hears_nothing_more(by_shell):
    """A verb whose answer goes into a pipe without a reader ends with 141, without a message."""
    assert_reader_hears_nothing_more(by_shell(("schema",), "| true"))


def test_a_run_whose_reader_has_seen_enough_goes_on_in_silence(with_stdout, tmp_path):
    """A run whose answer goes into a pipe without a reader ends with 141, without a message, and keeps its results."""
    reading, writing = os.pipe()
    os.close(reading)
    assert_reader_hears_nothing_more(with_stdout(TINY, writing))
    assert (tmp_path / "out/run.h5").exists()
