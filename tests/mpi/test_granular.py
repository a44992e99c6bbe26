"""Contacts that join cells of two ranks: the same bits on any number of them, of both engines."""

from __future__ import annotations

import hashlib

from mpi4py import MPI

import pytest

from vipetsc.case import Case
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory

CHAIN = {
    "lattice": {"cell": {"masses": [1e-3, 2e-3], "contact": [1, 2],
                         "springs": [{"start": 1, "end": 2, "stiffness": 1e4},
                                     {"start": 2, "end": 1, "stiffness": 1e3, "next_cell": True}]}, "cells": 7},
    "contacts": {"stiffness": 1e7, "restitution": 0.7, "clearance": 1e-5, "sites": [1, 2, 3, 3, 4, 5, 6, 7],
                 "each": {"pair": [[2, 1], [2, 1], [1, 2], [2, 1], [2, 1], [0, 2], [2, 1], [0, 1]],
                          "next_cell": [True, True, False, True, True, False, True, False]}},
    "drive": {"amplitude": 30.0, "cycles": 2, "frequency": 2e3},
    "time": {"end": 0.02, "sample_interval": 2e-4, "rtol": 1e-8},
}  # fmt: skip


# A ring whose joint a contact crosses, with a pressed contact, for exact steps.
RING = CHAIN | {
    "lattice": CHAIN["lattice"] | {"ends": "periodic"},
    "contacts": {
        "stiffness": 1e7, "clearance": 1e-5, "sites": [1, 2, 3, 3, 4, 5, 6, 7],
        "each": {"pair": [[2, 1], [1, 1], [1, 2], [2, 1], [2, 1], [0, 2], [2, 1], [2, 1]],
                 "next_cell": [True, True, False, True, True, False, True, True],
                 "side": ["both", "minus", *["both"] * 6], "restitution": [0.7, 1.0, *[0.7] * 6],
                 "precompression": [0.0, 3e-5, *[0.0] * 6]},
    },
    "time": CHAIN["time"] | {"engine": "propagator"},
}  # fmt: skip


def digest(comm, table):
    memory = RunMemory(comm)
    result = simulate(Case.from_table(table), memory)
    assert result.complete, result.sentence
    assert result.statistics["engine"] == table["time"].get("engine", "ts")

    if comm.rank:
        return None
    data = memory.dataset
    assert len(data["impacts/site"]) > 8
    assert set(data["impacts/site"].values) > {1, 3, 4}

    parts = [data[name].values.tobytes() for name in sorted(data) if name.startswith(("displ", "impacts/", "energy/"))]
    return hashlib.sha256(b"".join(parts)).hexdigest(), result.statistics["switches"], result.statistics["steps"]


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize("table", [CHAIN, RING])
def test_contacts_between_cells_of_two_ranks_have_the_bits_of_one(table):
    comm = MPI.COMM_WORLD
    alone = digest(MPI.COMM_SELF, table) if comm.rank == 0 else None
    together = digest(comm, table)
    assert together == alone
