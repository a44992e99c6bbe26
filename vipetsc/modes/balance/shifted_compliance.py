"""The compliance at the multiples of a frequency, shifted by springs that keep its poles away.

With a spring of the stiffness s added at each pair the compliance G becomes G_s = A G, A = (1 + s G)^-1
(``harmonic_balance``). If all modes are known, its derivative by frequency is A G' A. It is exact however near a pole
of G_s is, as that of a mode that hardly moves the pairs. Otherwise it is taken from values of G at complex frequencies
around the real one, by Cauchy's formula, with nodes w_n on a circle of the radius r about omega:

    dG_s/domega = (1/N) sum_n G_s(w_n)/(w_n - omega).

With N = 8 and r = 1e-4 omega rounding makes an error of 1e-12 G_s/omega, and the truncation one of the order
(r/d)^8, with the distance d of the nearest pole of G_s. The mean of G_s(w_n) is G_s(omega) with an error of that order:
where it is not, as a pole is near, r is taken smaller.
"""

from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from vipetsc.lattice import DenseCompliance
from vipetsc.modes.latest import LatestValues

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
        """G (frequency, pair, pair) in m/N at ``omegas`` (frequency,) in rad/s, which may be complex."""


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
        self._values = LatestValues[float, np.ndarray](KEPT)
        self._shifted = LatestValues[tuple[float, bytes], Shifted](KEPT)
        self._factors = LatestValues[tuple[int, float, bytes], np.ndarray](KEPT)
        self._rates = LatestValues[tuple[float, bytes], np.ndarray](KEPT)

    def values(self, omega: float) -> np.ndarray:
        """G (orders, pairs, pairs) in m/N at the multiples of ``omega``."""
        return self._values.get(omega, partial(self._evaluate, self.orders, omega))

    def shift(self, omega: float) -> np.ndarray:
        """The stiffnesses s (orders, 1, 1) in N/m to shift the compliance by for motions near ``omega``."""
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
        """G_s and A at the multiples of ``omega`` in rad/s, of a ``shift`` (orders, 1, 1) in N/m."""
        key = omega, shift.tobytes()
        return self._shifted.get(key, lambda: self._shift(self.orders, omega, self.values(omega), shift))

    def factor(self, order: int, omega: float, shift: np.ndarray) -> np.ndarray:
        """The factor A (pairs, pairs) of one of the orders alone."""
        (place,) = np.nonzero(self.orders == order)
        orders = self.orders[place]

        def compute() -> np.ndarray:
            return self._shift(orders, omega, self._evaluate(orders, omega), shift[place]).factor[0]

        return self._factors.get((order, omega, shift.tobytes()), compute)

    def rate(self, omega: float, shift: np.ndarray) -> np.ndarray:
        """Derivative (orders, pairs, pairs) of G_s by its own frequency, at the multiples of ``omega``."""
        key = omega, shift.tobytes()
        return self._rates.get(key, partial(self._differentiate, omega, shift))

    def _evaluate(self, orders: np.ndarray, omega: float) -> np.ndarray:
        """G (orders, pairs, pairs) at some of the orders."""
        with np.errstate(divide="ignore", invalid="ignore"):
            values = self.compliance.at(orders * omega)
        # On a linear mode the compliance is infinite, and the motion finite.
        if not np.all(np.isfinite(values)):
            values = self.compliance.at(orders * omega * (1 + DETUNING))
        return self._weighted(values, orders)

    def _weighted(self, values: np.ndarray, orders: np.ndarray) -> np.ndarray:
        """G (..., orders, pairs, pairs) with the weight of the orders above the first."""
        if self.weight == 1.0:
            return values
        return values * np.where(orders > 1, self.weight, 1.0)[:, None, None]

    def _shift(self, orders: np.ndarray, omega: float, values: np.ndarray, shift: np.ndarray) -> Shifted:
        """G_s and A of the ``values`` (orders, pairs, pairs) of G at some of the orders."""
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
        """The numbers (n,) of the ``values`` that are so near to a pole of G that (1 + s G)^-1 has lost digits."""
        # Near the pole of a mode the compliance of several pairs is that of the mode alone, to rounding, and the
        # inverse has lost the rest; of one pair nothing is lost.
        sizes = np.abs(shift[:, 0, 0]) * np.abs(values).max(axis=(1, 2))
        is_near = (sizes > NEAR_POLE) & (self.pairs > 1) & (self.weight == 1.0)
        return np.flatnonzero(is_near)

    def _differentiate(self, omega: float, shift: np.ndarray) -> np.ndarray:
        """The derivative of G_s: from all modes, by Cauchy's formula, or by a central difference where G is complex."""
        if isinstance(self.compliance, DenseCompliance):
            return self._differentiate_modes(self.compliance, omega, shift)

        if np.isrealobj(self.values(omega)):
            return self._differentiate_real(omega, shift)

        circle = STEP * np.array([1.0, -1.0])
        return self._expand(self.orders, omega, shift, circle).slopes

    def _differentiate_real(self, omega: float, shift: np.ndarray) -> np.ndarray:
        """The derivative of a real G_s by Cauchy's formula, of each order on a circle without poles."""
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
        """The mean of G_s over a ``circle`` around the frequency of each of some ``orders``, and its derivative there.

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
        """The derivative of G_s by A G' A, with the derivative G' of the compliance from its modes."""
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
