"""Stability of reversible periodic orbits: Floquet half-traces and multipliers from one arc."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vipetsc.modes.orbit import Arc
from vipetsc.modes.shooting import Shooting


@dataclass(frozen=True, eq=False)
class Stability:
    """Half-traces c (n - 1,) = (mu + 1/mu)/2 of the basic map's multipliers, the trivial pair left out.

    The basic map is the half period (seen with the sign reversed) for the quarter-period map and the period
    for the others. c = 1 is a fold or a branch point that keeps the map's symmetry, c = -1 breaks it (quarter)
    or doubles the period (others), c = 0 doubles the period of the quarter-period map's orbits.
    """

    half_traces: np.ndarray
    twisted: bool

    @property
    def multipliers(self) -> np.ndarray:
        """Floquet multipliers (2n - 2,) over the whole period."""
        c = self.half_traces.astype(complex)
        root = np.sqrt(c * c - 1)
        mu = np.where(np.abs(c + root) >= np.abs(c - root), c + root, c - root)  # the larger one, no cancellation
        mu = np.concatenate([mu, 1 / mu])
        return mu**2 if self.twisted else mu

    @property
    def largest(self) -> float:
        """Largest modulus of a multiplier; 1 for a stable orbit and for a single degree of freedom."""
        return float(np.abs(self.multipliers).max(initial=1.0))

    @property
    def stable(self) -> bool:
        """Whether no multiplier leaves the unit circle by more than 1e-6."""
        return self.largest <= 1 + 1e-6


def stability(problem: Shooting, arc: Arc) -> Stability:
    """Half-traces from the sensitivity of an arc between two symmetric sections.

    With S = [[A, B], [C, D]] in mass-normalised coordinates and its mirror image after the end, the basic map has
    the diagonal block I + 2 B^T C, whose eigenvalues are the half-traces; one of them, trivial, is 1 (-1 before
    the sign is reversed for a quarter period) and its left eigenvector is known, so that it is removed exactly.
    """
    root = np.sqrt(problem.system.masses)
    a, b, c, d = (root[:, None] * block / root for block in arc.blocks())
    n = len(root)
    twisted = problem.map.start != problem.map.end
    if problem.map.fraction == 1.0:  # the whole period needs no mirror image
        product, trivial = (a - np.eye(n)) / 2, arc.acceleration[0] * root
    elif problem.map.start == "rest":
        product, trivial = (d.T @ a if twisted else b.T @ c), arc.acceleration[0] * root
    else:
        product, trivial = c.T @ b, arc.start[n:] * root
    if n == 2:  # the trace is more exact than a projection
        rest = np.array([np.trace(product)])
    else:
        basis = np.linalg.svd(trivial[None, :])[2][1:].T
        rest = np.linalg.eigvals(basis.T @ product @ basis)
    # twisted: I - 2 D^T A = -(I + 2 B^T C)
    traces = 1 - 2 * rest if twisted else 1 + 2 * rest
    order = np.argsort(traces.real)
    traces = traces[order]
    return Stability(traces.real if np.all(np.abs(traces.imag) == 0) else traces, twisted)
