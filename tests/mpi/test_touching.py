"""Runs with contacts that touch at rest, within cells and between cells of two ranks, have the same bits on 2 ranks."""

from __future__ import annotations

import hashlib

from mpi4py import MPI

import pytest

from tests.verify.test_resonators_in_grains import grains
from tests.verify.test_touching import bead_case, sprung_case
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory


def digest(comm, case):
    """A hash of motion, energies and impacts, and the number of landings, on rank 0; None on other ranks."""
    memory = RunMemory(comm)
    result = simulate(case, memory)
    assert result.complete, result.sentence
    if comm.rank:
        return None

    data = memory.dataset
    names = [name for name in sorted(data) if name.startswith(("displacement", "impacts/", "energy/"))]
    parts = [data[name].values.tobytes() for name in names]
    return hashlib.sha256(b"".join(parts)).hexdigest(), result.statistics["landings"]


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("engine", ["ts", "propagator"])
@pytest.mark.parametrize("create", [sprung_case, bead_case, grains])
def test_touching_contacts_have_the_bits_of_one_rank(engine, create):
    """Motion, energies, impacts and landings of a run on all ranks are those of a run on one rank."""
    comm = MPI.COMM_WORLD
    case = create(engine)
    alone = digest(MPI.COMM_SELF, case) if comm.rank == 0 else None
    together = digest(comm, case)
    assert together == alone
