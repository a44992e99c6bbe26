"""A linear run shows how near a member comes to its stops; motions proportional to the drive are scaled."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.case import Case
from vipetsc.studies.linear_run import LinearRun, factor, is_proportional, linear_case

CUBIC_CELL = {
    "masses": [0.01, 0.02],
    "springs": [
        {"start": 1, "end": 1, "stiffness": 4e3, "next_cell": True, "cubic": 3e9},
        {"start": 1, "end": 2, "stiffness": 2e3},
    ],
    "contact": [1, 2],
}


@pytest.mark.parametrize(
    ("contacts", "expected"),
    [
        ({"clearance": 4e-4}, [0.5]),
        ({"clearance": 4e-4, "clearance_minus": 1e-4}, [2.0]),
        ({"clearance": 1e-4, "clearance_minus": 4e-4}, [2.0]),
        ({"clearance": 1e-4, "clearance_minus": 4e-4, "side": "minus"}, [0.5]),
        # The contact is to ground, and the envelope is that of the cell's pair: the distance is unknown.
        ({"clearance": 4e-4, "pair": [0, 2]}, np.inf),
        # These contacts touch or are pressed at rest: no motion is linear without the contact.
        ({"clearance": 1e-4, "precompression": 3e-4, "side": "plus", "restitution": 1.0}, np.inf),
        ({"clearance": 0.0, "side": "plus", "restitution": 1.0}, np.inf),
    ],
)
def test_a_member_comes_as_near_as_its_smaller_clearance_permits(contacts, expected):
    """A member reaches the amplitude times the envelope over the smaller clearance; unknown distances are infinite."""
    run = LinearRun(envelope=np.full(24, 1e-4), arrival=np.zeros(24), statistics={}, measures={})
    case = small_case(contacts={"sites": [6]} | contacts, drive={"amplitude": 2.0})
    assert run.reached(case) == pytest.approx(expected)


def test_a_linear_lattice_with_one_drive_is_scaled():
    """A linear lattice with one drive is run at 1 N and its motion scaled by the amplitude."""
    case = small_case()
    assert is_proportional(case)
    assert factor(case) == abs(case.drive.amplitude)
    assert linear_case(case).drive.amplitude == 1.0


def two_drives() -> Case:
    step = {"waveform": "step", "amplitude": 1.0, "ramp": 1e-3, "cell": 9}
    return small_case(drive={"amplitude": 3.0, "more": [step]})


def cubic_springs() -> Case:
    return Case.from_table(
        {
            "name": "small",
            "lattice": {"cell": CUBIC_CELL, "cells": 24},
            "contacts": {"sites": [6], "clearance": 2e-4, "stiffness": 1e8},
            "drive": {"amplitude": 3.0, "cycles": 6, "frequency": 500.0},
            "time": {"end": 0.05},
        }
    )


@pytest.mark.parametrize("build", [two_drives, cubic_springs])
def test_a_lattice_that_does_not_move_in_proportion_is_not_scaled(build):
    """The linear run of a case with two drives or nonlinear springs has its own amplitudes and no contacts."""
    case = build()
    assert not is_proportional(case)
    assert factor(case) == 1.0
    assert linear_case(case).drive.amplitude == 3.0
    assert not linear_case(case).contacts.sites
