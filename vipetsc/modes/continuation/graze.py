"""Grazing: the orbit of a branch whose contact just touches, by Newton's method with the touch as two of its equations.

A pair of changes of a contact, an onset and a separation in either order, meets where the contact stands at its
clearance on side s with w' = 0. With the time t of that as an unknown beside those of the chart,

    H(xi) = 0,    s w(t; xi) = D,    w'(t; xi) = 0,

and the flow's sensitivities give all derivatives. At rest w' = 0 already, and t stays 0.
"""

from collections.abc import Iterator

import numpy as np

from vipetsc.modes.continuation.arclength import Frame
from vipetsc.modes.point import Point
from vipetsc.modes.problem import FlowError
from vipetsc.modes.shooting.flow import Arc
from vipetsc.modes.shooting.shooting import Grazing

# Newton steps at most; none is longer than this, and behind one below that rounding is left, in unknowns of order one.
STEPS, FURTHEST, CLOSE = 10, 0.5, 1e-9
# The flow must not end on an extremum; a parabola over this share of the time goes on to it, to rounding.
SHORT = 1e-6


def graze(frame: Frame, guess: np.ndarray, touching: Point) -> np.ndarray:
    """Unknowns (n + 1,) of the orbit near ``guess`` where the nearest pair of changes of ``touching`` meets.

    Raises ArithmeticError if there is no pair, or Newton's method fails.
    """
    problem, chart, system = frame.problem, frame.chart, frame.problem.system
    pairs = _pairs(problem.arc(touching.x, touching.period), problem.map.start == "rest", problem.map.end == "rest")
    _, time, contact, side = min(pairs, default=(0.0, np.nan, 0, 0))
    row = side * system.contact_rows[contact] / system.clearances[contact]
    n, xi = system.dofs, guess
    try:
        for _ in range(STEPS):
            x, period = chart.decode(xi)
            arc, inner = problem.arc(x, period), chart.derivative(xi)
            part, rest = problem.flow.arc(arc.start, (1 - SHORT) * time, period), SHORT * time
            (u, v), (du, dv) = np.split(part.end, 2), np.split(part.sensitivity[:, problem.free] @ inner[:-1], 2)
            pull = -system.forces(u) / system.masses
            u, v = u + rest * (v + rest / 2 * pull), v + rest * pull
            matrix = np.zeros((n + 2, n + 2))
            matrix[:n, :-1] = problem.jacobian(arc) @ inner / chart.size
            matrix[n] = np.append(row @ du, row @ v)
            matrix[n + 1] = np.append(row @ dv, row @ pull)
            values = np.array([*problem.residual(arc) / chart.size, row @ u - 1, row @ v])
            if time == 0 and isinstance(chart, Grazing) and chart.index == system.contacts[contact].resonator:
                matrix[n], values[n] = np.eye(n + 2)[chart.index], xi[chart.index]  # the gap's root, not the gap
            *step, later = np.linalg.solve(matrix, -values)
            size = float(np.linalg.norm(step))
            xi, time = xi + step, time + later
            if not (size <= FURTHEST and 0 <= time <= 1.1 * arc.duration):
                raise ArithmeticError("Newton's method goes astray")
            if size <= CLOSE:
                return xi
    except (FlowError, np.linalg.LinAlgError) as error:
        raise ArithmeticError(error) from error
    raise ArithmeticError(f"the touch is not found: last step {size:.1e}")


def _pairs(arc: Arc, rest_before: bool, rest_after: bool) -> Iterator[tuple[float, float, int, int]]:
    """Neighbouring changes of a contact on one side: time between them, the middle, contact, side.

    At rest before and after the arc its mirror image adds one each.
    """
    for contact in np.unique(arc.events[:, 1]).astype(int):
        times, _, sides, _ = arc.events[arc.events[:, 1] == contact].T
        if rest_before:
            times, sides = np.append(-times[0], times), np.append(sides[0], sides)
        if rest_after:
            times, sides = np.append(times, 2 * arc.duration - times[-1]), np.append(sides, sides[-1])
        for i in np.flatnonzero(sides[1:] == sides[:-1]):
            yield times[i + 1] - times[i], (times[i] + times[i + 1]) / 2, contact, int(sides[i])
