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

    # The whole period needs no mirror image.
    if shooting_map.fraction == 1.0:
        product = (a - np.eye(n)) / 2
    elif shooting_map.quarter:
        product = d.T @ a
    elif shooting_map.starts_at_rest:
        product = b.T @ c
    else:
        product = c.T @ b

    # Of two masses the trivial eigenvalue is 0 and the trace is the other one, more exactly than by a projection.
    if n == 2:
        eigenvalues = np.array([np.trace(product)])
    else:
        trivial = _start_rate(system, shooting_map, arc) * root
        basis = np.linalg.svd(trivial[None, :])[2][1:].T
        eigenvalues = np.linalg.eigvals(basis.T @ product @ basis)

    sign = 1
    if shooting_map.quarter:
        sign = -1
    traces = 1 + sign * 2 * eigenvalues
    traces = traces[np.argsort(traces.real)]
    # Pairs of multipliers that leave the unit circle together have complex half-traces; all others are real.
    if np.any(np.abs(traces.imag) != 0):
        return traces
    return traces.real


def _start_rate(system: System, shooting_map: ShootingMap, arc: Arc) -> np.ndarray:
    """The time derivative (n,) of what is zero at the arc's start."""
    n = system.dofs
    if not shooting_map.starts_at_rest:
        return arc.start[n:]
    return -system.forces(arc.start[:n]) / system.masses


def multipliers(traces: np.ndarray, quarter: bool) -> np.ndarray:
    """Floquet multipliers (2n - 2,) over the whole period from half-traces (n - 1,)."""
    c = traces.astype(complex)
    root = np.sqrt(c * c - 1)
    # The larger root of mu^2 - 2 c mu + 1 = 0 without cancellation; the smaller one is its inverse.
    mu = np.where(np.abs(c + root) >= np.abs(c - root), c + root, c - root)
    mu = np.concatenate([mu, 1 / mu])
    # The basic map of a quarter is half a period.
    if quarter:
        return mu**2
    return mu


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
