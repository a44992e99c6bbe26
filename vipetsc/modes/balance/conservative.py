"""Branches of conservative motions by harmonic balance: their start, and the unknowns of their continuation.

A *place* is a contact or a smooth spring; z are the elongations of all places, contacts first. Their harmonics Z_k in a
motion of frequency Om, with the harmonics F_k(Z) of the forces, solve the equations of the package's docstring,

    Z_k + G_s(k Om) (F_k - s_k Z_k) = 0,

where the *shift* s_k is the stiffness of springs that are added to the compliance G and taken off the forces, so that
G_s has no pole near k Om. The solutions do not depend on it, the residuals do: a step of the continuation, which is a
``HarmonicFrame``, keeps one. The motions are at rest at phase 0, so that the Z_k are real (cosines alone), and
symmetric where all forces are odd (odd harmonics alone). The unknowns are Z_k, place by place, and the frequency.

The *truncation* of a motion is the estimated size of the harmonics left out over that of the motion
(``HarmonicBalance.truncation``). By it the number of harmonics is chosen at every point for the next one.

A branch begins at a linear mode, or at a frequency in a gap. There a describing function, z = b + a cos(Om t) at one
place, gives a from a + G(Om) F_1 = 0 and the mean from b + G(0) F_0 = 0, and the other harmonics are brought in with a
growing weight.
"""

from collections.abc import Iterator

import numpy as np

from vipetsc.case.nnm_table import NnmTable
from vipetsc.modes.balance.describing_function import PlaceCompliance, describing_motion
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
# The truncation falls as the inverse cube of the order at least (``HarmonicBalance.truncation``). In one step
# the order grows by this factor at most, since the estimate of a motion with few harmonics may be far off.
DECAY = 3
MOST_GROWTH = 2.0
# Step along the tangent, in the unknowns, by whose two ends the energy's derivative along the branch is taken.
SLOPE_STEP = 1e-5
# As the harmonics above the first are brought in: first step of their weight, how far the motion may change in one, in
# its size, factors of the step after success and failure, and the smallest step.
FIRST_WEIGHT = 0.1
FURTHEST = 0.1
LONGER = 1.6
SHORTER = 0.4
SMALLEST_WEIGHT = 1e-4
# A contact episode whose middle lies within this phase (rad) of the arc's ends is on the end: counted once.
PHASE_ROUNDING = 1e-9


class HarmonicFrame:
    """Unknowns at and near a motion: harmonics over their largest ``size`` in m, and the frequency over its ``omega``.

    The equations ``balance``, with their number of harmonics, and their ``shift`` stay the same within a step. The unit
    ``tangent`` (n + 1,) is there if the branch has one at the motion, which ``correct`` and ``tangent_at`` need.
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

        ``direction`` (n + 1,) is the branch's unit tangent there; without one, None, the motion has no slope.
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
    """The intervals of phase between ``spans``, which are in their order and less than a period together."""
    after = [*spans[1:], *((begin + 2 * np.pi, stop) for begin, stop in spans[:1])]
    gaps = [(stop, begin) for (_, stop), (begin, _) in zip(spans, after, strict=True)]
    return [(begin, stop) for begin, stop in gaps if stop > begin]


class ConservativeMotions:
    """Branches of conservative motions of ``forces`` at places whose ``compliance`` is given, by [nnm].

    At most ``nnm.harmonics`` are taken, and as many as the relative ``nnm.truncation`` needs.
    """

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
            beyond = sizes[:, ::-1].cumsum(axis=1)[:, ::-1]
            needed = int((beyond > AIM * allowed * sizes.sum(axis=1).max()).any(axis=0).sum())
            if self.forces.odd:
                needed = 2 * needed
            order = max(min(needed // 2 * 2 + 1, order), FEWEST)
        return min(order, self.control.harmonics)

    def frame(self, point: Point, chart: str = "auto") -> HarmonicFrame:
        """The frame at a motion, with the harmonics that motions near it need; there is one ``chart``."""
        balance = self.balance(self.order_near(point))
        x = self.resized(point.x, balance)
        frame = HarmonicFrame(self, balance, x, 2 * np.pi / point.period, float(np.abs(x).max()))
        if point.tangent.size:
            frame.tangent = unit(frame.direction(point))
        return frame

    def first_tangent(self, start: Point, direction: int) -> np.ndarray:
        """Tangent d(x, period) at a corrected motion, towards growing (+1) or falling (-1) energy."""
        frame = self.frame(start)
        null = np.linalg.svd(frame.jacobian(frame.xi))[2][-1]
        point = frame.measures(Attempt(True, "", [], frame.xi), null)
        sign = np.sign(point.energy_tangent) * direction or direction
        harmonics = self.resized(point.tangent[:-1], self.balance(start.order))
        return np.append(harmonics, point.tangent[-1]) * sign

    def turn(self, before: Point, after: Point) -> float:
        """0: shooting guards a second angle between tangents here; in these unknowns that of the step is enough."""
        return 0.0

    def special_kinds(self, left: Point, right: Point) -> Iterator[SpecialKind[Point]]:
        """Folds of the energy and of the frequency, where the motion is not linear."""
        if left.episodes or not self.forces.is_linear_at_rest:
            yield SpecialKind("fold-energy", lambda p: p.energy_tangent)
            yield SpecialKind("fold-frequency", lambda p: float(p.tangent[-1] / p.period))

    def refined(self, point: Point, keep_frequency: bool) -> Point:
        """The motion of the frequency, or else of the amplitude, of ``point``, with as many harmonics as are needed.

        Raises ContinuationError where Newton's method fails.
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
            if point.truncation <= MORE * self.control.truncation or point.order == order:
                return point

    def from_mode(self, z: np.ndarray, omega: float) -> Point:
        """The motion near a linear mode of frequency ``omega`` (rad/s) with the elongations ``z`` (places,) in m."""
        return self.refined(self._guess(self.one_harmonic(z), omega), keep_frequency=False)

    def from_gap(self, omega: float, signs: np.ndarray) -> Point:
        """The motion of ``omega`` (rad/s) with contact at the places whose ``signs`` (places,) are +1 or -1.

        Raises ContinuationError where there is none with one harmonic, or none is reached by bringing in the others.
        """
        # A harmonic motion of forces that are odd has no mean, and the static compliance need not be there.
        static_at = 0.0
        if self.forces.odd:
            static_at = omega
        static, dynamic = self.compliance.at(np.array([static_at, omega]))
        z = np.zeros(len(signs))
        mean = np.zeros(len(signs))
        for place in np.nonzero(signs)[0].tolist():
            g = PlaceCompliance(float(static[place, place]), float(dynamic[place, place]))
            mean[place], amplitude = describing_motion(self.forces, place, g, omega)
            z[place] = signs[place] * amplitude
            # A first guess: the force at this place moves the places without a force of their own by the ratio of the
            # compliances; how it moves the others is left to Newton's method.
            z += np.where(signs == 0, dynamic[:, place] / g.dynamic * z[place], 0.0)

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
        """Unknowns with the fewest harmonics of a motion ``mean`` + z cos(theta), ``z`` (places,) and mean in m."""
        balance = self.balance(FEWEST)
        harmonics = z[:, None] * (np.arange(balance.order + 1) == 1)
        harmonics[:, 0] = mean
        return balance.pack(harmonics)

    def _guess(self, x: np.ndarray, omega: float) -> Point:
        """A point to be corrected, of unknowns with the fewest harmonics."""
        frame = HarmonicFrame(self, self.balance(FEWEST), x, omega, 1.0)
        return frame.measures(Attempt(False, "", [], frame.xi))
