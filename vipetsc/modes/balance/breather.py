"""Branches of conservative motions condensed onto contacts and springs: their start, and their continuation.

The motions are at rest at phase 0 (cosines alone), and symmetric where all forces are odd (odd harmonics alone). The
number of harmonics is chosen at every point for the next one by the estimate of what is left out. A branch begins at
a linear mode, or at a frequency in a gap: there a describing function, z = a cos(Om t) at one place, gives a from
1 + G(Om) F_1(a)/a = 0, and the other harmonics are brought in with a growing weight.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import brentq

from vipetsc.case.nnm import NnmTable
from vipetsc.modes.balance.harmonic_balance import Balance, Compliance
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.continuation.arclength import Continuation, Frame, unit
from vipetsc.modes.continuation.special import Segment
from vipetsc.modes.newton import Attempt, BorderedNewton
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError, FlowError

# Harmonics at the start; their number changes where the harmonics left out are outside these shares of what is
# allowed, and then so that they become the share AIM of it.
FEWEST, FEWER, AIM, MORE = 15, 0.02, 0.2, 0.5
# Step along the tangent by whose two ends the energy's slope is taken; largest size of a describing function, in
# clearances; how far the motion may change, and the smallest step, as the other harmonics are brought in.
SLOPE_STEP, LARGEST, FURTHEST, SMALLEST_WEIGHT = 1e-5, 1e3, 0.1, 1e-4


@dataclass(frozen=True, eq=False)
class CondensedPoint(Point):
    """A periodic motion: ``x`` are the unknowns of a ``Balance`` with ``last`` harmonics, in m.

    ``elongations`` (places,) in m at phase 0; ``truncation``: ``Balance.truncation``.
    """

    last: int = 0
    truncation: float = np.nan
    elongations: np.ndarray = field(default_factory=lambda: np.empty(0))


class CondensedProblem:
    """The branches' equations: harmonics over their largest sum, and the frequency over that of a point.

    ``most`` harmonics are taken at most, and as many as a relative ``truncation`` needs.
    """

    def __init__(self, compliance: Compliance, forces: SiteForces, control: NnmTable) -> None:
        self.compliance, self.forces, self.control = compliance, forces, control
        self.tolerance = control.tolerance
        self._made: dict[int, tuple[Balance, BorderedNewton]] = {}
        self.select(FEWEST)

    def select(self, last: int, omega: float | None = None) -> None:
        """Take ``last`` harmonics from now on, and shift the compliance for motions near ``omega`` (rad/s)."""
        if last not in self._made:
            balance = Balance(self.compliance, self.forces, last, self.forces.odd, cosines=True)
            limits = self.control.tolerance, self.control.max_newton
            self._made[last] = balance, BorderedNewton(self._function, self.matrix, balance.size + 1, *limits)
        self.balance, self._newton = self._made[last]
        if omega is not None:
            self.balance.shift(omega)

    def prepare(self, point: CondensedPoint) -> np.ndarray:
        """Choose the harmonics for motions near ``point``, and give its unknowns (n,) with so many."""
        allowed, last = self.control.truncation, point.last
        if point.truncation >= MORE * allowed:
            last = int(last * min((point.truncation / allowed / AIM) ** (1 / 3), 2.0)) // 2 * 2 + 1
        elif point.truncation <= FEWER * allowed:
            sizes = np.abs(point.x.reshape(self.forces.pairs, -1))
            needed = (sizes[:, ::-1].cumsum(axis=1)[:, ::-1] > AIM * allowed * sizes.sum(axis=1).max()).any(axis=0)
            last = max(min(int(needed.sum()) * (1 + self.forces.odd) // 2 * 2 + 1, last), FEWEST)
        self.select(min(last, self.control.harmonics), 2 * np.pi / point.period)
        return self.resized(point.x, self.balance.last)

    def resized(self, x: np.ndarray, last: int) -> np.ndarray:
        """Unknowns with ``last`` harmonics, zero where they are new."""
        parts = x.reshape(self.forces.pairs, -1)
        out = np.zeros((len(parts), self._made[last][0].size // len(parts)))
        count = min(parts.shape[1], out.shape[1])
        out[:, :count] = parts[:, :count]
        return out.ravel()

    def solve(self, size: float, omega: float, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        """Newton's method for (x/``size``, frequency over ``omega``) on row . xi = value, from ``guess``."""
        self._scale = size, omega
        attempt = self._newton.solve(guess, row, value)
        return attempt if attempt.left_domain else replace(attempt, arc=self.balance)

    def _function(self, xi: np.ndarray) -> np.ndarray:
        size, omega = self._scale
        if not np.all(np.isfinite(xi)) or not 0.5 < xi[-1] < 2:
            raise FlowError("Newton left the domain: the frequency is off by a factor")
        return self.balance.residual(xi[:-1] * size, xi[-1] * omega) / size

    def matrix(self, xi: np.ndarray) -> np.ndarray:
        """Derivative (n, n + 1) of the scaled equations."""
        size, omega = self._scale
        jacobian, rate = self.balance.derivative(xi[:-1] * size, xi[-1] * omega)
        return np.column_stack([jacobian, rate * (omega / size)])

    def tangent(self, xi: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Unit tangent (n + 1,) at ``xi``, turned towards ``reference``, which is not across the branch."""
        border = np.vstack([self.matrix(xi), reference])
        return unit(np.linalg.solve(border, np.append(np.zeros(len(xi) - 1), 1.0)))

    def point(self, attempt: Attempt, direction: np.ndarray | None = None) -> CondensedPoint:
        """The point of a converged attempt, where ``direction`` is the branch's tangent."""
        (size, omega), xi, balance = self._scale, attempt.xi, self.balance
        x, rate = xi[:-1] * size, xi[-1] * omega
        series, z = balance.series(x, rate), balance.unpack(x).real
        quarter = np.pi / 2 if self.forces.odd else np.pi
        middles = [(e.onset + e.length / 2 + 1e-9) % (2 * np.pi) for e in series.episodes]
        point = CondensedPoint(
            x=x,
            period=2 * np.pi / rate,
            energy=balance.energy(x, rate),
            residual=float(np.abs(balance.residual(x, rate)).max() / size),
            half_traces=np.empty(0),
            multiplier=np.nan,
            episodes=sum(middle < quarter + 2e-9 for middle in middles),
            closed=float(series.closed.max(initial=0.0)),
            newton=len(attempt.history) - 1,
            last=balance.last,
            truncation=balance.truncation(x, rate),
            elongations=z.sum(axis=1),
        )
        if direction is None:
            return point
        ahead, behind = (xi + sign * SLOPE_STEP * direction for sign in (1, -1))
        energies = [balance.energy(place[:-1] * size, place[-1] * omega) for place in (ahead, behind)]
        rise = (energies[0] - energies[1]) / (2 * SLOPE_STEP)
        slope = direction[-1] * omega / (2 * np.pi) / rise if rise else np.inf
        tangent = np.append(direction[:-1] * size, -direction[-1] * omega / (2 * np.pi) * point.period**2)
        return replace(point, tangent=tangent, energy_tangent=rise, slope=slope)

    def refined(self, point: CondensedPoint, keep_frequency: bool) -> CondensedPoint:
        """The motion of the frequency, or else of the amplitude, of ``point``, with as many harmonics as are needed.

        Raises ContinuationError where Newton's method fails.
        """
        while True:
            before, x = point.last, self.prepare(point)
            size = float(np.abs(x).max())
            xi = np.append(x / size, 1.0)
            row = np.append(0 * x, 1.0) if keep_frequency else unit(np.append(x, 0.0))
            attempt = self.solve(size, 2 * np.pi / point.period, xi, row, row @ xi)
            if not attempt.converged:
                why = f"{attempt.reason}; residuals {attempt.residuals}"
                raise ContinuationError(f"no motion at f = {point.frequency:.9g} Hz ({why}): change where it begins")
            point = self.point(attempt)
            if point.truncation <= MORE * self.control.truncation or point.last == before:
                return point

    def from_mode(self, z: np.ndarray, omega: float) -> CondensedPoint:
        """The motion near a linear mode of frequency ``omega`` (rad/s) with the elongations ``z`` (places,) in m."""
        x = self.balance.pack(z[:, None] * (np.arange(self.balance.last + 1) == 1))
        return self.refined(self._guess(x, omega), keep_frequency=False)

    def from_gap(self, omega: float, signs: np.ndarray) -> CondensedPoint:
        """The motion of ``omega`` (rad/s) with contact at the places whose ``signs`` (places,) are +1 or -1.

        Raises ContinuationError where there is none with one harmonic, or no way from it to all harmonics.
        """
        g, z = self.compliance.at(np.array([omega]))[0], np.zeros(len(signs))
        for place in np.nonzero(signs)[0]:
            z[place] = signs[place] * describing(self.forces, place, g[place, place], omega)
        x = self.balance.pack(z[:, None] * (np.arange(self.balance.last + 1) == 1))
        size, weight, step = float(np.abs(z).max()), 0.0, 0.1
        row = np.append(0 * x, 1.0)
        while weight < 1:
            self.balance.weigh(min(weight + step, 1.0))
            attempt = self.solve(size, omega, np.append(x / size, 1.0), row, 1.0)
            moved = np.linalg.norm(attempt.xi[:-1] - x / size)
            if attempt.converged and moved < FURTHEST:
                x, weight, step = attempt.xi[:-1] * size, self.balance.weight, 1.6 * step
            elif (step := 0.4 * step) < SMALLEST_WEIGHT:
                raise ContinuationError(
                    f"no breather at {omega:g} rad/s: with {weight:.3g} of the harmonics above the first, Newton's "
                    f"method ends ({attempt.reason}); change nnm.start_frequency or raise nnm.max_newton"
                )
        return self.refined(self._guess(x, omega), keep_frequency=True)

    def _guess(self, x: np.ndarray, omega: float) -> CondensedPoint:
        """A point to be corrected."""
        self._scale = 1.0, omega
        return self.point(Attempt(False, "", [], np.append(x, 1.0)))


def describing(forces: SiteForces, place: int, g: float, omega: float) -> float:
    """Amplitude in m of z = a cos(Om t) at a ``place`` with the compliance ``g`` in m/N and one of the ``forces``.

    Raises ContinuationError where there is none.
    """
    z = np.zeros((forces.pairs, 2), complex)

    def balance(amplitude: float) -> float:
        z[place, 1] = amplitude
        return amplitude + g * float(forces.series(z, omega).forces[place, 1].real)

    contacts = forces.contacts
    cubic = contacts[place][1] if place < len(contacts) else forces.springs[place - len(contacts)][1]
    size = cubic if place < len(contacts) else 1 / np.sqrt(np.abs(g * cubic) or 1.0)
    if balance(size) * balance(LARGEST * size) >= 0:
        raise ContinuationError(
            f"no breather begins at {omega:g} rad/s: the compliance of its site is {g:.4g} m/N there, and a force "
            f"that hardens needs a negative one of moderate size; change nnm.start_frequency"
        )
    return float(brentq(balance, size, LARGEST * size, rtol=1e-12))


class CondensedFrame(Frame):
    """A point's unknowns over its size, and the frequency over its own: a frame that is its own chart."""

    def __init__(self, problem: CondensedProblem, chart: str, point: CondensedPoint) -> None:
        x = problem.prepare(point)
        self.problem, self.chart, self.last = problem, self, problem.balance.last
        self.size, self.omega = float(np.abs(x).max()), 2 * np.pi / point.period
        self.xi = self.encode(x, point.period)
        if point.tangent.size:
            self.tangent = unit(self.direction(point))

    def encode(self, x: np.ndarray, period: float) -> np.ndarray:
        """The scaled unknowns of a motion, which may have another number of harmonics."""
        return np.append(self.problem.resized(x, self.last) / self.size, 2 * np.pi / period / self.omega)

    def direction(self, point: Point) -> np.ndarray:
        """As of ``Frame``."""
        harmonics = self.problem.resized(point.tangent[:-1], self.last) / self.size
        return np.append(harmonics, -2 * np.pi / point.period**2 * point.tangent[-1] / self.omega)

    def correct(self, guess: np.ndarray, step: float) -> Attempt:
        """Newton's method from ``guess`` for the motion at the arclength ``step`` along the tangent."""
        self.problem.select(self.last, self.omega)
        return self.problem.solve(self.size, self.omega, guess, self.tangent, self.tangent @ self.xi + step)

    def point(self, attempt: Attempt, index: int, step: float) -> tuple[CondensedPoint, np.ndarray]:
        """The point that an attempt has converged to, and the unit tangent there."""
        direction = self.problem.tangent(attempt.xi, self.tangent)
        return replace(self.problem.point(attempt, direction), index=index, step=step), direction


class CondensedSegment(Segment):
    """The branch between two points of condensed motions."""

    frame_type = CondensedFrame


class CondensedContinuation(Continuation):
    """Along a branch of condensed motions; the number of harmonics goes with the point."""

    frame = CondensedFrame

    def changes(self, last: Point, point: Point) -> dict[str, float]:
        """The harmonics left out, over what is allowed."""
        assert isinstance(point, CondensedPoint)
        return {"truncation": point.truncation / self.control.truncation}

    def first_tangent(self, start: Point, direction: int) -> np.ndarray:
        """As of ``Continuation``."""
        assert isinstance(start, CondensedPoint)
        frame, problem = CondensedFrame(self.problem, "", start), self.problem
        problem._scale = frame.size, frame.omega
        null = np.linalg.svd(problem.matrix(frame.xi))[2][-1]
        point = problem.point(Attempt(True, "", [], frame.xi), null)
        sign = np.sign(point.energy_tangent) * direction or direction
        return np.append(problem.resized(point.tangent[:-1], start.last), point.tangent[-1]) * sign
