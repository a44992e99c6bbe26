"""Collocation of forces at Gauss nodes of a substep, for three ways in which the nodes lie in time.

With Hertz's law a force begins and ends as the power 3/2 of time. Nodes laid out evenly in the root of the time
since the onset, or before the separation, see a smooth function: ``ONSET`` and ``EXIT`` beside ``PLAIN``.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import leggauss, legval

NODES = 8
PLAIN, ONSET, EXIT = range(3)

# Share of the substep at xi in [0, 1], and its slope.
_SHARES = {
    PLAIN: (lambda x: x, lambda x: np.ones_like(x)),
    ONSET: (lambda x: x * x, lambda x: 2 * x),
    EXIT: (lambda x: x * (2 - x), lambda x: 2 - 2 * x),
}


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


@lru_cache
def collocation(powers: int) -> Collocation:
    """Tables for the powers 0 to ``powers`` - 1."""
    x, w = leggauss(NODES)
    x, w = (1 + x) / 2, w / 2
    # Exact for all products: degree 2 powers + NODES + 1.
    fine, fine_weight = leggauss(powers + NODES)
    fine, fine_weight = (1 + fine) / 2, fine_weight / 2
    share = np.stack([f(x) for f, _ in _SHARES.values()])
    weight = np.stack([w * slope(x) for _, slope in _SHARES.values()])
    table = np.empty((3, powers, NODES, NODES))
    for kind, (f, slope) in _SHARES.items():
        at = x[:, None] * fine  # (node j, fine)
        lag = f(x)[:, None] - f(at)
        lagrange = _lagrange(x, at) * (slope(at) * fine_weight * x[:, None])  # (node k, node j, fine)
        power = np.ones_like(lag)
        for p in range(powers):
            table[kind, p] = np.einsum("jf,kjf->kj", power, lagrange)
            power = power * lag
    tail = np.stack([(2 * k + 1) * w * legval(2 * x - 1, np.eye(NODES)[k]) for k in (NODES - 2, NODES - 1)])
    return Collocation(share, weight, table, tail)


def _lagrange(x: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Lagrange polynomials (node, ...) of the nodes ``x`` at the points ``at``."""
    values = np.ones((x.size, *at.shape))
    for k in range(x.size):
        for i in range(x.size):
            if i != k:
                values[k] *= (at - x[i]) / (x[k] - x[i])
    return values
