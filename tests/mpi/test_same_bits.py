"""Runs have the same bits on any number of ranks: every lattice of the zoo, and what lies across borders of ranks."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

import vipetsc
from tests.conftest import small_case
from tests.mpi.alike import as_alone
from tests.verify.test_impacts import joined
from tests.verify.test_measures_of_runs import EXPONENT_OF_CHAIN
from tests.zoo import ZOO
from vipetsc.case import Case, CaseError
from vipetsc.dynamics import simulate

EXAMPLES = Path(vipetsc.__file__).parent / "examples"
ENGINES = [(name, engine) for name, kind in ZOO.items() for engine in kind.engines]


def case_at_border(name: str, engine: str) -> Case:
    """Return a lattice of the zoo with its sites on both sides of the border of two ranks."""
    table = ZOO[name].table(engine)
    # 16 cells are cut after cell 8.
    if table["contacts"].get("sites") == [7, 8]:
        table["contacts"]["sites"] = [8, 9]
    return Case.from_table(table)


@pytest.mark.parallel([2])
@pytest.mark.parametrize(("name", "engine"), ENGINES)
def test_two_ranks_have_the_bits_of_one(name, engine):
    """Samples, impacts, energies and statistics of every lattice of the zoo, with contacts."""
    result = as_alone(case_at_border(name, engine))
    assert result.complete
    assert result.statistics["episodes"] > 0


TWO_MASSES = {
    "cells": 7,
    "cell": {
        "masses": [1e-3, 2e-3],
        "contact": [1, 2],
        "springs": [
            {"start": 1, "end": 2, "stiffness": 1e4},
            {"start": 2, "end": 1, "stiffness": 1e3, "next_cell": True},
        ],
    },
}


def joined_cells(engine: str, **contacts: Any) -> Case:
    """Return seven cells with contacts that join cells, masses of one cell, and masses with the ground."""
    table = {"stiffness": 1e7, "clearance": 1e-5, "sites": [1, 2, 3, 3, 4, 5, 6, 7], "restitution": 0.7}
    each = {
        "pair": [[2, 1], [2, 1], [1, 2], [2, 1], [2, 1], [0, 2], [2, 1], [0, 1]],
        "next_cell": [True, True, False, True, True, False, True, False],
    }
    return Case.from_table({
        "lattice": TWO_MASSES | {"ends": contacts.pop("ends", "fixed")},
        "contacts": table | {"each": each | contacts},
        "drive": {"amplitude": 30.0, "cycles": 2, "frequency": 2e3},
        "time": {"engine": engine, "end": 0.008, "sample_interval": 2e-4, "rtol": 1e-8},
    })  # fmt: skip


def pressed_ring(engine: str) -> Case:
    """Return such a ring, in which a contact joins the last cell and the first, and another one is pressed at rest."""
    return joined_cells(
        engine,
        ends="periodic",
        pair=[[2, 1], [1, 1], [1, 2], [2, 1], [2, 1], [0, 2], [2, 1], [2, 1]],
        next_cell=[True, True, False, True, True, False, True, True],
        side=["both", "minus", *["both"] * 6],
        restitution=[0.7, 1.0, *[0.7] * 6],
        precompression=[0.0, 3e-5, *[0.0] * 6],
    )


# 24 cells are cut after cell 12 on 2 ranks, and after cells 8 and 16 on 3: these masses are on both sides of the cuts,
# in cells with a site and without one.
PLACES = [(1, 1), (8, 2), (9, 3), (12, 4), (12, 2), (13, 1), (13, 3), (24, 4)]
POINTS = [{"name": f"c{cell}m{mass}", "cell": cell, "mass": mass} for cell, mass in PLACES]


def points(engine: str) -> Case:
    """Return a damped ring with points, forces of sites that are not sorted, and a window that leaves points out."""
    return small_case(
        lattice={"ends": "periodic", "damping": {"mass": 5.0, "stiffness": 1e-6}},
        contacts={"sites": [13, 6, 12]},
        time={"end": 0.03, "engine": engine},
        output={"points": POINTS, "forces": True, "window": [5, 15], "stride": 2},
    )


def curved_springs(engine: str) -> Case:
    """Return a ring with springs that are not linear before the borders of ranks, and clusters of sites."""
    springs = {
        "springs[1].cubic": {"cells": [8, 12, 16], "value": 3e11},
        "springs[4].quadratic": {"cells": [13], "value": 1e5},
    }
    lattice = {"profiles": springs, "damping": {"mass": 30.0}, "ends": "periodic"}
    sites = [1, 6, 7, 12, 13, 16, 17, 24]
    return small_case(lattice=lattice, contacts={"sites": sites}, time={"end": 0.02, "engine": engine})


def drives(engine: str) -> Case:
    """Return a lattice under drives of cells of several ranks, and of a moved end with dashpots."""
    more = [
        {"waveform": "impulse", "amplitude": 2e-2, "duration": 3e-4, "cell": 20, "mass": 3},
        {"waveform": "chirp", "amplitude": 8.0, "frequency": 900.0, "bandwidth": 500.0, "duration": 0.02, "cell": 11},
        {"waveform": "step", "amplitude": 1e-4, "ramp": 2e-3, "end": "right"},
    ]
    lattice = {"damping": {"stiffness": 1e-5}}
    return small_case(drive={"more": more}, lattice=lattice, time={"end": 0.022, "engine": engine})


def one_mode(engine: str) -> Case:
    """Return a lattice that begins with a linear mode, in which contacts are closed."""
    mode = {"kind": "mode", "number": 40, "energy": 0.5}
    contacts = {"sites": [6, 8, 9, 12, 13, 16, 17], "clearance": 1e-3, "stiffness": 1e5}
    time = {"engine": engine, "end": 0.008}
    return small_case(lattice={"ends": "free"}, contacts=contacts, drive={"amplitude": 0.0}, initial=mode, time=time)


def few_cells(engine: str) -> Case:
    """Return a damped lattice of two cells: the last of three ranks has none."""
    lattice = {"cells": 2, "damping": {"mass": 10.0, "stiffness": 1e-6}}
    contacts = {"sites": [1, 2], "clearance": 5e-5}
    return small_case(lattice=lattice, contacts=contacts, time={"end": 0.02, "engine": engine})


def wide_band(engine: str) -> Case:
    """Return a lattice in which motion reaches beyond the neighbouring rank within a sample interval."""
    return small_case(
        lattice={"cells": 11},
        contacts={"sites": [3, 8]},
        drive={"cell": 6, "mass": 3},
        time={"end": 0.04, "sample_interval": 8e-4, "engine": engine},
    )


def sticking(engine: str) -> Case:
    """Return a ring in which masses of neighbouring cells stick, those of two ranks among them."""
    return joined(engine, [6, 8, 12, 16, 18, 24], 0.0, "periodic", time={"end": 0.02})


def sharing_masses(engine: str) -> Case:
    """Return rigid stops that share masses of two ranks."""
    return joined(engine, [11, 12, 13], 0.3, "periodic", time={"end": 0.03})


def squeezed(engine: str) -> Case:
    """Return a mass with two stops without clearance, one of them to a mass of the other rank."""
    each = {"pair": [[1, 1], [0, 1]], "next_cell": [True, False], "side": ["minus", "plus"]}
    contacts = {"clearance": 0.0, "pair": None, "next_cell": None, "side": None, "each": each}
    return joined(engine, [12, 13], 0.7, contacts=contacts, time={"end": 0.03})


def strip(engine: str) -> Case:
    """Return a strip with stops to the ground and between rows, rigid ones and others, on both sides of all cuts."""
    each = {
        "pair": [[0, 1], [3, 4], [0, 2], [3, 4], [0, 2], [0, 3]],
        "law": ["rigid", "rigid", "hertz", "rigid", "hertz", "rigid"],
    }
    return Case.from_table({
        "lattice": {"cells": 24, "strip": {"rows": 5, "mass": 0.01, "stiffness": 1e4}},
        "contacts": {
            "sites": [5, 6, 8, 9, 12, 13],
            "clearance": 1e-4,
            "stiffness": 1e8,
            "restitution": 0.8,
            "each": each,
        },
        "drive": {"amplitude": 20.0, "waveform": "harmonic", "frequency": 1000.0, "place": [3, 2]},
        "time": {"end": 0.04, "engine": engine},
    })  # fmt: skip


def exponent(engine: str) -> Case:
    """Return a run with a Lyapunov exponent, whose companion lies on all ranks too."""
    time = EXPONENT_OF_CHAIN["time"] | {"engine": engine, "end": 0.2}
    return Case.from_table(EXPONENT_OF_CHAIN | {"time": time})


def users_law(engine: str) -> Case:
    """Return a lattice with the law of a user's module, which each rank compiles."""
    table = tomllib.loads((EXAMPLES / "own-law.toml").read_text())
    table["plugins"]["modules"] = [str(EXAMPLES / "own_law.py")]
    table["lattice"]["cells"] = 24
    table["contacts"] |= {"sites": [6, 12, 13], "clearance": 2e-4}
    table["time"] |= {"end": 0.05, "engine": engine}
    return Case.from_table(table)


BOTH = "ts", "propagator"
ACROSS = {
    joined_cells: BOTH,
    pressed_ring: BOTH,
    points: BOTH,
    curved_springs: BOTH,
    drives: BOTH,
    one_mode: BOTH,
    wide_band: ("propagator",),
    sticking: BOTH,
    sharing_masses: ("propagator",),
    squeezed: ("propagator",),
    strip: BOTH,
    exponent: BOTH,
    users_law: BOTH,
}
# Blocks that differ in size, a rank without cells, and ranks between two others.
ON_THREE = [
    (joined_cells, "ts"),
    (pressed_ring, "propagator"),
    (points, "ts"),
    (curved_springs, "propagator"),
    (few_cells, "ts"),
    (wide_band, "propagator"),
    (sticking, "ts"),
    (sharing_masses, "propagator"),
    (strip, "ts"),
    (strip, "propagator"),
]
# Two ranks lie between two others.
ON_FOUR = [(joined_cells, "ts"), (sticking, "ts"), (curved_springs, "propagator"), (strip, "ts"), (strip, "propagator")]


def assert_as_alone(create: Any, engine: str) -> None:
    """Assert that the run of a case has contacts, and the bits of one rank."""
    result = as_alone(create(engine))
    assert result.complete, result.sentence
    assert result.statistics["engine"] == engine
    assert result.statistics["episodes"] > 1


@pytest.mark.parallel([2])
@pytest.mark.parametrize(("create", "engine"), [(create, name) for create, names in ACROSS.items() for name in names])
def test_what_lies_across_a_border_has_the_bits_of_one_rank(create, engine):
    assert_as_alone(create, engine)


@pytest.mark.parallel([3])
@pytest.mark.parametrize(("create", "engine"), ON_THREE)
def test_three_ranks_have_the_bits_of_one(create, engine):
    assert_as_alone(create, engine)


@pytest.mark.parallel([4])
@pytest.mark.parametrize(("create", "engine"), ON_FOUR)
def test_four_ranks_have_the_bits_of_one(create, engine):
    assert_as_alone(create, engine)


@pytest.mark.parallel(2)
def test_stops_that_share_a_mass_are_refused_on_two_ranks():
    """Blows pass from mass to mass within an instant, which ``ts`` follows on one rank."""
    with pytest.raises(CaseError, match="rank"):
        simulate(joined("ts", [11, 12], 0.5))
