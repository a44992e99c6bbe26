"""The same ensemble file on any number of ranks, alone or in teams."""

from __future__ import annotations

import tomllib

from mpi4py import MPI

import pytest

from tests.conftest import assert_same_bits, datasets
from vipetsc.case import Sweep
from vipetsc.parallel import SharedCounter
from vipetsc.studies.sweep import run_sweep

TABLE = """
name = "small"
[lattice]
preset = "four-band"
cells = 16
[contacts]
clearance = 2e-4
[drive]
cycles = 3
[time]
end = 0.04
rtol = 1e-8
[output]
stride = 2
[sweep.contacts]
sites = [[4], [4, 9]]
[sweep.drive]
amplitude = [0.1, 20.0, 40.0]
"""


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("team", [1, 2])
def test_the_ensemble_does_not_depend_on_the_ranks(folder, team):
    comm = MPI.COMM_WORLD
    plan = Sweep.from_table(tomllib.loads(TABLE), [f"sweep.ranks={team}"])
    result = run_sweep(plan, folder / "all", comm)
    assert result.complete
    assert len(result.outcomes) == 6
    assert len(result.busy) == comm.size
    if comm.rank == 0:
        alone = run_sweep(Sweep.from_table(tomllib.loads(TABLE)), folder / "alone", MPI.COMM_SELF)
        assert alone.complete
        assert_same_bits(datasets(folder / "all" / "ensemble.h5"), datasets(folder / "alone" / "ensemble.h5"))
    comm.Barrier()


@pytest.mark.parallel([1, 2, 3])
def test_every_number_is_drawn_once():
    comm = MPI.COMM_WORLD
    counter, drawn = SharedCounter(comm), []
    while (number := counter.draw()) < 200:
        drawn.append(number)
    everything = [number for share in comm.allgather(drawn) for number in share]
    assert sorted(everything) == list(range(200))
    counter.free()
