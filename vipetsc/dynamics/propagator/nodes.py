"""The nodes at which forces are collocated within a substep, and the integrals between them.

Sec. 3 of the derivation in the package's docstring. With Hertz's law a force begins and ends as the power 3/2 of time.
Nodes laid out evenly in the root of the time since the onset, or before the separation, see a smooth function:
``ONSET`` and ``EXIT`` beside ``PLAIN``.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import leggauss, legval

NODES = 8
PLAIN, ONSET, EXIT = range(3)


class Collocation(NamedTuple):
    """Nodes of a substep of unit length; leading axes are the three kinds.

    ``share`` (3, node) and ``weight`` (3, node) integrate over it; ``powers`` (3, power, node k, node j): the
    integral from 0 to node j of (share_j - s)^power times node k's Lagrange polynomial; ``tail`` (2, node): the
    last two Legendre coefficients of a function from its values at the nodes.
    """

    share: np.ndarray
    weight: np.ndarray
    powers: np.ndarray
    tail: np.ndarray


def _lay_out(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share of the substep (3, ...) at ``x`` in [0, 1] for each kind of nodes, and its slope."""
    return np.stack([x, x * x, x * (2 - x)]), np.stack([np.ones_like(x), 2 * x, 2 - 2 * x])


@lru_cache
def collocation(powers: int) -> Collocation:
    """Tables for the powers 0 to ``powers`` - 1."""
    # The finer ones are exact for all products: degree 2 powers + NODES + 1.
    rules = leggauss(NODES), leggauss(powers + NODES)
    (x, w), (fine, fine_weight) = (((1 + at) / 2, weight / 2) for at, weight in rules)
    at = x[:, None] * fine  # (node j, fine)
    (share, slope), (share_at, slope_at) = _lay_out(x), _lay_out(at)
    lagrange = np.stack([np.prod([(at - a) / (b - a) for a in x if a != b], axis=0) for b in x])  # (node k, j, fine)
    integrand = lagrange * (slope_at * fine_weight * x[:, None])[:, None]
    lag = share[:, :, None] - share_at
    power, table = np.ones_like(lag), []
    for _ in range(powers):
        table.append(np.einsum("tjf,tkjf->tkj", power, integrand))
        power = power * lag
    tail = np.stack([(2 * k + 1) * w * legval(2 * x - 1, np.eye(NODES)[k]) for k in (NODES - 2, NODES - 1)])
    return Collocation(share, w * slope, np.stack(table, axis=1), tail)
