"""The table of a lattice whose cells and sites all differ, as a case of nonlinear normal modes."""

from __future__ import annotations

from typing import Any

from vipetsc.case import NnmCase

# Three sites: within the first cell, with stops on both sides; between the first two cells, with a stop on one side;
# and to the ground in the third cell.
TABLE: dict[str, Any] = {
    "name": "unlike",
    "lattice": {
        "cells": 3,
        "cell": {
            "masses": [4e-3, 2e-3],
            "springs": [
                {"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True},
                {"start": 1, "end": 2, "stiffness": 5e3},
            ],
        },
        "profiles": {"masses[1]": {"first": 4e-3, "last": 5e-3}, "springs[2].stiffness": [5e3, 5.5e3, 4.5e3]},
    },
    "contacts": {
        "sites": [1, 1, 3],
        "clearance": [1e-4, 1.5e-4, 1.2e-4],
        "each": {
            "pair": [[1, 2], [1, 1], [0, 2]],
            "next_cell": [False, True, False],
            "law": ["bilinear", "hertz", "bilinear"],
            "stiffness": [4e4, 2e6, 4e4],
            "side": ["both", "plus", "minus"],
            "clearance_minus": [1.4e-4, 1.5e-4, 1.2e-4],
        },
    },
    "nnm": {"system": "chain", "modes": [4], "tolerance": 1e-12, "first_step": 1e-2},
}


def unlike_case(**nnm: Any) -> NnmCase:
    """The case of the lattice's branches; ``nnm`` updates its section."""
    return NnmCase.from_table(TABLE | {"nnm": TABLE["nnm"] | nnm})
