"""Collocation of a substep: its nodes, and a mass on a linear stop against its exact motion."""

from math import factorial

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.special import ellipj

from tests.unit.propagator_parts import MASS, RATE, SPEED, mass_on_cubic_spring, mass_on_stop, workspace
from vipetsc.contact.law import FREE
from vipetsc.dynamics.propagator.collocation import (
    accumulate_moments,
    collocate,
    error_ratio,
    evaluate_site_motion,
    node_responses,
    update_taylor,
)
from vipetsc.dynamics.propagator.nodes import EXIT, NODES, ONSET, PLAIN, collocation
from vipetsc.dynamics.propagator.substeps import Cluster, Substep, Trial


def one_substep(cluster: Cluster, substep: Substep) -> Trial:
    """Collocate a substep and return it with the series at its end; moments and energy are added to the cluster."""
    trial = cluster.trial
    assert collocate(cluster, trial, substep)
    update_taylor(cluster, trial, substep)
    accumulate_moments(cluster, trial, substep)
    return trial


def test_nodes_have_the_order_of_gauss_and_follow_roots():
    """Eight nodes integrate powers up to 15 exactly, nodes of an onset or exit also the power 3/2 of Hertz's law."""
    table = collocation(4)
    position = table.position
    weight = table.weight

    assert weight[PLAIN] @ position[PLAIN] ** 15 == pytest.approx(1 / 16, rel=1e-14)
    assert abs(weight[PLAIN] @ position[PLAIN] ** 16 - 1 / 17) > 1e-12
    assert weight[ONSET] @ position[ONSET] ** 1.5 == pytest.approx(1 / 2.5, rel=1e-14)
    assert weight[EXIT] @ (1 - position[EXIT]) ** 1.5 == pytest.approx(1 / 2.5, rel=1e-14)
    assert abs(weight[PLAIN] @ position[PLAIN] ** 1.5 - 1 / 2.5) > 1e-8

    # ``tail`` yields the last two Legendre coefficients: zero for a lower degree, 0 and 1 for the last polynomial.
    x = position[PLAIN]
    assert np.abs(table.tail @ x ** (NODES - 3)).max() < 1e-14
    legendre = np.polynomial.legendre.legval(2 * x - 1, np.eye(NODES)[NODES - 1])
    np.testing.assert_allclose(table.tail @ legendre, [0, 1], atol=1e-13)


@pytest.mark.parametrize("kind", [PLAIN, ONSET, EXIT])
def test_a_linear_contact_is_an_oscillator(kind):
    """A mass m on a linear stop moves as w - 1 = (V/omega) sin omega t, under the force -m omega V sin omega t."""
    cluster = mass_on_stop()
    interval = cluster.interval
    begin = 0.25
    length = 0.3
    cluster.state["position"] = begin

    trial = one_substep(cluster, Substep(kind, length))

    phase = RATE * length * interval
    assert trial.taylor[0, 0] - 1 == pytest.approx(SPEED / RATE * np.sin(phase), rel=1e-9)
    assert trial.taylor[0, 1] / interval == pytest.approx(SPEED * np.cos(phase), rel=1e-10)

    # Moments of the force are taken about the end of the step; the zeroth one is the change of the momentum.
    assert cluster.moments[0, 0] == pytest.approx(MASS * SPEED * (np.cos(phase) - 1), rel=1e-9)
    t = np.linspace(0, length * interval, 20001)
    force = -MASS * RATE * SPEED * np.sin(RATE * t)
    # The trapezoidal rule over 20000 intervals has an error of some 1e-9 of the integral.
    assert cluster.moments[0, 1] == pytest.approx(trapezoid(force * (1 - begin - t / interval), t), rel=1e-7)
    assert cluster.energy[0] == 0.0


def test_a_cubic_spring_moves_a_mass_as_jacobis_cosine():
    """The exact motion under the force -c u^3 is u = A cn(omega t, 1/2) with omega^2 = A^2 c/m.

    The error falls with an order above 14, and its estimate is not smaller.
    """
    omega = 1e4
    amplitude = 1e-3
    cubic = MASS * (omega / amplitude) ** 2

    def exact(phase: float) -> np.ndarray:
        sn, cn, dn, _ = ellipj(phase, 0.5)
        return amplitude * np.array([cn, -omega * sn * dn])

    errors = []
    begin = -1.5
    for phase in (2.0, 1.0):
        cluster = mass_on_cubic_spring(cubic)
        u, v = exact(begin)
        cluster.taylor[:] = [[u, v * cluster.interval]]
        length = phase / omega / cluster.interval
        trial = one_substep(cluster, Substep(PLAIN, length))
        end = np.array([trial.taylor[0, 0], trial.taylor[0, 1] / cluster.interval])
        error = np.abs(end - exact(begin + phase)) / [amplitude, amplitude * omega]
        errors.append(error.max())

        # A spring dissipates nothing: no energy is booked.
        assert cluster.energy[0] == 0.0
        assert cluster.moments[0, 0] == pytest.approx(MASS * (end[1] - v), rel=1e-9, abs=1e-9 * MASS * abs(v))
        allowed = cluster.rtol * np.abs(trial.v[0]).max() + cluster.atol
        assert error_ratio(cluster, trial, length) * allowed > error[1] * amplitude * omega
    assert errors[1] < 1e-11
    assert np.log2(errors[0] / errors[1]) > 14


def cluster_on(part: str) -> Cluster:
    """Return a moving mass on a bilinear stop or on a cubic spring."""
    if part == "stop":
        return mass_on_stop()
    cluster = mass_on_cubic_spring(MASS * 1e14)
    cluster.taylor[:] = [[1e-3, 3.0 * cluster.interval]]
    return cluster


@pytest.mark.parametrize("part", ["stop", "spring"])
def test_a_substep_that_does_not_converge_leaves_nothing_to_the_next_one(part):
    """A substep after one that did not converge has the bits of a substep in a new cluster.

    Picard's iteration contracts below h omega = 13 and does not converge for 60.

    Forces of the failed trial, if kept, could converge in the next substep with a rounding that depends on them.
    """
    cluster = cluster_on(part)
    too_long = Substep(PLAIN, 60.0 / RATE / cluster.interval)
    assert not collocate(cluster, cluster.trial, too_long)
    assert not cluster.trial.force.any()

    again = one_substep(cluster, Substep(PLAIN, 0.3))
    fresh = one_substep(cluster_on(part), Substep(PLAIN, 0.3))
    for name in ("force", "w", "v", "taylor"):
        np.testing.assert_array_equal(getattr(again, name), getattr(fresh, name))


def test_springs_accelerate_the_sites_next_to_them():
    """w'' at a site is the free motion's second derivative less c u^3/m, for a spring of the elongation u nearby."""
    cubic = mass_on_cubic_spring(2e3)
    open_stop = mass_on_stop()
    open_stop.contacts["mode"] = FREE
    taylor = np.array([[0.5, 1e-4, 3e-9], [0.2, 0.0, 0.0]])
    cluster = cubic._replace(
        contacts=open_stop.contacts,
        taylor=taylor,
        response=np.full((2, 2, 1), cubic.interval**2 / MASS),
        trial=workspace(2, 1),
    )
    motion = np.zeros((1, 3))
    evaluate_site_motion(cluster, taylor, motion)
    expected = 2 * 3e-9 / cubic.interval**2 - 2e3 * 0.2**3 / MASS
    np.testing.assert_allclose(motion[0], [0.5, 1e-4 / cubic.interval, expected], rtol=1e-14)


def test_the_error_estimate_falls_as_the_order_says():
    """Half the substep divides the estimate by 2^6 to 2^8.5, and the allowed error grows with the approach."""
    ratios = []
    for length in (0.8, 0.4):
        cluster = mass_on_stop()
        trial = one_substep(cluster, Substep(PLAIN, length))
        ratios.append(error_ratio(cluster, trial, length))
    # The estimate is the last two coefficients, which fall as h^6 and h^7, times the length h.
    assert 6 < np.log2(ratios[0] / ratios[1]) < 8.5

    # The error allowed is rtol |w'_minus| + atol, with the approach velocity w'_minus: 1e-10 * 0.5 + 1e-12 above, and
    # 1e-10 * 1.0 + 1e-12 here.
    cluster.contacts["approach"] = 1.0
    assert error_ratio(cluster, cluster.trial, 0.4) == pytest.approx(ratios[1] * 5.1e-11 / 1.01e-10)


def test_responses_are_added_up_over_all_terms():
    """A constant force F moves an oscillator by m omega^2 w = F (1 - cos omega t), m omega w' = F sin omega t."""
    omega_h = 1.2
    terms = 8
    cluster = mass_on_stop()
    powers = np.arange(terms)
    coefficients = (-(omega_h**2)) ** powers / [factorial(2 * m + 1) for m in powers]
    nodes = collocation(2 * terms)
    cluster = cluster._replace(
        response=cluster.response * coefficients, taylor=np.zeros((1, 2 * terms)), nodes=nodes, omega_max_h=omega_h
    )

    to_w, to_v = np.zeros((2, NODES, NODES))
    assert node_responses(cluster, Substep(PLAIN, 0.9), 0, 0, to_w, to_v)

    interval = cluster.interval
    phase = omega_h * 0.9 * nodes.position[PLAIN]
    displacement = (1 - np.cos(phase)) * interval**2 / (MASS * omega_h**2)
    velocity = np.sin(phase) * interval / (MASS * omega_h)
    np.testing.assert_allclose(to_w.sum(axis=0), displacement, rtol=1e-11)
    np.testing.assert_allclose(to_v.sum(axis=0), velocity, rtol=1e-11)
