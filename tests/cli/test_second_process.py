"""Pictures by a second process: the files are the same, also if it fails, and it ends with the process that asks."""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from mpi4py import MPI

import pytest

from tests.conftest import small_case
from vipetsc.cli.drawing import draw_pictures, draw_unmeasured
from vipetsc.cli.verbs.run_verb import PICTURES
from vipetsc.dynamics import simulate
from vipetsc.figures.common_turns import CommonTurns
from vipetsc.figures.registry import draw
from vipetsc.figures.second_process import SecondProcess

pytestmark = pytest.mark.parallel(1)
# These pictures are drawn from run.h5 alone: they need not wait for the measures.
WITHOUT_MEASURES = {"phase.png", "unit_cell.png", "impacts.png", "ledger.png"}


def run_in(folder: Path, stride: int) -> Path:
    """Write a run without contacts, with the fields of every ``stride``-th sample, into ``folder``, and return it."""
    output = {"fields": ["velocity"], "stride": stride}
    case = small_case(contacts={"sites": []}, time={"engine": "propagator", "end": 0.03}, output=output)
    simulate(case, folder, MPI.COMM_SELF)
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """The folder of a run that is not measured."""
    return run_in(tmp_path_factory.mktemp("whole") / "run", stride=1)


@pytest.fixture(scope="module")
def thinned(tmp_path_factory) -> Path:
    """The folder of a run whose measures will warn that its samples do not resolve the highest band."""
    return run_in(tmp_path_factory.mktemp("thinned") / "run", stride=20)


def pictures_in(folder: Path) -> dict[str, bytes]:
    """The bytes of each picture of a run, by its name."""
    return {path.name: path.read_bytes() for path in (folder / "figures").iterdir()}


class Recorded:
    """A second process that has failed: it draws nothing, and keeps the options of each request."""

    is_asked = False

    def __init__(self) -> None:
        self.turns = iter(())
        self.requests = []

    def ask(self, source, folders, divided=False, **options):
        self.requests.append(options)
        self.is_asked = True

    def drawn(self):
        return None


class Immediate(Recorded):
    """A second process that has drawn all that it is asked for as soon as it is asked."""

    def __init__(self) -> None:
        super().__init__()
        self.files = []

    def ask(self, source, folders, divided=False, **options):
        super().ask(source, folders, divided, **options)
        self.files += draw(source, folders, **options)

    def drawn(self):
        return self.files


@pytest.mark.slow
def test_two_processes_draw_what_one_draws(run, tmp_path):
    """Two processes together draw the same pictures, byte by byte, as one process alone."""
    alone = shutil.copytree(run, tmp_path / "alone")
    expected = draw_pictures(PICTURES, [alone], MPI.COMM_SELF)

    with SecondProcess() as second:
        draw_unmeasured(PICTURES, run, second)
        drawn = draw_pictures(PICTURES, [run], MPI.COMM_SELF, afresh=False, helper=second)
        # The two processes took a turn for each of two pictures, and each took one more to find that none was left.
        assert next(second.turns) == 2 + 2

        # A request that fails does not end the second process.
        second.ask("run", [run], names=["no figure"])
        assert second.drawn() is None
        second.ask("run", [run], names=["unit_cell"])
        assert second.drawn() == [run / "figures" / "unit_cell.png"]

    assert [path.name for path in drawn] == [path.name for path in expected]
    assert pictures_in(run) == pictures_in(alone)


def test_pictures_that_the_second_process_did_not_draw_are_drawn_here(thinned):
    """If the second process has failed, this process draws all pictures."""
    second = Recorded()
    drawn = draw_pictures(PICTURES, [thinned], MPI.COMM_SELF, helper=second)
    assert {path.name for path in drawn} == {"spacetime.png", "unit_cell.png", "ledger.png"}
    assert all(path.stat().st_size for path in drawn)


@pytest.mark.parametrize("name", ["run", "thinned"])
def test_pictures_without_the_warnings_of_the_measures_are_drawn_again(name, request, monkeypatch, tmp_path):
    """A picture that was drawn before the run was measured stays only if the measures bring no warning."""
    folder = shutil.copytree(request.getfixturevalue(name), tmp_path / "run")
    (folder / "analysis.h5").unlink(missing_ok=True)
    monkeypatch.setattr("vipetsc.figures.registry.draw", lambda *arguments, **options: [])
    second = Recorded()
    draw_unmeasured(PICTURES, folder, second)
    draw_pictures(PICTURES, [folder], MPI.COMM_SELF, helper=second)
    ahead, rest = second.requests
    assert {f"{figure}.png" for figure in ahead["names"]} == WITHOUT_MEASURES
    assert rest["omit"] == (ahead["names"] if name == "run" else ())


def test_pictures_that_were_drawn_ahead_are_not_drawn_by_a_later_call(tmp_path):
    """A later call draws nothing, though pictures of the first call are older than the measures."""
    folder = run_in(tmp_path / "run", stride=1)
    ahead = Immediate()
    draw_unmeasured(PICTURES, folder, ahead)
    assert draw_pictures(PICTURES, [folder], MPI.COMM_SELF, afresh=False, helper=ahead)

    assert draw_pictures(PICTURES, [folder], MPI.COMM_SELF, afresh=False) == []


def test_earlier_measures_keep_pictures_from_being_drawn_ahead(tmp_path):
    """Nothing is drawn before the measures if a run has earlier measures."""
    (tmp_path / "analysis.h5").touch()
    second = Recorded()
    draw_unmeasured(PICTURES, tmp_path, second)
    assert not second.requests


def test_a_second_process_that_was_killed_has_drawn_nothing(tmp_path):
    """A request to a second process that was killed returns no pictures, without an error."""
    with SecondProcess() as second:
        # The system kills a process where memory is short.
        second._process.kill()
        second._process.wait()
        second.ask("run", [tmp_path])
        assert second.drawn() is None


def test_the_second_process_ends_with_the_one_that_asks():
    """The second process ends when the first one is killed.

    Both processes hold the pipe of stderr open: the call returns only after the second one has ended too.
    """
    program = (
        "import os, signal\n"
        "from vipetsc.figures.second_process import SecondProcess\n"
        "second = SecondProcess()\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=300)
    assert ended.returncode == -signal.SIGKILL
    assert not ended.stderr


@pytest.mark.parametrize(("cores", "load", "useful"), [(2, 1.4, True), (1, 0.0, False), (2, 8.0, False)])
def test_a_second_process_needs_an_idle_core(cores, load, useful, monkeypatch):
    """A second process is useful on Linux with more than one core and a load that leaves one of them idle."""
    monkeypatch.delitem(sys.modules, "matplotlib", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {*range(cores)})
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(os, "getloadavg", lambda: (load, load, load))
    assert SecondProcess.is_useful() == useful
    monkeypatch.setattr(sys, "platform", "darwin")
    assert not SecondProcess.is_useful()


@pytest.fixture
def turns() -> Iterator[int]:
    """The descriptor of a file from which processes take turns: numbers 0, 1, 2, ..., each once."""
    file = os.memfd_create("turns")
    yield file
    os.close(file)


def taker(file: int, count: int) -> subprocess.Popen:
    """Start a process that prints "begun", takes ``count`` turns, and prints their numbers."""
    program = (
        "import sys; from itertools import islice\n"
        "from vipetsc.figures.common_turns import CommonTurns\n"
        "print('begun', flush=True)\n"
        f"print(*islice(CommonTurns({file}), {count}))\n"
    )
    return subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, pass_fds=(file,))


def test_two_processes_take_each_turn_once(turns):
    """Two processes that take 2000 turns each have together taken every number below 4000 once."""
    with taker(turns, 2000) as first, taker(turns, 2000) as second:
        taken = [process.communicate()[0].split()[1:] for process in (first, second)]
    assert sorted(map(int, taken[0] + taken[1])) == list(range(4000))
    assert next(CommonTurns(turns)) == 4000


def test_a_turn_is_not_taken_while_another_process_takes_one(turns):
    """A process waits for the lock of the file, and takes the number that the owner of the lock has left in it."""
    with taker(turns, 1) as other:
        fcntl.lockf(turns, fcntl.LOCK_EX)
        assert other.stdout.readline() == "begun\n"
        time.sleep(0.1)
        os.pwrite(turns, (7).to_bytes(8, "little"), 0)
        fcntl.lockf(turns, fcntl.LOCK_UN)
        assert other.stdout.readline() == "7\n"
