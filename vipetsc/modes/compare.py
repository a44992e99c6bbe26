"""One flow against another on the orbits of a branch, at the same amplitude."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vipetsc.modes.chart import Relative
from vipetsc.modes.orbit import Flow
from vipetsc.modes.point import Point
from vipetsc.modes.shooting import Corrector, Shooting


@dataclass(frozen=True, eq=False)
class Comparison:
    """What flow ``name`` finds beside the branch's orbits (orbits,): relative differences; NaN where it fails.

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
    found = np.full((2, len(chosen)), np.nan)
    for i, point in enumerate(chosen):
        chart = Relative(problem.system, point.x, point.period, rest=problem.map.start == "rest")
        xi = chart.encode(point.x, point.period)
        row = np.zeros(len(xi))
        contacts = problem.system.contacts
        row[contacts[0].resonator if contacts else int(np.abs(point.x).argmax())] = 1.0
        # begin beside the orbit, or a flow whose residual passes there would not move at all
        attempt = corrector.solve(chart, xi + 1e-6 * (1 - row), row, row @ xi)
        if attempt.converged:
            x, period = chart.decode(attempt.xi)
            found[:, i] = problem.energy(x) / point.energy - 1, point.period / period - 1
    return Comparison(
        flow.name,
        np.array([p.index for p in chosen]),
        np.array([p.energy for p in chosen]),
        found[0],
        found[1],
    )
