r"""Steady states of a lattice's sites under a harmonic force or an incident Bloch wave, followed over a parameter.

With the contacts condensed (``balance``) the harmonics Z of the relative displacements obey

    Z_k + G(k Om) F_k(Z) = a delta_k1 w(Om),

where w is the motion of the sites by the force (1 N) or the wave (1 clearance of the first site) alone. Unknowns are Z
over that clearance and the parameter, the amplitude a or the frequency Om over a scale; a curve of solutions is
followed by pseudo-arclength (``continuation``), folds in the parameter are located on it.

**Energy.** A wave of the flux P a^2 comes in. What leaves at Om on the side that it goes to is transmitted (T), on the
other reflected (R); what leaves at k Om, k > 1, is U; contacts lose L. T + R + U + L = 1 for any number of harmonics,
as the loss is that of the harmonics kept. A force gives what it gives: fractions are over that, T to higher cells.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vipetsc.case.nfrc import NfrcCase
from vipetsc.lattice import IncidentWave, ModalCompliance, WaveCompliance
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.balance.hill import Hill
from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.problem import Attempt, ContinuationError, FlowError, Solution, SpecialKind
from vipetsc.modes.response.condensation import compliance_of, driven_points, stops_of

# Relative step of a difference in frequency.
SLOPE = 1e-6
# A force's work over what it moves, below which nothing but rounding says that something leaves or is lost.
LEAST_WORK = 1e-12
# Frequencies whose linear motions are kept: those of a step and of its differences.
KEPT_MOTIONS = 9
# Samples a harmonic of the period in which the largest displacement is looked for.
SAMPLES_A_HARMONIC = 16


class Measures(NamedTuple):
    """Measures of a steady state (``branches.response_layout`` has units and texts).

    ``fractions`` (4,) of the energy that comes in are transmitted, reflected, at higher harmonics, and lost;
    ``harmonics`` (site, order) complex in m; ``unstable`` perturbations grow, the fastest at ``growth`` over Om.
    """

    frequency: float
    amplitude: float
    largest: np.ndarray
    fractions: np.ndarray
    unstable: int
    growth: float
    closed: np.ndarray
    episodes: int
    truncation: float
    harmonics: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Response(Solution):
    """A steady state: unknowns ``xi``, the last of which is the parameter, and the unit ``tangent``."""

    xi: np.ndarray
    tangent: np.ndarray = field(default_factory=lambda: np.empty(0))
    index: int = 0
    step: float = 0.0
    next_step: float = np.nan
    kind: str = "regular"
    measures: Measures | None = None

    @property
    def measured(self) -> Measures:
        """The measures, which every state has before it is written to a file."""
        assert self.measures is not None
        return self.measures


class LinearMotion(NamedTuple):
    """Harmonics (pairs, K + 1) in m that a drive of amplitude 1 alone makes at the sites; its wave if it is one."""

    harmonics: np.ndarray
    wave: IncidentWave | None


class ContinuationParameter(NamedTuple):
    """Parameter of a curve, "amplitude" or "frequency", the value of the other one, and the parameter's unit."""

    over: str
    fixed: float
    scale: float


class SteadyFrame:
    """Steady states at and near one state, with its unknowns and tangent, and the ``shift`` of its compliance."""

    def __init__(self, equations: "SteadyEquations", xi: np.ndarray, tangent: np.ndarray) -> None:
        self.equations = equations
        self.xi = xi
        self.tangent = tangent
        self.shift = equations.balance.shift(equations.drive(xi[-1])[0])

    def encode(self, point: Response) -> np.ndarray:
        """The unknowns of another state."""
        return point.xi

    def direction(self, point: Response) -> np.ndarray:
        """The curve's direction at another state."""
        return point.tangent

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """The residual (n,), which vanishes at a steady state, over the clearance."""
        return self.equations.residual(xi, self.shift)

    def jacobian(self, xi: np.ndarray) -> np.ndarray:
        """Derivative (n, n + 1) of the residual."""
        return self.equations.jacobian(xi, self.shift)

    def correct(self, guess: np.ndarray, arclength: float) -> Attempt:
        """Newton's method from ``guess`` for the state at an ``arclength`` along the tangent."""
        # The plane is that of the predictor, whose rounding the first residual then does not see.
        predicted = self.xi + arclength * self.tangent
        return self.solve(guess, self.tangent, self.tangent @ predicted)

    def solve(self, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        """Newton's method for the state with row . xi = value; not converged after an ArithmeticError."""
        equations = self.equations
        try:
            return equations.newton.solve(self, guess, row, value, equations.tolerance)
        except ArithmeticError as error:
            return Attempt(False, str(error), [], guess, left_domain=True)

    def tangent_at(self, xi: np.ndarray) -> np.ndarray:
        """The unit tangent at a state, on the side of the frame's own."""
        right = np.zeros(len(xi))
        right[-1] = 1
        direction = np.linalg.solve(np.vstack([self.jacobian(xi), self.tangent]), right)
        return np.asarray(direction / np.linalg.norm(direction))

    def measures(self, attempt: Attempt, direction: np.ndarray) -> Response:
        """The state that an attempt has converged to, without measures, which are computed once it is accepted."""
        return Response(xi=attempt.xi, tangent=direction)


class SteadyEquations(ABC):
    """Steady states under a drive that alone makes the ``linear_motion``; unknowns are over the ``clearance``."""

    has_half_traces = False
    guards: frozenset[str] = frozenset()

    def __init__(
        self,
        balance: HarmonicBalance,
        clearance: float,
        parameter: ContinuationParameter,
        tolerance: float,
        max_newton: int,
    ) -> None:
        self.balance = balance
        self.clearance = clearance
        self.parameter = parameter
        self.tolerance = tolerance
        self.newton = DenseNewton(balance.size + 1, max_newton)

    @abstractmethod
    def linear_motion(self, omega: float) -> LinearMotion:
        """The motion of the linear lattice at ``omega`` in rad/s; raises FlowError where there is no such drive."""

    def drive(self, p: float) -> tuple[float, float]:
        """Frequency (rad/s) and amplitude at the scaled parameter ``p``."""
        over, fixed, scale = self.parameter
        return (fixed, p * scale) if over == "amplitude" else (p * scale, fixed)

    def residual(self, xi: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """The residual (n,) of the harmonics, which vanishes at a steady state, over the clearance."""
        omega, amplitude = self.drive(xi[-1])
        if not omega > 0:
            raise FlowError("the frequency is not positive")
        x = xi[:-1] * self.clearance
        linear = amplitude * self.linear_motion(omega).harmonics
        return self.balance.residual(x, omega, shift, linear) / self.clearance

    def jacobian(self, xi: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """The derivative (n, n + 1) of the ``residual``."""
        omega, amplitude = self.drive(xi[-1])
        jacobian, column = self.balance.derivative(xi[:-1] * self.clearance, omega, shift)
        if self.parameter.over == "amplitude":
            # The residual is linear in the amplitude: the drive's term for the amplitude 1.
            column = self._drive_term(omega, 1.0, shift)
        else:
            ends = [omega * (1 + sign * SLOPE) for sign in (1, -1)]
            after, before = (self._drive_term(end, amplitude, shift) for end in ends)
            column = column + (after - before) / (ends[0] - ends[1])
        return np.column_stack([jacobian, column * self.parameter.scale / self.clearance])

    def _drive_term(self, omega: float, amplitude: float, shift: np.ndarray) -> np.ndarray:
        """The part (n,) of the residual that is due to the drive, in m: the residual at rest."""
        rest = np.zeros(self.balance.size)
        return self.balance.residual(rest, omega, shift, amplitude * self.linear_motion(omega).harmonics)

    def frame(self, point: Response, chart: str = "auto") -> SteadyFrame:
        """The frame at a state; there is one ``chart``."""
        return SteadyFrame(self, point.xi, point.tangent)

    def first_tangent(self, start: Response, direction: int) -> np.ndarray:
        """Tangent at the first state, along which the parameter grows (``direction`` 1) or falls (-1)."""
        along_parameter = np.eye(len(start.xi))[-1] * direction
        return SteadyFrame(self, start.xi, along_parameter).tangent_at(start.xi)

    def turn(self, before: Response, after: Response) -> float:
        """Angle between the tangents of two states in relative units: that of the step, which is judged anyway."""
        return 0.0

    def special_kinds(self, left: Response, right: Response) -> Iterator[SpecialKind[Response]]:
        """Folds in the parameter."""
        yield SpecialKind("fold", lambda point: float(point.tangent[-1]))

    def at(self, guess: np.ndarray, p: float) -> np.ndarray:
        """Unknowns of the state at the scaled parameter ``p`` near ``guess``; raises ContinuationError."""
        along_parameter = np.eye(self.balance.size + 1)[-1]
        begin = np.append(guess[:-1], p)
        attempt = SteadyFrame(self, begin, along_parameter).solve(begin, along_parameter, p)
        if not attempt.converged:
            over = self.parameter.over
            omega, amplitude = self.drive(p)
            value = amplitude if over == "amplitude" else omega
            raise ContinuationError(f"no solution at {over} {value:.6g}: {attempt.reason}")
        return attempt.xi


class SteadyStates(SteadyEquations):
    """Steady states of the sites of a case with a ``restitution`` and the other parameter ``fixed`` (``NfrcTable``).

    ``compliance`` is that of the case, if it has been computed already.
    """

    def __init__(
        self,
        case: NfrcCase,
        restitution: float,
        fixed: float,
        compliance: WaveCompliance | ModalCompliance | None = None,
    ) -> None:
        options = case.nfrc
        self.case = case
        self.options = options
        self.restitution = restitution
        self.wave = options.source == "wave"
        self.forces = SiteForces(stops_of(case, restitution))
        self.points, self.weights = driven_points(case)
        self.compliance = compliance_of(case) if compliance is None else compliance

        # Latest linear motions by frequency, and the latest determinant: neighbours on a curve over the amplitude.
        self._motions: dict[float, LinearMotion] = {}
        self._hill: Hill | None = None

        clearance = self._unit()
        super().__init__(
            balance=HarmonicBalance(
                self.compliance, self.forces, options.harmonics, odd=bool(options.symmetric), cosines=False
            ),
            clearance=clearance,
            parameter=ContinuationParameter(options.over, fixed, self._scale(clearance)),
            tolerance=options.tolerance,
            max_newton=options.max_newton,
        )

    def _unit(self) -> float:
        """Unit of displacements in m: the first clearance; of contacts without any the linear motion of the range."""
        for stops in self.forces.contacts:
            for gap in (stops.plus, stops.minus):
                if 0 < gap < np.inf:
                    return gap
        over_amplitude = self.options.over == "amplitude"
        omega = self.case.frequency
        amplitude = self.options.range[1] if over_amplitude else self.options.fixed[0]
        return float(amplitude * np.abs(self.linear_motion(omega).harmonics).max())

    def _scale(self, clearance: float) -> float:
        """Unit of the parameter: half the range of frequencies, or the amplitude that touches, 1 of a wave."""
        low, high = self.options.range
        if self.options.over == "frequency":
            return (high - low) / 2
        if self.wave:
            return 1.0
        linear = self.linear_motion(self.case.frequency).harmonics
        return float(clearance / np.abs(linear[:, 1]).max())

    def linear_motion(self, omega: float) -> LinearMotion:
        """The motion of the linear lattice for the amplitude 1; FlowError outside a wave's band."""
        if omega not in self._motions:
            self._motions = dict(list(self._motions.items())[1 - KEPT_MOTIONS :])
            self._motions[omega] = self._evaluate_linear(omega)
        return self._motions[omega]

    def _evaluate_linear(self, omega: float) -> LinearMotion:
        pairs = self.forces.pairs
        z = np.zeros((pairs, self.options.harmonics + 1), complex)
        if not self.wave:
            z[:, 1] = self.compliance.response(omega)[0, :, pairs:] @ self.weights
            return LinearMotion(z, None)
        assert isinstance(self.compliance, WaveCompliance)
        try:
            wave = self.compliance.incident(omega, self.options.band or 0, self.options.towards)
        except ValueError as error:
            raise FlowError(str(error)) from None
        z[:, 1] = wave.relative * self._unit()
        return LinearMotion(z, wave)

    def measured(self, xi: np.ndarray) -> Measures:
        """The measures of a state for its file."""
        omega, amplitude = self.drive(xi[-1])
        x = xi[:-1] * self.clearance
        z = self.balance.unpack(x)
        series = self.balance.series(x, omega)

        hill = self.hill(omega)
        unstable = hill.unstable(series)
        # The count is cheaper than the zeros themselves, and most states are stable.
        fastest = hill.fastest(series) if unstable else 0j
        forces = series.forces[:, : z.shape[1]]
        return Measures(
            frequency=omega,
            amplitude=amplitude,
            largest=_largest(z),
            fractions=self._fractions(omega, amplitude, forces, float(series.loss.sum())),
            unstable=unstable,
            growth=np.nan if fastest is None else fastest.real,
            closed=series.closed,
            episodes=len(series.episodes),
            truncation=self.balance.truncation(x, omega),
            harmonics=z,
        )

    def hill(self, omega: float) -> Hill:
        """Hill's determinant at a frequency; the latest is kept, since it keeps the compliances of perturbations."""
        if self._hill is None or self._hill.omega != omega:
            options = self.options
            decay = 0.0
            if isinstance(self.compliance, ModalCompliance):
                decay = self.compliance.slowest / omega
            self._hill = Hill(
                compliance=self.compliance,
                omega=omega,
                order=options.harmonics,
                odd=bool(options.symmetric),
                finite=not options.infinite,
                decay=decay,
            )
        return self._hill

    def _fractions(self, omega: float, amplitude: float, forces: np.ndarray, loss: float) -> np.ndarray:
        """T, R, U, L over what comes in (4,), NaN where a finite lattice lets nothing leave; ``loss`` in J a period."""
        wave = self.linear_motion(omega).wave
        first = forces[:, 1]
        if wave is not None:
            # A wave's amplitude counts in clearances of the first site.
            amplitude = amplitude * self.clearance
            given = amplitude**2 * wave.flux
        else:
            first = np.append(first, amplitude * self.weights)
            moved = 0.0
            for (cell, mass), weight in zip(self.points, self.weights.tolist(), strict=True):
                moved = moved + weight * self.compliance.field(omega, first, [cell])[0, mass]
            given = 0.5 * amplitude * float((1j * omega * moved).real)
            if not given > LEAST_WORK * amplitude * omega * abs(moved):
                given = 0.0

        powers = np.full(4, 0.0 if self.options.infinite else np.nan)
        if isinstance(self.compliance, WaveCompliance) and self.options.infinite:
            outgoing = self.compliance.outgoing(omega, first, wave, amplitude).sum(axis=1)
            powers[:2] = outgoing if self.options.towards > 0 else outgoing[::-1]
            for k in range(2, forces.shape[1]):
                # Even orders of a symmetric motion have no force, and waves are not solved for in vain.
                if np.any(forces[:, k]):
                    powers[2] += self.compliance.outgoing(k * omega, forces[:, k]).sum()
        powers[3] = loss * (omega / (2 * np.pi))
        return powers / given if given > 0 else np.full(4, np.nan)


def _largest(z: np.ndarray) -> np.ndarray:
    """Largest |w| (pairs,) in m of the motions with the harmonics ``z`` (pairs, K + 1)."""
    half = SAMPLES_A_HARMONIC // 2 * z.shape[1]
    padded = np.pad(z, ((0, 0), (0, half - z.shape[1]))) * np.where(np.arange(half), 0.5, 1)
    return np.abs(np.fft.irfft(padded, axis=1, norm="forward")).max(axis=1)
