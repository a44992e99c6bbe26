"""Stops as in experiments: laws that differ from site to site, stops on one side, damping factors by name."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import run_of, small_case
from vipetsc.case import Case


def test_lists_of_equal_values_give_the_bits_of_the_one_value():
    common = {"law": "hertz", "stiffness": 5e6, "clearance": 3e-5, "sites": [4, 5]}
    each = {"restitution": [0.6, 0.6], "side": ["both", "both"], "clearance_minus": [3e-5, 3e-5], "law": ["hertz"] * 2}

    one = run_of(small_case(contacts=common | {"restitution": 0.6}, time={"end": 0.04}))
    lists = run_of(small_case(contacts=common | {"each": each}, time={"end": 0.04}))

    assert len(one["impacts/site"]) > 2
    np.testing.assert_array_equal(one["displacement"].values, lists["displacement"].values)


def test_disorder_scatters_each_of_a_list():
    table = {"sites": [4, 9], "clearance": 3e-5, "each": {"restitution": [0.5, 0.7]}}
    case = small_case(contacts=table, disorder={"seed": 3, "restitution": {"relative": 0.05}})
    drawn = case.contacts.each.restitution
    assert drawn != [0.5, 0.7]
    assert drawn == pytest.approx([0.5, 0.7], rel=0.3)
    assert [site.law.restitution for site in case.model().chain.sites] == drawn
    assert Case.from_toml(case.to_toml()).model() == case.model()
