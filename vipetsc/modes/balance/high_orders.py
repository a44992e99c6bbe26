r"""High orders of perturbations in Hill's method: which are kept, and how the others are eliminated.

In the notation of ``hill``, the high orders h of a perturbation follow from the lower orders l,
d_h = -(I + G_hh J_hh)^-1 G_hh J_hl d_l. Where nothing dissipates they are eliminated with G at lambda = 0: their
contribution to J falls as k^-4 with Hertz's law, and changes with lambda by the fraction lambda/(k Om). The elimination
divides D by det(I + G_hh J_hh), a constant, so that no zero moves. At lambda = 0 it is exact. Above the linear modes
and pass bands G is even in the frequency, so that the changes for the orders k and -k have opposite signs. For a motion
that is even in time they cancel to first order in lambda: D keeps its double zero at lambda = 0, which belongs to a
shift in time and to the neighbouring motion of the branch.

An order whose frequency is near a linear mode must not be eliminated, since its G changes much with lambda. The same
holds for the modes that the lattice would have if contacts stayed closed: I + G_hh J_hh is nearly singular there. Let
S = diag(max df/dz) be the largest stiffnesses that the forces of the pairs have in a period. With springs of these
stiffnesses the squared frequencies are the eigenvalues of M^-1 (K + B S B^T), where B^T u are the elongations. By
Weyl's inequality they are at most

    omega_h^2 = omega_max^2 + the largest eigenvalue of S^1/2 B^T M^-1 B S^1/2

with the highest linear frequency omega_max. Orders up to ``ABOVE`` omega_h/Om are kept, ``KEPT`` at least. A motion
whose own harmonics end below omega_h has too few orders for its perturbations, and leaves their growth undecided.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.modes.balance.harmonics import ForceSeries
from vipetsc.modes.balance.order_matrices import flat, of_pairs, plus_one, product_of
from vipetsc.modes.balance.shifted_compliance import Compliance

# Orders of perturbations, to both sides of 0, that are kept at least where nothing dissipates, and the factor of
# omega_h up to which further orders are. In 24 random systems with one stop the growth rates over Om differ by less
# than 1e-3 from those with all orders; with the factor 2 they differ by less than 1e-4.
KEPT = 48
ABOVE = 1.25
# The number of orders is a multiple of this one, so that neighbouring states of a curve have compliances in common.
KEPT_TOGETHER = 16
# At this multiple of the highest linear frequency the compliance is that of the masses alone, with an error of 1e-4.
FAR = 100.0


class KeptOrders(NamedTuple):
    """The ``orders`` that are kept, and ``jacobian`` (order pair, order pair), their J with the effect of the others.

    ``jacobian`` is None where forces dissipate: J depends on lambda there, and all orders are kept.
    """

    orders: np.ndarray
    jacobian: np.ndarray | None


def kept_orders(
    compliance: Compliance, omega: float, series: ForceSeries, orders: np.ndarray, acting: np.ndarray, highest: float
) -> KeptOrders:
    """Eliminate the high ones of ``orders``, -K..K or every other one, in a motion at ``omega`` (rad/s).

    The ``series`` has its forces, and ``highest`` is omega_h; the matrices are those of the pairs with the numbers
    ``acting``.
    """
    if series.dissipates:
        return KeptOrders(orders, None)

    pairs = len(acting)
    jacobian = flat(series.jacobian(orders=orders)[acting])
    multiples = int(np.ceil(ABOVE * highest / omega / KEPT_TOGETHER))
    high = np.abs(orders) > max(KEPT, multiples * KEPT_TOGETHER)
    if not high.any():
        return KeptOrders(orders, jacobian)

    g = of_pairs(compliance.at(orders[high] * omega), acting)
    rows = np.repeat(high, pairs)
    inner = plus_one(g, jacobian[np.ix_(rows, rows)])
    moved = np.linalg.solve(inner, product_of(g, jacobian[np.ix_(rows, ~rows)]))
    reduced = jacobian[np.ix_(~rows, ~rows)] - jacobian[np.ix_(~rows, rows)] @ moved
    return KeptOrders(orders[~high], reduced)


def highest_in_contact(compliance: Compliance, omega: float, series: ForceSeries, acting: np.ndarray) -> float:
    """omega_h in rad/s of a motion at ``omega`` (rad/s) with the forces ``series`` on the pairs ``acting``."""
    samples = 2 * series.slopes.shape[1]
    slopes = np.fft.irfft(series.slopes[acting], samples) * samples
    root = np.sqrt(np.maximum(slopes.max(axis=1), 0.0))

    # Far above all linear frequencies inertia alone counts: G = -B^T M^-1 B/omega^2.
    far = FAR * max(compliance.highest, series.order * omega)
    inverse_masses = -of_pairs(compliance.at(np.array([far])), acting)[0].real * far**2
    by_forces = np.linalg.eigvalsh(root[:, None] * inverse_masses * root)[-1]
    return float(np.sqrt(compliance.highest**2 + max(by_forces, 0.0)))
