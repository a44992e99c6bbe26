"""Special points of curves of steady states at which stability changes: what kind they are, and where.

A perturbation exp(lambda t) begins to grow where its exponent lambda, over Om, passes the line Re lambda = ``least`` of
Hill's method: a real one at a fold or a branch point, one with Im lambda = 1/2 at a period doubling, a complex pair at
a Neimark-Sacker bifurcation, behind which the motion is quasi-periodic. On the real axis and on Im lambda = 1/2 Hill's
determinant D is real, and a zero passes the line where its sign there changes. What these zeros leave of a change of
the number of growing perturbations is due to pairs.

Two changes between neighbouring states that cancel are not seen, as where one pair begins to grow and another one to
decay.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from vipetsc.modes.problem import NoMotionError, SpecialKind
from vipetsc.modes.response.state import Response
from vipetsc.modes.stability import AT_ZERO, Perturbations

if TYPE_CHECKING:
    from vipetsc.modes.response.equations import SteadyEquations

BRANCH_POINT = "branch-point"
PERIOD_DOUBLING = "period-doubling"
NEIMARK_SACKER = "neimark-sacker"


class StabilityChanges:
    """Changes of stability between two neighbouring states of a curve: those that ``nfrc.special_points`` asks for."""

    def __init__(self, states: "SteadyEquations", left: Response, right: Response) -> None:
        self.states = states
        self.left = left
        self.right = right

    def kinds(self) -> Iterator[SpecialKind[Response]]:
        """The kinds of points between the two states, but folds, which tangents show."""
        states = self.states
        left = states.stability(self.left.xi)
        right = states.stability(self.right.xi)
        # A state that is unstable on both sides of a point stays so: only "all" asks for such points. -1 is undecided.
        fewer = min(left.unstable, right.unstable)
        if fewer < 0 or (fewer > 0 and states.options.special_points == "stability"):
            return

        # A fold has a multiplier of 1 as well, which passes the line there or in one of the next steps. At a branch
        # point there is no fold, and D changes its sign at lambda = 0 as well as on the line.
        folds = self.left.tangent[-1] * self.right.tangent[-1] < 0
        passes_one = left.at_one * right.at_one < 0
        if passes_one and not folds:
            ends = [states.determinant(point.xi, AT_ZERO) for point in (self.left, self.right)]
            if ends[0] * ends[1] < 0:
                yield self._real(BRANCH_POINT, AT_ZERO, fewer)
        passes_minus_one = left.at_minus_one * right.at_minus_one < 0
        if passes_minus_one:
            yield self._real(PERIOD_DOUBLING, states.least_growth(self.left.xi) + 0.5j, fewer)

        # A real multiplier that passes changes the number by one, a pair by two.
        if abs(right.unstable - left.unstable) - passes_one - passes_minus_one >= 2:
            yield self._pair(left.unstable, fewer)

    def _real(self, name: str, exponent: complex, fewer: int) -> SpecialKind[Response]:
        """The kind where the real multiplier exp(2 pi ``exponent``) passes; ``fewer`` others grow there."""

        def determinant(point: Response) -> float:
            return self.states.determinant(point.xi, exponent)

        def finish(point: Response, left: Response, right: Response) -> Response:
            return self._measured(point, fewer, exponent)

        return SpecialKind(name, determinant, finish=finish)

    def _pair(self, unstable: int, fewer: int) -> SpecialKind[Response]:
        """The kind where a complex pair passes the line; at the left state ``unstable`` perturbations grow.

        The test is the distance of the pair's exponent from the line. The exponent is followed from the state at which
        the pair grows. If that fails, the test is a step, +-1/2, where the number of growing perturbations changes.
        """
        states = self.states
        exponents: dict[bytes, complex] = {}

        def distance(point: Response) -> float:
            """Re lambda over Om beyond the line; the guess is the exponent of the state found last."""
            key = point.xi.tobytes()
            if key not in exponents:
                exponents[key] = states.pair_near(point.xi, [*exponents.values()][-1])
            return exponents[key].real - states.least_growth(point.xi)

        def changed(point: Response) -> float:
            """1/2 where as many perturbations grow as at the left state, else -1/2."""
            return 0.5 - (states.stability(point.xi).unstable != unstable)

        def finish(point: Response, left: Response, right: Response) -> Response:
            return self._measured(point, fewer, exponents.get(point.xi.tobytes()))

        stable, growing = sorted((self.left, self.right), key=lambda point: states.stability(point.xi).unstable)
        # The pair that grows most slowly at this end is nearest to the line.
        with suppress(NoMotionError, IndexError):
            exponents[growing.xi.tobytes()] = states.growing_pairs(growing.xi)[0]
            if distance(stable) < 0:
                return SpecialKind(NEIMARK_SACKER, distance, finish=finish)
        return SpecialKind(NEIMARK_SACKER, changed, finish=finish)

    def _measured(self, point: Response, unstable: int, exponent: complex | None) -> Response:
        """The ``point`` with its measures, where ``unstable`` perturbations grow.

        The perturbation with that ``exponent`` neither grows nor decays, and is given as the fastest.
        """
        return replace(point, measures=self.states.measured(point.xi, Perturbations(unstable, exponent)))
