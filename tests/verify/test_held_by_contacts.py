"""Frequency responses of lattices that no wall holds, but contacts pressed to the ground, dashpots or nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vipetsc.case.nfrc import NfrcCase
from vipetsc.lattice import Chain, ModalCompliance, UnitCell
from vipetsc.lattice.sites import sites_at
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
PRESSED = {"clearance": 0.0, "precompression": DEPTH}


def test_bodies_that_dashpots_oppose_differently_move_each_for_itself():
    """The compliance between two unconnected masses, of which a dashpot brakes one, is the sum of their compliances.

    Both modes have frequency 0, and so has any combination. The dashpot couples all modes but those of one mass each.
    """
    cell = UnitCell((1.0, 2.0), (), 0, 1, grounding=(0.3, 0.0))
    chain = Chain(cell, 1, "free", sites=sites_at([0], cell.pair))
    omega = 0.7
    found = ModalCompliance(chain).at(omega)[0, 0, 0]
    assert found == pytest.approx(1 / (0.3j * omega - omega**2) - 1 / (2 * omega**2), rel=1e-12)
