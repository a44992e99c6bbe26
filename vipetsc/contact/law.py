"""The compiled contact force: one law for time stepping, for the propagator and for normal modes.

The formulas stand in the package's docstring. ``vipetsc.lattice.Contact`` is the same law on arrays.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.lattice import Contact

# Modes of a site; the sign is the side.
FREE, CLOSED, CLIPPED = 0, 1, 2

SITE = np.dtype([("mode", np.int64), ("clearance", np.float64), ("approach", np.float64)])
"""A site: its mode times its side, the clearance in m, the signed approach velocity w'_minus in m/s."""


class ForceLaw(NamedTuple):
    """F = stiffness x^exponent g.

    ``stiffness`` in N/m^n; ``exponent`` n; ``damping`` c = 3 (1 - r)/2; ``clip``: whether g is kept from becoming
    negative; ``approach_floor``: smallest |w'_minus| in m/s.
    """

    stiffness: float
    exponent: float
    damping: float
    clip: bool
    approach_floor: float


class Contacts(NamedTuple):
    """Sites that share a law; ``sites`` (sites,) of dtype ``SITE``."""

    law: ForceLaw
    sites: np.ndarray


def create_contacts(contact: Contact, clearances: Sequence[float]) -> Contacts:
    """Free sites with the ``clearances`` in m."""
    clip = contact.adhesion == "clip"
    law = ForceLaw(contact.stiffness, contact.exponent, contact.damping, clip, contact.approach_floor)
    sites = np.zeros(len(clearances), SITE)
    sites["clearance"] = clearances
    sites["approach"] = 1.0
    return Contacts(law, sites)


@kernel
def elastic_force_and_slope(law: ForceLaw, x: float) -> tuple[float, float]:
    """kc x^n in N and its derivative in N/m at the indentation x in m, continued as an odd function to x < 0."""
    if law.exponent == 1.0:
        return law.stiffness * x, law.stiffness
    slope = law.stiffness * law.exponent * abs(x) ** (law.exponent - 1.0)
    return slope * x / law.exponent, slope


@kernel
def elastic_force(law: ForceLaw, x: float) -> float:
    """The force of ``elastic_force_and_slope``; Hertz's by a square root, which is five times as fast as a power."""
    if law.exponent == 1.5:
        return law.stiffness * (x * np.sqrt(abs(x)))
    return elastic_force_and_slope(law, x)[0]


@kernel
def elastic_energy(law: ForceLaw, x: float) -> float:
    """kc x^(n+1)/(n+1) in J for the indentation x in m; zero for x <= 0."""
    if x <= 0.0:
        return 0.0
    if law.exponent == 1.5:
        return law.stiffness * x * x * np.sqrt(x) / 2.5
    if law.exponent == 1.0:
        return 0.5 * law.stiffness * x * x
    return law.stiffness * x ** (law.exponent + 1.0) / (law.exponent + 1.0)


@kernel
def contact_force(contacts: Contacts, i: int, w: float, rate: float) -> tuple[float, float]:
    """Force on the host in N and dissipated power in W of site ``i`` in its present mode, at w in m and w' in m/s."""
    site = contacts.sites[i]
    if site.mode == FREE:
        return 0.0, 0.0
    side = 1.0 if site.mode > 0 else -1.0
    elastic = elastic_force(contacts.law, side * w - site.clearance)
    g = 0.0
    if abs(site.mode) != CLIPPED:
        g = 1.0 + contacts.law.damping * rate / site.approach
    return side * elastic * g, side * elastic * (g - 1.0) * rate
