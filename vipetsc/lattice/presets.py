"""The paper's two lattices: cell, length, contacts, sites and drive, as plain case tables."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from vipetsc.lattice.cell import UnitCell, diatomic, four_band


@dataclass(frozen=True)
class Preset:
    """One of the paper's lattices; the tables hold what a case file would say, in SI units.

    ``site_span(cells, count)`` gives the 1-based positions (first, last) between which sites are spread,
    ``clearance_span(count)`` the clearances in m of the leading and of the last site.
    """

    cell: Callable[..., UnitCell]
    cells: int
    contacts: dict[str, Any]
    drive: dict[str, Any]
    site_span: Callable[[int, int], tuple[float, float]]
    clearance_span: Callable[[int], tuple[float, float]]


CONTACTS: dict[str, Any] = {"law": "hertz", "radius": 0.005, "poisson": 0.3, "restitution": 0.7, "sites": 5}

PRESETS: dict[str, Preset] = {
    "four-band": Preset(
        cell=four_band,
        cells=300,
        contacts=CONTACTS | {"modulus": 1e8},
        drive={"amplitude": 24.33, "cycles": 30, "band": 2, "at": "max-group-velocity"},
        site_span=lambda n, count: (n / 3, n / 3) if count == 1 else (n / 4, 2 * n / 3),
        clearance_span=lambda count: (10 ** (-2.75 if count == 1 else -2.65), 10**-2.75),
    ),
    "diatomic": Preset(
        cell=diatomic,
        cells=600,
        contacts=CONTACTS | {"modulus": 2e8},
        drive={"amplitude": 1.0, "cycles": 30, "wavenumber": "5pi/9", "band": 2},
        site_span=lambda n, count: (n / 4, n / 2),
        clearance_span=lambda count: (2e-4, 1e-4),
    ),
}
