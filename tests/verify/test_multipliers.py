"""The largest multipliers of condensed motions, by Hill's determinant and by the sensitivities of orbits."""

from __future__ import annotations

import numpy as np
import pytest

from tests.breathers import BREATHER_FREQUENCY, breather_case, breather_chain
from tests.models import CLEARANCE, four_band_contact
from vipetsc.case import NnmCase
from vipetsc.modes.branches import balance
from vipetsc.modes.branches.balance import BalanceMethod, state_of
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.shooting import Shooting
from vipetsc.modes.stops import Stops
from vipetsc.modes.system import System

STOPS = [Stops.both(four_band_contact(), CLEARANCE)]


def test_a_breather_and_its_multiplier_are_those_of_shooting():
    """A breather of 14 cells is an orbit of all masses by shooting, with the largest multiplier by Hill's determinant.

    Amplitude and energy are those of an earlier computation with 8 to 16 harmonics.
    """
    method = BalanceMethod(breather_case())
    point = method.assess(method.motions, method.start(method.motions, 0))
    assert abs(point.elongations[0]) / CLEARANCE == pytest.approx(1.286, abs=5e-4)
    assert point.energy == pytest.approx(0.0203, abs=5e-5)

    shooting = Shooting(Dop853Flow(System.from_chain(breather_chain(), STOPS)), MAPS["quarter"], tolerance=1e-12)
    u = np.concatenate(list(state_of(method.motions, point, 4).values()))
    frame = shooting.relative_frame(u, 2 * np.pi / BREATHER_FREQUENCY)
    keep_period = np.append(np.zeros(len(u)), 1.0)
    attempt = frame.solve(frame.xi, keep_period, 1.0)
    assert attempt.converged
    orbit = frame.measures(attempt)

    assert np.abs(orbit.x - u).max() < 1e-7 * np.abs(u).max()
    assert orbit.energy == pytest.approx(point.energy, rel=1e-7)
    # The breather is unstable; all multipliers of a stable one would have the modulus 1.
    assert orbit.multiplier > 1.3
    assert point.multiplier == pytest.approx(orbit.multiplier, rel=1e-6)


@pytest.mark.parametrize("sites", [[1], [1, -2]])
def test_sensitivities_of_all_masses_and_hills_determinant_agree(monkeypatch, sites):
    """Multipliers by sensitivities of all masses and by Hill's determinant agree, in a lattice of cubic springs.

    A breather of one site is stable, and one of two sites that move against each other is unstable.
    """
    springs = [
        {"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": 5e3, "cubic": 1e9},
    ]
    table = {
        "lattice": {"cells": 3, "cell": {"masses": [4e-3, 2e-3], "springs": springs}},
        "contacts": {"law": "hertz", "stiffness": 1e7, "sites": [1, 2], "clearance": 1e-4},
        "nnm": {"system": "condensed", "start_frequency": [6000.0], "start_sites": sites, "truncation": 1e-5},
    }
    method = BalanceMethod(NnmCase.from_table(table))
    point = method.start(method.motions, 0)
    assert method.motions.forces.pairs > balance.MOST_OF_HILL
    by_orbit = method.assess(method.motions, point).multiplier
    monkeypatch.setattr(balance, "MOST_OF_HILL", method.motions.forces.pairs)
    by_hill = method.assess(method.motions, point).multiplier

    assert (by_orbit > 1.5) == (len(sites) == 2)
    assert by_orbit == pytest.approx(by_hill, rel=1e-6)


def test_a_slow_motion_with_few_harmonics_has_the_multiplier_of_its_orbit():
    """Where harmonics end below the highest mode, which decides nothing by Hill's method, the orbit of all masses does.

    A chain of 25 masses moves in its lowest mode with 15 harmonics, at a sixteenth of the highest frequency.
    """
    masses = 25
    springs = [{"start": i, "end": i + 1, "stiffness": 1.0} for i in range(masses)]
    system = {"masses": [1.0] * masses, "springs": springs, "smooth": [{"start": 0, "end": 1, "cubic": 0.5}]}
    options = {"system": "own", "method": "balance", "start_energy": 1e-3, "own": system}
    method = BalanceMethod(NnmCase.from_table({"nnm": options}))
    point = method.start(method.motions, 0)
    assert point.order * 2 * np.pi / point.period < method.motions.compliance.highest
    assert method.assess(method.motions, point).multiplier == pytest.approx(1.0, abs=1e-6)
