"""The compiled contact force: one law for time stepping, for the propagator and for normal modes.

The docstring of the package derives the formulas. ``vipetsc.lattice.Contact`` is the same law on arrays: force, slope
and energy of a shipped elastic law are defined there and here, and nowhere else. A law that a user's module registers
is called by the addresses of its compiled functions, which its record holds in this process.
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

# Smallest approach speed in m/s for an impact's duration: the energy of a slower impact underflows.
SLOWEST = 1e-100
# Modes of a site; the sign is the side. Those from PERMANENT on have the force of max(x, 0), without loss.
FREE, CLOSED, CLIPPED, PERMANENT, RESTING = 0, 1, 2, 3, 4

PARAMETERS = ("first", "second", "third", "fourth")  # of a registered law
ELASTIC = np.dtype(
    [(name, np.float64) for name in ("stiffness", "exponent", "duration_factor", "speed_exponent")]
    + [(name, np.int64) for name in ("force", "slope", "energy")]
    + [(name, np.float64) for name in PARAMETERS]
)
"""Parameters of an elastic law: kc in N/m^n, the power n with which the force begins, ``Contact.duration_factor``.

``force``, ``slope`` and ``energy`` are the addresses of a registered law's functions in this process, 0 of a shipped
one, and what follows are its parameters.

``speed_exponent`` is that of the speed in an impact's energy, 2: from a record, no compiler makes a product of the
power. Its last bit differs from the library's now and then, and with it the steps of a chaotic run.
"""

SITE = np.dtype(
    [
        ("mode", np.int64),
        ("clearance", np.float64),
        ("clearance_minus", np.float64),
        ("scale", np.float64),
        ("approach", np.float64),
        ("elastic", ELASTIC),
        ("damping", np.float64),
        ("floor", np.float64),
        ("clip", bool),
        ("reduced_mass", np.float64),
        ("preload", np.float64),
    ],
    align=True,
)
"""A site: its mode times its side, the clearances in m on the sides + and - (inf: no stop there), the length in m that
landings are measured by, the signed approach velocity w'_minus in m/s; its elastic law, the damping c of the factor g,
the smallest |w'_minus| in m/s, whether g is kept from becoming negative; the reduced mass of its two masses in kg.
``preload`` in N is its force at w = 0, which a static load balances.
"""


def elastic_records(laws: Sequence[Contact]) -> np.ndarray:
    """Parameters (law,) of dtype ``ELASTIC`` of the elastic laws of ``laws``."""
    # Sites have few different laws, and a factor costs gamma functions: it is computed once for each law.
    rows = {law: _elastic_row(law) for law in dict.fromkeys(laws)}
    return np.array([rows[law] for law in laws], ELASTIC)


def _elastic_row(law: Contact) -> tuple[float, ...]:
    """The values of a record of dtype ``ELASTIC``."""
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
    # Landings are as exact as the smaller stop needs; one without clearance has no size of its own.
    sizes = np.where((gaps != 0) & np.isfinite(gaps), np.abs(gaps), np.inf).min(axis=1)
    sites["scale"] = np.where(np.isfinite(sizes), sizes, scale)
    sites["approach"] = 1.0
    sites["elastic"] = elastic_records(per_site)
    sites["damping"] = [dampings[law] for law in per_site]
    sites["floor"] = [law.approach_floor for law in per_site]
    sites["clip"] = [law.adhesion == "clip" for law in per_site]
    sites["reduced_mass"] = reduced_mass
    return sites


def hold(sites: np.ndarray, laws: Sequence[Contact], which: np.ndarray, speed: float) -> None:
    """Make the sites ``which`` permanent, without changes of mode: no loss, and touching at w = 0 or pressed there.

    ``laws`` (site,) are those of all ``sites``; ``speed`` in m/s is that of relative motion, for what is small
    compared with it.
    """
    # A contact that is pressed at rest has one stop: that of the smaller clearance, which is negative.
    side = np.where(sites["clearance"] < sites["clearance_minus"], 1, -1)
    pressed = np.maximum(-np.minimum(sites["clearance"], sites["clearance_minus"]), 0.0)
    sites["mode"][which] = (side * PERMANENT)[which]
    sites["approach"][which] = side[which] * speed
    load = np.zeros(len(sites))
    sites_of_law: dict[Contact, list[int]] = {}
    for i, law in enumerate(laws):
        sites_of_law.setdefault(law, []).append(i)
    for law, numbers in sites_of_law.items():
        load[numbers] = law.elastic_force(pressed[numbers])
    sites["preload"][which] = (side * load)[which]


@kernel
def side_of(mode: int) -> int:
    """The side, 1 or -1, at which a site of a ``mode`` other than ``FREE`` touches."""
    return 1 if mode > 0 else -1


@kernel
def gap_of(site: Any, side: int) -> float:
    """Clearance in m of a ``SITE`` on one side, 1 or -1."""
    return site.clearance if side > 0 else site.clearance_minus


@kernel
def resting_side(site: Any) -> int:
    """The side on which a ``SITE`` may rest in contact, that of a stop without clearance; 0 if it cannot rest.

    The damping of a contact that is pressed from rest has no limit without a floor of the approach velocity.
    """
    if site.damping != 0.0 and site.floor == 0.0:
        return 0
    if site.clearance == 0.0:
        return 1
    if site.clearance_minus == 0.0:
        return -1
    return 0


@kernel
def _registered(function: int, law: Any, x: float) -> float:
    """The value of a registered law's ``function``, an address, at the indentation x in m."""
    # The type of an intrinsic does not show its first argument.
    return call_address(function, x, law.stiffness, law.first, law.second, law.third, law.fourth)  # type: ignore[call-arg]


@kernel
def elastic_force_and_slope(law: Any, x: float) -> tuple[float, float]:
    """f in N and df/dx in N/m at the indentation x in m, continued as an odd function to x < 0.

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
    """The force of ``elastic_force_and_slope``; Hertz's by a square root, which is five times as fast as a power."""
    if law.force != 0:
        return np.copysign(_registered(law.force, law, abs(x)), x)
    if law.exponent == 1.5:
        return law.stiffness * (x * np.sqrt(abs(x)))
    return elastic_force_and_slope(law, x)[0]


@kernel
def elastic_energy(law: Any, x: float) -> float:
    """The integral of f in J from 0 to the indentation x in m; zero for x <= 0."""
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
    """Whether the force begins in proportion to the indentation; else its derivatives are unbounded at the onset."""
    return law.exponent == 1.0


@kernel
def impact_time(site: Any, speed: float) -> float:
    """Contact time in s of an isolated conservative impact on a ``SITE`` at ``speed`` in m/s: see ``Contact``."""
    law = site.elastic
    speed = max(speed, SLOWEST)
    if law.duration_factor > 0.0:
        inertia = (law.exponent + 1.0) / 2.0 * site.reduced_mass
        depth = (inertia * speed**law.speed_exponent / law.stiffness) ** (1.0 / (law.exponent + 1.0))
        return law.duration_factor * depth / speed

    # Newton's method from beyond the turning point comes down on it: the energy of a hardening force is convex.
    energy = 0.5 * site.reduced_mass * speed * speed
    depth = SHALLOWEST
    while elastic_energy(law, depth) < energy:
        depth *= 2.0
    step = depth
    while step > 1e-14 * depth:
        step = (elastic_energy(law, depth) - energy) / elastic_force(law, depth)
        depth -= step

    # With x = depth sin(phase) the integrand stays finite where the speed falls to zero.
    width = 0.5 * np.pi / PHASES
    total = 0.0
    for k in range(PHASES):
        phase = (k + 0.5) * width
        kinetic = energy - elastic_energy(law, depth * np.sin(phase))
        total += depth * np.cos(phase) * np.sqrt(0.5 * site.reduced_mass / kinetic)
    return 2.0 * total * width


@kernel
def contact_force(contacts: np.ndarray, i: int, w: float, rate: float) -> tuple[float, float]:
    """Force on the host in N and power in W that leaves the ledger, of site ``i`` in its mode at w in m, w' in m/s.

    The power is what the contact dissipates; of a clipped one it is 0: see ``clipped_energy``. ``contacts`` (site,) are
    of dtype ``SITE``; ``rate`` is w'.
    """
    site = contacts[i]
    if site.mode == FREE:
        return 0.0, 0.0

    side = side_of(site.mode)
    x = side * w - gap_of(site, side)
    if abs(site.mode) >= PERMANENT:
        # No change of mode at x = 0 is looked for: the force itself has the kink where the masses part.
        return side * elastic_force(site.elastic, max(x, 0.0)), 0.0

    if abs(site.mode) == CLIPPED:
        # The loss is that of the elastic energy, a function of w: ``clipped_energy``.
        return 0.0, 0.0
    elastic = elastic_force(site.elastic, x)
    g = 1.0 + site.damping * rate / site.approach
    return side * elastic * g, side * elastic * (g - 1.0) * rate


@kernel
def clipped_energy(site: Any, w: float) -> float:
    """Elastic energy in J that a ``CLIPPED`` ``SITE`` still has at w in m, and loses up to its separation; else 0."""
    if abs(site.mode) != CLIPPED:
        return 0.0
    side = side_of(site.mode)
    return elastic_energy(site.elastic, side * w - gap_of(site, side))
