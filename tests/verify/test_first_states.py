"""First states of ``nfrc`` in contact, found by growing amplitudes or, where these fail, by growing contact forces."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.conftest import StopAt
from tests.independent_lattice import ScipyLattice, Stop
from tests.models import TWO_MASS_CELL
from tests.steady_states import motion_at, refined
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.response import steps
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state
from vipetsc.parallel import StoppedError

CLEARANCE = 1e-4
RESTITUTION = 0.7
PHASE = 1.5  # rad, at which no contact is closed


def states_from(omega: float, touches: float, **nfrc: Any) -> SteadyStates:
    """Steady states of three cells with a stiff lossy stop in the second, at ``omega`` (rad/s).

    The range begins at ``touches`` times the force at which the linear motion touches the stop.
    """

    def states(low: float) -> SteadyStates:
        case = NfrcCase.from_table(
            {
                "name": "x",
                "lattice": {"cells": 3, "cell": TWO_MASS_CELL},
                "contacts": {"stiffness": 1e7, "sites": [2], "clearance": CLEARANCE, "restitution": RESTITUTION},
                "drive": {"frequency": omega, "cell": 1, "amplitude": 1.0, "cycles": 3},
                "nfrc": {"source": "force", "infinite": False, "harmonics": 21, "range": [low, 1e4]} | nfrc,
            }
        )
        return SteadyStates(case, RESTITUTION, omega)

    return states(touches * states(1e-3).parameter.scale)


def after_a_period(states: SteadyStates, omega: float, amplitude: float, start: np.ndarray) -> np.ndarray:
    """Displacements and velocities (2, n) a period after ``start`` (2, n) at the phase ``PHASE``, by SciPy."""
    chain = states.case.model().chain
    n = len(chain.masses())
    stops = tuple(
        Stop(resonator=3, host=2, gap=CLEARANCE, stiffness=1e7, exponent=1.5, restitution=RESTITUTION, side=side)
        for side in (1, -1)
    )
    push = np.zeros(n)
    push[0] = amplitude
    lattice = ScipyLattice(
        masses=chain.masses(),
        stiffness=chain.stiffness_matrix().toarray(),
        damping=np.zeros((n, n)),
        stops=stops,
        force=lambda t: push * np.cos(omega * t),
    )
    # The integrator begins with open stops, hence at a phase without contact.
    times = (PHASE + np.array([0.0, 2 * np.pi])) / omega
    motion, impacts = lattice.motion(times, *start, start=float(times[0]))
    # The state sought has one impact on either side.
    assert impacts == 2
    return motion[:2, -1]


@pytest.fixture
def by_weights(monkeypatch) -> list[Any]:
    """The calls of the path by growing weights of the contact forces, one entry for each."""
    asked: list[Any] = []
    lead = steps._by_weights

    def recorded(*given: Any) -> np.ndarray:
        asked.append(given)
        return lead(*given)

    monkeypatch.setattr(steps, "_by_weights", recorded)
    return asked


def test_a_range_begins_where_growing_amplitudes_do_not_lead(by_weights):
    """At 3 times the touching force a state is found by growing weights, and SciPy returns it after a period.

    Growing amplitudes end at 2.4 times that force, where one episode of contact becomes two.
    """
    omega = 1000.0
    few = states_from(omega, 3.0)
    first = first_state(few)
    # Growing amplitudes alone would not have led there.
    assert len(by_weights) == 1

    # With 101 harmonics the error of truncation is below the tolerance of the comparison.
    many = states_from(omega, 3.0, harmonics=101)
    xi = refined(few, many, first.xi)
    _, amplitude = many.drive(xi[-1])
    start = np.stack([part.ravel() for part in motion_at(many, xi, np.arange(3), PHASE)])
    end = after_a_period(many, omega, amplitude, start)
    change = np.abs(end - start).max(axis=1) / np.abs(start).max(axis=1)
    assert (change < 3e-4).all(), change


def test_growing_weights_lead_to_the_state_of_growing_amplitudes(monkeypatch, by_weights):
    """Where there is only one state, growing weights find the one that growing amplitudes find.

    Growing weights take over when growing amplitudes reach their limit of steps.
    """
    omega = 1700.0
    states = states_from(omega, 1.5)
    expected = first_state(states).xi
    assert states.measured(expected).episodes == 2
    assert not by_weights

    # A low limit ends growing amplitudes early, so that growing weights are used.
    monkeypatch.setattr(steps, "MOST_RAMP", 5)
    monkeypatch.setattr(steps, "LONGEST_RAMP", 0.5)
    assert first_state(states).xi == pytest.approx(expected, abs=1e-9)
    assert by_weights


def test_a_request_to_stop_ends_the_way_to_the_first_state(monkeypatch, by_weights):
    """Neither growing amplitudes nor growing weights go on after a request to stop."""
    states = states_from(1000.0, 3.0)
    with pytest.raises(StoppedError, match="before the first point"):
        first_state(states, StopAt(0))
    assert not by_weights

    # After a single step of growing amplitudes, growing weights take over.
    monkeypatch.setattr(steps, "MOST_RAMP", 1)
    monkeypatch.setattr(steps, "LONGEST_RAMP", 0.0)
    with pytest.raises(StoppedError, match="before the first point"):
        first_state(states, StopAt(3))
    assert len(by_weights) == 1
