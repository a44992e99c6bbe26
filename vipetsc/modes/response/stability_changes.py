"""Special points of curves of steady states at which stability changes: what kind they are, and where.

A perturbation exp(lambda t) begins to grow where its exponent lambda, over Om, passes the line Re lambda = ``least`` of
Hill's method: a real one at a fold or a branch point, one with Im lambda = 1/2 at a period doubling, a complex pair at
a Neimark-Sacker bifurcation, behind which the motion is quasi-periodic. On the real axis and on Im lambda = 1/2 Hill's
determinant D is real, and a zero passes the line where its sign there changes. What these zeros leave of a change of
the number of growing perturbations is due to pairs.

Two changes between neighbouring states that cancel are not seen, as where one pair begins to grow and another one to
decay.
"""

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from vipetsc.case.nfrc import NfrcTable
from vipetsc.modes.balance.harmonics import ForceSeries
from vipetsc.modes.cache import BoundedCache
from vipetsc.modes.problem import NoMotionError, SpecialKind
from vipetsc.modes.response.state import Measures, Response
from vipetsc.modes.response.turning import RangeProblem
from vipetsc.modes.stability import AT_ZERO, Hill, Stability

BRANCH_POINT = "branch-point"
PERIOD_DOUBLING = "period-doubling"
NEIMARK_SACKER = "neimark-sacker"


# States whose stability is kept: the ends of a step, and one between them. Without special points one is enough.
KEPT_STATES = 3


class StatesWithStability(RangeProblem):
    """Steady states, each given by its unknowns ``xi`` (n + 1,), whose perturbations Hill's determinant judges.

    ``options`` are the section [nfrc] of the case.
    """

    def __init__(self, options: NfrcTable) -> None:
        self.options = options
        self._stabilities = BoundedCache[bytes, Stability](KEPT_STATES)

    @abstractmethod
    def hill_at(self, xi: np.ndarray) -> tuple[Hill, ForceSeries]:
        """Return Hill's determinant of motions near the state ``xi`` (n + 1,), and the forces there."""

    def stability(self, xi: np.ndarray) -> Stability:
        """Return the stability of a state ``xi`` (n + 1,), kept since neighbours on a curve are compared."""

        def evaluate() -> Stability:
            hill, series = self.hill_at(xi)
            return hill.stability(series)

        return self._stabilities.get(xi.tobytes(), evaluate)

    @abstractmethod
    def measured(self, xi: np.ndarray, stability: Stability | None = None) -> Measures:
        """Return the measures of the state ``xi`` (n + 1,) for its file.

        Its ``stability`` is looked for unless it is given.
        """

    def determinant(self, xi: np.ndarray, exponent: complex) -> float:
        """Return Hill's determinant of the state ``xi`` (n + 1,) at lambda/Om = ``exponent``, where it is real."""
        hill, series = self.hill_at(xi)
        return float(hill.determinants(series, np.array([exponent]))[0].real)

    def growing_pairs(self, xi: np.ndarray) -> list[complex]:
        """Return lambda/Om of complex pairs of growing perturbations of the state ``xi`` (n + 1,), slowest first."""
        hill, series = self.hill_at(xi)
        return hill.pairs(series)

    def pair_near(self, xi: np.ndarray, guess: complex) -> complex:
        """Return lambda/Om of the pair of a state ``xi`` (n + 1,) near a ``guess``; raises NoMotionError."""
        hill, series = self.hill_at(xi)
        return hill.near(series, guess)

    def least_growth(self, xi: np.ndarray) -> float:
        """Return Re lambda/Om up to which perturbations of the state ``xi`` (n + 1,) count as stable."""
        hill, _ = self.hill_at(xi)
        return hill.least

    def special_kinds(self, left: Response, right: Response) -> Iterator[SpecialKind[Response]]:
        """Yield folds, where the parameter's component of the tangent changes sign, and other changes of stability."""
        yield SpecialKind("fold", lambda point: float(point.tangent[-1]))
        yield from StabilityChanges(self, left, right).kinds()


class StabilityChanges:
    """Changes of stability between two neighbouring states of a curve: those that ``nfrc.special_points`` asks for."""

    def __init__(self, states: "StatesWithStability", left: Response, right: Response) -> None:
        self.states = states
        self.left = left
        self.right = right

    def kinds(self) -> Iterator[SpecialKind[Response]]:
        """Yield the kinds of points between the two states, but folds, which tangents show."""
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
        """Return the kind where the real multiplier exp(2 pi ``exponent``) passes; ``fewer`` others grow there."""

        def determinant(point: Response) -> float:
            return self.states.determinant(point.xi, exponent)

        def finish(point: Response, left: Response, right: Response) -> Response:
            return self._measured(point, fewer, exponent)

        return SpecialKind(name, determinant, finish=finish)

    def _pair(self, unstable: int, fewer: int) -> SpecialKind[Response]:
        """Return the kind where a complex pair passes the line; at the left state ``unstable`` perturbations grow.

        The test is the distance of the pair's exponent from the line. The exponent is followed from the state at which
        the pair grows. If that fails, the test is a step, +-1/2, where the number of growing perturbations changes.
        """
        states = self.states
        exponents: dict[bytes, complex] = {}

        def distance(point: Response) -> float:
            """Return Re lambda over Om beyond the line; the guess is the exponent of the state found last."""
            key = point.xi.tobytes()
            if key not in exponents:
                exponents[key] = states.pair_near(point.xi, [*exponents.values()][-1])
            return exponents[key].real - states.least_growth(point.xi)

        def changed(point: Response) -> float:
            """Return 1/2 where as many perturbations grow as at the left state, else -1/2."""
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
        """Return the ``point`` with its measures, where ``unstable`` perturbations grow.

        The perturbation with that ``exponent`` neither grows nor decays, and is given as the fastest.
        """
        return replace(point, measures=self.states.measured(point.xi, Stability(unstable, fastest=exponent)))
