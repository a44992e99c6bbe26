"""A lattice whose cells and sites all differ, as a case of nonlinear normal modes and as equations for SciPy."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.independent_lattice import ScipyLattice, Stop
from vipetsc.case import NnmCase

CELLS = 3
HOSTS = np.linspace(4e-3, 5e-3, CELLS)
RESONATORS = np.full(CELLS, 2e-3)
BETWEEN = 1e4
WITHIN = np.array([5e3, 5.5e3, 4.5e3])
# Three sites: within the first cell, with stops on both sides; between the first two cells, with a stop on one side;
# and to the ground in the third cell.
LINEAR = 4e4
HERTZ = 2e6
TABLE: dict[str, Any] = {
    "name": "unlike",
    "lattice": {
        "cells": CELLS,
        "cell": {
            "masses": [4e-3, 2e-3],
            "springs": [
                {"start": 1, "end": 1, "stiffness": BETWEEN, "next_cell": True},
                {"start": 1, "end": 2, "stiffness": 5e3},
            ],
        },
        "profiles": {"masses[1]": {"first": HOSTS[0], "last": HOSTS[-1]}, "springs[2].stiffness": WITHIN.tolist()},
    },
    "contacts": {
        "sites": [1, 1, 3],
        "clearance": [1e-4, 1.5e-4, 1.2e-4],
        "each": {
            "pair": [[1, 2], [1, 1], [0, 2]],
            "next_cell": [False, True, False],
            "law": ["bilinear", "hertz", "bilinear"],
            "stiffness": [LINEAR, HERTZ, LINEAR],
            "side": ["both", "plus", "minus"],
            "clearance_minus": [1.4e-4, 1.5e-4, 1.2e-4],
        },
    },
    "nnm": {"system": "chain", "modes": [4], "tolerance": 1e-12, "first_step": 1e-2},
}


def unlike_case(**nnm: Any) -> NnmCase:
    """The case of the lattice's branches; ``nnm`` updates its section."""
    return NnmCase.from_table(TABLE | {"nnm": TABLE["nnm"] | nnm})


def independent_lattice() -> ScipyLattice:
    """The lattice of ``TABLE``, assembled spring by spring; its masses are host and resonator of each cell in turn."""
    n = 2 * CELLS
    stiffness = np.zeros((n, n))
    for left in range(-1, CELLS):
        row = np.zeros(n)
        if left >= 0:
            row[2 * left] = -1.0
        if left + 1 < CELLS:
            row[2 * left + 2] = 1.0
        stiffness += BETWEEN * np.outer(row, row)
    for cell in range(CELLS):
        row = np.zeros(n)
        row[2 * cell : 2 * cell + 2] = -1.0, 1.0
        stiffness += WITHIN[cell] * np.outer(row, row)

    stops = (
        Stop(resonator=1, host=0, gap=1e-4, stiffness=LINEAR, exponent=1.0, restitution=1.0, side=1),
        Stop(resonator=1, host=0, gap=1.4e-4, stiffness=LINEAR, exponent=1.0, restitution=1.0, side=-1),
        Stop(resonator=2, host=0, gap=1.5e-4, stiffness=HERTZ, exponent=1.5, restitution=1.0, side=1),
        Stop(resonator=5, host=-1, gap=1.2e-4, stiffness=LINEAR, exponent=1.0, restitution=1.0, side=-1),
    )
    return ScipyLattice(
        masses=np.column_stack([HOSTS, RESONATORS]).ravel(),
        stiffness=stiffness,
        damping=np.zeros((n, n)),
        stops=stops,
        force=lambda t: np.zeros(n),
    )
