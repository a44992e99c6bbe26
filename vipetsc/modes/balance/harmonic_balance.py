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

If all modes are known, the derivative of G_s by frequency is A G' A. It is exact however near a pole of G_s is, as that
of a mode that hardly moves the pairs. Otherwise it is taken from values of G at complex frequencies around the real
one, by Cauchy's formula, with nodes w_n on a circle of the radius r about omega:

    dG_s/domega = (1/N) sum_n G_s(w_n)/(w_n - omega).

With N = 8 and r = 1e-4 omega rounding makes an error of 1e-12 G_s/omega, and the truncation one of the order (r/d)^8,
with the distance d of the nearest pole of G_s. The mean of G_s(w_n) is G_s(omega) with an error of that order: where it
is not, as a pole is near, r is taken smaller.

**Energy** of a conservative motion, which is constant, from its means over a period: with dG/domega = 2 omega
b^T (K - omega^2 M)^-1 M (K - omega^2 M)^-1 b,

    E = F_0 . G(0) F_0/2 + sum_{k>0} F_k* . (G + omega dG/domega) F_k/4 + mean potential of f,    omega = k Om;

it is evaluated for the shifted compliance, less the energy of the added springs.
"""

from abc import ABC, abstractmethod
from functools import cached_property, partial
from typing import NamedTuple, Protocol

import numpy as np

from vipetsc.lattice import DenseCompliance
from vipetsc.modes.balance.harmonics import ForceSeries, SiteForces
from vipetsc.modes.cache import BoundedCache
from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.problem import Attempt, FlowError, NoMotionError, unit

# Radii, over the frequency, of circles on which Cauchy's formula gives the derivative of a real compliance. A smaller
# one is taken where a pole is near a larger one.
RADII = (1e-4, 1e-5, 1e-6, 1e-7)
# If G_s differs from its mean over a circle by more than this, over its largest value, a pole is near and a smaller
# circle is taken. A pole at a distance of ten radii makes an error of this size in the derivative.
MISFIT = 1e-8
# The lower half of its eight nodes.
NODES = np.exp(-1j * np.pi / 8 * np.array([1, 3, 5, 7]))
# Relative step of a central difference, which is taken for a complex compliance: half a circle is not enough for it.
# With a pole at the relative distance d it errs by (STEP/d)^2, and rounding by about 1e-16 d/STEP: together by 1e-9 at
# most at d = 0.1, and by 4e-6 on the resonance of a mode with a loss factor of 1e-3.
STEP = 1e-6
# The order 0 has no frequency of its own to scale a circle by: this fraction of the highest order's is taken. Its
# derivative is multiplied by the order, so that any number serves.
LEAST_RATE = 1e-3
# Relative detuning of a frequency at which the compliance has a pole: a few units in the last place.
DETUNING = 1e-15
# Compliance times stiffness of the shift, a number, above which a frequency counts as close to a pole for several
# pairs: 1 + s G then has lost three digits or more.
NEAR_POLE = 1e3
# Frequencies whose values are kept: that of a motion, and the two ends of a difference along its branch.
KEPT = 3


class Compliance(Protocol):
    """Interface of ``lattice.compliance``: G (frequencies, pairs, pairs) in m/N, real or complex."""

    @property
    def highest(self) -> float:
        """The highest frequency of a linear mode or wave in rad/s."""

    def at(self, omegas: np.ndarray) -> np.ndarray:
        """Return G (frequency, pair, pair) in m/N at ``omegas`` (frequency,) in rad/s, which may be complex."""


class Shifted(NamedTuple):
    """The shifted compliance G_s = A G (orders, pairs, pairs) in m/N, and the factor A = (1 + s G)^-1."""

    compliance: np.ndarray
    factor: np.ndarray


class Expansion(NamedTuple):
    """The mean (orders, pairs, pairs) in m/N of G_s over a circle, and its derivative in the centre: ``slopes``."""

    mean: np.ndarray
    slopes: np.ndarray


class ShiftedCompliance:
    """A ``compliance`` between ``pairs`` at the multiples ``orders`` of a frequency, in rad/s, as it is and shifted.

    Stiffnesses s (orders, 1, 1) in N/m are those that ``shift`` chooses. ``weight`` multiplies the compliances of
    orders above the first. What has been computed at the latest frequencies is kept: Newton's method asks for the
    same values several times, and along a curve over the amplitude the frequency stays the same.
    """

    def __init__(self, compliance: Compliance, pairs: int, orders: np.ndarray, weight: float) -> None:
        self.compliance = compliance
        self.pairs = pairs
        self.orders = orders
        self.weight = weight
        self._values = BoundedCache[float, np.ndarray](KEPT)
        self._shifted = BoundedCache[tuple[float, bytes], Shifted](KEPT)
        self._factors = BoundedCache[tuple[int, float, bytes], np.ndarray](KEPT)
        self._rates = BoundedCache[tuple[float, bytes], np.ndarray](KEPT)

    def values(self, omega: float) -> np.ndarray:
        """Return G (orders, pairs, pairs) in m/N at the multiples of ``omega``."""
        return self._values.get(omega, partial(self._evaluate, self.orders, omega))

    def shift(self, omega: float) -> np.ndarray:
        """Return the stiffnesses s (orders, 1, 1) in N/m to shift the compliance by for motions near ``omega``."""
        g = self.values(omega)
        one = np.eye(self.pairs)
        squared = np.maximum(self.orders, 1) ** 2
        # At the highest order inertia alone counts: G = -1/(mass omega^2). This is the mass times omega^2, from the
        # mean of the pairs and without the weight.
        mass = 1 / (self.orders[-1] ** 2 * np.abs(np.trace(g[-1])) / self.weight / len(one))
        # The poles of G_s are farther away with the sign of the stiffness that keeps 1 + s G farther from singular, as
        # measured by its smallest singular value.
        size = (mass * squared)[:, None, None]
        plus, minus = (np.linalg.svd(one + sign * size * g, compute_uv=False)[:, -1] for sign in (1, -1))
        return np.where((plus >= minus)[:, None, None], size, -size)

    def at(self, omega: float, shift: np.ndarray) -> Shifted:
        """Return G_s and A at the multiples of ``omega`` in rad/s, of a ``shift`` (orders, 1, 1) in N/m."""
        key = omega, shift.tobytes()
        return self._shifted.get(key, lambda: self._shift(self.orders, omega, self.values(omega), shift))

    def factor(self, order: int, omega: float, shift: np.ndarray) -> np.ndarray:
        """Return the factor A (pairs, pairs) of one of the orders alone."""
        (place,) = np.nonzero(self.orders == order)
        orders = self.orders[place]

        def compute() -> np.ndarray:
            return self._shift(orders, omega, self._evaluate(orders, omega), shift[place]).factor[0]

        return self._factors.get((order, omega, shift.tobytes()), compute)

    def rate(self, omega: float, shift: np.ndarray) -> np.ndarray:
        """Return the derivative (orders, pairs, pairs) of G_s by its own frequency, at the multiples of ``omega``."""
        key = omega, shift.tobytes()
        return self._rates.get(key, partial(self._differentiate, omega, shift))

    def _evaluate(self, orders: np.ndarray, omega: float) -> np.ndarray:
        """Return G (orders, pairs, pairs) at some of the orders."""
        with np.errstate(divide="ignore", invalid="ignore"):
            values = self.compliance.at(orders * omega)
        # On a linear mode the compliance is infinite, and the motion finite.
        if not np.all(np.isfinite(values)):
            values = self.compliance.at(orders * omega * (1 + DETUNING))
        return self._weighted(values, orders)

    def _weighted(self, values: np.ndarray, orders: np.ndarray) -> np.ndarray:
        """Return G (..., orders, pairs, pairs) with the weight of the orders above the first."""
        if self.weight == 1.0:
            return values
        return values * np.where(orders > 1, self.weight, 1.0)[:, None, None]

    def _shift(self, orders: np.ndarray, omega: float, values: np.ndarray, shift: np.ndarray) -> Shifted:
        """Return G_s and A of the ``values`` (orders, pairs, pairs) of G at some of the orders."""
        factor = np.linalg.inv(np.eye(self.pairs) + shift * values)
        shifted = factor @ values
        if self.pairs < 2 or not isinstance(self.compliance, DenseCompliance):
            return Shifted(shifted, factor)

        near = self._near_poles(values, shift)
        stiffness = shift[near, 0, 0]
        if near.size:
            shifted[near] = self.compliance.with_springs(orders[near] * omega, stiffness)
            factor[near] = np.eye(self.pairs) - stiffness[:, None, None] * shifted[near]
        return Shifted(shifted, factor)

    def _near_poles(self, values: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return numbers (n,) of the ``values`` that are so near to a pole of G that (1 + s G)^-1 has lost digits."""
        # Near the pole of a mode the compliance of several pairs is that of the mode alone, to rounding, and the
        # inverse has lost the rest; of one pair nothing is lost.
        sizes = np.abs(shift[:, 0, 0]) * np.abs(values).max(axis=(1, 2))
        is_near = (sizes > NEAR_POLE) & (self.pairs > 1) & (self.weight == 1.0)
        return np.flatnonzero(is_near)

    def _differentiate(self, omega: float, shift: np.ndarray) -> np.ndarray:
        """Return the derivative of G_s: from all modes, by Cauchy's formula, or by a difference where G is complex."""
        if isinstance(self.compliance, DenseCompliance):
            return self._differentiate_modes(self.compliance, omega, shift)

        if np.isrealobj(self.values(omega)):
            return self._differentiate_real(omega, shift)

        circle = STEP * np.array([1.0, -1.0])
        return self._expand(self.orders, omega, shift, circle).slopes

    def _differentiate_real(self, omega: float, shift: np.ndarray) -> np.ndarray:
        """Return the derivative of a real G_s by Cauchy's formula, of each order on a circle without poles."""
        # A compliance that is real on the real axis has conjugate values above and below it: half a circle is enough.
        expansion = self._expand(self.orders, omega, shift, RADII[0] * NODES)
        mean = expansion.mean.real
        slopes = expansion.slopes.real

        # The mean of G_s over a circle is G_s in its centre, unless a pole is near. Close to a pole of G that several
        # pairs have, rounding hides the difference.
        centre = self.at(omega, shift).compliance
        is_certain = np.ones(len(self.orders), bool)
        is_certain[self._near_poles(self.values(omega), shift)] = False
        largest = np.abs(centre).max(axis=(1, 2))
        for radius in RADII[1:]:
            misfit = np.abs(mean - centre).max(axis=(1, 2))
            disturbed = np.flatnonzero(is_certain & (misfit > MISFIT * largest))
            if not disturbed.size:
                break
            expansion = self._expand(self.orders[disturbed], omega, shift[disturbed], radius * NODES)
            mean[disturbed] = expansion.mean.real
            slopes[disturbed] = expansion.slopes.real
        return np.asarray(slopes)

    def _expand(self, orders: np.ndarray, omega: float, shift: np.ndarray, circle: np.ndarray) -> Expansion:
        """Return mean of G_s over a ``circle`` around the frequency of each of ``orders``, and its derivative there.

        ``circle`` (node,) are the distances of the nodes over the frequency.
        """
        rates = orders * omega
        sizes = np.maximum(rates, LEAST_RATE * (self.orders[-1] * omega))
        near = self.compliance.at((rates + sizes * circle[:, None]).ravel())
        values = self._weighted(near.reshape(len(circle), len(rates), self.pairs, self.pairs), orders)

        shifted = np.linalg.inv(np.eye(self.pairs) + shift * values) @ values
        slopes = np.einsum("n,nkij->kij", 1 / circle, shifted) / (sizes * len(circle))[:, None, None]
        return Expansion(shifted.mean(axis=0), slopes)

    def _differentiate_modes(self, compliance: DenseCompliance, omega: float, shift: np.ndarray) -> np.ndarray:
        """Return the derivative of G_s by A G' A, with the derivative G' of the compliance from its modes."""
        rates = self.orders * omega
        with np.errstate(divide="ignore", invalid="ignore"):
            slopes = compliance.rate(rates)
        if not np.all(np.isfinite(slopes)):
            slopes = compliance.rate(rates * (1 + DETUNING))
        factor = self.at(omega, shift).factor
        out = factor @ self._weighted(slopes, self.orders) @ factor

        near = self._near_poles(self.values(omega), shift)
        if near.size:
            out[near] = compliance.rate_with_springs(rates[near], shift[near, 0, 0])
        return np.asarray(out)


# The energy's derivative by the frequency at given forces is a difference over this fraction of the frequency to each
# side. The linear system alone enters, whose shifted compliance has no pole there.
FREQUENCY_STEP = 1e-5


class RealUnknowns:
    """Harmonics up to the ``order`` K of so many ``rows``, elongations or displacements, as real unknowns x (size,).

    x holds, row by row, Re Z_k for all ``orders`` k, those from 0 to K or the ``odd`` ones alone, and then Im Z_k for
    those above 0, or none of them with ``cosines``.
    """

    def __init__(self, rows: int, order: int, odd: bool, cosines: bool) -> None:
        self.rows = rows
        self.order = order
        self.odd = odd
        self.cosines = cosines
        self.orders = np.arange(order + 1)
        if odd:
            self.orders = np.arange(1, order + 1, 2)
        # The cosines of all orders and the sines of those above 0 have these places among the orders from 0 to K.
        self._places = slice(int(self.orders[0]), None, 1 + odd)
        self._sine_places = slice(1, None, 1 + odd)
        if cosines:
            self._sine_places = slice(0, 0)
        count = len(self.orders)
        sines = len(range(*self._sine_places.indices(order + 1)))
        # The orders that have no sine: the mean, or all of them.
        self.skipped = count - sines
        self.size = rows * (count + sines)
        # dZ/dx (orders, unknowns) of one row.
        one = np.eye(count)
        self._same = np.concatenate([one, 1j * one[:, self.skipped :]], axis=1)

    def pack(self, z: np.ndarray) -> np.ndarray:
        """Return unknowns (size,) of harmonics (rows, K + 1) complex."""
        return np.hstack([z[:, self._places].real, z[:, self._sine_places].imag]).ravel()

    def unpack(self, x: np.ndarray) -> np.ndarray:
        """Return harmonics (rows, K + 1) complex of unknowns."""
        z = np.zeros((self.rows, self.order + 1), complex)
        parts = x.reshape(self.rows, -1)
        z.real[:, self._places] = parts[:, : len(self.orders)]
        z.imag[:, self._sine_places] = parts[:, len(self.orders) :]
        return z

    def resized(self, x: np.ndarray) -> np.ndarray:
        """Return unknowns (size,) from those of another ``order``, ``x`` (n,), of the same kind; 0 for new orders."""
        parts = x.reshape(self.rows, -1)
        count = parts.shape[1]
        if not self.cosines:
            count = (count + self.skipped) // 2
        cosines = len(self.orders)
        return np.hstack([_cut(parts[:, :count], cosines), _cut(parts[:, count:], cosines - self.skipped)]).ravel()

    def by_unknowns(self, series: ForceSeries) -> np.ndarray:
        """Return derivative (pair, orders, unknowns of a row) of forces by the unknowns of their own elongations."""
        # Forces by the harmonics of orders k and -k, which are conjugate to each other: by Re Z_k they change by 1 and
        # 1, by Im Z_k by i and -i. The mean would be counted for k and for -k.
        count = len(self.orders)
        halves = np.where(self.orders == 0, 0.5, 1.0)[:, None]
        columns = np.concatenate([self.orders, -self.orders])
        two_sided = series.jacobian(orders=columns, rows=self.orders) * halves
        plus = two_sided[:, :, :count]
        minus = two_sided[:, :, count:]
        return np.concatenate([plus + minus, 1j * (plus - minus)[:, :, self.skipped :]], axis=2)

    def real_rows(self, matrix: np.ndarray) -> np.ndarray:
        """Return the rows (size, ...) of the unknowns, of a complex ``matrix`` (rows, orders, ...)."""
        parts = [matrix.real, matrix[:, self.skipped :].imag]
        return np.concatenate(parts, axis=1).reshape(self.size, *matrix.shape[2:])


class HarmonicBalance(RealUnknowns):
    """The equations of motions with harmonics up to the ``order`` K, in real unknowns x (size,) in m.

    With ``odd`` only odd orders k are unknowns, which is enough for motions z(theta + pi) = -z(theta) if ``forces`` are
    odd, too. With ``cosines`` only the real parts of the harmonics are, which is enough for conservative motions at
    rest at phase 0: ``forces`` that depend on no velocity, and no load. ``weight`` multiplies the compliances of orders
    above the first: with 0 a motion has a mean and one harmonic.

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
        super().__init__(forces.pairs, order, odd, cosines)
        self.compliance = compliance
        self.forces = forces
        self.weight = weight
        if shifted is None:
            shifted = ShiftedCompliance(compliance, forces.pairs, self.orders, weight)
        self.shifted = shifted
        # Newton's method asks for the same forces several times.
        self._series = BoundedCache[tuple[bytes, float], ForceSeries](1)
        self._changes = BoundedCache[tuple[bytes, float, bytes], np.ndarray](1)

    def weighted(self, weight: float) -> "HarmonicBalance":
        """Return the equations with another ``weight``."""
        return HarmonicBalance(
            self.compliance, self.forces, order=self.order, odd=self.odd, cosines=self.cosines, weight=weight
        )

    def series(self, x: np.ndarray, omega: float) -> ForceSeries:
        """Return the forces' harmonics and derivatives at the unknowns ``x`` (n,)."""
        key = x.tobytes(), omega
        return self._series.get(key, lambda: self.forces.series(self.unpack(x), omega))

    def elongations(self, x: np.ndarray) -> np.ndarray:
        """Return harmonics (pairs, K + 1) complex in m of the elongations, which are the unknowns themselves."""
        return self.unpack(x)

    def shift(self, omega: float) -> np.ndarray:
        """Return the stiffnesses s (orders, 1, 1) in N/m to shift the compliance by for motions near ``omega``."""
        return self.shifted.shift(omega)

    def shifted_force(self, x: np.ndarray, omega: float, shift: np.ndarray) -> np.ndarray:
        """Return F - s Z (orders, pairs, 1) complex in N."""
        force = self.series(x, omega).forces[:, : self.order + 1].T[self._places, :, None]
        elongation = self.unpack(x).T[self._places, :, None]
        return force - shift * elongation

    def residual(self, x: np.ndarray, omega: float, shift: np.ndarray, linear: np.ndarray | float = 0.0) -> np.ndarray:
        """Return Z + G_s (F - s Z) - A Z^linear as unknowns (size,), in m, which vanishes at a solution.

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
        """Return -A Z^linear, what a ``linear`` motion (pairs, K + 1) adds to the ``residual``, (size,) in m.

        Only the orders that the motion has are computed, and no forces.
        """
        out = np.zeros_like(linear)
        for order in np.flatnonzero(linear.any(axis=0)).tolist():
            out[:, order] = -(self.shifted.factor(order, omega, shift) @ linear[:, order])
        return self.pack(out)

    def jacobian(self, x: np.ndarray, omega: float, shift: np.ndarray) -> np.ndarray:
        """Return dR/dx (size, size) of the ``residual``."""
        shifted = self.shifted.at(omega, shift)
        pairs = self.forces.pairs
        changes = self._force_changes(x, omega, shift)

        # Of pair i and order k by the unknown u of pair j: G_s (dF - s dZ), and dZ of the pair itself.
        matrix = shifted.compliance.swapaxes(0, 1)[:, :, :, None] * changes.swapaxes(0, 1)
        for pair in range(pairs):
            matrix[pair, :, pair] += self._same
        return self.real_rows(matrix.reshape(pairs, len(self.orders), -1))

    def _force_changes(self, x: np.ndarray, omega: float, shift: np.ndarray) -> np.ndarray:
        """Return the derivative (pair, orders, unknowns of the pair) of F - s Z by the unknowns of the same pair."""

        def compute() -> np.ndarray:
            return self.by_unknowns(self.series(x, omega)) - shift[:, 0] * self._same

        return self._changes.get((x.tobytes(), omega, shift.tobytes()), compute)

    def rate(self, x: np.ndarray, omega: float, shift: np.ndarray) -> np.ndarray:
        """Return dR/domega (size,) in m s/rad of the ``residual`` with no linear motion given: dG_s/domega (F - s Z).

        G_s of the order k is taken at k omega, which gives its derivative the factor k. F depends on omega only through
        the floor of the approach velocity and through ``Stops.drag``; both are left out.
        """
        out = np.zeros((self.forces.pairs, self.order + 1), complex)
        by_omega = self.shifted.rate(omega, shift) @ self.shifted_force(x, omega, shift)
        out[:, self._places] = (self.orders[:, None, None] * by_omega)[..., 0].T
        return self.pack(out)

    def truncation(self, x: np.ndarray, omega: float) -> float:
        """Return estimated size of the harmonics left out of the motion ``x`` (n,), over the largest sum of those kept.

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
        """Return the energy in J of a conservative motion at ``omega`` in rad/s.

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
        """Return change of the ``energy`` in J with the unknowns by ``along`` (size,) in m and omega by ``by_omega``.

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
        """Return G_s + omega dG_s/domega (orders, pairs, pairs), which gives the linear system's energy from forces."""
        compliance = self.shifted.at(omega, shift).compliance
        return compliance + (self.orders * omega)[:, None, None] * self.shifted.rate(omega, shift)

    @cached_property
    def _means(self) -> np.ndarray:
        """The mean (orders,) over a period of products of two harmonics of one order."""
        return np.where(self.orders == 0, 1.0, 0.5)


def _cut(parts: np.ndarray, count: int) -> np.ndarray:
    """Return the first ``count`` columns of ``parts`` (rows, columns), with 0 in those that it lacks."""
    out = np.zeros((len(parts), count))
    both = min(count, parts.shape[1])
    out[:, :both] = parts[:, :both]
    return out


# The number of harmonics changes where the truncation is outside these fractions of the one allowed, and then so that
# it becomes the fraction AIM: far enough from both ends that the number does not change at every point.
FEWER = 0.02
MORE = 0.5
AIM = 0.2
# The truncation falls as the inverse cube of the order K at least: the harmonics of a force with a kink fall as k^-2,
# and so does G, hence Z_k as k^-4, and the sum of those beyond K as K^-3. With a smaller power the order would grow by
# more than is needed; the truncation itself takes k^-3 for Z_k, so that its estimate is not too small.
DECAY = 3
# In one step the order grows by this factor at most (and to the next odd number), since the estimate of a motion with
# few harmonics may be far off.
MOST_GROWTH = 2.0


def order_needed(
    balance: RealUnknowns, x: np.ndarray, truncation: float, allowed: float, fewest: int, fewer: float = FEWER
) -> int:
    """Return the order, odd and at least ``fewest``, for motions near one with a ``truncation`` where ``allowed`` is.

    The unknowns ``x`` (size,) of the motion are those of ``balance``, in any unit. The order falls where the truncation
    is below the fraction ``fewer`` of the one allowed.
    """
    order = balance.order
    # Odd in any case: symmetric motions have no other.
    if truncation >= MORE * allowed:
        growth = (truncation / allowed / AIM) ** (1 / DECAY)
        return int(order * min(growth, MOST_GROWTH)) // 2 * 2 + 1
    if truncation > fewer * allowed:
        return order

    sizes = np.abs(balance.unpack(x)[:, balance.orders])
    # What would be left out from each harmonic on, that harmonic included.
    left_out = sizes[:, ::-1].cumsum(axis=1)[:, ::-1]
    count = int((left_out > AIM * allowed * sizes.sum(axis=1).max()).any(axis=0).sum())
    # The last of ``count`` harmonics has the order count - 1, or 2 count - 1 if only odd ones are kept. The odd order
    # above is taken, which keeps one harmonic more, since the next motion may need more than this one.
    beyond = count * (1 + balance.odd)
    return max(min(beyond // 2 * 2 + 1, order), fewest)


# A frequency that changes by this factor, or its inverse, within one correction has left the branch.
LARGE_FACTOR = 2.0


def check_frequency(xi: np.ndarray) -> None:
    """Raise FlowError where the last of the unknowns ``xi`` (n + 1,), a frequency near 1, has left the branch."""
    if not np.all(np.isfinite(xi)) or not 1 / LARGE_FACTOR < xi[-1] < LARGE_FACTOR:
        raise FlowError("Newton's method left the domain: the frequency changed by a large factor")


class BalanceFrame(ABC):
    """The equations of harmonic balance at and near one motion, in unknowns ``xi`` (n + 1,) of order one.

    ``tangent`` (n + 1,) is the branch's unit tangent, where the motion has one. ``newton`` solves the equations to the
    residual ``tolerance``. Equations and shift stay the same within a step.
    """

    xi: np.ndarray
    tangent: np.ndarray
    newton: DenseNewton
    tolerance: float

    @abstractmethod
    def residual(self, xi: np.ndarray) -> np.ndarray:
        """Return the residual (n,) at the unknowns ``xi`` (n + 1,), which vanishes at a solution."""

    @abstractmethod
    def jacobian(self, xi: np.ndarray) -> np.ndarray:
        """Return the derivative (n, n + 1) of the residual."""

    def correct(self, guess: np.ndarray, arclength: float) -> Attempt:
        """Solve for the motion at an ``arclength`` along the tangent, from ``guess`` (n + 1,)."""
        # The plane goes through the predictor as it is rounded, so that the row's first residual is exactly zero where
        # the predictor is the guess.
        predicted = self.xi + arclength * self.tangent
        return self.solve(guess, self.tangent, self.tangent @ predicted)

    def correct_here(self) -> None:
        """Correct the motion itself before a step is taken from it, where it has had other harmonics.

        Else the corrections of the steps would contain the change of the harmonics, however short the steps are.
        """
        attempt = self.correct(self.xi, 0.0)
        if attempt.converged:
            self.xi = attempt.xi

    def solve(self, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        """Solve for the motion with row . xi = value, (n + 1,); not converged after a NoMotionError."""
        try:
            return self.newton.solve(self, guess, row, value, self.tolerance)
        except NoMotionError as error:
            return Attempt(converged=False, reason=str(error), history=[], xi=guess, left_domain=True)

    def tangent_at(self, xi: np.ndarray) -> np.ndarray:
        """Return the unit tangent (n + 1,) at a solution ``xi`` (n + 1,), on the side of the frame's own.

        Of the null vectors of the derivative the row ``tangent`` chooses the one with tangent . direction = 1.
        """
        border = np.vstack([self.jacobian(xi), self.tangent])
        return unit(np.linalg.solve(border, np.append(np.zeros(len(xi) - 1), 1.0)))
