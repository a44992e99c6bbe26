"""The compiled contact force: one law for time stepping, for the propagator and for normal modes.

The formulas stand in the package's docstring. ``vipetsc.lattice.Contact`` is the same law on arrays.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gamma

from vipetsc.compiled import kernel
from vipetsc.lattice import Contact

# Modes of a site; the sign is the side.
FREE, CLOSED, CLIPPED, LASTING = 0, 1, 2, 3

_LAW = ("stiffness", "exponent", "damping", "floor")
_TIMES = ("inertia", "power", "root", "factor")
SITE = np.dtype(
    [
        ("mode", np.int64),
        *((name, np.float64) for name in ("clearance", "clearance_minus", "scale", "approach", *_LAW)),
        ("clip", bool),
        *((name, np.float64) for name in (*_TIMES, "preload")),
    ],
    align=True,
)
"""A site: its mode times its side, the clearances in m on the sides + and - (inf: no stop there), the length in m that
landings are measured by, the signed approach velocity w'_minus in m/s.

Its law F = ``stiffness`` x^``exponent`` g, in N/m^n; ``damping`` c; ``floor``: smallest |w'_minus| in m/s; ``clip``:
whether g is kept from becoming negative. An isolated impact at speed v without loss takes ``factor`` depth/v, its depth
is (``inertia`` v^``power``/``stiffness``)^``root``; ``power`` is 2 (Johnson 1985, sec. 11.4). ``preload`` in N is its
force at w = 0, which a static load balances.
"""


def create_contacts(
    laws: Contact | Sequence[Contact], clearances: ArrayLike, reduced_mass: ArrayLike = 1.0, scale: float = 1.0
) -> np.ndarray:
    """Free sites (site,) of dtype ``SITE``: their laws or that of all, ``clearances`` (site,) or (site, 2) in m.

    ``reduced_mass`` in kg is m_host m_resonator / (m_host + m_resonator), of all or (site,); ``scale`` in m stands for
    the clearance of a site that has none.
    """
    gaps = np.array(clearances, float)
    gaps = gaps.reshape(-1, 2) if gaps.ndim == 2 else np.column_stack([gaps, gaps])
    of_sites = [laws] * len(gaps) if isinstance(laws, Contact) else list(laws)
    sites = np.zeros(len(gaps), SITE)
    sites["clearance"], sites["clearance_minus"] = gaps.T
    sizes = np.where((gaps != 0) & np.isfinite(gaps), np.abs(gaps), np.inf).min(axis=1)
    sites["scale"] = np.where(np.isfinite(sizes), sizes, scale)
    sites["approach"], sites["power"] = 1.0, 2.0
    rows = {law: (law.stiffness, law.exponent, law.damping, law.approach_floor) for law in dict.fromkeys(of_sites)}
    for name, values in zip(_LAW, zip(*map(rows.__getitem__, of_sites), strict=True), strict=False):
        sites[name] = values
    sites["clip"] = [law.adhesion == "clip" for law in of_sites]
    n = sites["exponent"]
    # Integral of dx / sqrt(1 - x^(n+1)) over [0, 1]: pi/2 for n = 1, 1.4716 for n = 3/2.
    integral = np.sqrt(np.pi) * gamma(1 / (n + 1)) / ((n + 1) * gamma(0.5 + 1 / (n + 1)))
    sites["inertia"], sites["root"], sites["factor"] = (n + 1) / 2 * np.asarray(reduced_mass), 1 / (n + 1), 2 * integral
    return sites


def hold(sites: np.ndarray, which: np.ndarray, speed: float) -> None:
    """Let the sites ``which`` act without changes of mode: no loss, and touching at w = 0 or pressed there.

    ``speed`` in m/s is that of relative motion, for what is small beside it.
    """
    side = np.where(sites["clearance"] < sites["clearance_minus"], 1, -1)
    pressed = np.maximum(-np.minimum(sites["clearance"], sites["clearance_minus"]), 0.0)
    load = side * sites["stiffness"] * pressed ** sites["exponent"]
    sites["mode"][which], sites["preload"][which] = (side * LASTING)[which], load[which]
    sites["approach"][which] = side[which] * speed


@kernel
def gap_of(site: Any, side: float) -> float:
    """Clearance in m of a ``SITE`` on one side."""
    return site.clearance if side > 0 else site.clearance_minus


@kernel
def impact_time(site: Any, speed: float) -> float:
    """Contact time in s of an isolated conservative impact on a ``SITE`` at ``speed`` in m/s."""
    depth = (site.inertia * speed**site.power / site.stiffness) ** site.root
    return site.factor * depth / speed


@kernel
def elastic_force_and_slope(law: Any, x: float) -> tuple[float, float]:
    """kc x^n in N and its derivative in N/m at the indentation x in m, continued as an odd function to x < 0.

    ``law`` is a record with ``stiffness`` and ``exponent``.
    """
    if law.exponent == 1.0:
        return law.stiffness * x, law.stiffness
    slope = law.stiffness * law.exponent * abs(x) ** (law.exponent - 1.0)
    return slope * x / law.exponent, slope


@kernel
def elastic_force(law: Any, x: float) -> float:
    """The force of ``elastic_force_and_slope``; Hertz's by a square root, which is five times as fast as a power."""
    if law.exponent == 1.5:
        return law.stiffness * (x * np.sqrt(abs(x)))
    return elastic_force_and_slope(law, x)[0]


@kernel
def elastic_energy(law: Any, x: float) -> float:
    """kc x^(n+1)/(n+1) in J for the indentation x in m; zero for x <= 0."""
    if x <= 0.0:
        return 0.0
    if law.exponent == 1.5:
        return law.stiffness * x * x * np.sqrt(x) / 2.5
    if law.exponent == 1.0:
        return 0.5 * law.stiffness * x * x
    return law.stiffness * x ** (law.exponent + 1.0) / (law.exponent + 1.0)


@kernel
def contact_force(contacts: np.ndarray, i: int, w: float, rate: float) -> tuple[float, float]:
    """Force on the host in N and dissipated power in W of site ``i`` in its present mode, at w in m and w' in m/s."""
    site = contacts[i]
    if site.mode == FREE:
        return 0.0, 0.0
    side = 1.0 if site.mode > 0 else -1.0
    x = side * w - gap_of(site, side)
    if abs(site.mode) == LASTING:
        return side * elastic_force(site, max(x, 0.0)), 0.0
    elastic = elastic_force(site, x)
    g = 0.0
    if abs(site.mode) != CLIPPED:
        g = 1.0 + site.damping * rate / site.approach
    return side * elastic * g, side * elastic * (g - 1.0) * rate
