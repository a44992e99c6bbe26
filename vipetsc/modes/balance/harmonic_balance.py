r"""Periodic motions condensed onto the places where a system is nonlinear: harmonic balance at contacts and springs.

M u'' + K u + sum_j b_j f_j = p with the elongations z_j = b_j . u has the periodic solutions

    Z_k + G(k Om) F_k(Z) = Z_k^linear,    G(omega) = b^T (K - omega^2 M)^-1 b,    k = 0..K,

exact but for the harmonics beyond K, whatever the number of degrees of freedom: ``Compliance`` gives G. The forces and
their derivatives are ``SiteForces``. What is left out is -G(k Om) F_k for k > K; F_k is computed up to 2K, falls as
k^-(n + 1) for a contact with the exponent n, and G as k^-2, so that its size is estimated
(``HarmonicBalance.truncation``).

**Shifted compliance.** G has poles at the linear modes, where F_k vanishes. A spring of stiffness s_k is therefore
added at each place and taken off the force: Z_k + G_s (F_k - s_k Z_k) = A Z_k^linear, G_s = A G, A = (1 + s_k G)^-1,
which has the same solutions. The sign of s_k is the one that keeps the poles of G_s away from k Om; |s_k| is
(k Om)^2 times the effective mass.

**Energy** of a conservative motion, which is constant, from its means over a period: with dG/domega = 2 omega
b^T (K - omega^2 M)^-1 M (K - omega^2 M)^-1 b,

    E = F_0 . G(0) F_0/2 + sum_{k>0} F_k* . (G + omega dG/domega) F_k/4 + mean potential of f,    omega = k Om;

it is evaluated for the shifted compliance, less the energy of the added springs.
"""

from typing import NamedTuple, Protocol

import numpy as np

from vipetsc.lattice import DenseCompliance
from vipetsc.modes.balance.harmonics import ForceSeries, SiteForces

# Radius, over the frequency, of a circle on which Cauchy's formula gives the derivative of a real compliance, and the
# lower half of its nodes.
RADIUS = 1e-4
NODES = np.exp(-1j * np.pi / 8 * np.array([1, 3, 5, 7]))
# Relative step of a difference for a complex compliance, which Cauchy's formula on half a circle does not fit.
STEP = 1e-6
# The order 0 has no frequency of its own to scale a step by: this fraction of the highest.
LEAST_RATE = 1e-3
# Relative detuning of a frequency at which the compliance has a pole.
DETUNING = 1e-15
# Size of the compliance times the stiffness of the shift from which several pairs are taken to be close to a pole.
NEAR_POLE = 1e3


class Compliance(Protocol):
    """Interface of ``lattice.compliance``: G (frequencies, pairs, pairs) in m/N, real or complex."""

    def at(self, omegas: np.ndarray) -> np.ndarray:
        """G (frequency, place, place) in m/N at ``omegas`` (frequency,) in rad/s, which may be complex."""


class Compliances(NamedTuple):
    """G at the multiples of a frequency and at points near each of them, for its derivative.

    ``values`` (1 + nodes, orders, pairs, pairs) in m/N; ``circle`` (nodes,) are the distances of these points over
    ``scale`` (orders,) in rad/s, which has the number of nodes as a factor.
    """

    values: np.ndarray
    scale: np.ndarray
    circle: np.ndarray


class Shifted(NamedTuple):
    """The shifted compliance G_s (orders, pairs, pairs), its derivative by the frequency, and the factor A."""

    compliance: np.ndarray
    rate: np.ndarray
    factor: np.ndarray


class HarmonicBalance:
    """The equations of motions with the harmonics ``orders``, in real unknowns x: cosines, then sines if not left out.

    ``order`` is K, the highest. Odd orders alone are enough for symmetric motions of ``forces.odd``; ``cosines`` alone
    for conservative motions that are at rest at phase 0. x holds, pair by pair, Re Z_k and then Im Z_k for the orders
    k, in m. ``weight`` multiplies the compliances of orders above the first: at 0 a motion has a mean and one harmonic.

    Residual, derivative and energy are those of the compliance shifted by stiffnesses that ``shift`` chooses at a
    frequency: all of them are asked with one choice along a step.
    """

    def __init__(
        self, compliance: Compliance, forces: SiteForces, order: int, odd: bool, cosines: bool, weight: float = 1.0
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
        self._sines = self.orders[self.orders > 0]
        if cosines:
            self._sines = self.orders[:0]
        self.size = forces.pairs * (len(self.orders) + len(self._sines))
        # The latest compliances and forces: Newton's method asks for the same ones several times.
        self._compliances: tuple[float, Compliances] | None = None
        self._series: tuple[np.ndarray, float, ForceSeries] | None = None

    def weighted(self, weight: float) -> "HarmonicBalance":
        """The equations with another ``weight``."""
        return HarmonicBalance(self.compliance, self.forces, self.order, self.odd, self.cosines, weight)

    def pack(self, z: np.ndarray) -> np.ndarray:
        """Unknowns (size,) of harmonics (pairs, K + 1) complex."""
        return np.hstack([z[:, self.orders].real, z[:, self._sines].imag]).ravel()

    def unpack(self, x: np.ndarray) -> np.ndarray:
        """Harmonics (pairs, K + 1) complex of unknowns."""
        z = np.zeros((self.forces.pairs, self.order + 1), complex)
        parts = x.reshape(self.forces.pairs, -1)
        z[:, self.orders] = parts[:, : len(self.orders)]
        z[:, self._sines] += 1j * parts[:, len(self.orders) :]
        return z

    def series(self, x: np.ndarray, omega: float) -> ForceSeries:
        """The forces' harmonics and derivatives at the unknowns ``x`` (n,)."""
        if self._series is None or self._series[1] != omega or not np.array_equal(self._series[0], x):
            self._series = x.copy(), omega, self.forces.series(self.unpack(x), omega)
        return self._series[2]

    def compliances(self, omega: float) -> Compliances:
        """G at the multiples ``orders`` of ``omega`` in rad/s, and near each of them."""
        if self._compliances is None or self._compliances[0] != omega:
            self._compliances = omega, self._evaluate(omega)
        return self._compliances[1]

    def _evaluate(self, omega: float) -> Compliances:
        rates = self.orders * omega
        sizes = np.maximum(rates, LEAST_RATE * rates[-1])
        with np.errstate(divide="ignore", invalid="ignore"):
            values = self.compliance.at(rates)
        # On a linear mode the compliance is infinite, and the motion finite.
        if not np.all(np.isfinite(values)):
            values = self.compliance.at(rates * (1 + DETUNING))

        # A compliance that is real on the real axis has conjugate values above and below it: half a circle is enough.
        circle = STEP * np.array([1.0, -1.0])
        if np.isrealobj(values):
            circle = RADIUS * NODES
        near = self.compliance.at((rates + sizes * circle[:, None]).ravel())
        values = np.concatenate([values[None], near.reshape(len(circle), *values.shape)])
        values[:, self.orders > 1] *= self.weight
        return Compliances(values, sizes * len(circle), circle)

    def shift(self, omega: float) -> np.ndarray:
        """The stiffnesses s (orders, 1, 1) in N/m to shift the compliance by for motions near ``omega``."""
        g = self.compliances(omega).values[0]
        one = np.eye(self.forces.pairs)
        squared = np.maximum(self.orders, 1) ** 2
        # At the highest order inertia alone counts: G = -1/(mass omega^2). Of the two signs of the stiffness the one
        # that keeps 1 + s G farther from singular has the poles of G_s farther away.
        mass = 1 / (self.orders[-1] ** 2 * np.abs(np.trace(g[-1])) / self.weight / len(one))  # times omega^2
        size = (mass * squared)[:, None, None]
        plus, minus = (np.linalg.svd(one + sign * size * g, compute_uv=False)[:, -1] for sign in (1, -1))
        return np.where((plus >= minus)[:, None, None], size, -size)

    def _shifted(self, omega: float, shift: np.ndarray) -> Shifted:
        values, scale, circle = self.compliances(omega)
        factor = np.linalg.inv(np.eye(self.forces.pairs) + shift * values)
        shifted = factor @ values
        self._correct_near_modes(omega, shift, values[0], shifted[0], factor[0])
        slopes = np.einsum("n,nkij->kij", 1 / circle, shifted[1:]) / scale[:, None, None]
        if len(circle) == len(NODES):  # the other half of the circle is its conjugate
            return Shifted(shifted[0].real, slopes.real, factor[0].real)
        return Shifted(shifted[0], slopes, factor[0])

    def _correct_near_modes(
        self, omega: float, shift: np.ndarray, values: np.ndarray, shifted: np.ndarray, factor: np.ndarray
    ) -> None:
        """Compute ``shifted`` and ``factor`` anew, of orders at which the compliance ``values`` are close to a pole.

        All three are (orders, pairs, pairs). Near the pole of a mode the compliance of several pairs is that of the
        mode alone, to rounding, and the inverse has lost the rest; of one pair nothing is lost.
        """
        if self.forces.pairs < 2 or not isinstance(self.compliance, DenseCompliance):
            return
        sizes = np.abs(shift[:, 0, 0]) * np.abs(values).max(axis=(1, 2))
        (near,) = np.nonzero(sizes > NEAR_POLE)
        stiffness = shift[near, 0, 0]
        if near.size and self.weight == 1.0:
            shifted[near] = self.compliance.with_springs(self.orders[near] * omega, stiffness)
            factor[near] = np.eye(self.forces.pairs) - stiffness[:, None, None] * shifted[near]

    def shifted_force(self, x: np.ndarray, omega: float, shift: np.ndarray) -> np.ndarray:
        """F - s Z (orders, pairs, 1) complex in N."""
        force = self.series(x, omega).forces.T[self.orders, :, None]
        elongation = self.unpack(x).T[self.orders, :, None]
        return force - shift * elongation

    def residual(self, x: np.ndarray, omega: float, shift: np.ndarray, linear: np.ndarray | float = 0.0) -> np.ndarray:
        """Z + G_s (F - s Z) - A Z^linear as unknowns (size,), in m; ``linear`` (pairs, K + 1) complex."""
        shifted = self._shifted(omega, shift)
        z = self.unpack(x)
        elongation = z.T[self.orders, :, None]
        given = np.broadcast_to(linear, z.shape).T[self.orders, :, None]
        out = np.zeros_like(z)
        balance = elongation + shifted.compliance @ self.shifted_force(x, omega, shift) - shifted.factor @ given
        out[:, self.orders] = balance[..., 0].T
        return self.pack(out)

    def derivative(self, x: np.ndarray, omega: float, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """dR/dx (size, size) and dR/domega (size,) of the ``residual`` with no linear motion given.

        F does not depend on omega, but through a floor of the approach velocity, which is left out.
        """
        shifted = self._shifted(omega, shift)
        series = self.series(x, omega)
        count = len(self.orders)
        pairs = self.forces.pairs

        # The forces' derivative by the harmonics of orders k and -k, which are conjugate to each other.
        two_sided = series.jacobian(orders=np.concatenate([self.orders, -self.orders]))[:, :count]
        two_sided[:, self.orders == 0] *= 0.5  # one-sided series have the mean once
        plus = two_sided[:, :, :count]
        minus = two_sided[:, :, count:]
        sines = np.isin(self.orders, self._sines)
        columns = np.concatenate([plus + minus, 1j * (plus - minus)[:, :, sines]], axis=2)
        same = np.concatenate([np.eye(count), 1j * np.eye(count)[:, sines]], axis=1)

        matrix = np.einsum("kij,jku->ikju", shifted.compliance, columns - shift[:, 0] * same)
        matrix += np.einsum("ij,ku->ikju", np.eye(pairs), same)
        matrix = matrix.reshape(pairs, count, -1)
        jacobian = np.concatenate([matrix.real, matrix[:, sines].imag], axis=1).reshape(self.size, self.size)

        out = np.zeros_like(self.unpack(x))
        by_omega = self.orders[:, None, None] * shifted.rate @ self.shifted_force(x, omega, shift)
        out[:, self.orders] = by_omega[..., 0].T
        return jacobian, self.pack(out)

    def truncation(self, x: np.ndarray, omega: float) -> float:
        """Estimated size of the harmonics left out of ``x`` (n,), over the largest sum of those kept.

        Those from K + 1 to 2K are -G F_k with G continued by its last value as k^-2; the others are estimated from them
        by the bound k^-3 of their fall.
        """
        highest = self.orders[-1]
        forces = np.abs(self.series(x, omega).forces)
        g = np.abs(self.compliances(omega).values[0, -1]).sum(axis=1)
        beyond = np.arange(self.order + 1, forces.shape[1])
        left_out = (g[:, None] * forces[:, beyond] * (highest / beyond) ** 2).sum(axis=1) * 4 / 3
        return float(left_out.max() / np.abs(self.unpack(x)).sum(axis=1).max())

    def energy(self, x: np.ndarray, omega: float, shift: np.ndarray) -> float:
        """Energy in J of a conservative motion at ``omega`` in rad/s.

        ``x`` (size,) are its unknown harmonics in m, ``shift`` (orders, 1, 1) in N/m the stiffnesses of ``shift``.
        """
        shifted = self._shifted(omega, shift)
        elongation = self.unpack(x).T[self.orders]
        force = self.shifted_force(x, omega, shift)[..., 0]
        quadratic = shifted.compliance + (self.orders * omega)[:, None, None] * shifted.rate
        energies = np.einsum("ki,kij,kj->k", force.conj(), quadratic, force).real
        energies -= shift[:, 0, 0] * np.sum(np.abs(elongation) ** 2, axis=1)  # what the added springs hold
        return float(np.where(self.orders == 0, 0.5, 0.25) @ energies + self.series(x, omega).potential.sum())
