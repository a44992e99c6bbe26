"""Steady states of rigs whose stop touches at rest, against the exact bilinear oscillator and SciPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.rigs import followed
from tests.verify.test_one_mass import ONE_MASS
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

pytestmark = pytest.mark.parallel(1)


def touching(table: dict[str, Any] = ONE_MASS, contacts: dict[str, Any] | None = None, **nfrc: Any) -> NfrcCase:
    """The case of a rig with a stop that touches at rest; ``contacts`` and ``nfrc`` update these tables."""
    options = {
        "source": "force",
        "over": "frequency",
        "range": [1.9, 2.0],
        "fixed": [0.2],
        "harmonics": 15,
        "largest_step": 0.3,
    } | nfrc
    stops = table["contacts"] | {"clearance": 0.0} | (contacts or {})
    return NfrcCase.from_table(table | {"contacts": stops, "nfrc": options})


def test_its_resonance_is_that_of_a_bilinear_oscillator(tmp_path):
    """The resonance is that of a bilinear oscillator, 2 w1 w2/(w1 + w2) with w1 = sqrt(1.5), w2 = sqrt(21.5) rad/s.

    The oscillator swings half a cycle at each of the two frequencies, whatever the amplitude.
    """
    _, points = followed(touching(range=[1.92, 1.96]), tmp_path / "one")
    soft, stiff = np.sqrt([1.5, 21.5])
    resonance = 2 * soft * stiff / (soft + stiff)
    highest = max(points, key=lambda point: point.measured.largest[0])
    # The peak of a response with a dashpot of 0.06 1/s is a little lower.
    assert highest.measured.frequency == pytest.approx(resonance, rel=3e-3)
    assert highest.measured.episodes == 1
    assert highest.measured.closed[0] == pytest.approx(soft / (soft + stiff), rel=0.02)


def test_it_is_proportional_to_the_drive(tmp_path):
    """Forces of a bilinear stop that touches at rest scale with the motion: states are proportional to the drive."""
    _, points = followed(touching(over="amplitude", range=[0.1, 5.0], fixed=[1.5], largest_step=1.0), tmp_path / "two")
    first, last = (point.measured for point in (points[0], points[-1]))
    np.testing.assert_allclose(last.harmonics, 50 * first.harmonics, atol=1e-8)
    assert first.unstable == last.unstable


def test_a_lattice_without_damping_has_a_state_between_its_resonances():
    """A first state of an undamped lattice between its resonances is found, and contains no dashpots.

    The search for it uses temporary dashpots, which keep it from the resonance that a growing force passes.
    """
    cell = {
        "masses": [0.004, 0.002],
        "springs": [
            {"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True},
            {"start": 1, "end": 2, "stiffness": 5e3},
        ],
    }
    stops = {"law": "hertz", "stiffness": 1e7, "sites": [12, 14], "clearance": 0.0, "side": "plus", "restitution": 1.0}
    drive = {"amplitude": 3.0, "frequency": 1000.0, "cycles": 3, "cell": 4}
    options = {"source": "force", "infinite": False, "range": [0.44, 1.0], "harmonics": 5}
    case = NfrcCase.from_table(
        {"lattice": {"cells": 24, "cell": cell}, "contacts": stops, "drive": drive, "nfrc": options}
    )
    states = SteadyStates(case, 1.0, 1000.0)
    point = first_state(states)
    assert np.abs(states.residual(point.xi, states.shift_near(point.xi))).max() < 1e-10
    # Without dissipation all motions are in phase with the drive or in antiphase.
    assert np.abs(states.measured(point.xi).harmonics.imag).max() < 1e-9 * states.clearance
