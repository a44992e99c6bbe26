"""Orbits that are much slower than the fastest mode, whose residuals rounding keeps above the tolerance of others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from vipetsc.case import NnmCase
from vipetsc.modes.branches.orbits import ShootingMethod
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.shooting import Shooting, linear_start
from vipetsc.modes.system import SmoothSpring, System

pytestmark = pytest.mark.parallel(1)

# Two masses of 1 kg. The first one is on a spring of z + q z^2 + c z^3, and is joined to the second by a spring of
# 1 N/m and a contact of Hertz's law, which is pressed by DEPTH at rest. They move together 245 times more slowly than
# they vibrate against each other.
QUADRATIC = 0.3
CUBIC = 0.5
STIFFNESS = 1e7
DEPTH = 1e-6
CASE: dict[str, Any] = {
    "name": "stiff",
    "contacts": {"law": "hertz", "stiffness": STIFFNESS, "side": "plus", "precompression": DEPTH},
    "nnm": {
        "system": "own",
        "modes": [1],
        "points": 6,
        "first_step": 0.1,
        "largest_step": 0.3,
        "own": {
            "masses": [1.0, 1.0],
            "springs": [{"start": 0, "end": 1, "stiffness": 1.0}, {"start": 1, "end": 2, "stiffness": 1.0}],
            "smooth": [{"start": 0, "end": 1, "quadratic": QUADRATIC, "cubic": CUBIC}],
            "contacts": [{"host": 1, "resonator": 2, "clearance": 0.0}],
        },
    },
}


def test_two_masses_on_a_stiff_spring_have_the_period_of_one():
    """Two masses that a stiff spring joins move as one, whose period is a quadrature of the energy of the soft spring.

    The stiff spring of k N/m gives way by 1/(2 k) of the displacement.
    """
    link = 1e6
    smooth = [SmoothSpring.between(None, 0, quadratic=QUADRATIC, cubic=CUBIC)]
    system = System.assemble([1.0, 1.0], [(None, 0, 1.0), (0, 1, link)], [], smooth)
    problem = Shooting(Dop853Flow(system), MAPS["half"])
    point = linear_start(problem, 0, 0.05)
    turns = np.roots([CUBIC / 4, QUADRATIC / 3, 0.5, 0.0, -point.energy])
    low, high = sorted(turns[np.isreal(turns)].real)

    def slowness(phi: float) -> float:
        u = low + (high - low) * np.sin(phi) ** 2
        potential = u**2 / 2 + QUADRATIC * u**3 / 3 + CUBIC * u**4 / 4
        # Both masses have this speed.
        return float((high - low) * np.sin(2 * phi) / np.sqrt(point.energy - potential))

    assert point.period == pytest.approx(2 * quad(slowness, 0, np.pi / 2, epsrel=1e-10)[0], rel=3 / link)
    assert point.residual < problem.rounding(point.period)


def test_a_residual_that_rounding_does_not_explain_is_no_orbit():
    """Newton's method from the orbit of a stiff system converges within its rounding, and not if that were smaller."""
    method = ShootingMethod(NnmCase.from_table(CASE))
    problem = method.shooting
    point = method.start(problem, 0)
    frame = problem.frame_at("relative", point.x, point.period)
    row = np.append(point.x / np.linalg.norm(point.x), 0.0)
    rounding = problem.rounding(point.period)
    assert frame.solve(frame.xi * [1.0, 1.0, 1 + 1e-6], row, row @ frame.xi).history[-1] < rounding
    problem.rounding = lambda period: 1e-2 * rounding
    assert not frame.solve(frame.xi * [1.0, 1.0, 1 + 1e-6], row, row @ frame.xi).converged
