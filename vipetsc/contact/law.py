"""The compiled contact force: one law for time stepping, for the propagator and for normal modes.

The docstring of the package derives the formulas. ``vipetsc.lattice.Contact`` is the same law on arrays: force, slope
and energy of a shipped elastic law are defined there and here, and nowhere else. A law that a user's module registers
is called by the addresses of its compiled functions, which are part of the site's record and valid in this process
alone.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.compiled import kernel
from vipetsc.lattice import Contact
from vipetsc.lattice.contact import PHASES, SHALLOWEST, registered_law
from vipetsc.lattice.registered_law import call_address, compiled_law
from vipetsc.register import MOST_PARAMETERS

# Smallest approach speed in m/s for an impact's duration. Squares below 1e-154 m/s underflow: this is far from it, so
# that masses and stiffnesses of any size may multiply the square.
SLOWEST = 1e-100
# The tolerance of a landing on a clearance is this fraction of the site's scale: more than the rounding of w, also
# where displacements are 1e5 times as large.
LANDED = 1e-10
# Where there is a clearance it need not be more than so many roundings of w, relative to the clearance or to the scale
# of displacements: contacts that are less deep than the tolerance have no onset and no separation of their own. A stop
# without clearance keeps the larger tolerance, below which the front of a wave passes through w = 0 again and again.
ROUNDINGS = 1000 * float(np.finfo(float).eps)
# Nor may it be less than so many roundings of the scale of displacements, however small the clearance: w is the
# difference of two of them, and no step would land on less.
LEAST_ROUNDINGS = 10 * float(np.finfo(float).eps)
# Modes of a site, see the package's docstring. A site in contact has its mode times the side, 1 or -1. The modes
# UNSWITCHED and RESTING have the force of max(x, 0), without loss; a rigid site is free or STUCK.
FREE = 0
CLOSED = 1
UNSWITCHED = 2
RESTING = 3
STUCK = 4
# A rigid site sticks where its next flight would take less than this fraction of the shortest period of the motion.
SHORTEST_FLIGHT = 1e-6

PARAMETERS = ("first", "second", "third", "fourth")  # of a registered law
ELASTIC = np.dtype(
    [(name, np.float64) for name in ("stiffness", "exponent", "duration_factor", "speed_exponent")]
    + [(name, np.int64) for name in ("force", "slope", "energy")]
    + [(name, np.float64) for name in PARAMETERS]
)
"""Parameters of an elastic law: kc in N/m^n, the power n with which the force begins, ``Contact.duration_factor``.

``force``, ``slope`` and ``energy`` are the addresses of a registered law's functions in this process, 0 for a shipped
law; ``first`` to ``fourth`` are the parameters of a registered law.

``speed_exponent`` is always 2, the exponent of the speed in an impact's energy. It is stored because a compiler
replaces a power with the constant exponent 2 by a product, or does not, as its version pleases. The product and the
library's power differ in their last bit now and then, and with it differ the steps of a chaotic run.
"""

SITE = np.dtype(
    [
        ("mode", np.int64),
        ("clearance", np.float64),
        ("clearance_minus", np.float64),
        ("scale", np.float64),
        ("tolerance", np.float64),
        ("approach", np.float64),
        ("elastic", ELASTIC),
        ("damping", np.float64),
        ("floor", np.float64),
        ("clip", bool),
        ("reduced_mass", np.float64),
        ("preload", np.float64),
        ("rigid", bool),
        ("shares", bool),
        ("restitution", np.float64),
        ("flight", np.float64),
        ("host", np.int64),
        ("resonator", np.int64),
        ("host_inverse", np.float64),
        ("resonator_inverse", np.float64),
        ("reaction", np.float64),
    ],
    align=True,
)
"""A site: its mode times its side, the clearances in m on the sides + and - (inf: no stop there), the ``scale`` of w in
m, the ``tolerance`` in m of a landing on a clearance, the signed ``approach`` velocity w'_minus in m/s; its elastic
law, the damping c of the factor g, the ``floor`` of |w'_minus| in m/s, whether g is kept from becoming negative; the
reduced mass of its two masses in kg. ``preload`` in N is the force of an unswitched contact at w = 0: a static load
balances it.

A ``rigid`` site has its ``restitution`` r, the shortest ``flight`` in s after which it still is free, its ``host`` and
``resonator`` as masses counted through all cells (-1: the ground), their inverse masses in 1/kg (0 of the ground), and
whether it ``shares`` one of them with another rigid site; the ``approach`` stands for the speed of the motion there.
``reaction`` in N is the force on its host while it is stuck, which the engine keeps up to date.
"""


def elastic_records(laws: Sequence[Contact]) -> np.ndarray:
    """Return parameters (law,) of dtype ``ELASTIC`` of the elastic laws of ``laws``."""
    # Sites have few different laws, and a factor costs gamma functions: it is computed once for each law.
    rows = {law: _elastic_row(law) for law in dict.fromkeys(laws)}
    return np.array([rows[law] for law in laws], ELASTIC)


def _elastic_row(law: Contact) -> tuple[float, ...]:
    """Return the values of a record of dtype ``ELASTIC``."""
    shipped = law.stiffness, law.onset_exponent, law.duration_factor, 2.0
    registered = registered_law(law.law)
    if registered is None:
        return *shipped, 0, 0, 0, *[0.0] * MOST_PARAMETERS
    padding = [0.0] * (MOST_PARAMETERS - len(law.parameters))
    return *shipped, *compiled_law(registered), *law.parameters, *padding


def create_contacts(
    laws: Contact | Sequence[Contact], clearances: ArrayLike, reduced_mass: ArrayLike = 1.0, scale: float = 1.0
) -> np.ndarray:
    """Free sites (site,) of dtype ``SITE``: their laws or that of all, ``clearances`` (site,) or (site, 2) in m.

    ``reduced_mass`` in kg is m_host m_resonator / (m_host + m_resonator), of all or (site,); ``scale`` in m stands for
    the clearance of a site that has none.
    """
    gaps = np.array(clearances, float)
    if gaps.ndim == 1:
        gaps = np.column_stack([gaps, gaps])
    if isinstance(laws, Contact):
        per_site = [laws] * len(gaps)
    else:
        per_site = list(laws)
    # Sites have few different laws, and the damping of some is the root of an equation.
    dampings = {law: law.damping for law in dict.fromkeys(per_site)}

    sites = np.zeros(len(gaps), SITE)
    sites["clearance"], sites["clearance_minus"] = gaps.T
    # The smaller clearance asks for the more exact landing. A stop without clearance has no length of its own.
    sizes = np.where((gaps != 0) & np.isfinite(gaps), np.abs(gaps), np.inf).min(axis=1)
    sites["scale"] = np.where(np.isfinite(sizes), sizes, scale)
    sites["tolerance"] = LANDED * sites["scale"]
    apart = gaps.min(axis=1) > 0
    rounded = ROUNDINGS * np.maximum(sites["scale"], scale)
    least = LEAST_ROUNDINGS * scale
    sites["tolerance"][apart] = np.clip(sites["tolerance"], least, rounded)[apart]
    sites["approach"] = 1.0
    sites["elastic"] = elastic_records(per_site)
    sites["damping"] = [dampings[law] for law in per_site]
    sites["floor"] = [law.approach_floor for law in per_site]
    sites["clip"] = [law.adhesion == "clip" for law in per_site]
    sites["rigid"] = [law.is_rigid for law in per_site]
    sites["restitution"] = [law.restitution for law in per_site]
    sites["reduced_mass"] = reduced_mass
    return sites


def hold(sites: np.ndarray, laws: Sequence[Contact], which: np.ndarray, speed: float) -> None:
    """Make the sites that the mask ``which`` (site,) marks unswitched (see the package's docstring).

    They touch or are pressed at w = 0. ``laws`` (site,) are those of all ``sites``. ``speed`` in m/s, that of the
    relative motion to be expected, takes the place of w'_minus: errors of steps in contact are relative to it.
    """
    # A contact that is pressed at rest has one stop, that of the smaller clearance. The clearance is negative: minus
    # it is the indentation at rest.
    side = np.where(sites["clearance"] < sites["clearance_minus"], 1, -1)
    pressed = np.maximum(-np.minimum(sites["clearance"], sites["clearance_minus"]), 0.0)
    sites["mode"][which] = (side * UNSWITCHED)[which]
    sites["approach"][which] = side[which] * speed

    # Law by law, since the force of a law is computed for arrays.
    load = np.zeros(len(sites))
    sites_of_law: dict[Contact, list[int]] = {}
    for i, law in enumerate(laws):
        sites_of_law.setdefault(law, []).append(i)
    for law, numbers in sites_of_law.items():
        load[numbers] = law.elastic_force(pressed[numbers])
    sites["preload"][which] = (side * load)[which]


@kernel
def side_of(mode: int) -> int:
    """Return the side, 1 or -1, at which a site of a ``mode`` other than ``FREE`` touches."""
    return 1 if mode > 0 else -1


@kernel
def gap_of(site: Any, side: int) -> float:
    """Return the clearance in m of a ``SITE`` on one side, 1 or -1."""
    return site.clearance if side > 0 else site.clearance_minus


@kernel
def landed_side(site: Any, w: float) -> int:
    """Return side, 1 or -1, of a ``SITE`` on whose clearance ``w`` in m has landed, to the tolerance; 0 for none."""
    for side in (1, -1):
        if abs(side * w - gap_of(site, side)) <= site.tolerance:
            return side
    return 0


@kernel
def _registered(function: int, law: Any, x: float) -> float:
    """Return the value of a registered law's ``function``, an address, at the indentation x in m."""
    return call_address(function, x, law.stiffness, law.first, law.second, law.third, law.fourth)


@kernel
def elastic_force_and_slope(law: Any, x: float) -> tuple[float, float]:
    """Return f in N and df/dx in N/m at the indentation x in m, continued as an odd function to x < 0.

    ``law`` is a record of dtype ``ELASTIC``.
    """
    if law.force != 0:
        depth = abs(x)
        return np.copysign(_registered(law.force, law, depth), x), _registered(law.slope, law, depth)
    if law.exponent == 1.0:
        return law.stiffness * x, law.stiffness
    slope = law.stiffness * law.exponent * abs(x) ** (law.exponent - 1.0)
    return slope * x / law.exponent, slope


@kernel
def elastic_force(law: Any, x: float) -> float:
    """Return force of ``elastic_force_and_slope``; Hertz's by a square root, which is five times as fast as a power."""
    if law.force != 0:
        return np.copysign(_registered(law.force, law, abs(x)), x)
    if law.exponent == 1.5:
        return law.stiffness * (x * np.sqrt(abs(x)))
    return elastic_force_and_slope(law, x)[0]


@kernel
def elastic_energy(law: Any, x: float) -> float:
    """Return the integral of f in J from 0 to the indentation x in m; zero for x <= 0."""
    if x <= 0.0:
        return 0.0
    if law.force != 0:
        return _registered(law.energy, law, x)
    if law.exponent == 1.5:
        return law.stiffness * x * x * np.sqrt(x) / 2.5
    if law.exponent == 1.0:
        return 0.5 * law.stiffness * x * x
    return law.stiffness * x ** (law.exponent + 1.0) / (law.exponent + 1.0)


@kernel
def begins_linearly(law: Any) -> bool:
    """Return whether the force begins in proportion to the indentation; else derivatives are unbounded there."""
    return law.exponent == 1.0


@kernel
def impact_time(site: Any, speed: float) -> float:
    """Return the contact time in s of a conservative impact of two masses alone on a ``SITE``, at ``speed`` in m/s.

    ``Contact.impact_time`` is the same on arrays; m is the reduced mass. Where the force is a power of the indentation,
    the deepest one is x_m = ((n + 1) m speed^2/(2 kc))^(1/(n + 1)), and the time a factor times x_m/speed (Johnson
    1985, sec. 11.4). For a registered law both are found numerically.
    """
    law = site.elastic
    speed = max(speed, SLOWEST)
    if law.duration_factor > 0.0:
        inertia = (law.exponent + 1.0) / 2.0 * site.reduced_mass
        depth = (inertia * speed**law.speed_exponent / law.stiffness) ** (1.0 / (law.exponent + 1.0))
        return law.duration_factor * depth / speed

    # The deepest indentation stores the whole energy. The stored energy is convex, since forces grow with the
    # indentation: Newton's method from beyond the root comes down to it without a bracket.
    energy = 0.5 * site.reduced_mass * speed * speed
    depth = SHALLOWEST
    while elastic_energy(law, depth) < energy:
        depth *= 2.0
    step = depth
    while step > 1e-14 * depth:
        step = (elastic_energy(law, depth) - energy) / elastic_force(law, depth)
        depth -= step

    # The time is twice the integral of dx/x' from 0 to the depth. With x = depth sin(phase) the integrand stays finite
    # where x' falls to zero, and the midpoint rule does.
    width = 0.5 * np.pi / PHASES
    total = 0.0
    for k in range(PHASES):
        phase = (k + 0.5) * width
        kinetic = energy - elastic_energy(law, depth * np.sin(phase))
        total += depth * np.cos(phase) * np.sqrt(0.5 * site.reduced_mass / kinetic)
    return 2.0 * total * width


@kernel
def contact_force(contacts: np.ndarray, i: int, w: float, rate: float) -> tuple[float, float]:
    """Return force on the host in N and dissipated power in W of site ``i``, at ``w`` in m and ``rate`` w' in m/s.

    ``contacts`` (site,) are of dtype ``SITE``.
    """
    site = contacts[i]
    if site.mode == FREE:
        return 0.0, 0.0

    side = side_of(site.mode)
    x = side * w - gap_of(site, side)
    if abs(site.mode) >= UNSWITCHED:
        if abs(site.mode) == STUCK:
            return site.reaction, 0.0
        # The mode stays while the masses part and meet: the force itself has the kink at x = 0.
        return side * elastic_force(site.elastic, max(x, 0.0)), 0.0

    elastic = elastic_force(site.elastic, x)
    g = 1.0 + site.damping * rate / site.approach
    if site.clip:
        g = max(g, 0.0)
    return side * elastic * g, side * elastic * (g - 1.0) * rate
