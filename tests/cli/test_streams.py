"""Output and logs that cannot be written: the exit code tells the failure, and results are complete nevertheless."""

from __future__ import annotations

import array
import fcntl
import os
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest

from tests.conftest import clean_environment
from vipetsc.cli.streams import CheckedStream

pytestmark = pytest.mark.slow

TINY = ("run", "--set", "lattice.cells=12", "--set", "contacts.sites=[4]", "--set", "drive.cycles=3",
        "--set", "time.end=0.02", "--set", "time.engine=propagator", "--set", "output.figures=false",
        "--set", "contacts.clearance=2e-4", "--out", "out")  # fmt: skip
CAPACITY_OF_A_PIPE = 65536  # bytes
BEADS = Path(__file__).parents[2] / "runs/examples/beads.toml"
ANSWERS = {
    "schema": ("schema",),
    "manual": ("manual", "case-file"),
    "validate": ("validate",),
    # Beads have no band and therefore no picture, which would take long.
    "bands": ("bands", str(BEADS), "--json", "--out", "bands"),
    "help": ("law", "--help"),
    "run": TINY,
}


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
    """Call the program in this process, in a temporary folder, with its stdout on a ``descriptor``, which is closed.

    The stream is the one that the program puts in the place of Python's own. By ``by_shell`` each kind of redirection
    is tested once in a real process, with its beginning and end.
    """

    def call(words: tuple[str, ...], descriptor: int) -> subprocess.CompletedProcess:
        with CheckedStream(descriptor, "stdout", "utf-8") as stream, monkeypatch.context() as context:
            context.setattr(sys, "stdout", stream)
            return in_process(*words, cwd=tmp_path)

    return call


def assert_full_device_is_reported(ended: subprocess.CompletedProcess) -> None:
    """The exit code is 1, and a sentence says that the device is full."""
    assert ended.returncode == 1, ended.stderr
    assert "vipetsc: stdout: No space left on device" in ended.stderr
    assert "Traceback" not in ended.stderr and "Logging error" not in ended.stderr


def test_a_run_whose_answer_a_full_device_does_not_take_is_a_failure(by_shell, tmp_path):
    """A run whose stdout is a full device ends with 1 and a sentence, and keeps its results."""
    assert_full_device_is_reported(by_shell(TINY, ">/dev/full"))
    assert (tmp_path / "out/run.h5").exists()


@pytest.mark.parametrize("answer", [answer for answer in ANSWERS if answer != "run"])
def test_an_answer_that_a_full_device_does_not_take_is_a_failure(with_stdout, answer):
    """A verb whose stdout is a full device ends with 1 and a sentence."""
    assert_full_device_is_reported(with_stdout(ANSWERS[answer], os.open("/dev/full", os.O_WRONLY)))


def assert_closed_stdout_is_reported(ended: subprocess.CompletedProcess) -> None:
    """The exit code is 1, a sentence says that stdout is closed, and the answer does not go to stderr instead."""
    assert ended.returncode == 1, ended.stderr
    assert "vipetsc: stdout: Bad file descriptor" in ended.stderr
    assert "properties" not in ended.stderr and "complete: " not in ended.stderr


def test_an_answer_to_a_closed_stdout_is_a_failure(by_shell):
    """A verb whose stdout is closed ends with 1 and a sentence."""
    assert_closed_stdout_is_reported(by_shell(ANSWERS["schema"], ">&-"))


def test_a_run_whose_answer_goes_to_a_closed_stdout_is_a_failure(with_stdout, tmp_path):
    """A run whose stdout is closed ends with 1 and a sentence, and keeps its results."""
    # At its beginning the program opens a file that cannot be written in the place of a closed stream.
    assert_closed_stdout_is_reported(with_stdout(TINY, os.open(os.devnull, os.O_RDONLY)))
    assert (tmp_path / "out/run.h5").exists()


def test_no_file_takes_the_number_of_a_closed_stream(tmp_path):
    """If stdout is closed, a new file does not get its descriptor: libraries would print into that file."""
    script = "import os; from vipetsc.cli.streams import check_standard_streams as check; check(); "
    script += "os.write(os.open('file', os.O_WRONLY | os.O_CREAT), b'content'); os.write(1, b'message')"
    command = ["bash", "-c", '"$@" >&-', "bash", sys.executable, "-c", script]
    ended = subprocess.run(
        command, cwd=tmp_path, env=clean_environment(), capture_output=True, text=True, timeout=300, check=False
    )
    assert (tmp_path / "file").read_text() == "content"
    assert "Bad file descriptor" in ended.stderr


@pytest.mark.parametrize("options", [["--quiet"], []])
def test_closed_streams_are_no_failure(by_shell, tmp_path, options):
    """A run with closed streams ends with 0 and leaves its results, with --quiet or without."""
    ended = by_shell((*TINY, *options), "<&- >&- 2>&-")
    assert ended.returncode == 0
    assert (tmp_path / "out/run.h5").exists()


def assert_reader_hears_nothing_more(ended: subprocess.CompletedProcess) -> None:
    """The exit code is 141 (128 + SIGPIPE), and nothing is said."""
    assert ended.returncode == 141
    for complaint in ("stdout", "Traceback", "Broken"):
        assert complaint not in ended.stderr


def test_a_reader_that_has_seen_enough_hears_nothing_more(by_shell):
    """A verb whose answer goes into a pipe without a reader ends with 141, without a message."""
    assert_reader_hears_nothing_more(by_shell(ANSWERS["schema"], "| true"))


def test_a_run_whose_reader_has_seen_enough_goes_on_in_silence(with_stdout, tmp_path):
    """A run whose answer goes into a pipe without a reader ends with 141, without a message, and keeps its results."""
    reading, writing = os.pipe()
    os.close(reading)
    assert_reader_hears_nothing_more(with_stdout(TINY, writing))
    assert (tmp_path / "out/run.h5").exists()


def assert_lost_log_is_reported(ended: subprocess.CompletedProcess) -> None:
    """The exit code is 1, and one sentence says that the log's device is full."""
    assert ended.returncode == 1, ended.stderr
    assert ended.stderr.count("vipetsc: --log /dev/full: No space left on device") == 1
    assert "Traceback" not in ended.stderr


def test_a_log_on_a_full_device_is_a_failure(by_shell, tmp_path):
    """A verb whose log is a full device prints its answer, says once that the log failed, and ends with 1."""
    assert_lost_log_is_reported(by_shell(("schema", "--log", "/dev/full"), ">printed"))
    assert (tmp_path / "printed").stat().st_size > 100


def test_the_log_of_a_run_on_a_full_device_is_a_failure(in_process, tmp_path):
    """A run whose log is a full device prints its answer, says once that the log failed, and ends with 1."""
    ended = in_process(*TINY, "--log", "/dev/full", cwd=tmp_path)
    assert_lost_log_is_reported(ended)
    assert len(ended.stdout) > 100


def test_a_reader_that_is_slow_gets_all(tmp_path):
    """A slow reader gets the whole answer, also from a non-blocking pipe: another user of a pipe may have set that."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    command = [sys.executable, "-m", "vipetsc", "schema"]
    with subprocess.Popen(command, stdout=writing, cwd=tmp_path, env=clean_environment()) as process:
        os.close(writing)
        held = array.array("i", [0])
        while process.poll() is None and held[0] < CAPACITY_OF_A_PIPE:
            time.sleep(0.05)
            fcntl.ioctl(reading, termios.FIONREAD, held)
        # The program has time for a second attempt to write into the full pipe.
        time.sleep(0.5)
        with os.fdopen(reading, "rb") as pipe:
            whole = pipe.read()
    assert process.returncode == 0
    assert len(whole) > CAPACITY_OF_A_PIPE
    assert whole.rstrip().endswith(b"}")


@pytest.mark.mpirun
def test_all_ranks_end_with_the_code_of_the_first(tmp_path):
    """All ranks end with 1 if the answer, which rank 0 writes, cannot be written; the message is printed once."""
    # mpirun ends all ranks as soon as one has another code than 0: each rank records its code in a file first.
    of_rank = f"{sys.executable} -m vipetsc manual >/dev/full; echo $? >{tmp_path}/code-$OMPI_COMM_WORLD_RANK"
    command = ["mpirun", "--oversubscribe", "-n", "2", "bash", "-c", of_rank]
    ended = subprocess.run(command, capture_output=True, text=True, env=clean_environment(), timeout=300, check=False)
    assert ended.stderr.count("vipetsc: stdout: No space left on device") == 1
    assert [(tmp_path / f"code-{rank}").read_text() for rank in range(2)] == ["1\n", "1\n"]
