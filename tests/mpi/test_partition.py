"""Runs have the same bits on any number of ranks: samples, impacts and energies, in gathered and parallel files."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import StopAt, assert_same_bits, datasets, on_two, small_case
from vipetsc.case import Case
from vipetsc.dynamics import simulate
from vipetsc.dynamics.failing_place import failing_place
from vipetsc.dynamics.observers import Observer
from vipetsc.dynamics.propagator import engine
from vipetsc.dynamics.propagator.engine import Forces
from vipetsc.io.store import RunMemory
from vipetsc.lattice.topology import Topology
from vipetsc.parallel import on_root, wait_for_all


def runs_alike(folder: Path, case: Case) -> None:
    """Simulate ``case`` on all ranks and on rank 0 alone, and assert that every dataset has the same bits."""
    together = simulate(case, folder / "together")
    assert together.complete

    def compare() -> None:
        alone = simulate(case, folder / "alone", MPI.COMM_SELF)
        assert alone.complete

        run = datasets(folder / "together" / "run.h5")
        assert_same_bits(run, datasets(folder / "alone" / "run.h5"))
        # Results of different numbers of ranks could differ at impacts.
        assert len(run["impacts/site"]) > 0
        for name in ("episodes", "steps", "rejected", "landings", "switches", "ledger_error", "work", "dissipated"):
            assert together.statistics[name] == alone.statistics[name], name

    on_root(MPI.COMM_WORLD, compare)


@pytest.mark.parallel([2, 3, 4])
@pytest.mark.parametrize("ends", [*on_two("fixed", "free"), "periodic"])
@pytest.mark.parametrize("law", [*on_two("hertz"), "bilinear"])
def test_same_bits_with_sites_on_the_borders(folder, ends, law):
    """A run by ``ts`` with sites on both sides of every border has the same bits on any number of ranks."""
    # 24 cells are cut after cell 12 on 2 ranks, after 8 and 16 on 3, and after 6, 12 and 18 on 4.
    sites = [6, 7, 12, 13, 16, 17]
    case = small_case(lattice={"ends": ends}, contacts={"law": law, "sites": sites}, time={"end": 0.03})
    runs_alike(folder, case)


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("ends", [*on_two("fixed", "free"), "periodic"])
def test_same_bits_with_dashpots_in_cells_that_differ(folder, ends):
    """Cells that are scattered from one seed, and their dashpots, are the same on any number of ranks."""
    scatter = {"masses[1]": {"relative": 0.02}, "springs[1].stiffness": {"relative": 0.02}}
    lattice = {"ends": ends, "damping": {"mass": 10.0, "stiffness": 1e-5}}
    case = small_case(lattice=lattice, disorder={"seed": 2, "cells": scatter}, time={"end": 0.02})
    runs_alike(folder, case)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_same_bits_with_springs_that_are_not_linear(folder, ends):
    """A run with quadratic and cubic springs in every cell has the same bits on any number of ranks."""
    springs = [
        {"start": 1, "end": 1, "stiffness": 2e4, "next_cell": True, "quadratic": -1e7, "cubic": 1e10},
        {"start": 1, "end": 2, "stiffness": 2e3, "cubic": 1e9},
    ]
    cell = {"masses": [0.01, 0.005], "springs": springs, "contact": [1, 2]}
    table = {
        "lattice": {"cell": cell, "cells": 23, "ends": ends},
        "contacts": {"law": "hertz", "stiffness": 1e8, "restitution": 0.7, "sites": [7, 8, 12], "clearance": 1e-4},
        "drive": {"amplitude": 20.0, "cycles": 4, "frequency": 500.0},
        "time": {"engine": "ts", "end": 0.03},
    }
    runs_alike(folder, Case.from_table(table))


@pytest.mark.parallel(2)
def test_same_bits_diatomic_and_driven_in_the_middle(folder):
    """A run of another cell, driven near the border of two ranks, has the same bits on any number of ranks."""
    table = {
        "lattice": {"preset": "diatomic", "cells": 31},
        "contacts": {"sites": [8, 15, 16, 31], "clearance": 4e-5},
        "drive": {"amplitude": 40.0, "cycles": 10, "cell": 16, "mass": 2},
        "time": {"engine": "ts", "end": 0.05},
    }
    runs_alike(folder, Case.from_table(table))


@pytest.mark.parallel([3, 4])
def test_ranks_without_cells_take_part(folder):
    """A lattice of fewer cells than ranks is simulated with the bits of one rank."""
    case = small_case(lattice={"cells": 2}, contacts={"sites": [1, 2], "clearance": 5e-5}, time={"end": 0.02})
    runs_alike(folder, case)


@pytest.mark.parallel(3)
def test_ranks_without_cells_have_no_dashpots(folder):
    """A damped lattice of fewer cells than ranks, with dashpots to its walls, has the bits of one rank."""
    lattice = {"cells": 2, "damping": {"mass": 10.0, "stiffness": 1e-6}}
    runs_alike(folder, small_case(lattice=lattice, contacts={"sites": [1, 2], "clearance": 5e-5}, time={"end": 0.02}))


class Spoiler(Observer):
    """An observer that makes one number of cell 36 of the state NaN after the first block of samples."""

    name = "test-spoiler"
    # A block has so many samples. Checkpoints are written as often: engines may go back to the last one.
    longest = 61
    cell = 35

    def observe(self, block):
        layout = self.setup.layout
        if block.first == 0 and layout.start <= self.cell < layout.stop:
            block.state.array[self.cell - layout.start] = np.nan


@pytest.mark.parallel(2)
def test_an_engine_that_one_rank_cannot_set_up_is_set_up_by_none(monkeypatch):
    """An error of one rank in the set-up of the propagator is raised on all ranks."""

    def forces(*arguments):
        if MPI.COMM_WORLD.rank == 1:
            raise ValueError("no room")
        return Forces(*arguments)

    monkeypatch.setattr(engine, "Forces", forces)
    case = small_case(contacts={"sites": [5]}, time={"engine": "propagator"})
    with pytest.raises(ValueError, match="no room"):
        simulate(case, RunMemory(MPI.COMM_WORLD))


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize(("ends", "site"), [("fixed", "site 1 in cell 6"), ("periodic", "site 2 in cell 20")])
def test_of_cells_that_move_equally_fast_the_first_is_named(ends, site):
    """Many cells of several ranks may be not finite. On a ring the last cell is next to the first."""
    comm = MPI.COMM_WORLD
    layout = SimpleNamespace(comm=comm, dofs=1, owned=3, start=3 * comm.rank)
    engine = SimpleNamespace(state=SimpleNamespace(array_r=np.array([0.0, 0.0, 0.0, 1.0, np.nan, np.nan])))
    model = SimpleNamespace(
        chain=SimpleNamespace(sites=(5, 19), topology=Topology(20, ends), cell=SimpleNamespace(springs=()))
    )
    place = failing_place(SimpleNamespace(layout=layout, engine=engine, model=model))
    assert place == f"cell 2, nearest {site}"


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize(
    ("engine", "stiffness", "observers", "reason"),
    [
        ("propagator", 1e45, [], "stalled: the contacts of sites 1 at"),
        *on_two(("ts", 1e30, [], "stalled: the step fell to")),
        *on_two(("propagator", 1e6, [Spoiler], "the state is not finite")),
        ("ts", 1e6, [Spoiler], "the state is not finite"),
    ],
)
def test_a_step_that_fails_on_one_rank_ends_the_run_on_all(engine, stiffness, observers, reason):
    """A step that fails on the rank of the only site ends the run on all ranks, with the same outcome.

    In the propagator the forces of the site do not even reach another rank within a sample interval.
    """
    table = {
        "name": "failing",
        "lattice": {"preset": "diatomic", "cells": 40},
        "contacts": {"law": "bilinear", "stiffness": stiffness, "sites": [5], "clearance": 1e-5},
        "drive": {"amplitude": 20.0},
        "time": {"end": 0.02, "engine": engine, "rtol": 1e-8},
    }
    memory = RunMemory(MPI.COMM_WORLD, states_every=Spoiler.longest)
    result = simulate(Case.from_table(table), memory, observers=observers)

    assert not result.complete
    assert not result.resumable
    assert result.sentence.startswith(reason)
    assert "nearest site 1 in cell 5" in result.sentence

    outcomes = MPI.COMM_WORLD.allgather((result.sentence, result.statistics, result.warnings))
    assert all(outcome == outcomes[0] for outcome in outcomes)


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize(
    ("engine", "looks", "damping"), [("ts", (500, 150), None), ("propagator", (6, 1), {"mass": 10.0})]
)
def test_a_stopped_run_goes_on_to_the_same_bits_on_any_number_of_ranks(folder, monkeypatch, engine, looks, damping):
    """A run begins on one rank, continues on all and ends on all but one, with the bits of an uninterrupted run.

    Some contacts are closed at both checkpoints. The propagator's run has dashpots, whose losses checkpoints keep cell
    by cell.
    """
    comm = MPI.COMM_WORLD
    # Blocks have 25 samples, and the propagator can stop between two blocks.
    monkeypatch.setattr("vipetsc.dynamics.run.BLOCK_CELLS", 24 * 25)
    sections = {
        "lattice": {"damping": damping},
        "contacts": {"sites": [12, 8, 1, 13, 24], "restitution": 0.7},
        "output": {"window": [3, 20], "every": 2},
    }
    case = small_case(time={"end": 0.05, "engine": engine}, **sections)
    fewer = comm.Split(int(comm.rank == 0))
    if comm.rank == 0:
        simulate(case, folder / "straight", MPI.COMM_SELF)
        assert simulate(case, folder / "stopped", MPI.COMM_SELF, stop=StopAt(looks[0])).resumable
    # Ranks that wait for others to simulate are asleep: in a barrier they would keep their cores busy.
    wait_for_all(comm)

    assert simulate(case, folder / "stopped", resume=True, stop=StopAt(looks[1])).resumable
    comm.Barrier()

    if comm.rank:
        assert simulate(case, folder / "stopped", fewer, resume=True).complete
    wait_for_all(comm)
    fewer.Free()

    if comm.rank == 0:
        straight = datasets(folder / "straight" / "run.h5")
        assert_same_bits(straight, datasets(folder / "stopped" / "run.h5"))
        assert len(straight["impacts/site"]) > 10


@pytest.mark.parallel(2)
def test_the_whole_builtin_run_has_the_same_bits(folder):
    """The built-in run has the same bits on two ranks, and the recorded number of episodes at each site."""
    case = Case.load()
    comm = MPI.COMM_WORLD

    result = simulate(case, folder / "two", comm)

    if comm.rank == 0:
        simulate(case, folder / "one", MPI.COMM_SELF)
        run = datasets(folder / "one" / "run.h5")
        assert_same_bits(run, datasets(folder / "two" / "run.h5"))
        # 181 contact episodes in all, in both engines at all tight tolerances.
        assert np.bincount(run["impacts/site"])[1:].tolist() == [50, 43, 33, 37, 18]
    assert result.statistics["ledger_error"] < 1e-8
