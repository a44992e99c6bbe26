"""The direction in which another branch leaves a branch at a point where they cross.

On a branch of H(xi) = 0 the derivative dH/dxi (n, n + 1) has one null vector, the tangent t. Where another branch
crosses it has two: the directions of both branches lie in their plane. With the unit vector r of the plane that is
orthogonal to t, and a small step s, the equations H(xi) = 0, r . (xi - xi_0) = s have a solution on the crossing branch
and none on the old one, along which r . (xi - xi_0) is of second order.
"""

import numpy as np

from vipetsc.modes.problem import unit


def crossing_row(null_vectors: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return r (n + 1,), in the plane of the orthonormal ``null_vectors`` (2, n + 1), orthogonal to ``along`` in it.

    ``along`` (n + 1,) is the direction of the old branch, of any length.
    """
    # The old direction has the coordinates (first, second) in the plane. Turned by 90 deg it is r.
    first, second = null_vectors @ along
    return unit(null_vectors.T @ np.array([-second, first]))
