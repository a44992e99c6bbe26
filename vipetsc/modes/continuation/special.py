"""Special points between two points of a branch, located and not interpolated, and the branches that cross there."""

import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial

import numpy as np
from scipy.optimize import brentq

from vipetsc.modes.continuation.arclength import Frame, unit
from vipetsc.modes.continuation.graze import graze
from vipetsc.modes.point import Point, repetitions, resonance
from vipetsc.modes.problem import ContinuationError
from vipetsc.modes.shooting.shooting import MAPS, Relative, Shooting

Test = Callable[[Point], float]
Knot = tuple[np.ndarray, np.ndarray]  # the unknowns of a branch and their slope at an arclength
# A point of a segment is nearer to where it was sought than this share of its length.
FURTHEST = 0.5
# Rounding keeps Newton's method from the tolerance near the tips of narrow tongues; so many times of it is enough here.
ROUNDING = 10
# Attempts at a point that Newton's method does not reach, each in half of the segment before, and where to halve it.
HALVINGS = 5
MIDDLES = np.array([0.5, 0.25, 0.75, 0.125, 0.875])
# Parts of the first step along a crossing branch that are tried; how many of them Newton's method may add, since the
# branch leaves at an angle (up to 5 on the paper's branches, beyond 100 on others); the loosest tolerance there.
AMPLITUDES, ASTRAY, LOOSEST = np.array([1.0, 0.1, 0.01, 0.001]), 20.0, 1e-9
# A turn is looked at if its value is estimated below this share of those beside it.
NEAR = 0.5


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
        for i in range(problem.system.dofs - 1 if problem.dense else 0):
            yield kind, crossing(level, i), 1e-6


def locate(
    problem: Shooting,
    left: Point,
    right: Point,
    chart: str = "relative",
    grazing: bool = False,
    before: Point | None = None,
    missed: list[str] | None = None,
) -> list[Point]:
    """Special points between two consecutive points of a branch, in order; their ``index`` is the right one's.

    ``chart`` as for ``Continuation``; with ``grazing`` also every change of the number of contacts, by bisection (40
    corrections or so). With the point ``before`` the left one, two special points of a kind are found within a step as
    well. An energy fold always has a half-trace of 1 and is not reported as a branch point too; it begins or ends the
    tongue of a ``resonance``. What cannot be located is appended to ``missed`` in a sentence.
    """
    points, segment = list[Point](), Segment(problem, chart, left, right)
    touching = sum(p.episodes > 0 for p in (left, right))
    kinds = list(special_kinds(problem))
    if grazing and left.episodes != right.episodes:
        kinds.append(("grazing", lambda p: 1.0 if p.episodes == right.episodes else -1.0, 0.0))
    for kind, test, floor in kinds:
        if not problem.system.springs and touching < (2 if kind.startswith("fold") else 1):
            continue  # a linear branch has folds of rounding only
        if kind == "branch-point" and any(p.kind == "fold-energy" for p in points):
            continue
        try:
            points += segment.roots(kind, test, floor, before)
        except ArithmeticError as error:
            if missed is not None:
                missed.append(f"a {kind} after point {left.index} (E = {left.energy:.9g} J) is not located: {error}")
    tips = {id(p): resonance(problem, p) for p in points if p.kind == "fold-energy" and problem.dense}
    folds = (replace(p, resonance=tips[id(p)]) if id(p) in tips else p for p in points)
    return sorted(folds, key=lambda p: p.step)


def at_energy(problem: Shooting, left: Point, right: Point, energy: float, chart: str = "relative") -> Point:
    """The orbit of an ``energy`` in J between two consecutive points on both sides of it, of the kind regular.

    Raises ArithmeticError if Newton's method fails.
    """
    return Segment(problem, chart, left, right).root("regular", lambda p: p.energy / energy - 1, HALVINGS)


class Segment:
    """The branch between two points, parametrised by arclength along the left point's tangent.

    ``begin`` is the arclength from the start of the step that the segment is a part of. The unknowns and their slopes
    at arclengths where they are ``known``, the ends at first, give the first guess at others.
    """

    frame_type: Callable[..., Frame] = Frame

    def __init__(self, problem: Shooting, chart: str, left: Point, right: Point, begin: float = 0.0) -> None:
        self.left, self.right, self.begin, self.frame = left, right, begin, self.frame_type(problem, chart, left)
        end = self.frame.chart.encode(right.x, right.period)
        self.length, self.known = float(self.frame.tangent @ (end - self.frame.xi)), dict[float, Knot]()
        self._know(0.0, self.frame.xi, self.frame.tangent)
        self._know(self.length, end, self.frame.direction(right))
        self.make = partial(type(self), problem, chart)

    def _know(self, arclength: float, xi: np.ndarray, direction: np.ndarray) -> None:
        self.known[arclength] = xi, direction / (self.frame.tangent @ direction)

    def _guess(self, arclength: float) -> np.ndarray:
        """The cubic through the nearest known places before and behind."""
        before, behind = max(s for s in self.known if s <= arclength), min(s for s in self.known if s >= arclength)
        (a, slope_a), (b, slope_b), h = self.known[before], self.known[behind], behind - before
        share = (arclength - before) / (h or 1.0)
        bend = 3 * (b - a) - h * (2 * slope_a + slope_b) + share * (2 * (a - b) + h * (slope_a + slope_b))
        return np.asarray(a + share * h * slope_a + share**2 * bend)

    def at(self, arclength: float) -> Point:
        """The point at an arclength; raises ArithmeticError if Newton's method fails there or leaves the step."""
        frame, guess = self.frame, self._guess(arclength)
        attempt = frame.correct(guess, arclength)
        allowed = ROUNDING * frame.problem.tolerance
        if attempt.arc is None or not (attempt.converged or attempt.history[-1] <= allowed):
            raise ArithmeticError(f"{attempt.reason}; residuals {attempt.residuals}")
        if np.linalg.norm(attempt.xi - guess) > FURTHEST * self.length:
            raise ArithmeticError("Newton's method leaves the step")
        point, direction = frame.point(attempt, self.right.index, arclength)
        self._know(arclength, attempt.xi, direction)
        return point

    def roots(self, kind: str, test: Test, floor: float, before: Point | None) -> list[Point]:
        """Points where ``test`` vanishes: one between values of two signs beyond ``floor``, or two around a turn."""
        a, b = test(self.left), test(self.right)
        if min(abs(a), abs(b)) <= floor:
            return []
        if a * b < 0:
            return [self.root(kind, test, HALVINGS)]
        if before is None or not self.left.step:
            return []
        turn, parts = _turn((-self.left.step, test(before)), (0.0, a), (self.length, b)), tuple[Segment, ...]()
        with suppress(ArithmeticError):  # whether there are two is not known
            parts = self.split(turn) if turn else ()
        return [part.root(kind, test, HALVINGS) for part in parts if test(part.left) * test(part.right) < 0]

    def root(self, kind: str, test: Test, halvings: int) -> Point:
        """The point where ``test`` vanishes; in the half with it if Newton's method fails on the way.

        Raises ArithmeticError if that does not help ``halvings`` times.
        """
        sys.audit("vipetsc.landing", kind)

        at = cache(self.at)  # the root is one of the places where a value was asked for

        def value(arclength: float) -> float:
            if arclength == 0:
                return test(self.left)
            return test(self.right) if arclength == self.length else test(at(arclength))

        try:
            if kind == "grazing" and halvings:
                arclength = self.touch()
            else:
                arclength = brentq(value, 0.0, self.length, xtol=1e-12 * self.length, rtol=1e-14)
            point = at(arclength)
            if kind == "grazing":  # what just touches is not counted
                point = replace(point, episodes=min(self.left.episodes, self.right.episodes))
            return replace(point, kind=kind, step=self.begin + point.step)
        except (ArithmeticError, ValueError) as error:
            if halvings == 0:
                raise ArithmeticError(error) from error
        first, second = self.split()
        return (first if test(first.left) * test(first.right) < 0 else second).root(kind, test, halvings - 1)

    def touch(self) -> float:
        """The arclength where a contact grazes; raises ArithmeticError if none does within the segment."""
        frame, touching = self.frame, max(self.left, self.right, key=lambda p: p.episodes)
        xi = graze(frame, self._guess(0.5 * self.length), touching)
        arclength = float(frame.tangent @ (xi - frame.xi))
        if not 0 < arclength < self.length:
            raise ArithmeticError("the touch lies outside of the step")
        return arclength

    def split(self, arclength: float | None = None) -> "tuple[Segment, Segment]":
        """The parts before and behind an arclength, or about the middle; raises ArithmeticError if there is none."""
        for place in (arclength,) if arclength else self.length * MIDDLES:
            with suppress(ArithmeticError):
                middle = self.at(place)
                return self.make(self.left, middle, self.begin), self.make(middle, self.right, self.begin + place)
        raise ArithmeticError("Newton's method fails within the step")


def _turn(*values: tuple[float, float]) -> float | None:
    """Where a value turns between the last two of three places, if it may cross zero there, by a parabola."""
    (x0, z), (x1, a), (x2, b) = values
    bend = ((b - a) / (x2 - x1) - (z - a) / (x0 - x1)) / (x2 - x0)
    slope = (b - a) / (x2 - x1) - bend * (x2 - x1)
    at = -slope / (2 * bend) if bend else x1
    top = a + slope * at / 2
    return at if x1 < at < x2 and top * np.sign(a) < NEAR * min(abs(a), abs(b)) else None


def switch(old: Shooting, point: Point, amplitude: float = 1e-3) -> tuple[Shooting, Point]:
    """The problem and a first point, with its tangent, on the branch that crosses at a special ``point``.

    The new orbits have less symmetry: they are shot over half a period, from rest to rest or from centre to
    centre, whichever map has a second null direction at ``point``; over the doubled period at a period doubling.
    ``amplitude`` is the first step along the new direction, relative to the orbit's size; where Newton's method goes
    astray, parts of it are tried. The tolerance is what the map's rounding at the special point allows. Raises
    ContinuationError if no map has a second null direction, or no orbit off the old branch is found.
    """
    singular = []
    for name in ("quarter", "half", "half-centre") if old.map.quarter else (old.map.name,):
        problem = Shooting(old.flow, MAPS[name], old.tolerance)
        x, period = _re_expressed(old, point, problem)
        chart = Relative(problem.system, x, period, rest=problem.map.start == "rest")
        xi = chart.encode(x, period)
        arc = problem.arc(x, period)
        rounding = float(np.abs(problem.residual(arc)).max() / chart.size)
        if rounding > 1e-6:
            continue  # not an orbit of this map: the doubled period's quarter
        problem.tolerance = max(old.tolerance, min(10 * rounding, LOOSEST))
        matrix = problem.jacobian(arc) @ chart.derivative(xi) / chart.size
        values, directions = np.linalg.svd(matrix)[1:]
        singular.append(f"{name} {values[-1] / values[0]:.1e}")
        if values[-1] > 1e-5 * values[0]:
            continue
        x, period = point.x + 1e-6 * point.tangent[:-1], point.period + 1e-6 * point.tangent[-1]
        along = chart.encode(*_re_expressed(old, replace(point, x=x, period=period), problem)) - xi
        first, second = directions[-2:] @ (directions[-2:].T @ directions[-2:] @ along)
        row = unit(directions[-2:].T @ np.array([-second, first]))  # across the old branch in the null plane
        for step in amplitude * AMPLITUDES:
            attempt = problem.solve(chart, xi + step * row, row, row @ xi + step)
            astray = float(np.linalg.norm(attempt.xi - xi - step * row)) > ASTRAY * step
            if attempt.converged and not astray:
                first = Point.of(problem, attempt, chart, problem.tangent(attempt.xi, row))
                if repetitions(problem, first) == 1:
                    return problem, first
        why = f"the last attempt, at {step:g}: {attempt.reason}; residuals {attempt.residuals}"
        knobs = f"raise nnm.tolerance (it was {problem.tolerance:.1g}), or change nnm.switch_amplitude"
        raise ContinuationError(f"no orbit off the old branch is found at E = {point.energy:.9g} J ({why}): {knobs}")
    where = f"at E = {point.energy:.9g} J, f = {point.frequency:.9g} Hz"
    raise ContinuationError(f"no branch crosses {where}: smallest singular values {', '.join(singular)}")


def _re_expressed(old: Shooting, point: Point, new: Shooting) -> tuple[np.ndarray, float]:
    """Initial values and period of a special point's orbit for another map; the period is doubled where it doubles."""
    period = (2 if point.kind == "period-doubling" else 1) * point.period
    if old.map.start == new.map.start:
        return point.x, period
    return old.arc(point.x, point.period).end[old.system.dofs :], period  # the centre of a quarter-period orbit
