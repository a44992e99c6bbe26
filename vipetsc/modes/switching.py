"""Branch switching: from a symmetry-breaking, branch or period-doubling point onto the branch that crosses there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vipetsc.modes.chart import Relative
from vipetsc.modes.continuation import ContinuationError, null_vector
from vipetsc.modes.point import Point
from vipetsc.modes.shooting import MAPS, Corrector, Shooting


def switch(corrector: Corrector, point: Point, amplitude: float = 1e-3, sign: int = 1) -> tuple[Corrector, Point]:
    """A corrector and a first point, with its tangent, on the branch that crosses at ``point``.

    The new orbits have less symmetry: they are shot over half a period, from rest to rest or from centre to
    centre, whichever map has a second null direction at ``point``; over the doubled period at a period doubling.

    Parameters
    ----------
    amplitude
        First step along the new direction, relative to the orbit's size.
    sign
        Which side of a pitchfork, 1 or -1.

    Raises
    ------
    ContinuationError
        If no map has a second null direction, or the corrector falls back or fails.
    """
    tried = []
    for name in ("quarter", "half", "half-centre"):
        if corrector.problem.map.start == corrector.problem.map.end and name != corrector.problem.map.name:
            continue
        times = 2 if point.kind == "period-doubling" else 1
        problem = Shooting(corrector.problem.flow, MAPS[name])
        fresh = Corrector(problem, corrector.tolerance, corrector.step_tolerance)
        x, period = _re_expressed(corrector.problem, point, problem), times * point.period
        chart = Relative(problem.system, x, period, rest=problem.map.start == "rest")
        xi = chart.encode(x, period)
        scale = problem.residual_scale(chart.size, chart.period)
        arc = problem.arc(x, period)
        if np.abs(problem.residual(arc)).max() > 1e-6 * scale:
            continue  # not an orbit of this map: the doubled period's quarter
        matrix = problem.jacobian(arc) @ chart.derivative(xi) / scale
        values, directions = np.linalg.svd(matrix)[1:]
        tried.append(f"{name} {values[-1] / values[0]:.1e}")
        if values[-1] > 1e-5 * values[0]:
            continue
        base = np.append(x * 0, 0.0)
        if point.tangent is not None:
            later = replace(
                point, x=point.x + 1e-6 * point.tangent[:-1], period=point.period + 1e-6 * point.tangent[-1]
            )
            base = chart.encode(_re_expressed(corrector.problem, later, problem), times * later.period) - xi
        new = directions[-2:].T @ directions[-2:] @ base  # the old branch within the null plane
        flat = directions[-2:] @ new
        across = directions[-2:].T @ np.array([-flat[1], flat[0]])
        row = sign * across / np.linalg.norm(across)
        attempt = fresh.solve(chart, xi + amplitude * row, row, row @ xi + amplitude)
        if not attempt.converged:
            history = " ".join(f"{r:.1e}" for r in attempt.history)
            raise ContinuationError(
                f"no convergence on the crossing branch at E = {point.energy:.9g} J "
                f"({attempt.reason}; residuals {history}): "
                "lower nnm.switch_amplitude"
            )
        direction = null_vector(fresh.matrix(attempt.xi)[:-1])
        direction *= np.sign(direction @ row) or 1.0
        tangent = chart.derivative(attempt.xi) @ direction
        return fresh, Point.of(problem, attempt, chart, tangent=tangent)
    raise ContinuationError(
        f"no branch crosses at E = {point.energy:.9g} J, f = {point.frequency:.9g} Hz: "
        f"smallest singular values {', '.join(tried)}"
    )


def _re_expressed(old: Shooting, point: Point, new: Shooting) -> np.ndarray:
    """The initial values of the same orbit for another map."""
    if old.map.start == new.map.start:
        return point.x
    return old.arc(point.x, point.period).end[old.system.dofs :]  # the centre of a quarter-period orbit
