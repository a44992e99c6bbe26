"""Arcs and orbits of the reduced model: an exact solution, conservation, sensitivities, other flows and maps."""

from __future__ import annotations

import numpy as np
import pytest

from tests.models import CLEARANCE, OUT_OF_PHASE, reduced_model
from tests.reference_flows import FiniteDifferences
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.shooting import Shooting


def superposed(stiffness, masses, centre, displacement, velocity, duration):
    """Displacement and velocity (dof,) of a linear system about its ``centre`` after a ``duration`` in s.

    The motion is the superposition of the modes of ``stiffness`` (dof, dof) and ``masses`` (dof,).
    """
    root = np.sqrt(masses)
    squared, modes = np.linalg.eigh(stiffness / np.outer(root, root))
    omega = np.sqrt(squared)

    amplitude = modes.T @ (root * (displacement - centre))
    rate = modes.T @ (root * velocity)
    cosine = np.cos(omega * duration)
    sine = np.sin(omega * duration)

    later = modes @ (cosine * amplitude + sine / omega * rate)
    later_rate = modes @ (cosine * rate - omega * sine * amplitude)
    return later / root + centre, later_rate / root


def test_bilinear_orbit_is_the_exact_piecewise_solution(bilinear):
    """A quarter period of a bilinear orbit is modal superposition with the contact closed, and then with it open.

    At the end of the quarter all displacements are zero.
    """
    problem = bilinear.problem
    system = problem.system
    point = bilinear.at_energy(1.0)
    (separation,) = problem.arc(point.x, point.period).events

    # The quarter begins at rest with the contact closed. The stop at a distance shifts the centre of the motion.
    row = np.array([-1.0, 1.0])
    side = np.sign(row @ point.x)
    contact_stiffness = system.contacts[0].law.stiffness
    closed = system.stiffness + contact_stiffness * np.outer(row, row)
    centre = np.linalg.solve(closed, contact_stiffness * CLEARANCE * side * row)

    u, v = superposed(closed, system.masses, centre, point.x, np.zeros(2), separation[0])
    assert side * (row @ u) == pytest.approx(CLEARANCE, rel=1e-12)

    u, _ = superposed(system.stiffness, system.masses, np.zeros(2), u, v, point.period / 4 - separation[0])
    assert np.abs(u).max() <= 1e-12 * np.abs(point.x).max()


@pytest.mark.parametrize("shooting", ["half", "whole"])
def test_maps_agree(shooting, bilinear):
    """Half and whole periods find the orbits of the quarter period, with the same multipliers."""
    stable = next(point for point in bilinear.points if point.energy > 1.0)
    unstable = max(bilinear.points, key=lambda point: point.multiplier)

    for point in (stable, unstable):
        # Residuals are at least 3e4 times the errors of the unknowns. Rounding errors leave a residual of 7e-9 for the
        # unstable orbit.
        other = Shooting(bilinear.problem.flow, MAPS[shooting], tolerance=1e-7)
        frame = other.relative_frame(point.x, point.period)
        row = np.append(point.x / np.linalg.norm(point.x), 0.0)
        attempt = frame.solve(frame.xi + 1e-7, row, row @ frame.xi)
        assert attempt.converged, attempt.history

        found = frame.measures(attempt)
        assert found.frequency == pytest.approx(point.frequency, rel=1e-9)
        assert found.multiplier == pytest.approx(point.multiplier, rel=1e-3)


@pytest.mark.parametrize("law", ["bilinear", "hertz"])
def test_sensitivities(law):
    """Variational equations agree with central differences and are symplectic, on an arc with many contacts."""
    system = reduced_model(law)
    start = np.array([3 * CLEARANCE, 1.2 * CLEARANCE, 0.1, -0.2])
    flow = Dop853Flow(system)

    arc = flow.arc(start, 3e-3, 3e-3)
    differences = FiniteDifferences(flow, 1e-7).arc(start, 3e-3, 3e-3).sensitivity

    assert len(arc.events) >= 8
    largest = np.abs(arc.sensitivity).max()
    assert arc.sensitivity == pytest.approx(differences, rel=1e-4, abs=1e-4 * largest)

    # In displacements and momenta S^T J S = J. The rounding error is relative to the terms that cancel in the product.
    masses = np.diag(system.masses)
    zero = np.zeros((2, 2))
    form = np.block([[zero, masses], [-masses, zero]])
    size = np.abs(arc.sensitivity.T) @ np.abs(form) @ np.abs(arc.sensitivity)
    defect = np.abs(arc.sensitivity.T @ form @ arc.sensitivity - form)
    assert defect.max() <= 1e-7 * size.max()


def test_flow_conserves_energy_and_reverses():
    """After more than 50 changes of contact the energy is the same, and the reversed motion leads back."""
    system = reduced_model()
    flow = Dop853Flow(system)
    start = np.array([30 * CLEARANCE, 10 * CLEARANCE, 0.0, 0.0])

    arc = flow.arc(start, 7e-3, 7e-3)
    assert len(arc.events) > 50

    u = arc.end[:2]
    v = arc.end[2:]
    assert system.energy(u, v) == pytest.approx(system.energy(start[:2], start[2:]), rel=1e-12)

    back = flow.arc(np.append(u, -v), 7e-3, 7e-3)
    assert np.abs(back.end[:2] - start[:2]).max() <= 1e-11 * np.abs(start).max()


# A contact of depth 1e-12 D lasts about 1e-6 of the period; a motion that ends 1e-12 D short of the stop has none.
@pytest.mark.parametrize(("excess", "changes"), [(1e-12, 2), (-1e-12, 0)])
def test_short_contacts_inside_a_step_are_found(excess, changes):
    """A pair of changes 1e-6 of the period apart is found, and a near miss does not count."""
    system = reduced_model()
    omega, shapes = system.linear_modes()
    shape = shapes[:, OUT_OF_PHASE]
    touching = shape * CLEARANCE / abs(shape[1] - shape[0])
    period = 2 * np.pi / omega[OUT_OF_PHASE]
    centre = np.append(np.zeros(2), omega[OUT_OF_PHASE] * (1 + excess) * touching)

    arc = Dop853Flow(system).arc(centre, period / 2, period)

    assert len(arc.events) == changes


@pytest.mark.parametrize("law", ["bilinear", "hertz"])
def test_states_at_uniform_times_are_those_of_arcs(law, request):
    """States of an orbit, computed without variations, are the ends of arcs, also after changes of contact."""
    branch = request.getfixturevalue(law)
    flow = branch.problem.flow
    point = branch.at_energy(10.0)
    start = branch.problem.start(point.x)
    count = 12
    states = flow.states(start, point.period / count, count, point.period)

    size = np.abs(states).max(axis=0)
    assert states.shape == (count + 1, len(start))
    assert np.array_equal(states[0], start)
    for number in range(1, count + 1):
        end = flow.arc(start, number * point.period / count, point.period).end
        assert np.all(np.abs(states[number] - end) <= 1e-11 * size)
