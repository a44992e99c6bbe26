"""Modes of mirror-symmetric lattices, whose contacts begin in pairs, at one instant or half a period apart."""

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from vipetsc.case import NnmCase
from vipetsc.modes import Branch
from vipetsc.modes.branches.follow import follow_all

WALL = 1000.0  # N/m, the spring of each of two masses of 1 kg to the ground
BETWEEN = 500.0  # N/m, the spring between the two masses
STOP = 5000.0  # N/m
CLEARANCE = 1e-3  # m
# The stiffness (N/m) that one mass moves against. In phase the spring between the masses is not strained; out of phase
# its middle stands still, so that each half of the spring has twice its stiffness.
HALF = {"in-phase": WALL, "out-of-phase": WALL + 2 * BETWEEN}
TABLE: dict[str, Any] = {
    "name": "mirror",
    "contacts": {"law": "bilinear", "stiffness": STOP},
    "nnm": {
        "system": "own",
        "modes": [1, 2],
        "energy": [0.0, 6e-3],
        "points": 90,
        "locate": False,
        "own": {
            "masses": [1.0, 1.0],
            "springs": [
                {"start": 0, "end": 1, "stiffness": WALL},
                {"start": 1, "end": 2, "stiffness": BETWEEN},
                {"start": 0, "end": 2, "stiffness": WALL},
            ],
            "contacts": [
                {"host": 0, "resonator": 1, "clearance": CLEARANCE},
                {"host": 0, "resonator": 2, "clearance": CLEARANCE},
            ],
        },
    },
}
CELLS = 24
SITES = [8, CELLS + 1 - 8]
# A row of masses between walls, with two stops at equal distances from its middle.
CHAIN: dict[str, Any] = {
    "name": "mirror",
    "lattice": {
        "cells": CELLS,
        "cell": {"masses": [1.0], "springs": [{"start": 1, "end": 1, "next_cell": True, "stiffness": WALL}]},
    },
    "contacts": {
        "law": "bilinear",
        "stiffness": STOP,
        "sites": SITES,
        "clearance": CLEARANCE,
        "each": {"pair": [[0, 1], [0, 1]]},
        "side": "plus",
    },
    "nnm": {
        "system": "chain",
        "modes": [1],
        "start_energy": 1.3e-4,
        "energy": [0.0, 1.6e-4],
        "points": 18,
        "tolerance": 1e-12,
    },
}


def own_case(sides: list[str], **nnm: Any) -> dict[str, Any]:
    """The case of two masses whose stops are on these ``sides``; ``nnm`` updates the table [nnm]."""
    contacts = TABLE["contacts"] | {"each": {"side": sides}}
    return TABLE | {"contacts": contacts, "nnm": TABLE["nnm"] | nnm}


def branches(table: dict[str, Any]) -> dict[str, Branch]:
    """The branches of the case in ``table`` by their names."""
    found = follow_all(NnmCase.from_table(table), None, MPI.COMM_SELF)
    return {branch.name: branch for branch in found}


def exact_period(energy: float, stiffness: float, sides: int) -> float:
    """Period in s of a mass of 1 kg on a spring, with a stop on one of its sides or on both, at an ``energy`` in J.

    The motion is harmonic about 0 outside the stop, and about the equilibrium of both springs at the stop.
    """
    omega = np.sqrt(stiffness)
    if 2 * energy < stiffness * CLEARANCE**2:
        return float(2 * np.pi / omega)
    speed = np.sqrt(2 * energy - stiffness * CLEARANCE**2)
    to_stop = np.arctan2(omega * CLEARANCE, speed) / omega
    stiffer = np.sqrt(stiffness + STOP)
    rest = STOP * CLEARANCE / (stiffness + STOP)
    in_stop = np.arctan2(speed, stiffer * (CLEARANCE - rest)) / stiffer
    return float(2 * sides * (to_stop + in_stop) + (2 - sides) * np.pi / omega)


def assert_halves(branch: Branch, sides: int, rtol: float) -> None:
    """Assert that every orbit has the period of one mass that moves with half of the energy."""
    for point in branch.regular():
        exact = exact_period(point.energy / 2, HALF[branch.name], sides)
        assert point.period == pytest.approx(exact, rel=rtol)


# The sides of the two stops, the modes in which each mass moves as if alone with a stop, and the sides of that stop.
SIDES = [
    (["plus", "plus"], ["in-phase"], 1),
    (["plus", "minus"], ["out-of-phase"], 1),
    (["both", "both"], ["in-phase", "out-of-phase"], 2),
]


@pytest.mark.parametrize(("sides", "halved", "stops"), SIDES)
@pytest.mark.parametrize("map_name", ["auto", "whole"])
def test_contacts_of_a_mirrored_lattice_begin_in_pairs(sides, halved, stops, map_name):
    """Branches of mirror-symmetric modes pass the grazing of two contacts and reach the end of their range.

    The contacts begin at one instant, or half a period apart in the other mode. Where each mass moves as if alone, the
    period is that of one mass in closed form.
    """
    found = branches(own_case(sides, map=map_name))
    assert list(found) == list(HALF)
    for name, branch in found.items():
        assert "energy range" in branch.ended.sentence, branch.ended.sentence
        episodes = [point.episodes for point in branch.regular()]
        assert episodes[0] == 0
        assert episodes[-1] >= 2
        if name in halved:
            assert_halves(branch, stops, rtol=1e-9)


def test_so_do_those_of_condensed_motions():
    """Contacts of a mirrored lattice begin in pairs in condensed motions too, with the exact period."""
    found = branches(own_case(["plus", "plus"], method="balance", truncation=1e-4, first_step=0.05, largest_step=0.2))
    for branch in found.values():
        assert "energy range" in branch.ended.sentence, branch.ended.sentence
        assert branch.regular()[-1].episodes == 2
    assert_halves(found["in-phase"], sides=1, rtol=1e-5)


@pytest.mark.parametrize("beyond", [0.0, 1e-7, 1e-4])
def test_contacts_that_are_no_images_begin_one_after_the_other(beyond):
    """Two contacts graze at two points if their clearances differ by little, and at one if they are equal."""
    table = own_case(["plus", "plus"], locate=True, locate_grazing=True)
    own = table["nnm"]["own"]
    first, second = own["contacts"]
    further = second | {"clearance": CLEARANCE * (1 + beyond)}
    table["nnm"]["own"] = own | {"contacts": [first, further]}
    for branch in branches(table).values():
        grazing = [point.energy for point in branch.points if point.kind == "grazing"]
        assert len(grazing) == (2 if beyond else 1)
        assert max(point.episodes for point in branch.points) == 2
        # The second contact begins at an energy that is larger by about twice the difference.
        if beyond:
            assert 0.1 * beyond < grazing[1] / grazing[0] - 1 < 10 * beyond
