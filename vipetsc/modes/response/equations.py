"""The equations of steady states under a harmonic drive, and the frames in which continuation follows them.

The harmonics Z in m of the elongations under a drive of the frequency Om and the amplitude a obey

    R(Z, Om, a) = Z + G_s (F(Z) - s Z) - a A w(Om) = 0,    G_s = A G,    A = (1 + s G)^-1,

with the forces F, the compliance G at the multiples of Om, the stiffnesses s by which it is shifted
(``balance.harmonic_balance``), and the motion w of the linear lattice under the drive of amplitude 1. One of Om and a
varies along a curve, or a key of the case with both fixed: this is the parameter. The unknowns are

    xi = (x/clearance, p),

where x (n,) in m are the real and imaginary parts of Z and p is the parameter over a unit, its ``scale``. The residual
is R over the clearance. Its derivative by p over the amplitude is -A w times the scale; over the frequency it is that
of G_s (``HarmonicBalance.rate``) plus a central difference of the drive's term -a A w.

**Number of harmonics.** All states of a curve have unknowns up to the order ``nfrc.harmonics``. With
``nfrc.truncation`` each step solves for as many of them as that fraction needs, by the ``truncation`` of the state at
which it begins (``balance.harmonic_balance.order_needed``); the others are 0.
"""

from abc import abstractmethod
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from vipetsc.case.nfrc import NfrcTable
from vipetsc.lattice import ComplianceError, IncidentWave
from vipetsc.modes.balance.harmonic_balance import FEWER, MORE, BalanceFrame, HarmonicBalance, order_needed
from vipetsc.modes.cache import BoundedCache
from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.problem import Attempt, ContinuationError, FlowError, NoMotionError, unit
from vipetsc.modes.response.stability_changes import StatesWithStability
from vipetsc.modes.response.state import Response

# Relative step of the central difference in frequency. Its relative error is (SLOPE/d)^2 at the relative distance d
# from a pole of A w, and 1e-16/SLOPE by rounding. A mode that hardly moves the pairs makes A w large close to its pole
# alone. Such an error makes Newton's method converge linearly, with a factor of its size; the solutions do not depend
# on it.
SLOPE = 1e-8
# What may end a curve of steady states, or keep Newton's method from one. Where the derivative is singular there is no
# unique tangent.
FAILURES = NoMotionError, ComplianceError, np.linalg.LinAlgError
# Order of the highest harmonic, over that of the drive, below which none is taken.
FEWEST = 15


class LinearMotion(NamedTuple):
    """The motion of the linear lattice, on which no contact acts, under a drive of amplitude 1.

    ``harmonics`` (pairs, K + 1) in m are those of the elongations, of which only the first is not zero. ``wave`` is the
    incident wave; None under a force.
    """

    harmonics: np.ndarray
    wave: IncidentWave | None


class ContinuationParameter(NamedTuple):
    """The quantity that varies along a curve, and the one that does not.

    ``over`` is "amplitude", "frequency" or the path of a key of the case. ``fixed`` is the frequency in rad/s of a
    curve over the amplitude, else the amplitude. ``scale`` is the unit of the parameter: the last unknown is the value
    over it.
    """

    over: str
    fixed: float
    scale: float


class SteadyFrame(BalanceFrame):
    """The equations at and near one state, with its unknowns ``xi`` (n + 1,) and unit ``tangent`` (n + 1,).

    The ``shift`` (orders, 1, 1) in N/m of the compliance is chosen at this state and stays the same within a step.
    ``whole`` are equations of a higher order, whose unknowns the points of the curve have.
    """

    def __init__(
        self, equations: "SteadyEquations", xi: np.ndarray, tangent: np.ndarray, whole: "SteadyEquations | None" = None
    ) -> None:
        self.equations = equations
        self.whole = whole or equations
        self.newton = equations.newton
        self.tolerance = equations.tolerance
        self.xi = xi
        self.tangent = tangent
        self.shift = equations.shift_near(xi)

    def encode(self, point: Response) -> np.ndarray:
        """Return the unknowns (n + 1,) of another state."""
        return self.equations.resized(point.xi)

    def direction(self, point: Response) -> np.ndarray:
        """Return the curve's direction (n + 1,) at another state."""
        return self.equations.resized(point.tangent)

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """Return the residual (n,), which vanishes at a steady state, over the clearance."""
        return self.equations.residual(xi, self.shift)

    def jacobian(self, xi: np.ndarray) -> np.ndarray:
        """Return the derivative (n, n + 1) of the residual."""
        return self.equations.jacobian(xi, self.shift)

    def measures(self, attempt: Attempt, direction: np.ndarray) -> Response:
        """Return the state that an attempt has converged to, without measures, which are computed once it is accepted.

        ``direction`` (n + 1,) is the branch's unit tangent there.
        """
        return Response(xi=self.whole.resized(attempt.xi), tangent=self.whole.resized(direction))


class SteadyEquations(StatesWithStability):
    """The equations of steady states, for ``Continuation``; a subclass gives the ``linear_motion`` of the drive.

    ``options`` are the section [nfrc] of the case, ``balance`` the equations of the harmonics, ``clearance`` in m is
    the unit of these, and ``parameter`` says what varies. The motion has the period of ``periods`` periods of the
    drive: harmonics are those of Om/periods.
    """

    def __init__(
        self, options: NfrcTable, balance: HarmonicBalance, clearance: float, parameter: ContinuationParameter
    ) -> None:
        super().__init__(options)
        self.balance = balance
        self.periods = options.subharmonic
        self.clearance = clearance
        self.parameter = parameter
        self.tolerance = options.tolerance
        self.max_newton = options.max_newton
        # Along a curve over the amplitude the drive's term is the same for all states of a step.
        self._drive_terms = BoundedCache[tuple[float, bytes], np.ndarray](1)
        # The same equations with fewer harmonics, by their order: a curve comes back to the same few.
        self._of_orders: dict[int, Self] = {}

    @abstractmethod
    def linear_motion(self, omega: float) -> LinearMotion:
        """Return motion of the linear lattice at ``omega`` in rad/s; raises FlowError where there is no such drive."""

    @abstractmethod
    def with_order(self, order: int) -> Self:
        """Return the same equations with harmonics up to another ``order``."""

    def of_order(self, order: int) -> Self:
        """Return the same equations with harmonics up to ``order``, made once."""
        if order == self.balance.order:
            return self
        if order not in self._of_orders:
            self._of_orders[order] = self.with_order(order)
        return self._of_orders[order]

    def of_state(self, xi: np.ndarray) -> Self:
        """Return the equations with as many harmonics as the state ``xi`` (n + 1,) has, all without a truncation."""
        if self.options.truncation is None:
            return self
        sizes = np.abs(self.balance.unpack(xi[:-1])).max(axis=0)
        (orders,) = np.nonzero(sizes)
        order = max(int(orders.max(initial=0)), FEWEST * self.periods)
        return self.of_order(min(order, self.balance.order))

    def near(self, xi: np.ndarray) -> Self:
        """Return the equations with as many harmonics as states near ``xi`` (n + 1,) need."""
        allowed = self.options.truncation
        if allowed is None:
            return self
        states = self.of_state(xi)
        inner = states.resized(xi)
        # A state with all harmonics, such as the first one of a curve, may have many more than it needs.
        fewer = FEWER
        if states is self:
            fewer = MORE
        truncation = states.truncation(inner)
        order = order_needed(states.balance, inner[:-1], truncation, allowed, FEWEST * self.periods, fewer)
        return self.of_order(min(order, self.balance.order))

    def resized(self, xi: np.ndarray) -> np.ndarray:
        """Return unknowns, or a tangent, (n + 1,) of equations of another order as those of these."""
        return np.append(self.balance.resized(xi[:-1]), xi[-1])

    def truncation(self, xi: np.ndarray) -> float:
        """Return the estimated size of the harmonics that the state ``xi`` (n + 1,) leaves out, over the motion."""
        return self.balance.truncation(xi[:-1] * self.clearance, self.motion_frequency(xi))

    @cached_property
    def newton(self) -> DenseNewton:
        """Newton's method for the equations and one linear row, the plane on which a state is looked for."""
        return DenseNewton(self.balance.size + 1, self.max_newton)

    def shift_near(self, xi: np.ndarray) -> np.ndarray:
        """Return the stiffnesses (orders, 1, 1) in N/m that shift the compliance for states near ``xi`` (n + 1,)."""
        return self.balance.shift(self.motion_frequency(xi))

    def motion_frequency(self, xi: np.ndarray) -> float:
        """Return the frequency in rad/s of the motion in ``xi`` (n + 1,), of which all others are multiples."""
        omega, _ = self.drive(xi[-1])
        return omega / self.periods

    def drive(self, p: float) -> tuple[float, float]:
        """Return the frequency (rad/s) and amplitude at the scaled parameter ``p``."""
        over, fixed, scale = self.parameter
        if over == "amplitude":
            return fixed, p * scale
        return p * scale, fixed

    def residual(self, xi: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return the residual (n,) of the harmonics, which vanishes at a steady state, over the clearance.

        ``xi`` (n + 1,) are harmonics over the clearance and the scaled parameter, ``shift`` (orders, 1, 1) in N/m the
        stiffnesses by which the compliance is shifted. Raises FlowError where the frequency is not positive.
        """
        omega, amplitude = self.drive(xi[-1])
        if not omega > 0:
            raise FlowError("the frequency is not positive")
        x = xi[:-1] * self.clearance
        linear = amplitude * self.linear_motion(omega).harmonics
        return self.balance.residual(x, omega / self.periods, shift, linear) / self.clearance

    def jacobian(self, xi: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return the derivative (n, n + 1) of the ``residual``."""
        omega, amplitude = self.drive(xi[-1])
        x = xi[:-1] * self.clearance
        base = omega / self.periods
        jacobian = self.balance.jacobian(x, base, shift)
        if self.parameter.over == "amplitude":
            # The residual is linear in the amplitude: the drive's term for the amplitude 1.
            key = omega, shift.tobytes()
            column = self._drive_terms.get(key, lambda: self._drive_term(omega, 1.0, shift))
        else:
            ends = [omega * (1 + sign * SLOPE) for sign in (1, -1)]
            after, before = (self._drive_term(end, amplitude, shift) for end in ends)
            column = self.balance.rate(x, base, shift) / self.periods + (after - before) / (ends[0] - ends[1])
        return np.column_stack([jacobian, column * self.parameter.scale / self.clearance])

    def _drive_term(self, omega: float, amplitude: float, shift: np.ndarray) -> np.ndarray:
        """Return the part (n,) of the residual that is due to the drive, in m."""
        return self.balance.drive_term(omega / self.periods, shift, amplitude * self.linear_motion(omega).harmonics)

    def frame(self, point: Response, chart: str = "auto") -> SteadyFrame:
        """Return the frame at a state; there is one ``chart``."""
        states = self.near(point.xi)
        if states is self:
            return SteadyFrame(self, point.xi, point.tangent)
        frame = SteadyFrame(states, states.resized(point.xi), unit(states.resized(point.tangent)), whole=self)
        if states is not self.of_state(point.xi):
            frame.correct_here()
        return frame

    def tangent_near(self, point: Response, xi: np.ndarray) -> np.ndarray:
        """Return the unit tangent (n + 1,) at a state ``xi`` (n + 1,) near a ``point``, of all harmonics."""
        return SteadyFrame(self, point.xi, point.tangent).tangent_at(xi)

    def first_tangent(self, start: Response, direction: int) -> np.ndarray:
        """Return the tangent (n + 1,) at the first state: the parameter grows (``direction`` 1) or falls (-1)."""
        along_parameter = np.eye(len(start.xi))[-1] * direction
        return SteadyFrame(self, start.xi, along_parameter).tangent_at(start.xi)

    def at(self, guess: np.ndarray, p: float) -> np.ndarray:
        """Return the state (n + 1,) at the scaled parameter ``p`` near a ``guess``; raises ContinuationError."""
        along_parameter = np.eye(self.balance.size + 1)[-1]
        begin = np.append(guess[:-1], p)
        attempt = SteadyFrame(self, begin, along_parameter).solve(begin, along_parameter, p)
        if not attempt.converged:
            value = p * self.parameter.scale
            raise ContinuationError(f"no solution at {self.parameter.over} {value:.6g}: {attempt.reason}")
        return attempt.xi
