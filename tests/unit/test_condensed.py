"""Harmonics of contact forces, and the balance at the places where a system is nonlinear."""

import itertools
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from scipy.integrate import trapezoid

from vipetsc.case.nnm import NnmTable
from vipetsc.lattice import Chain, Contact, DenseCompliance, ModalCompliance, Spring, UnitCell, WaveCompliance
from vipetsc.modes.balance import conservative
from vipetsc.modes.balance.conservative import ConservativeMotions, HarmonicFrame, fraction_closed
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance, ShiftedCompliance
from vipetsc.modes.balance.harmonics import SiteForces, intervals_above
from vipetsc.modes.balance.stops import Stops
from vipetsc.modes.point import Point
from vipetsc.modes.problem import Attempt, ContinuationError, NoMotionError

Symmetry = Literal["at rest", "odd", "any"]

CONSERVATIVE = [Contact("bilinear", 3.0), Contact("hertz", 3.0)]
DISSIPATIVE = [
    Contact("hertz", 3.0, 0.7),
    Contact("hertz", 3.0, 0.8, factor="exact"),
    Contact("bilinear", 3.0, 0.3, "clip"),
    Contact("hertz", 3.0, 0.7, approach_floor=1.5),
]
OMEGA = 0.77


class DefinedCompliance:
    """Compliance G = b^T (K - omega^2 M)^-1 b of a system with dense matrices, solved for at each frequency."""

    def __init__(self, masses: np.ndarray, stiffness: np.ndarray, rows: np.ndarray) -> None:
        self.masses = masses
        self.stiffness = stiffness
        self.rows = rows

    def at(self, omegas: np.ndarray) -> np.ndarray:
        kind = np.result_type(np.asarray(omegas), float)
        values = []
        for omega in np.asarray(omegas):
            dynamic = self.stiffness - omega**2 * np.diag(self.masses)
            values.append(self.rows @ np.linalg.solve(dynamic, self.rows.T.astype(kind)))
        return np.array(values)


def random_harmonics(forces: SiteForces, order: int, seed: int, symmetry: Symmetry) -> np.ndarray:
    """Return random harmonics (pairs, order + 1) that pass the clearances; ``at rest``: odd and at rest at phase 0."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(forces.pairs, order + 1)) + 1j * rng.normal(size=(forces.pairs, order + 1))
    # Harmonics fall as in a smooth motion, and the first one passes the clearances.
    z *= 0.7 ** np.arange(order + 1)
    z[:, 0] = 0.2 * z[:, 0].real
    z[:, 1] += 2
    if symmetry != "any":
        z[:, ::2] = 0
    if symmetry == "at rest":
        return z.real + 0j
    return z


def random_balance(forces: SiteForces, order: int, symmetry: Symmetry) -> HarmonicBalance:
    """Return the equations of a random system with five degrees of freedom, on which ``forces`` act."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(5, 5))
    stiffness = root @ root.T + np.eye(5)
    compliance = DefinedCompliance(np.ones(5), stiffness, rng.normal(size=(forces.pairs, 5)))
    return HarmonicBalance(compliance, forces, order, odd=symmetry != "any", cosines=symmetry == "at rest")


def harmonics_of(samples: np.ndarray, orders: int) -> np.ndarray:
    """Return the one-sided harmonics (..., orders) of a period sampled uniformly along the last axis."""
    harmonics = np.fft.rfft(samples)[..., :orders] / samples.shape[-1] * 2
    harmonics[..., 0] /= 2
    return harmonics


@pytest.mark.slow
@pytest.mark.parametrize("law", CONSERVATIVE)
@pytest.mark.parametrize("seed", range(3))
def test_force_harmonics_are_those_of_a_dense_sampling(law, seed):
    """Harmonics of forces, potential and closed time are those of 2^18 samples; elastic contacts have no loss."""
    forces = SiteForces([Stops.both(law, 1.0), Stops(law, 0.8, 0.4), Stops(law, 0.5, np.inf)])
    order = 9
    z = random_harmonics(forces, order, seed, "any")

    series = forces.series(z, OMEGA)

    theta = np.linspace(0, 2 * np.pi, 2**18, endpoint=False)
    phasors = np.exp(1j * np.arange(order + 1)[:, None] * theta)
    w = np.sum(z[..., None] * phasors, axis=1).real
    pairs = list(zip(w, forces.contacts, strict=True))
    sampled = np.array([law.elastic_force(w - s.plus) - law.elastic_force(-w - s.minus) for w, s in pairs])
    potential = [(law.elastic_energy(w - s.plus) + law.elastic_energy(-w - s.minus)).mean() for w, s in pairs]
    # A kink of the force lies up to half a sample beside one of the 2**18 samples; the error goes with its square.
    assert series.forces == pytest.approx(harmonics_of(sampled, 2 * order + 1), abs=1e-9 * np.abs(sampled).max())
    assert series.potential == pytest.approx(potential, rel=1e-9)
    assert np.abs(series.loss).max() < 1e-10
    # The closed part of a period is counted in whole samples.
    closed = (w > [[1.0], [0.8], [0.5]]) | (-w > [[1.0], [0.4], [np.inf]])
    assert series.closed == pytest.approx(closed.mean(axis=1), abs=1e-4)


def test_time_in_which_several_contacts_are_closed_counts_once():
    """Three contacts, each closed for a third of the period, two of them at once for 40 degrees, are so for 320."""
    law = Contact("bilinear", 3.0)
    forces = SiteForces([Stops(law, 0.5, np.inf)] * 3)
    # cos(theta - shift) is above 1/2 within 60 degrees of the shift: from -60 to 60, 30 to 150 and 190 to 310 degrees.
    shifts = np.radians([0.0, 90.0, 250.0])
    z = np.column_stack([np.zeros(3), np.exp(-1j * shifts)])

    assert fraction_closed(forces.series(z, OMEGA)) == pytest.approx(320 / 360, abs=1e-9)
    # One contact alone, and none.
    assert fraction_closed(forces.series(z * [[1], [0], [0]], OMEGA)) == pytest.approx(120 / 360, abs=1e-9)
    assert fraction_closed(forces.series(0 * z, OMEGA)) == 0.0


def test_smooth_springs_have_the_harmonics_of_powers_of_a_cosine():
    """A spring 2 w^2 + w^3/2 under w = 3 cos theta has the harmonics of these powers of a cosine."""
    spring = Spring(0, 1, 0.0, quadratic=2.0, cubic=0.5)
    series = SiteForces([], [spring]).series(np.array([[0.0, 3.0]]), OMEGA)
    # 2 cos^2 = 1 + cos 2 and 4 cos^3 = 3 cos + cos 3.
    assert series.forces[0] == pytest.approx([9.0, 0.5 * 27 * 0.75, 9.0], abs=1e-12)


@pytest.mark.parametrize("law", DISSIPATIVE)
def test_a_dissipative_contact_loses_the_work_of_its_force(law):
    """The loss of w = cos theta at two stops is twice the integral of F dw over the closed time of one."""
    forces = SiteForces([Stops.both(law, 0.5)])

    series = forces.series(np.array([[0.0, 1.0]], complex), OMEGA)

    # w = cos theta passes -1/2 and 1/2 with |dw/dtheta| = sqrt(3)/2 and returns there symmetrically.
    theta = np.linspace(-np.pi / 3, np.pi / 3, 400001)
    approach = OMEGA * np.sqrt(0.75)
    force = law.force(np.cos(theta), 0.5, -OMEGA * np.sin(theta), approach)
    loss = 2 * trapezoid(force * -np.sin(theta), theta)
    assert series.loss[0] == pytest.approx(loss, rel=1e-8)
    assert series.loss[0] > 0
    assert [episode.side for episode in series.episodes] == [1, -1]
    floored = max(approach, law.approach_floor)
    assert [episode.approach for episode in series.episodes] == pytest.approx([floored] * 2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "symmetry"),
    [*itertools.product(CONSERVATIVE, ("at rest", "odd", "any")), *itertools.product(DISSIPATIVE, ("odd", "any"))],
)
def test_derivatives_are_those_of_the_residual(law, symmetry):
    """The Jacobian and the derivative by omega of the residual agree with central differences."""
    # A quadratic spring would break the symmetry of odd motions.
    quadratic = 0.3 if symmetry == "any" else 0.0
    forces = SiteForces(
        [Stops.both(law, 1.0), Stops.both(law, 0.8)], [Spring(0, 1, 0.0, quadratic=quadratic, cubic=0.2)]
    )
    balance = random_balance(forces, 7, symmetry)
    x = balance.pack(random_harmonics(forces, 7, 1, symmetry))
    shift = balance.shift(OMEGA)

    jacobian = balance.jacobian(x, OMEGA, shift)
    rate = balance.rate(x, OMEGA, shift)

    assert_derivatives_by_differences(balance, x, shift, jacobian)
    # The derivative of a force with a floor of the approach velocity omits a small part.
    if not law.approach_floor:
        step = 1e-6
        ahead = balance.residual(x, OMEGA + step, shift)
        behind = balance.residual(x, OMEGA - step, shift)
        assert rate == pytest.approx((ahead - behind) / (2 * step), abs=2e-8 * np.abs(rate).max())


@pytest.mark.parametrize("symmetry", ["odd", "any"])
def test_a_drive_adds_its_term_to_the_residual_of_every_motion(symmetry):
    """The residual is linear in the driven linear motion: with and without it, residuals differ by ``drive_term``."""
    forces = hardening_forces()
    balance = random_balance(forces, 5, symmetry)
    x = balance.pack(random_harmonics(forces, 5, 2, symmetry))
    shift = balance.shift(OMEGA)
    linear = balance.unpack(balance.pack(random_harmonics(forces, 5, 3, symmetry)))

    term = balance.drive_term(OMEGA, shift, linear)

    added = balance.residual(x, OMEGA, shift, linear) - balance.residual(x, OMEGA, shift)
    assert term == pytest.approx(added, abs=1e-13 * np.abs(added).max())


def assert_derivatives_by_differences(
    balance: HarmonicBalance, x: np.ndarray, shift: np.ndarray, jacobian: np.ndarray
) -> None:
    """Assert that ``jacobian`` agrees with central differences of the residual, whose error is 1e-8 with this step."""
    step = 1e-6
    columns = []
    for e in np.eye(balance.size):
        ahead = balance.residual(x + step * e, OMEGA, shift)
        behind = balance.residual(x - step * e, OMEGA, shift)
        columns.append((ahead - behind) / (2 * step))
    assert jacobian == pytest.approx(np.transpose(columns), abs=2e-8 * np.abs(jacobian).max())


@pytest.mark.parametrize("law", [CONSERVATIVE[1], DISSIPATIVE[0]])
def test_a_growing_perturbation_has_the_derivative_of_its_frozen_growth(law):
    """A perturbation exp(mu theta) dz with mu = i has the derivative of a periodic one whose orders are one higher."""
    series = SiteForces([Stops.both(law, 0.5)]).series(np.array([[0.1, 1.0, 0.2j, 0.1]]), OMEGA)
    orders = np.arange(-3, 4)
    growing = series.jacobian(1j, orders[:-1])
    shifted = series.jacobian(0.0, orders[1:])
    assert growing == pytest.approx(shifted, abs=1e-13 * np.abs(growing).max())


def test_short_arcs_are_not_missed():
    """The arc of cos(theta + 0.3) - 1 above -d has the half-width arccos(1 - d), also far below the sample spacing."""
    theta = np.linspace(0, 2 * np.pi, 64, endpoint=False) + 0.3
    motion = np.stack([np.cos(theta) - 1, -np.sin(theta), -np.cos(theta)], axis=1)
    # The shortest of these arcs is a thousandth of the distance between samples.
    for depth in (1e-3, 1e-6, 1e-9):
        ((start, end),) = intervals_above(motion, -depth)
        assert (end - start) / 2 == pytest.approx(np.arccos(1 - depth), rel=3e-3)
        assert (start + end) / 2 % (2 * np.pi) == pytest.approx(2 * np.pi - 0.3, abs=1e-4)


def test_an_arc_that_ends_exactly_with_the_period_is_not_missed():
    """An arc of cos above its value at the first sample ends with the period, 2 pi, and has the length 0.6."""
    theta = np.linspace(0, 2 * np.pi, 64, endpoint=False) + 0.3
    motion = np.stack([np.cos(theta), -np.sin(theta), -np.cos(theta)], axis=1)
    ((start, end),) = intervals_above(motion, motion[0, 0])
    assert start == pytest.approx(2 * np.pi - 0.6)
    assert end == pytest.approx(2 * np.pi)


def test_a_contact_that_never_separates_is_a_spring_if_it_is_conservative_and_refused_else():
    """A contact closed all the time has the force k (w - D); with losses it is refused."""
    z = np.array([[3.0, 1.0]], complex)
    series = SiteForces([Stops.both(CONSERVATIVE[0], 1.0)]).series(z, OMEGA)
    assert series.forces[0] == pytest.approx([6.0, 3.0, 0.0], abs=1e-13)
    assert series.closed == [1.0]

    # The loss depends on the approach velocity of an onset, which a permanent contact does not have.
    with pytest.raises(NoMotionError, match="never separates"):
        SiteForces([Stops.both(DISSIPATIVE[0], 1.0)]).series(z, OMEGA)


def hardening_forces() -> SiteForces:
    return SiteForces([Stops.both(CONSERVATIVE[1], 1.0)], [Spring(0, 1, 0.0, cubic=0.2)])


@pytest.mark.parametrize("pairs", [1, 2])
@pytest.mark.parametrize("detuning", [0.0, 1e-9, 1e-5, 1e-3])
def test_the_rate_is_exact_beside_a_mode_that_hardly_moves_the_pairs(detuning, pairs):
    """Stiff springs at the pairs: the pole of the shifted compliance is 4e-5 of the frequency beside the mode."""
    stiffness = np.array([[1.2e4, -1e4, -1e3, 0], [-1e4, 1e4, 0, 0], [-1e3, 0, 1.4e4, -1.2e4], [0, 0, -1.2e4, 1.2e4]])
    rows = np.array([[-1.0, 1.0, 0, 0], [0, 0, -1.0, 1.0]])[:pairs]
    dense = DenseCompliance(np.array([1.0, 0.15, 1.0, 0.2]), stiffness, rows)
    omega = float(np.sqrt(dense.squared[0])) * (1 + detuning)
    orders = np.array([1, 3])
    shifted = ShiftedCompliance(dense, pairs, orders, 1.0)
    shift = shifted.shift(omega)
    step = 1e-8 * omega
    ends = [dense.with_springs(orders * omega + sign * step, shift[:, 0, 0]) for sign in (1, -1)]
    expected = (ends[0] - ends[1]) / (2 * step)
    found = shifted.rate(omega, shift)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-5 * np.abs(other).max())


@pytest.mark.parametrize("compliance", [ModalCompliance, WaveCompliance])
@pytest.mark.parametrize("detuning", [0.0, 1e-7, 1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("stiffness", [1e3, 3e3, 1e4, 1e5])
def test_the_rate_from_values_around_the_frequency_is_that_of_all_modes(stiffness, detuning, compliance):
    """Stiff springs in the cells: the pole of the shifted compliance is within 3e-4 of the frequency of the mode.

    Without all modes its derivative is taken on a circle around the frequency, which must not contain the pole.
    """
    cell = UnitCell((1.0, 0.15), (Spring(0, 0, 1e3, offset=1), Spring(0, 1, stiffness)), host=0, resonator=1)
    chain = Chain(cell, 3, sites=(1,))
    rows = ModalCompliance(chain).loads.T
    dense = DenseCompliance(chain.masses(), chain.stiffness_matrix().toarray(), rows)
    omega = float(np.sqrt(dense.squared[0])) * (1 + detuning)
    orders = np.array([1, 3])
    exact = ShiftedCompliance(dense, 1, orders, 1.0)
    shift = exact.shift(omega)
    expected = exact.rate(omega, shift)
    found = ShiftedCompliance(compliance(chain), 1, orders, 1.0).rate(omega, shift)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_branch_begins_at_a_mode_that_hardly_moves_its_pair():
    """A cell's stiff spring lies beside the contact: the motion of the mode has its frequency."""
    stiffness = np.array([[1.2e4, -1e4], [-1e4, 1e4]])
    row = np.array([[-1.0, 1.0]])
    dense = DenseCompliance(np.array([1.0, 0.15]), stiffness, row)
    omega = float(np.sqrt(dense.squared[0]))
    motions = ConservativeMotions(dense, SiteForces([Stops(CONSERVATIVE[0], 1.0, np.inf)]), NnmTable())
    point = motions.from_mode(0.01 * row @ dense.vectors[:, 0], omega)
    assert 2 * np.pi / point.period == pytest.approx(omega, rel=1e-12)


def test_the_solution_does_not_depend_on_the_shift():
    """A motion that solves the equations solves them with any shift."""
    forces = hardening_forces()
    balance = random_balance(forces, 5, "odd")
    x = balance.pack(random_harmonics(forces, 5, 2, "odd"))
    z = balance.unpack(x)
    force = balance.series(x, OMEGA).forces[:, :6]
    # Any motion Z with contact forces F is a solution under the linear motion Z + G F.
    linear = z + np.einsum("kij,jk->ik", balance.compliance.at(np.arange(6) * OMEGA), force)
    for shift in (balance.shift(OMEGA), -balance.shift(OMEGA)):
        assert balance.residual(x, OMEGA, shift, linear) == pytest.approx(np.zeros(balance.size), abs=1e-14)


@pytest.mark.parametrize("weight", [0.1, 0.4, 1.0])
@pytest.mark.parametrize("symmetry", ["odd", "any"])
def test_a_weight_multiplies_the_compliance_of_harmonics_above_the_first(symmetry, weight):
    """The residual with a weight has weight times G at all orders above 1, and its Jacobian follows."""
    forces = hardening_forces()
    whole = random_balance(forces, 5, symmetry)
    balance = whole.weighted(weight)
    x = balance.pack(random_harmonics(forces, 5, 2, symmetry))
    z = balance.unpack(x)
    assert (balance.size, balance.weight, whole.weight) == (whole.size, weight, 1.0)

    # Under the linear motion Z + weight G F the motion is a solution; mean and first harmonic have all of G.
    factor = np.full(6, weight)
    factor[:2] = 1.0
    compliance = factor[:, None, None] * whole.compliance.at(np.arange(6) * OMEGA)
    linear = z + np.einsum("kij,jk->ik", compliance, balance.series(x, OMEGA).forces[:, :6])
    shift = balance.shift(OMEGA)
    assert balance.residual(x, OMEGA, shift, linear) == pytest.approx(np.zeros(balance.size), abs=1e-14)

    jacobian = balance.jacobian(x, OMEGA, shift)
    assert_derivatives_by_differences(balance, x, shift, jacobian)


def test_the_shift_is_the_effective_mass_of_the_system_whatever_the_weight():
    """Far above all modes the shift of order k is k^2 omega^2 m with the effective mass m: there G = -1/(omega^2 m)."""
    forces = hardening_forces()
    whole = random_balance(forces, 9, "odd")
    mass = 1 / np.diag(whole.compliance.rows @ whole.compliance.rows.T).mean()
    # Stiffnesses are of the order 10 N/m: at 1e3 rad/s the inertia alone counts.
    omega = 1e3
    for weight in (0.1, 1.0):
        shift = whole.weighted(weight).shift(omega)
        assert np.abs(shift[:, 0, 0]) == pytest.approx(mass * (whole.orders * omega) ** 2, rel=1e-3)


def gap_motions(**options: object) -> ConservativeMotions:
    """Return the motions of two masses with a hardening contact, whose breathers have frequencies above both modes."""
    stiffness = np.array([[2.0, -1.0], [-1.0, 2.0]])
    compliance = DefinedCompliance(np.ones(2), stiffness, np.array([[1.0, 0.0]]))
    control = NnmTable(tolerance=1e-12, truncation=1e-4, **options)
    return ConservativeMotions(compliance, SiteForces([Stops.both(CONSERVATIVE[1], 1.0)]), control)


def record_weights(monkeypatch) -> list[float]:
    """Return a list that receives each weight with which the harmonics above the first are tried from now on."""
    tried: list[float] = []
    weighted = HarmonicBalance.weighted

    def record(balance: HarmonicBalance, weight: float) -> HarmonicBalance:
        tried.append(weight)
        return weighted(balance, weight)

    monkeypatch.setattr(HarmonicBalance, "weighted", record)
    return tried


def test_the_harmonics_above_the_first_are_brought_in_by_growing_weights(monkeypatch):
    """Weights grow in steps that are 1.6 times as long as the last one, and the motion of weight 1 is a solution."""
    tried = record_weights(monkeypatch)
    point = gap_motions().in_gap(2.1, np.array([1.0]))
    # Steps are 0.1, 0.16, 0.256, 0.4096, and the rest to 1.
    assert tried == pytest.approx([0.1, 0.26, 0.516, 0.9256, 1.0])
    assert point.frequency == pytest.approx(2.1 / (2 * np.pi), rel=1e-14)
    assert point.residual < 1e-11


def test_a_weight_at_which_the_motion_changes_too_much_is_tried_again_shorter(monkeypatch):
    """A step of the weight after which the motion changes too much is cut to 0.4 of it, down to the smallest step."""
    tried = record_weights(monkeypatch)
    # No change is small enough: steps are 0.1 times powers of 0.4, until the next one is below the smallest step.
    monkeypatch.setattr(conservative, "FURTHEST", 0.0)
    reason = r"no breather at 2\.1 rad/s: with 0 of the harmonics above the first, the motion changes by more than"
    with pytest.raises(ContinuationError, match=reason) as error:
        gap_motions().in_gap(2.1, np.array([1.0]))
    assert tried == pytest.approx(0.1 * 0.4 ** np.arange(8))
    # Newton's method has converged each time: more steps of it are no remedy.
    assert "Newton" not in str(error.value)


def test_harmonics_with_which_newtons_method_fails_are_told_with_its_reason(monkeypatch):
    """If Newton's method fails, the error has its reason and the keys to change."""
    gap = gap_motions()
    solve = HarmonicFrame.solve

    def fail(frame: HarmonicFrame, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        attempt = solve(frame, guess, row, value)
        return replace(attempt, converged=False, reason="the test says so")

    monkeypatch.setattr(HarmonicFrame, "solve", fail)
    reason = r"Newton's method ends \(the test says so\); change nnm.start_frequency or raise nnm.max_newton"
    with pytest.raises(ContinuationError, match=reason):
        gap.in_gap(2.1, np.array([1.0]))


def test_a_case_has_the_harmonics_with_which_a_branch_begins():
    """The guess of a start and the harmonics that are brought in never have more than ``nnm.harmonics``."""
    NnmTable(harmonics=conservative.FEWEST)
    with pytest.raises(ValueError, match="harmonics"):
        NnmTable(harmonics=conservative.FEWEST - 1)


def test_a_weight_cut_to_1_in_vain_is_followed_by_a_smaller_one(monkeypatch):
    """The problem of the weight 1 is not solved twice from the same guess."""
    tried = record_weights(monkeypatch)
    solve = HarmonicFrame.solve

    def fail_once_at_1(frame: HarmonicFrame, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        attempt = solve(frame, guess, row, value)
        # ``refined`` solves with all harmonics without asking for a weight.
        if tried.count(1.0) == 1 and tried[-1] == 1.0:
            attempt.converged = False
        return attempt

    monkeypatch.setattr(HarmonicFrame, "solve", fail_once_at_1)
    gap_motions().in_gap(2.1, np.array([1.0]))
    # The step of 0.0744 to the weight 1 is cut to 0.4 of it; the next one, 1.6 times as long, ends at 1.
    assert tried == pytest.approx([0.1, 0.26, 0.516, 0.9256, 1.0, 0.95536, 1.0])


def coupled_masses(masses: int, coupling: float) -> ConservativeMotions:
    """Return the motions of masses of 1 kg with contacts, on springs of 1 N/m, and ``coupling`` N/m between them."""
    neighbours = coupling * (np.eye(masses, k=1) + np.eye(masses, k=-1))
    stiffness = (1 + 2 * coupling) * np.eye(masses) - neighbours
    compliance = DefinedCompliance(np.ones(masses), stiffness, np.eye(masses))
    forces = SiteForces([Stops.both(CONSERVATIVE[1], 1.0)] * masses)
    return ConservativeMotions(compliance, forces, NnmTable(tolerance=1e-12, truncation=1e-4))


@pytest.mark.parametrize("coupling", [0.3, 1.0])
@pytest.mark.parametrize("sign", [1, -1])
def test_contacts_that_feel_one_another_have_the_motion_of_one_mass_on_its_share_of_the_springs(sign, coupling):
    """Two equal masses move as one mass on 1 + 2 c - c N/m in phase and 1 + 2 c + c N/m out of phase.

    The spring c between them is not strained in phase; out of phase its middle is at rest.
    """
    omega = 1.05 * np.sqrt(1 + 3 * coupling)
    point = coupled_masses(2, coupling).in_gap(omega, np.array([1.0, sign]))

    # A mass has springs of the stiffness ``coupling`` to a wall and to its neighbour, and one of 1 N/m.
    share = 1 + 2 * coupling - sign * coupling
    compliance = DefinedCompliance(np.ones(1), np.array([[share]]), np.eye(1))
    forces = SiteForces([Stops.both(CONSERVATIVE[1], 1.0)])
    alone = ConservativeMotions(compliance, forces, NnmTable(tolerance=1e-12, truncation=1e-4))
    reference = alone.in_gap(omega, np.array([1.0]))
    assert point.elongations == pytest.approx(reference.elongations[0] * np.array([1, sign]), rel=1e-9)
    assert point.energy == pytest.approx(2 * reference.energy, rel=1e-9)


def test_a_motion_with_other_signs_is_not_taken_for_the_one_that_is_asked_for():
    """A motion in phase, to which Newton's method converges here, is refused where the middle mass has the sign -1."""
    with pytest.raises(ContinuationError, match="no breather at"):
        coupled_masses(3, coupling=1.0).in_gap(2.20605, np.array([1.0, -1.0, 1.0]))


def test_a_motion_in_a_gap_needs_a_sign():
    with pytest.raises(ValueError, match="signs are 0 for all pairs"):
        gap_motions().in_gap(2.1, np.zeros(1))


def test_the_state_of_rest_is_no_motion():
    """A guess within the clearance is refused: no force acts, and rest is the only motion of a frequency in a gap."""
    motions = gap_motions()
    guess = motions._guess(motions.one_harmonic(np.array([0.5])), 2.1)
    with pytest.raises(ContinuationError, match="the state of rest"):
        motions.refined(guess, keep_frequency=True)


def test_folds_are_sought_where_both_motions_have_contact():
    """Frequencies of linear motions differ by rounding alone, hence a change of sign between them is no fold."""
    motions = one_mass(truncation=1e-3)
    linear = motions.from_mode(np.array([0.99]), 1.0)
    touching = motions.from_mode(np.array([1.05]), 1.0)
    assert (linear.episodes, touching.episodes) == (0, 1)

    def kinds(left: Point, right: Point) -> list[str]:
        return [kind.name for kind in motions.special_kinds(left, right)]

    assert kinds(touching, touching) == ["fold-energy", "fold-frequency"]
    assert kinds(linear, touching) == kinds(touching, linear) == kinds(linear, linear) == []


def test_folds_of_motions_that_are_never_linear_are_sought_everywhere():
    """Folds are searched for between motions without contact, too, where a spring is nonlinear."""
    compliance = DenseCompliance(np.ones(1), np.eye(1), np.eye(1))
    motions = ConservativeMotions(compliance, SiteForces([], [Spring(0, 1, 0.0, cubic=0.2)]), NnmTable())
    point = motions.from_mode(np.array([0.1]), 1.0)
    assert point.episodes == 0
    assert len(list(motions.special_kinds(point, point))) == 2


def one_mass(**options: object) -> ConservativeMotions:
    """Return the motions of a mass of 1 kg on a spring of 1 N/m with a stop of 20 N/m, 1 m away on one side."""
    compliance = DenseCompliance(np.ones(1), np.array([[1.0]]), np.array([[1.0]]))
    stops = Stops(Contact("bilinear", 20.0), 1.0, np.inf)
    return ConservativeMotions(compliance, SiteForces([stops]), NnmTable(tolerance=1e-12, **options))


def test_a_start_whose_guess_needs_fewer_harmonics_than_the_motion_has_enough():
    """A motion whose truncation is too large with the harmonics of its guess gets more harmonics."""
    motions = one_mass(truncation=4e-4)
    z = np.array([1.01])
    guess = motions._guess(motions.one_harmonic(z), 1.0)
    assert motions.order_near(guess) == guess.order

    point = motions.from_mode(z, 1.0)

    assert point.order > guess.order
    assert point.truncation <= conservative.MORE * 4e-4


@pytest.mark.parametrize("harmonics", [20, 21])
def test_the_highest_order_is_odd_and_a_start_that_needs_more_has_it(harmonics):
    """A start that needs more orders than ``nnm.harmonics`` has the largest odd number of them."""
    point = one_mass(truncation=1e-9, harmonics=harmonics).from_mode(np.array([1.01]), 1.0)
    assert point.truncation > 1e-9
    assert point.order == {20: 19, 21: 21}[harmonics]
