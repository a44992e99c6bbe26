"""The derivatives of a fit are jobs that ranks divide; what holds for every study is in ``test_study_contract``."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.conftest import assert_same_bits, datasets
from tests.identified import identify_table, lattice_table, measured_table
from vipetsc.case.identify import IdentifyCase
from vipetsc.parallel import divided, on_root, smallest
from vipetsc.studies.identification import run_identification

COMM = MPI.COMM_WORLD


@pytest.mark.parallel([2, 3])
def test_ranks_divide_a_single_start_to_the_same_bits(folder):
    """Ranks that divide the derivatives by parameters and initial state of one start get the result of one rank."""

    def alone() -> str:
        """Compute the fit on this rank, into a folder of its own; return its case, whose record rank 0 alone writes."""
        table = lattice_table(time={"end": 0.007})
        record = measured_table(folder, table, noise=0.01) | {"begin": 0.004, "initial": "estimate"}
        unknowns = [{"quantity": "clearance", "of": [[1]], "bounds": [2e-4, 8e-4], "start": 6e-4}]
        plan = IdentifyCase.from_table(identify_table(table, record, unknowns=unknowns, steps=1))
        run_identification(plan, folder / "alone", MPI.COMM_SELF)
        return plan.to_toml()

    plan = IdentifyCase.from_toml(on_root(COMM, alone))
    run_identification(plan, folder / "together", COMM)
    assert_same_bits(datasets(folder / "together/identified.h5"), datasets(folder / "alone/identified.h5"))
    COMM.Barrier()


@pytest.mark.parallel([1, 2, 3])
def test_the_smallest_numbers_of_all_ranks_are_known_to_all():
    """``smallest`` reduces each number by itself: a rank may have one, another rank the other."""
    last = COMM.size - 1
    assert smallest(COMM, 2.0 + COMM.rank, -float(COMM.rank == last), 0.5) == [2.0, -1.0, 0.5]


@pytest.mark.parallel([1, 2, 3])
def test_jobs_are_divided_and_their_first_failure_is_that_of_all():
    """``divided`` computes job k on rank k mod size, gives all ranks all values, and raises one error on all ranks."""
    computed: list[int] = []

    def job(number: int) -> int:
        computed.append(number)
        if number in (2, 4):
            raise ArithmeticError(f"job {number}")
        return number**2

    jobs = [lambda number=number: job(number) for number in range(2)]
    assert divided(COMM, jobs) == [0, 1]
    # Every rank has all values, and has computed only its own.
    assert computed == [number for number in range(2) if number % COMM.size == COMM.rank]
    # All ranks raise the failure with the smallest number, not the earliest one.
    with pytest.raises(ArithmeticError, match="job 2"):
        divided(COMM, [lambda number=number: job(number) for number in range(5)])
    COMM.Barrier()
