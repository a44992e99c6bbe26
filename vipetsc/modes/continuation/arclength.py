"""Pseudo-arclength continuation: one branch of solutions, step by step, with the special points between its points.

A method (``modes.problem.PeriodicProblem``) has n equations H = 0 in n + 1 unknowns, whose solutions form a curve, a
branch. At the last point it gives a *frame*: a *chart*, which scales the unknowns to order one, the unknowns ``xi``
(n + 1,) of that point, and the unit tangent t of the branch there, the null vector of dH/dxi. A step of the arclength s
predicts xi + s t, and Newton's method corrects the prediction to the solution xi_new of

    H(xi_new) = 0,    t . (xi_new - xi) = s,

so that the correction is orthogonal to the tangent (Keller 1977, reference in ``modes``). The arclength is in the units
of the chart. The frame's ``measures`` turn a solution into a point of the branch with its energy, frequency and so on.

**Steps.** ``Continuation`` is an iterator over points; the caller owns the loop. A *step rule* decides what follows
after each attempt. ``GuardedSteps`` is the rule for normal modes, by the section [nnm] of a case file; other kinds of
branches bring their own.

**Guards** bound what may change from one point to the next, by which jumps to another arc are noticed: the points of
both arcs satisfy the equations to rounding, so that residuals do not distinguish them. Arcs that lie close together, as
in neighbouring tongues of internal resonances, differ in their half-traces c = (mu + 1/mu)/2 of the Floquet multipliers
mu or in their direction. A step in which one of them changes by more than its bound is refused. A jump between arcs
that differ in neither by more is not noticed. The bound on half-traces also keeps steps so short that few special
points are missed. The number of contacts needs no bound: of a step in which several begin or end each is located.

**Special points** are zeros of test functions, found by Brent's method (``locate``): of dE along the tangent at energy
folds, of dT at frequency folds, of what half-traces show elsewhere. They are not interpolated between two points of the
branch, but lie on it: at each arclength s that the search asks for, Newton's method solves H(xi) = 0 and
t . (xi - xi_left) = s, with the left point's unknowns and unit tangent t. The first guess is a cubic through
neighbouring points (``Segment``).
"""

import itertools
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from typing import Any, Generic, NamedTuple, Protocol

import numpy as np
from scipy.optimize import brentq

from vipetsc.case.nnm import NnmTable
from vipetsc.endings import NOT_FINISHED, Ended, Ending
from vipetsc.modes.point import OrbitProblem, Point
from vipetsc.modes.problem import (
    Attempt,
    ContinuationError,
    FlowError,
    Frame,
    NoMotionError,
    PeriodicProblem,
    S,
    SpecialKind,
)

# The change that a guard limits, for messages, and the key with its bound.
GUARDED = {
    "half_trace": ("the half-trace changes too much", "nnm.guards.half_trace"),
    "corrector": ("the corrector moves too far", "nnm.guards.corrector"),
    "turn": ("the branch turns too sharply", "nnm.guards.turn"),
    "turn_relative": ("the branch turns too sharply in the relative chart", "nnm.guards.turn_relative"),
    "truncation": ("the neglected harmonics are too large", "nnm.harmonics or nnm.truncation"),
}
# A change of these within its bound is no reason for a shorter step: such changes do not shrink with the step.
ALL_OR_NOTHING = {"turn_relative", "truncation"}


class GuardedChange(NamedTuple):
    """Largest change in a step over the bound of its ``guard``; 1 is the bound."""

    size: float
    guard: str


def largest_change(
    problem: OrbitProblem, control: NnmTable, before: Point, after: Point, geometry: dict[str, float]
) -> GuardedChange:
    """Return the largest change of a step, from ``before`` to ``after``, over its bound in ``control``.

    ``geometry`` has the fields of ``Geometry``: ``corrector`` and ``turn``. Which other changes are guarded
    ``problem.guards`` says.
    """
    changes = dict(geometry)
    if "half_trace" in problem.guards:
        changes["half_trace"] = half_trace_change(before, after)
    if "turn_relative" in problem.guards:
        changes["turn_relative"] = problem.turn(before, after)
    if "truncation" in problem.guards:
        changes["truncation"] = after.truncation / control.truncation

    worst = GuardedChange(-np.inf, "")
    for guard, change in changes.items():
        # The truncation has been divided by its bound above, which is no key of [nnm.guards]. A bound of 0 switches a
        # guard off.
        bound = getattr(control.guards, guard, 1.0) or np.inf
        size = change / bound
        # A change that cannot be computed counts as beyond any bound.
        if np.isnan(size):
            size = np.inf
        if guard in ALL_OR_NOTHING and size <= 1:
            size = 0.0
        if size > worst.size:
            worst = GuardedChange(size, guard)
    return worst


def half_trace_change(a: Point, b: Point) -> float:
    """Return Hausdorff distance between the sets of asinh(c) of two points, c their half-traces.

    It is the largest distance of a half-trace of one point from the nearest one of the other. Half-traces may meet and
    turn into a complex pair, so that they have no lasting order in which to compare them. 0 for one degree of freedom,
    which has none.
    """
    distance = np.abs(_squashed(a.half_traces)[:, None] - _squashed(b.half_traces)[None, :])
    return float(max(distance.min(axis=axis, initial=np.inf).max(initial=0.0) for axis in (0, 1)))


def _squashed(c: np.ndarray) -> np.ndarray:
    """Return asinh(|c|) with the phase of c, for complex c (...).

    It grows as the logarithm of a large |c|, so that relative changes are compared. asinh(c) itself has branch cuts on
    the imaginary axis, across which it jumps.
    """
    size = np.maximum(np.abs(c), np.finfo(float).tiny)
    return c * (np.arcsinh(size) / size)


# The following numbers decide how many points lie on a branch, not its course. None is sharp.
#
# The largest change over its bound at which the step after an accepted one aims.
AIM = 0.7
# Newton steps up to which the next step need not be shorter.
EASY = 5
# Largest growth from one step to the next.
MOST_GROWTH = 2
# Factor of a step where Newton's method fails.
FAILED_FACTOR = 0.4
# The same for the repetition of a step that a guard has refused.
AIM_AGAIN = 0.8
# Largest correction of the first step beyond a corner, over its length.
BEYOND_CORNER = 0.1
# Bounds of the factor of such a step.
LEAST_FACTOR = 0.1
MOST_FACTOR = 0.7
#
# Of an orbit that begins near an equilibrium the acceleration there, over that of a harmonic motion of the same size
# and period, is small. Below the first number the branch ends at the equilibrium: one step on, the period of an orbit
# that leaves an unstable equilibrium grows without bound, and the size of one about another equilibrium vanishes. Below
# the second one the motion is the equilibrium itself, which solves the equations with any period.
NEAR_EQUILIBRIUM = 1e-3
CONSTANT = 1e-12


class Geometry(NamedTuple):
    """How a corrected step differs from its prediction.

    ``corrector`` is the length of the correction over that of the step, ``turn`` the angle in rad between the tangents.
    """

    corrector: float
    turn: float


class Verdict(NamedTuple):
    """Whether a step is accepted, and the arclength of the next ``step``, or of the next attempt if it is not.

    For a step that is not accepted, ``why`` gives the reason, and ``remedy`` names keys of the case file that may help.
    """

    accepted: bool
    step: float
    why: str = ""
    remedy: str = ""


class StepRule(Protocol[S]):
    """How long steps are, and where a branch ends.

    One run computes ``points`` at most, without the start; ``points_key`` is the key of the case file that says how
    many. A step below ``smallest_step`` ends the branch with a ContinuationError, whose text ``stuck`` gives. ``chart``
    is the name of the chart for ``PeriodicProblem.frame``; "" where the problem offers no choice.
    """

    points: int
    points_key: str
    first_step: float
    smallest_step: float
    chart: str

    def not_converged(self, step: float, attempt: Attempt) -> Verdict:
        """Return the verdict on an ``attempt`` at a ``step`` that has not converged."""

    def judge(self, before: S, after: S, geometry: Geometry) -> Verdict:
        """Return the verdict on a step from the point ``before`` to ``after`` that has converged."""

    def end(self, before: S, point: S) -> tuple[S, Ended] | None:
        """Return the last point of the branch and how it ended, if it ends at ``point``, after ``before``; else None.

        The last point may differ from ``point``, as where a rule moves it to the end of a range that it has passed.
        """

    def stuck(self, last: S, attempt: Attempt | None, verdict: Verdict) -> str:
        """Return why no step leads on from the ``last`` point."""


class GuardedSteps:
    """Steps of a branch of normal modes by [nnm], of such length that the largest change comes to ``AIM`` of its bound.

    Most guarded changes are proportional to a short step: angles and half-traces change at a rate along the branch, and
    a correction, which is of second order in the step, is divided by the step. The next step is therefore the last one
    times ``AIM`` over the largest change in units of its bound. It at most doubles, and is shorter than the last one
    where Newton's method needed more than ``EASY`` steps. Changes that are not proportional to the step
    (``ALL_OR_NOTHING``) do not matter as long as they are within their bounds.

    ``problem`` has the orbits, ``control`` the numbers of [nnm].
    """

    points_key = "nnm.points"
    no_step = Verdict(accepted=False, step=0.0, why="no step tried", remedy="nnm.max_newton or nnm.tolerance")

    def __init__(self, problem: OrbitProblem, control: NnmTable) -> None:
        self.problem = problem
        self.control = control
        self.points = control.points
        self.first_step = control.first_step
        self.smallest_step = control.smallest_step
        self.chart: str = control.chart

    def not_converged(self, step: float, attempt: Attempt) -> Verdict:
        """Return a shorter step."""
        return Verdict(
            accepted=False,
            step=step * FAILED_FACTOR,
            why=f"no convergence ({attempt.reason})",
            remedy="nnm.max_newton or nnm.tolerance",
        )

    def judge(self, before: Point, after: Point, geometry: Geometry) -> Verdict:
        """Accept a step to a point that moves, if no change is beyond its bound."""
        if self.problem.acceleration(after) < CONSTANT:
            return Verdict(
                accepted=False,
                step=after.step * FAILED_FACTOR,
                why="Newton's method ends at an equilibrium, which has no period",
                remedy="nnm.largest_step",
            )
        if self.problem.has_corner(before, after):
            # Steps come to the corner itself, where the branch has another tangent.
            why = "the branch has a corner, beyond which a rigid stop is first struck, or no longer"
            return Verdict(accepted=False, step=after.step * LEAST_FACTOR, why=why, remedy="nnm.first_step")
        size, guard = largest_change(self.problem, self.control, before, after, geometry._asdict())
        if size <= 1.0:
            # The largest of three reasons for a shorter step, each as the factor by which it divides the last one.
            effort = max(size / AIM, after.newton / EASY, 1 / MOST_GROWTH)
            return Verdict(accepted=True, step=min(after.step / effort, self.control.largest_step))

        # The change may not be proportional to the step: the least factor keeps one large change from ending the
        # branch, and the largest one lets every refusal shorten the step, so that the attempts end.
        factor = min(max(AIM_AGAIN / size, LEAST_FACTOR), MOST_FACTOR)
        why, remedy = GUARDED[guard]
        return Verdict(accepted=False, step=after.step * factor, why=why, remedy=remedy)

    def end(self, before: Point, point: Point) -> tuple[Point, Ended] | None:
        """Return the point itself, if it has left the range of energies or frequencies, or is almost an equilibrium."""
        if self.problem.acceleration(point) < NEAR_EQUILIBRIUM:
            return point, Ending.EQUILIBRIUM.with_numbers(energy=point.energy, frequency=point.frequency)
        if self.problem.rests_on_stop(point):
            return point, Ending.STOP_AT_REST.with_numbers(energy=point.energy, frequency=point.frequency)
        low, high = self.control.energy
        # The first motion has the energy asked for by its linear mode alone: springs and pressed contacts that are not
        # linear change it. A branch may therefore begin outside the range and come into it.
        comes_nearer = before.energy < point.energy < low or high < point.energy < before.energy
        if not (low <= point.energy <= high or comes_nearer):
            return point, Ending.OUT_OF_ENERGIES.with_numbers(low=low, high=high)
        low, high = self.control.frequency
        if not low <= 2 * np.pi * point.frequency <= high:
            return point, Ending.OUT_OF_FREQUENCIES.with_numbers(low=low, high=high)
        return None

    def stuck(self, last: Point, attempt: Attempt | None, verdict: Verdict) -> str:
        """Return a sentence on where and why no step was short enough, and on keys of the case that may help."""
        residuals = "none"
        if attempt is None:
            verdict = self.no_step
        else:
            residuals = attempt.residuals
        return (
            f"step below {self.smallest_step:g} after point {last.index} "
            f"(E = {last.energy:.9g} J, f = {last.frequency:.9g} Hz): {verdict.why}; {self._grazing_advice(last)}"
            f"residuals of the last attempt: {residuals}; change nnm.smallest_step or {verdict.remedy}"
        )

    def _grazing_advice(self, point: Point) -> str:
        """Return a sentence on contacts that graze in the orbit of a ``point``, and on keys that help, or ""."""
        try:
            numbers = self.problem.grazing(point)
            corner = self.problem.turned_at_corner(point)
        except FlowError:
            return ""
        if not numbers:
            return ""
        if corner is not None:
            return f"rigid stop {numbers[0]} is touched there, and no orbit was found beyond that corner; "
        graze = f"contact {numbers[0]} grazes"
        if len(numbers) > 1:
            graze = f"contacts {', '.join(map(str, numbers))} graze"
        return (
            f"{graze} there, at no speed, where a stiff contact bends the branch within less than a step: "
            'try nnm.chart = "grazing", or nnm.smallest_step = 1e-18 with nnm.guards.corrector = 0.5, turn = 1 and'
            " turn_relative = 1; "
        )


class Continuation(Generic[S]):
    """Iterates over the points of a branch that follow ``start``; the start itself is not among them.

    ``control`` is a step rule, or the section [nnm] of a case, by which ``GuardedSteps`` is the rule. That section
    gives the ``chart`` (``auto``: grazing near a contact at the arc's start, else relative), the steps in units of the
    chart, the ``guards``, and where the branch ends: outside ``energy`` (J), outside ``frequency`` (Hz) or after
    ``points`` points. ``step`` is the first arclength, by default the rule's ``first_step``. A start without a tangent
    is left towards growing energy (``direction`` 1) or falling energy (-1); one with a tangent is left along it, and
    ``direction`` is not used.

    Each point is yielded when it has been accepted. ``point`` is the last one; ``passed`` is the same point as it was
    before the rule's ``end`` may have moved it to the end of a range. ``ended`` is how the
    branch ended, and ``finished`` whether it did so by the rule's ``end``.

    The whole state is the last point and the next ``step``: a stored branch can be resumed, and ``points`` then counts
    from there; the ending tells their number together with the ``points_before``. Raises ContinuationError if the step
    falls below the smallest or the tangent at the start is degenerate.
    """

    def __init__(
        self,
        problem: PeriodicProblem[S],
        start: S,
        control: NnmTable | StepRule[S],
        direction: int = 1,
        step: float | None = None,
        points_before: int = 0,
    ) -> None:
        self.problem = problem
        self.points_before = points_before
        self.rule: StepRule[S] = _rule(problem, control)
        self.point = self.passed = start
        if not start.tangent.size:
            self.point = replace(start, tangent=problem.first_tangent(start, direction))
        self.step = self.rule.first_step
        if step is not None:
            self.step = step
        self.ended = NOT_FINISHED

    @property
    def finished(self) -> bool:
        """Whether the branch has come to its end, as the rule has it."""
        return self.ended.ending.is_final

    def __iter__(self) -> Iterator[S]:
        for _ in range(self.rule.points):
            before = self.point
            self.point = self.passed = self._next()
            end = self.rule.end(before, self.point)
            if end is not None:
                self.point, self.ended = end
            yield self.point
            if self.finished:
                return
        total = self.points_before + self.rule.points
        self.ended = Ending.POINTS_USED.with_numbers(points=total, key=self.rule.points_key)

    def _next(self) -> S:
        """Return the next point; raises ContinuationError where no step is short enough."""
        last = self.point
        frame = self.problem.frame(last, self.rule.chart)
        attempt = None
        verdict = Verdict(accepted=False, step=self.step)

        while self.step >= self.rule.smallest_step:
            attempt, tangent = _corrected(frame, self.step)
            if tangent is not None:
                point = replace(frame.measures(attempt, tangent), index=last.index + 1, step=self.step)

                # The cosine is cut off at 1, above which rounding may bring it. It needs no bound below: the tangent is
                # on the side of the frame's, so that it is positive.
                correction = attempt.xi - frame.xi - self.step * frame.tangent
                geometry = Geometry(
                    corrector=float(np.linalg.norm(correction)) / self.step,
                    turn=float(np.arccos(min(tangent @ frame.tangent, 1.0))),
                )
                verdict = self.rule.judge(before=last, after=point, geometry=geometry)
            else:
                verdict = self.rule.not_converged(self.step, attempt)

            # The step of a failure is kept as well, so that a second iteration does not repeat the attempts.
            self.step = verdict.step
            if verdict.accepted:
                return replace(point, next_step=self.step)
        beyond = self._beyond_corner(last)
        if beyond is not None:
            return beyond
        raise ContinuationError(self.rule.stuck(last, attempt, verdict))

    def _beyond_corner(self, last: S) -> S | None:
        """Return the first point beyond a corner at the ``last`` one; None if there is none, or no point is found.

        No guard holds across a corner: what is found must lie near the direction in which the branch leaves it.
        """
        corner = self.problem.turned_at_corner(last)
        if corner is None:
            return None
        frame = self.problem.frame(corner.point, self.rule.chart)
        length = np.linalg.norm(frame.direction(corner.point))
        bend = frame.direction(replace(corner.point, tangent=corner.bend)) / length**2
        step = self.rule.first_step
        while step >= self.rule.smallest_step:
            guess = frame.xi + step * frame.tangent + step**2 * bend
            attempt = frame.correct(guess, step)
            if attempt.converged and np.linalg.norm(attempt.xi - guess) < BEYOND_CORNER * step:
                tangent = frame.tangent_at(attempt.xi)
                point = replace(frame.measures(attempt, tangent), index=last.index + 1, step=step)
                self.step = step
                return replace(point, next_step=step)
            step *= FAILED_FACTOR
        return None


def _corrected(frame: Frame[S], step: float) -> tuple[Attempt, np.ndarray | None]:
    """Return attempt at a point a ``step`` along the tangent of ``frame``, and the unit tangent there if it converges.

    Newton's method may converge to a point with no unique tangent, as where two branches meet, or where a jump led to
    another branch. This counts as an attempt that has not converged: another step leads to another point.
    """
    attempt = frame.correct(frame.xi + step * frame.tangent, step)
    if not attempt.converged:
        return attempt, None
    try:
        return attempt, frame.tangent_at(attempt.xi)
    except np.linalg.LinAlgError as error:
        return replace(attempt, converged=False, reason=f"no unique tangent: {error}"), None


def _rule(problem: Any, control: Any) -> Any:
    """Return the step rule that ``control`` is, or ``GuardedSteps`` by a section [nnm].

    Such a section is only given with a problem whose points are orbits, which types cannot say: hence Any.
    """
    if isinstance(control, NnmTable):
        return GuardedSteps(problem, control)
    return control


# A solution farther from its first guess than this fraction of the segment's length is taken to lie on another arc.
FURTHEST = 0.5
# Near the tips of narrow tongues rounding keeps Newton's method from reaching the tolerance. A residual of this many
# times the tolerance is accepted for a special point.
ROUNDING = 10
# Where a test turns back between two points, its extreme value is estimated by a parabola. Two zeros are looked for if
# the estimate is beyond zero or below this fraction of the smaller value at the ends: the parabola may be wrong by as
# much.
NEAR = 0.5
# Zeros of one test that are nearer to one another than this fraction of the segment's length are one zero.
APART = 1e-6
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
        """Return the unknowns at an arclength of Hermite's cubic through the nearest knots before and after it."""
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
        """Return the point at an arclength; raises NoMotionError if Newton's method fails there or leaves the step."""
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

    def roots(self, kind: SpecialKind[S], before: S | None, bends: Sequence[float] = ()) -> list[S]:
        """Return points of a kind, where its test vanishes and that the kind accepts.

        There is one if the test has two signs at the ends. If it has one sign but turns back between them, as the point
        ``before`` the left one shows, there may be two, one on each side of the turn. At the arclengths ``bends``,
        where contacts begin or end, tests bend sharply, so that there may be more on both sides. Raises NoMotionError
        where a zero between two signs is not found.
        """
        points = self._zeros(kind, before)
        if bends:
            points += self._further_zeros(kind, points, bends)
        if kind.accept is None:
            return points
        return [point for point in points if kind.accept(point)]

    def _zeros(self, kind: SpecialKind[S], before: S | None) -> list[S]:
        """Return the points where the kind's test vanishes."""
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

    def _further_zeros(self, kind: SpecialKind[S], points: list[S], bends: Sequence[float]) -> list[S]:
        """Return zeros of the kind's test, besides ``points``, that its values at and between the ``bends`` show."""
        places = [point.step for point in points]
        ends = sorted({0.0, *bends, *places, self.length})
        middles = [(a + b) / 2 for a, b in itertools.pairwise(ends)]
        samples = [(0.0, self.left)]
        for arclength in sorted([*bends, *middles]):
            # A sample only suggests further zeros. Where there is no point, none need be missed.
            with suppress(NoMotionError):
                samples.append((arclength, self.at(arclength)))
        samples.append((self.length, self.right))

        further = []
        certain = [(arclength, point) for arclength, point in samples if abs(kind.test(point)) > kind.floor]
        for (low, a), (high, b) in itertools.pairwise(certain):
            if kind.test(a) * kind.test(b) > 0 or any(low < place < high for place in places):
                continue
            zero = self.between(a, b, low).root(kind)
            # Where a point lies on a bend itself, the sign there is that of rounding.
            if all(abs(zero.step - place) > APART * self.length for place in places):
                further.append(zero)
        return further

    def _zero_beside_left(self, kind: SpecialKind[S], before: S | None) -> list[S]:
        """Return the zero next to the left point, whose value is within the floor, if its neighbours differ in sign.

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

    def root(self, kind: SpecialKind[S]) -> S:
        """Return point where the kind's test, of two signs at the ends, vanishes; raises NoMotionError without one."""
        # So that the command line can report what a run is doing (``cli.messages``).
        sys.audit("vipetsc.landing", kind.name)
        point = self._corner(kind) if kind.corner else self._find(kind)
        if kind.finish is not None:
            point = kind.finish(point, self.left, self.right)
        return replace(point, kind=kind.name, step=self.begin + point.step)

    def _find(self, kind: SpecialKind[S]) -> S:
        """Return the point where a test of two signs at the ends vanishes, by Brent's method."""
        # The root is one of the arclengths at which a value was asked for: its point is not computed twice.
        at = cache(self.at)
        value = partial(self._value, kind.test, at)
        return at(float(brentq(value, 0.0, self.length, xtol=EXACT * abs(self.length))))

    def _corner(self, kind: SpecialKind[S]) -> S:
        """Return the end of the segment at which the branch has its corner, to which steps have come."""
        if kind.test(self.left) < 0:
            return replace(self.left, index=self.right.index, step=0.0)
        return replace(self.right, step=self.length)

    def _value(self, test: Callable[[S], float], at: Callable[[float], S], arclength: float) -> float:
        """Return value of a test at an arclength; at the ends it is that of their points, which need no correction."""
        if arclength == 0:
            return test(self.left)
        if arclength == self.length:
            return test(self.right)
        return test(at(arclength))

    def split(self, arclength: float) -> "tuple[Segment[S], Segment[S]]":
        """Return the parts before and after an ``arclength``; raises NoMotionError if there is no point."""
        middle = self.at(arclength)
        after = self.between(middle, self.right, self.begin + arclength)
        return self.between(self.left, middle, self.begin), after


def _turn(*values: tuple[float, float]) -> float | None:
    """Return the place between the last two of x0 < x1 = 0 < x2 where a value turns back, if it may cross zero there.

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


# Two special points of a kind are one within this fraction of a segment: each is found to 1e-10 of it.
SAME = 1e-9


def locate(
    problem: PeriodicProblem[S],
    left: S,
    right: S,
    chart: str = "relative",
    grazing: bool = False,
    before: S | None = None,
    missed: list[str] | None = None,
    chosen: Sequence[SpecialKind[S]] = (),
) -> list[S]:
    """Return special points between two consecutive points of a branch, in order; their ``index`` is the right one's.

    Their kinds, each with a test function that vanishes there, are those of ``problem.special_kinds``, and those
    ``chosen``. ``chart`` is as for ``Continuation``. With ``grazing`` every change of the number of contacts is located
    as well, which takes about 40 corrections where it must be bracketed. With the point ``before`` the left one, two
    special points of one kind within the step are found as well, and with ``grazing`` those on both sides of a change
    of contact. For each special point that cannot be located a
    sentence is appended to ``missed``.

    An energy fold has a half-trace of 1, as a branch point has. In a step with an energy fold no branch point is
    therefore looked for: it would be the fold again.
    """
    points: list[S] = []
    segment = Segment(problem, chart, left, right)
    kinds = [*problem.special_kinds(left, right), *chosen]
    if not grazing:
        kinds = [kind for kind in kinds if kind.name != "grazing"]
    # Where contacts begin or end is found first: there the tests of the other kinds bend.
    kinds.sort(key=lambda kind: kind.name != "grazing")
    for kind in kinds:
        if kind.name == "branch-point" and any(p.kind == "fold-energy" for p in points):
            continue
        try:
            bends = [p.step for p in points if p.kind == "grazing"]
            if kind.name == "grazing":
                bends = []
            roots = segment.roots(kind, before, bends)
            # Contacts that begin at one point, by a symmetry, make one special point.
            points += [p for p in roots if not _is_among(p, kind.name, points, segment.length)]
        except NoMotionError as error:
            if missed is not None:
                missed.append(f"a {kind.name} after {left.describe()} is not located: {error}")
    return sorted(points, key=lambda p: p.step)


def _is_among(point: S, kind: str, others: list[S], length: float) -> bool:
    """Return whether one of the ``others`` is the same point of that kind, on a segment of that ``length``."""
    return any(other.kind == kind and abs(other.step - point.step) <= SAME * length for other in others)


def at_energy(
    problem: PeriodicProblem[Point], left: Point, right: Point, energy: float, chart: str = "relative"
) -> Point:
    """Return the orbit of an ``energy`` in J between two consecutive points with less and with more of it.

    It is a point of the kind "regular". Raises NoMotionError if Newton's method fails.
    """
    kind: SpecialKind[Point] = SpecialKind("regular", lambda p: p.energy / energy - 1)
    return Segment(problem, chart, left, right).root(kind)
