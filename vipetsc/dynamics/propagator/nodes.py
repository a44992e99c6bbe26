"""The nodes at which forces are collocated within a substep, and the integrals between them.

The force of a contact is represented by its values at eight Gauss nodes of a substep (sec. 3 of the derivation in the
package's docstring). It enters the motion by integrals of its interpolant times powers of time: numbers that do not
depend on the lattice and are tabulated once. With Hertz's law a force begins and ends as the power 3/2 of
time, which a polynomial in time follows badly: eight nodes integrate it to 5e-6. In the root of the time since the
onset, or before the separation, it is smooth. There are therefore three kinds of nodes: ``PLAIN`` ones at s = z,
``ONSET`` at s = z^2 and ``EXIT`` at s = z (2 - z), where z are Gauss's nodes.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import leggauss, legval

# Nodes of a substep. On the built-in case up to 0.5 s six of them take 2.4 times as many substeps and 1.4 times the CPU
# time; 10 and 16 take 0.6 and 0.4 of the substeps, each of which is dearer, and the same CPU time.
NODES = 8
PLAIN, ONSET, EXIT = range(3)


class Collocation(NamedTuple):
    """Nodes of a substep of unit length; leading axes are the three kinds.

    ``position`` (3, node) and ``weight`` (3, node) are the nodes and weights of an integral over it. ``powers`` (3,
    power, node k, node j) is the integral from 0 to node j of (position_j - s)^power times node k's Lagrange
    polynomial. ``tail`` (2, node) takes a function's values at the nodes to its last two Legendre coefficients.
    """

    position: np.ndarray
    weight: np.ndarray
    powers: np.ndarray
    tail: np.ndarray


def _lay_out(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the position s in the substep (3, ...) at ``z`` in [0, 1] for each kind of nodes, and its slope ds/dz."""
    position = np.stack([z, z * z, z * (2 - z)])
    slope = np.stack([np.ones_like(z), 2 * z, 2 - 2 * z])
    return position, slope


def gauss(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss's nodes (node,) and weights (node,) on [0, 1]; ``count`` is their number."""
    nodes, weights = leggauss(count)
    return (1 + nodes) / 2, weights / 2


@lru_cache
def collocation(powers: int) -> Collocation:
    """Return tables for the powers 0 to ``powers`` - 1."""
    z, weight = gauss(NODES)
    position, slope = _lay_out(z)

    # Integrals from 0 to node j by a finer rule. In z the integrand has a degree of 2 powers + NODES at most, the power
    # and the slope being quadratic and linear in it: so many nodes integrate it exactly.
    fine, fine_weight = gauss(powers + NODES)
    fine_z = z[:, None] * fine  # (node j, fine)
    fine_position, fine_slope = _lay_out(fine_z)

    # Node k's Lagrange polynomial, in z: (node k, node j, fine).
    lagrange = np.stack([np.prod([(fine_z - a) / (b - a) for a in z if a != b], axis=0) for b in z])
    integrand = lagrange * (fine_slope * fine_weight * z[:, None])[:, None]
    lag = position[:, :, None] - fine_position

    tables = []
    power = np.ones_like(lag)
    for _ in range(powers):
        tables.append(np.einsum("tjf,tkjf->tkj", power, integrand))
        power = power * lag

    last_degrees = (NODES - 2, NODES - 1)
    tail = np.stack([(2 * k + 1) * weight * legval(2 * z - 1, np.eye(NODES)[k]) for k in last_degrees])
    return Collocation(position=position, weight=weight * slope, powers=np.stack(tables, axis=1), tail=tail)
