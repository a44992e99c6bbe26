"""Steps on which a curve turns by half of what is allowed: the step rule of curves without half-traces."""

from abc import ABC, abstractmethod
from typing import Generic

from vipetsc.endings import Ended
from vipetsc.modes.continuation.arclength import Geometry, Verdict
from vipetsc.modes.problem import Attempt, S

# The following three numbers decide how many states lie on a curve, not its course: each state solves the equations. On
# the curve of ``runs/examples/nfrc.toml`` for the restitution 0.7, with 21 harmonics, its folds stay the same to 1e-8
# where one of them is changed. With half the TURN it has 203 states instead of 114, with twice the TURN 97; with a
# CORRECTION of 0.03 it has 277, with 1 still 114; with a MOST_GROWTH of 1.3 or 2.5 it has 124 or 111.
#
# Largest angle in rad between tangents, and largest correction over the step, of a step that is accepted.
TURN = 0.25
CORRECTION = 0.1
# The next step is TURN/2 over the turn times the last one, so that the curve turns by half of what is allowed, but at
# most this factor times the last one.
MOST_GROWTH = 1.6
# A turn in rad below which the quotient is not formed: the growth is at its bound anyway.
LEAST_ANGLE = 1e-9


class BoundedTurn(ABC, Generic[S]):
    """A step rule (``StepRule``) that bounds the turn of the curve in a step, and the correction over the step.

    Of ``points`` there are as many at most; steps are from ``smallest_step`` to ``largest_step`` long, in units of the
    unknowns. A subclass says where the curve ends.
    """

    points_key = "points"
    chart = ""

    def __init__(self, points: int, first_step: float, smallest_step: float, largest_step: float) -> None:
        self.points = points
        self.first_step = first_step
        self.smallest_step = smallest_step
        self.largest_step = largest_step

    def not_converged(self, step: float, attempt: Attempt) -> Verdict:
        """Return the verdict on a failed attempt: half the step."""
        residuals = attempt.residuals or "none"
        why = f"Newton's method ended with {attempt.reason} (residuals {residuals})"
        return Verdict(accepted=False, step=step / 2, why=why)

    def judge(self, before: S, after: S, geometry: Geometry) -> Verdict:
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

    @abstractmethod
    def end(self, before: S, point: S) -> tuple[S, Ended] | None:
        """Return the last point of the curve and how it ended, if it ends at ``point``; else None."""

    @abstractmethod
    def stuck(self, last: S, attempt: Attempt | None, verdict: Verdict) -> str:
        """Why no step leads on from the ``last`` point."""
