"""Frequency responses of laboratory rigs: with dashpots, one-sided stops, sites that differ, and a wall that moves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.conftest import run_of
from tests.rigs import OUTPUT, TWO_MASSES, after_a_period, followed
from tests.steady_states import motion_at
from vipetsc.case import Case
from vipetsc.case.nfrc import NfrcCase
from vipetsc.lattice import Chain, ModalCompliance, Spring, UnitCell, WaveCompliance
from vipetsc.lattice.sites import Pair, sites_at
from vipetsc.modes.problem import FlowError
from vipetsc.modes.response.condensation import stops_of
from vipetsc.modes.response.state import Response
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

pytestmark = pytest.mark.parallel(1)

# Ten cells whose masses and springs scatter, with dashpots to the ground and three sites without a common property.
TEN_CELLS: dict[str, Any] = {
    "name": "ten",
    "lattice": {
        "cells": 10,
        "cell": {
            "masses": [1.0, 0.3],
            "springs": [
                {"start": 1, "end": 1, "stiffness": 1.0, "next_cell": True},
                {"start": 1, "end": 2, "stiffness": 0.5},
            ],
            "contact": [1, 2],
        },
        "damping": {"mass": 0.03, "stiffness": 0.02},
    },
    "disorder": {"seed": 4, "cells": {"masses[1]": {"relative": 0.05}, "springs[2].stiffness": {"relative": 0.05}}},
    "contacts": {"law": "bilinear", "stiffness": 8.0, "restitution": 1.0, "sites": [2, 4, 5], "clearance": 0.5},
    "drive": {"waveform": "harmonic", "amplitude": 0.3, "frequency": 0.9, "cell": 1, "mass": 1},
    "time": {"end": 10.0},
    "nfrc": {"source": "force", "over": "frequency", "range": [0.5, 1.0], "fixed": [0.35], "harmonics": 21},
}
TEN_CELLS["nfrc"] |= {"points": 16, "largest_step": 0.3}
TEN_CELLS["contacts"]["each"] = {
    "side": ["plus", "both", "minus"],
    "clearance_minus": [0.4, 0.9, 0.5],
    "stiffness": [8.0, 5.0, 12.0],
    "pair": [[1, 2], [0, 1], [1, 1]],
    "next_cell": [False, False, True],
}


@pytest.fixture(scope="module")
def two_masses(tmp_path_factory):
    """The steady states of the rig of two masses, and the points of its curve."""
    # The range contains the first resonance, with two folds and a pair of multipliers that leaves the unit circle.
    first = TWO_MASSES | {"nfrc": TWO_MASSES["nfrc"] | {"range": [1.0, 1.5]}}
    return followed(NfrcCase.from_table(first), tmp_path_factory.mktemp("rig") / "two")


def test_what_follows_from_the_lattice_is_filled_in():
    """Whether a lattice is infinite and its motion symmetric follows from its ends, dashpots and stops."""
    case = NfrcCase.from_table(TWO_MASSES)
    assert (case.nfrc.infinite, case.nfrc.symmetric) == (False, False)
    plain = NfrcCase.from_table({"nfrc": {"range": [0.9, 1.1]}})
    assert (plain.nfrc.infinite, plain.nfrc.symmetric) == (True, True)


def rounded_cell(grounding: tuple[float, ...] = ()) -> UnitCell:
    """A cell of two masses with dashpots parallel to its springs, and ``grounding`` dashpots (N s/m) to the ground."""
    springs = (Spring(0, 0, 1.0, offset=1, damping=0.1), Spring(0, 1, 0.5, damping=0.02))
    return UnitCell((1.0, 0.3), springs, host=0, resonator=1, grounding=grounding)


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
@pytest.mark.parametrize("grounding", [(), (0.05, 0.2)])
def test_the_sum_over_poles_is_the_inverse_of_the_dynamic_stiffness(ends, grounding):
    """The compliance as a sum over poles is the inverse of K + i omega C - omega^2 M, also with rigid motions."""
    pairs = (Pair(0, 1), Pair(0, 0, offset=1))
    chain = Chain(rounded_cell(grounding), 5, ends, sites=sites_at([1, 3], pairs))
    compliance = ModalCompliance(chain, ((0, 0),))
    loads = compliance.loads
    for omega in (0.3, 1.1 - 0.2j, -0.7, 4.0):
        dynamic = chain.stiffness_matrix().toarray() + 1j * omega * chain.damping_rows(0, 5).toarray()
        u = np.linalg.solve(dynamic - omega**2 * np.diag(chain.masses()), loads)
        np.testing.assert_allclose(compliance.response(omega)[0], loads[:, :2].T @ u, rtol=1e-9, atol=1e-12)
        field = compliance.field(omega, [0.5, -2.0, 3.0], range(5))
        np.testing.assert_allclose(field.ravel(), u @ [-0.5, 2.0, 3.0], rtol=1e-9, atol=1e-12)


def test_without_dashpots_it_is_that_of_bloch_waves():
    """Without dashpots the compliance by poles is that by Bloch waves, and real."""
    cell = UnitCell((1.0, 0.3), (Spring(0, 0, 1.0, offset=1), Spring(0, 1, 0.5)), host=0, resonator=1)
    chain = Chain(cell, 9, "free", sites=sites_at([2, 6], cell.pair))
    omega = np.array([0.0, 0.31, 1.27, 2.9])
    modal = ModalCompliance(chain, ((0, 0),)).response(omega)
    waves = WaveCompliance(chain, points=((0, 0),)).response(omega)
    # The last column, of a force on one mass, is left out at rest: that force moves a free lattice without bound.
    np.testing.assert_allclose(modal[:, :, :2], waves[:, :, :2], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(modal[1:], waves[1:], rtol=1e-8, atol=1e-10)
    assert np.isrealobj(modal)


def test_errors_fall_as_harmonics_are_added(two_masses):
    """With four times the harmonics a state returns after a period with at most 1/16 of the error.

    Contact forces have kinks and harmonics that fall as k^-2, so that those of the velocity fall as k^-3.
    """
    states, points = two_masses
    few = max(points, key=lambda point: point.measured.largest[0])
    errors = []
    for order in (20, 80):
        case = states.case.model_copy(update={"nfrc": states.options.model_copy(update={"harmonics": order})})
        finer = SteadyStates(case, states.restitution, states.parameter.fixed)
        z = np.zeros((1, order + 1), complex)
        kept = min(order, states.options.harmonics) + 1
        z[:, :kept] = few.measured.harmonics[:, :kept]
        xi = finer.at(np.append(finer.balance.pack(z) / finer.clearance, few.xi[-1]), few.xi[-1])
        u, v = motion_at(finer, xi, np.arange(2))
        state = np.concatenate([u.ravel(), v.ravel()])
        errors.append(np.abs(after_a_period(finer, Response(xi=xi), state) - state).max())
    assert errors[1] < errors[0] / 16


def test_a_force_that_touches_nothing_has_the_linear_response(two_masses):
    """Below contact a wall moved by U gives the first harmonic (K + i omega C - omega^2 M)^-1 k U."""
    states, points = two_masses
    quiet = [point for point in points if not point.measured.episodes]
    assert quiet
    chain = states.case.model().chain
    for point in quiet[::10]:
        omega, amplitude = states.drive(point.xi[-1])
        dynamic = chain.stiffness_matrix().toarray() + 1j * omega * chain.damping_rows(0, 2).toarray()
        u = np.linalg.solve(dynamic - omega**2 * np.eye(2), [amplitude * 1.5, 0.0])
        np.testing.assert_allclose(point.measured.harmonics[0, 1], u[0], rtol=1e-8)


def test_a_lossy_run_settles_into_the_response():
    """A run from rest with restitution 0.6 settles to the amplitudes of the response at its frequency."""
    table = TWO_MASSES | {"contacts": TWO_MASSES["contacts"] | {"restitution": 0.6}}
    frequency = 1.25
    period = 2 * np.pi / frequency
    run = run_of(
        Case.from_table(
            {
                **{key: table[key] for key in ("name", "lattice", "contacts")},
                "drive": table["drive"] | {"amplitude": 0.2, "frequency": frequency},
                "time": {"end": 90 * period, "sample_interval": period / 64, "rtol": 1e-10},
                "output": OUTPUT,
            }
        )
    )
    w = run["displacement"].values[-64:, 0, 0]
    settled = np.fft.rfft(w) / 32

    options = {"source": "force", "over": "amplitude", "range": [0.2, 0.3], "fixed": [frequency], "harmonics": 61}
    states = SteadyStates(NfrcCase.from_table(table | {"nfrc": options, "output": OUTPUT}), 0.6, frequency)
    measured = states.measured(first_state(states).xi)
    assert measured.episodes == 1
    assert measured.unstable == 0
    np.testing.assert_allclose(np.abs(measured.harmonics[0, 1:4]), np.abs(settled[1:4]), rtol=2e-4)

    # The records of named masses and of the lossy contact in the last period have the same peaks, up to the errors of
    # 64 samples in a period.
    for quantity, error in (("displacement", 2e-3), ("velocity", 4e-3), ("acceleration", 4e-2)):
        recorded = np.abs(run[f"points/{quantity}"].values[-64:]).max(axis=0)
        np.testing.assert_allclose(measured.outputs[f"peak_{quantity}"], recorded, rtol=error)
    assert measured.outputs["largest_force"] == pytest.approx(run["impacts/force"].values[-1], rel=5e-3)
    speeds = np.sqrt(np.mean(run["points/velocity"].values[-64:] ** 2, axis=0))
    assert measured.outputs["transmission"] == pytest.approx(speeds[1] / speeds[0], rel=1e-3)


def test_a_drive_that_moves_no_contact_has_no_unit_of_amplitude_and_a_motion_at_rest():
    """A force on masses that nothing joins to the contacts moves none: over the frequency these stay at rest."""
    spring = {"stiffness": 1.5, "next_cell": True}
    cell = {"masses": [1.0] * 3, "springs": [spring | {"start": mass, "end": mass} for mass in (1, 2, 3)]}
    table = {
        "lattice": {"cells": 2, "cell": cell | {"contact": [1, 2]}, "damping": {"mass": 0.06}},
        "contacts": {"law": "bilinear", "stiffness": 20.0, "restitution": 1.0, "sites": [1], "clearance": 0.8},
        "drive": {"waveform": "harmonic", "amplitude": 0.1, "frequency": 1.0, "cell": 1, "mass": 3},
        "time": {"end": 10.0},
    }
    nfrc = {"source": "force", "harmonics": 11}
    over_amplitude = NfrcCase.from_table(table | {"nfrc": nfrc | {"over": "amplitude", "range": [0.1, 1.0]}})
    with pytest.raises(FlowError, match="the drive moves no contact"):
        SteadyStates(over_amplitude, 1.0, 1.0)

    nfrc |= {"over": "frequency", "range": [0.5, 2.0], "fixed": [0.2]}
    states = SteadyStates(NfrcCase.from_table(table | {"nfrc": nfrc}), 1.0, 0.2)
    measured = states.measured(first_state(states).xi)
    assert measured.largest.tolist() == [0.0]
    assert measured.truncation == 0.0


def test_a_contact_that_is_pressed_at_rest_pulls_as_far_as_it_is_pressed():
    """For small motions a pressed contact is a spring: the response is that of the lattice with its stiffness added."""
    contacts = TWO_MASSES["contacts"] | {"clearance": 0.0, "precompression": 0.3}
    nfrc = TWO_MASSES["nfrc"] | {"fixed": [0.01], "range": [0.8, 0.9]}
    case = NfrcCase.from_table(TWO_MASSES | {"contacts": contacts, "nfrc": nfrc})
    (stops,) = stops_of(case, 1.0)
    assert (stops.plus, stops.minus, stops.load) == (-0.3, np.inf, pytest.approx(6.0))

    states = SteadyStates(case, 1.0, 0.01)
    point = states.measured(first_state(states).xi)
    stiffness = np.array([[3.0 + 20.0, -1.5], [-1.5, 3.0]])
    dynamic = stiffness + 0.8j * 0.06 * np.eye(2) - 0.8**2 * np.eye(2)
    assert point.closed[0] == 1.0
    # The static load balances the contact's force at rest, so that the mean displacement is zero.
    assert abs(point.harmonics[0, 0]) < 1e-12
    np.testing.assert_allclose(point.harmonics[0, 1], np.linalg.solve(dynamic, [0.01 * 1.5, 0.0])[0], rtol=1e-8)
