"""Special points between two points of a branch, located and not interpolated, and the branches that cross there."""

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq

from vipetsc.modes.continuation import ContinuationError, Frame, unit
from vipetsc.modes.point import Point, resonance
from vipetsc.modes.shooting import MAPS, Relative, Shooting

Test = Callable[[Point], float]


def special_kinds(problem: Shooting) -> Iterator[tuple[str, Test, float]]:
    """What can happen on a branch: its kind, a test that changes sign there, by more than a floor on both sides.

    A half-trace of 1 is a branch point (or a fold) that keeps the map's symmetry; -1 breaks it (quarter period) or
    doubles the period (the others); 0 doubles the period of quarter-period orbits. Half-traces of one system cross
    +-1 tangentially along narrow tongues, to rounding; crossings below 1e-6 are not told from those.
    """

    def crossing(level: float, i: int) -> Test:
        return lambda p: float(np.real(p.half_traces[i])) - level

    yield "fold-energy", lambda p: p.energy_tangent, 0.0
    yield "fold-frequency", lambda p: float(p.tangent[-1] / p.period), 0.0
    levels = {1.0: "branch-point", -1.0: "symmetry-breaking" if problem.map.quarter else "period-doubling"}
    if problem.map.quarter:
        levels[0.0] = "period-doubling"
    for level, kind in levels.items():
        for i in range(problem.system.dofs - 1):
            yield kind, crossing(level, i), 1e-6


def locate(problem: Shooting, left: Point, right: Point, chart: str = "relative", grazing: bool = False) -> list[Point]:
    """Special points between two consecutive points of a branch, in order; their ``index`` is the right one's.

    ``chart`` as for ``Continuation``; with ``grazing`` also every change of the number of contacts, by bisection (40
    corrections or so). An energy fold always has a half-trace of 1 and is not reported as a branch point too; it begins
    or ends the tongue of a ``resonance``.
    """
    points, segment = list[Point](), _Segment(problem, chart, left, right)
    touching = sum(p.episodes > 0 for p in (left, right))
    for kind, test, floor in special_kinds(problem):
        if not problem.system.springs and touching < (2 if kind.startswith("fold") else 1):
            continue  # a linear branch has folds of rounding only
        a, b = test(left), test(right)
        folded = kind == "branch-point" and any(p.kind == "fold-energy" for p in points)
        if a * b < 0 and min(abs(a), abs(b)) > floor and not folded:
            sys.audit("vipetsc.landing", kind)
            points += segment.root(kind, test)
    if grazing and left.episodes != right.episodes:
        points += segment.root("grazing", lambda p: 1.0 if p.episodes == right.episodes else -1.0, 1e-11)
    folds = (replace(p, resonance=resonance(problem, p)) if p.kind == "fold-energy" else p for p in points)
    return sorted(folds, key=lambda p: p.step)


class _Segment:
    """The branch between two points, parametrised by arclength along the left point's tangent."""

    def __init__(self, problem: Shooting, chart: str, left: Point, right: Point) -> None:
        self.left, self.right, self.frame = left, right, Frame(problem, chart, left)
        self.chord = self.frame.chart.encode(right.x, right.period) - self.frame.xi
        self.length = float(self.frame.tangent @ self.chord)

    def at(self, arclength: float) -> Point:
        """The point at an arclength; raises ArithmeticError if Newton's method fails there."""
        frame, share = self.frame, arclength / self.length
        # a parabola through both points, tangent at the left one
        guess = frame.xi + arclength * frame.tangent + share**2 * (self.chord - self.length * frame.tangent)
        attempt = frame.correct(guess, arclength)
        if not attempt.converged:
            raise ArithmeticError(attempt.reason)
        return frame.point(attempt, self.right.index, arclength)[0]

    def root(self, kind: str, test: Test, accuracy: float = 1e-14) -> list[Point]:
        """The point where ``test`` vanishes, to ``accuracy`` of the step; none if Newton's method fails on the way."""

        def value(arclength: float) -> float:
            if arclength == 0:
                return test(self.left)
            return test(self.right) if arclength == self.length else test(self.at(arclength))

        try:
            arclength = brentq(value, 0.0, self.length, xtol=accuracy * self.length, rtol=1e-14)
            return [replace(self.at(arclength), kind=kind)]
        except (ArithmeticError, ValueError):
            return []


def switch(old: Shooting, point: Point, amplitude: float = 1e-3) -> tuple[Shooting, Point]:
    """The problem and a first point, with its tangent, on the branch that crosses at a special ``point``.

    The new orbits have less symmetry: they are shot over half a period, from rest to rest or from centre to
    centre, whichever map has a second null direction at ``point``; over the doubled period at a period doubling.
    ``amplitude`` is the first step along the new direction, relative to the orbit's size. Raises ContinuationError if
    no map has a second null direction, or Newton's method fails.
    """
    singular = []
    for name in ("quarter", "half", "half-centre") if old.map.quarter else (old.map.name,):
        problem = Shooting(old.flow, MAPS[name], old.tolerance)
        x, period = _re_expressed(old, point, problem)
        chart = Relative(problem.system, x, period, rest=problem.map.start == "rest")
        xi = chart.encode(x, period)
        arc = problem.arc(x, period)
        if np.abs(problem.residual(arc)).max() > 1e-6 * chart.size:
            continue  # not an orbit of this map: the doubled period's quarter
        matrix = problem.jacobian(arc) @ chart.derivative(xi) / chart.size
        values, directions = np.linalg.svd(matrix)[1:]
        singular.append(f"{name} {values[-1] / values[0]:.1e}")
        if values[-1] > 1e-5 * values[0]:
            continue
        x, period = point.x + 1e-6 * point.tangent[:-1], point.period + 1e-6 * point.tangent[-1]
        along = chart.encode(*_re_expressed(old, replace(point, x=x, period=period), problem)) - xi
        first, second = directions[-2:] @ (directions[-2:].T @ directions[-2:] @ along)
        row = unit(directions[-2:].T @ np.array([-second, first]))  # across the old branch in the null plane
        attempt = problem.solve(chart, xi + amplitude * row, row, row @ xi + amplitude)
        if not attempt.converged:
            why = f"({attempt.reason}; residuals {attempt.residuals}): lower nnm.switch_amplitude"
            raise ContinuationError(f"no convergence on the crossing branch at E = {point.energy:.9g} J {why}")
        return problem, Point.of(problem, attempt, chart, problem.tangent(attempt.xi, row))
    where = f"at E = {point.energy:.9g} J, f = {point.frequency:.9g} Hz"
    raise ContinuationError(f"no branch crosses {where}: smallest singular values {', '.join(singular)}")


def _re_expressed(old: Shooting, point: Point, new: Shooting) -> tuple[np.ndarray, float]:
    """Initial values and period of a special point's orbit for another map; the period is doubled where it doubles."""
    period = (2 if point.kind == "period-doubling" else 1) * point.period
    if old.map.start == new.map.start:
        return point.x, period
    return old.arc(point.x, point.period).end[old.system.dofs :], period  # the centre of a quarter-period orbit
