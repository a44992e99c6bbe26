r"""Curves of special points of steady states over two parameters, the frequency and the amplitude of the drive.

Along a curve over the frequency there are folds, branch points, period doublings and Neimark-Sacker points
(``stability_changes``). With the amplitude as a second parameter each kind forms a curve of its own, which bounds the
frequencies and amplitudes with a jump, a broken symmetry, a doubled period, a modulated motion. It solves

    R(x, Om, a) = 0,    g(x, Om, a) = 0,

with the equations R of steady states (``equations``) and one number g that vanishes at points of the kind. At a fold
the derivative J = dR/dx is singular: with fixed vectors b and c, near its null vectors, g follows from

    J v + b g = 0,    c . v = 1;    dg = -w . dJ v,    J^T w + c g = 0,    b . w = 1

(minimally augmented system: Griewank and Reddien, IMA J. Numer. Anal. 4 (1984) 203; Govaerts 2000). Of dJ v by x a
difference along v is enough, as second derivatives commute. At a branch point or a period doubling g is Hill's
determinant at the exponent that passes, at a Neimark-Sacker point the growth of the pair beyond its line; derivatives
are differences. A *cusp* is a point at which two folds meet, where the curve turns back in both parameters; where the
amplitude alone turns back (``extreme-amplitude``) an isolated curve begins, or two curves meet.
"""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from vipetsc.endings import Ended, Ending
from vipetsc.modes.cache import BoundedCache
from vipetsc.modes.problem import ContinuationError, FlowError, NoMotionError, SpecialKind
from vipetsc.modes.response.stability_changes import NEIMARK_SACKER, PERIOD_DOUBLING
from vipetsc.modes.response.state import Measures, Response
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.stability import AT_ZERO, Stability
from vipetsc.modes.user_equations import DIFFERENCE, UserFrame, UserProblem, UserSteps

FOLD = "fold"
# The amplitude's part of a tangent below which it turns back together with the frequency: at a cusp.
AT_CUSP = 1e-3
# A special point on a line between two neighbours is nearer to it than this fraction of their distance.
NEAR = 0.2
# Amplitudes whose equations are kept: that of a point and those of its differences.
KEPT = 5


class SpecialCurve(UserProblem):
    """Special points of a ``kind`` of the curve of ``states`` over the frequency (``PeriodicProblem``).

    Unknowns (n + 2,) are the harmonics over the clearance, the amplitude over that of the curve, and its scaled
    frequency.
    """

    def __init__(self, states: SteadyStates, kind: str, point: Response) -> None:
        self.states = states
        self.kind = kind
        self._amplitude = states.parameter.fixed
        self._latest = BoundedCache[float, SteadyStates](KEPT)
        self._exponent = complex(AT_ZERO)
        if kind == PERIOD_DOUBLING:
            self._exponent = states.least_growth(point.xi) + 0.5j
        if kind == NEIMARK_SACKER:
            # That of the pair, which is found again from point to point. A point that was located by the number of
            # growing perturbations alone has none.
            self._exponent = complex(states.least_growth(point.xi), point.measured.sideband)
            if not np.isfinite(self._exponent):
                pairs = states.growing_pairs(point.xi)
                if not pairs:
                    raise ContinuationError("no pair of multipliers is found at the point: increase nfrc.harmonics")
                self._exponent = pairs[0]
        self._size = 1.0
        count = states.balance.size
        super().__init__(self._equations, self._derivative, np.ones(count + 2), states.tolerance, states.max_newton)
        self.first = np.insert(point.xi, -1, 1.0)
        self._prepare(self.first)
        self._size = float(np.linalg.norm(self._slope(self.first[:-1], self.first[-1]))) or 1.0

    def start(self, side: int) -> Response:
        """Return the point of the amplitude of the curve, with the tangent of one ``side`` (1 or -1)."""
        attempt = self.solve(self.first, np.eye(len(self.first))[-2], 1.0)
        if not attempt.converged:
            raise ContinuationError(f"no {self.kind} is found again: {attempt.reason}; residuals {attempt.residuals}")
        return Response(xi=attempt.xi, tangent=side * self.null_vectors(attempt.xi)[0])

    def frame(self, point: Response, chart: str = "auto") -> UserFrame:
        """Return the frame at a point, whose vectors b and c and exponent of a pair serve near it."""
        self._prepare(point.xi)
        return super().frame(point, chart)

    def special_kinds(self, left: Response, right: Response) -> Iterator[SpecialKind[Response]]:
        """Yield where the amplitude turns back: with the frequency at a cusp, alone where an isolated curve begins."""

        def is_cusp(point: Response) -> bool:
            return bool(abs(point.tangent[-1]) < AT_CUSP)

        yield SpecialKind("cusp", lambda point: float(point.tangent[-2]), accept=is_cusp)
        yield SpecialKind(
            "extreme-amplitude", lambda point: float(point.tangent[-2]), accept=lambda point: not is_cusp(point)
        )

    def measured(self, xi: np.ndarray) -> Measures:
        """Return the measures of a point; its stability is undecided, since it changes there."""
        states, inner = self._at(xi[:-1], xi[-1])
        return states.measured(inner, Stability(-1, fastest=None))

    def _at(self, y: np.ndarray, p: float) -> tuple[SteadyStates, np.ndarray]:
        """Return the equations at the amplitude, the last number of ``y``, and the unknowns of these equations."""
        amplitude = float(y[-1] * self._amplitude)
        return self._latest.get(amplitude, lambda: self._states_at(amplitude)), np.append(y[:-1], p)

    def _states_at(self, amplitude: float) -> SteadyStates:
        base = self.states
        return SteadyStates(base.case, base.restitution, amplitude, like=base)

    def _prepare(self, xi: np.ndarray) -> None:
        """Take the shift of the compliance, b and c, and the exponent of a pair from the point ``xi`` (n + 2,)."""
        states, inner = self._at(xi[:-1], xi[-1])
        self._shift = states.shift_near(inner)
        if self.kind == FOLD:
            left, _, right = np.linalg.svd(states.jacobian(inner, self._shift)[:, :-1])
            self._b = left[:, -1]
            self._c = right[-1]
        elif self.kind == NEIMARK_SACKER:
            self._exponent = states.pair_near(inner, self._exponent)

    def _equations(self, y: np.ndarray, p: float) -> np.ndarray:
        """Return R (n,) and g."""
        states, inner = self._at(y, p)
        return np.append(states.residual(inner, self._shift), self._test(y, p) / self._size)

    def _derivative(self, y: np.ndarray, p: float) -> np.ndarray:
        """Return the derivative (n + 1, n + 1) by harmonics and amplitude."""
        states, inner = self._at(y, p)
        step = DIFFERENCE * np.eye(len(y))[-1]
        residuals = []
        for end in (y + step, y - step):
            at_end, inner_end = self._at(end, p)
            residuals.append(at_end.residual(inner_end, self._shift))
        by_amplitude = (residuals[0] - residuals[1]) / (2 * DIFFERENCE)
        rows = np.column_stack([states.jacobian(inner, self._shift)[:, :-1], by_amplitude])
        return np.vstack([rows, self._slope(y, p)[:-1] / self._size])

    def _test(self, y: np.ndarray, p: float) -> float:
        """Return the number g."""
        if self.kind == FOLD:
            g, _, _ = self._bordered(y, p)
            return g
        states, inner = self._at(y, p)
        if self.kind == NEIMARK_SACKER:
            try:
                return states.pair_near(inner, self._exponent).real - states.least_growth(inner)
            except NoMotionError as error:
                # A shorter step leads to a state whose pair is nearer.
                raise FlowError(str(error)) from None
        return states.determinant(inner, self._exponent)

    def _jacobian(self, y: np.ndarray, p: float) -> np.ndarray:
        states, inner = self._at(y, p)
        return states.jacobian(inner, self._shift)[:, :-1]

    def _bordered(self, y: np.ndarray, p: float) -> tuple[float, np.ndarray, np.ndarray]:
        """Return g, v and w of the docstring of the module."""
        matrix = np.block([[self._jacobian(y, p), self._b[:, None]], [self._c[None], np.zeros((1, 1))]])
        right = np.eye(len(matrix))[-1]
        v = np.linalg.solve(matrix, right)
        w = np.linalg.solve(matrix.T, right)
        return float(v[-1]), v[:-1], w[:-1]

    def _slope(self, y: np.ndarray, p: float) -> np.ndarray:
        """Return the derivative (n + 2,) of g by harmonics, amplitude and frequency."""
        steps = DIFFERENCE * np.eye(len(y) + 1)
        xi = np.append(y, p)
        if self.kind != FOLD:
            values = [self._test((xi + s)[:-1], (xi + s)[-1]) - self._test((xi - s)[:-1], (xi - s)[-1]) for s in steps]
            return np.array(values) / (2 * DIFFERENCE)

        _, v, w = self._bordered(y, p)
        # w . d(J v) by x is w . (dJ along v); by amplitude and frequency a difference each.
        along = np.concatenate([v, [0.0, 0.0]])
        changes = []
        for step in (DIFFERENCE * along, steps[-2], steps[-1]):
            after = self._jacobian((xi + step)[:-1], (xi + step)[-1])
            before = self._jacobian((xi - step)[:-1], (xi - step)[-1])
            changes.append((after - before) / (2 * DIFFERENCE))
        by_x, by_amplitude, by_frequency = changes
        return -np.concatenate([w @ by_x, [w @ by_amplitude @ v, w @ by_frequency @ v]])


class SpecialSteps(UserSteps):
    """Steps within the range of frequencies and amplitudes of a curve of special points."""

    def __init__(self, problem: SpecialCurve, first: Response, points: int) -> None:
        options = problem.states.options
        scale = problem.states.parameter.scale
        super().__init__(problem, first, np.array(options.range) / scale, points, options.largest_step)
        self.scale = scale
        self.amplitude = problem.states.parameter.fixed
        self.reach = options.isola_reach

    def end(self, before: Response, point: Response) -> tuple[Response, Ended] | None:
        """Return the point at which the range of frequencies ends, or the first beyond the range of amplitudes."""
        over = point.xi[-2]
        if not 1 / self.reach <= over <= self.reach:
            return point, Ending.END_OF_AMPLITUDES.with_numbers(end=over * self.amplitude)
        return super().end(before, point)

    def ended_at(self, bound: float) -> Ended:
        """Return that the frequency came to an end of its range."""
        return Ending.END_OF_RANGE.with_numbers(end=bound * self.scale)


def crosses_amplitude(points: list[Response], special: Response) -> bool:
    """Return whether a curve of special ``points`` passes a ``special`` point of a curve over the frequency."""
    for before, after in pairwise(point.xi for point in points):
        if (before[-2] - 1) * (after[-2] - 1) > 0 or before[-2] == after[-2]:
            continue
        # A line between two neighbours errs by what the curve turns in a step.
        place = (1 - before[-2]) / (after[-2] - before[-2])
        passed = np.delete(before + place * (after - before), -2)
        if np.linalg.norm(passed - special.xi) < NEAR * np.linalg.norm(after - before):
            return True
    return False
