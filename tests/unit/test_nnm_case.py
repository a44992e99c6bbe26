"""The section [nnm]: all problems in one error, cases written out and read back, features that are refused."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

from tests.models import CLEARANCE, KERSCHEN
from vipetsc.case import CaseError
from vipetsc.case.nnm import NnmCase
from vipetsc.modes.system import System


def test_a_case_is_written_out_and_read_back():
    """The text of a case holds the contact's default numbers, and gives the same case and system again."""
    case = NnmCase.from_table({"name": "a", "lattice": {"reading": "printed"}, "contacts": {"law": "bilinear"}})

    table = tomllib.loads(case.to_toml())

    assert NnmCase.from_table(table) == case
    contacts = table["contacts"]
    # The paper's values (Sec. III and IV).
    assert contacts["modulus"] == 1e8
    assert contacts["radius"] == 0.005
    assert contacts["poisson"] == 0.3
    assert contacts["clearance"] == [CLEARANCE]
    system = System.from_case(case)
    assert system.contacts[0].clearance == pytest.approx(CLEARANCE)
    assert [system.branch_name(mode) for mode in (0, 1)] == ["in-phase", "out-of-phase"]


def test_a_lattice_that_nothing_holds_is_not_pushed():
    """A free lattice between two stops to ground is accepted; one stop, whose mean force moves it away, is refused."""
    table = {
        "lattice": {"preset": "four-band", "cells": 8, "ends": "free"},
        "contacts": {"sites": [2], "clearance": 1e-3, "pair": [0, 3]},
        "nnm": {"system": "chain", "modes": [5]},
    }
    NnmCase.from_table(table)
    table["contacts"] |= {"side": "plus"}
    with pytest.raises(CaseError, match="nothing holds this lattice"):
        NnmCase.from_table(table)


def test_stops_to_ground_hold_symmetric_motions_alone():
    """A free lattice between equal stops to ground is refused if other forces on it are not symmetric."""
    sites = {"sites": [2, 4], "clearance": 1e-3, "each": {"pair": [[0, 3], [2, 3]], "side": ["both", "both"]}}
    table: dict[str, Any] = {
        "lattice": {"preset": "four-band", "cells": 8, "ends": "free"},
        "contacts": sites,
        "nnm": {"system": "chain", "modes": [5]},
    }
    NnmCase.from_table(table)

    quadratic = {"springs[3].quadratic": {"cells": [2], "value": 1e5}}
    with pytest.raises(CaseError, match="no place of their own"):
        NnmCase.from_table(table | {"lattice": table["lattice"] | {"profiles": quadratic}})
    sites["each"]["side"] = ["both", "plus"]
    with pytest.raises(CaseError, match="no place of their own"):
        NnmCase.from_table(table)
    NnmCase.from_table(table | {"lattice": table["lattice"] | {"ends": "fixed"}})


def test_a_contact_pressed_to_ground_holds_a_lattice():
    """A contact to ground that is pressed at rest holds a free lattice, or given masses, so that mode 1 oscillates."""
    contacts = {"stiffness": 20.0, "clearance": 0.0, "side": "minus", "precompression": 0.02}
    spring = {"start": 1, "end": 1, "stiffness": 1.0, "next_cell": True}
    table: dict[str, Any] = {
        "lattice": {"cells": 3, "ends": "free", "cell": {"masses": [1.0], "springs": [spring]}},
        "contacts": contacts | {"sites": [1], "pair": [0, 1]},
        "nnm": {"system": "chain", "modes": [1]},
    }
    NnmCase.from_table(table)
    # The mass does not touch this stop at rest, hence the lattice can move as a whole.
    apart = {"stiffness": 20.0, "clearance": 0.02, "sites": [1], "pair": [0, 1]}
    with pytest.raises(CaseError, match="rigid body"):
        NnmCase.from_table(table | {"contacts": apart})

    own = {
        "masses": [1.0, 2.0],
        "springs": [{"start": 1, "end": 2, "stiffness": 1.0}],
        "contacts": [{"host": 0, "resonator": 1, "clearance": 0.0}],
    }
    NnmCase.from_table({"contacts": contacts, "nnm": {"system": "own", "modes": [1], "own": own}})


@pytest.mark.parametrize(
    ("begun", "resumed", "goes_on"),
    [
        ({}, {"direction": "both"}, True),
        ({"direction": "both"}, {"points": 7}, True),
        ({}, {"direction": "down"}, False),
        ({"direction": "down"}, {"direction": "both"}, False),
        ({"forced": [1]}, {"forced": [2]}, False),
        ({"method": "balance"}, {"method": "damped"}, False),
    ],
)
def test_a_branch_that_goes_on_is_the_one_that_was_begun(begun, resumed, goes_on):
    """Keys that leave a branch's file what it is may change; a branch the other way, or another force, is another."""
    nnm = {"system": "own", "own": KERSCHEN, "energy": [1e-3, 1.0]}
    first, second = (NnmCase.from_table({"nnm": nnm | keys}) for keys in (begun, resumed))
    assert (first.physics() == second.physics()) == goes_on
