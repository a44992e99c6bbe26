"""A zoo of small lattices, one of each kind that there is, for laws that must hold for all of them.

Each is the table of a case that runs for a fraction of a second. ``exact`` ones have no power of a real exponent
in their laws, so that a change of units by powers of 16 changes no bit; ``mirrored`` ones may be counted from the other
end by the numbers of their cells and masses, ``turned`` ones seen from the other side by the signs of numbers, and
``scaled`` ones are given in numbers alone, whose units are known.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from tests.conftest import DIFFERING, with_sections
from vipetsc.lattice.contact import LAWS

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
    "time": {"end": 0.12, "samples": 121, "rtol": 1e-11},
}


@dataclass(frozen=True)
class Kind:
    """A lattice: sections that update those of ``BASE``, and what its motion has."""

    sections: dict[str, Any] = field(default_factory=dict)
    exact: bool = True
    conservative: bool = True
    mirrored: bool = True
    linear_without_sites: bool = True
    turned: bool = True
    scaled: bool = True
    engines: tuple[str, ...] = ("ts", "propagator")
    without: tuple[str, ...] = ()
    units: dict[str, str] = field(default_factory=dict)

    def table(self, engine: str) -> dict[str, Any]:
        """Return the table of the case for an ``engine``."""
        base = {name: section for name, section in BASE.items() if name not in self.without}
        table = with_sections(base, self.sections)
        table = with_sections(table, {"time": {"engine": engine}})
        # None takes a key of the base away.
        return {name: {k: v for k, v in section.items() if v is not None} for name, section in table.items()}

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


def driven(**drive: Any) -> dict[str, Any]:
    """Return the section [drive] of a force on cell 4."""
    return {"drive": {"cell": 4} | drive}


HERTZ = {"contacts": {"law": "hertz", "stiffness": 1e9}}
HERTZ_UNITS = {"contacts.stiffness": "N/m^1.5"}
RIGID = {"law": "rigid", "stiffness": None}
# Contacts that join cells: each reaches into the next cell.
JOINED = {"pair": [1, 1], "next_cell": True, "side": "minus"}
INSIDE = {"start": 1, "end": 2, "stiffness": 4.1e4}
UNEVEN = {
    "masses": [0.2, 0.3, 0.15, 0.1],
    "springs": [
        {"start": 4, "end": 1, "stiffness": 1.3e5, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": 9e4},
        {"start": 2, "end": 4, "stiffness": 7e4},
        {"start": 2, "end": 3, "stiffness": 2e4},
    ],
    "contact": [2, 3],
}
CURVED = {
    "springs[1].cubic": {"cells": [5, 16], "value": 3e10},
    "springs[2].quadratic": {"cells": [3, 9], "value": 4e6},
}
ZOO = {
    "bilinear": Kind(),
    "hertz": Kind(HERTZ, exact=False, units=HERTZ_UNITS),
    "power": Kind(
        {"contacts": {"law": "power", "exponent": 1.25, "stiffness": 5e7}},
        exact=False,
        units={"contacts.stiffness": "N/m^1.25"},
    ),
    "restitution": Kind({"contacts": {"restitution": 0.6}}, conservative=False),
    "one side": Kind({"contacts": {"side": "plus"}}),
    "rigid": Kind({"contacts": RIGID}),
    "rigid with loss": Kind({"contacts": RIGID | {"restitution": 0.4}}, conservative=False),
    "rigid, sticking": Kind({"contacts": RIGID | {"restitution": 0.0}}, conservative=False),
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
    "cubic": Kind(cell(PAIR, springs=springs(cubic=3e10)), linear_without_sites=False, engines=("ts",)),
    "quadratic": Kind(cell(PAIR, springs=springs(quadratic=4e6)), linear_without_sites=False, engines=("ts",)),
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
        turned=False,
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
    "clipped": Kind({"contacts": {"restitution": 0.0, "adhesion": "clip"}}, conservative=False),
    "slow approaches": Kind({"contacts": {"restitution": 0.4, "approach_floor": 0.3}}, conservative=False),
    "unequal stops": Kind({"contacts": {"clearance_minus": 1e-4, "restitution": 0.7}}, conservative=False),
    "each its law": Kind(
        {
            "contacts": {"sites": [6, 7, 9], "exponent": 1.25, "clearance": [3e-5, 2e-5, 1e-5], "each": DIFFERING}
            # No site has the common restitution, whose exact factor would be infinite.
            | {"restitution": 0.0, "damping": "exact"}
        },
        exact=False,
        conservative=False,
        mirrored=False,
        turned=False,
        scaled=False,
    ),
    "several pairs": Kind(
        cell(TRIPLE) | {"contacts": {"sites": [7, 7, 8], "each": {"pair": [[2, 3], [1, 2], [0, 3]]}}}, mirrored=False
    ),
    "touching": Kind({"contacts": {"side": "plus", "clearance": 0.0}}, mirrored=False),
    "touching with loss": Kind(
        {
            "contacts": HERTZ["contacts"]
            | {"side": "minus", "clearance": 0.0, "restitution": 0.7, "approach_floor": 0.5}
        },
        exact=False,
        conservative=False,
        units=HERTZ_UNITS,
    ),
    "across the joint": Kind(
        {"lattice": {"ends": "periodic"}, "contacts": JOINED | {"sites": [3, 16], "clearance": 5e-5}}, mirrored=False
    ),
    "beads": Kind(
        {
            "lattice": {"ends": "free", "cell": {"masses": [0.35]}},
            "contacts": HERTZ["contacts"] | JOINED | {"sites": list(range(1, 16)), "clearance": 0.0},
        },
        mirrored=False,
        linear_without_sites=False,
        exact=False,
        units=HERTZ_UNITS,
    ),
    "grains": Kind(
        {
            "lattice": {"ends": "free", "cell": {"masses": [0.35, 0.11], "springs": [INSIDE]}},
            "contacts": JOINED | {"sites": list(range(1, 16)), "clearance": 2e-5, "restitution": 0.8},
        },
        conservative=False,
        mirrored=False,
    ),
    "uneven cell": Kind(cell(UNEVEN) | {"time": {"end": 0.06, "samples": 61}}),
    "profiles": Kind(
        {
            "lattice": {
                "profiles": {
                    "masses[2]": {"first": 0.11, "last": 0.16},
                    "springs[1].stiffness": {"cells": [9], "value": 9e4},
                },
                "damping": {"mass": 2.0, "stiffness": 1e-5},
            }
        },
        conservative=False,
        scaled=False,
        mirrored=False,
    ),
    "ground springs": Kind(
        cell(
            PAIR,
            springs=[
                *PAIR["springs"],
                {"start": 0, "end": 2, "stiffness": 2.5e4, "damping": 0.3},
                {"start": 0, "end": 1, "stiffness": -6e3},
            ],
        )
        | {"drive": {"amplitude": 240.0}},
        conservative=False,
    ),
    "a few curved springs": Kind(
        {"lattice": {"profiles": CURVED}}, scaled=False, mirrored=False, linear_without_sites=False
    ),
    "curved on a ring": Kind(
        {
            "lattice": {"ends": "periodic", "profiles": CURVED, "damping": {"mass": 5.0}},
            "contacts": {"restitution": 0.7},
        },
        conservative=False,
        scaled=False,
        mirrored=False,
        linear_without_sites=False,
    ),
    # Springs of all cells are linear; the one to the left wall is that of the reference cell.
    "curved at the wall": Kind(
        {
            "lattice": {
                "cell": PAIR | {"springs": [PAIR["springs"][0] | {"cubic": 3e10, "quadratic": 4e6}, INSIDE]},
                "profiles": {
                    f"springs[1].{term}": {"cells": [*range(1, 17)], "value": 0.0} for term in ("cubic", "quadratic")
                },
            },
            "drive": {"cell": 2},
        },
        scaled=False,
        mirrored=False,
        linear_without_sites=False,
    ),
    "strip": Kind(
        {
            "lattice": {"cell": None, "strip": {"rows": 5, "mass": 0.35, "stiffness": 1.3e5}},
            "contacts": {"sites": None, "places": [[5, 1], [8, 2], [9, 3]], "restitution": 0.8},
            "drive": {"cell": None, "place": [3, 2], "amplitude": 240.0},
        },
        conservative=False,
        mirrored=False,
    ),
    "damped ring": Kind(
        {"lattice": {"ends": "periodic", "damping": {"mass": 50.0, "stiffness": 1e-4}}, "drive": {"amplitude": 240.0}},
        conservative=False,
    ),
    "loss by bands": Kind({"lattice": {"damping": {"loss": {"1": 0.01, "2": 0.02}}}}, exact=False, conservative=False),
    "absorbing at both ends": Kind(
        {
            "lattice": {"cells": 24, "absorbing": {"end": "both", "cells": 6, "strength": 500.0}},
            "contacts": {"sites": [12, 14]},
            "drive": {"cell": 10},
        },
        conservative=False,
        mirrored=False,
    ),
    "few samples": Kind({"time": {"samples": 61}}),
    "short": Kind(
        {
            "lattice": {"cells": 7},
            "contacts": {"sites": [5]},
            "drive": {"amplitude": 240.0},
            # This motion is chaotic: rounding would show in a longer one.
            "time": {"end": 0.05, "samples": 51},
        },
        engines=("ts",),
    ),
    "closed at first": Kind(
        {
            "initial": {"kind": "packet", "band": 2, "wavenumber": 1.5, "cell": 8, "width": 2.0, "amplitude": 2e-3},
            "contacts": {"restitution": 0.7},
        },
        conservative=False,
        mirrored=False,
        turned=False,
        without=("drive",),
    ),
    "harmonic": Kind(driven(waveform="harmonic", frequency=550.0, amplitude=40.0, ramp=4e-3), without=("drive",)),
    "impulse": Kind(driven(waveform="impulse", amplitude=0.5, duration=1e-3), without=("drive",)),
    "held": Kind(driven(waveform="step", amplitude=80.0, ramp=1.3e-3, duration=0.011), without=("drive",)),
    "samples": Kind(
        driven(
            waveform="samples",
            amplitude=100.0,
            frequency=500.0,
            samples={"time": [1e-3, 4e-3, 8e-3, 1.5e-2], "value": [1.0, 1.0, -1.0, 0.5]},
        ),
        without=("drive",),
    ),
    "damped wall": Kind(
        {
            "lattice": {"damping": {"stiffness": 1e-5}},
            "drive": {"end": "right", "waveform": "step", "ramp": 4e-3, "amplitude": 1.2e-3, "frequency": 550.0},
        },
        conservative=False,
        mirrored=False,
        without=("drive",),
    ),
    "one mass": Kind(
        {
            "lattice": {
                "cells": 1,
                "cell": {"masses": [0.5], "springs": [{"start": 1, "end": 1, "stiffness": 5e4, "next_cell": True}]},
            },
            "contacts": {"sites": [1], "pair": [0, 1]},
            "drive": {"cell": 1, "amplitude": 200.0},
        },
        engines=("ts",),
    ),
}
# A law that no lattice above has is in one of its own.
for law in LAWS:
    if law not in {kind.table("ts")["contacts"]["law"] for kind in ZOO.values()}:
        ZOO[f"law {law}"] = Kind({"contacts": {"law": law}}, exact=False, scaled=False)
