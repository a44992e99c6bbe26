"""Small linear systems in compiled code."""

import numpy as np
import pytest

from vipetsc.dynamics.propagator.linear_system import solve_in_place


@pytest.mark.parametrize("size", [1, 2, 9])
def test_a_system_is_solved(size):
    """The residual is rounding, also where the first pivot is zero and rows differ by ten orders of magnitude."""
    random = np.random.default_rng(size)
    matrix = random.standard_normal((size, size)) * 10.0 ** random.uniform(-5, 5, (size, 1))
    if size > 1:
        matrix[0, 0] = 0.0
    right = random.standard_normal((size, 4))

    solution = right.copy()
    solve_in_place(matrix.copy(), solution)
    residual = np.abs(matrix @ solution - right)
    assert np.all(residual <= 1e-14 * size * (np.abs(matrix) @ np.abs(solution)))


def test_pivots_are_the_largest():
    """Rows are exchanged for the largest pivot: the pivot 1e-20 would leave no digit of the first unknown."""
    right = np.array([[1.0], [2.0]])
    solve_in_place(np.array([[1e-20, 1.0], [1.0, 1.0]]), right)
    np.testing.assert_allclose(right, [[1.0], [1.0]], rtol=1e-15)


def test_a_singular_system_has_no_finite_solution():
    right = np.array([[1.0], [2.0]])
    solve_in_place(np.array([[1.0, 2.0], [2.0, 4.0]]), right)
    assert not np.isfinite(right).any()
