"""Springs to the ground and negative springs in both engines, against DOP853 on equations written from the case."""

from __future__ import annotations

import pytest

from vipetsc.case import Case
from vipetsc.case.section import CaseError

NEXT = {"start": 1, "end": 1, "stiffness": 900.0, "next_cell": True}
INSIDE = {"start": 1, "end": 2, "stiffness": 400.0}
GROUND = {"start": 0, "end": 2, "stiffness": 250.0}
NEGATIVE = {"start": 0, "end": 1, "stiffness": -60.0}
CELLS = 5


def table(springs, engine="ts", ends="fixed", **lattice):
    """Five cells of two masses, whose first mass is driven in the middle; there are no contacts."""
    return {
        "lattice": {"cells": CELLS, "ends": ends, "cell": {"masses": [0.1, 0.05], "springs": springs}} | lattice,
        "contacts": {"sites": []},
        "drive": {"amplitude": 1.5, "cycles": 3, "frequency": 60.0, "cell": 3},
        "time": {"end": 0.6, "engine": engine, "rtol": 1e-11},
    }


CUT = [
    {"start": 2, "end": 1, "stiffness": 1000.0, "next_cell": True},
    INSIDE | {"stiffness": 10.0},
    {"start": 0, "end": 1, "stiffness": -50.0},
    {"start": 0, "end": 2, "stiffness": 100.0},
]


@pytest.mark.parametrize(
    "springs, lattice, key",
    [
        ([NEXT, INSIDE | {"stiffness": -400.0}], {}, r"springs\[2\]\.stiffness"),
        ([NEXT, INSIDE, NEGATIVE | {"stiffness": -5.0}], {}, r"springs\[3\]\.stiffness"),
        ([NEXT, INSIDE, GROUND | {"damping": -0.1}], {}, r"springs\[3\]\.damping"),
        ([NEXT, INSIDE, GROUND | {"stiffness": 0.0}], {}, r"springs\[3\]\.stiffness"),
        ([NEXT, INSIDE, GROUND | {"next_cell": True}], {}, r"springs\[3\]\.next_cell"),
        ([NEXT, INSIDE, {"start": 2, "end": 0, "stiffness": 3.0}], {}, r"springs\[3\]"),
        # Stable in a lattice with walls, but not where a spring to the next cell is cut.
        (CUT, {}, None),
        (CUT, {"ends": "free"}, r"springs\[3\]\.stiffness"),
        (
            [NEXT, INSIDE, GROUND, NEGATIVE],
            {"profiles": {"springs[1].stiffness": {"cells": [2], "value": 5.0}}},
            "profiles",
        ),
    ],
)
def test_unstable_springs_are_refused(springs, lattice, key):
    """Names the spring or the key."""
    if key is None:
        Case.from_table(table(springs, **lattice))
        return
    with pytest.raises(CaseError, match=key):
        Case.from_table(table(springs, **lattice))
