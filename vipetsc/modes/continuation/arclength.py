"""Pseudo-arclength continuation as an iterator over points; the caller owns the loop.

A method (``modes.problem.PeriodicProblem``) has n equations H = 0 in n + 1 unknowns, whose solutions form a curve, a
branch. At the last point it gives a *frame*: a *chart*, which scales the unknowns to order one, the unknowns ``xi``
(n + 1,) of that point, and the unit tangent t of the branch there. A step of the arclength s predicts xi + s t, and
Newton's method corrects the prediction to the solution xi_new of

    H(xi_new) = 0,    t . (xi_new - xi) = s,

so that the correction is orthogonal to the tangent (Keller 1977, reference in ``modes``). The arclength is in the units
of the chart. The frame's ``measures`` turn a solution into a point of the branch with its energy, frequency and so on.

*Guards* bound what may change from one point to the next (``continuation.guards``): the correction over the step, the
angle between tangents, contacts, half-traces of Floquet multipliers. A step in which one of them changes by more than
its bound is refused, since it may have jumped to another branch.

A *step rule* decides what follows after each attempt. ``GuardedSteps`` is the rule for normal modes, by the section
[nnm] of a case file; other kinds of branches bring their own.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Generic, NamedTuple, Protocol

import numpy as np

from vipetsc.case.nnm_table import NnmTable
from vipetsc.modes.continuation.guards import GUARDED, OrbitProblem, largest_change
from vipetsc.modes.point import Point
from vipetsc.modes.problem import Attempt, ContinuationError, FlowError, Frame, PeriodicProblem, S

# The following numbers decide how many points lie on a branch, not its course: each point solves the equations and
# keeps the guards. None is sharp. On the out-of-phase branch of the paper's reduced model up to 10 kJ (176 points, 21
# attempts in vain) each may be changed by a quarter or more, and the Newton steps of all points together change by 13 %
# at most.
#
# The largest change over its bound at which the step after an accepted one aims. At 1, nearly twice as many steps are
# refused.
AIM = 0.7
# Newton steps up to which the next step need not be shorter.
EASY = 5
# Largest growth from one step to the next.
MOST_GROWTH = 2
# Factor of a step where Newton's method fails.
FAILED_FACTOR = 0.4
# The same for the repetition of a step that a guard has refused.
AIM_AGAIN = 0.8
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
        """The verdict on an ``attempt`` at a ``step`` that has not converged."""

    def judge(self, before: S, after: S, geometry: Geometry) -> Verdict:
        """The verdict on a step from the point ``before`` to ``after`` that has converged."""

    def end(self, before: S, point: S) -> tuple[S, str] | None:
        """The last point of the branch and how it ended, if it ends at ``point``, the one after ``before``; else None.

        The last point may differ from ``point``, as where a rule moves it to the end of a range that it has passed.
        """

    def stuck(self, last: S, attempt: Attempt | None, verdict: Verdict) -> str:
        """Why no step leads on from the ``last`` point."""


class GuardedSteps:
    """Steps of a branch of normal modes by [nnm], of such length that the largest change comes to ``AIM`` of its bound.

    Most guarded changes are proportional to a short step: angles and half-traces change at a rate along the branch, and
    a correction, which is of second order in the step, is divided by the step. The next step is therefore the last one
    times ``AIM`` over the largest change in units of its bound. It at most doubles, and is shorter than the last one
    where Newton's method needed more than ``EASY`` steps. Changes that are not proportional to the step
    (``guards.ALL_OR_NOTHING``) do not matter as long as they are within their bounds.

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
        """A shorter step."""
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

    def end(self, before: Point, point: Point) -> tuple[Point, str] | None:
        """The point itself, where it has left the range of energies or of frequencies, or is almost an equilibrium."""
        if self.problem.acceleration(point) < NEAR_EQUILIBRIUM:
            return point, (
                f"ends at an equilibrium: at E = {point.energy:.9g} J, f = {point.frequency:.6g} Hz the motion begins "
                "where the forces almost balance"
            )
        low, high = self.control.energy
        # The first motion has the energy asked for by its linear mode alone: springs and pressed contacts that are not
        # linear change it. A branch may therefore begin outside the range and come into it.
        comes_nearer = before.energy < point.energy < low or high < point.energy < before.energy
        if not (low <= point.energy <= high or comes_nearer):
            return point, f"left the energy range {low:g} to {high:g} J"
        low, high = self.control.frequency
        if not low <= 2 * np.pi * point.frequency <= high:
            return point, f"left the frequency range {low:g} to {high:g} rad/s"
        return None

    def stuck(self, last: Point, attempt: Attempt | None, verdict: Verdict) -> str:
        """A sentence that says where and why no step was short enough, and which keys of the case file may help."""
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
        """A sentence on contacts that graze in the orbit of a ``point``, and on keys that help; empty without any."""
        try:
            numbers = self.problem.grazing(point)
        except FlowError:
            return ""
        if not numbers:
            return ""
        graze = f"contact {numbers[0]} grazes"
        if len(numbers) > 1:
            graze = f"contacts {', '.join(map(str, numbers))} graze"
        return (
            f"{graze} there, at no speed, where a stiff contact bends the branch within less than a step: "
            'try nnm.chart = "grazing", or nnm.guards.corrector = 0.5 with nnm.smallest_step = 1e-18; '
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
    before the rule's ``end`` may have moved it to the end of a range. ``ending`` says in a sentence how the branch
    ended, and ``finished`` whether it did so by the rule's ``end``.

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
        self.ending = "not finished"
        self.finished = False

    def __iter__(self) -> Iterator[S]:
        for _ in range(self.rule.points):
            before = self.point
            self.point = self.passed = self._next()
            end = self.rule.end(before, self.point)
            if end is not None:
                self.point, self.ending = end
                self.finished = True
            yield self.point
            if self.finished:
                return
        total = self.points_before + self.rule.points
        self.ending = f"{total} points reached: increase {self.rule.points_key} and resume to continue"

    def _next(self) -> S:
        """The next point; raises ContinuationError where no step is short enough."""
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
        raise ContinuationError(self.rule.stuck(last, attempt, verdict))


def _corrected(frame: Frame[S], step: float) -> tuple[Attempt, np.ndarray | None]:
    """The attempt at a point a ``step`` along the tangent of ``frame``, and the unit tangent there if it converges.

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
    """The step rule that ``control`` is, or ``GuardedSteps`` by a section [nnm].

    Such a section is only given with a problem whose points are orbits, which types cannot say: hence Any.
    """
    if isinstance(control, NnmTable):
        return GuardedSteps(problem, control)
    return control
