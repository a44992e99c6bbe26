"""Steps on which a curve turns by half of what is allowed, to an end of a range: the step rule of responses."""

from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np

from vipetsc.endings import Ended, Ending
from vipetsc.modes.continuation.arclength import Geometry, Verdict
from vipetsc.modes.problem import Attempt, PeriodicProblem
from vipetsc.modes.response.state import Response, returned

# The following three numbers decide how many states lie on a curve, not its course.
#
# Largest angle in rad between tangents, and largest correction over the step, of a step that is accepted.
TURN = 0.25
CORRECTION = 0.1
# The next step is TURN/2 over the turn times the last one, so that the curve turns by half of what is allowed, but at
# most this factor times the last one.
MOST_GROWTH = 1.6
# A turn in rad below which the quotient is not formed: the growth is at its bound anyway.
LEAST_ANGLE = 1e-9


class RangeProblem(PeriodicProblem[Response]):
    """Equations with a parameter, of which a solution at a given value can be asked for."""

    @abstractmethod
    def at(self, guess: np.ndarray, p: float) -> np.ndarray:
        """Return unknowns (n + 1,) at the scaled parameter ``p`` near a ``guess``; or ContinuationError."""

    def tangent_near(self, point: Response, xi: np.ndarray) -> np.ndarray:
        """Return the unit tangent (n + 1,) at a solution ``xi`` (n + 1,) near a ``point``."""
        return self.frame(point).tangent_at(xi)


class BoundedTurn(ABC):
    """A step rule (``StepRule``) that bounds the turn of the curve in a step, and the correction over the step.

    Of ``points`` there are as many at most; steps are from ``smallest_step`` to ``largest_step`` long, in units of the
    unknowns. The curve ends at an end of the range ``ends`` (2,) of the scaled parameter, or where it comes back to its
    ``first`` point, if that is given.
    """

    points_key = "points"
    chart = ""
    first_step: float
    smallest_step: float
    largest_step: float

    def __init__(self, problem: RangeProblem, points: int, ends: np.ndarray, first: Response | None = None) -> None:
        self.problem = problem
        self.points = points
        self.ends = ends
        self.first = first

    def not_converged(self, step: float, attempt: Attempt) -> Verdict:
        """Return the verdict on a failed attempt: half the step."""
        residuals = attempt.residuals or "none"
        why = f"Newton's method ended with {attempt.reason} (residuals {residuals})"
        return Verdict(accepted=False, step=step / 2, why=why)

    def judge(self, before: Response, after: Response, geometry: Geometry) -> Verdict:
        """Accept a step on which neither the tangent turns too far nor the correction is too long; else half of it."""
        # A comparison with NaN is false, which refuses the step.
        why = ""
        if not geometry.turn <= TURN:
            why = f"the curve turns too sharply ({geometry.turn:.2g} rad)"
        elif not geometry.corrector <= CORRECTION:
            why = f"the correction is too long ({geometry.corrector:.2g} of the step)"
        if why:
            return Verdict(accepted=False, step=after.step / 2, why=why)
        growth = min(MOST_GROWTH, 0.5 * TURN / max(geometry.turn, LEAST_ANGLE))
        # An accepted turn is at most TURN, so that the quotient is at least 1/2, but for rounding.
        return Verdict(accepted=True, step=min(after.step * max(growth, 0.5), self.largest_step))

    def end(self, before: Response, point: Response) -> tuple[Response, Ended] | None:
        """Return the first point if the curve comes back to it, or that on the end of the range if it passes it."""
        if self.first is not None and returned(self.first, before, point):
            first = replace(self.first, index=point.index, step=point.step, next_step=point.next_step)
            return first, Ending.CLOSED.with_numbers()
        p = point.xi[-1]
        bound = float(np.clip(p, *self.ends))
        if p == bound:
            return None
        # The last point is moved back to the end itself: curves over the same range end at the same parameter. The line
        # through both points is nearer to it than the last one, and along a fold Newton's method needs that.
        place = (bound - before.xi[-1]) / (p - before.xi[-1])
        xi = self.problem.at(before.xi + place * (point.xi - before.xi), bound)
        last = replace(point, xi=xi, tangent=self.problem.tangent_near(point, xi))
        return last, self.ended_at(bound)

    @abstractmethod
    def ended_at(self, bound: float) -> Ended:
        """Return how a curve ended that has come to the ``bound`` of the scaled parameter."""

    @abstractmethod
    def stuck(self, last: Response, attempt: Attempt | None, verdict: Verdict) -> str:
        """Return why no step leads on from the ``last`` point."""
