"""Describing function: a motion of one pair with a mean and one harmonic, from which a branch in a gap begins.

The motion of the pair is z = b + a cos theta. Of its force, that of a contact or a smooth spring, the mean F_0(a, b)
and the first harmonic F_1(a, b) are kept, the others and the motion of all other pairs are neglected (N. M. Krylov and
N. N. Bogoliubov, Introduction to Non-Linear Mechanics, Princeton 1947). With the compliance G of the pair

    b + G(0) F_0(a, b) = 0,    a + G(Om) F_1(a, b) = 0.

The first equation gives b for every a, the second then a. It is a guess: the balance of all harmonics decides.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.problem import ContinuationError

# Amplitudes are sought up to this multiple of ``SiteForces.amplitude_scale``, which is the clearance of a contact, and
# means up to this multiple of the amplitude. The amplitude by Hertz's law grows without bound as the compliance goes to
# 0, so that there must be some bound: of 30 random negative compliances 18 have a motion below 1e2 clearances, 19 below
# 1e3, 26 below 1e4.
LARGEST = 1e3
# A mean below this fraction of the amplitude is rounding, and taken to be 0.
LEAST_MEAN = 1e-14
# The force of a contact that is pressed at rest softens as it opens and hardens beyond. Its balance may therefore have
# the same sign at the smallest and at the largest amplitude, and change it twice in between. It is evaluated at
# TRIED_OF_PRESSED amplitudes, spaced evenly in their logarithms, from this multiple of the depth to ``LARGEST``. Of 50
# random pressed contacts 21 have a motion: all are found with 21 amplitudes or more, 20 with 6 or 11.
LEAST_OF_PRESSED = 1e-2
TRIED_OF_PRESSED = 41


class PairCompliance(NamedTuple):
    """Compliance in m/N of one pair: ``static``, which the mean of a force meets, and ``dynamic``, at a frequency."""

    static: float
    dynamic: float


class DescribedMotion(NamedTuple):
    """A motion ``mean`` + ``amplitude`` cos(theta) of one pair, in m."""

    mean: float
    amplitude: float


def describing_motion(forces: SiteForces, pair: int, g: PairCompliance, omega: float) -> DescribedMotion:
    """The motion z = b + a cos(Om t) of a ``pair`` with one of the ``forces``, of which two harmonics balance.

    ``pair`` is its number, ``g`` are the compliances of the pair at 0 and at ``omega`` (rad/s). The equations are those
    of the module. Raises ContinuationError where they have no solution.
    """
    spring = pair - len(forces.contacts)
    if spring >= 0 and forces.springs[spring].cubic == 0:
        raise ContinuationError(
            f"no breather starts at {omega:g} rad/s on a spring without a cubic part: of a harmonic motion its "
            "quadratic force has a mean and a second harmonic alone; give it a cubic part, or begin at another place"
        )
    is_pressed = pair < len(forces.contacts) and forces.contacts[pair].is_pressed
    z = np.zeros((forces.pairs, 2), complex)

    def force(mean: float, amplitude: float) -> np.ndarray:
        """F_0, F_1 and F_2 in N: the motion is even in time, so that they are real."""
        z[pair] = mean, amplitude
        return forces.series(z, omega).forces[pair].real

    def mean_of(amplitude: float) -> float:
        """The mean b in m for an amplitude a in m."""

        def static_balance(mean: float) -> float:
            return mean + g.static * float(force(mean, amplitude)[0])

        without = static_balance(0.0)
        if forces.odd or abs(without) <= LEAST_MEAN * amplitude:
            return 0.0
        # A force that grows with the elongation opposes the mean: b lies between 0 and -G(0) F_0(a, 0), the mean that
        # the force at b = 0 would cause. The force of a contact that is pressed at rest softens: its mean may be
        # larger.
        furthest = -without
        while is_pressed and static_balance(furthest) * without > 0 and abs(furthest) < LARGEST * amplitude:
            furthest *= 2
        if static_balance(furthest) * without >= 0:
            # No mean within the bound balances the force. 0 is then a guess: the balance of all harmonics decides.
            return 0.0
        return float(brentq(static_balance, furthest, 0.0))

    def balance(amplitude: float) -> float:
        """a + G(Om) F_1 in m."""
        return amplitude + g.dynamic * float(force(mean_of(amplitude), amplitude)[1])

    size = forces.amplitude_scale(pair, g.dynamic)
    sizes = [size, LARGEST * size]
    if is_pressed:
        sizes = (size * np.geomspace(LEAST_OF_PRESSED, LARGEST, TRIED_OF_PRESSED)).tolist()
    for low, high in itertools.pairwise(sizes):
        if balance(low) * balance(high) < 0:
            amplitude = float(brentq(balance, low, high, rtol=1e-12))
            return DescribedMotion(mean=mean_of(amplitude), amplitude=amplitude)

    needs = "a force that hardens needs a negative one of moderate size"
    if is_pressed:
        needs = "the force of a contact that is pressed at rest balances it at no amplitude"
    raise ContinuationError(
        f"no breather starts at {omega:g} rad/s: the compliance of its site is {g.dynamic:.4g} m/N there, and "
        f"{needs}; change nnm.start_frequency"
    )
