"""Frequency responses of lattices that no wall holds, but contacts pressed to the ground, dashpots or nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.rigs import after_a_period
from tests.steady_states import motion_at
from vipetsc.case.nfrc import NfrcCase
from vipetsc.lattice import Chain, ModalCompliance, UnitCell
from vipetsc.modes.response.over_key import KeyedCase
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

pytestmark = pytest.mark.parallel(1)

SPRING = 3.0
DASHPOT = 0.1
STOP = 20.0
DEPTH = 0.1


def held(
    contacts: dict[str, Any] | None = None, lattice: dict[str, Any] | None = None, frequency: float = 1.0, **nfrc: Any
) -> NfrcCase:
    """Two masses of 1 kg joined by a spring, without walls; the first is pressed against a stop of the ground.

    ``contacts``, ``lattice`` and ``nfrc`` update the tables of these names; ``frequency`` in rad/s is the drive's.
    """
    spring = {"start": 1, "end": 1, "stiffness": SPRING, "next_cell": True}
    table: dict[str, Any] = {
        "lattice": {"cells": 2, "ends": "free", "damping": {"mass": DASHPOT}},
        "contacts": {"law": "hertz", "stiffness": STOP, "restitution": 1.0, "sites": [1], "pair": [0, 1]},
        "drive": {"waveform": "harmonic", "amplitude": 1.0, "frequency": frequency, "cell": 2},
        "time": {"end": 10.0, "sample_interval": 0.1},
        "output": {"points": [{"name": "near", "cell": 1}, {"name": "far", "cell": 2}], "forces": True},
        "nfrc": {"source": "force", "over": "frequency", "range": [0.8, 3.0], "fixed": [0.2], "harmonics": 23},
    }
    table["lattice"] |= {"cell": {"masses": [1.0], "springs": [spring], "contact": [1, 1]}} | (lattice or {})
    table["contacts"] |= {"side": "minus", "clearance": 0.0, "precompression": DEPTH} | (contacts or {})
    table["nfrc"] |= nfrc
    return NfrcCase.from_table(table)


def test_a_weak_force_moves_it_as_a_lattice_with_a_spring_to_the_ground():
    """Under a weak force the pressed contact acts as a spring k = (3/2) A d^(1/2), the slope of its force at rest."""
    omega = 1.7
    states = SteadyStates(held(range=[omega, 2.0], fixed=[1e-4]), 1.0, 1e-4)
    slope = 1.5 * STOP * DEPTH**0.5
    stiffness = np.array([[SPRING + slope, -SPRING], [-SPRING, SPRING]])
    u = np.linalg.solve(stiffness + (1j * omega * DASHPOT - omega**2) * np.eye(2), [0.0, 1e-4])

    outputs = states.measured(first_state(states).xi).outputs
    np.testing.assert_allclose(outputs["first_displacement"], np.abs(u), rtol=1e-5)
    np.testing.assert_allclose(outputs["first_force"], slope * np.abs(u[:1]), rtol=1e-5)
    np.testing.assert_allclose(outputs["largest_force"], STOP * DEPTH**1.5 + slope * np.abs(u[:1]), rtol=1e-5)


@pytest.mark.parametrize(("over", "values"), [("stiffness", [12.0, 30.0, 19.0]), ("precompression", [0.06, 0.2, 0.1])])
def test_along_a_curve_over_its_law_a_contact_that_holds_the_lattice_has_the_spring_of_each_value(over, values):
    """Under a weak force the pressed contact is a spring of the slope that its own law has at each value of a key."""
    omega = 1.7
    case = held(frequency=omega, over=f"contacts.{over}", range=[min(values), max(values)], fixed=[1e-4])
    keyed = KeyedCase(case, restitution=1.0, amplitude=1e-4)
    for value in values:
        states = keyed.at(value)
        law = {"stiffness": STOP, "precompression": DEPTH} | {over: value}
        slope = 1.5 * law["stiffness"] * law["precompression"] ** 0.5
        stiffness = np.array([[SPRING + slope, -SPRING], [-SPRING, SPRING]])
        u = np.linalg.solve(stiffness + (1j * omega * DASHPOT - omega**2) * np.eye(2), [0.0, 1e-4])

        outputs = states.measured(first_state(states).xi).outputs
        np.testing.assert_allclose(outputs["first_displacement"], np.abs(u), rtol=1e-5)


@pytest.mark.parametrize("side", ["plus", "minus"])
def test_a_motion_that_opens_the_contact_returns_after_a_period(side):
    """A steady state whose contact opens returns after a period of an independent integration.

    The static load, which an open contact does not balance, pushes the lattice back against the stop.
    """
    states = SteadyStates(held({"side": side}, range=[1.4, 2.0], fixed=[0.5]), 1.0, 0.5)
    point = first_state(states)
    measured = states.measured(point.xi)
    assert 0 < measured.closed[0] < 0.9
    state = np.concatenate([part.ravel() for part in motion_at(states, point.xi, np.arange(2))])
    assert after_a_period(states, point, state) == pytest.approx(state, abs=2e-4 * np.abs(state).max())


def test_growing_weights_lead_to_the_same_state_beside_a_stop_that_touches():
    """Growing weights find a steady state that returns after a period, next to a stop that touches at rest."""
    each = {"precompression": [DEPTH, 0.0], "pair": [[0, 1], [0, 1]], "side": ["minus", "plus"]}
    contacts = {"sites": [1, 2], "each": each, "side": None, "pair": None, "precompression": None}
    given = {key: value for key, value in contacts.items() if value is not None}
    case = held(given, range=[1.4, 2.0], fixed=[0.1])
    states = SteadyStates(case, 1.0, 0.1)
    point = first_state(states)
    state = np.concatenate([part.ravel() for part in motion_at(states, point.xi, np.arange(2))])
    assert after_a_period(states, point, state) == pytest.approx(state, abs=1e-3 * np.abs(state).max())


def test_the_unit_of_a_curve_is_its_largest_linear_motion():
    """The unit of a curve's amplitudes is the largest linear motion in its range, which a resonance determines.

    In units of the motion at the beginning of the range a resonance would be hundreds of units, and of steps, away.
    """
    states = SteadyStates(held(), 1.0, 0.2)
    motions = [np.abs(states.linear_motion(omega).harmonics).max() for omega in np.linspace(0.8, 3.0, 200)]
    assert states.clearance == pytest.approx(0.2 * max(motions), rel=0.2)


def test_a_lattice_that_walls_hold_has_its_own_springs_alone():
    """Contacts count as springs of the linear lattice where they press on the ground and no wall holds the lattice."""
    assert held().are_contacts_springs
    assert not held(lattice={"ends": "fixed"}).are_contacts_springs
    assert not held(IN_A_CELL | PRESSED, {"cell": SPRUNG}).are_contacts_springs


SPRINGS = [{"start": 1, "end": 1, "stiffness": SPRING, "next_cell": True}, {"start": 1, "end": 2, "stiffness": 1.0}]
SPRUNG = {"masses": [1.0, 0.5], "springs": SPRINGS, "contact": [1, 2]}
IN_A_CELL = {"sites": [2], "pair": [1, 2], "side": "plus", "clearance": 0.1, "precompression": None}
GRAINS = {"masses": [1.0], "contact": [1, 1]}
WITH_RESONATORS = {"masses": [1.0, 0.5], "springs": [SPRINGS[1]], "contact": [1, 2]}
PRESSED = {"clearance": 0.0, "precompression": DEPTH}
BETWEEN_CELLS = {"sites": [1, 2], "pair": [1, 1], "next_cell": True}
RING = {"sites": [1, 2, 3], "pair": [1, 1], "next_cell": True}
BOTH_SIDES = BETWEEN_CELLS | {"side": "both", "clearance": 0.01, "precompression": None}


@pytest.mark.parametrize(
    ("cell", "ends", "damping", "contacts", "force"),
    [
        pytest.param(SPRUNG, "free", {"mass": DASHPOT}, IN_A_CELL, 0.3, id="dashpots"),
        pytest.param(SPRUNG | {"grounding": [DASHPOT, 0.0]}, "free", {}, IN_A_CELL, 0.3, id="a dashpot"),
        pytest.param(SPRUNG, "periodic", {"mass": DASHPOT}, IN_A_CELL, 0.3, id="a ring"),
        pytest.param(GRAINS, "free", {"mass": DASHPOT}, BETWEEN_CELLS, 0.2, id="grains"),
        pytest.param(GRAINS, "free", {}, BETWEEN_CELLS, 0.2, id="grains without loss"),
        pytest.param(GRAINS, "periodic", {"mass": DASHPOT}, RING, 0.2, id="a ring of grains"),
        pytest.param(GRAINS, "free", {"mass": DASHPOT}, BOTH_SIDES, 0.02, id="grains apart"),
        pytest.param(WITH_RESONATORS, "free", {"mass": DASHPOT}, BETWEEN_CELLS, 0.2, id="resonators"),
        pytest.param(WITH_RESONATORS, "periodic", {"mass": DASHPOT}, RING, 0.2, id="a ring of resonators"),
        pytest.param(WITH_RESONATORS, "free", {"mass": DASHPOT}, BOTH_SIDES, 0.1, id="resonators apart"),
    ],
)
def test_what_only_dashpots_or_nothing_holds_returns_after_a_period(cell, ends, damping, contacts, force):
    """Steady states of lattices with contacts between their own masses return after a period.

    The contact forces add up to zero over the lattice, so that its mean position is arbitrary.
    """
    lattice = {"cells": 3, "ends": ends, "cell": cell, "damping": damping}
    case = held(contacts, lattice, range=[1.3, 2.0], fixed=[force], infinite=False)
    states = SteadyStates(case, 1.0, force)
    point = first_state(states)
    assert min(states.measured(point.xi).closed) > 0
    state = np.concatenate([part.ravel() for part in motion_at(states, point.xi, np.arange(3))])
    assert after_a_period(states, point, state) == pytest.approx(state, abs=2e-4 * np.abs(state).max())


def test_bodies_that_dashpots_oppose_differently_move_each_for_itself():
    """The compliance between two unconnected masses, of which a dashpot brakes one, is the sum of their compliances.

    Both modes have frequency 0, and so has any combination. The dashpot couples all modes but those of one mass each.
    """
    cell = UnitCell((1.0, 2.0), (), 0, 1, grounding=(0.3, 0.0))
    chain = Chain(cell, 1, "free", sites=(0,), clearances=(0.1,))
    omega = 0.7
    found = ModalCompliance(chain).at(omega)[0, 0, 0]
    assert found == pytest.approx(1 / (0.3j * omega - omega**2) - 1 / (2 * omega**2), rel=1e-12)
