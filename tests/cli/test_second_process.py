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
from vipetsc.figures.second_process import Drawn, DrawRequest, SecondProcess

pytestmark = pytest.mark.parallel(1)
PATIENCE = 60  # s to wait for processes, which take 3 s on an idle machine
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
    """A second process that has failed: it draws nothing, and keeps the options of each request.

    ``waits`` are the numbers of requests that had been made when the caller waited for them.
    """

    def __init__(self, draws_alone: bool = True) -> None:
        self.draws_alone = draws_alone
        self.requests = []
        self.asked = []
        self.waits = []

    def ask(self, source, folders, **options):
        self.asked.append(options)
        self.requests.append(DrawRequest({"source": source, "folders": folders} | options, iter(())))

    def drawn(self):
        self.requests.clear()
        self.waits.append(len(self.asked))


class Immediate(Recorded):
    """A second process that has drawn all that it is asked for as soon as it is asked."""

    def __init__(self) -> None:
        super().__init__()
        self.files = []

    def ask(self, source, folders, **options):
        super().ask(source, folders, **options)
        self.files += draw(source, folders, **options)

    def drawn(self):
        super().drawn()
        return Drawn(self.files, {})


@pytest.mark.slow
def test_two_processes_draw_what_one_draws(run, tmp_path, caplog):
    """Two processes together draw the same pictures, byte by byte, as one process alone, and print the same."""
    alone = shutil.copytree(run, tmp_path / "alone", ignore=shutil.ignore_patterns("figures"))
    with caplog.at_level("INFO", "vipetsc"):
        expected = draw_pictures(PICTURES, [alone], MPI.COMM_SELF)
    printed = caplog.messages
    assert "no picture of" in printed[0]

    for draws_alone in (True, False):
        caplog.clear()
        folder = tmp_path / f"run-{draws_alone}"
        shutil.copytree(run, folder, ignore=shutil.ignore_patterns("figures", "analysis.h5"))
        with SecondProcess(draws_alone) as second:
            draw_unmeasured(PICTURES, folder, second)
            with caplog.at_level("INFO", "vipetsc"):
                drawn = draw_pictures(PICTURES, [folder], MPI.COMM_SELF, afresh=False, helper=second)
            # Of each request every picture was given to one process, and every process found once that none was left.
            processes = len(second._channels) + (not draws_alone)
            unmeasured = WITHOUT_MEASURES & pictures_in(folder).keys()
            measured = pictures_in(folder).keys() - WITHOUT_MEASURES
            assert next(CommonTurns(second._file, place=0)) == len(unmeasured) + processes
            assert next(CommonTurns(second._file, place=1)) == len(measured) + processes

            # A request that fails does not end the second process.
            second.ask("run", [folder], names=["no figure"])
            assert second.drawn() is None
            second.ask("run", [folder], names=["unit_cell"])
            assert second.drawn().files == [folder / "figures" / "unit_cell.png"]

        assert [path.name for path in drawn] == [path.name for path in expected]
        assert pictures_in(folder) == pictures_in(alone)
        assert caplog.messages == printed


@pytest.mark.parametrize("draws_alone", [True, False])
def test_pictures_that_the_second_process_did_not_draw_are_drawn_here(draws_alone, thinned, tmp_path):
    """If the second process has failed, this process draws all pictures."""
    folder = shutil.copytree(thinned, tmp_path / "run")
    drawn = draw_pictures(PICTURES, [folder], MPI.COMM_SELF, helper=Recorded(draws_alone))
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
    ahead, rest = second.asked
    assert {f"{figure}.png" for figure in ahead["names"]} == WITHOUT_MEASURES
    if name == "run":
        assert rest["omit"] == ahead["names"]
        assert second.waits == [2]
    else:
        # The second drawing of a picture must not be replaced by a first one that ends later.
        assert rest["omit"] == ()
        assert second.waits == [1, 2]


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
    assert not second.asked


def children_of(process: int) -> list[int]:
    """The processes that a process has started and that have not ended."""
    return [int(child) for child in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def test_a_second_process_that_was_killed_has_drawn_nothing(run):
    """A second process that was killed, or whose copy was, returns no pictures, without an error."""
    with SecondProcess(draws_alone=True) as second:
        second.ask("run", [run], names=[])
        assert second.drawn() == ([], {})

        # The system kills a process where memory is short.
        (copy,) = children_of(second._process.pid)
        os.kill(copy, signal.SIGKILL)
        second.ask("run", [run], names=[])
        assert second.drawn() is None

        second._process.kill()
        second._process.wait()
        second.ask("run", [run], names=[])
        assert second.drawn() is None


# A second process whose pictures take longer than a test waits.
SLOW = f"""
import sys, time
from pathlib import Path
from vipetsc.figures import second_process

DRAW = "import os, time; from vipetsc.figures import registry;"
DRAW += "registry.draw = lambda *arguments, **options: print(os.getpid(), flush=True) or time.sleep({2 * PATIENCE});"
second_process.SERVE = DRAW + second_process.SERVE
with second_process.SecondProcess(draws_alone=True) as second:
    second.ask("run", [Path("none")])
    {{}}
"""


@pytest.mark.parametrize("signal_number", [signal.SIGKILL, None])
def test_all_copies_of_the_second_process_end_with_the_one_that_asks(signal_number):
    """The second process and its copy end in the middle of a picture when the first process is killed, or goes on.

    Both have the pipes of the first one open: these end only when all processes have ended.
    """
    drawing_copies = 2
    wait = "second.drawn()"
    if signal_number is None:
        # Only the second process itself draws while the first one computes.
        drawing_copies = 1
        wait = "sys.stdin.readline()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", SLOW.format(wait)], text=True, **pipes) as first:
        copies = {first.stdout.readline() for _ in range(drawing_copies)}
        assert len(copies) == drawing_copies
        if signal_number:
            first.send_signal(signal_number)
            expected = -signal_number
        else:
            expected = 0
        output, errors = first.communicate("\n", timeout=PATIENCE)
    assert first.returncode == expected
    assert not output
    assert not errors


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


def test_no_process_is_left_that_has_loaded_nothing_yet():
    """A second process ends, without a message, if the first one is killed while it loads its tools."""
    program = (
        "import os, signal\n"
        "from vipetsc.figures.second_process import SecondProcess\n"
        "second = SecondProcess(draws_alone=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=PATIENCE)
    assert ended.returncode == -signal.SIGKILL
    assert not ended.stderr


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


def test_a_file_has_several_sequences_of_turns(turns):
    """Turns of one sequence leave those of another as they are."""
    taken = [next(CommonTurns(turns, place)) for place in (0, 1, 1, 0, 1)]
    assert taken == [0, 0, 1, 1, 2]


def test_a_turn_is_not_taken_while_another_process_takes_one(turns):
    """A process waits for the lock of the file, and takes the number that the owner of the lock has left in it."""
    with taker(turns, 1) as other:
        fcntl.lockf(turns, fcntl.LOCK_EX)
        assert other.stdout.readline() == "begun\n"
        time.sleep(0.1)
        os.pwrite(turns, (7).to_bytes(8, "little"), 0)
        fcntl.lockf(turns, fcntl.LOCK_UN)
        assert other.stdout.readline() == "7\n"
