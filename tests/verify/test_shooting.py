"""Shooting: frequencies, portraits and multipliers of orbits against theory, and arcs that are hard to integrate."""

from __future__ import annotations

import numpy as np
import pytest

from tests.models import CLEARANCE, OUT_OF_PHASE, four_band_contact, reduced_model
from vipetsc.case.nnm import NnmTable
from vipetsc.lattice import four_band
from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.shooting import Shooting, linear_start, sample_orbit
from vipetsc.modes.stability import half_traces, multipliers
from vipetsc.modes.stops import Stops
from vipetsc.modes.system import SmoothSpring, System


def test_half_map_of_an_asymmetric_system():
    """Orbits of x'' + x + a x^2 = 0 have the frequency 1 - 5/12 a^2 A^2 to second order (Nayfeh and Mook 1979)."""
    a = 0.1
    system = System.assemble([1.0], [(None, 0, 1.0)], smooth=[SmoothSpring.between(None, 0, quadratic=a)])
    problem = Shooting(Dop853Flow(system), MAPS["half"])

    point = linear_start(problem, 0, 1e-3)

    amplitude_squared = 2 * point.energy
    # The next order of the expansion is (a A)^4, 4e-10.
    assert 2 * np.pi * point.frequency == pytest.approx(1 - 5 / 12 * a**2 * amplitude_squared, abs=2e-9)
    assert point.multiplier == 1


def test_an_arc_that_ends_where_a_contact_just_closes_ends():
    """An arc that ends within rounding of a contact's closing comes to an end, and an onset within rounding is none.

    A search for the change in the remaining time, which is all rounding, must not return to its beginning for ever.
    """
    system = System.reduced(four_band("printed"), Stops.both(four_band_contact("hertz"), CLEARANCE))
    flow = Dop853Flow(system)
    start = np.array([7.732456897616884, 7.742513284851792, 0.0, 0.0])

    arc = flow.arc(start, 0.0003398398033092859, 0.003147455285852897)

    assert arc.episodes == 1
    assert arc.events[:, 3].tolist() == [-1]
    assert np.abs(system.gaps(arc.end[:2])) < 1e-14


@pytest.mark.parametrize("cubic", [1e8, 1e12])
def test_a_step_that_overflows_is_taken_again_shorter(cubic):
    """A step that overflows is repeated shorter, until the flow keeps energy and volume.

    The longest step is a radian of the linear system; the cubic spring oscillates thousands of times in it.
    """
    stiffness = np.array([[2.0, -1.0], [-1.0, 2.0]])
    spring = SmoothSpring.between(None, 0, cubic=cubic)
    system = System(masses=np.ones(2), stiffness=stiffness, contacts=(), springs=(spring,))

    arc = Dop853Flow(system).arc(np.array([1.0, 1.0, 0.0, 0.0]), 2e-3, 8e-3)

    before, after = (system.energy(state[:2], state[2:]) for state in (arc.start, arc.end))
    assert after == pytest.approx(before, rel=1e-9)
    # The flow of a conservative system keeps volumes in phase space.
    assert np.linalg.det(arc.sensitivity) == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize("name", ["quarter", "half", "whole"])
def test_multipliers_are_those_of_the_monodromy_matrix(name):
    """At a linear orbit the multipliers are exp(+-i omega_1 T_2), whatever the map."""
    system = reduced_model()
    problem = Shooting(Dop853Flow(system), MAPS[name])
    point = linear_start(problem, OUT_OF_PHASE, 1e-3)

    traces = half_traces(system, problem.map, problem.arc(point.x, point.period))
    mu = multipliers(traces, problem.map.quarter)

    omega, _ = system.linear_modes()
    assert mu.real == pytest.approx(np.cos(2 * np.pi * omega[0] / omega[1]), abs=1e-9)
    assert np.abs(mu) == pytest.approx(1, abs=1e-9)


def test_a_portrait_is_the_orbit_itself():
    """A portrait, which mirrors a quarter into a whole period, agrees with a flow over the whole period."""
    problem = Shooting(Dop853Flow(reduced_model()), MAPS["quarter"])
    start = linear_start(problem, OUT_OF_PHASE, 0.02)
    *_, point = Continuation(problem, start, NnmTable(points=150, energy=[0.0, 0.5]))
    samples = 40

    displacement, velocity = sample_orbit(problem, point, samples)

    # The two samples lie in the second and in the last quarter.
    for number in (13, 33):
        time = number / samples * point.period
        arc = problem.flow.arc(np.append(point.x, [0, 0]), time, point.period)
        assert displacement[number] == pytest.approx(arc.end[:2], rel=1e-8)
        assert velocity[number] == pytest.approx(arc.end[2:], rel=1e-8)
