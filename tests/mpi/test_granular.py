"""Contacts that join cells of two ranks: runs by both engines have the same bits on any number of ranks."""

from __future__ import annotations

import hashlib

from mpi4py import MPI

import pytest

from vipetsc.case import Case
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory


def contact_table(**each: list) -> dict:
    """The table of contacts at eight sites in seven cells, of which cell 3 has two; ``each`` are keys by site."""
    return {"stiffness": 1e7, "clearance": 1e-5, "sites": [1, 2, 3, 3, 4, 5, 6, 7], "each": each}


LATTICE = {
    "cell": {
        "masses": [1e-3, 2e-3],
        "contact": [1, 2],
        "springs": [
            {"start": 1, "end": 2, "stiffness": 1e4},
            {"start": 2, "end": 1, "stiffness": 1e3, "next_cell": True},
        ],
    },
    "cells": 7,
}

# A chain whose contacts join cells, masses of a cell, and masses with ground.
CHAIN = {
    "lattice": LATTICE,
    "contacts": {"restitution": 0.7}
    | contact_table(
        pair=[[2, 1], [2, 1], [1, 2], [2, 1], [2, 1], [0, 2], [2, 1], [0, 1]],
        next_cell=[True, True, False, True, True, False, True, False],
    ),
    "drive": {"amplitude": 30.0, "cycles": 2, "frequency": 2e3},
    "time": {"engine": "ts", "end": 0.008, "sample_interval": 2e-4, "rtol": 1e-8},
}

# A ring for the propagator: a contact joins the last cell and the first, and another one is pressed at rest.
RING = CHAIN | {
    "lattice": LATTICE | {"ends": "periodic"},
    "contacts": contact_table(
        pair=[[2, 1], [1, 1], [1, 2], [2, 1], [2, 1], [0, 2], [2, 1], [2, 1]],
        next_cell=[True, True, False, True, True, False, True, True],
        side=["both", "minus", *["both"] * 6],
        restitution=[0.7, 1.0, *[0.7] * 6],
        precompression=[0.0, 3e-5, *[0.0] * 6],
    ),
    "time": CHAIN["time"] | {"engine": "propagator"},
}


def digest(comm: MPI.Comm, table: dict) -> tuple | None:
    """A hash of a run's fields, impacts and energies, and its numbers of switches and steps; None except on rank 0."""
    memory = RunMemory(comm)
    result = simulate(Case.from_table(table), memory)
    assert result.complete, result.sentence
    assert result.statistics["engine"] == table["time"]["engine"]

    if comm.rank:
        return None

    data = memory.dataset
    assert len(data["impacts/site"]) > 8
    assert set(data["impacts/site"].values) > {1, 3, 4}

    content = hashlib.sha256()
    for name in sorted(data):
        if name.startswith(("displacement", "impacts/", "energy/")):
            content.update(data[name].values.tobytes())
    return content.hexdigest(), result.statistics["switches"], result.statistics["steps"]


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("table", [CHAIN, RING])
def test_contacts_between_cells_of_two_ranks_have_the_bits_of_one(table):
    """Fields, impacts, energies, switches and steps of a run on all ranks are those of a run on one rank."""
    comm = MPI.COMM_WORLD
    together = digest(comm, table)

    if comm.rank == 0:
        assert together == digest(MPI.COMM_SELF, table)
