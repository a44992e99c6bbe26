"""The environment in which MPI is started by a process alone."""

from __future__ import annotations

import os

import pytest

from vipetsc.process import ALONE, RANKS, quick_start_alone

pytestmark = pytest.mark.parallel(1)


@pytest.fixture(autouse=True)
def alone(monkeypatch):
    """No launcher and no setting of the user, whatever has started the tests."""
    for name in (*RANKS, *ALONE):
        monkeypatch.delenv(name, raising=False)


def test_a_process_alone_starts_mpi_without_daemon_and_network():
    with quick_start_alone():
        assert os.environ.items() >= ALONE.items()


def test_processes_started_later_do_not_inherit_it():
    """With these settings an mpirun's ranks could not reach one another."""
    with pytest.raises(RuntimeError), quick_start_alone():
        raise RuntimeError
    assert not ALONE.keys() & os.environ.keys()


def test_what_a_user_has_set_stays(monkeypatch):
    name = "OMPI_MCA_pml"
    monkeypatch.setenv(name, "ucx")
    with quick_start_alone():
        assert os.environ[name] == "ucx"
    assert os.environ[name] == "ucx"


@pytest.mark.parametrize("name", RANKS)
def test_a_rank_of_a_job_starts_mpi_as_its_launcher_says(name, monkeypatch):
    monkeypatch.setenv(name, "0")
    with quick_start_alone():
        assert not ALONE.keys() & os.environ.keys()
