"""Properties of one shot orbit: its samples, its resonance, and whether it repeats a shorter one."""

from typing import Protocol

import numpy as np

from vipetsc.modes.point import Point
from vipetsc.modes.shooting.flow import Arc, Flow
from vipetsc.modes.shooting.maps import ShootingMap
from vipetsc.modes.system import System

# An orbit that comes back after a part of its period to within this fraction of its size repeats itself. On in-phase
# branches of the paper's model, orbits that are other ones passed three times come back to within 4e-13. Of 125 other
# orbits two come back to within 2e-7 and 1e-5, all others miss by 8e-3 at least.
SAME = 1e-6
# Numbers of repetitions that are looked for. A motion passed n times repeats itself for each prime factor of n, and one
# that is passed more often without any of these factors is not found.
PRIMES = 2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47


class ShotOrbits(Protocol):
    """Orbits shot with sensitivities: what of ``Shooting`` is needed to look at one of them."""

    flow: Flow
    map: ShootingMap
    system: System
    free: slice

    def arc(self, x: np.ndarray, period: float) -> Arc:
        """The arc from initial values ``x`` (n,)."""

    def residual(self, arc: Arc) -> np.ndarray:
        """The residual (n,) at the arc's end, which vanishes for an orbit."""

    def jacobian(self, arc: Arc) -> np.ndarray:
        """Derivative (n, n + 1) of the residual with respect to initial values and period."""


def sample_orbit(problem: ShotOrbits, point: Point, samples: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Displacements in m and velocities in m/s (samples, n) at uniform times, the end of the period left out.

    Only the arc that was shot is integrated; its mirror images make up the period. ``samples`` is a multiple of 4.
    """
    start = problem.arc(point.x, point.period).start
    count = round(problem.map.fraction * samples)
    u, v = np.hsplit(problem.flow.states(start, point.period / samples, count, point.period), 2)
    return whole_period(u, problem.map, samples, 1), whole_period(v, problem.map, samples, -1)


def whole_period(part: np.ndarray, shooting_map: ShootingMap, samples: int, parity: int) -> np.ndarray:
    """Values (samples, ...) at uniform times of a period, from those of an arc, its start and its end included.

    ``parity`` is 1 of displacements, which are even about a rest and odd about the centre, and -1 of velocities.
    """
    # A quarter ends at the centre, about which displacements are odd: the part then ends at rest.
    if shooting_map.quarter:
        part = np.concatenate([part, -parity * part[-2::-1]])
    if len(part) < samples:
        sign = 1
        if not (shooting_map.starts_at_rest or shooting_map.ends_at_rest):
            sign = -1
        part = np.concatenate([part, parity * sign * part[-2::-1]])
    return part[:samples]


def resonance(problem: ShotOrbits, point: Point, samples: int = 1024) -> int:
    """The number k of the k:1 internal resonance to whose tongue an orbit belongs; 1 without a resonance.

    It is the number of zeros in half a period of the contacts' relative motion, or, without contacts, of displacements:
    the largest over all of them. On the tongue the higher mode oscillates k times in a period of the lower one.
    """
    u, _ = sample_orbit(problem, point, samples)
    rows = problem.system.contact_rows
    w = u
    if len(rows):
        w = u @ rows.T
    # A contact at a node of the motion moves by rounding alone, and passes zero at random.
    amplitude = np.abs(w).max(axis=0)
    positive = w[:, amplitude > SAME * amplitude.max()] > 0
    passes = np.sum(positive != np.roll(positive, 1, axis=0), axis=0)
    return int(passes.max()) // 2


def repetitions(problem: ShotOrbits, point: Point) -> int:
    """How often an orbit passes the same motion in its period: the smallest such number among ``PRIMES``, else 1.

    Along a branch from a linear mode it is 1, except where a tongue of a k:1 internal resonance crosses the branch of
    another mode: there the orbit is that mode's, passed k times.
    """
    # Displacements are compared with the orbit's size, velocities with the size times a frequency.
    start = problem.arc(point.x, point.period).start
    rate = problem.flow.omega_ref(point.period)
    size = np.abs(start).max()
    if not problem.map.starts_at_rest:
        size = size / rate
    scale = size * np.repeat([1.0, rate], problem.system.dofs)

    for count in PRIMES:
        later = problem.flow.arc(start, point.period / count, point.period).end
        if np.all(np.abs(later - start) <= SAME * scale):
            return count
    return 1
