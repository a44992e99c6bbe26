"""Branches of conservative motions by harmonic balance: their start, and the unknowns of their continuation.

The motions are at rest at phase 0 (cosines alone), and symmetric where all forces are odd (odd harmonics alone). The
number of harmonics is chosen at every point for the next one by the estimate of what is left out. A branch begins at
a linear mode, or at a frequency in a gap: there a describing function, z = b + a cos(Om t) at one place, gives a from
1 + G(Om) F_1/a = 0 and the mean from b + G(0) F_0 = 0, and the other harmonics are brought in with a growing weight.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from vipetsc.case.nnm_table import NnmTable
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.balance.harmonics import Episode, SiteForces
from vipetsc.modes.balance.shifted_compliance import Compliance
from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.point import Point
from vipetsc.modes.problem import Attempt, ContinuationError, FlowError, SpecialKind, unit

# Order of the highest harmonic at the start; no motion has fewer harmonics.
FEWEST = 15
# The harmonics change where the part left out is outside these fractions of what is allowed, and then so that it
# becomes the fraction AIM of it: far enough from both ends that they do not change at every point.
FEWER = 0.02
MORE = 0.5
AIM = 0.2
# Step along the tangent by whose two ends the energy's slope is taken.
SLOPE_STEP = 1e-5
# Largest size of a describing function, in clearances, and the mean over the amplitude that is none.
LARGEST = 1e3
LEAST_MEAN = 1e-14
# Of a contact that is pressed at rest the smallest size, in its depth there, and the sizes that are tried: its force
# softens as it opens and hardens beyond, so that the two ends do not tell whether there is a motion.
LEAST_OF_PRESSED = 1e-2
TRIED_OF_PRESSED = 41
# As the harmonics above the first are brought in: first step of their weight, how far the motion may change in one,
# and the smallest.
FIRST_WEIGHT = 0.1
FURTHEST = 0.1
SMALLEST_WEIGHT = 1e-4
# A contact episode whose middle lies within this phase (rad) of the arc's ends is on the end: counted once.
PHASE_ROUNDING = 1e-9


class HarmonicFrame:
    """Unknowns at and near a motion: harmonics over their largest ``size`` in m, and the frequency over its ``omega``.

    Its ``balance`` and ``shift`` are those of the step: the number of harmonics stays within it.
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
        """The residual (n,), which vanishes at a solution, over the size."""
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
        """The motion that an attempt has converged to, where ``direction`` is the branch's unit tangent or empty."""
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
            # At a fold of the energy the branch is vertical.
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
        """How often contacts close, or open if they are pressed at rest, in the arc that shooting would cover."""
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
        if point.truncation >= MORE * allowed:
            # What is left out falls as the inverse cube of the order.
            order = int(order * min((point.truncation / allowed / AIM) ** (1 / 3), 2.0)) // 2 * 2 + 1
        elif point.truncation <= FEWER * allowed:
            sizes = np.abs(point.x.reshape(self.forces.pairs, -1))
            beyond = sizes[:, ::-1].cumsum(axis=1)[:, ::-1]
            needed = (beyond > AIM * allowed * sizes.sum(axis=1).max()).any(axis=0)
            order = max(min(int(needed.sum()) * (1 + self.forces.odd) // 2 * 2 + 1, order), FEWEST)
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
        """Angle between the tangents of two motions in relative units: that of the step, which is guarded anyway."""
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
            # The force there moves the places that are not in contact, too.
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
                step = 1.6 * step
                continue
            step = 0.4 * step
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


class PlaceCompliance(NamedTuple):
    """Compliance in m/N of one place: ``static``, which the mean of a force meets, and ``dynamic``, at a frequency."""

    static: float
    dynamic: float


class DescribedMotion(NamedTuple):
    """A motion ``mean`` + ``amplitude`` cos(theta) of one place, in m."""

    mean: float
    amplitude: float


def describing_motion(forces: SiteForces, place: int, g: PlaceCompliance, omega: float) -> DescribedMotion:
    """The motion z = b + a cos(Om t) at a ``place`` with one of the ``forces``, of which two harmonics balance.

    b + G(0) F_0 = 0 gives the mean b of every amplitude a, which increases with the force; a + G(Om) F_1 = 0 gives a.
    Raises ContinuationError where there is none.
    """
    spring = place - len(forces.contacts)
    if spring >= 0 and forces.springs[spring].cubic == 0:
        raise ContinuationError(
            f"no breather starts at {omega:g} rad/s on a spring without a cubic part: of a harmonic motion its "
            "quadratic force has a mean and a second harmonic alone; give it a cubic part, or begin at another place"
        )
    is_pressed = place < len(forces.contacts) and forces.contacts[place].is_pressed
    z = np.zeros((forces.pairs, 2), complex)

    def force(mean: float, amplitude: float) -> np.ndarray:
        z[place] = mean, amplitude
        return forces.series(z, omega).forces[place].real

    def mean_of(amplitude: float) -> float:
        def static_balance(mean: float) -> float:
            return mean + g.static * float(force(mean, amplitude)[0])

        # Odd forces have no mean. Of forces that harden it lies between 0 and that of the force at 0; of others the
        # balance of all harmonics will find it.
        without = static_balance(0.0)
        furthest = -without
        while is_pressed and static_balance(furthest) * without > 0 and abs(furthest) < LARGEST * amplitude:
            furthest *= 2
        if forces.odd or abs(without) <= LEAST_MEAN * amplitude or static_balance(furthest) * without >= 0:
            return 0.0
        return float(brentq(static_balance, furthest, 0.0))

    def balance(amplitude: float) -> float:
        return amplitude + g.dynamic * float(force(mean_of(amplitude), amplitude)[1])

    size = forces.amplitude_scale(place, g.dynamic)
    sizes = [size, LARGEST * size]
    if is_pressed:
        sizes = (size * np.geomspace(LEAST_OF_PRESSED, LARGEST, TRIED_OF_PRESSED)).tolist()
    for low, high in itertools.pairwise(sizes):
        if balance(low) * balance(high) < 0:
            amplitude = float(brentq(balance, low, high, rtol=1e-12))
            return DescribedMotion(mean=mean_of(amplitude), amplitude=amplitude)

    needs = "a force that hardens needs a negative one of moderate size"
    if is_pressed:
        needs = "the force of a contact that is pressed at rest balances it at no amplitude"
    raise ContinuationError(
        f"no breather starts at {omega:g} rad/s: the compliance of its site is {g.dynamic:.4g} m/N there, and "
        f"{needs}; change nnm.start_frequency"
    )
