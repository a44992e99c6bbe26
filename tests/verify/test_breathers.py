"""Branches by condensed harmonic balance are compared with integrated motions: by shooting, and of a whole chain."""

from __future__ import annotations

import numpy as np
import pytest

from tests.condensed_branches import condensed_branch, condensed_breather, condensed_problem, displacement
from tests.models import CLEARANCE, four_band_contact, kerschen_system, reduced_model
from vipetsc.lattice import Chain, four_band
from vipetsc.modes.balance.stops import Stops
from vipetsc.modes.branches.condensed import state_of
from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.shooting import Shooting, resonance
from vipetsc.modes.system import System


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "mode", "energy", "truncation"),
    [
        (kerschen_system(), 0, 1e-2, 1e-9),
        (kerschen_system(), 1, 1e-2, 1e-9),
        (reduced_model("hertz"), 0, 0.0034, 1e-8),
        (reduced_model("power", exponent=2.3), 1, 0.028, 1e-8),
    ],
)
def test_branches_from_modes_are_those_of_shooting(system, mode, energy, truncation):
    """Condensed branches from linear modes have the orbits of shooting, with cubic springs and with contacts."""
    _, points = branch = condensed_branch(system, mode, energy, truncation=truncation, points=12)
    assert system.springs or points[-1].episodes
    assert_orbits_of_shooting(system, *branch)


@pytest.mark.slow
def test_a_branch_from_a_describing_function_is_that_of_shooting():
    """A condensed branch that begins in contact, by a describing function, has the orbits of shooting."""
    system = reduced_model("bilinear")
    problem = condensed_problem(system, truncation=1e-7, points=2)
    start = problem.in_gap(3200.0, np.array([1.0]))
    points = list(Continuation(problem, start, problem.control))
    assert points[-1].episodes
    assert_orbits_of_shooting(system, problem, points)


def assert_orbits_of_shooting(system, problem, points) -> None:
    """Assert that shooting corrects points of a branch to orbits with the frequency of the branch, to 1e-6.

    The orbit's energy differs from the point's; the slope df/dE of the branch accounts for the difference.
    """
    shooting = Shooting(Dop853Flow(system), MAPS["quarter"], 1e-12)
    # Every fourth point is enough, but not the first, which is a linear mode.
    for point in points[:0:-4]:
        u = displacement(problem, point)
        frame = shooting.relative_frame(u, point.period)
        row = np.append(u / np.linalg.norm(u), 0.0)
        attempt = frame.solve(frame.xi, row, row @ frame.xi)
        assert attempt.converged
        orbit = frame.measures(attempt)

        frequency = point.frequency
        if point.episodes or system.springs:
            frequency += point.slope * (orbit.energy - point.energy)
        assert orbit.frequency == pytest.approx(frequency, rel=1e-6)
        assert point.energy == pytest.approx(system.energy(u, 0 * u), rel=1e-6)


@pytest.mark.slow
def test_a_breather_returns_after_a_period_in_its_chain():
    """A breather by harmonic balance in Bloch waves returns after its period in the flow of a chain of 12 cells."""
    chain = Chain(four_band("calibrated"), 12, "fixed", (5,), (CLEARANCE,))
    problem, point = condensed_breather(12, 6, 1600.0, 2e-9, max_newton=12)
    state = state_of(problem, point, chain.cell.dofs)
    u = np.concatenate([state[cell] for cell in range(12)])
    system = System.from_chain(chain, [Stops.both(four_band_contact("hertz"), CLEARANCE)])
    assert point.energy == pytest.approx(system.energy(u, 0 * u), rel=1e-8)

    end = Dop853Flow(system).arc(np.append(u, 0 * u), point.period, point.period).end

    size = np.abs(u).max()
    assert np.abs(end[:48] - u).max() < 1e-8 * size
    assert np.abs(end[48:]).max() < 1e-8 * size * 2 * np.pi / point.period


@pytest.mark.slow
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
