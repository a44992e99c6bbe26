"""Pseudo-arclength continuation as an iterator over points; the caller owns the loop."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from vipetsc.case.nnm import NnmTable
from vipetsc.modes.continuation.guards import GUARDED, strain
from vipetsc.modes.point import Point
from vipetsc.modes.problem import Attempt, ContinuationError, Problem, S, Solution

S_contra = TypeVar("S_contra", bound=Solution, contravariant=True)


# Strain of the guards at which the next step aims, Newton steps that need no shorter one, and its largest growth.
AIM = 0.7
EASY = 5
MOST_GROWTH = 2
# Factor of a step where Newton's method fails.
FAILED_FACTOR = 0.4
# Where a guard is strained: the strain aimed at, and bounds of the factor.
AIM_AGAIN = 0.8
LEAST_FACTOR = 0.1
MOST_FACTOR = 0.7


class Geometry(NamedTuple):
    """How a corrected step differs from its prediction.

    ``corrector`` is the length of the correction over that of the step, ``turn`` the angle in rad between the tangents.
    """

    corrector: float
    turn: float


class Verdict(NamedTuple):
    """Whether a step is accepted, the arclength of the next one (or of the next attempt), and why it is not."""

    accepted: bool
    step: float
    why: str = ""
    remedy: str = ""


class StepRule(Protocol[S]):
    """How long steps are, and where a branch ends.

    ``points`` at most are computed; a step below ``smallest_step`` ends the branch with the error ``stuck``.
    """

    points: int
    points_key: str
    first_step: float
    smallest_step: float
    chart: str

    def not_converged(self, step: float, attempt: Attempt) -> Verdict:
        """What follows after an ``attempt`` at a ``step`` that has not converged."""

    def judge(self, before: S, after: S, geometry: Geometry) -> Verdict:
        """What follows after a step from the point ``before`` to ``after`` that has converged."""

    def end(self, point: S) -> tuple[S, str] | None:
        """The last point of the branch and how it ended, if it ends at ``point``; else None."""

    def stuck(self, last: S, attempt: Attempt | None, verdict: Verdict) -> str:
        """Why no step leads on from the ``last`` point."""


class GuardedSteps:
    """Steps of a branch of normal modes by [nnm]: as long as its guards are strained to 70 % of their bounds.

    Strain grows with the step, so that its inverse scales the next one; a step at most doubles, and is shortened where
    Newton's method needs more than five iterations.
    """

    points_key = "nnm.points"
    no_step = Verdict(False, 0.0, "no step tried", "nnm.max_newton or nnm.tolerance")

    def __init__(self, problem: Problem[Point], control: NnmTable) -> None:
        self.problem = problem
        self.control = control
        self.points = control.points
        self.first_step = control.first_step
        self.smallest_step = control.smallest_step
        self.chart: str = control.chart

    def not_converged(self, step: float, attempt: Attempt) -> Verdict:
        """A shorter step."""
        return Verdict(
            False, step * FAILED_FACTOR, f"no convergence ({attempt.reason})", "nnm.max_newton or nnm.tolerance"
        )

    def judge(self, before: Point, after: Point, geometry: Geometry) -> Verdict:
        """Accept a step that strains no guard beyond its bound."""
        size, guard = strain(self.problem, self.control, before, after, geometry._asdict())
        if size <= 1.0:
            effort = max(size / AIM, after.newton / EASY, 1 / MOST_GROWTH)
            return Verdict(True, min(after.step / effort, self.control.largest_step))
        # A strain that does not fall in proportion to the step must not keep the attempts from ending.
        factor = min(max(AIM_AGAIN / size, LEAST_FACTOR), MOST_FACTOR)
        return Verdict(False, after.step * factor, *GUARDED[guard])

    def end(self, point: Point) -> tuple[Point, str] | None:
        """The point itself where it has left the range of energies or of frequencies."""
        low, high = self.control.energy
        if not low <= point.energy <= high:
            return point, f"left the energy range {low:g} to {high:g} J"
        low, high = self.control.frequency
        if not low <= point.frequency <= high:
            return point, f"left the frequency range {low:g} to {high:g} Hz"
        return None

    def stuck(self, last: Point, attempt: Attempt | None, verdict: Verdict) -> str:
        """Where, why, and which option to turn."""
        residuals = "none"
        if attempt is None:
            verdict = self.no_step
        else:
            residuals = attempt.residuals
        return (
            f"step below {self.smallest_step:g} after point {last.index} "
            f"(E = {last.energy:.9g} J, f = {last.frequency:.9g} Hz): {verdict.why}; "
            f"residuals of the last attempt: {residuals}; turn nnm.smallest_step or {verdict.remedy}"
        )


class Continuation(Generic[S]):
    """Iterates over the points of a branch, from ``start`` in the direction of growing or falling energy.

    Of the section [nnm], ``control``, it takes the ``chart`` (``auto``: grazing near a contact at the arc's start, else
    relative), the steps in units of the chart, the ``guards``, and where the branch ends: outside ``energy`` (J),
    outside ``frequency`` (Hz) or after ``points`` points; other kinds of branches have rules of their own. Each point
    is yielded when it has been accepted; ``ending`` says in a sentence how the branch ended, ``finished`` whether it
    left its range, and ``passed`` is the latest point before it was put on the end of a range. The whole state is the
    last point and the next step: a stored branch can be resumed. Raises ContinuationError if the step falls below the
    smallest or the tangent at the start is degenerate.
    """

    def __init__(
        self,
        problem: Problem[S],
        start: S,
        control: NnmTable | StepRule[S],
        direction: int = 1,
        step: float | None = None,
    ) -> None:
        self.problem = problem
        self.rule: StepRule[S] = _rule(problem, control)
        self.point = self.passed = start
        if not start.tangent.size:
            self.point = replace(start, tangent=problem.first_tangent(start, direction))
        self.step = self.rule.first_step if step is None else step
        self.ending = "not finished"
        self.finished = False

    def __iter__(self) -> Iterator[S]:
        for _ in range(self.rule.points):
            self.point = self.passed = self._next()
            end = self.rule.end(self.point)
            if end is not None:
                self.point, self.ending = end
                self.finished = True
            yield self.point
            if self.finished:
                return
        self.ending = f"{self.rule.points} points reached: raise {self.rule.points_key} and resume to go on"

    def _next(self) -> S:
        """The next point; raises ContinuationError where no step is short enough."""
        last = self.point
        frame = self.problem.frame(last, self.rule.chart)
        attempt = None
        verdict = Verdict(False, self.step)

        while self.step >= self.rule.smallest_step:
            predicted = frame.xi + self.step * frame.tangent
            attempt = frame.correct(predicted, self.step)
            if attempt.converged:
                direction = frame.tangent_at(attempt.xi)
                point = replace(frame.measures(attempt, direction), index=last.index + 1, step=self.step)
                verdict = self.rule.judge(
                    before=last,
                    after=point,
                    geometry=Geometry(
                        corrector=float(np.linalg.norm(attempt.xi - frame.xi - self.step * frame.tangent)) / self.step,
                        turn=float(np.arccos(min(direction @ frame.tangent, 1.0))),
                    ),
                )
            else:
                verdict = self.rule.not_converged(self.step, attempt)

            # Also the step of a failure is kept: a loop that is asked again does not repeat the attempts.
            self.step = verdict.step
            if verdict.accepted:
                return replace(point, next_step=self.step)
        raise ContinuationError(self.rule.stuck(last, attempt, verdict))


def _rule(problem: Any, control: Any) -> Any:
    """The rule itself, or that of a table [nnm], which goes with points that are orbits."""
    return GuardedSteps(problem, control) if isinstance(control, NnmTable) else control
