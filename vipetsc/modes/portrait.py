"""A whole period of an orbit, sampled, and the resonance that its harmonics show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vipetsc.modes.point import Point
from vipetsc.modes.shooting import Shooting
from vipetsc.modes.system import contact_directions


@dataclass(frozen=True, eq=False)
class Portrait:
    """``time`` (samples,) in s over one period, ``displacement`` and ``velocity`` (samples, n) in m and m/s."""

    time: np.ndarray
    displacement: np.ndarray
    velocity: np.ndarray


def portrait(problem: Shooting, point: Point, samples: int = 400) -> Portrait:
    """The orbit at ``samples`` uniform times (a multiple of 4), the end of the period left out.

    Only the arc that was shot is integrated; its mirror images make up the period.
    """
    pieces = round(problem.map.fraction * samples)
    n = problem.system.dofs
    interval = point.period / samples
    state = problem.arc(point.x, point.period).start
    states = [state]
    for _ in range(pieces):
        state = problem.flow.arc(state, interval, point.period).end
        states.append(state)
    track = np.array(states)
    u, v = track[:, :n], track[:, n:]
    if problem.map.start != problem.map.end:  # to the centre: odd about it
        u, v = np.vstack([u, -u[-2::-1]]), np.vstack([v, v[-2::-1]])
    if len(u) < samples:  # to a rest (or from centre to centre): mirror image about it
        sign = -1 if problem.map.start == problem.map.end == "centre" else 1
        u, v = np.vstack([u, sign * u[-2::-1]]), np.vstack([v, -sign * v[-2::-1]])
    return Portrait(np.arange(samples) * interval, u[:samples], v[:samples])


def resonance(problem: Shooting, point: Point, samples: int = 1024) -> int:
    """The harmonic k >= 2 that is strongest in the contacts' relative motion (all displacements without contacts).

    On a tongue of a k:1 internal resonance, mode two moves k times while mode one moves once.
    """
    u = portrait(problem, point, samples).displacement
    rows = contact_directions(problem.system)
    signal = u @ rows.T if len(rows) else u
    size = np.abs(np.fft.rfft(signal, axis=0)).sum(axis=1)
    return int(np.argmax(size[2 : samples // 4])) + 2
