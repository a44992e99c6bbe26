"""Runs with stops that do not yield have the same bits on any number of ranks, and after a stop while sites stick."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.conftest import StopAt, assert_same_bits, datasets, on_two
from tests.mpi.test_partition import runs_alike
from tests.verify.test_rigid_impacts import joined, pairs
from vipetsc.case import CaseError
from vipetsc.dynamics import simulate
from vipetsc.dynamics.observers import Observer
from vipetsc.parallel import on_root


@pytest.mark.parallel([1, 2, 3, 4])
@pytest.mark.parametrize("restitution", on_two(0.0, 0.7))
def test_pairs_of_cells_have_the_same_bits(folder, restitution):
    """Impacts and sticking of a cell's own pair, by ``ts``."""
    runs_alike(folder, pairs("ts", restitution))


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("ends", on_two("fixed", "periodic"))
def test_masses_of_two_ranks_that_stick_have_the_same_bits(folder, ends):
    """Masses of neighbouring cells stick, those of two ranks among them: each rank knows the other's acceleration."""
    sites = [6, 8, 12, 16, 18]
    if ends == "periodic":
        sites.append(24)
    runs_alike(folder, joined("ts", sites, 0.0, ends))


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("sites", on_two([6, 8, 12, 16, 18, 24], [11, 12, 13]))
def test_the_propagator_has_the_same_bits(folder, sites):
    """Sites that stick, and some that share masses of two ranks, are followed by every rank that feels them."""
    runs_alike(folder, joined("propagator", sites, 0.3, "periodic"))


@pytest.mark.parallel(2)
def test_stops_that_share_a_mass_are_refused_on_two_ranks():
    """Blows pass from mass to mass within an instant, which ``ts`` follows on one rank."""
    with pytest.raises(CaseError, match="rank"):
        simulate(joined("ts", [11, 12], 0.5), comm=MPI.COMM_WORLD)


class ShortBlocks(Observer):
    """An observer that cuts a run into blocks of five samples, after each of which engines look at requests to stop."""

    name = "test-short-blocks"
    longest = 5

    def observe(self, block):
        pass


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize(("engine", "looks"), on_two(("ts", 450), ("propagator", 38)))
def test_a_run_that_stopped_while_sites_stick_has_the_same_bits(folder, engine, looks):
    """A run that is resumed while sites are stuck has the bits of a run without a stop."""
    case = joined(engine, [6, 12, 18], 0.0)
    first = simulate(case, folder / "parts", stop=StopAt(looks), observers=[ShortBlocks])
    assert first.resumable, first.sentence
    end = first.statistics["end"]
    simulate(case, folder / "parts", resume=True, observers=[ShortBlocks])
    simulate(case, folder / "whole", observers=[ShortBlocks])

    def compare() -> None:
        parts = datasets(folder / "parts" / "run.h5")
        assert_same_bits(parts, datasets(folder / "whole" / "run.h5"))
        is_stuck = (parts["impacts/onset"] < end) & ~(parts["impacts/separation"] <= end)
        assert is_stuck.any(), end

    on_root(MPI.COMM_WORLD, compare)
