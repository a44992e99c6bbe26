"""Orbits of a branch, seen closer: a whole period sampled, its internal resonance, the same orbit by another flow."""

from dataclasses import dataclass

import numpy as np

from vipetsc.modes.chart import Relative
from vipetsc.modes.orbit import Flow
from vipetsc.modes.point import Point
from vipetsc.modes.shooting import Corrector, Shooting
from vipetsc.modes.system import contact_directions


@dataclass(frozen=True, eq=False)
class OrbitSamples:
    """``time`` (samples,) in s over one period, ``displacement`` and ``velocity`` (samples, n) in m and m/s."""

    time: np.ndarray
    displacement: np.ndarray
    velocity: np.ndarray


def sample_orbit(problem: Shooting, point: Point, samples: int = 400) -> OrbitSamples:
    """The orbit at ``samples`` uniform times (a multiple of 4), the end of the period left out.

    Only the arc that was shot is integrated; its mirror images make up the period.
    """
    n, interval = problem.system.dofs, point.period / samples
    states = [problem.arc(point.x, point.period).start]
    for _ in range(round(problem.map.fraction * samples)):
        states.append(problem.flow.arc(states[-1], interval, point.period).end)
    u, v = np.hsplit(np.array(states), [n])
    if problem.map.quarter:  # to the centre: odd about it
        u, v = np.vstack([u, -u[-2::-1]]), np.vstack([v, v[-2::-1]])
    if len(u) < samples:  # to a rest (or from centre to centre): mirror image about it
        sign = -1 if problem.map.start == problem.map.end == "centre" else 1
        u, v = np.vstack([u, sign * u[-2::-1]]), np.vstack([v, -sign * v[-2::-1]])
    return OrbitSamples(np.arange(samples) * interval, u[:samples], v[:samples])


def resonance(problem: Shooting, point: Point, samples: int = 1024) -> int:
    """The harmonic k >= 2 that is strongest in the contacts' relative motion (all displacements without contacts).

    On a tongue of a k:1 internal resonance, mode two moves k times while mode one moves once.
    """
    u = sample_orbit(problem, point, samples).displacement
    rows = contact_directions(problem.system)
    size = np.abs(np.fft.rfft(u @ rows.T if len(rows) else u, axis=0)).sum(axis=1)
    return int(np.argmax(size[2 : samples // 4])) + 2


@dataclass(frozen=True, eq=False)
class Comparison:
    """What flow ``name`` gives on a branch's orbits (orbits,): relative differences; NaN where it fails.

    ``number`` are the points, ``energy`` (J) theirs; ``energy_difference`` and ``frequency_difference`` are
    the other flow's values over the branch's, less 1.
    """

    name: str
    number: np.ndarray
    energy: np.ndarray
    energy_difference: np.ndarray
    frequency_difference: np.ndarray


def compare(reference: Corrector, points: list[Point], flow: Flow, every: int = 4) -> Comparison:
    """Correct every ``every``-th point with ``flow``, keeping the first contact's w (or the largest displacement).

    At the same energy or frequency the comparison would be ill-posed where the branch is vertical or flat.
    """
    problem = Shooting(flow, reference.problem.map)
    corrector = Corrector(problem, max(reference.tolerance, 1e-12))
    chosen = points[::every]
    difference = np.full((2, len(chosen)), np.nan)
    for i, point in enumerate(chosen):
        chart = Relative(problem.system, point.x, point.period, rest=problem.map.start == "rest")
        xi = chart.encode(point.x, point.period)
        contacts = problem.system.contacts
        row = np.zeros(len(xi))
        row[contacts[0].resonator if contacts else int(np.abs(point.x).argmax())] = 1.0
        # begin beside the orbit, or a flow whose residual passes there would not move at all
        attempt = corrector.solve(chart, xi + 1e-6 * (1 - row), row, row @ xi)
        if attempt.converged:
            x, period = chart.decode(attempt.xi)
            difference[:, i] = problem.energy(x) / point.energy - 1, point.period / period - 1
    number, energy = np.array([p.index for p in chosen]), np.array([p.energy for p in chosen])
    return Comparison(flow.name, number, energy, *difference)
