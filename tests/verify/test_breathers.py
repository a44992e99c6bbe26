"""Branches by condensed harmonic balance are compared with integrated motions: by shooting, and of a whole chain."""

from __future__ import annotations

import numpy as np
import pytest

from tests.condensed_branches import condensed_branch, displacement
from tests.models import kerschen_system
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.shooting import Shooting, resonance


def test_the_tongues_of_the_in_phase_mode_are_followed():
    """Harmonic balance passes the tips of Kerschen's 3:1 and 5:1 tongues; shooting from it finds the same orbits."""
    system = kerschen_system()
    problem, points = condensed_branch(system, 0, 1.0, truncation=1e-7, points=130, largest_step=0.15)
    energy = np.array([point.energy for point in points])
    tips = 1 + np.nonzero((energy[1:-1] > energy[:-2]) & (energy[1:-1] > energy[2:]))[0]
    assert energy[tips] == pytest.approx([4679, 2100, 107310], rel=1e-2)
    assert max(point.order for point in points) < 100

    shooting = Shooting(Dop853Flow(system), MAPS["quarter"], 1e-12)
    resonances = []
    # The points are the tips, and one beyond each tip on the way back.
    for i in (*tips, *(tips + 4)):
        point = points[i]
        frame = shooting.relative_frame(displacement(problem, point), point.period)
        # Shooting looks for the orbit at the same length along the branch as the point.
        before = frame.chart.encode(displacement(problem, points[i - 1]), points[i - 1].period)
        row = frame.xi - before
        attempt = frame.solve(frame.xi, row / np.linalg.norm(row), row @ frame.xi / np.linalg.norm(row))
        assert attempt.converged

        orbit = frame.measures(attempt)
        assert orbit.frequency == pytest.approx(point.frequency, rel=1e-8)
        assert orbit.energy == pytest.approx(point.energy, rel=1e-6)
        resonances.append(resonance(shooting, orbit))
    assert resonances[:3] == [3, 3, 5]
