"""The same identification on any number of ranks, and after a stop."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.conftest import assert_same_bits, datasets
from tests.identified import identify_table, lattice_table, measured_table
from vipetsc.case.identify import IdentifyCase
from vipetsc.parallel import StoppedError, StopRequest, on_root
from vipetsc.studies.identification import run_identification

OPTIONS = {"starts": 2, "profile": 2, "steps": 4}


class StopAfter(StopRequest):
    """A request to stop that comes with the check of that number."""

    def __init__(self, checks: int) -> None:
        self.left = checks

    @property
    def requested(self) -> bool:
        self.left -= 1
        return self.left < 0


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """A fit of one clearance, from two starts, to a record of a few contacts."""
    table = lattice_table(time={"end": 0.009})

    def made() -> str:
        record = measured_table(tmp_path_factory.mktemp("data"), table, noise=0.01)
        unknowns = [{"quantity": "clearance", "of": [[1]], "bounds": [2e-4, 8e-4], "start": 6e-4}]
        return IdentifyCase.from_table(identify_table(table, record, unknowns=unknowns, **OPTIONS)).to_toml()

    return IdentifyCase.from_toml(on_root(MPI.COMM_WORLD, made))


@pytest.fixture(scope="module")
def whole(plan, tmp_path_factory):
    """The result of one rank."""
    folder = tmp_path_factory.mktemp("whole")
    run_identification(plan, folder, MPI.COMM_SELF)
    return datasets(folder / "identified.h5")


@pytest.mark.parallel([1, 2])
def test_the_result_does_not_depend_on_the_ranks(folder, plan, whole):
    text = run_identification(plan, folder, MPI.COMM_WORLD)
    assert "clearance 1" in text
    assert "2 starts" in text
    assert_same_bits(datasets(folder / "identified.h5"), whole)
    MPI.COMM_WORLD.Barrier()


@pytest.mark.parallel([1, 2])
def test_a_stopped_identification_goes_on(folder, plan, whole):
    with pytest.raises(StoppedError):
        run_identification(plan, folder, MPI.COMM_WORLD, stop=StopAfter(30))
    assert not (folder / "identified.h5").exists()
    run_identification(plan, folder, MPI.COMM_WORLD, resume=True)
    assert_same_bits(datasets(folder / "identified.h5"), whole)
    MPI.COMM_WORLD.Barrier()
