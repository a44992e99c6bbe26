"""Work that a fit saves: derivatives of coefficients, the Jacobian at its end, and digits that noise hides."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from tests.unit.test_trial_cases import QUANTITIES, base_of, sought
from vipetsc.case import CaseError
from vipetsc.case.trial import TrialCases
from vipetsc.identification import motion
from vipetsc.identification.coefficient_slopes import CoefficientSlopes
from vipetsc.identification.least_residuals import _Step, least_residuals
from vipetsc.identification.motion import MotionCoefficients
from vipetsc.identification.precision import EXACT, FINAL, GROWING, ROUGHEST, TOLERANCE, Precision
from vipetsc.lattice import Chain

TIMES = np.linspace(0, 1, 20)
DATA = 2 * np.exp(-3 * TIMES) + 0.01 * np.random.default_rng(2).standard_normal(20)
BOUNDS = (np.zeros(2), np.full(2, 10.0))


def residuals(x: np.ndarray) -> np.ndarray:
    """Return residuals (datum,) of a decaying exponential."""
    return x[0] * np.exp(-x[1] * TIMES) - DATA


def slopes(x: np.ndarray) -> np.ndarray:
    """Return derivatives (datum, 2) of the residuals."""
    decay = np.exp(-x[1] * TIMES)
    return np.column_stack([decay, -x[0] * TIMES * decay])


@pytest.mark.parametrize("precision", [FINAL, GROWING, Precision(cost=1e-5)])
def test_a_fit_ends_where_scipys_does_with_one_jacobian_less(precision):
    """A fit ends at the point of ``scipy.optimize.least_squares``, to the bit, and computes one Jacobian less."""
    counted = [0, 0]

    def count(x: np.ndarray) -> np.ndarray:
        counted[0] += 1
        return residuals(x)

    def differentiate(x: np.ndarray) -> np.ndarray:
        counted[1] += 1
        return slopes(x)

    start = np.array([1.0, 1.0])
    found = least_residuals(count, differentiate, start, BOUNDS, precision, 50)
    tolerances = {"xtol": precision.step, "ftol": precision.cost, "gtol": TOLERANCE}
    expected = least_squares(residuals, start, jac=slopes, bounds=BOUNDS, max_nfev=50, **tolerances)
    assert expected.status in (2, 3, 4)
    assert found.tolist() == expected.x.tolist()
    assert counted == [expected.nfev, expected.njev - 1]


@pytest.mark.parametrize(("length", "ends"), [(0.9995e-6, True), (1.0005e-6, False)])
def test_a_small_step_is_judged_by_where_it_begins(length, ends):
    """A step from 0 ends a fit if it is below the square of the tolerance, as in SciPy, however far it leads."""
    step = _Step(x=np.zeros(1), residuals=np.ones(1), slopes=np.zeros((1, 1)))
    # The cost falls by much, so that the length of the step alone decides.
    assert step.ends_at(np.array([length]), np.full(1, 0.5), Precision(cost=1e-2, step=1e-3)) == ends


def test_a_bad_model_of_a_step_does_not_end_a_fit():
    """A fit goes on from a start at which wrong derivatives make a step gain little, and ends at the same minimum."""

    def wrong(x: np.ndarray) -> np.ndarray:
        return 1e-4 * slopes(x) if np.array_equal(x, start) else slopes(x)

    start = np.array([1.0, 1.0])
    found = least_residuals(residuals, wrong, start, BOUNDS, FINAL, 80)
    right = least_residuals(residuals, slopes, start, BOUNDS, FINAL, 80)
    assert found == pytest.approx(right, rel=1e-6)


# The quantities on which the force of a moved wall depends.
OF_WALL = ("spring", "amplitude", "mass")


@pytest.mark.parametrize(
    ("name", "quantity"),
    [*(("two sides", quantity) for quantity in QUANTITIES), *(("wall", quantity) for quantity in OF_WALL)],
)
def test_derivatives_of_coefficients_are_differences_of_cases(name, quantity):
    """Derivatives of a model's coefficients agree with central differences of cases, far from the start of the fit.

    Derivatives that do not depend on the place are computed once, at the start, by differences of another width.
    """
    base = base_of(name)
    # A second parameter moves too, since derivatives by the first one may depend on it.
    parameters = [p._replace(low=0.2 * p.start, high=5 * p.start or 1.0) for p in sought(base, quantity, "all")]
    parameters += [p._replace(low=0.1 * p.start, high=5 * p.start) for p in sought(base, "spring", "each")[:1]]
    if quantity == "spring":
        parameters = [p._replace(low=0.2 * p.start, high=5 * p.start) for p in sought(base, "spring", "each")[:2]]
    trials = TrialCases(base, parameters, {})
    z = np.array([0.3, 0.4])
    if quantity in ("restitution", "exponent"):
        z[0] = 0.18 if quantity == "restitution" else 0.2
    values = [p.from_coordinate(x) for p, x in zip(parameters, z, strict=True)]
    model = trials.case(values).model()
    middle = MotionCoefficients.of(model)
    found = CoefficientSlopes(parameters, trials).at(z, 0, model, middle).coefficients

    h = 1e-3
    ends = []
    for step in (-h, h):
        moved = [parameters[0].from_coordinate(z[0] + step), values[1]]
        at = trials.case(moved).model()
        ends.append((MotionCoefficients.of(at), at.chain.cell.springs))
    (before, springs_before), (after, springs_after) = ends
    for key in ("masses", "stiffness", "damping"):
        expected = (getattr(after, key) - getattr(before, key)) / (2 * h)
        assert getattr(found, key) == pytest.approx(expected, rel=1e-5, abs=1e-12)
    for column, key in enumerate(("clearance", "clearance_minus")):
        assert found.gaps[:, column] == pytest.approx((after.sites[key] - before.sites[key]) / (2 * h), rel=1e-6)
    elastic = [(at.sites["elastic"]["stiffness"], at.sites["elastic"]["exponent"]) for at in (before, after)]
    for column in (0, 1):
        assert found.laws[:, column] == pytest.approx((elastic[1][column] - elastic[0][column]) / (2 * h), rel=1e-5)
    damping = (after.sites["damping"] - before.sites["damping"]) / (2 * h)
    assert found.laws[:, 2] == pytest.approx(damping, rel=1e-4, abs=1e-12)
    assert found.drives * middle.gains == pytest.approx((after.gains - before.gains) / (2 * h), rel=1e-5, abs=1e-9)
    for column, key in enumerate(("quadratic", "cubic")):
        parts = [[getattr(spring, key) for spring in springs] for springs in (springs_before, springs_after)]
        assert found.curves[:, column] == pytest.approx(np.subtract(*parts[::-1]) / (2 * h), rel=1e-6)


def test_a_start_that_is_no_case_leaves_derivatives_to_the_place_where_they_are_asked_for():
    base = base_of("wall")
    parameters = sought(base, "quadratic", "all")
    parameters = [parameters[0]._replace(low=-1.0, high=1e5, start=1e4)]
    trials = TrialCases(base, parameters, {})
    with pytest.raises(CaseError):
        trials.case([1e4])
    assert CoefficientSlopes(parameters, trials)._by_value(0) is None


def test_motions_are_as_exact_as_the_noise_needs():
    """Tolerances of motions follow the noise: exact at the end, rough at first, and never finer than exact."""
    assert FINAL.tolerances(0.02).motion == EXACT.motion
    assert GROWING.tolerances(0.02).motion == ROUGHEST
    # For records without noise the estimate of the error is far smaller than any tolerance.
    assert GROWING.tolerances(1e-9).motion == EXACT.motion
    assert GROWING.tolerances(1e-5).motion == pytest.approx(1e-9)


def test_the_matrices_of_equal_cells_are_computed_once(monkeypatch):
    """Cases that differ in their contacts alone have one lattice, whose matrices are computed for the first of them."""
    computed = []
    compute = motion._matrices

    def count(chain: Chain) -> motion.MatrixEntries:
        computed.append(chain)
        return compute(chain)

    monkeypatch.setattr(motion, "_matrices", count)
    motion._matrices_of_equal_cells.cache_clear()
    base = base_of("preset")
    for factor in (1.0, 1.1, 1.2):
        clearance = [factor * value for value in base.contacts.clearance]
        MotionCoefficients.of(base.varied(contacts={"clearance": clearance}).model())
    assert len(computed) == 1
