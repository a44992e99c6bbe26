"""Legendre polynomials in what remains of a step, in which the losses by forces are expanded: their number, integrals.

Two forces at times after which the fractions a <= b of the step remain cause a loss that is smooth in a and b (sec. 10
of the derivation in the package's docstring): its rates turn by no more than 2 theta, theta = omega_max H, and its
coefficient of degree p is at most 2 p + 1 times the spherical Bessel function j_p(theta) <= theta^p/(2 p + 1)!!. Twelve
polynomials are enough at theta = 0.8, and 18 at 3.1. Powers of a and b in their place would cancel one another.
"""

from functools import lru_cache
from itertools import count

import numpy as np
from numpy.polynomial.legendre import legvander

from vipetsc.dynamics.propagator.nodes import gauss

# Coefficients below this fraction of the largest loss are left out. With 1e-9 the error of the energy balance of the
# example ``damped`` is 4e-13 of the work in place of 3e-13, with 1e-15 it is the same.
SMALLEST_MODE = 1e-13


def mode_count(theta: float) -> int:
    """Number of polynomials that a function whose rates turn by 2 ``theta`` over the step needs.

    They are those whose bound ``theta``^p/(2 p + 1)!! of the module's docstring is not below ``SMALLEST_MODE``.
    Factorials outgrow powers, so that the loop ends and AssertionError is never raised.
    """
    # Without the factor 2 p + 1: most rates of a lattice turn more slowly than the fastest. In the damped four-band
    # lattice, at theta = 0.8 and 3.1, the coefficients of further degrees are 1e-14 of the largest: that is rounding.
    bound = 1.0
    for p in count(1):
        bound *= theta / (2 * p + 1)
        if bound < SMALLEST_MODE and p > 1:
            return p
    raise AssertionError("factorials outgrow powers")


@lru_cache(maxsize=4)
def overlaps(modes: int, powers: int) -> np.ndarray:
    """Coefficients (mode p, mode q, power i, power j) of the integral of x^i (x + b - a)^j over x from 0 to a.

    The first mode is that of a, the second that of b.
    """
    # The coefficients of a, and of b, by Gauss's rule. With ``modes`` nodes the first degrees left out would be taken
    # for the last ones kept; a few nodes more keep them apart.
    nodes, weight = gauss(modes + 4)
    degrees = np.arange(modes)
    to_modes = (2 * degrees + 1)[:, None] * (legvander(2 * nodes - 1, modes - 1) * weight[:, None]).T

    # The integrand has a degree of 2 powers - 2 at most.
    fine, fine_weight = gauss(powers)
    x = nodes[:, None] * fine  # (a, fine)
    later = x[:, None] + (nodes - nodes[:, None])[:, :, None]  # (a, b, fine)
    first = x[:, :, None] ** np.arange(powers) * (nodes[:, None] * fine_weight)[:, :, None]
    second = later[..., None] ** np.arange(powers)
    integrals = first.swapaxes(1, 2)[:, None] @ second  # (a, b, power i, power j)

    out = np.tensordot(to_modes, integrals, axes=(1, 0))
    return np.tensordot(to_modes, out, axes=(1, 1)).swapaxes(0, 1)
