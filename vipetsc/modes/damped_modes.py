r"""Damped nonlinear modes by the extended periodic motion concept: harmonic balance with a negative damping.

A system M u'' + C u' + K u + B^T f(z, z') = 0, with the forces f at the elongations z = B u of contacts and springs
that are not linear, has no periodic motions if it dissipates. A damping proportional to the masses is therefore added,
with the sign and the size that make up for the loss in each period (Krack, Comput. Struct. 154 (2015) 59):

    M u'' + C u' + K u + B^T f - 2 zeta Om M u' = 0.

Its periodic motions u = Re sum_k U_k exp(i k Om t) form branches on which the frequency Om and the *damping ratio* zeta
depend on the size of the motion. Both are those of the linear mode where it is small: exact if C is proportional to M,
else up to zeta^2. Without loss zeta is 0, and the motions are the conservative ones. The harmonics k = 0..K obey

    [K + i k Om C - ((k Om)^2 + 2 i k zeta Om^2) M] U_k + B^T F_k(B U) = 0,    Im phi^T M U_1 = 0,

where the last equation fixes the phase with the linear mode phi. Unknowns are xi = (x/size, zeta, Om/omega): x (n,) in
m are the real and imaginary parts of the harmonics of all masses, odd ones alone if all forces are odd; size and omega
are those of the motion at which a step begins. Derivatives are exact. The energy is the mean of the mechanical one over
a period, which changes within it.
"""

from collections.abc import Iterator

import numpy as np

from vipetsc.modes.balance.conservative import episodes_in_arc, folds, fraction_closed
from vipetsc.modes.balance.harmonic_balance import BalanceFrame, RealUnknowns, check_frequency
from vipetsc.modes.balance.harmonics import ForceSeries, SiteForces
from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.point import OrbitProblem, Point
from vipetsc.modes.problem import Attempt, ContinuationError, SpecialKind, unit
from vipetsc.modes.system import System

# Step of the difference by which the energy's change along a branch is computed, in unknowns of order one.
ALONG = 1e-6


class DampedFrame(BalanceFrame):
    """Unknowns ``xi`` (n + 2,) at and near a motion with the harmonics ``x`` (n,), ``zeta`` and ``omega`` in rad/s."""

    def __init__(self, modes: "DampedModes", x: np.ndarray, zeta: float, omega: float) -> None:
        self.modes = modes
        self.newton = modes.newton
        self.tolerance = modes.tolerance
        self.size = float(np.abs(x).max())
        self.omega = omega
        self.xi = np.concatenate([x / self.size, [zeta, 1.0]])

    def motion(self, xi: np.ndarray) -> tuple[np.ndarray, float, float]:
        """Return the harmonics (n,) in m, damping ratio and frequency in rad/s at the unknowns ``xi`` (n + 2,)."""
        return xi[:-2] * self.size, float(xi[-2]), float(xi[-1] * self.omega)

    def encode(self, point: Point) -> np.ndarray:
        """Return the unknowns (n + 2,) of another motion."""
        return np.concatenate([point.x[:-1] / self.size, [point.x[-1], 2 * np.pi / point.period / self.omega]])

    def direction(self, point: Point) -> np.ndarray:
        """Return the branch's direction (n + 2,) at another motion, of any length."""
        # dOm = -2 pi/period^2 dperiod.
        by_omega = -2 * np.pi / point.period**2 * point.tangent[-1] / self.omega
        return np.concatenate([point.tangent[:-2] / self.size, [point.tangent[-2], by_omega]])

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """Return the residual (n + 1,) over the force of inertia of the size; raises FlowError at another frequency."""
        check_frequency(xi)
        x, zeta, omega = self.motion(xi)
        return np.append(self.modes.residual(x, zeta, omega) / self._force, self.modes.phase_row @ xi[:-2])

    def jacobian(self, xi: np.ndarray) -> np.ndarray:
        """Return the derivative (n + 1, n + 2) of the residual."""
        x, zeta, omega = self.motion(xi)
        by_x, by_zeta, by_omega = self.modes.jacobian(x, zeta, omega)
        rows = np.column_stack([by_x * self.size, by_zeta, by_omega * self.omega]) / self._force
        return np.vstack([rows, np.append(self.modes.phase_row, [0.0, 0.0])])

    @property
    def _force(self) -> float:
        return float(self.size * self.omega**2 * self.modes.system.masses.max())

    def measures(self, attempt: Attempt, direction: np.ndarray | None = None) -> Point:
        """Return the point of an attempt that converged; ``direction`` (n + 2,) is the branch's unit tangent there."""
        modes = self.modes
        x, zeta, omega = self.motion(attempt.xi)
        period = 2 * np.pi / omega
        energy = modes.energy(x, omega)
        series = modes.series(x, omega)

        tangent = np.empty(0)
        energy_tangent = slope = np.nan
        if direction is not None:
            ends = [self.motion(attempt.xi + sign * ALONG * direction) for sign in (1, -1)]
            after, before = (modes.energy(end_x, end_omega) for end_x, _, end_omega in ends)
            energy_tangent = (after - before) / (2 * ALONG)
            by_frequency = direction[-1] * self.omega / (2 * np.pi)
            slope = by_frequency / energy_tangent if energy_tangent else np.inf
            by_period = -by_frequency * period**2
            tangent = np.concatenate([direction[:-2] * self.size, [direction[-2], by_period]])

        return Point(
            x=np.append(x, zeta),
            period=period,
            energy=energy,
            residual=float(np.abs(self.residual(attempt.xi)).max()),
            episodes=episodes_in_arc(modes.forces, series.episodes),
            closed=fraction_closed(series),
            newton=max(len(attempt.history) - 1, 0),
            order=modes.order,
            truncation=modes.truncation(x, omega),
            elongations=modes.elongations @ modes.unpack(x).real.sum(axis=1),
            tangent=tangent,
            energy_tangent=energy_tangent,
            slope=slope,
            # What the negative damping gives back in a period: the integral of 2 zeta Om u'^T M u'.
            loss=8 * np.pi * zeta * modes.kinetic_energy(x, omega),
            zeta=zeta,
        )


class DampedModes(RealUnknowns, OrbitProblem):
    """Branches of damped modes of a ``system`` with dashpots ``damping`` (n, n) in N s/m, as a ``PeriodicProblem``.

    ``forces`` are those of its contacts, which may dissipate, and of its springs that are not linear. Harmonics are
    taken up to ``order``. Branches begin at the linear ``mode``, counted from 0.
    """

    def __init__(
        self,
        system: System,
        damping: np.ndarray,
        forces: SiteForces,
        order: int,
        tolerance: float,
        max_newton: int,
        mode: int,
    ) -> None:
        super().__init__(system.dofs, order, forces.odd, cosines=False)
        self.system = system
        self.damping = damping
        self.forces = forces
        self.tolerance = tolerance
        self.elongations = np.vstack([system.contact_rows, system.spring_rows])
        self.newton = DenseNewton(self.size + 2, max_newton)
        # The phase is that of the linear mode's first harmonic: of Im phi^T M U_1 = 0.
        self.mode = mode
        quarter = np.zeros((system.dofs, order + 1), complex)
        quarter[:, 1] = 1j * system.masses * system.linear_modes()[1][:, mode]
        self.phase_row = unit(self.pack(quarter))

    def series(self, x: np.ndarray, omega: float) -> ForceSeries:
        """Return the forces at the elongations of a motion."""
        return self.forces.series(self.elongations @ self.unpack(x), omega)

    def _dynamic(self, zeta: float, omega: float) -> np.ndarray:
        """Return the dynamic stiffness (order, masses, masses) of the linear system with the negative damping."""
        rates = (self.orders * omega)[:, None, None]
        masses = np.diag(self.system.masses)
        linear = self.system.stiffness_at_rest + 1j * rates * (self.damping - 2 * zeta * omega * masses)
        return np.asarray(linear - rates**2 * masses)

    def residual(self, x: np.ndarray, zeta: float, omega: float) -> np.ndarray:
        """Return the residual (n,) in N of the harmonics of all masses."""
        u = self.unpack(x)
        out = self.elongations.T @ self.series(x, omega).forces[:, : self.order + 1]
        out[:, self.orders] += np.einsum("kij,jk->ik", self._dynamic(zeta, omega), u[:, self.orders])
        return self.pack(out)

    def jacobian(self, x: np.ndarray, zeta: float, omega: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the derivatives of the residual by x (n, n), by zeta (n,) and by omega (n,)."""
        count = len(self.orders)
        skipped = self.skipped
        dofs = self.system.dofs
        changes = self.by_unknowns(self.series(x, omega))
        matrix = np.einsum("pi,pku,pj->ikju", self.elongations, changes, self.elongations).astype(complex)
        dynamic = self._dynamic(zeta, omega)
        for place in range(count):
            matrix[:, place, :, place] += dynamic[place]
            if place >= skipped:
                matrix[:, place, :, count + place - skipped] += 1j * dynamic[place]
        by_x = self.real_rows(matrix.reshape(dofs, count, -1))

        u = self.unpack(x)
        orders = np.arange(self.order + 1)
        masses = self.system.masses[:, None]
        by_zeta = -2j * orders * omega**2 * masses * u
        by_omega = 1j * orders * (self.damping @ u) - (2 * orders**2 + 4j * orders * zeta) * omega * masses * u
        return by_x, self.pack(by_zeta), self.pack(by_omega)

    def kinetic_energy(self, x: np.ndarray, omega: float) -> float:
        """Return the mean kinetic energy in J over a period."""
        speeds = np.abs(self.unpack(x) * np.arange(self.order + 1) * omega) ** 2
        return float(self.system.masses @ speeds.sum(axis=1) / 4)

    def energy(self, x: np.ndarray, omega: float) -> float:
        """Return the mean mechanical energy in J over a period."""
        u = self.unpack(x)
        means = np.where(np.arange(self.order + 1) == 0, 0.5, 0.25)
        stored = np.einsum("ik,ij,jk->k", u.conj(), self.system.stiffness_at_rest, u).real
        return self.kinetic_energy(x, omega) + float(stored @ means) + float(self.series(x, omega).potential.sum())

    def truncation(self, x: np.ndarray, omega: float) -> float:
        """Return estimated size of the harmonics left out, which inertia alone holds, over the sum of those kept."""
        forces = np.abs(self.elongations.T @ self.series(x, omega).forces)
        beyond = np.arange(self.order + 1, forces.shape[1])
        left_out = (forces[:, beyond] / (beyond * omega) ** 2).sum(axis=1) / self.system.masses
        return float(left_out.max() / np.abs(self.unpack(x)).sum(axis=1).max())

    def start(self, energy: float) -> Point:
        """Return the motion of about an ``energy`` in J near the linear mode; raises ContinuationError without one."""
        frequencies, shapes = self.system.linear_modes()
        omega = float(frequencies[self.mode])
        shape = shapes[:, self.mode]
        u = np.zeros((self.system.dofs, self.order + 1), complex)
        u[:, 1] = shape * np.sqrt(2 * energy) / omega
        zeta = float(shape @ self.damping @ shape) / (2 * omega)

        frame = DampedFrame(self, self.pack(u), zeta, omega)
        along = unit(np.append(frame.xi[:-2], [0.0, 0.0]))
        attempt = frame.solve(frame.xi, along, along @ frame.xi)
        if not attempt.converged:
            why = f"{attempt.reason}; residuals {attempt.residuals}"
            raise ContinuationError(f"no damped motion near mode {self.mode + 1} ({why}): change nnm.start_energy")
        return frame.measures(attempt)

    def frame(self, point: Point, chart: str = "auto") -> DampedFrame:
        """Return the frame at a motion; there is one ``chart``."""
        frame = DampedFrame(self, point.x[:-1], float(point.x[-1]), 2 * np.pi / point.period)
        if point.tangent.size:
            frame.tangent = unit(frame.direction(point))
        return frame

    def first_tangent(self, start: Point, direction: int) -> np.ndarray:
        """Return the tangent d(x, zeta, period) at a motion, towards growing (+1) or falling (-1) energy."""
        frame = self.frame(start)
        null_vector = np.linalg.svd(frame.jacobian(frame.xi))[2][-1]
        first = frame.measures(Attempt(converged=True, reason="", history=[], xi=frame.xi), null_vector)
        return first.tangent * ((np.sign(first.energy_tangent) or 1.0) * direction)

    def special_kinds(self, left: Point, right: Point) -> Iterator[SpecialKind[Point]]:
        """Yield folds of the energy and of the frequency, between two motions that are not linear."""
        return folds(self.forces, left, right)
