r"""Periodic motions condensed onto the places where a system is nonlinear: harmonic balance at contacts and springs.

M u'' + K u + sum_j b_j f_j = p with the elongations z_j = b_j . u has the periodic solutions

    Z_k + G(k Om) F_k(Z) = Z_k^linear,    G(omega) = b^T (K - omega^2 M)^-1 b,    k = 0..K,

exact but for the harmonics beyond K, whatever the number of degrees of freedom: ``Compliance`` gives G. The forces and
their derivatives are ``SiteForces``. What is left out is -G(k Om) F_k for k > K; F_k is known up to 2K, falls as
k^-(n + 1) for a contact with the exponent n, and G as k^-2, so that its size is estimated (``Balance.truncation``).

**Shifted compliance.** G has poles at the linear modes, where F_k vanishes. A spring of stiffness s_k is therefore
added at each place and taken off the force: Z_k + G_s (F_k - s_k Z_k) = A Z_k^linear, G_s = A G, A = (1 + s_k G)^-1,
which has the same solutions. The sign of s_k is the one that keeps the poles of G_s away from k Om; |s_k| is
(k Om)^2 times the effective mass.

**Energy** of a conservative motion, which is constant, from its means over a period: with dG/domega = 2 omega
b^T (K - omega^2 M)^-1 M (K - omega^2 M)^-1 b,

    E = F_0 . G(0) F_0/2 + sum_{k>0} F_k* . (G + omega dG/domega) F_k/4 + mean potential of f,    omega = k Om;

it is evaluated for the shifted compliance, less the energy of the added springs.
"""

from typing import Protocol

import numpy as np

from vipetsc.modes.balance.harmonics import ForceSeries, SiteForces

# Radius, over the frequency, of a circle on which Cauchy's formula gives the derivative of a real compliance, and the
# lower half of its nodes; relative step of a difference for a complex compliance.
RADIUS, NODES, STEP = 1e-4, np.exp(-1j * np.pi / 8 * np.array([1, 3, 5, 7])), 1e-6


class Compliance(Protocol):
    """What is needed of ``lattice.compliance``: G (frequencies, pairs, pairs) in m/N, real or complex."""

    def at(self, omegas: np.ndarray) -> np.ndarray:
        """G at frequencies in rad/s, which may be complex."""


class Balance:
    """The equations of motions with the harmonics ``orders``, in real unknowns x: cosines, then sines if not left out.

    Odd orders alone are enough for symmetric motions of ``forces.odd``; ``cosines`` alone for conservative motions
    that are at rest at phase 0. x holds, pair by pair, Re Z_k and then Im Z_k for the orders k, in m.
    """

    def __init__(self, compliance: Compliance, forces: SiteForces, last: int, odd: bool, cosines: bool) -> None:
        self.compliance, self.forces, self.last, self.cosines = compliance, forces, last, cosines
        self.orders = np.arange(1, last + 1, 2) if odd else np.arange(last + 1)
        self._sines = self.orders[:0] if cosines else self.orders[self.orders > 0]
        self.size = forces.pairs * (len(self.orders) + len(self._sines))
        self.weight = 1.0
        self._shift: np.ndarray | None = None
        self._last: tuple[float, np.ndarray, np.ndarray, np.ndarray] | None = None
        self._series: tuple[np.ndarray, float, ForceSeries] | None = None

    def pack(self, z: np.ndarray) -> np.ndarray:
        """Unknowns (size,) of harmonics (pairs, K + 1) complex."""
        return np.hstack([z[:, self.orders].real, z[:, self._sines].imag]).ravel()

    def unpack(self, x: np.ndarray) -> np.ndarray:
        """Harmonics (pairs, K + 1) complex of unknowns."""
        z, parts = np.zeros((self.forces.pairs, self.last + 1), complex), x.reshape(self.forces.pairs, -1)
        z[:, self.orders] = parts[:, : len(self.orders)]
        z[:, self._sines] += 1j * parts[:, len(self.orders) :]
        return z

    def series(self, x: np.ndarray, omega: float) -> ForceSeries:
        """The forces' harmonics and derivatives at the unknowns ``x``."""
        if self._series is None or self._series[1] != omega or not np.array_equal(self._series[0], x):
            self._series = x.copy(), omega, self.forces.series(self.unpack(x), omega)
        return self._series[2]

    def weigh(self, weight: float) -> None:
        """Take ``weight`` times the compliances of all orders but the first: on the way from one harmonic to all."""
        self.weight, self._last, self._shift = weight, None, None

    def compliances(self, omega: float) -> np.ndarray:
        """G (1 + nodes, orders, pairs, pairs) at the multiples ``orders`` of ``omega``, and around each of them."""
        if self._last is None or self._last[0] != omega:
            rates = self.orders * omega
            sizes = np.maximum(rates, 1e-3 * rates[-1])
            with np.errstate(divide="ignore", invalid="ignore"):
                values = self.compliance.at(rates)
            if not np.all(np.isfinite(values)):  # on a linear mode
                values = self.compliance.at(rates * (1 + 1e-15))
            circle = RADIUS * NODES if np.isrealobj(values) else STEP * np.array([1.0, -1.0])
            around = self.compliance.at((rates + sizes * circle[:, None]).ravel())
            values = np.concatenate([values[None], around.reshape(len(circle), *values.shape)])
            values[:, self.orders != 1] *= self.weight
            self._last = omega, values, sizes * len(circle), circle
        return self._last[1]

    def shift(self, omega: float) -> None:
        """Choose the shifting stiffnesses at ``omega``; they stay until the next choice."""
        g, one = self.compliances(omega)[0], np.eye(self.forces.pairs)
        squared = np.maximum(self.orders, 1) ** 2
        mass = 1 / (self.orders[-1] ** 2 * np.abs(np.trace(g[-1])) / self.weight / len(one))  # times omega^2
        size = (mass * squared)[:, None, None]
        plus, minus = (np.linalg.svd(one + sign * size * g, compute_uv=False)[:, -1] for sign in (1, -1))
        self._shift = np.where((plus >= minus)[:, None, None], size, -size)

    def _shifted(self, omega: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """G_s, dG_s/domega (orders, pairs, pairs), s (orders, 1, 1) and A."""
        if self._shift is None:
            self.shift(omega)
        assert self._shift is not None
        values = self.compliances(omega)
        assert self._last is not None
        factor = np.linalg.inv(np.eye(self.forces.pairs) + self._shift * values)
        shifted, (scale, circle) = factor @ values, self._last[2:]
        slopes = np.einsum("n,nkij->kij", 1 / circle, shifted[1:]) / scale[:, None, None]
        if len(circle) == len(NODES):  # the other half of the circle is its conjugate
            return shifted[0].real, slopes.real, self._shift, factor[0].real
        return shifted[0], slopes, self._shift, factor[0]

    def shifted_force(self, x: np.ndarray, omega: float) -> tuple[np.ndarray, np.ndarray]:
        """F - s Z (orders, pairs, 1) complex in N and s (orders, 1, 1) in N/m."""
        shift = self._shifted(omega)[2]
        force, moved = (part.T[self.orders, :, None] for part in (self.series(x, omega).forces, self.unpack(x)))
        return force - shift * moved, shift

    def residual(self, x: np.ndarray, omega: float, linear: np.ndarray | float = 0.0) -> np.ndarray:
        """Z + G_s (F - s Z) - A Z^linear as unknowns (size,), in m; ``linear`` (pairs, K + 1) complex."""
        shifted, _, _, factor = self._shifted(omega)
        z = self.unpack(x)
        moved = z.T[self.orders, :, None]
        given = np.broadcast_to(linear, z.shape).T[self.orders, :, None]
        out = np.zeros_like(z)
        out[:, self.orders] = (moved + shifted @ self.shifted_force(x, omega)[0] - factor @ given)[..., 0].T
        return self.pack(out)

    def derivative(self, x: np.ndarray, omega: float) -> tuple[np.ndarray, np.ndarray]:
        """dR/dx (size, size) and dR/domega (size,) of the ``residual`` with no linear motion given.

        F does not depend on omega, but through a floor of the approach velocity, which is left out.
        """
        shifted, rate, shift, _ = self._shifted(omega)
        series, count, pairs, z = self.series(x, omega), len(self.orders), self.forces.pairs, self.unpack(x)
        two_sided = series.jacobian(orders=np.concatenate([self.orders, -self.orders]))[:, :count]
        two_sided[:, self.orders == 0] *= 0.5  # one-sided series have the mean once
        plus, minus = two_sided[:, :, :count], two_sided[:, :, count:]
        sines = self.orders > 0 if len(self._sines) else self.orders < 0
        columns = np.concatenate([plus + minus, 1j * (plus - minus)[:, :, sines]], axis=2)
        same = np.concatenate([np.eye(count), 1j * np.eye(count)[:, sines]], axis=1)
        matrix = np.einsum("kij,jku->ikju", shifted, columns - shift[:, 0] * same)
        matrix += np.einsum("ij,ku->ikju", np.eye(pairs), same)
        matrix = matrix.reshape(pairs, count, -1)
        jacobian = np.concatenate([matrix.real, matrix[:, sines].imag], axis=1).reshape(self.size, self.size)
        out = np.zeros_like(z)
        out[:, self.orders] = (self.orders[:, None, None] * rate @ self.shifted_force(x, omega)[0])[..., 0].T
        return jacobian, self.pack(out)

    def truncation(self, x: np.ndarray, omega: float) -> float:
        """Estimated size of the harmonics left out, over the largest sum of those kept.

        Those from K + 1 to 2K are -G F_k with G continued by its last value as k^-2; the rest is estimated from them by
        the bound k^-3 of their fall.
        """
        last, forces = self.orders[-1], np.abs(self.series(x, omega).forces)
        g = np.abs(self.compliances(omega)[0, -1]).sum(axis=1)
        beyond = np.arange(self.last + 1, forces.shape[1])
        left_out = (g[:, None] * forces[:, beyond] * (last / beyond) ** 2).sum(axis=1) * 4 / 3
        return float(left_out.max() / np.abs(self.unpack(x)).sum(axis=1).max())

    def energy(self, x: np.ndarray, omega: float) -> float:
        """Energy in J of a conservative motion."""
        shifted, rate, _, _ = self._shifted(omega)
        (force, shift), moved = self.shifted_force(x, omega), self.unpack(x).T[self.orders]
        force = force[..., 0]
        quadratic = shifted + (self.orders * omega)[:, None, None] * rate
        energies = np.einsum("ki,kij,kj->k", force.conj(), quadratic, force).real
        energies -= shift[:, 0, 0] * np.sum(np.abs(moved) ** 2, axis=1)  # what the added springs hold
        return float(np.where(self.orders == 0, 0.5, 0.25) @ energies + self.series(x, omega).potential.sum())
