"""Runs with nonlinear springs across the borders of ranks have the same bits on any number of ranks."""

from __future__ import annotations

import pytest

from tests.conftest import on_two, small_case
from tests.mpi.test_partition import runs_alike
from vipetsc.case import Case

# 24 cells are cut after cell 12 on 2 ranks, and after cells 8 and 16 on 3: the cubic springs begin in the last cells
# before the cuts.
SPRINGS = {
    "springs[1].cubic": {"cells": [8, 12, 16], "value": 3e11},
    "springs[4].quadratic": {"cells": [13], "value": 1e5},
}


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("damping", [*on_two({}), {"mass": 30.0}])
@pytest.mark.parametrize("engine", [*on_two("ts"), "propagator"])
def test_same_bits_with_springs_across_borders(folder, engine, damping):
    """Nonlinear springs between cells of two ranks act alike on any number of ranks, with dashpots and without."""
    lattice = {"profiles": SPRINGS, "damping": damping, "ends": "periodic"}
    runs_alike(folder, small_case(lattice=lattice, time={"end": 0.02, "engine": engine}))


GROUNDED = {
    "masses": [0.1, 0.05],
    "springs": [
        {"start": 1, "end": 1, "stiffness": 900.0, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": 400.0},
        {"start": 0, "end": 2, "stiffness": 250.0, "cubic": 4e6},
        {"start": 0, "end": 1, "stiffness": -60.0},
    ],
}


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("damping", on_two({}, {"mass": 3.0}))
@pytest.mark.parametrize("engine", on_two("ts", "propagator"))
def test_same_bits_with_springs_to_the_ground(folder, engine, damping):
    """Springs to the ground and negative ones, linear and not, with dashpots and without."""
    table = {
        "lattice": {"cells": 11, "cell": GROUNDED, "damping": damping},
        "contacts": {"law": "bilinear", "stiffness": 1e5, "sites": [5], "clearance": 1e-3},
        "drive": {"amplitude": 6.0, "cycles": 3, "frequency": 60.0},
        "time": {"end": 0.5, "engine": engine},
    }
    runs_alike(folder, Case.from_table(table))
