"""Curves that leave responses where a symmetry breaks and where a period doubles, against integration in time."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from tests.rigs import after_a_period, period_map
from tests.steady_states import motion_at
from tests.verify.test_special_responses import FLIP, UNEVEN, case_of
from vipetsc.figures.registry import every_branch
from vipetsc.figures.sweep_members import Files
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.response.steady import SteadyStates

pytestmark = pytest.mark.parallel(1)


@pytest.mark.parametrize(
    "changes, kind, multiplier, curves, odd_one",
    [(UNEVEN, "branch-point", 1.0, 2, 0), (FLIP, "period-doubling", -1.0, 2, 1)],
    ids=["symmetry", "period"],
)
def test_the_curve_that_leaves(changes, kind, multiplier, curves, odd_one, tmp_path):
    """It begins where a multiplier is +1 or -1; its motions are periodic, and grow as the root of the distance.

    ``odd_one`` is the harmonic that the first curve lacks. A curve that meets the first one twice is followed once.
    """
    case = case_of(changes, switch=[kind], harmonics=21, points=60)
    followed = follow_all(case, tmp_path, MPI.COMM_SELF)
    assert len(followed) == curves
    trunk, crossing = followed
    assert crossing.name == f"{trunk.name}-{kind}-1"
    with Files() as files:
        # Pictures of all curves name the first one first.
        assert [path.stem for path in every_branch([tmp_path], files)] == [f"branch-{curve.name}" for curve in followed]
    point = next(point for point in trunk.points if point.kind == kind)
    states = SteadyStates(case, 1.0, case.nfrc.fixed[0])
    state = np.ravel(motion_at(states, point.xi, np.arange(2)))
    multipliers = period_map(states, point, state).multipliers
    # With 21 harmonics the motion itself has an error of 1e-3.
    assert np.abs(multipliers - multiplier).min() < 0.03

    # The square of the new harmonic is linear in the frequency, and vanishes at the special point.
    first = crossing.points[:3]
    frequencies = np.array([p.measured.frequency for p in first])
    squares = np.array([abs(p.measured.harmonics[0, odd_one]) ** 2 for p in first])
    line = np.polyfit(squares, frequencies, 1)
    assert line[1] == pytest.approx(point.measured.frequency, abs=2e-4)
    assert abs(frequencies[-1] - line[1]) > 1e-4

    # The file has the case with the harmonics of the crossing curve. Its motions are those of the equations in time.
    stored = read_branch(tmp_path / f"branch-{crossing.name}.h5")
    case = type(case).from_toml(stored.case)
    assert case.nfrc.subharmonic == (2 if kind == "period-doubling" else 1)
    assert case.nfrc.symmetric is False
    states = SteadyStates(case, 1.0, case.nfrc.fixed[0])
    for p in crossing.regular()[4:12:4]:
        state = np.ravel(motion_at(states, p.xi, np.arange(2)))
        after = state
        for _ in range(case.nfrc.subharmonic):
            before = after
            after = after_a_period(states, p, before)
        size = np.abs(state).max()
        assert np.abs(after - state).max() < 0.02 * size
        if kind == "period-doubling":
            assert np.abs(before - state).max() > 0.05 * size
