"""Branches shared over ranks: the same bits on 1 and on 2, a failure on one leaves the others."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.conftest import assert_same_bits, datasets
from vipetsc.case.nnm import NnmCase
from vipetsc.modes.follow import follow_all


def three_cells(**nnm) -> NnmCase:
    table = {
        "name": "cells",
        "lattice": {"preset": "four-band", "reading": "printed", "cells": 3},
        "contacts": {"law": "hertz", "sites": [1, 2, 3], "clearance": {"first": 10**-2.65, "last": 10**-2.75}},
        "nnm": {"system": "chain", "modes": [1, 2], "points": 60, "locate_grazing": False} | nnm,
    }
    return NnmCase.from_table(table)


@pytest.mark.parallel([1, 2])
def test_same_bits_on_every_number_of_ranks(folder):
    """Twelve degrees of freedom, the two lowest modes through grazing; rank 0 repeats them alone."""
    comm = MPI.COMM_WORLD
    case = three_cells()
    branches = follow_all(case, folder, comm)
    comm.Barrier()
    if comm.rank == 0:
        assert [b.name for b in branches] == ["mode-1", "mode-2"]
        assert all(b.points[-1].episodes > 0 for b in branches)
        alone = folder / "alone"
        alone.mkdir()
        follow_all(case, alone, MPI.COMM_SELF)
        for b in branches:
            name = f"branch-{b.name}"
            assert (folder / f"{name}.csv").read_text() == (alone / f"{name}.csv").read_text()
            assert_same_bits(datasets(folder / f"{name}.h5"), datasets(alone / f"{name}.h5"))
    else:
        assert branches == []


@pytest.mark.parallel([1, 2])
def test_a_branch_that_fails_keeps_its_points_and_the_others_go_on(folder):
    """A half-trace that may not move at all stops the branches at their first contact, with their points on disk."""
    comm = MPI.COMM_WORLD
    case = three_cells(smallest_step=1e-3, guards={"half_trace": 1e-3})
    branches = follow_all(case, folder, comm)
    comm.Barrier()
    if comm.rank == 0:
        for b in branches:
            assert b.ending.startswith("failed: step below")
            assert "nnm.guards.half_trace" in b.ending
            rows = (folder / f"branch-{b.name}.csv").read_text().splitlines()
            assert len(rows) == len(b.points) + 1 > 2
