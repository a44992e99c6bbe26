r"""The equations of damped nonlinear modes, by the extended periodic motion concept: balance with a negative damping.

A system M u'' + C u' + K u + B^T f(z, z') = 0, with the forces f at the elongations z = B u of contacts and springs
that are not linear, has no periodic motions if it dissipates. A damping proportional to the masses is therefore added,
with the sign and the size that make up for the loss in each period (Krack, Comput. Struct. 154 (2015) 59):

    M u'' + C u' + K u + B^T f - 2 zeta Om M u' = 0.

Its periodic motions u = Re sum_k U_k exp(i k Om t) form branches on which the frequency Om and the *damping ratio* zeta
depend on the size of the motion. Both are those of the linear mode where it is small: exact if C is proportional to M,
else up to zeta^2. Without loss zeta is 0, and the motions are the conservative ones. The harmonics k = 0..K obey

    [K + i k Om C - ((k Om)^2 + 2 i k zeta Om^2) M] U_k + B^T F_k(B U) = 0,    Im phi^T M U_1 = 0,

where the last equation fixes the phase with the linear mode phi. Rigid motions that nothing resists leave the mean
open; that of the motion's centre of mass is taken to be 0. Unknowns are the real and imaginary parts of the
harmonics of all masses, odd ones alone if all forces are odd, zeta, and Om. Derivatives are exact. The energy is the
mean of the mechanical one over a period, which changes within it.
"""

import numpy as np
from scipy.linalg import null_space

from vipetsc.modes.balance.harmonic_balance import RealUnknowns
from vipetsc.modes.balance.harmonics import ForceSeries, SiteForces
from vipetsc.modes.problem import unit
from vipetsc.modes.system import System

# Step of the difference by which the energy's change along a branch is computed, in unknowns of order one.
ALONG = 1e-6
# A motion is rigid if it stretches springs, contacts and nonlinear springs by less than this fraction of the largest.
RIGID = 1e-12


class DampedBalance(RealUnknowns):
    """The equations of damped modes of a ``system`` with dashpots ``damping`` (n, n) in N s/m, up to an ``order``.

    ``forces`` are those of its contacts, which may dissipate, and of its springs that are not linear. The phase is that
    of the linear ``mode``, counted from 0. Unknowns x are the damping ratio, and behind it the harmonics (size,) in m.
    The residual is divided by the stiffness that the largest mass has by its inertia in that mode, and so is in m.
    """

    def __init__(self, system: System, damping: np.ndarray, forces: SiteForces, order: int, mode: int) -> None:
        super().__init__(system.dofs, order, forces.odd, cosines=False)
        self.system = system
        self.damping = damping
        self.forces = forces
        self.pair_rows = np.vstack([system.contact_rows, system.spring_rows])
        frequencies, shapes = system.linear_modes()
        self.stiffness = float(frequencies[mode] ** 2 * system.masses.max())
        # What no spring and no contact holds is held in the mean by springs, which have no force where the centre of
        # mass is at rest: all other forces between masses that move together have the sum 0.
        largest = np.abs(system.stiffness_at_rest).max()
        rigid = null_space(np.vstack([system.stiffness_at_rest / largest, self.pair_rows]), rcond=RIGID)
        momenta = system.masses[:, None] * rigid / system.masses.max()
        self.holding = self.stiffness * momenta @ momenta.T
        quarter = np.zeros((system.dofs, order + 1), complex)
        quarter[:, 1] = 1j * system.masses * shapes[:, mode]
        self.phase_row = unit(self.pack(quarter))

    def unpack(self, x: np.ndarray) -> np.ndarray:
        """Return harmonics (masses, K + 1) complex of unknowns."""
        return super().unpack(x[1:])

    def resized(self, x: np.ndarray) -> np.ndarray:
        """Return unknowns (size + 1,) from those of another order, ``x`` (n + 1,)."""
        return np.append(x[0], super().resized(x[1:]))

    def elongations(self, x: np.ndarray) -> np.ndarray:
        """Return harmonics (pairs, K + 1) complex in m of the elongations."""
        return self.pair_rows @ self.unpack(x)

    def series(self, x: np.ndarray, omega: float) -> ForceSeries:
        """Return the forces at the elongations of a motion."""
        return self.forces.series(self.elongations(x), omega)

    def shift(self, omega: float) -> np.ndarray:
        """Return no stiffnesses: these equations have no poles."""
        return np.empty(0)

    def _dynamic(self, zeta: float, omega: float) -> np.ndarray:
        """Return the dynamic stiffness (order, masses, masses) of the linear system with the negative damping."""
        rates = (self.orders * omega)[:, None, None]
        masses = np.diag(self.system.masses)
        linear = self.system.stiffness_at_rest + 1j * rates * (self.damping - 2 * zeta * omega * masses)
        linear[self.orders == 0] += self.holding
        return np.asarray(linear - rates**2 * masses)

    def residual(self, x: np.ndarray, omega: float, shift: np.ndarray) -> np.ndarray:
        """Return the residual (size + 1,) of the harmonics of all masses, and of the phase."""
        u = self.unpack(x)
        out = self.pair_rows.T @ self.series(x, omega).forces[:, : self.order + 1]
        out[:, self.orders] += np.einsum("kij,jk->ik", self._dynamic(x[0], omega), u[:, self.orders])
        return np.append(self.pack(out) / self.stiffness, self.phase_row @ x[1:])

    def jacobian(self, x: np.ndarray, omega: float, shift: np.ndarray) -> np.ndarray:
        """Return the derivative (size + 1, size + 1) of the residual by the unknowns."""
        count = len(self.orders)
        skipped = self.skipped
        dofs = self.system.dofs
        changes = self.by_unknowns(self.series(x, omega))
        matrix = np.einsum("pi,pku,pj->ikju", self.pair_rows, changes, self.pair_rows).astype(complex)
        dynamic = self._dynamic(x[0], omega)
        for place in range(count):
            matrix[:, place, :, place] += dynamic[place]
            if place >= skipped:
                matrix[:, place, :, count + place - skipped] += 1j * dynamic[place]
        by_harmonics = self.real_rows(matrix.reshape(dofs, count, -1)) / self.stiffness

        orders = np.arange(self.order + 1)
        by_zeta = self.pack(-2j * orders * omega**2 * self.system.masses[:, None] * self.unpack(x)) / self.stiffness
        return np.block([[by_zeta[:, None], by_harmonics], [0.0, self.phase_row]])

    def rate(self, x: np.ndarray, omega: float, shift: np.ndarray) -> np.ndarray:
        """Return the derivative (size + 1,) of the residual by omega."""
        u = self.unpack(x)
        orders = np.arange(self.order + 1)
        inertia = (2 * orders**2 + 4j * orders * x[0]) * omega * self.system.masses[:, None] * u
        by_omega = 1j * orders * (self.damping @ u) - inertia
        return np.append(self.pack(by_omega) / self.stiffness, 0.0)

    def kinetic_energy(self, x: np.ndarray, omega: float) -> float:
        """Return the mean kinetic energy in J over a period."""
        speeds = np.abs(self.unpack(x) * np.arange(self.order + 1) * omega) ** 2
        return float(self.system.masses @ speeds.sum(axis=1) / 4)

    def energy(self, x: np.ndarray, omega: float, shift: np.ndarray) -> float:
        """Return the mean mechanical energy in J over a period."""
        u = self.unpack(x)
        means = np.where(np.arange(self.order + 1) == 0, 0.5, 0.25)
        stored = np.einsum("ik,ij,jk->k", u.conj(), self.system.stiffness_at_rest, u).real
        return self.kinetic_energy(x, omega) + float(stored @ means) + float(self.series(x, omega).potential.sum())

    def energy_change(
        self, x: np.ndarray, omega: float, shift: np.ndarray, along: np.ndarray, by_omega: float
    ) -> float:
        """Return change of the ``energy`` in J with the unknowns by ``along`` (size + 1,) and omega by ``by_omega``."""
        ends = [self.energy(x + step * along, omega + step * by_omega, shift) for step in (ALONG, -ALONG)]
        return (ends[0] - ends[1]) / (2 * ALONG)

    def loss(self, x: np.ndarray, omega: float) -> float:
        """Return what the negative damping gives back in a period, in J: the integral of 2 zeta Om u'^T M u'."""
        return float(8 * np.pi * x[0]) * self.kinetic_energy(x, omega)

    def truncation(self, x: np.ndarray, omega: float) -> float:
        """Return estimated size of the harmonics left out, which inertia alone holds, over the sum of those kept."""
        forces = np.abs(self.pair_rows.T @ self.series(x, omega).forces)
        beyond = np.arange(self.order + 1, forces.shape[1])
        left_out = (forces[:, beyond] / (beyond * omega) ** 2).sum(axis=1) / self.system.masses
        return float(left_out.max() / np.abs(self.unpack(x)).sum(axis=1).max())
