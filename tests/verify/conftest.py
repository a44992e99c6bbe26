"""Branches of the paper's reduced model that several modules read, each followed once."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest

from tests.models import IN_PHASE, OUT_OF_PHASE, reduced_model
from vipetsc.case.nnm import NnmTable
from vipetsc.modes.continuation.arclength import Continuation, locate
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.point import Point
from vipetsc.modes.shooting import Shooting, linear_start
from vipetsc.modes.system import System


class Branch(NamedTuple):
    """A branch as it was followed: its problem, its points in order, and its special points."""

    problem: Shooting
    points: list[Point]
    special: list[Point]

    def of_kind(self, kind: str) -> list[Point]:
        """The special points of one ``kind``."""
        return [point for point in self.special if point.kind == kind]

    def at_energy(self, energy: float) -> Point:
        """The orbit of an ``energy`` (J), corrected by Newton's method.

        Where a branch passes the energy several times, the last passage at which the energy grows is taken.
        """
        point = None
        for a, b in pairwise(self.points):
            if a.energy <= energy < b.energy:
                point = a
        assert point is not None

        # Newton's method in the energy along the branch.
        for _ in range(8):
            length = (energy - point.energy) / point.energy_tangent
            frame = self.problem.frame(point, "relative")
            guess = frame.xi + length * frame.direction(point)
            attempt = frame.solve(guess, frame.tangent, frame.tangent @ guess)
            assert attempt.converged, attempt.history
            # The tangent spans the null space of the Jacobian.
            tangent = np.linalg.svd(frame.jacobian(attempt.xi))[2][-1]
            point = frame.measures(attempt, tangent)

        assert point.energy == pytest.approx(energy, rel=1e-12)
        return point


def follow(system: System, mode: int, start: float, **control) -> Branch:
    """Follow a linear ``mode`` from the energy ``start`` (J) by quarter-period maps; ``control`` is the table [nnm]."""
    problem = Shooting(Dop853Flow(system), MAPS["quarter"])
    first = linear_start(problem, mode, start)
    continuation = Continuation(problem, first, NnmTable(**{"points": 20000} | control))
    chart = control.get("chart", "relative")

    # The continuation does not yield its start.
    points = [continuation.point]
    special = []
    for point in continuation:
        special += locate(problem, points[-1], point, chart, grazing=True)
        points.append(point)
    return Branch(problem, points, special)


@pytest.fixture(scope="session")
def bilinear() -> Branch:
    """The out-of-phase branch of linear stops over thirteen decades of energy."""
    return follow(reduced_model("bilinear"), OUT_OF_PHASE, 3e-4, energy=[1e-4, 1e9], chart="auto")


@pytest.fixture(scope="session")
def hertz() -> Branch:
    """The out-of-phase branch of Hertz contacts over thirteen decades of energy."""
    return follow(reduced_model("hertz"), OUT_OF_PHASE, 3e-4, energy=[1e-4, 1e9], chart="auto")


@pytest.fixture(scope="session")
def in_phase() -> Branch:
    """The in-phase branch of linear stops from the linear mode past the 7:1 tongue, without special points."""
    problem = Shooting(Dop853Flow(reduced_model("bilinear")), MAPS["quarter"])
    start = linear_start(problem, IN_PHASE, 1e-3)
    continuation = Continuation(problem, start, NnmTable(energy=[0.0, 25.0], points=20000))

    points = [continuation.point, *continuation]

    assert continuation.finished
    return Branch(problem, points, [])


@pytest.fixture(scope="session")
def short_branch() -> Branch:
    """The out-of-phase branch of linear stops from the linear mode over both energy folds, without special points."""
    problem = Shooting(Dop853Flow(reduced_model("bilinear")), MAPS["quarter"])
    start = linear_start(problem, OUT_OF_PHASE, 0.02)
    continuation = Continuation(problem, start, NnmTable(points=400, energy=[0.0, 1e4]))

    points = [continuation.point, *continuation]

    assert continuation.finished
    return Branch(problem, points, [])
