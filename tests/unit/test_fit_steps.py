"""Steps of a fit: where it ends, and the Jacobians that it does not compute."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from vipetsc.identification.least_squares import CLOSE, FINAL, GROWING, TOLERANCE, Precision, _Step, least_residuals

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


def least_by_scipy(start: np.ndarray):
    """Return what SciPy finds from ``start`` (coordinate,)."""
    tolerances = {"xtol": TOLERANCE, "ftol": TOLERANCE, "gtol": TOLERANCE}
    return least_squares(residuals, start, jac=slopes, bounds=BOUNDS, **tolerances)


@pytest.mark.parametrize("start", [[1.0, 1.0], [0.1, 6.0], [9.0, 9.0]])
@pytest.mark.parametrize("precision", [FINAL, CLOSE, GROWING])
def test_a_fit_ends_where_scipys_does_with_fewer_jacobians(precision, start):
    """A fit has the least squares of ``scipy.optimize.least_squares`` within its precision, with fewer Jacobians."""
    computed = []

    def differentiate(x: np.ndarray) -> np.ndarray:
        computed.append(x)
        return slopes(x)

    found = least_residuals(residuals, differentiate, np.array(start), BOUNDS, precision, 50)
    expected = least_by_scipy(np.array(start))
    assert np.sum(residuals(found.coordinates) ** 2) <= 2 * (1 + 2 * precision.cost) * expected.cost
    assert len(computed) < 0.6 * expected.njev
    if precision is FINAL:
        assert found.coordinates == pytest.approx(expected.x, rel=1e-7)
        assert found.slopes == pytest.approx(slopes(found.coordinates), abs=1e-3)


@pytest.mark.parametrize("factor", [0.8, 1.2, -1.0])
@pytest.mark.parametrize(("precision", "error"), [(FINAL, 1e-7), (CLOSE, 1e-2)])
def test_given_slopes_that_are_wrong_do_not_end_a_fit_elsewhere(precision, error, factor):
    """A fit that begins with wrong derivatives ends at the same minimum, also from where they foretell a loss."""
    start = np.array([2.2, 2.7])
    wrong = slopes(start) * [1.0, factor]
    found = least_residuals(residuals, slopes, start, BOUNDS, precision, 50, wrong)
    assert found.coordinates == pytest.approx(least_by_scipy(start).x, rel=error)


@pytest.mark.parametrize(("length", "ends"), [(0.9995e-6, True), (1.0005e-6, False)])
def test_a_small_step_is_judged_by_where_it_begins(length, ends):
    """A step from 0 ends a fit if it is below the square of the tolerance, as in SciPy, however far it leads."""
    step = _Step(x=np.zeros(1), residuals=np.ones(1), slopes=np.zeros((1, 1)))
    # The cost falls by much, so that the length of the step alone decides.
    assert step.ends_at(np.array([length]), np.full(1, 0.5), Precision(cost=1e-2, step=1e-3)) == ends
