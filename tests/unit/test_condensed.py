"""Harmonics of contact forces, and the balance at the places where a system is nonlinear."""

import itertools

import numpy as np
import pytest
from scipy.integrate import trapezoid

from vipetsc.lattice import Contact, Spring
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.balance.harmonics import SiteForces, arcs

CONSERVATIVE = [Contact("bilinear", 3.0), Contact("hertz", 3.0)]
DISSIPATIVE = [
    Contact("hertz", 3.0, 0.7),
    Contact("hertz", 3.0, 0.8, factor="exact"),
    Contact("bilinear", 3.0, 0.3, "clip"),
    Contact("hertz", 3.0, 0.7, approach_floor=1.5),
]
OMEGA = 0.77


class DenseCompliance:
    """G of a system with dense matrices, as it is defined."""

    def __init__(self, masses, stiffness, rows):
        self.masses, self.stiffness, self.rows = np.asarray(masses, float), stiffness, rows

    def at(self, omegas):
        kind = np.result_type(np.asarray(omegas), float)
        dynamic = (self.stiffness - omega**2 * np.diag(self.masses) for omega in np.asarray(omegas))
        return np.array([self.rows @ np.linalg.solve(d, self.rows.T.astype(kind)) for d in dynamic])


def motion_of(forces, last, seed, kind):
    """Random harmonics (pairs, last + 1) that fall by .7 each and pass the clearances."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(forces.pairs, last + 1)) + 1j * rng.normal(size=(forces.pairs, last + 1))
    z *= 0.7 ** np.arange(last + 1)
    z[:, 0], z[:, 1] = 0.2 * z[:, 0].real, z[:, 1] + 2
    if kind != "any":
        z[:, ::2] = 0
    return z.real + 0j if kind == "at rest" else z


def balance_of(forces, last, kind):
    rng = np.random.default_rng(3)
    root = rng.normal(size=(5, 5))
    compliance = DenseCompliance(np.ones(5), root @ root.T + np.eye(5), rng.normal(size=(forces.pairs, 5)))
    return HarmonicBalance(compliance, forces, last, odd=kind != "any", cosines=kind == "at rest")


def series_of(samples, orders):
    out = np.fft.rfft(samples)[..., :orders] / samples.shape[-1] * 2
    out[..., 0] /= 2
    return out


@pytest.mark.slow
@pytest.mark.parametrize("law", CONSERVATIVE)
@pytest.mark.parametrize("seed", range(3))
def test_force_harmonics_are_those_of_a_dense_sampling(law, seed):
    forces, last, theta = SiteForces([(law, 1.0), (law, 0.8)]), 9, np.linspace(0, 2 * np.pi, 2**18, endpoint=False)
    z = motion_of(forces, last, seed, "any")
    w = np.sum(z[..., None] * np.exp(1j * np.arange(last + 1)[:, None] * theta), axis=1).real
    series = forces.series(z, OMEGA)
    dense = np.array([law.force(row, clearance) for row, (law, clearance) in zip(w, forces.contacts, strict=True)])
    assert series.forces == pytest.approx(series_of(dense, 2 * last + 1), abs=1e-9 * np.abs(dense).max())
    potential = [law.potential(row, clearance).mean() for row, (law, clearance) in zip(w, forces.contacts, strict=True)]
    assert series.potential == pytest.approx(potential, rel=1e-9)
    assert np.abs(series.loss).max() < 1e-10
    assert series.closed == pytest.approx(np.mean(np.abs(w) > [[1.0], [0.8]], axis=1), abs=1e-4)


def test_smooth_springs_have_the_harmonics_of_powers_of_a_cosine():
    series = SiteForces([], [Spring(0, 1, 0.0, quadratic=2.0, cubic=0.5)]).series(np.array([[0.0, 3.0]]), OMEGA)
    assert series.forces[0] == pytest.approx([9.0, 0.5 * 27 * 0.75, 9.0], abs=1e-12)  # 2 cos^2 = 1 + cos 2


@pytest.mark.parametrize("law", DISSIPATIVE)
def test_a_dissipative_contact_loses_what_its_law_says(law):
    forces = SiteForces([(law, 0.5)])
    series = forces.series(np.array([[0.0, 1.0]], complex), OMEGA)
    # w = cos theta passes -1/2 and 1/2 with |w'| = sqrt(3)/2 and is back there symmetrically
    theta = np.linspace(-np.pi / 3, np.pi / 3, 400001)
    approach = OMEGA * np.sqrt(0.75)
    force = law.force(np.cos(theta), 0.5, -OMEGA * np.sin(theta), approach)
    loss = 2 * trapezoid(force * -np.sin(theta), theta)
    assert series.loss[0] == pytest.approx(loss, rel=1e-8)
    assert series.loss[0] > 0
    assert [episode.side for episode in series.episodes] == [1, -1]
    assert [episode.approach for episode in series.episodes] == pytest.approx([max(approach, law.approach_floor)] * 2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "kind"),
    [*itertools.product(CONSERVATIVE, ("at rest", "odd", "any")), *itertools.product(DISSIPATIVE, ("odd", "any"))],
)
def test_derivatives_are_those_of_the_residual(law, kind):
    spring = Spring(0, 1, 0.0, quadratic=0.3 if kind == "any" else 0.0, cubic=0.2)
    forces = SiteForces([(law, 1.0), (law, 0.8)], [spring])
    balance = balance_of(forces, 7, kind)
    x = balance.pack(motion_of(forces, 7, 1, kind))
    step = 1e-6
    shift = balance.shift(OMEGA)
    jacobian, rate = balance.derivative(x, OMEGA, shift)
    differences = [
        (balance.residual(x + step * e, OMEGA, shift) - balance.residual(x - step * e, OMEGA, shift)) / (2 * step)
        for e in np.eye(balance.size)
    ]
    assert jacobian == pytest.approx(np.transpose(differences), abs=2e-8 * np.abs(jacobian).max())
    if not law.approach_floor:  # its small part of the derivative is left out
        ahead, behind = (balance.residual(x, OMEGA + s, shift) for s in (step, -step))
        assert rate == pytest.approx((ahead - behind) / (2 * step), abs=2e-8 * np.abs(rate).max())


@pytest.mark.parametrize("law", [CONSERVATIVE[1], DISSIPATIVE[0]])
def test_a_growing_perturbation_has_the_derivative_of_its_frozen_growth(law):
    """Over one episode: exp(mu theta) dz is a perturbation like another, and mu = i shifts the orders by one."""
    series = SiteForces([(law, 0.5)]).series(np.array([[0.1, 1.0, 0.2j, 0.1]]), OMEGA)
    orders = np.arange(-3, 4)
    here, there = series.jacobian(1j, orders[:-1]), series.jacobian(0.0, orders[1:])
    assert here == pytest.approx(there, abs=1e-13 * np.abs(here).max())


def test_short_arcs_are_not_missed():
    theta = np.linspace(0, 2 * np.pi, 64, endpoint=False) + 0.3
    w = np.cos(theta) - 1, -np.sin(theta), -np.cos(theta)
    for depth in (1e-3, 1e-6, 1e-9):
        ((start, end),) = arcs(np.stack(w, axis=1), -depth)
        assert (end - start) / 2 == pytest.approx(np.arccos(1 - depth), rel=3e-3)
        assert (start + end) / 2 % (2 * np.pi) == pytest.approx(2 * np.pi - 0.3, abs=1e-4)


def test_an_arc_that_ends_exactly_with_the_period_is_not_missed():
    theta = np.linspace(0, 2 * np.pi, 64, endpoint=False) + 0.3
    motion = np.stack([np.cos(theta), -np.sin(theta), -np.cos(theta)], axis=1)
    ((start, end),) = arcs(motion, motion[0, 0])
    assert (start, end) == (pytest.approx(2 * np.pi - 0.6), pytest.approx(2 * np.pi))


def test_a_contact_that_never_separates():
    z = np.array([[3.0, 1.0]], complex)
    series = SiteForces([(CONSERVATIVE[0], 1.0)]).series(z, OMEGA)
    assert series.forces[0] == pytest.approx([6.0, 3.0, 0.0], abs=1e-13)
    assert series.closed == [1.0]
    with pytest.raises(ArithmeticError, match="never separates"):
        SiteForces([(DISSIPATIVE[0], 1.0)]).series(z, OMEGA)


def test_the_solution_does_not_depend_on_the_shift():
    forces = SiteForces([(CONSERVATIVE[1], 1.0)], [Spring(0, 1, 0.0, cubic=0.2)])
    balance = balance_of(forces, 5, "odd")
    x = balance.pack(motion_of(forces, 5, 2, "odd"))
    z, force = balance.unpack(x), balance.series(x, OMEGA).forces[:, :6]
    linear = z + np.einsum("kij,jk->ik", balance.compliance.at(np.arange(6) * OMEGA), force)
    for shift in (balance.shift(OMEGA), -balance.shift(OMEGA)):
        assert balance.residual(x, OMEGA, shift, linear) == pytest.approx(np.zeros(balance.size), abs=1e-14)
