"""Motions of lattices with stops by SciPy: equations, integrator and contacts share no code with the package."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from tests.references import recorded


@dataclass(frozen=True)
class Stop:
    """A stop that mass ``resonator`` meets at w = u_resonator - u_host = ``side`` times ``gap``; host -1 is the ground.

    At the penetration x = ``side`` w - ``gap`` > 0 its force is k x^n (1 + c w'/w'_minus): w'_minus is the velocity w'
    at the onset of the contact, and c = 3 (1 - r)/2 with the restitution r.
    """

    resonator: int
    host: int
    gap: float
    stiffness: float
    exponent: float
    restitution: float
    side: int = 1

    def row(self, count: int) -> np.ndarray:
        """The row (``count``,) that gives w = row @ u from the displacements of ``count`` masses."""
        row = np.zeros(count)
        row[self.resonator] = 1.0
        if self.host >= 0:
            row[self.host] = -1.0
        return row


class CurvedSpring(NamedTuple):
    """The nonlinear part q z^2 + c z^3 of a spring's force at the elongation z = ``row`` @ u.

    ``quadratic`` is q in N/m^2, ``cubic`` is c in N/m^3.
    """

    row: np.ndarray
    quadratic: float
    cubic: float

    def force(self, u: np.ndarray) -> np.ndarray:
        """Forces (n,) in N on the masses at displacements ``u`` (n,) in m."""
        z = self.row @ u
        return -(self.quadratic * z**2 + self.cubic * z**3) * self.row


@dataclass(frozen=True)
class ScipyLattice:
    """The lattice M u'' + C u' + K u = force(t) + forces of stops + nonlinear parts of springs.

    ``masses`` (n,) are the diagonal of M, ``stiffness`` (n, n) is K and ``damping`` (n, n) is C.
    """

    masses: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    stops: tuple[Stop, ...]
    force: Callable[[float], np.ndarray]
    curved: tuple[CurvedSpring, ...] = ()

    def recorded_motion(
        self, name: str, times: np.ndarray, u: np.ndarray, v: np.ndarray, start: float
    ) -> tuple[np.ndarray, int]:
        """Return what ``motion`` returns, from the reference ``name`` in ``tests/references``."""
        stops = [
            (stop.resonator, stop.host, stop.gap, stop.stiffness, stop.exponent, stop.restitution, stop.side)
            for stop in self.stops
        ]
        curved = [[*spring.row, spring.quadratic, spring.cubic] for spring in self.curved]
        forces = [self.force(t) for t in np.linspace(start, times[-1], 20)]
        problem = (self.masses, self.stiffness, self.damping, stops, curved, forces, times[[0, -1]], len(times), u, v)

        def solve() -> np.ndarray:
            motion, impacts = self.motion(times, u, v, start)
            # The number of impacts is a fourth quantity, the same at all times.
            return np.concatenate([motion, np.full((1, *motion.shape[1:]), impacts)])

        solution = recorded(name, problem, solve)
        return solution[:3], int(solution[3, 0, 0])

    def motion(self, times: np.ndarray, u: np.ndarray, v: np.ndarray, start: float) -> tuple[np.ndarray, int]:
        """u, u' and u'' (quantity, time, mass) at ``times`` in s, and the number of impacts until the last time.

        The motion begins at the time ``start`` with the displacements ``u`` (mass,) and the velocities ``v`` (mass,).
        """
        n = len(self.masses)
        rows = [stop.row(n) for stop in self.stops]
        # Springs and dashpots are one product, because rates are evaluated some ten thousand times.
        linear = -np.hstack([self.stiffness, self.damping])
        # Stops without clearance or loss push whenever they are met: they need no changes, and have any approach.
        touching = [k for k, stop in enumerate(self.stops) if stop.gap == 0 and stop.restitution == 1]
        closed: dict[int, float] = dict.fromkeys(touching, 1.0)
        impacts = 0

        def rates(t: float, y: np.ndarray) -> np.ndarray:
            total = self.force(t) + linear @ y
            for spring in self.curved:
                total = total + spring.force(y[:n])
            for k, speed in closed.items():
                stop = self.stops[k]
                depth = max(stop.side * (rows[k] @ y[:n]) - stop.gap, 0.0)
                # w'/w'_minus: the velocity towards the stop, over its value at the onset.
                ratio = stop.side * (rows[k] @ y[n:]) / speed
                pressure = stop.stiffness * depth**stop.exponent * (1 + 1.5 * (1 - stop.restitution) * ratio)
                total = total - stop.side * pressure * rows[k]
            return np.concatenate([y[n:], total / self.masses])

        y = np.concatenate([u, v])
        t = start
        samples = np.zeros((len(times), 2 * n))
        accelerations = np.zeros((len(times), n))
        while t < times[-1]:
            events = []
            changing = [k for k in range(len(self.stops)) if k not in touching]
            for k in changing:
                stop = self.stops[k]

                def beyond(_: float, y: np.ndarray, k: int = k, stop: Stop = stop) -> float:
                    return float(stop.side * (rows[k] @ y[:n]) - stop.gap)

                beyond.terminal = True
                # An open stop waits for its onset, a closed one for its separation.
                beyond.direction = -1 if k in closed else 1
                events.append(beyond)
            solution = solve_ivp(
                rates,
                (t, times[-1]),
                y,
                "DOP853",
                # These errors are far below the tolerances of the tests, which then hold for the package alone.
                rtol=1e-11,
                atol=1e-15,
                events=events or None,
                # Values are returned at the samples only: a dense output of all steps would cost a fifth more.
                t_eval=times[times >= t],
                # SciPy looks for events once a step: a longer step could miss a short contact.
                max_step=2e-4,
            )
            first = np.searchsorted(times, t)
            for number, at in enumerate(solution.t, first):
                samples[number] = solution.y[:, number - first]
                accelerations[number] = rates(at, samples[number])[n:]

            # The integration begins anew at each change, where the derivative of the force jumps.
            t, y = self._end_of(solution, times[-1])
            for k, found in zip(changing, solution.t_events or (), strict=True):
                if found.size and k in closed:
                    del closed[k]
                elif found.size:
                    # The approach velocity of this contact.
                    closed[k] = float(self.stops[k].side * (rows[k] @ y[n:]))
                    impacts += 1
        return np.stack([samples[:, :n], samples[:, n:], accelerations]), impacts

    @staticmethod
    def _end_of(solution: Any, last: float) -> tuple[float, np.ndarray]:
        """The time and state at the end of SciPy's ``solution``: at a change of contact, or at the time ``last``."""
        for times, states in zip(solution.t_events or (), solution.y_events or (), strict=True):
            if len(times):
                return float(times[-1]), states[-1]
        return last, solution.y[:, -1]


def chain_matrices(count: int, stiffness: float, damping: float, ground: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """K and C (count, count) of ``count`` masses in a row, with equal springs and dashpots, between two walls.

    ``stiffness`` is in N/m, ``damping`` in N s/m; a dashpot ``ground`` in N s/m joins each mass to the ground.
    """
    shape = 2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    return stiffness * shape, damping * shape + ground * np.eye(count)
