"""Least squares of a fit: where it ends, and the Jacobians that it does not compute."""

from __future__ import annotations

import numpy as np
import pytest

from vipetsc.identification.least_squares import CLOSE, FINAL, GROWING, least_residuals

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


@pytest.mark.parametrize("start", [[1.0, 1.0], [0.1, 6.0], [10.0, 10.0 + 1e-12]])
@pytest.mark.parametrize("precision", [FINAL, CLOSE, GROWING])
def test_a_fit_ends_where_the_residuals_are_orthogonal_to_their_slopes(precision, start):
    """At the end J^T r = 0 within the precision, from starts on and beyond a bound, too; looser fits end earlier."""
    calls = []

    def counted(x: np.ndarray) -> np.ndarray:
        calls.append(x)
        return residuals(x)

    found = least_residuals(counted, slopes, np.array(start), BOUNDS, precision, 50)
    exact = least_residuals(residuals, slopes, np.array([2.0, 3.0]), BOUNDS, FINAL, 50)
    np.testing.assert_allclose(slopes(exact.coordinates).T @ residuals(exact.coordinates), 0, atol=1e-9)
    assert np.sum(residuals(found.coordinates) ** 2) <= (1 + 2 * precision.cost) * np.sum(
        residuals(exact.coordinates) ** 2
    )
    if precision is FINAL:
        assert found.coordinates == pytest.approx(exact.coordinates, rel=1e-7)
        np.testing.assert_array_equal(found.slopes, slopes(found.coordinates))
    least_residuals(counted, slopes, np.array(start), BOUNDS, precision, limit := 3)
    assert len(calls) <= 50 + limit


@pytest.mark.parametrize("factor", [0.8, 1.2])
@pytest.mark.parametrize(("precision", "error"), [(FINAL, 1e-7), (CLOSE, 1e-2)])
def test_given_slopes_save_the_first_jacobian(precision, error, factor):
    """A fit that begins with derivatives of a neighbour ends at the same minimum, with one Jacobian fewer."""
    start = np.array([2.2, 2.7])
    asked = []

    def differentiate(x: np.ndarray) -> np.ndarray:
        asked.append(x.copy())
        return slopes(x)

    exact = least_residuals(residuals, slopes, start, BOUNDS, FINAL, 50).coordinates
    found = least_residuals(residuals, differentiate, start, BOUNDS, precision, 50, slopes(start) * [1.0, factor])
    assert found.coordinates == pytest.approx(exact, rel=error)
    assert not any(np.array_equal(x, start) for x in asked)
