"""Lattices whose cells contacts alone join: modes of a cell, features that are refused, branches and responses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vipetsc.case import CaseError, NnmCase
from vipetsc.case.bodies import bodies_of
from vipetsc.case.nfrc import NfrcCase
from vipetsc.lattice import Chain, Spring, UnitCell, fastest_speed, modes_of_a_cell, wave_bands, waves_at
from vipetsc.lattice.sites import Pair, sites_at
from vipetsc.modes.system import System

INSIDE = {"start": 1, "end": 2, "stiffness": 5e3}
CELL = UnitCell((4e-3, 2e-3), (Spring(0, 1, 5e3),), host=0, resonator=1)
LOCAL = np.sqrt(5e3 * (1 / 4e-3 + 1 / 2e-3))  # rad/s, of grain and resonator against each other
PRESSED = {"clearance": 0.0, "side": "minus", "precompression": 1e-4}
APART = {"clearance": 1e-5, "precompression": None, "side": None}


def table(**sections: dict[str, Any]) -> dict[str, Any]:
    """Return the table of four grains with resonators, pressed together; ``sections`` update it, None removes a key."""
    given: dict[str, Any] = {
        "lattice": {"cells": 4, "ends": "free", "cell": {"masses": [4e-3, 2e-3], "springs": [INSIDE]}},
        "contacts": {"stiffness": 1e7, "pair": [1, 1], "next_cell": True, "sites": [1, 2, 3]} | PRESSED,
        "drive": {"amplitude": 1.0, "frequency": 1e3, "cycles": 2},
        "time": {"end": 0.01, "sample_interval": 1e-4},
    }
    merged = given | {name: given.get(name, {}) | values for name, values in sections.items()}
    return {name: {key: value for key, value in part.items() if value is not None} for name, part in merged.items()}


def test_a_cell_alone_has_modes_and_no_waves():
    """Cells without springs between them have the modes of one cell, at 0 and (k (1/m1 + 1/m2))^(1/2), and no bands."""
    assert modes_of_a_cell(CELL) == pytest.approx([0.0, LOCAL], rel=1e-12)
    assert wave_bands(CELL) == ()
    assert fastest_speed(CELL) == 0
    # At the frequency of its mode a band without width would have a wave at every wavenumber.
    for frequency in (0.0, LOCAL, float(modes_of_a_cell(CELL)[1])):
        assert waves_at(CELL, frequency) == ()


def bodies_with(pairs: list[Pair], gaps: list[tuple[float, float]]) -> list[int]:
    """Return the bodies of two cells with contacts of these ``pairs`` in the first one."""
    return bodies_of(Chain(CELL, 2, "free", sites=sites_at([0] * len(pairs), pairs, gaps=gaps)))


def test_bodies_are_what_springs_and_pressed_contacts_hold_together():
    """Numbers of bodies are those of the ground, then of grain and resonator of each cell."""
    between, ground = Pair(0, 0, offset=1), Pair(-1, 0)
    pressed, apart = (-1e-5, np.inf), (1e-5, np.inf)
    assert bodies_with([between], [apart]) == [0, 1, 1, 2, 2]
    assert bodies_with([between], [pressed]) == [0, 1, 1, 1, 1]
    assert bodies_with([between, ground], [pressed, pressed]) == [0, 0, 0, 0, 0]
    assert bodies_with([between, ground], [apart, pressed]) == [0, 0, 0, 1, 1]
    assert bodies_with([between], [(1e-5, 1e-5)]) == [0, 1, 1, 2, 2]


def modes_case(modes: list[int], contacts: dict[str, Any] | None = None, ends: str = "free") -> dict[str, Any]:
    """Return the table of branches of a whole lattice of grains."""
    given = table(contacts=contacts or {}, lattice={"ends": ends}, nnm={"system": "chain", "modes": modes})
    return {name: given[name] for name in ("lattice", "contacts", "nnm")}


@pytest.mark.parametrize("ends", ["free", "fixed"])
@pytest.mark.parametrize(("contacts", "still"), [({}, 1), (APART, 4)])
def test_branches_begin_where_a_motion_oscillates(ends, contacts, still):
    """Rigid motions are refused by their numbers: one of a pressed chain with any ends, four of four separate grains.

    No spring joins an end to a wall.
    """
    modes = list(range(1, 9))
    with pytest.raises(CaseError, match="can move as a rigid body") as error:
        NnmCase.from_table(modes_case(modes, contacts, ends))
    assert error.value.problems[0].value == modes[:still]

    case = NnmCase.from_table(modes_case(modes[still:], contacts, ends))
    frequencies = System.from_case(case).linear_modes()[0]
    assert np.sum(frequencies < 1e-6 * frequencies[-1]) == still


def test_modes_of_a_pressed_chain_are_those_of_masses_in_masses():
    """The modes of n pressed grains have kappa = j pi/n with free ends.

    Both branches solve (q + k2 - m1 w^2)(k2 - m2 w^2) = k2^2 with q = 4 k sin^2(kappa/2) and the slope k of the
    contact's force, 3/2 times the stiffness times the square root of the precompression.
    """
    slope = 1.5 * 1e7 * 1e-4**0.5
    expected = []
    for j in range(4):
        pull = 4 * slope * np.sin(j * np.pi / 8) ** 2
        matrix = np.array([[pull + 5e3, -5e3], [-5e3, 5e3]]) / np.array([[4e-3], [2e-3]])
        expected += np.sqrt(np.abs(np.linalg.eigvals(matrix))).tolist()
    found = System.from_case(NnmCase.from_table(modes_case([2]))).linear_modes()[0]
    assert found == pytest.approx(sorted(expected), rel=1e-9, abs=1e-4)


def response(**sections: dict[str, Any]) -> dict[str, Any]:
    """Return the table of a frequency response of grains."""
    nfrc = {"source": "force", "range": [0.1, 1.0], "harmonics": 5} | sections.pop("nfrc", {})
    return table(nfrc=nfrc, **sections)


def test_responses_are_those_of_a_pressed_chain():
    """Pressed contacts are springs of the chain; contacts apart are accepted on both sides alone.

    The mean force of a contact on one side pushes grains, which no spring holds, apart.
    """
    case = NfrcCase.from_table(response())
    assert case.are_contacts_springs and not case.nfrc.infinite
    assert NfrcCase.from_table(response(contacts=APART)).nfrc.symmetric
    with pytest.raises(CaseError, match="its mean force pushes them apart"):
        NfrcCase.from_table(response(contacts=APART | {"side": "minus"}))
    # Springs hold masses that a contact within a cell would push apart.
    inside = {"sites": [1, 2, 3, 2], "pair": None, "next_cell": None, "precompression": None}
    each = {"pair": [[1, 1]] * 3 + [[1, 2]], "next_cell": [True] * 3 + [False], "precompression": [1e-4] * 3 + [0.0]}
    assert NfrcCase.from_table(response(contacts=inside | {"each": each}))
