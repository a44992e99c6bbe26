"""Branches of conservative motions by harmonic balance: their start, and the unknowns of their continuation.

A *pair* is a contact or a smooth spring, contacts first (``harmonics``; files of branches call it a place); z are the
elongations of all pairs. In a motion of frequency Om that is at rest at phase 0 each is a sum of cosines,

    z(theta) = sum_k Z_k cos(k theta),    theta = Om t,    k = 0..K,

with real Z_k, of which those of odd k are enough where all forces are odd: such motions are symmetric. With the
harmonics F_k(Z) of the forces they solve the equations of ``harmonic_balance``,

    Z_k + G_s(k Om) (F_k - s_k Z_k) = 0,    G_s = (G^-1 + s_k)^-1.

The *shift* s_k in N/m, one number for each harmonic, is the stiffness of a spring that is added at each pair to the
linear system, whose compliance G becomes G_s, and taken off the pair's force. It keeps poles of G_s away from k Om. The
solutions do not depend on it, the residuals do: a ``HarmonicFrame`` keeps one through a step of the continuation. The
unknowns are Z_k, pair by pair, and the frequency.

The *truncation* of a motion is the estimated size of the harmonics left out over that of the motion
(``HarmonicBalance.truncation``). By it the number of harmonics is chosen at every point for the next one.

A branch begins at a linear mode, or at a frequency in a gap between or beyond the lattice's pass bands. In a gap a
describing function is the first guess: the motion of each pair is z = b + a cos(Om t), with a from a + G(Om) F_1 = 0
and the mean b from b + G(0) F_0 = 0. Then the compliances G(k Om) of the other harmonics, k > 1, are multiplied by a
weight that grows from 0 to 1.
"""

from collections.abc import Iterator

import numpy as np

from vipetsc.case.nnm_table import NnmTable
from vipetsc.modes.balance.describing_function import PairCompliance, describing_motion
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.balance.harmonics import Episode, SiteForces
from vipetsc.modes.balance.shifted_compliance import Compliance
from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.point import Point
from vipetsc.modes.problem import Attempt, ContinuationError, FlowError, SpecialKind, unit

# Order of the highest harmonic at the start; no motion has fewer harmonics.
FEWEST = 15
# The number of harmonics changes where the truncation is outside these fractions of the one allowed, and then so that
# it becomes the fraction AIM: far enough from both ends that the number does not change at every point.
FEWER = 0.02
MORE = 0.5
AIM = 0.2
# The truncation falls as the inverse cube of the order K at least: the harmonics of a force with a kink fall as k^-2,
# and so does G, hence Z_k as k^-4, and the sum of those beyond K as K^-3.
DECAY = 3
# In one step the order grows by this factor at most (and to the next odd number), since the estimate of a motion with
# few harmonics may be far off.
MOST_GROWTH = 2.0
# The energy's derivative along the branch is a difference over this distance along the tangent, to both sides.
SLOPE_STEP = 1e-5
# As the harmonics above the first are brought in: first step of their weight; how far the motion may change in one
# step, over the largest harmonic of the first guess; factors of the step after success and failure; the smallest step.
FIRST_WEIGHT = 0.1
FURTHEST = 0.1
LONGER = 1.6
SHORTER = 0.4
SMALLEST_WEIGHT = 1e-4
# Of an episode about the end of an arc the middle is the end but for rounding, up to this phase (rad). The arc includes
# both of its ends.
PHASE_ROUNDING = 1e-9


class HarmonicFrame:
    """Unknowns ``xi`` (n + 1,) at and near a motion with the harmonics x (n,) in m and the frequency Om in rad/s.

    They are x/``size``, with the largest |x| of the motion in m, and Om/``omega``, with its frequency. The equations
    ``balance``, with their number of harmonics, and their ``shift`` stay the same within a step. The unit ``tangent``
    (n + 1,) has been set if the branch has one at the motion; ``correct`` and ``tangent_at`` need it. Tangents of
    ``Point`` are d(x, period) in m and s, of any length.
    """

    tangent: np.ndarray

    def __init__(
        self, problem: "ConservativeMotions", balance: HarmonicBalance, x: np.ndarray, omega: float, size: float
    ) -> None:
        self.problem = problem
        self.balance = balance
        self.shift = balance.shift(omega)
        self.size = size
        self.omega = omega
        self.xi = np.append(x / size, 1.0)

    def motion(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Harmonics (n,) in m and frequency in rad/s at the unknowns ``xi`` (n + 1,)."""
        return xi[:-1] * self.size, float(xi[-1] * self.omega)

    def encode(self, point: Point) -> np.ndarray:
        """The unknowns (n + 1,) of another motion, which may have another number of harmonics."""
        x = self.problem.resized(point.x, self.balance)
        return np.append(x / self.size, 2 * np.pi / point.period / self.omega)

    def direction(self, point: Point) -> np.ndarray:
        """The branch's direction (n + 1,) at another motion, of any length."""
        # dOm = -2 pi/period^2 dperiod.
        harmonics = self.problem.resized(point.tangent[:-1], self.balance) / self.size
        return np.append(harmonics, -2 * np.pi / point.period**2 * point.tangent[-1] / self.omega)

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """The residual (n,) at the unknowns ``xi`` (n + 1,), which vanishes at a solution, over the size.

        Raises FlowError where the frequency has changed by a factor of 2 or more.
        """
        if not np.all(np.isfinite(xi)) or not 0.5 < xi[-1] < 2:
            raise FlowError("Newton's method left the domain: the frequency changed by a large factor")
        return self.balance.residual(*self.motion(xi), self.shift) / self.size

    def jacobian(self, xi: np.ndarray) -> np.ndarray:
        """Derivative (n, n + 1) of the residual."""
        x, omega = self.motion(xi)
        jacobian = self.balance.jacobian(x, omega, self.shift)
        rate = self.balance.rate(x, omega, self.shift)
        return np.column_stack([jacobian, rate * (self.omega / self.size)])

    def correct(self, guess: np.ndarray, arclength: float) -> Attempt:
        """Newton's method from ``guess`` (n + 1,) for the motion at an ``arclength`` along the tangent."""
        return self.solve(guess, self.tangent, self.tangent @ self.xi + arclength)

    def solve(self, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        """Newton's method from ``guess`` (n + 1,) for the motion with row . xi = value."""
        newton = self.problem.newton(self.balance)
        return newton.solve(self, guess, row, value, self.problem.tolerance)

    def tangent_at(self, xi: np.ndarray) -> np.ndarray:
        """The unit tangent (n + 1,) at a solution ``xi`` (n + 1,), along the branch on the side of the frame's own."""
        border = np.vstack([self.jacobian(xi), self.tangent])
        return unit(np.linalg.solve(border, np.append(np.zeros(len(xi) - 1), 1.0)))

    def measures(self, attempt: Attempt, direction: np.ndarray | None = None) -> Point:
        """The motion that an attempt has converged to.

        ``direction`` (n + 1,) is the branch's unit tangent there; without one, None, the motion has no slope. The
        point's ``energy_tangent`` is dE in J for a unit step along it in this frame's unknowns: from frame to frame
        only its sign can be compared.
        """
        balance = self.balance
        xi = attempt.xi
        x, omega = self.motion(xi)
        series = balance.series(x, omega)
        tangent = np.empty(0)
        energy_tangent = slope = np.nan
        if direction is not None:
            energies = [balance.energy(*self.motion(xi + s * SLOPE_STEP * direction), self.shift) for s in (1, -1)]
            energy_tangent = (energies[0] - energies[1]) / (2 * SLOPE_STEP)
            by_frequency = direction[-1] * self.omega / (2 * np.pi)
            # The slope is df/dE in Hz/J: infinite at a fold of the energy.
            slope = np.inf
            if energy_tangent:
                slope = by_frequency / energy_tangent
            period = 2 * np.pi / omega
            tangent = np.append(direction[:-1] * self.size, -direction[-1] * self.omega / (2 * np.pi) * period**2)

        return Point(
            x=x,
            period=2 * np.pi / omega,
            energy=balance.energy(x, omega, self.shift),
            residual=float(np.abs(balance.residual(x, omega, self.shift)).max() / self.size),
            episodes=self._episodes(series.episodes),
            closed=float(series.closed.max(initial=0.0)),
            newton=len(attempt.history) - 1,
            order=balance.order,
            truncation=balance.truncation(x, omega),
            # At phase 0 all cosines are 1.
            elongations=balance.unpack(x).real.sum(axis=1),
            tangent=tangent,
            energy_tangent=energy_tangent,
            slope=slope,
        )

    def _episodes(self, episodes: list[Episode]) -> int:
        """How often contacts close, or open if they are pressed at rest, from phase 0 to where the motion repeats.

        That is half a period for a motion at rest at phase 0, and a quarter if it is symmetric as well: the arcs that
        shooting integrates, with whose counts these are compared.
        """
        end = np.pi
        if self.balance.forces.odd:
            end = np.pi / 2
        middles: list[float] = []
        for pair, stops in enumerate(self.balance.forces.contacts):
            spans = [(episode.onset, episode.onset + episode.length) for episode in episodes if episode.pair == pair]
            if stops.is_pressed:
                spans = _between(spans)
            middles += [(begin + stop) / 2 for begin, stop in spans]

        count = 0
        for middle in middles:
            count += (middle + PHASE_ROUNDING) % (2 * np.pi) < end + 2 * PHASE_ROUNDING
        return count


def _between(spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The intervals of phase between ``spans``, sorted ones that do not overlap, and the first one's next turn."""
    after = [*spans[1:], *((begin + 2 * np.pi, stop) for begin, stop in spans[:1])]
    gaps = [(stop, begin) for (_, stop), (begin, _) in zip(spans, after, strict=True)]
    return [(begin, stop) for begin, stop in gaps if stop > begin]


class ConservativeMotions:
    """Branches of conservative motions of ``forces`` at pairs whose ``compliance`` is given.

    ``control`` is the table [nnm] of a case: harmonics are taken up to the order ``nnm.harmonics`` at most, and as many
    as the relative ``nnm.truncation`` needs.
    """

    # Floquet multipliers are not among these equations. What is guarded from point to point, besides the changes that
    # all problems have in common, is the truncation: at the highest order the harmonics left out may become too large.
    has_half_traces = False
    guards = frozenset({"truncation"})

    def __init__(self, compliance: Compliance, forces: SiteForces, control: NnmTable) -> None:
        self.compliance = compliance
        self.forces = forces
        self.control = control
        self.tolerance = control.tolerance
        # Equations and solvers by the order of the highest harmonic: a branch comes back to the same few.
        self._balances: dict[int, HarmonicBalance] = {}
        self._newtons: dict[int, DenseNewton] = {}

    def balance(self, order: int) -> HarmonicBalance:
        """The equations of motions with harmonics up to ``order``."""
        if order not in self._balances:
            self._balances[order] = HarmonicBalance(self.compliance, self.forces, order, self.forces.odd, cosines=True)
        return self._balances[order]

    def newton(self, balance: HarmonicBalance) -> DenseNewton:
        """Newton's method for equations of that size."""
        if balance.size not in self._newtons:
            self._newtons[balance.size] = DenseNewton(balance.size + 1, self.control.max_newton)
        return self._newtons[balance.size]

    def resized(self, x: np.ndarray, balance: HarmonicBalance) -> np.ndarray:
        """Unknowns (n,) of a ``balance`` from those of another one, ``x``; zero where they are new."""
        parts = x.reshape(self.forces.pairs, -1)
        out = np.zeros((len(parts), balance.size // len(parts)))
        count = min(parts.shape[1], out.shape[1])
        out[:, :count] = parts[:, :count]
        return out.ravel()

    @property
    def highest_order(self) -> int:
        """The highest order that is taken: ``nnm.harmonics``, or the odd number below it."""
        return (self.control.harmonics - 1) // 2 * 2 + 1

    def order_near(self, point: Point) -> int:
        """The order of the highest harmonic for motions near ``point``."""
        allowed = self.control.truncation
        order = point.order
        # The highest order is odd in any case: symmetric motions have no other.
        if point.truncation >= MORE * allowed:
            growth = (point.truncation / allowed / AIM) ** (1 / DECAY)
            order = int(order * min(growth, MOST_GROWTH)) // 2 * 2 + 1
        elif point.truncation <= FEWER * allowed:
            sizes = np.abs(point.x.reshape(self.forces.pairs, -1))
            # What would be left out from each harmonic on, that harmonic included.
            left_out = sizes[:, ::-1].cumsum(axis=1)[:, ::-1]
            count = int((left_out > AIM * allowed * sizes.sum(axis=1).max()).any(axis=0).sum())
            # The last of ``count`` harmonics has the order count - 1, of odd ones 2 count - 1. One more harmonic at
            # least is kept, since the sizes are those of this motion and not of the next one.
            order_beyond = count
            if self.forces.odd:
                order_beyond = 2 * count
            order = max(min(order_beyond // 2 * 2 + 1, order), FEWEST)
        return min(order, self.highest_order)

    def frame(self, point: Point, chart: str = "auto") -> HarmonicFrame:
        """The frame at a motion, with the harmonics that motions near it need.

        There is one chart: the name of a ``chart``, which other problems need, is not looked at.
        """
        balance = self.balance(self.order_near(point))
        x = self.resized(point.x, balance)
        frame = HarmonicFrame(self, balance, x, 2 * np.pi / point.period, float(np.abs(x).max()))
        if point.tangent.size:
            frame.tangent = unit(frame.direction(point))
        return frame

    def first_tangent(self, start: Point, direction: int) -> np.ndarray:
        """Tangent d(x, period) at a corrected motion, towards growing (+1) or falling (-1) energy."""
        frame = self.frame(start)
        # The frame may have other harmonics than the start, which then solves its equations up to the truncation. That
        # is exact enough for a tangent, which predicts the first step and gets corrected.
        null = np.linalg.svd(frame.jacobian(frame.xi))[2][-1]
        point = frame.measures(_solution(frame.xi), null)
        sign = np.sign(point.energy_tangent) * direction or direction
        harmonics = self.resized(point.tangent[:-1], self.balance(start.order))
        return np.append(harmonics, point.tangent[-1]) * sign

    def turn(self, before: Point, after: Point) -> float:
        """0: with one chart there is nothing to guard beyond the angle between the tangents of a step.

        Problems with several charts give the angle in relative units here, whatever the chart of the step.
        """
        return 0.0

    def special_kinds(self, left: Point, right: Point) -> Iterator[SpecialKind[Point]]:
        """Folds of the energy and of the frequency, where the motion is not linear."""
        # Linear motions have one frequency at all energies: their tests would be rounding.
        if left.episodes or not self.forces.is_linear_at_rest:
            yield SpecialKind("fold-energy", lambda p: p.energy_tangent)
            yield SpecialKind("fold-frequency", lambda p: float(p.tangent[-1] / p.period))

    def refined(self, point: Point, keep_frequency: bool) -> Point:
        """The motion of the frequency, or else of the amplitude, of ``point``, with as many harmonics as are needed.

        If the order ``nnm.harmonics`` is not enough, it has all of these. Raises ContinuationError where Newton's
        method fails.
        """
        while True:
            order = point.order
            frame = self.frame(point)
            x = self.resized(point.x, frame.balance)
            row = unit(np.append(x, 0.0))
            if keep_frequency:
                row = np.append(0 * x, 1.0)
            attempt = frame.solve(frame.xi, row, row @ frame.xi)
            if not attempt.converged:
                why = f"{attempt.reason}; residuals {attempt.residuals}"
                raise ContinuationError(f"no motion at f = {point.frequency:.9g} Hz ({why}): choose another start")
            point = frame.measures(attempt)
            if point.truncation <= MORE * self.control.truncation:
                return point
            # A guess may need fewer harmonics than the motion: that the order has not changed is not enough.
            if point.order == order == self.highest_order:
                return point

    def from_mode(self, z: np.ndarray, omega: float) -> Point:
        """The motion near a linear mode of frequency ``omega`` (rad/s) with the elongations ``z`` (pairs,) in m."""
        return self.refined(self._guess(self.one_harmonic(z), omega), keep_frequency=False)

    def from_gap(self, omega: float, signs: np.ndarray) -> Point:
        """The motion of ``omega`` (rad/s) with contact at the pairs whose ``signs`` (pairs,) are +1 or -1.

        A pair of the sign -1 moves half a period later than one of +1: its cosine has the other sign, its mean the
        same. Raises ContinuationError where there is no motion with one harmonic, or none is reached by bringing in the
        others.
        """
        # A harmonic motion of forces that are odd has no mean, and the static compliance need not be there.
        static_at = 0.0
        if self.forces.odd:
            static_at = omega
        static, dynamic = self.compliance.at(np.array([static_at, omega]))
        z = np.zeros(len(signs))
        mean = np.zeros(len(signs))
        for pair in np.nonzero(signs)[0].tolist():
            g = PairCompliance(static=float(static[pair, pair]), dynamic=float(dynamic[pair, pair]))
            described = describing_motion(self.forces, pair, g, omega)
            mean[pair] = described.mean
            z[pair] = signs[pair] * described.amplitude
            # A first guess: the force at this pair moves the pairs without a force of their own by the ratio of the
            # compliances; how it moves the others is left to Newton's method.
            z += np.where(signs == 0, dynamic[:, pair] / g.dynamic * z[pair], 0.0)

        x = self.one_harmonic(z, mean)
        size = float(np.abs(z).max())
        row = np.append(0 * x, 1.0)
        weight = 0.0
        step = FIRST_WEIGHT
        # Harmonics above the first change the motion smoothly with their weight; at once Newton's method would be lost.
        while weight < 1:
            tried = min(weight + step, 1.0)
            frame = HarmonicFrame(self, self.balance(FEWEST).weighted(tried), x, omega, size)
            attempt = frame.solve(frame.xi, row, 1.0)
            # Over ``size``, as the unknowns are.
            moved = np.linalg.norm(attempt.xi[:-1] - x / size)
            if attempt.converged and moved < FURTHEST:
                x = attempt.xi[:-1] * size
                weight = tried
                step = LONGER * step
                continue
            step = SHORTER * step
            if step < SMALLEST_WEIGHT:
                raise ContinuationError(
                    f"no breather at {omega:g} rad/s: with {weight:.3g} of the harmonics above the first, Newton's "
                    f"method ends ({attempt.reason}); change nnm.start_frequency or raise nnm.max_newton"
                )
        return self.refined(self._guess(x, omega), keep_frequency=True)

    def one_harmonic(self, z: np.ndarray, mean: np.ndarray | float = 0.0) -> np.ndarray:
        """Unknowns with the fewest harmonics of a motion ``mean`` + z cos(theta), ``z`` (pairs,) and mean in m."""
        balance = self.balance(FEWEST)
        harmonics = z[:, None] * (np.arange(balance.order + 1) == 1)
        harmonics[:, 0] = mean
        return balance.pack(harmonics)

    def _guess(self, x: np.ndarray, omega: float) -> Point:
        """A point to be corrected, of unknowns with the fewest harmonics."""
        frame = HarmonicFrame(self, self.balance(FEWEST), x, omega, 1.0)
        return frame.measures(_solution(frame.xi))


def _solution(xi: np.ndarray) -> Attempt:
    """Unknowns ``xi`` as if Newton's method had found them, for ``HarmonicFrame.measures``."""
    return Attempt(converged=True, reason="", history=[], xi=xi)
