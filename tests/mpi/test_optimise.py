"""A search has the same bits on any number of ranks, with ranks in teams or not, and after any stop."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import TWO, StopAt, assert_same_bits, datasets, on_two, search_table, with_sections
from tests.verify.test_optimise_responses import TABLE
from vipetsc.case.optimise import OptimiseCase
from vipetsc.parallel import StoppedError, StopRequest, on_root
from vipetsc.studies.optimum_search import run_search


def plan(*changes: str) -> OptimiseCase:
    """A search for the clearances and the cells of two sites; ``changes`` are overrides of its case."""
    bounds = {"variables": {"clearance": [1e-5, 1e-3], "sites": [3, 12]}}
    table = search_table(16, [4, 9])
    return OptimiseCase.from_table(table | {"optimise": table["optimise"] | bounds}, changes)


def found_by_one_rank(case: OptimiseCase, folder: Path) -> dict[str, np.ndarray]:
    """The datasets of the search that rank 0 computes alone in ``folder``; all ranks get them."""

    def found() -> dict[str, np.ndarray]:
        run_search(case, folder, MPI.COMM_SELF)
        return datasets(folder / "optimum.h5")

    return on_root(MPI.COMM_WORLD, found)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The datasets of the search ``plan()`` on one rank."""
    return found_by_one_rank(plan(), tmp_path_factory.mktemp("whole"))


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("team", [*on_two(1), 2])
def test_the_optimum_does_not_depend_on_the_ranks(folder, whole, team):
    """A search on all ranks, each alone or in teams of two, has the bits of a search on one rank."""
    text = run_search(plan(f"optimise.ranks={team}"), folder, MPI.COMM_WORLD).attrs["summary"]

    assert "14 designs" in text
    assert_same_bits(datasets(folder / "optimum.h5"), whole)
    MPI.COMM_WORLD.Barrier()


@pytest.mark.parallel([2])
def test_a_front_does_not_depend_on_the_ranks(folder, tmp_path_factory):
    """A search for two objectives on two ranks has the bits of a search on one rank."""
    case = plan(TWO, "optimise.population=6")
    alone = found_by_one_rank(case, tmp_path_factory.mktemp("alone"))
    run_search(case, folder, MPI.COMM_WORLD)

    assert_same_bits(datasets(folder / "optimum.h5"), alone)
    MPI.COMM_WORLD.Barrier()


@pytest.mark.parallel([1, 2])
# The search stops at its first look at the request, or after some designs. A rank looks twice for each design that it
# computes: on two ranks 14 to 26 times, as ranks take designs when they are free.
@pytest.mark.parametrize("looks", [1, 4])
def test_one_rank_that_is_asked_to_stop_stops_all_and_the_search_goes_on(folder, whole, looks):
    """A request to stop on one rank ends the search on all; the resumed search has the bits of an unstopped one."""
    comm = MPI.COMM_WORLD
    stop = StopAt(looks) if comm.rank == comm.size - 1 else StopRequest()

    with pytest.raises(StoppedError, match="the same command continues"):
        run_search(plan(), folder, comm, stop=stop)
    assert not (folder / "optimum.h5").exists()

    # No rank continues while another one still looks for the file.
    comm.Barrier()
    run_search(plan(), folder, comm, resume=True)

    assert_same_bits(datasets(folder / "optimum.h5"), whole)
    comm.Barrier()


@pytest.mark.parallel([2])
def test_responses_do_not_depend_on_the_ranks(folder, tmp_path_factory):
    """A search for responses has the same bits if ranks divide the designs, and if a team divides a design's curves."""
    # The range is near the lower resonance: the mass meets its stops at 2 N, and does not reach them at 1 N.
    curves = {"fixed": [1.0, 2.0], "range": [0.84, 0.9], "largest_step": 1.0}
    sections = {"contacts": {"clearance": 14.0}, "nfrc": curves, "optimise": {"budget": 3}}
    table = with_sections(TABLE, sections)
    alone = found_by_one_rank(OptimiseCase.from_table(table), tmp_path_factory.mktemp("alone"))
    for ranks in (1, 2):
        case = OptimiseCase.from_table(table, [f"optimise.ranks={ranks}"])
        run_search(case, folder / str(ranks), MPI.COMM_WORLD)
        assert_same_bits(datasets(folder / str(ranks) / "optimum.h5"), alone)
    MPI.COMM_WORLD.Barrier()
