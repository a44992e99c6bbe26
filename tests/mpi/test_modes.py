"""Branches on different ranks have the same bits as on one rank, and a branch that fails does not affect the others."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.conftest import assert_same_bits, datasets
from vipetsc.case.nnm import NnmCase
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all


def three_cells(**nnm) -> NnmCase:
    """Branches from the two lowest modes of twelve degrees of freedom, into contact; ``nnm`` updates its section."""
    table = {
        "name": "cells",
        "lattice": {"preset": "four-band", "reading": "printed", "cells": 3},
        "contacts": {"law": "hertz", "sites": [1, 2, 3], "clearance": {"first": 10**-2.65, "last": 10**-2.75}},
        "nnm": {"system": "chain", "modes": [1, 2], "points": 60, "locate_grazing": False} | nnm,
    }
    return NnmCase.from_table(table)


@pytest.mark.parallel([1, 2])
def test_same_bits_on_every_number_of_ranks(folder):
    """Branches on one rank each have the files of branches on a single rank, and rank 0 gets all of them."""
    comm = MPI.COMM_WORLD
    case = three_cells()
    branches = follow_all(case, folder, comm)
    comm.Barrier()
    if comm.rank:
        # Rank 0 collects the branches of all ranks.
        assert branches == []
        return

    assert [branch.name for branch in branches] == ["mode-1", "mode-2"]
    assert all(branch.points[-1].episodes > 0 for branch in branches)

    alone = folder / "alone"
    alone.mkdir()
    follow_all(case, alone, MPI.COMM_SELF)
    for branch in branches:
        name = f"branch-{branch.name}"
        assert (folder / f"{name}.csv").read_text() == (alone / f"{name}.csv").read_text()
        assert_same_bits(datasets(folder / f"{name}.h5"), datasets(alone / f"{name}.h5"))


@pytest.mark.parallel([1, 2])
def test_a_branch_that_fails_keeps_its_points_and_the_others_go_on(folder):
    """A tight bound on the half-trace ends both branches at their first contact, with their points on disk."""
    comm = MPI.COMM_WORLD
    case = three_cells(smallest_step=1e-3, guards={"half_trace": 1e-3})

    branches = follow_all(case, folder, comm)

    comm.Barrier()
    if comm.rank == 0:
        assert len(branches) == 2
        for branch in branches:
            assert branch.ended.sentence.startswith("failed: step below")
            assert "nnm.guards.half_trace" in branch.ended.sentence
            # The table has a row of names, and then one row for each point.
            rows = (folder / f"branch-{branch.name}.csv").read_text().splitlines()
            assert len(rows) == len(branch.points) + 1 > 2


@pytest.mark.parallel([2])
def test_an_error_of_one_rank_is_raised_on_all_when_the_others_have_finished(folder):
    """An error that is no failure of the method, here of a listener, is raised on all ranks after all branches."""
    comm = MPI.COMM_WORLD

    def listener(branch, point):
        if branch.name == "mode-2":
            raise RuntimeError("of rank 1 alone")

    # Rank 1 follows mode-2.
    with pytest.raises(RuntimeError, match="of rank 1 alone"):
        follow_all(three_cells(points=3), folder, comm, listener=listener)

    comm.Barrier()
    if comm.rank == 0:
        assert len(read_branch(folder / "branch-mode-1.h5").points) == 4
