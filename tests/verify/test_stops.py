"""Stops as in experiments: laws that differ from site to site, stops on one side, damping factors by name."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.conftest import DIFFERING, run_of, small_case
from vipetsc.case import Case, CaseError
from vipetsc.contact.law import CLOSED, contact_force, create_contacts
from vipetsc.lattice import Contact


def differing(engine="propagator", **contacts):
    """The case of three sites near the drive, each with a law and stops of its own."""
    table = {"law": "hertz", "exponent": 1.25, "sites": [4, 5, 9], "clearance": [3e-5, 2e-5, 1e-5], "each": DIFFERING}
    return small_case(contacts=table | contacts, time={"end": 0.06, "engine": engine, "rtol": 1e-10})


def test_sites_that_differ_are_followed_alike_by_both_engines():
    """Both engines give the same motion and impacts of sites with laws and stops of their own, and energy balances."""
    first = run_of(differing("propagator"))
    second = run_of(differing("ts"))

    u = first["displacement"].values
    assert np.abs(u - second["displacement"].values).max() < 1e-6 * np.abs(u).max()
    site = first["impacts/site"].values
    assert np.array_equal(site, second["impacts/site"].values)

    # Sites 1 and 3 have a stop on one side alone; the clearance of the other side is infinite.
    sides = {number: set(first["impacts/side"].values[site == number]) for number in (1, 2, 3)}
    assert sides == {1: {1}, 2: {1, -1}, 3: {-1}}
    assert np.isinf(first["sites/clearance"].values[2])
    assert np.isinf(first["sites/clearance_minus"].values[0])

    work = first["energy/work"].values
    spent = sum(first[f"energy/{name}"].values for name in ("dissipated", "kinetic", "spring", "contact"))
    assert np.abs(work - spent).max() < 1e-8 * work.max()
    # Site 3 has restitution 1, the others have less.
    lost = np.bincount(site, first["impacts/loss"].values)[1:]
    assert lost[0] > 0
    assert lost[1] > 0
    assert lost[2] == 0


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


@pytest.mark.parametrize(
    ("contacts", "key"),
    [
        ({"law": "power"}, "contacts.exponent"),
        ({"exponent": 2.0}, "contacts.exponent"),
        ({"each": {"restitution": [0.5]}}, "contacts.each.restitution"),
        ({"each": {"exponent": [2.0, 0.5]}}, "contacts.each.exponent[2]"),
        ({"damping": "flores", "restitution": 0.01}, "contacts.restitution"),
        ({"each": {"restitution": [0.5, 0.0], "damping": ["paper", "exact"]}}, "contacts.each.restitution"),
        ({"clearance": 0.0}, "contacts.clearance"),
        ({"each": {"modulus": [1e8, 2e8]}, "stiffness": 1e5}, "contacts.stiffness"),
    ],
)
def test_what_sites_cannot_be_is_refused_with_its_key(contacts, key):
    with pytest.raises(CaseError) as error:
        small_case(contacts={"sites": [4, 9], "clearance": 3e-5} | contacts)
    assert [problem.key for problem in error.value.problems] == [key]


def test_disorder_scatters_each_of_a_list():
    table = {"sites": [4, 9], "clearance": 3e-5, "each": {"restitution": [0.5, 0.7]}}
    case = small_case(contacts=table, disorder={"seed": 3, "restitution": {"relative": 0.05}})
    drawn = case.contacts.each.restitution
    assert drawn != [0.5, 0.7]
    assert drawn == pytest.approx([0.5, 0.7], rel=0.3)
    assert [law.restitution for law in case.model().laws] == drawn
    assert Case.from_toml(case.to_toml()).model() == case.model()


def mirrored_case(sign: int, engine: str, stops: tuple[float | None, float | None], **contacts: object) -> Case:
    """Return the case of a struck lattice with ``stops`` on the sides + and -, or with all signs the other way."""
    springs = [{"start": 1, "end": 2, "stiffness": 1e4}, {"start": 2, "end": 1, "stiffness": 1e4, "next_cell": True}]
    plus, minus = stops[::sign]
    sides: dict[str, object] = {"clearance": plus, "clearance_minus": minus}
    if minus is None:
        sides = {"clearance": plus, "side": "plus"}
    elif plus is None:
        sides = {"clearance": minus, "side": "minus"}
    struck = {"cell": 3, "velocity": 0.3 * sign, "more": [{"cell": 7, "mass": 2, "velocity": -0.2 * sign}]}
    return Case.from_table({
        "lattice": {"cell": {"masses": [1e-3, 2e-3], "contact": [1, 2], "springs": springs}, "cells": 14},
        "contacts": {"stiffness": 1e7, "sites": [4, 7]} | sides | contacts,
        "initial": {"kind": "velocity"} | struck,
        "time": {"end": 5e-3, "sample_interval": 1e-4, "engine": engine},
    })  # fmt: skip


@pytest.mark.parametrize("engine", ["ts", "propagator"])
@pytest.mark.parametrize(
    ("stops", "contacts"),
    [
        ((1e-5, 3e-5), {}),
        ((1e-5, 3e-5), {"restitution": 0.6, "adhesion": "clip"}),
        ((0.0, None), {"restitution": 0.6, "approach_floor": 1e-3}),
        ((0.0, None), {"precompression": 1e-6}),
    ],
)
def test_both_sides_of_a_stop_are_alike(engine, stops, contacts):
    """With all velocities and sides the other way round, the motion is the same but for its sign, to the last bit."""
    one, other = (run_of(mirrored_case(sign, engine, stops, **contacts)) for sign in (1, -1))
    assert np.array_equal(one["displacement"], -other["displacement"])
    assert np.array_equal(one["impacts/side"], -other["impacts/side"])
    for name in ("onset", "indentation", "force", "loss"):
        assert np.array_equal(one[f"impacts/{name}"], other[f"impacts/{name}"])
    assert len(one["impacts/onset"]) > 1
