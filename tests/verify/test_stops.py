"""Stops of experiments: laws that differ from site to site, one side alone, damping factors by name."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.conftest import DIFFERING, small_case
from vipetsc.case import Case, CaseError, LawCase, NnmCase
from vipetsc.contact.law import CLOSED, contact_force, create_contacts
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory
from vipetsc.lattice import Contact

FACTORS = ("paper", "hunt-crossley", "lankarani-nikravesh", "flores", "exact")


def run(case):
    memory = RunMemory(MPI.COMM_SELF)
    result = simulate(case, memory)
    assert result.complete, result.sentence
    return memory.dataset


def differing(engine="propagator", **contacts):
    """Three sites near the drive, each with a law and stops of its own."""
    table = {"law": "hertz", "exponent": 1.25, "sites": [4, 5, 9], "clearance": [3e-5, 2e-5, 1e-5], "each": DIFFERING}
    return small_case(contacts=table | contacts, time={"end": 0.06, "engine": engine, "rtol": 1e-10})


def test_sites_that_differ_are_followed_alike_by_both_engines():
    first, second = (run(differing(engine)) for engine in ("propagator", "ts"))
    u = [data["displacement"].values for data in (first, second)]
    assert np.abs(u[0] - u[1]).max() < 1e-6 * np.abs(u[0]).max()
    sides = {site: set(first["impacts/side"].values[first["impacts/site"].values == site]) for site in (1, 2, 3)}
    assert sides == {1: {1}, 2: {1, -1}, 3: {-1}}
    assert (first["impacts/site"].values == second["impacts/site"].values).all()
    assert np.isinf(first["sites/clearance"].values[2]) and np.isinf(first["sites/clearance_minus"].values[0])
    residual = first["energy/work"] - sum(first[f"energy/{k}"] for k in ("dissipated", "kinetic", "spring", "contact"))
    assert np.abs(residual.values).max() < 1e-8 * first["energy/work"].values.max()
    lost = np.bincount(first["impacts/site"].values, first["impacts/loss"].values)[1:]
    assert lost[0] > 0 and lost[1] > 0 and lost[2] == 0


def test_sites_that_are_said_to_differ_and_do_not_are_those_of_one_law():
    """Lists of equal values give the bits of the one value."""
    alike = {"law": "hertz", "stiffness": 5e6, "restitution": 0.6, "clearance": 3e-5, "sites": [4, 5]}
    each = {"restitution": [0.6, 0.6], "side": ["both", "both"], "clearance_minus": [3e-5, 3e-5], "law": ["hertz"] * 2}
    one, lists = (
        run(small_case(contacts=table, time={"end": 0.04}))
        for table in (alike, {k: v for k, v in alike.items() if k != "restitution"} | {"each": each})
    )
    np.testing.assert_array_equal(one["displacement"].values, lists["displacement"].values)
    assert len(one["impacts/site"]) > 2


@pytest.mark.parametrize("n", [1.0, 1.5, 3.0])
@pytest.mark.parametrize("factor", FACTORS)
def test_two_masses_rebound_as_each_law_predicts(factor, n):
    """A normal impact at asked restitution .5, integrated, against the law's integral; it knows neither n nor mass."""
    contact = Contact("power", 1e5, 0.5, factor=factor, exponent=n)
    sites, mass, speed = create_contacts(contact, [1e-4]), 0.003, 0.2
    sites["mode"], sites["approach"] = CLOSED, speed

    def apart(_t, z):
        return z[0]

    apart.terminal, apart.direction = True, -1
    ended = solve_ivp(
        lambda _t, z: [z[1], -contact_force(sites, 0, 1e-4 + z[0], z[1])[0] / mass],
        (0, 1), [0.0, speed], rtol=1e-11, atol=1e-15, events=apart, method="DOP853",
    )  # fmt: skip
    rebound = -ended.y[1, -1] / speed
    assert rebound == pytest.approx(contact.effective_restitution, rel=1e-7)
    damping = {"lankarani-nikravesh": 0.5625, "flores": 1.6, "exact": contact.damping}.get(factor, 0.75)
    assert contact.damping == damping
    known = {"lankarani-nikravesh": 0.72524, "flores": 0.47044, "exact": 0.5}.get(factor, 0.66296)
    assert rebound == pytest.approx(known, abs=5e-5)


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
def test_what_sites_cannot_be_is_said_with_its_key(contacts, key):
    with pytest.raises(CaseError) as error:
        small_case(contacts={"sites": [4, 9], "clearance": 3e-5} | contacts)
    assert [problem.key for problem in error.value.problems] == [key]


@pytest.mark.parametrize("kind", [LawCase, NnmCase])
def test_verbs_of_alike_sites_refuse_others(kind):
    table = {"lattice": {"preset": "four-band", "cells": 40}, "contacts": {"sites": [20], "clearance": 1e-3}}
    for key, value in (("side", "plus"), ("clearance_minus", 2e-3), ("each", {"restitution": [0.5]})):
        with pytest.raises(CaseError) as error:
            kind.from_table(table | {"contacts": table["contacts"] | {key: value}})
        assert [problem.key for problem in error.value.problems] == [f"contacts.{key}"]


def test_disorder_scatters_each_of_a_list():
    table = {"sites": [4, 9], "clearance": 3e-5, "each": {"restitution": [0.5, 0.7]}}
    case = small_case(contacts=table, disorder={"seed": 3, "restitution": {"relative": 0.05}})
    drawn = case.contacts.each.restitution
    assert drawn != [0.5, 0.7] and drawn == pytest.approx([0.5, 0.7], rel=0.3)
    assert [law.restitution for law in case.model().laws] == drawn
    assert Case.from_toml(case.to_toml()).model() == case.model()
