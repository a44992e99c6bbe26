"""Steps of a fit: where it ends, and the Jacobian that it saves there."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from vipetsc.identification.growing_windows import FINAL, GROWING, TOLERANCE, Precision, _Step, least_residuals

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
