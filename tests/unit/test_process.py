"""A process before MPI and at its end: the environment in which it starts MPI, requests to stop, garbage."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from vipetsc.process import ALONE, ONE_MACHINE, RANKS, quick_start

pytestmark = pytest.mark.parallel(1)

# Open MPI's variables with the number of all ranks and of the ranks on the machine.
SIZES = "OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_LOCAL_SIZE"


@pytest.fixture(autouse=True)
def alone(monkeypatch):
    """Remove the variables of launchers and of users, which may be set where the tests run."""
    for name in (*RANKS, *SIZES, *ALONE):
        monkeypatch.delenv(name, raising=False)


def test_a_process_alone_starts_mpi_without_daemon_and_network():
    """A process without a launcher has the settings ALONE while MPI starts."""
    with quick_start():
        assert os.environ.items() >= ALONE.items()


def test_processes_started_later_do_not_inherit_it():
    """The settings are removed after MPI's start, also after an error: ranks of an mpirun could not communicate."""
    with pytest.raises(RuntimeError), quick_start():
        raise RuntimeError
    assert not ALONE.keys() & os.environ.keys()


def test_what_a_user_has_set_stays(monkeypatch):
    """A setting of the user stays while MPI starts and afterwards."""
    name = "OMPI_MCA_pml"
    monkeypatch.setenv(name, "ucx")
    with quick_start():
        assert os.environ[name] == "ucx"
    assert os.environ[name] == "ucx"


@pytest.mark.parametrize("name", RANKS)
def test_a_rank_of_a_job_starts_mpi_as_its_launcher_says(name, monkeypatch):
    """A rank of a launcher has none of the settings ALONE."""
    monkeypatch.setenv(name, "0")
    with quick_start():
        assert not ALONE.keys() & os.environ.keys()


@pytest.mark.parametrize(("here", "expected"), [("4", {**ONE_MACHINE}), ("2", {})])
def test_ranks_look_for_a_network_unless_one_machine_has_them_all(here, expected, monkeypatch):
    """Ranks have settings for one machine if all ranks are on it, and none else; all ranks see the same numbers."""
    for name, value in zip((RANKS[0], *SIZES), ("1", "4", here), strict=True):
        monkeypatch.setenv(name, value)

    with quick_start():
        assert {name: os.environ[name] for name in ALONE if name in os.environ} == expected


# The process sends itself the signal; if the handler returned, the exit code would be 0.
REQUESTED = """
import os, signal
from vipetsc.process import end_on_request
end_on_request()
os.kill(os.getpid(), signal.{name})
"""


@pytest.mark.parametrize(
    ("launched", "said"), [({}, "vipetsc: stopped on request\n"), ({"OMPI_COMM_WORLD_RANK": "1"}, "")]
)
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_request_before_anything_has_begun_ends_the_process_with_code_75(name, launched, said):
    """A signal before any work ends the process with code 75, as a run that can be resumed; ranks print nothing."""
    # The tests may run under nohup, which ignores SIGHUP.
    not_ignored = f"import signal; signal.signal(signal.{name}, signal.SIG_DFL)"
    ended = subprocess.run(
        [sys.executable, "-c", not_ignored + REQUESTED.format(name=name)],
        env=os.environ | launched,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )

    assert ended.returncode == os.EX_TEMPFAIL == 75
    assert ended.stderr == said


def test_a_signal_that_nohup_has_set_aside_stays_so():
    """A process that ignores SIGHUP from its start, as under nohup, is not ended by it."""
    ignoring = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)"
    program = ignoring + REQUESTED.format(name="SIGHUP")
    ended = subprocess.run([sys.executable, "-c", program], check=False)
    assert ended.returncode == 0


# Objects in a circle are freed by a search for garbage only.
CIRCLE = """
from vipetsc.process import collect_seldom
class InCircle:
    def __del__(self):
        print("freed")
{seldom}
circle = InCircle()
circle.itself = circle
del circle
"""


@pytest.mark.parametrize(("seldom", "printed"), [("collect_seldom()", ""), ("", "freed\n")])
def test_a_process_that_collects_seldom_ends_without_a_search(seldom, printed):
    """At its end the process does not look for garbage, as Python does by itself."""
    program = CIRCLE.format(seldom=seldom)
    ended = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, check=True)
    assert ended.stdout == printed
