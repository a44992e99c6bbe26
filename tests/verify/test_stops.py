"""Stops as in experiments: laws that differ from site to site, stops on one side, damping factors by name."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.conftest import run_of, small_case
from vipetsc.case import Case
from vipetsc.contact.law import CLOSED, contact_force, create_contacts
from vipetsc.lattice import Contact


def test_lists_of_equal_values_give_the_bits_of_the_one_value():
    common = {"law": "hertz", "stiffness": 5e6, "clearance": 3e-5, "sites": [4, 5]}
    each = {"restitution": [0.6, 0.6], "side": ["both", "both"], "clearance_minus": [3e-5, 3e-5], "law": ["hertz"] * 2}

    one = run_of(small_case(contacts=common | {"restitution": 0.6}, time={"end": 0.04}))
    lists = run_of(small_case(contacts=common | {"each": each}, time={"end": 0.04}))

    assert len(one["impacts/site"]) > 2
    np.testing.assert_array_equal(one["displacement"].values, lists["displacement"].values)


@pytest.mark.parametrize("n", [1.0, 1.5, 3.0])
@pytest.mark.parametrize(
    ("factor", "damping", "rebound"),
    [
        ("paper", 0.75, 0.66296),  # 3 (1 - r)/2
        ("hunt-crossley", 0.75, 0.66296),
        ("lankarani-nikravesh", 0.5625, 0.72524),  # 3 (1 - r^2)/4
        ("flores", 1.6, 0.47044),  # 8 (1 - r)/(5 r)
        ("exact", None, 0.5),
    ],
)
def test_two_masses_rebound_as_each_law_predicts(factor, damping, rebound, n):
    """An integrated impact with r = 1/2 has the effective restitution of the law's factor, for any exponent."""
    contact = Contact("power", 1e5, 0.5, factor=factor, exponent=n)
    if damping is not None:
        assert contact.damping == damping

    mass = 0.003
    speed = 0.2
    clearance = 1e-4
    sites = create_contacts(contact, [clearance])
    sites["mode"] = CLOSED
    sites["approach"] = speed

    def rate(_, z):
        return [z[1], -contact_force(sites, 0, clearance + z[0], z[1])[0] / mass]

    def separation(_, z):
        return z[0]

    separation.terminal = True
    separation.direction = -1
    ended = solve_ivp(rate, (0, 1), [0.0, speed], "DOP853", events=separation, rtol=1e-11, atol=1e-15)

    measured = -ended.y[1, -1] / speed
    assert measured == pytest.approx(contact.effective_restitution, rel=1e-7)
    assert measured == pytest.approx(rebound, abs=5e-5)


def test_disorder_scatters_each_of_a_list():
    table = {"sites": [4, 9], "clearance": 3e-5, "each": {"restitution": [0.5, 0.7]}}
    case = small_case(contacts=table, disorder={"seed": 3, "restitution": {"relative": 0.05}})
    drawn = case.contacts.each.restitution
    assert drawn != [0.5, 0.7]
    assert drawn == pytest.approx([0.5, 0.7], rel=0.3)
    assert [law.restitution for law in case.model().laws] == drawn
    assert Case.from_toml(case.to_toml()).model() == case.model()
