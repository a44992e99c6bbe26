"""Scripts in which one rank or all ranks raise an error: all ranks end, and the message is printed once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import clean_environment

FAILS_ON_RANK_0_FOR_ALL = """
from mpi4py import MPI
from vipetsc.parallel import install_abort_hook, on_root
install_abort_hook()

def write():
    raise PermissionError(13, "no right to write")

on_root(MPI.COMM_WORLD, write)
"""

# Rank 0 waits for rank 1 in a collective call of the job, and rank 1, whose job has failed, waits in another one.
FAILS_IN_THE_MIDST_OF_A_JOB = """
import sys
from mpi4py import MPI
from vipetsc import install_abort_hook
from vipetsc.parallel import StopRequest, on_every_rank
from vipetsc.studies.pool import TaskPool
assert sys.excepthook is sys.__excepthook__, "an import has installed a hook"
install_abort_hook()
comm = MPI.COMM_WORLD

def work(job):
    if comm.rank == 1:
        raise MemoryError("no room for the job")
    on_every_rank(comm, lambda: None)

TaskPool(comm, comm, StopRequest()).run([1], work)
"""


def run_script(text: str, folder: Path, ranks: int) -> subprocess.CompletedProcess:
    """Run a Python script on several ranks."""
    script = folder / "fails.py"
    script.write_text(text)
    command = ["mpirun", "--oversubscribe", "-n", str(ranks), sys.executable, str(script)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env=clean_environment(), check=False)


@pytest.mark.mpirun
def test_what_rank_0_raises_for_all_is_said_once(tmp_path):
    """An error of rank 0 that all ranks raise is printed once, and all end with 1."""
    ended = run_script(FAILS_ON_RANK_0_FOR_ALL, tmp_path, ranks=3)

    assert ended.returncode == 1
    assert ended.stderr.count("no right to write") == 1


@pytest.mark.mpirun
def test_a_rank_that_fails_in_the_midst_of_a_job_of_several_ends_all(tmp_path):
    """The error of one rank ends the others, and is printed with its rank: no call is matched with another one."""
    ended = run_script(FAILS_IN_THE_MIDST_OF_A_JOB, tmp_path, ranks=2)

    assert ended.returncode == 1
    assert "rank 1: no room for the job" in ended.stderr
    assert "TypeError" not in ended.stderr
