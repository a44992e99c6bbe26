"""Arcs, orbits and branches of the reduced model: exact solutions, conservation, sensitivities, tongues, limits."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from tests.models import CLEARANCE, GRAZING_ENERGY, IN_PHASE, OUT_OF_PHASE, four_band_contact, reduced_model
from tests.reference_flows import FiniteDifferences
from tests.verify.conftest import follow
from vipetsc.case.nnm import Guards
from vipetsc.lattice import four_band
from vipetsc.modes.branches.branch_checks import BranchMonitor
from vipetsc.modes.continuation.arclength import locate
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.shooting import Shooting, linear_start, resonance
from vipetsc.modes.stability import half_traces, multipliers
from vipetsc.modes.stops import Stops
from vipetsc.modes.system import SmoothSpring, System


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
    """A quarter period of a bilinear orbit is modal superposition with the contact closed, and then with it open."""
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
    """An arc that ends within rounding of a contact's closing comes to an end, and an onset within rounding is none."""
    system = System.reduced(four_band("printed"), Stops.both(four_band_contact("hertz"), CLEARANCE))
    flow = Dop853Flow(system)
    start = np.array([7.732456897616884, 7.742513284851792, 0.0, 0.0])

    arc = flow.arc(start, 0.0003398398033092859, 0.003147455285852897)

    assert arc.episodes == 1
    assert arc.events[:, 3].tolist() == [-1]
    assert np.abs(system.gaps(arc.end[:2])) < 1e-14


@pytest.mark.parametrize("cubic", [1e8, 1e12])
def test_a_step_that_overflows_is_taken_again_shorter(cubic):
    """A step that overflows is repeated shorter, until the flow keeps energy and volume."""
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


def test_linear_modes_and_limits():
    """The linear modes have the frequencies of the paper's two masses, and large motions those with closed contacts."""
    system = reduced_model()

    assert system.linear_modes()[0] / (2 * np.pi) == pytest.approx([135.1209897, 474.2501016], rel=1e-9)
    assert system.closed_frequencies() / (2 * np.pi) == pytest.approx([318.1562921, 10252.6169369], rel=1e-9)


@pytest.mark.parametrize("name", ["bilinear", "hertz"])
def test_out_of_phase_branch(name, request):
    """The branch grazes once, at the energy of the linear mode that touches, and is stable above its folds."""
    branch = request.getfixturevalue(name)
    points = branch.points

    # Steps grow with the energy, so that thirteen decades take few points.
    assert len(points) <= 400
    assert points[-1].energy >= 1e9
    assert max(point.residual for point in points) <= 1e-12

    (graze,) = branch.of_kind("grazing")
    assert graze.energy == pytest.approx(GRAZING_ENERGY[OUT_OF_PHASE], rel=1e-10)
    assert all(point.multiplier == pytest.approx(1, abs=1e-9) for point in points if point.energy > 0.1)


def test_bilinear_folds_and_stability(bilinear):
    """The energy folds back twice at grazing, and orbits are unstable between the folds and nowhere else."""
    folds = bilinear.of_kind("fold-energy")

    # A pair of multipliers is at +1 where the energy is stationary: their half-trace is 1.
    assert len(folds) == 2
    for fold in folds:
        assert fold.half_traces[0] == pytest.approx(1, abs=1e-6)

    first, second = (fold.index for fold in folds)
    for point in bilinear.points:
        if first < point.index < second:
            assert point.multiplier > 1.01
        elif not first <= point.index <= second:
            assert point.multiplier == pytest.approx(1, abs=1e-6)


def test_bilinear_approaches_its_limit(bilinear):
    """The distance f_limit - f falls as E^(-1/2), as the clearance over the amplitude does."""
    limit = bilinear.problem.system.closed_frequencies()[1] / (2 * np.pi)

    lower = limit - bilinear.at_energy(1e6).frequency
    upper = limit - bilinear.at_energy(1e8).frequency

    # The next term of the expansion is smaller by D over the amplitude, 3e-3 at 1e6 J.
    assert lower / upper == pytest.approx(10, rel=2e-3)


def test_hertz_folds_only_at_200_mpa(hertz):
    """Hertz contacts of the printed 100 MPa have no fold and no instability; those of 200 MPa have both."""
    assert not hertz.of_kind("fold-energy")
    assert max(point.multiplier for point in hertz.points) == pytest.approx(1, abs=1e-6)

    stiffer = follow(reduced_model("hertz", modulus=2e8), OUT_OF_PHASE, 1e-2, energy=[1e-4, 0.1])
    assert len(stiffer.of_kind("fold-energy")) == 2
    assert max(point.multiplier for point in stiffer.points) > 1.01


def test_in_phase_through_the_first_tongues(in_phase):
    """The branch passes the grazing cascade and two resonances without a jump, and grazes at its own energy."""
    problem = in_phase.problem
    # The frequency first exceeds 333 Hz behind the tongues 7:1 and 5:1; checks of all points would take long.
    points = list(itertools.takewhile(lambda point: point.frequency < 333, in_phase.points))
    steps = list(itertools.pairwise(points))

    special = (point for a, b in steps for point in locate(problem, a, b, grazing=True))
    graze = next(point for point in special if point.kind == "grazing")
    assert graze.energy == pytest.approx(GRAZING_ENERGY[IN_PHASE], rel=1e-10)

    assert max(point.residual for point in points) <= 1e-11
    assert max(abs(a.episodes - b.episodes) for a, b in steps) == 1

    monitor = BranchMonitor(problem, Guards())
    assert not any(monitor.check(point) for point in points)


def test_in_phase_through_every_odd_tongue_towards_the_limit(in_phase):
    """At the tip of the k:1 tongue the resonator strikes (k + 1)/2 times in a quarter period, for every odd k."""
    problem = in_phase.problem
    points = in_phase.points
    assert points[-1].energy > 25
    assert max(point.residual for point in points) <= 3e-12
    assert max(abs(a.episodes - b.episodes) for a, b in itertools.pairwise(points)) == 1

    limit = problem.system.closed_frequencies()[0] / (2 * np.pi)
    tongues = set()
    distances = []
    for last, point in itertools.pairwise(points):
        # The energy turns upwards at the inner end of a tongue.
        if not (last.energy_tangent < 0 < point.energy_tangent and point.episodes > 0):
            continue
        order = resonance(problem, point)
        if point.episodes == (order + 1) // 2:
            tongues.add(order)
        if order == 1 and point.energy > 0.02:
            distances.append((limit - point.frequency) * np.sqrt(point.energy))

    assert tongues - {1} == {3, 5, 7}
    # f_limit - f falls as E^(-1/2): over these three energies the product changes little.
    assert len(distances) == 3
    assert min(distances) > 10
    assert max(distances) < 14
