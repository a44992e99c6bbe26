"""The branch between two of its points, on which special points are located.

A special point is not interpolated between the two: it is a point of the branch itself. At each arclength s that the
search for a zero of a test function asks for, Newton's method solves H(xi) = 0 and t . (xi - xi_left) = s, with the
left point's unknowns and unit tangent t. The first guess is a cubic through neighbouring points.
"""

import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from typing import Generic, NamedTuple

import numpy as np
from scipy.optimize import brentq

from vipetsc.modes.problem import NoMotionError, PeriodicProblem, S, SpecialKind

# A solution farther from its first guess than this fraction of the segment's length is taken to lie on another arc. The
# guess is a cubic between two knots, which misses a circular arc that turns by 0.2 rad, the default guard, by 7e-5 of
# its length, and one that turns by 0.8 rad by 0.01.
FURTHEST = 0.5
# Near the tips of narrow tongues rounding keeps Newton's method from reaching the tolerance. A residual of this many
# times the tolerance is accepted for a special point.
ROUNDING = 10
# How often a segment is halved to find a special point that Newton's method does not reach. On the paper's three
# branches, of which the in-phase one has 250 special points, neither this nor ROUNDING acts: both are a margin.
HALVINGS = 5
# Fractions of its length at which a segment may be cut in two; the first one at which Newton's method converges counts.
MIDDLES = np.array([0.5, 0.25, 0.75, 0.125, 0.875])
# Where a test turns back between two points, its extreme value is estimated by a parabola. Two zeros are looked for if
# the estimate is beyond zero or below this fraction of the smaller value at the ends: the parabola may be wrong by as
# much.
NEAR = 0.5
# A special point is sought to this fraction of the segment's length: values of its test have errors of 1e-11.
EXACT = 1e-10


class Knot(NamedTuple):
    """Unknowns ``xi`` (n + 1,) of a branch at an arclength s, and their ``slope`` dxi/ds (n + 1,) there."""

    xi: np.ndarray
    slope: np.ndarray


class Segment(Generic[S]):
    """The branch between two points, parametrised by the arclength s = t . (xi - xi_left), t the left point's tangent.

    ``length`` is the arclength of the right point. ``begin`` is the arclength from the start of the step that the
    segment is a part of. ``knots`` are the unknowns and their slopes at the arclengths found so far, the ends at first:
    they give the first guess at others.
    """

    def __init__(self, problem: PeriodicProblem[S], chart: str, left: S, right: S, begin: float = 0.0) -> None:
        self.problem = problem
        self.left = left
        self.right = right
        self.begin = begin
        self.frame = problem.frame(left, chart)
        self.between = partial(type(self), problem, chart)

        end = self.frame.encode(right)
        self.length = float(self.frame.tangent @ (end - self.frame.xi))
        self.knots: dict[float, Knot] = {}
        self._add_knot(0.0, self.frame.xi, self.frame.tangent)
        self._add_knot(self.length, end, self.frame.direction(right))

    def _add_knot(self, arclength: float, xi: np.ndarray, direction: np.ndarray) -> None:
        """Keep the unknowns ``xi`` (n + 1,) and the branch's ``direction`` (n + 1,), of any length, at an arclength."""
        # s is measured along t, so that t . dxi/ds = 1.
        self.knots[arclength] = Knot(xi, direction / (self.frame.tangent @ direction))

    def _guess(self, arclength: float) -> np.ndarray:
        """The unknowns at an arclength of Hermite's cubic through the nearest knots before and after it."""
        before = max(s for s in self.knots if s <= arclength)
        after = min(s for s in self.knots if s >= arclength)
        a, slope_a = self.knots[before]
        b, slope_b = self.knots[after]
        h = after - before
        # At a knot itself h is 0, and the cubic is that knot.
        s = (arclength - before) / (h or 1.0)
        bend = 3 * (b - a) - h * (2 * slope_a + slope_b) + s * (2 * (a - b) + h * (slope_a + slope_b))
        return np.asarray(a + s * h * slope_a + s**2 * bend)

    def at(self, arclength: float) -> S:
        """The point at an arclength; raises NoMotionError if Newton's method fails there or leaves the step."""
        guess = self._guess(arclength)
        attempt = self.frame.correct(guess, arclength)
        allowed = ROUNDING * self.problem.tolerance
        if attempt.left_domain or not (attempt.converged or attempt.history[-1] <= allowed):
            raise NoMotionError(f"{attempt.reason}; residuals {attempt.residuals}")
        # A solution far from the guess lies on another arc.
        if np.linalg.norm(attempt.xi - guess) > FURTHEST * self.length:
            raise NoMotionError("Newton's method leaves the step")

        try:
            direction = self.frame.tangent_at(attempt.xi)
        except np.linalg.LinAlgError as error:
            raise NoMotionError(f"no unique tangent: {error}") from None
        point = self.frame.measures(attempt, direction)
        self._add_knot(arclength, attempt.xi, direction)
        return replace(point, index=self.right.index, step=arclength)

    def roots(self, kind: SpecialKind[S], before: S | None) -> list[S]:
        """Points of a kind, where its test vanishes and that the kind accepts.

        There is one if the test has two signs at the ends. If it has one sign but turns back between them, as the point
        ``before`` the left one shows, there may be two, one on each side of the turn. Raises NoMotionError where a
        zero between two signs is not found.
        """
        points = self._zeros(kind, before)
        if kind.accept is None:
            return points
        return [point for point in points if kind.accept(point)]

    def _zeros(self, kind: SpecialKind[S], before: S | None) -> list[S]:
        """The points where the kind's test vanishes."""
        a = kind.test(self.left)
        b = kind.test(self.right)
        # A value within the floor of zero has no sign to go by. Where a point of the branch is that near to a special
        # one, the points on either side of it tell: it is found with the second of these.
        if abs(b) <= kind.floor:
            return []
        if abs(a) <= kind.floor:
            return self._zero_beside_left(kind, before)
        if a * b < 0:
            return [self.root(kind)]
        # The first point of a branch has no step, and neither have points of files of earlier versions.
        if before is None or not self.left.step:
            return []

        turn = _turn((-self.left.step, kind.test(before)), (0.0, a), (self.length, b))
        if turn is None:
            return []
        parts: tuple[Segment[S], ...] = ()
        # The parabola only suggests two zeros. Where no point of the branch is found at the turn, none need be missed.
        with suppress(NoMotionError):
            parts = self.split(turn)
        return [part.root(kind) for part in parts if kind.test(part.left) * kind.test(part.right) < 0]

    def _zero_beside_left(self, kind: SpecialKind[S], before: S | None) -> list[S]:
        """The zero next to the left point, whose value is within the floor, if those on its two sides differ in sign.

        It lies in this segment or in the one from the point ``before``, as the left point's own sign says.
        """
        if before is None:
            return []
        value_before = kind.test(before)
        right = kind.test(self.right)
        if abs(value_before) <= kind.floor or value_before * right > 0:
            return []
        if kind.test(self.left) * right <= 0:
            return [self.root(kind)]
        point = self.between(before, self.left).root(kind)
        return [replace(point, index=self.right.index, step=0.0)]

    def root(self, kind: SpecialKind[S], halvings: int = HALVINGS) -> S:
        """The point where the kind's test, of two signs at the ends, vanishes.

        Where Newton's method fails, the search is repeated in the half of the segment that has the zero. Raises
        NoMotionError if it fails after ``halvings`` halvings as well.
        """
        # So that the command line can report what a run is doing (``cli.messages``).
        sys.audit("vipetsc.landing", kind.name)
        try:
            point = self._find(kind)
            if kind.finish is not None:
                point = kind.finish(point, self.left, self.right)
            return replace(point, kind=kind.name, step=self.begin + point.step)
        except NoMotionError as error:
            if halvings == 0:
                raise NoMotionError(error) from error

        # Nearer ends give better guesses, and a Newton step that left the segment may stay in its half.
        first, second = self.split()
        if kind.test(first.left) * kind.test(first.right) < 0:
            return first.root(kind, halvings=halvings - 1)
        return second.root(kind, halvings=halvings - 1)

    def _find(self, kind: SpecialKind[S]) -> S:
        """The point where a test of two signs at the ends vanishes, by Brent's method."""
        # The root is one of the arclengths at which a value was asked for: its point is not computed twice.
        at = cache(self.at)
        value = partial(self._value, kind.test, at)
        return at(float(brentq(value, 0.0, self.length, xtol=EXACT * self.length)))

    def _value(self, test: Callable[[S], float], at: Callable[[float], S], arclength: float) -> float:
        """The value of a test at an arclength; at the ends it is that of their points, which need no correction."""
        if arclength == 0:
            return test(self.left)
        if arclength == self.length:
            return test(self.right)
        return test(at(arclength))

    def split(self, arclength: float | None = None) -> "tuple[Segment[S], Segment[S]]":
        """The parts before and after an arclength, or about the middle; raises NoMotionError if there is none."""
        places = self.length * MIDDLES
        if arclength is not None:
            places = np.array([arclength])
        for place in places.tolist():
            with suppress(NoMotionError):
                middle = self.at(place)
                return self.between(self.left, middle, self.begin), self.between(middle, self.right, self.begin + place)
        raise NoMotionError("Newton's method fails within the step")


def _turn(*values: tuple[float, float]) -> float | None:
    """Place between the last two of three places x0 < x1 = 0 < x2 where a value turns back, if it may cross zero there.

    ``values`` are pairs of a place and the value there. The parabola through them, a + slope x + bend x^2, has its
    extreme a + slope at/2 at the place at = -slope/(2 bend). None if that lies elsewhere, or the extreme is not near
    zero.
    """
    (x0, z), (x1, a), (x2, b) = values
    bend = ((b - a) / (x2 - x1) - (z - a) / (x0 - x1)) / (x2 - x0)
    slope = (b - a) / (x2 - x1) - bend * (x2 - x1)
    if bend == 0:
        return None
    at = -slope / (2 * bend)
    top = a + slope * at / 2
    if x1 < at < x2 and top * np.sign(a) < NEAR * min(abs(a), abs(b)):
        return at
    return None
