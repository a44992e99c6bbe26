"""Harmonics of contact forces, and the balance at the places where a system is nonlinear."""

import itertools
from typing import Literal

import numpy as np
import pytest
from scipy.integrate import trapezoid

from tests.models import force_of
from vipetsc.case.nnm import NnmTable
from vipetsc.lattice import Contact, DenseCompliance, Spring
from vipetsc.modes.balance import conservative
from vipetsc.modes.balance.conservative import ConservativeMotions
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance, ShiftedCompliance
from vipetsc.modes.balance.harmonics import SiteForces, intervals_above
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError, NoMotionError
from vipetsc.modes.stops import Stops

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
    force = force_of(law, np.cos(theta), 0.5, -OMEGA * np.sin(theta), approach)
    loss = 2 * trapezoid(force * -np.sin(theta), theta)
    assert series.loss[0] == pytest.approx(loss, rel=1e-8)
    assert series.loss[0] > 0
    assert [episode.side for episode in series.episodes] == [1, -1]
    floored = max(approach, law.approach_floor)
    assert [episode.approach for episode in series.episodes] == pytest.approx([floored] * 2)


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


def test_short_arcs_are_not_missed():
    """The arc of cos(theta + 0.3) - 1 above -d has the half-width arccos(1 - d), also far below the sample spacing."""
    theta = np.linspace(0, 2 * np.pi, 64, endpoint=False) + 0.3
    motion = np.stack([np.cos(theta) - 1, -np.sin(theta), -np.cos(theta)], axis=1)
    # The shortest of these arcs is a thousandth of the distance between samples.
    for depth in (1e-3, 1e-6, 1e-9):
        ((start, end),) = intervals_above(motion, -depth)
        assert (end - start) / 2 == pytest.approx(np.arccos(1 - depth), rel=3e-3)
        assert (start + end) / 2 % (2 * np.pi) == pytest.approx(2 * np.pi - 0.3, abs=1e-4)


def test_a_contact_that_never_separates_is_a_spring_if_it_is_conservative_and_refused_else():
    """A contact closed all the time has the force k (w - D); with losses it is refused."""
    z = np.array([[3.0, 1.0]], complex)
    series = SiteForces([Stops.both(CONSERVATIVE[0], 1.0)]).series(z, OMEGA)
    assert series.forces[0] == pytest.approx([6.0, 3.0, 0.0], abs=1e-13)
    assert series.closed == [1.0]

    # The loss depends on the approach velocity of an onset, which an unswitched contact does not have.
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


def test_a_case_has_the_harmonics_with_which_a_branch_begins():
    """The guess of a start and the harmonics that are brought in never have more than ``nnm.harmonics``."""
    NnmTable(harmonics=conservative.FEWEST)
    with pytest.raises(ValueError, match="harmonics"):
        NnmTable(harmonics=conservative.FEWEST - 1)


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


def one_mass(**options: object) -> ConservativeMotions:
    """Return the motions of a mass of 1 kg on a spring of 1 N/m with a stop of 20 N/m, 1 m away on one side."""
    compliance = DenseCompliance(np.ones(1), np.array([[1.0]]), np.array([[1.0]]))
    stops = Stops(Contact("bilinear", 20.0), 1.0, np.inf)
    return ConservativeMotions(compliance, SiteForces([stops]), NnmTable(tolerance=1e-12, **options))
