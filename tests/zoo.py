"""A zoo of small lattices, one of each kind that there is, for laws that must hold for all of them.

Each is the table of a case that runs for a fraction of a second. ``exact`` ones have no power of a real exponent
in their laws, so that a change of units by powers of 16 changes no bit; ``mirrored`` ones are the same counted from the
other end.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from tests.conftest import with_sections

PAIR = {
    "masses": [0.35, 0.11],
    "springs": [
        {"start": 1, "end": 1, "stiffness": 1.3e5, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": 4.1e4},
    ],
    "contact": [1, 2],
}
TRIPLE = {
    "masses": [0.3, 0.2, 0.1],
    "springs": [
        {"start": 1, "end": 2, "stiffness": 9e4},
        {"start": 2, "end": 3, "stiffness": 4e4},
        {"start": 3, "end": 1, "stiffness": 7e4, "next_cell": True},
    ],
    "contact": [1, 2],
}
BASE: dict[str, Any] = {
    "lattice": {"cells": 16, "cell": PAIR},
    "contacts": {"law": "bilinear", "stiffness": 1e7, "sites": [7, 8], "clearance": 3e-4},
    "drive": {"cell": 4, "frequency": 550.0, "amplitude": 60.0, "cycles": 5},
    "time": {"end": 0.12, "samples": 121},
}


@dataclass(frozen=True)
class Kind:
    """A lattice: sections that update those of ``BASE``, and what its motion has."""

    sections: dict[str, Any] = field(default_factory=dict)
    exact: bool = True
    conservative: bool = True
    mirrored: bool = True
    linear_without_sites: bool = True
    engines: tuple[str, ...] = ("ts", "propagator")
    without: tuple[str, ...] = ()
    units: dict[str, str] = field(default_factory=dict)

    def table(self, engine: str) -> dict[str, Any]:
        """Return the table of the case for an ``engine``."""
        base = {name: section for name, section in BASE.items() if name not in self.without}
        table = with_sections(base, self.sections)
        return with_sections(table, {"time": {"engine": engine}})

    def key_units(self) -> dict[str, str]:
        """Return units of keys that depend on others, by the path of the key."""
        return {"contacts.stiffness": "N/m", "contacts.each.stiffness": "N/m"} | self.units


def cell(base: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """Return the section [lattice] with a cell changed by ``changes``."""
    return {"lattice": {"cell": base | changes}}


def springs(**changes: float) -> list[dict[str, Any]]:
    """Return the springs of ``PAIR``, the second one with ``changes``."""
    first, second = PAIR["springs"]
    return [first, second | changes]


HERTZ = {"contacts": {"law": "hertz", "stiffness": 1e9}}
ZOO = {
    "bilinear": Kind(),
    "hertz": Kind(HERTZ, exact=False, units={"contacts.stiffness": "N/m^1.5"}),
    "restitution": Kind({"contacts": {"restitution": 0.6}}, conservative=False),
    "one side": Kind({"contacts": {"side": "plus"}}),
    "pressed": Kind(
        {"contacts": {"side": "plus", "clearance": 0.0, "precompression": 2e-5}, "drive": {"amplitude": 240.0}}
    ),
    "each its own": Kind(
        {"contacts": {"clearance": [2e-4, 4e-4], "each": {"stiffness": [4e6, 2e7], "restitution": [0.5, 1.0]}}},
        conservative=False,
        mirrored=False,
    ),
    "dashpots": Kind(cell(PAIR, springs=springs(damping=3.0), grounding=[0.4, 0.0]), conservative=False),
    "proportional": Kind({"lattice": {"damping": {"mass": 2.0, "stiffness": 1e-5}}}, conservative=False),
    "cubic": Kind(cell(PAIR, springs=springs(cubic=3e10)), linear_without_sites=False),
    "quadratic": Kind(cell(PAIR, springs=springs(quadratic=4e6)), linear_without_sites=False),
    "joined cells": Kind(cell(TRIPLE) | {"contacts": {"pair": [3, 1], "next_cell": True}}, mirrored=False),
    "to ground": Kind({"contacts": {"pair": [0, 2]}}),
    "ring": Kind({"lattice": {"ends": "periodic"}}),
    "free ends": Kind({"lattice": {"ends": "free"}}),
    "disorder": Kind({"disorder": {"seed": 3, "cells": {"masses[2]": {"relative": 0.05}}}}, mirrored=False),
    "packet": Kind(
        {
            "initial": {
                "kind": "packet",
                "band": 1,
                "wavenumber": 1.2,
                "cell": 5,
                "width": 2.0,
                "direction": 1,
                "amplitude": 6e-4,
            }
        },
        without=("drive",),
    ),
    "struck": Kind({"initial": {"kind": "velocity", "cell": 6, "mass": 1, "velocity": 0.8}}, without=("drive",)),
    "moved wall": Kind(
        {"drive": {"end": "left", "amplitude": 1.2e-3, "frequency": 550.0, "cycles": 5}},
        without=("drive",),
        mirrored=False,
    ),
    "absorbing": Kind(
        {"lattice": {"absorbing": {"end": "right", "cells": 6, "reflection": 0.1}}}, conservative=False, mirrored=False
    ),
    "two drives": Kind(
        {"drive": {"more": [{"cell": 13, "frequency": 700.0, "amplitude": 20.0, "cycles": 4}]}}, mirrored=False
    ),
    "one mass": Kind(
        {
            "lattice": {
                "cells": 1,
                "cell": {"masses": [0.5], "springs": [{"start": 1, "end": 1, "stiffness": 5e4, "next_cell": True}]},
            },
            "contacts": {"sites": [1], "pair": [0, 1]},
            "drive": {"cell": 1, "amplitude": 200.0},
        }
    ),
}
