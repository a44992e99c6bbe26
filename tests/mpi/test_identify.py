"""An identification has the same bits on any number of ranks, and after a stop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import StopAt, assert_same_bits, datasets
from tests.identified import identify_table, lattice_table, measured_table
from vipetsc.case.identify import IdentifyCase
from vipetsc.identification.growing_windows import GrowingWindows
from vipetsc.parallel import StoppedError, divided, on_root, smallest
from vipetsc.studies.identification import run_identification

# Two starts and two points of a profile: several jobs, but fewer than three ranks.
OPTIONS = {"starts": 2, "profile": 2, "steps": 4}


def plan_of(folder: Path, changes: dict[str, Any], end: float = 0.009, **options: Any) -> IdentifyCase:
    """A fit of one clearance to a record with contacts, up to ``end`` in s; ``changes`` update the record's table."""
    table = lattice_table(time={"end": end})

    def written() -> str:
        record = measured_table(folder, table, noise=0.01) | changes
        unknowns = [{"quantity": "clearance", "of": [[1]], "bounds": [2e-4, 8e-4], "start": 6e-4}]
        # Rank 0 alone writes the record, and hands the case to the others as text.
        return IdentifyCase.from_table(identify_table(table, record, unknowns=unknowns, **options)).to_toml()

    return IdentifyCase.from_toml(on_root(MPI.COMM_WORLD, written))


def result_of_one_rank(plan: IdentifyCase, folder: Path) -> dict[str, np.ndarray]:
    """The datasets of the identification that rank 0 computes alone; all ranks get them."""

    def identified() -> dict[str, np.ndarray]:
        run_identification(plan, folder, MPI.COMM_SELF)
        return datasets(folder / "identified.h5")

    return on_root(MPI.COMM_WORLD, identified)


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """The case of a fit from two starts."""
    return plan_of(tmp_path_factory.mktemp("data"), {}, **OPTIONS)


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """The case of a fit from one start that also estimates the initial state, and its result on one rank."""
    # A state has many coordinates: the derivatives with respect to them are the jobs that ranks divide.
    changes = {"begin": 0.004, "initial": "estimate"}
    plan = plan_of(tmp_path_factory.mktemp("single"), changes, end=0.007, profile=0, steps=3)
    return plan, result_of_one_rank(plan, tmp_path_factory.mktemp("single-whole"))


@pytest.fixture(scope="module")
def whole(plan, tmp_path_factory):
    """The result of ``plan`` on one rank."""
    return result_of_one_rank(plan, tmp_path_factory.mktemp("whole"))


@pytest.mark.parallel([1, 2])
def test_the_result_does_not_depend_on_the_ranks(folder, plan, whole):
    """A fit from two starts on all ranks has the bits of a fit on one rank."""
    text = run_identification(plan, folder, MPI.COMM_WORLD).attrs["summary"]
    assert "clearance 1" in text
    assert "2 starts" in text
    assert_same_bits(datasets(folder / "identified.h5"), whole)
    MPI.COMM_WORLD.Barrier()


@pytest.mark.parallel([1, 2])
def test_a_stopped_identification_goes_on(folder, plan, whole):
    """A fit that is stopped and resumed has the bits of an uninterrupted one."""
    with pytest.raises(StoppedError):
        run_identification(plan, folder, MPI.COMM_WORLD, stop=StopAt(20))
    assert not (folder / "identified.h5").exists()
    run_identification(plan, folder, MPI.COMM_WORLD, resume=True)
    assert_same_bits(datasets(folder / "identified.h5"), whole)
    MPI.COMM_WORLD.Barrier()


@pytest.mark.parallel([2, 3])
def test_ranks_divide_a_single_start_to_the_same_bits(folder, single):
    """Ranks that divide the derivatives of one start get the result of one rank."""
    plan, whole = single
    run_identification(plan, folder, MPI.COMM_WORLD)
    assert_same_bits(datasets(folder / "identified.h5"), whole)
    MPI.COMM_WORLD.Barrier()


@pytest.mark.parallel([1, 2])
def test_no_window_that_was_solved_is_solved_again(folder, single, monkeypatch):
    """A fit that is stopped twice within its only start solves every window once, with the bits of an unstopped fit."""
    plan, whole = single
    solve = GrowingWindows.minimum
    solved: list[int] = []

    def counted(windows: GrowingWindows, *arguments: Any) -> Any:
        solution = solve(windows, *arguments)
        solved.append(len(arguments[1]))
        return solution

    # Windows that are read from the records do not call this function.
    monkeypatch.setattr(GrowingWindows, "minimum", counted)
    for resume in (False, True):
        with pytest.raises(StoppedError):
            run_identification(plan, folder, MPI.COMM_WORLD, stop=StopAt(14), resume=resume)
    before = len(solved)
    assert before >= 2
    run_identification(plan, folder, MPI.COMM_WORLD, resume=True)
    lines = (folder / "identified-runs.jsonl").read_text().splitlines()
    # There is one record for each window that was solved.
    assert len(solved) == sum(" window " in line for line in lines) > before
    assert_same_bits(datasets(folder / "identified.h5"), whole)
    MPI.COMM_WORLD.Barrier()


@pytest.mark.parallel([1, 2, 3])
def test_the_smallest_numbers_of_all_ranks_are_known_to_all():
    """``smallest`` reduces each number by itself: a rank may have one, another rank the other."""
    comm = MPI.COMM_WORLD
    last = comm.size - 1
    assert smallest(comm, 2.0 + comm.rank, -float(comm.rank == last), 0.5) == [2.0, -1.0, 0.5]


@pytest.mark.parallel([1, 2, 3])
def test_jobs_are_divided_and_their_first_failure_is_that_of_all():
    """``divided`` computes job k on rank k mod size, gives all ranks all values, and raises one error on all ranks."""
    comm = MPI.COMM_WORLD
    computed: list[int] = []

    def job(number: int) -> int:
        computed.append(number)
        if number in (2, 4):
            raise ArithmeticError(f"job {number}")
        return number**2

    jobs = [lambda number=number: job(number) for number in range(2)]
    assert divided(comm, jobs) == [0, 1]
    # Every rank has all values, and has computed only its own.
    assert computed == [number for number in range(2) if number % comm.size == comm.rank]
    # All ranks raise the failure with the smallest number, not the earliest one.
    with pytest.raises(ArithmeticError, match="job 2"):
        divided(comm, [lambda number=number: job(number) for number in range(5)])
    comm.Barrier()
