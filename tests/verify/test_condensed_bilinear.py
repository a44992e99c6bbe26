"""The paper's bilinear stop by harmonics: branches pass the first touch, with the slopes and folds of shooting."""

from __future__ import annotations

import itertools
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from vipetsc.case import NnmCase
from vipetsc.modes import follow_all
from vipetsc.modes.branches.branch import Branch

pytestmark = pytest.mark.parallel(1)

# J: grazing of the two modes, and the folds of the energy, by shooting.
GRAZING = {1: 0.00354423143560, 2: 0.0293434562302}
FOLDS = {1: [], 2: [0.0293435546934, 0.0223715911605]}


def condensed(mode: int, top: float, modulus: float = 1e8, **options: Any) -> Branch[Any]:
    nnm = {"modes": [mode], "energy": [0.0, top], "method": "balance", "points": 300} | options
    table = {
        "lattice": {"preset": "four-band", "reading": "printed"},
        "contacts": {"law": "bilinear", "modulus": modulus},
        "nnm": nnm,
    }
    (branch,) = follow_all(NnmCase.from_table(table), None, MPI.COMM_SELF)
    return branch


@pytest.mark.parametrize("mode", [1, 2])
def test_a_branch_passes_the_first_touch_as_in_shooting(mode):
    """Folds are those of shooting; between regular points the secant has the sign of the slopes at both."""
    top = {1: 0.006, 2: 0.5}[mode]
    branch = condensed(mode, top, truncation=1e-5)
    assert branch.complete
    assert branch.points[-1].energy > top

    folds = [p.energy for p in branch.points if p.kind == "fold-energy"]
    assert folds == pytest.approx(FOLDS[mode], rel=1e-6)

    touched = [p for p in branch.points if p.energy > GRAZING[mode] or p.episodes]
    for left, right in itertools.pairwise(touched):
        # The branch turns back in energy at a fold, and the sign of its slope changes there.
        if "regular" == left.kind == right.kind:
            secant = (right.frequency - left.frequency) / (right.energy - left.energy)
            assert np.sign(left.slope) == np.sign(right.slope) == np.sign(secant)
