"""The direction in which another branch leaves a branch at a point where they cross.

On a branch of H(xi) = 0 the derivative dH/dxi (n, n + 1) has one null vector, the tangent t. Where another branch
crosses it has two: the directions of both branches lie in their plane. With the unit vector r of the plane that is
orthogonal to t, and a small step s, the equations H(xi) = 0, r . (xi - xi_0) = s have a solution on the crossing branch
and none on the old one, along which r . (xi - xi_0) is of second order.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from vipetsc.modes.problem import Attempt, unit

# The longest correction of a first point on the crossing branch over the step to it.
ASTRAY = 1.0


def crossing_row(null_vectors: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return r (n + 1,), in the plane of the orthonormal ``null_vectors`` (2, n + 1), orthogonal to ``along`` in it.

    ``along`` (n + 1,) is the direction of the old branch, of any length.
    """
    # The old direction has the coordinates (first, second) in the plane. Turned by 90 deg it is r.
    first, second = null_vectors @ along
    return unit(null_vectors.T @ np.array([-second, first]))


def step_across(
    solve: Callable[[np.ndarray, np.ndarray, float], Attempt],
    begin: np.ndarray,
    row: np.ndarray,
    steps: Iterable[float],
) -> tuple[Attempt, float]:
    """Return Newton's attempt at a first point of the crossing branch, with the first of ``steps`` that leads to it.

    ``solve`` seeks the solution with row . xi = value from a guess; ``begin`` (n + 1,) is the point at which branches
    cross, ``row`` (n + 1,) is r. If no step leads there, the last attempt is returned as one that did not converge.
    """
    for step in steps:
        guess = begin + step * row
        attempt = solve(guess, row, row @ guess)
        if attempt.converged and np.linalg.norm(attempt.xi - guess) <= ASTRAY * step:
            return attempt, step
    return replace(attempt, converged=False), step
