"""Where branches of normal modes begin: in any unit of energy, and at modes that feel a contact or a spring."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from vipetsc.case import NnmCase
from vipetsc.modes import follow_all
from vipetsc.modes.branches.branch import Branch

pytestmark = pytest.mark.parallel(1)


def duffing_pair(mass: float, stiffness: float, cubic: float, method: str) -> Branch[Any]:
    """The lower mode of two equal masses on three equal springs, one of which hardens; 15 points."""
    own = {
        "masses": [mass, mass],
        "springs": [{"start": a, "end": b, "stiffness": stiffness} for a, b in ((0, 1), (1, 2), (0, 2))],
        "smooth": [{"start": 0, "end": 1, "cubic": cubic}],
    }
    nnm = {"system": "own", "own": own, "modes": [1], "points": 15, "method": method, "energy": [0.0, 1e40]}
    (branch,) = follow_all(NnmCase.from_table({"nnm": nnm}), None, MPI.COMM_SELF)
    return branch


@pytest.mark.parametrize("method", ["shooting", "balance"])
@pytest.mark.parametrize(("mass", "stiffness", "cubic"), [(1e-12, 1e-3, 1e9), (1e6, 1e9, 1e-4)])
def test_a_branch_is_the_same_in_any_units(method, mass, stiffness, cubic):
    """With energies over k^2/c and frequencies over (k/m)^1/2 a branch is that of numbers of order one."""
    ones = duffing_pair(1.0, 1.0, 1.0, method)
    branch = duffing_pair(mass, stiffness, cubic, method)
    energies = [p.energy * cubic / stiffness**2 for p in branch.points]
    frequencies = [p.frequency * np.sqrt(mass / stiffness) for p in branch.points]
    assert energies == pytest.approx([p.energy for p in ones.points], rel=1e-7)
    assert frequencies == pytest.approx([p.frequency for p in ones.points], rel=1e-9)
    # The first motion is almost linear: the spring's largest force is 1e-4 of the linear one.
    assert ones.points[0].frequency == pytest.approx(np.sqrt(1.0) / (2 * np.pi), rel=1e-4)


THREE: dict[str, Any] = {
    "masses": [1.0, 1.0, 1.0],
    "springs": [{"start": a, "end": b, "stiffness": 1.0} for a, b in ((0, 1), (1, 2), (2, 3), (0, 3))],
}


@pytest.mark.parametrize(
    "own",
    [
        pytest.param({"contacts": [{"host": 0, "resonator": 2, "clearance": 0.1}]}, id="contact"),
        pytest.param({"smooth": [{"start": 0, "end": 2, "cubic": 1.0}]}, id="spring"),
        pytest.param({"smooth": [{"start": 0, "end": 2, "quadratic": 1.0, "cubic": 1.0}]}, id="quadratic"),
    ],
)
def test_a_mode_with_a_node_where_it_could_touch_begins_no_condensed_branch(own):
    """The second mode of three masses has a node in the middle; its branch is refused, not that of another mode."""
    table = {
        "contacts": {"law": "bilinear", "stiffness": 10.0},
        "nnm": {"system": "own", "own": THREE | own, "modes": [2], "points": 3, "method": "balance"},
    }
    if "contacts" not in own:
        del table["contacts"]
    (branch,) = follow_all(NnmCase.from_table(table), None, MPI.COMM_SELF)
    assert not branch.points
    assert "node" in branch.ended.sentence
    # Shooting follows the linear motion.
    table["nnm"]["method"] = "shooting"
    (branch,) = follow_all(NnmCase.from_table(table), None, MPI.COMM_SELF)
    assert branch.points[0].frequency == pytest.approx(np.sqrt(2) / (2 * np.pi), rel=1e-9)
