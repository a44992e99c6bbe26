"""Frequency responses of lattices with nonlinear springs: Duffing's oscillator, and chains without and with a stop."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.rigs import OUTPUT, followed
from tests.steady_states import motion_at
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

pytestmark = pytest.mark.parallel(1)

# Duffing's oscillator u'' + 0.1 u' + u + u^3 = 0.1 cos(Om t). Half of the stiffness is on either side of the mass.
HARDENING = {"start": 1, "end": 1, "stiffness": 0.5, "cubic": 0.5, "next_cell": True}
DUFFING: dict[str, Any] = {
    "name": "duffing",
    "lattice": {
        "cells": 1,
        "cell": {"masses": [1.0], "springs": [HARDENING], "contact": [1, 1]},
        "damping": {"mass": 0.1},
    },
    "contacts": {"sites": []},
    "drive": {"waveform": "harmonic", "amplitude": 0.1, "frequency": 1.0, "cell": 1, "mass": 1},
    "time": {"end": 10.0},
    "nfrc": {"source": "force", "over": "frequency", "range": [0.7, 1.7], "fixed": [0.1], "harmonics": 9},
}
STOP = {"law": "bilinear", "stiffness": 5.0, "restitution": 1.0, "sites": [1], "clearance": 0.3, "side": "plus"}
STOP["pair"] = [0, 1]


def chain_of(count: int, spring: dict[str, Any], **nfrc: Any) -> dict[str, Any]:
    """The table of a chain of ``count`` masses between walls, with dashpots, driven at its first mass."""
    springs = [{"start": 1, "end": 1, "stiffness": 1.0, "next_cell": True} | spring]
    lattice = {"cells": count, "cell": {"masses": [1.0], "springs": springs, "contact": [1, 1]}}
    options = DUFFING["nfrc"] | nfrc
    return DUFFING | {"lattice": lattice | {"damping": {"mass": 0.1}}, "nfrc": options}


@pytest.fixture(scope="module")
def duffing(tmp_path_factory):
    """The folder, the steady states and the points of the curve of Duffing's oscillator."""
    folder = tmp_path_factory.mktemp("smooth") / "duffing"
    return folder, *followed(NfrcCase.from_table(DUFFING), folder)


def test_its_first_harmonic_is_that_of_duffings_oscillator(duffing):
    """With one harmonic the response is exactly that of textbooks, a^2 ((1 - Om^2 + 3 a^2/4)^2 + (0.1 Om)^2) = F^2."""
    _, states, points = duffing
    case = states.case.model_copy(update={"nfrc": states.options.model_copy(update={"harmonics": 1})})
    one = SteadyStates(case, 1.0, 0.1)
    # States along the whole curve, on both sides of the folds, are guesses for the state with one harmonic.
    for point in points[::8]:
        # The mass moves as the first spring's end, so that its harmonics are those of the elongation.
        guess = point.measured.outputs["spring_harmonics"] + 1j * point.measured.outputs["spring_harmonics_imaginary"]
        p = states.drive(point.xi[-1])[0] / one.parameter.scale
        xi = one.at(np.append(one.balance.pack(guess[:, :2]) / one.clearance, p), p)
        omega = one.drive(xi[-1])[0]
        a = np.abs(one.balance.unpack(xi[:-1] * one.clearance)[0, 1])
        left = a**2 * ((1 - omega**2 + 0.75 * a**2) ** 2 + (0.1 * omega) ** 2)
        assert left == pytest.approx(0.01, rel=1e-9)


def test_its_folds_are_those_of_the_response_with_one_harmonic(duffing):
    """The folds are at the largest frequency left of the backbone and the least one right of it, to 1 %.

    Both follow from the response with one harmonic. The third harmonic moves the folds by less than 1 %.
    """
    _, states, points = duffing
    a = np.linspace(1e-3, 1.5, 20001)
    # Every amplitude a below the peak has two frequencies, left and right of the backbone.
    with np.errstate(invalid="ignore"):
        middle = 1 + 0.75 * a**2 - 0.005
        width = np.sqrt(middle**2 - (1 + 0.75 * a**2) ** 2 + (0.1 / a) ** 2)
        left = np.sqrt(middle - width)
        right = np.sqrt(middle + width)
    found = sorted(states.drive(point.xi[-1])[0] for point in points if point.kind == "fold")
    np.testing.assert_allclose(found, [np.nanmin(right), np.nanmax(left)], rtol=1e-2)


def test_walls_feel_the_whole_force_of_their_springs():
    """The force on a wall is that of its spring at each instant, cubic part included."""
    options = {"over": "amplitude", "range": [0.3, 0.4], "fixed": [0.8], "harmonics": 21}
    output = OUTPUT | {"transmission": None}
    table = chain_of(2, {"cubic": 2.0, "quadratic": 0.5}, **options)
    case = NfrcCase.from_table(table | {"output": {key: value for key, value in output.items() if value is not None}})
    states = SteadyStates(case, 1.0, 0.8)
    xi = first_state(states).xi
    outputs = states.measured(xi).outputs
    phases = np.linspace(0, 2 * np.pi, 2001)
    (left,), (right,) = motion_at(states, xi, np.arange(2), phases)[0]
    # The elongation of the right wall's spring is the last mass's displacement, reversed.
    z = np.stack([left, -right])
    force = z + 0.5 * z**2 + 2.0 * z**3
    np.testing.assert_allclose(outputs["largest_wall_force"], np.abs(force).max(axis=1), rtol=1e-4)
