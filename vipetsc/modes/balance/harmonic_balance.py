r"""Periodic motions condensed onto the places where a system is nonlinear: harmonic balance at contacts and springs.

A system M u'' + K u + sum_j b_j f_j = p has the displacements u, the forces f_j at the pairs j, which act along b_j and
depend on the elongations z_j = b_j . u, and a load p of the frequency Om. Its motions z = Re sum_k Z_k exp(i k Om t)
obey

    Z_k + G(k Om) F_k(Z) = Z_k^linear,    G(omega) = b^T (K - omega^2 M)^-1 b,    k = 0..K,

with the harmonics F_k of the forces, and those of the elongations under the load alone, Z_k^linear. The equations are
exact but for the harmonics beyond K, whatever the number of degrees of freedom: ``Compliance`` gives G, also of systems
with losses. The forces and their derivatives are ``SiteForces``. What is left out is -G(k Om) F_k for k > K; F_k is
computed up to 2K, falls as k^-(n + 1) for a contact with the exponent n, and G as k^-2, so that its size is estimated
(``HarmonicBalance.truncation``).

**Shifted compliance.** G has poles at the linear modes, where F_k vanishes: their product cannot be computed. A spring
of stiffness s_k is therefore added at each place and taken off the force:

    Z_k + G_s (F_k - s_k Z_k) = A Z_k^linear,    G_s = A G,    A = (1 + s_k G)^-1.

This is the equation above with s_k G Z_k added and taken off, multiplied by A: it has the same solutions. The sign of
s_k is the one that keeps the poles of G_s away from k Om; |s_k| is (k Om)^2 times the effective mass of a pair, the
size of the stiffness that it has by inertia alone.

**Energy** of a conservative motion, which is constant, from its means over a period: with dG/domega = 2 omega
b^T (K - omega^2 M)^-1 M (K - omega^2 M)^-1 b,

    E = F_0 . G(0) F_0/2 + sum_{k>0} F_k* . (G + omega dG/domega) F_k/4 + mean potential of f,    omega = k Om;

it is evaluated for the shifted compliance, less the energy of the added springs.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np

from vipetsc.modes.balance.harmonics import ForceSeries, SiteForces
from vipetsc.modes.balance.shifted_compliance import Compliance, ShiftedCompliance
from vipetsc.modes.latest import LatestValues

# The energy's derivative by the frequency at given forces is a difference over this fraction of the frequency to each
# side. The linear system alone enters, whose shifted compliance has no pole there.
FREQUENCY_STEP = 1e-5


class _Columns(NamedTuple):
    """How the harmonics of one pair follow from its unknowns.

    ``orders`` (2 orders,) are the orders k of the harmonics, and then -k of their conjugates. ``halves`` (orders, 1)
    is 1/2 for the mean, which would otherwise be counted for k and for -k, and 1 for the others. ``same`` (orders,
    unknowns) is dZ/dx of the pair.
    """

    orders: np.ndarray
    halves: np.ndarray
    same: np.ndarray


class HarmonicBalance:
    """The equations of motions with harmonics up to the ``order`` K, in real unknowns x (size,) in m.

    With ``odd`` only odd orders k are unknowns, which is enough for motions z(theta + pi) = -z(theta) if ``forces`` are
    odd, too. With ``cosines`` only the real parts of the harmonics are, which is enough for conservative motions at
    rest at phase 0: ``forces`` that depend on no velocity, and no load. x holds, pair by pair, Re Z_k for all orders k
    and then Im Z_k. ``weight`` multiplies the compliances of orders above the first: with 0 a motion has a mean and one
    harmonic.

    Residual, derivative and energy are those of the compliance shifted by stiffnesses, which ``shift`` chooses at a
    frequency; one choice must be kept along a step. ``shifted`` may be that of other equations with the same
    compliance, orders and weight, whose values are then not computed again.
    """

    def __init__(
        self,
        compliance: Compliance,
        forces: SiteForces,
        order: int,
        odd: bool,
        cosines: bool,
        weight: float = 1.0,
        shifted: ShiftedCompliance | None = None,
    ) -> None:
        self.compliance = compliance
        self.forces = forces
        self.order = order
        self.odd = odd
        self.cosines = cosines
        self.weight = weight
        self.orders = np.arange(order + 1)
        if odd:
            self.orders = np.arange(1, order + 1, 2)
        # The cosines of all orders and the sines of those above 0 have these places among the orders from 0 to K.
        self._places = slice(int(self.orders[0]), None, 1 + odd)
        self._sine_places = slice(1, None, 1 + odd)
        if cosines:
            self._sine_places = slice(0, 0)
        self._sines = np.arange(order + 1)[self._sine_places]
        self.size = forces.pairs * (len(self.orders) + len(self._sines))
        if shifted is None:
            shifted = ShiftedCompliance(compliance, forces.pairs, self.orders, weight)
        self.shifted = shifted
        # Newton's method asks for the same forces several times.
        self._series = LatestValues[tuple[bytes, float], ForceSeries](1)
        self._changes = LatestValues[tuple[bytes, float, bytes], np.ndarray](1)

    def weighted(self, weight: float) -> "HarmonicBalance":
        """The equations with another ``weight``."""
        return HarmonicBalance(
            self.compliance, self.forces, order=self.order, odd=self.odd, cosines=self.cosines, weight=weight
        )

    def pack(self, z: np.ndarray) -> np.ndarray:
        """Unknowns (size,) of harmonics (pairs, K + 1) complex."""
        return np.hstack([z[:, self._places].real, z[:, self._sine_places].imag]).ravel()

    def unpack(self, x: np.ndarray) -> np.ndarray:
        """Harmonics (pairs, K + 1) complex of unknowns."""
        z = np.zeros((self.forces.pairs, self.order + 1), complex)
        parts = x.reshape(self.forces.pairs, -1)
        z.real[:, self._places] = parts[:, : len(self.orders)]
        z.imag[:, self._sine_places] = parts[:, len(self.orders) :]
        return z

    def resized(self, x: np.ndarray) -> np.ndarray:
        """Unknowns (size,) from those of equations with another ``order``, ``x`` (n,); 0 for orders that are new.

        Both must have cosines alone, and both have odd orders alone or all.
        """
        parts = x.reshape(self.forces.pairs, -1)
        out = np.zeros((len(parts), self.size // len(parts)))
        count = min(parts.shape[1], out.shape[1])
        out[:, :count] = parts[:, :count]
        return out.ravel()

    def series(self, x: np.ndarray, omega: float) -> ForceSeries:
        """The forces' harmonics and derivatives at the unknowns ``x`` (n,)."""
        key = x.tobytes(), omega
        return self._series.get(key, lambda: self.forces.series(self.unpack(x), omega))

    def shift(self, omega: float) -> np.ndarray:
        """The stiffnesses s (orders, 1, 1) in N/m to shift the compliance by for motions near ``omega``."""
        return self.shifted.shift(omega)

    def shifted_force(self, x: np.ndarray, omega: float, shift: np.ndarray) -> np.ndarray:
        """F - s Z (orders, pairs, 1) complex in N."""
        force = self.series(x, omega).forces[:, : self.order + 1].T[self._places, :, None]
        elongation = self.unpack(x).T[self._places, :, None]
        return force - shift * elongation

    def residual(self, x: np.ndarray, omega: float, shift: np.ndarray, linear: np.ndarray | float = 0.0) -> np.ndarray:
        """Z + G_s (F - s Z) - A Z^linear as unknowns (size,), in m, which vanishes at a solution.

        ``x`` (size,) are the unknowns in m, ``omega`` is in rad/s, ``shift`` (orders, 1, 1) in N/m, and ``linear``
        (pairs, K + 1) complex in m are the harmonics Z^linear.
        """
        shifted = self.shifted.at(omega, shift)
        z = self.unpack(x)
        elongation = z.T[self._places, :, None]
        given = np.broadcast_to(linear, z.shape).T[self._places, :, None]
        out = np.zeros_like(z)
        balance = elongation + shifted.compliance @ self.shifted_force(x, omega, shift) - shifted.factor @ given
        out[:, self._places] = balance[..., 0].T
        return self.pack(out)

    def drive_term(self, omega: float, shift: np.ndarray, linear: np.ndarray) -> np.ndarray:
        """-A Z^linear, what a ``linear`` motion (pairs, K + 1) adds to the ``residual``, as unknowns (size,) in m.

        Only the orders that the motion has are computed, and no forces.
        """
        out = np.zeros_like(linear)
        for order in np.flatnonzero(linear.any(axis=0)).tolist():
            out[:, order] = -(self.shifted.factor(order, omega, shift) @ linear[:, order])
        return self.pack(out)

    def jacobian(self, x: np.ndarray, omega: float, shift: np.ndarray) -> np.ndarray:
        """dR/dx (size, size) of the ``residual``."""
        shifted = self.shifted.at(omega, shift)
        columns = self._columns
        count = len(self.orders)
        pairs = self.forces.pairs
        changes = self._force_changes(x, omega, shift)

        # Of pair i and order k by the unknown u of pair j: G_s (dF - s dZ), and dZ of the pair itself.
        matrix = shifted.compliance.swapaxes(0, 1)[:, :, :, None] * changes.swapaxes(0, 1)
        for pair in range(pairs):
            matrix[pair, :, pair] += columns.same
        matrix = matrix.reshape(pairs, count, -1)
        rows = [matrix.real, matrix[:, count - len(self._sines) :].imag]
        return np.concatenate(rows, axis=1).reshape(self.size, self.size)

    def _force_changes(self, x: np.ndarray, omega: float, shift: np.ndarray) -> np.ndarray:
        """The derivative (pair, orders, unknowns of the pair) of F - s Z by the unknowns of the same pair."""

        def compute() -> np.ndarray:
            columns = self._columns
            count = len(self.orders)
            # The forces' derivative by the harmonics of orders k and -k, which are conjugate to each other: by Re Z_k
            # they change by 1 and 1, by Im Z_k by i and -i.
            two_sided = self.series(x, omega).jacobian(orders=columns.orders, rows=self.orders) * columns.halves
            plus = two_sided[:, :, :count]
            minus = two_sided[:, :, count:]
            changes = np.concatenate([plus + minus, 1j * (plus - minus)[:, :, count - len(self._sines) :]], axis=2)
            changes -= shift[:, 0] * columns.same
            return changes

        return self._changes.get((x.tobytes(), omega, shift.tobytes()), compute)

    def rate(self, x: np.ndarray, omega: float, shift: np.ndarray) -> np.ndarray:
        """dR/domega (size,) in m s/rad of the ``residual`` with no linear motion given: dG_s/domega (F - s Z).

        G_s of the order k is taken at k omega, which gives its derivative the factor k. F depends on omega only through
        the floor of the approach velocity and through ``Stops.drag``; both are left out.
        """
        out = np.zeros((self.forces.pairs, self.order + 1), complex)
        by_omega = self.shifted.rate(omega, shift) @ self.shifted_force(x, omega, shift)
        out[:, self._places] = (self.orders[:, None, None] * by_omega)[..., 0].T
        return self.pack(out)

    @cached_property
    def _columns(self) -> _Columns:
        count = len(self.orders)
        one = np.eye(count)
        return _Columns(
            orders=np.concatenate([self.orders, -self.orders]),
            halves=np.where(self.orders == 0, 0.5, 1.0)[:, None],
            same=np.concatenate([one, 1j * one[:, count - len(self._sines) :]], axis=1),
        )

    def truncation(self, x: np.ndarray, omega: float) -> float:
        """Estimated size of the harmonics left out of the motion ``x`` (n,), over the largest sum of those kept.

        The harmonics from K + 1 to 2K are -G F_k, where G falls as k^-2 from its value at K omega, as inertia does. For
        each pair the sum of |G| over its row stands for G. Those beyond 2K are taken to be 1/3 of those from K to 2K,
        as if all fell as k^-3.
        """
        highest = self.orders[-1]
        forces = np.abs(self.series(x, omega).forces)
        g = np.abs(self.shifted.values(omega)[-1]).sum(axis=1)
        beyond = np.arange(self.order + 1, forces.shape[1])
        left_out = (g[:, None] * forces[:, beyond] * (highest / beyond) ** 2).sum(axis=1) * 4 / 3
        size = np.abs(self.unpack(x)).sum(axis=1).max()
        # At rest there is nothing to leave out.
        if size == 0:
            return 0.0
        return float(left_out.max() / size)

    def energy(self, x: np.ndarray, omega: float, shift: np.ndarray) -> float:
        """Energy in J of a conservative motion at ``omega`` in rad/s.

        ``x`` (size,) are its unknown harmonics in m, ``shift`` (orders, 1, 1) in N/m the stiffnesses of ``shift``.
        """
        elongation = self.unpack(x).T[self._places]
        force = self.shifted_force(x, omega, shift)[..., 0]
        energies = np.einsum("ki,kij,kj->k", force.conj(), self._stored_by_forces(omega, shift), force).real
        # What the added springs hold.
        energies -= shift[:, 0, 0] * np.sum(np.abs(elongation) ** 2, axis=1)
        return float(self._means @ energies / 2 + self.series(x, omega).potential.sum())

    def energy_change(
        self, x: np.ndarray, omega: float, shift: np.ndarray, along: np.ndarray, by_omega: float
    ) -> float:
        """The change of the ``energy`` in J with the unknowns by ``along`` (size,) in m and omega by ``by_omega``.

        The forces' derivative is exact, also next to a touch, where a difference along the branch would be wrong.
        """
        elongation = self.unpack(x).T[self._places]
        change = self.unpack(along).T[self._places]
        shifts = shift[:, 0]
        shifted_force = self.shifted_force(x, omega, shift)[..., 0]
        of_pairs = along.reshape(self.forces.pairs, -1)
        force_change = np.einsum("pku,pu->kp", self._force_changes(x, omega, shift), of_pairs)

        stored = self._stored_by_forces(omega, shift)
        changes = np.einsum("ki,kij,kj->k", shifted_force.conj(), stored, force_change).real
        changes -= np.sum((shifts * elongation.conj() * change).real, axis=1)
        # The potential changes by the work of the forces.
        force = shifted_force + shifts * elongation
        changes += np.sum((force.conj() * change).real, axis=1)

        step = FREQUENCY_STEP * omega
        after = self._stored_by_forces(omega + step, shift)
        before = self._stored_by_forces(omega - step, shift)
        by_frequency = np.einsum("ki,kij,kj->k", shifted_force.conj(), after - before, shifted_force).real
        return float(self._means @ (changes + by_frequency / (4 * step) * by_omega))

    def _stored_by_forces(self, omega: float, shift: np.ndarray) -> np.ndarray:
        """G_s + omega dG_s/domega (orders, pairs, pairs), by which forces give the energy of the linear system."""
        compliance = self.shifted.at(omega, shift).compliance
        return compliance + (self.orders * omega)[:, None, None] * self.shifted.rate(omega, shift)

    @cached_property
    def _means(self) -> np.ndarray:
        """The mean (orders,) over a period of products of two harmonics of one order."""
        return np.where(self.orders == 0, 1.0, 0.5)
