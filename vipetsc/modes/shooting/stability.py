"""Floquet multipliers of a shot orbit, from the sensitivities of the arc that was integrated."""

import numpy as np

from vipetsc.modes.point import Point
from vipetsc.modes.shooting.flow import Arc
from vipetsc.modes.shooting.maps import ShootingMap
from vipetsc.modes.system import System


def half_traces(system: System, shooting_map: ShootingMap, arc: Arc) -> np.ndarray:
    """Half-traces c (n - 1,) = (mu + 1/mu)/2 of the basic map's multipliers, the trivial pair left out.

    The basic map is the half period (seen with the sign reversed) for the quarter-period map and the period for the
    others; its diagonal block is derived in the package's docstring. The left eigenvector of its trivial eigenvalue is
    the velocity (or acceleration) at the start, so that it is removed exactly.
    """
    root = np.sqrt(system.masses)
    n = len(root)
    sensitivity = arc.sensitivity
    blocks = sensitivity[:n, :n], sensitivity[:n, n:], sensitivity[n:, :n], sensitivity[n:, n:]
    a, b, c, d = (root[:, None] * block / root for block in blocks)

    if shooting_map.fraction == 1.0:  # the whole period needs no mirror image
        product = (a - np.eye(n)) / 2
    elif shooting_map.start == "rest":
        product = d.T @ a if shooting_map.quarter else b.T @ c
    else:
        product = c.T @ b

    if n == 2:  # the trace is more exact than a projection
        eigenvalues = np.array([np.trace(product)])
    else:
        trivial = _start_rate(system, shooting_map, arc) * root
        basis = np.linalg.svd(trivial[None, :])[2][1:].T
        eigenvalues = np.linalg.eigvals(basis.T @ product @ basis)

    traces = 1 - 2 * eigenvalues if shooting_map.quarter else 1 + 2 * eigenvalues
    traces = traces[np.argsort(traces.real)]
    # Pairs of multipliers that leave the unit circle together have complex half-traces; all others are real.
    return traces.real if np.all(np.abs(traces.imag) == 0) else traces


def _start_rate(system: System, shooting_map: ShootingMap, arc: Arc) -> np.ndarray:
    """The time derivative (n,) of what is zero at the arc's start."""
    n = system.dofs
    if shooting_map.start == "centre":
        return arc.start[n:]
    return -system.forces(arc.start[:n]) / system.masses


def multipliers(traces: np.ndarray, quarter: bool) -> np.ndarray:
    """Floquet multipliers (2n - 2,) over the whole period from half-traces (n - 1,)."""
    c = traces.astype(complex)
    root = np.sqrt(c * c - 1)
    mu = np.where(np.abs(c + root) >= np.abs(c - root), c + root, c - root)  # the larger one, no cancellation
    mu = np.concatenate([mu, 1 / mu])
    return mu**2 if quarter else mu


def real_half_traces(left: Point, right: Point) -> list[int]:
    """Numbers (from 0) of the half-traces that are real at one of two points or at both.

    A complex one belongs to multipliers off the real axis, which do not come to 1 or -1, whatever its real part does.
    """
    are_complex = (np.imag(left.half_traces) != 0) & (np.imag(right.half_traces) != 0)
    return np.flatnonzero(~are_complex).tolist()


class HalfTraceAbove:
    """Distance of half-trace ``number`` (from 0) of a point above a ``level``."""

    def __init__(self, number: int, level: float) -> None:
        self.number = number
        self.level = level

    def __call__(self, point: Point) -> float:
        """The difference at a point."""
        return float(np.real(point.half_traces[self.number])) - self.level

    def is_real(self, point: Point) -> bool:
        """Whether the half-trace is real at a point; numbers change where two of them become a complex pair."""
        return bool(np.imag(point.half_traces[self.number]) == 0)
