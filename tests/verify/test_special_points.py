"""Special points of a branch: energy folds, two of a kind in a step, roots that are hard to find, period doublings."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from tests.models import reduced_model
from vipetsc.modes.continuation.arclength import Segment, locate
from vipetsc.modes.continuation.switching import switch
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.point import Point
from vipetsc.modes.problem import NoMotionError
from vipetsc.modes.shooting import Shooting, repetitions


def of_kind(kind: str, points: Iterable[Point]) -> list[Point]:
    """Return the points of one kind."""
    return [point for point in points if point.kind == kind]


def folding_steps(points: list[Point]) -> list[tuple[Point, Point]]:
    """Return the steps in contact over which the energy turns."""
    steps = itertools.pairwise(points)
    return [(a, b) for a, b in steps if a.energy_tangent * b.energy_tangent < 0 and a.episodes > 0]


@pytest.mark.parametrize("sign", [1, -1])
def test_energy_folds_are_where_the_energy_turns(short_branch, sign):
    """Two folds are found in both directions along a branch, where the energy is stationary and a half-trace is 1."""
    problem = short_branch.problem
    points = [
        replace(point, tangent=sign * point.tangent, energy_tangent=sign * point.energy_tangent)
        for point in short_branch.points[::sign]
    ]

    turning = folding_steps(points)
    assert len(turning) == 2
    for a, b in turning:
        (fold,) = of_kind("fold-energy", locate(problem, a, b))
        assert abs(fold.energy_tangent) <= 1e-9 * abs(a.energy_tangent)
        assert fold.half_traces[0] == pytest.approx(1, abs=1e-6)

    # No fold is found far from these two.
    for a, b in itertools.pairwise(points[-20:]):
        assert not of_kind("fold-energy", locate(problem, a, b))


class RoundedPoint(NamedTuple):
    """A point of a branch in few digits: displacements in m, period in s, and the arclength of the step to it."""

    x: list[float]
    period: float
    step: float

    def on_branch(self, problem: Shooting) -> Point:
        """Return the point of the branch nearby, with falling period along its tangent."""
        frame = problem.relative_frame(np.array(self.x), self.period)
        tangent = np.linalg.svd(frame.jacobian(frame.xi))[2][-1]
        attempt = frame.solve(frame.xi, tangent, tangent @ frame.xi)
        assert attempt.converged
        return replace(frame.measures(attempt, -tangent * np.sign(tangent[-1])), step=self.step)


# Three successive points of the in-phase Hertz branch for each kind, near 1.0e6 J for the first and 1.7e7 J for the
# second.
PAIRS = {
    "symmetry-breaking": [
        RoundedPoint([-9.151145747905344, -9.226299568925315], 0.003148020146748403, 0.0986),
        RoundedPoint([-9.869904521950374, -9.949778169710124], 0.0031478468939554415, 0.1),
        RoundedPoint([-10.564752182727462, -10.650004848960046], 0.0031476911959756027, 0.0969),
    ],
    "fold-energy": [
        RoundedPoint([-41.58157519928831, -41.827813151364275], 0.003145313850191308, 0.0109),
        RoundedPoint([-41.592476734313195, -41.841905100306086], 0.003145304127065715, 0.013),
        RoundedPoint([-41.58941483494171, -41.843776559314165], 0.0031452884555063713, 0.0198),
    ],
}


@pytest.mark.parametrize("kind", PAIRS)
def test_two_special_points_within_a_step_are_found(kind):
    """Two special points within one step are found by means of the step before.

    Their test function passes zero twice, and has the same sign at both ends of the step.
    """
    problem = Shooting(Dop853Flow(reduced_model("hertz")), MAPS["quarter"])
    before, left, right = (rounded.on_branch(problem) for rounded in PAIRS[kind])

    pair = of_kind(kind, locate(problem, left, right, before=before))

    assert len(pair) == 2
    assert 0 < pair[0].step < pair[1].step < right.step
    for point in pair:
        residuals = {"symmetry-breaking": point.half_traces[0] + 1, "fold-energy": point.energy_tangent / point.energy}
        assert abs(residuals[kind]) <= 1e-8

    # Without the point before, the turn of the test function is not seen.
    assert not of_kind(kind, locate(problem, left, right))


def test_a_root_that_is_never_found_is_reported(short_branch, monkeypatch):
    """A fold between two points that cannot be located is named with the point before it and its energy."""
    a, b = folding_steps(short_branch.points)[0]
    missed = []

    def fails(self, arclength):
        raise NoMotionError("never")

    monkeypatch.setattr(Segment, "at", fails)
    assert not locate(short_branch.problem, a, b, missed=missed)

    assert missed[0].startswith(f"a fold-energy after point {a.index} (E = {a.energy:.9g} J) is not located")


def first_doubling(problem: Shooting, points: list[Point]) -> Point:
    """Return the first period doubling in contact near the grazing energy, 0.02934 J."""
    for a, b in itertools.pairwise(points):
        if a.energy < 0.02935 and b.episodes:
            doublings = of_kind("period-doubling", locate(problem, a, b))
            if doublings:
                return doublings[0]
    pytest.fail("the branch has no period doubling near grazing")


def test_a_period_doubled_orbit_is_off_its_parent(short_branch):
    """The switch at a period doubling ends on an orbit of the doubled period, not on the parent passed twice.

    Near grazing the first attempt ends on the linear mode passed twice, and the switch tries a smaller amplitude.
    """
    problem = short_branch.problem
    point = first_doubling(problem, short_branch.points)

    doubled_problem, first = switch(problem, point)

    assert repetitions(doubled_problem, first) == 1
    assert first.energy == pytest.approx(point.energy, rel=1e-3)
    assert first.period == pytest.approx(2 * point.period, rel=1e-3)
    # The doubled period passes the parent twice.
    parent = replace(first, x=point.x, period=2 * point.period)
    assert repetitions(doubled_problem, parent) == 2
