"""Branches of springs that soften end where a motion no longer leaves an equilibrium; its periods are integrals."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scipy.special import ellipk

from vipetsc.case import NnmCase
from vipetsc.modes import follow_all
from vipetsc.modes.branches.branch import Branch

pytestmark = pytest.mark.parallel(1)


def softening(method: str, energy: float = 1.0, masses: int = 1, stiffness: float = 1.0, **law: float) -> Branch[Any]:
    """The branch of the first mode of masses of 1 kg, each on a spring to the ground that softens."""
    ground = range(1, masses + 1)
    own = {
        "masses": [1.0] * masses,
        "springs": [{"start": 0, "end": mass, "stiffness": stiffness} for mass in ground],
        "smooth": [{"start": 0, "end": mass} | law for mass in ground],
    }
    own["springs"] += [{"start": mass, "end": mass + 1, "stiffness": 0.1} for mass in range(1, masses)]
    nnm = {"system": "own", "method": method, "modes": [1], "energy": [0.0, energy], "own": own, "harmonics": 255}
    (branch,) = follow_all(NnmCase.from_table({"nnm": nnm}), None, MPI.COMM_SELF)
    return branch


def quadratic_period(x: float) -> float:
    """The period of u'' + u - u^2 = 0 from rest at x: u is between the two smaller roots of the potential."""
    others = np.roots([1.0, x - 1.5, x * (x - 1.5)])
    low, middle, high = np.sort([x, *others.real])
    return 4 * np.sqrt(1.5 / (high - low)) * ellipk((middle - low) / (high - low))


def cubic_period(x: float) -> float:
    """The period of u'' + u - u^3 = 0 from rest at x."""
    return 4 * np.sqrt(2 / (2 - x**2)) * ellipk(x**2 / (2 - x**2))


@pytest.mark.parametrize("method", ["shooting", "balance"])
@pytest.mark.parametrize(
    ("law", "last", "period"), [("quadratic", 1 / 6, quadratic_period), ("cubic", 1 / 4, cubic_period)]
)
def test_a_branch_ends_at_the_saddle(method, law, last, period):
    """The energy of the saddle ends the branch, its points are orbits, and their periods are elliptic integrals."""
    branch = softening(method, **{law: -1.0})
    assert branch.complete
    assert "equilibrium" in branch.ended.sentence
    assert branch.points[-1].energy == pytest.approx(last, rel=1e-6)
    assert {p.kind for p in branch.points} == {"regular"}

    assert max(p.residual for p in branch.points) < 1e-8
    for point in branch.points:
        start = float(np.ravel(point.elongations if method == "balance" else point.x)[0])
        # Near the saddle the period depends on the last digits of the start.
        if abs(start - 1) > 1e-4:
            assert point.period == pytest.approx(period(start), rel=1e-9 + 1e-7 / abs(start - 1))


@pytest.mark.parametrize(
    ("change", "saddle"),
    [
        pytest.param({"cubic": -1.0, "masses": 2}, 0.5, id="two masses"),
        pytest.param({"cubic": -4.0, "stiffness": 4.0, "energy": 2.0}, 1.0, id="stiffer"),
        # k u - 3 u^2 + 2 u^3 has the equilibria 0, 1/2 and 1.
        pytest.param({"quadratic": -3.0, "cubic": 2.0}, 1 / 32, id="two wells"),
    ],
)
def test_other_saddles_end_branches(change, saddle):
    branch = softening("shooting", **change)
    assert "equilibrium" in branch.ended.sentence
    assert branch.points[-1].energy == pytest.approx(saddle, rel=1e-6)
    assert max(p.residual for p in branch.points) < 1e-8
