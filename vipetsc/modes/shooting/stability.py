"""Floquet multipliers of a shot orbit, from the sensitivities of the arc that was integrated.

S = [[A, B], [C, D]] is the derivative of the arc's end by its start, of displacements before velocities, in coordinates
M^1/2 u: the block A becomes M^1/2 A M^-1/2, and so do the others. In these coordinates S is symplectic, that is

    D^T A - B^T C = 1,    S^-1 = [[D^T, -B^T], [-C^T, A^T]],

and D^T B and C^T A are symmetric. The rest of the period is the arc's mirror image. With R = diag(1, -1), which
reverses time, the multipliers mu are the eigenvalues of the *basic map*, or their squares:

    arc                 basic map             its diagonal block           multipliers
    half, from rest     R S^-1 R S            1 + 2 B^T C (upper)          mu
    half, from centre   R S^-1 R S            1 + 2 C^T B (lower)          mu
    quarter, from rest  -R S^-1 R S           1 - 2 D^T A (upper)          mu^2: the map is over half a period
    whole, from rest    S                     A = 1 + 2 (A - 1)/2 (upper)  mu

The eigenvalues of a basic map Q come in pairs, mu and 1/mu, since Q^-1 = R Q R. (Q + Q^-1)/2 has the two diagonal
blocks of Q and else zeros. The eigenvalues of each block are

    c = (mu + 1/mu)/2,

the *half-traces*, n of them. In (-1, 1) the pair is on the unit circle, mu = exp(+-i arccos c): the orbit is stable.
One half-trace is 1 for every orbit, that of a shift in time and of a change of energy. Its left eigenvector l in the
product of blocks above is the rate at which the start passes its section: at rest the acceleration a, at the centre the
velocity v. For S takes the state's rate at the start to that at the end. From rest to rest these are (0, a) and (0,
a'), so that B a = 0 and l^T B^T C = 0; from rest to the centre (0, a) and (v', 0), so that D a = 0; from centre to
centre (v, 0) and (v', 0), so that C v = 0. The other half-traces belong to the space orthogonal to l, into which the
product maps.
"""

import numpy as np

from vipetsc.modes.point import Point
from vipetsc.modes.shooting.flow import Arc
from vipetsc.modes.shooting.maps import ShootingMap
from vipetsc.modes.system import System


def half_traces(system: System, shooting_map: ShootingMap, arc: Arc) -> np.ndarray:
    """Half-traces c (n - 1,) of the basic map of an ``arc``, without that of its trivial pair, by their real parts.

    They are real, or complex if one of them is not.
    """
    root = np.sqrt(system.masses)
    n = len(root)
    sensitivity = arc.sensitivity
    blocks = sensitivity[:n, :n], sensitivity[:n, n:], sensitivity[n:, :n], sensitivity[n:, n:]
    a, b, c, d = (root[:, None] * block / root for block in blocks)

    # The product of blocks in the table of this module, of which the half-traces are 1 + 2 eigenvalues, or 1 - 2.
    if shooting_map.fraction == 1.0:
        product = (a - np.eye(n)) / 2
    elif shooting_map.quarter:
        product = d.T @ a
    elif shooting_map.starts_at_rest:
        product = b.T @ c
    else:
        product = c.T @ b

    # With two masses one eigenvalue is the trivial one, 0, so that the trace is the other one: more exact than a
    # projection.
    if n == 2:
        eigenvalues = np.array([np.trace(product)])
    else:
        trivial = _start_rate(system, shooting_map, arc) * root
        # The right singular vectors of a row are the row itself, then a basis of what is orthogonal to it.
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
    """The time derivative (n,) of what is zero at the arc's start: acceleration at rest, velocity at the centre."""
    n = system.dofs
    if not shooting_map.starts_at_rest:
        return arc.start[n:]
    return -system.forces(arc.start[:n]) / system.masses


def multipliers(traces: np.ndarray, quarter: bool) -> np.ndarray:
    """Floquet multipliers (2n - 2,) over the whole period from half-traces (n - 1,), those of a ``quarter`` map or not.

    The first half has |mu| >= 1, the second half their inverses.
    """
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
