"""Special points between two points of a branch: folds, changes of stability, grazing; located, not interpolated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

from vipetsc.modes.continuation import chart_at, null_vector, unit
from vipetsc.modes.point import Point
from vipetsc.modes.shooting import Corrector

Test = Callable[[Point], float]


@dataclass(frozen=True)
class SpecialPoint:
    """A kind of special point: where ``test`` changes sign by more than ``floor`` on both sides."""

    kind: str
    test: Test
    floor: float = 0.0


def kinds(corrector: Corrector) -> list[SpecialPoint]:
    """What can happen on a branch of a problem; a half-trace has one meaning for every map (see ``Stability``).

    Half-traces of one system cross +-1 tangentially along narrow tongues, to rounding; crossings below 1e-6
    are not told from those.
    """
    quarter = corrector.problem.map.start != corrector.problem.map.end
    found = [
        SpecialPoint("fold-energy", lambda p: p.rise),
        SpecialPoint("fold-frequency", lambda p: p.tangent[-1] / p.period),
    ]
    levels = {1.0: "branch-point", -1.0: "symmetry-breaking" if quarter else "period-doubling"}
    if quarter:
        levels[0.0] = "period-doubling"
    for level, kind in levels.items():
        for i in range(corrector.problem.system.dofs - 1):
            found.append(SpecialPoint(kind, lambda p, i=i, level=level: float(np.real(p.half_traces[i])) - level, 1e-6))
    return found


class Locator:
    """Finds the special points inside one step of a branch.

    Parameters
    ----------
    corrector
        Solver and problem.
    chart
        Name of the chart, as in ``StepControl``.
    grazing
        Also locate every change of the number of contacts, by bisection (some 40 corrections each).
    """

    def __init__(self, corrector: Corrector, chart: str = "relative", grazing: bool = False) -> None:
        self.corrector, self.chart_name, self.grazing = corrector, chart, grazing
        self.kinds = kinds(corrector)

    def between(self, left: Point, right: Point) -> list[Point]:
        """Special points between two consecutive points, in order; their ``index`` is the right one's.

        An energy fold always has a half-trace of 1 and is not reported as a branch point too.
        """
        found: list[tuple[float, Point]] = []
        segment = Segment(self.corrector, self.chart_name, left, right)
        smooth = len(self.corrector.problem.system.springs) > 0
        touching = sum(p.episodes > 0 for p in (left, right))
        for special in self.kinds:
            if not smooth and touching < (2 if special.kind.startswith("fold") else 1):
                continue  # a linear branch has folds of rounding only
            a, b = special.test(left), special.test(right)
            if not (a * b < 0 and min(abs(a), abs(b)) > special.floor):
                continue
            if special.kind == "branch-point" and any(p.kind == "fold-energy" for _, p in found):
                continue
            point = segment.root(special.test, a)
            if point is not None:
                found.append((segment.place, replace(point, kind=special.kind)))
        if self.grazing and left.episodes != right.episodes:
            point = segment.root(lambda p: 1.0 if p.episodes == right.episodes else -1.0, -1.0, 1e-11)
            if point is not None:
                found.append((segment.place, replace(point, kind="grazing")))
        return [point for _, point in sorted(found, key=lambda pair: pair[0])]


class Segment:
    """The branch between two points, parametrised by arclength along the left point's tangent.

    ``place`` is the arclength of the last root found.
    """

    def __init__(self, corrector: Corrector, chart: str, left: Point, right: Point) -> None:
        self.corrector, self.left, self.right = corrector, left, right
        self.chart = chart_at(corrector.problem, chart, left)
        self.xi = self.chart.encode(left.x, left.period)
        self.tangent = unit(np.linalg.solve(self.chart.derivative(self.xi), left.tangent))
        self.chord = self.chart.encode(right.x, right.period) - self.xi
        self.length = float(self.tangent @ self.chord)
        self.place = 0.0

    def at(self, place: float) -> Point:
        """The point at arclength ``place``; raises ArithmeticError if the corrector fails there."""
        share = place / self.length
        # a parabola through both points, tangent at the left one
        guess = self.xi + place * self.tangent + share**2 * (self.chord - self.length * self.tangent)
        attempt = self.corrector.solve(self.chart, guess, self.tangent, self.tangent @ self.xi + place)
        if not attempt.converged:
            raise ArithmeticError(attempt.reason)
        direction = null_vector(self.corrector.matrix(attempt.xi)[:-1])
        if direction @ self.tangent < 0:
            direction = -direction
        tangent = self.chart.derivative(attempt.xi) @ direction
        return Point.of(
            self.corrector.problem, attempt, self.chart, tangent=tangent, index=self.right.index, step=place
        )

    def root(self, test: Test, at_left: float, accuracy: float = 1e-14) -> Point | None:
        """The point where ``test`` vanishes, to ``accuracy`` of the step; None if the corrector fails on the way."""

        def value(place: float) -> float:
            if place == 0:
                return at_left
            return test(self.right) if place == self.length else test(self.at(place))

        try:
            self.place = brentq(value, 0.0, self.length, xtol=accuracy * self.length, rtol=1e-14)
            return self.at(self.place)
        except (ArithmeticError, ValueError):
            return None
