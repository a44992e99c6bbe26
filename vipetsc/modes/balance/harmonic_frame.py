"""The unknowns of harmonic balance at and near one conservative motion, in which a step of its branch is taken.

The unknowns ``xi`` (n + 1,) are numbers of order one,

    xi = (x/size, Om/omega).

Here x (n,) are the motion's harmonics in m, and Om is its frequency in rad/s; ``size`` is the largest |x| of the motion
at which the frame is, ``omega`` that motion's frequency. A ``Point`` of a branch has its tangent as d(x, period) in m
and s instead, of any length, with period = 2 pi/Om and so dperiod = -(period^2/2 pi) dOm.
"""

import numpy as np

from vipetsc.modes.balance.departures import departures_of, fraction_closed
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.point import Point
from vipetsc.modes.problem import Attempt, FlowError, unit

# A frequency that changes by this factor, or its inverse, within one correction has left the branch.
LARGE_FACTOR = 2.0


class HarmonicFrame:
    """Unknowns ``xi`` (n + 1,) at and near the motion with the harmonics ``x`` (n,) in m and ``omega`` in rad/s.

    ``size`` in m is the unit of the harmonics. The equations ``balance``, with their number of harmonics, and their
    ``shift`` stay the same within a step; ``newton`` solves them to the residual ``tolerance``. ``tangent`` (n + 1,) is
    the branch's unit tangent. It is set after construction where the motion has one; ``correct`` and ``tangent_at``
    need it.
    """

    tangent: np.ndarray

    def __init__(
        self, balance: HarmonicBalance, newton: DenseNewton, tolerance: float, x: np.ndarray, omega: float, size: float
    ) -> None:
        self.balance = balance
        self.newton = newton
        self.tolerance = tolerance
        self.shift = balance.shift(omega)
        self.size = size
        self.omega = omega
        self.xi = np.append(x / size, 1.0)

    def motion(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Harmonics (n,) in m and frequency in rad/s at the unknowns ``xi`` (n + 1,)."""
        return xi[:-1] * self.size, float(xi[-1] * self.omega)

    def encode(self, point: Point) -> np.ndarray:
        """The unknowns (n + 1,) of another motion, which may have another number of harmonics."""
        x = self.balance.resized(point.x)
        return np.append(x / self.size, 2 * np.pi / point.period / self.omega)

    def direction(self, point: Point) -> np.ndarray:
        """The branch's direction (n + 1,) at another motion, of any length."""
        # dOm = -2 pi/period^2 dperiod.
        harmonics = self.balance.resized(point.tangent[:-1]) / self.size
        return np.append(harmonics, -2 * np.pi / point.period**2 * point.tangent[-1] / self.omega)

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """The residual (n,) at the unknowns ``xi`` (n + 1,), which vanishes at a solution, over the size.

        Raises FlowError where the frequency has changed by a factor of ``LARGE_FACTOR`` or more.
        """
        if not np.all(np.isfinite(xi)) or not 1 / LARGE_FACTOR < xi[-1] < LARGE_FACTOR:
            raise FlowError("Newton's method left the domain: the frequency changed by a large factor")
        return self.balance.residual(*self.motion(xi), self.shift) / self.size

    def jacobian(self, xi: np.ndarray) -> np.ndarray:
        """Derivative (n, n + 1) of the residual."""
        x, omega = self.motion(xi)
        jacobian = self.balance.jacobian(x, omega, self.shift)
        by_omega = self.balance.rate(x, omega, self.shift)
        return np.column_stack([jacobian, by_omega * (self.omega / self.size)])

    def correct(self, guess: np.ndarray, arclength: float) -> Attempt:
        """Newton's method from ``guess`` (n + 1,) for the motion at an ``arclength`` along the tangent."""
        return self.solve(guess, self.tangent, self.tangent @ self.xi + arclength)

    def solve(self, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        """Newton's method from ``guess`` (n + 1,) for the motion with row . xi = value."""
        return self.newton.solve(self, guess, row, value, self.tolerance)

    def tangent_at(self, xi: np.ndarray) -> np.ndarray:
        """The unit tangent (n + 1,) at a solution ``xi`` (n + 1,), along the branch on the side of the frame's own."""
        border = np.vstack([self.jacobian(xi), self.tangent])
        return unit(np.linalg.solve(border, np.append(np.zeros(len(xi) - 1), 1.0)))

    def measures(self, attempt: Attempt, direction: np.ndarray | None = None) -> Point:
        """The point of the branch that an attempt has converged to.

        ``direction`` (n + 1,) is the branch's unit tangent there; without one, None, the point has no slope. Its
        ``energy_tangent`` is dE in J for a unit step along the tangent in this frame's unknowns: from frame to frame
        only the sign can be compared.
        """
        balance = self.balance
        xi = attempt.xi
        x, omega = self.motion(xi)
        period = 2 * np.pi / omega
        series = balance.series(x, omega)

        tangent = np.empty(0)
        energy_tangent = slope = np.nan
        if direction is not None:
            energy_tangent = balance.energy_change(
                x, omega, self.shift, along=direction[:-1] * self.size, by_omega=direction[-1] * self.omega
            )
            by_frequency = direction[-1] * self.omega / (2 * np.pi)
            # The slope is df/dE in Hz/J: infinite at a fold of the energy.
            slope = np.inf
            if energy_tangent:
                slope = by_frequency / energy_tangent
            tangent = np.append(direction[:-1] * self.size, -direction[-1] * self.omega / (2 * np.pi) * period**2)

        return Point(
            x=x,
            period=period,
            energy=balance.energy(x, omega, self.shift),
            residual=float(np.abs(balance.residual(x, omega, self.shift)).max() / self.size),
            episodes=len(departures_of(balance.forces, series.episodes)),
            closed=fraction_closed(series),
            # The history has the residual of the guess, too; that of a guess which is not corrected is empty.
            newton=max(len(attempt.history) - 1, 0),
            order=balance.order,
            truncation=balance.truncation(x, omega),
            # At phase 0 all cosines are 1.
            elongations=balance.unpack(x).real.sum(axis=1),
            tangent=tangent,
            energy_tangent=energy_tangent,
            slope=slope,
        )
