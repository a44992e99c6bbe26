"""What the linear run tells of a member: how near it comes to its stops, and whether it may be scaled."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.studies.linear_run import LinearRun, factor, is_proportional, linear_case

CUBIC = {
    "masses": [0.01, 0.02],
    "springs": [{"start": 1, "end": 1, "stiffness": 4e3, "next_cell": True, "cubic": 3e9},
                {"start": 1, "end": 2, "stiffness": 2e3}],
    "contact": [1, 2],
}  # fmt: skip


@pytest.mark.parametrize(
    ("contacts", "expected"),
    [
        ({"clearance": 4e-4}, 0.5),
        ({"clearance": 4e-4, "clearance_minus": 1e-4}, 2.0),
        ({"clearance": 1e-4, "clearance_minus": 4e-4}, 2.0),
        ({"clearance": 1e-4, "clearance_minus": 4e-4, "side": "minus"}, 0.5),
        ({"clearance": 4e-4, "pair": [0, 2]}, np.inf),  # to ground: the envelope is that of the cell's pair
    ],
)
def test_a_member_comes_as_near_as_its_lesser_clearance_lets_it(contacts, expected):
    run = LinearRun(np.full(24, 1e-4), np.zeros(24), {}, {})
    case = small_case(contacts={"sites": [6]} | contacts, drive={"amplitude": 2.0})
    assert run.reached(case) == pytest.approx(expected if np.isinf(expected) else [expected])


@pytest.mark.parametrize(
    "sections",
    [
        {"drive": {"amplitude": 3.0, "more": [{"waveform": "step", "amplitude": 1.0, "ramp": 1e-3, "cell": 9}]}},
        {"lattice": {"preset": None, "cell": CUBIC}, "contacts": {"stiffness": 1e8}, "drive": {"frequency": 500.0}},
    ],
)
def test_a_lattice_that_does_not_move_in_proportion_is_not_scaled(sections):
    table = {"name": "small", "lattice": {"preset": "four-band", "cells": 24}, "time": {"end": 0.05}}
    table |= {"contacts": {"sites": [6], "clearance": 2e-4}, "drive": {"amplitude": 3.0, "cycles": 6}}
    merged = {name: table.get(name, {}) | sections.get(name, {}) for name in table.keys() - {"name"}}
    merged["lattice"] = {key: value for key, value in merged["lattice"].items() if value is not None}
    plain, case = small_case(), small_case().from_table({"name": "small"} | merged)
    assert is_proportional(plain) and factor(plain) == abs(plain.drive.amplitude)
    assert linear_case(plain).drive.amplitude == 1.0
    assert not is_proportional(case) and factor(case) == 1.0
    assert linear_case(case).drive.amplitude == 3.0 and not linear_case(case).contacts.sites
