"""Branch switching: the first point of a branch of less symmetry that crosses at a special point."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vipetsc.modes.point import Point
from vipetsc.modes.problem import Attempt, ContinuationError, unit
from vipetsc.modes.shooting.maps import MAPS
from vipetsc.modes.shooting.orbit import repetitions
from vipetsc.modes.shooting.shooting import DenseFrame, Shooting

# Fractions of the first step along a crossing branch that are tried.
FRACTIONS = np.array([1.0, 0.1, 0.01, 0.001])
# How many steps Newton's method may add to the first, since the branch leaves at an angle: up to 5 on the paper's
# branches, beyond 100 on others.
ASTRAY = 20.0
# The loosest tolerance of the crossing branch.
LOOSEST = 1e-9
# A residual of the special point above this: it is no orbit of the map, as the doubled period's is none of a quarter.
NO_ORBIT = 1e-6
# The smallest singular value over the largest, up to which a map has a second null direction.
SINGULAR = 1e-5
# Step along the old branch's tangent, in units of (x, period), that gives its direction in another map's unknowns.
ALONG = 1e-6


class Crossing(NamedTuple):
    """A crossing of branches seen by a ``problem`` with another map, at the unknowns of its ``frame``.

    ``row`` (n + 1,) is the unit direction across the old branch in the plane of the null vectors.
    """

    problem: Shooting
    frame: DenseFrame
    row: np.ndarray


def switch(old: Shooting, point: Point, amplitude: float = 1e-3) -> tuple[Shooting, Point]:
    """The problem and a first point, with its tangent, on the branch that crosses at a special ``point``.

    The new orbits have less symmetry: they are shot over half a period, from rest to rest or from centre to
    centre, whichever map has a second null direction at ``point``; over the doubled period at a period doubling.
    ``amplitude`` is the first step along the new direction, relative to the orbit's size; where Newton's method goes
    astray, parts of it are tried. The tolerance is what the map's rounding at the special point allows. Raises
    ContinuationError if no map has a second null direction, or no orbit off the old branch is found.
    """
    # An orbit over a quarter of its period has two symmetries, and a crossing branch may lack either.
    names: tuple[str, ...] = (old.map.name,)
    if old.map.quarter:
        names = ("quarter", "half", "half-centre")

    singular: list[str] = []
    for name in names:
        crossing = _crossing(old, point, name, singular)
        if crossing is not None:
            return crossing.problem, _first_point(crossing, point, amplitude)
    where = f"at E = {point.energy:.9g} J, f = {point.frequency:.9g} Hz"
    raise ContinuationError(f"no branch crosses {where}: smallest singular values {', '.join(singular)}")


def _crossing(old: Shooting, point: Point, name: str, singular: list[str]) -> Crossing | None:
    """The crossing seen by the map of that name, or None if it has no second null direction there.

    A text with the smallest singular value is appended to ``singular``.
    """
    problem = Shooting(old.flow, MAPS[name], old.tolerance)
    x, period = _re_expressed(old, point, problem)
    frame = problem.relative_frame(x, period)
    rounding = float(np.abs(problem.residual(problem.arc(x, period))).max() / frame.chart.size)
    if rounding > NO_ORBIT:
        return None

    values, directions = np.linalg.svd(frame.jacobian_of(problem.arc(x, period), frame.xi))[1:]
    singular.append(f"{name} {values[-1] / values[0]:.1e}")
    if values[-1] > SINGULAR * values[0]:
        return None

    ahead = replace(point, x=point.x + ALONG * point.tangent[:-1], period=point.period + ALONG * point.tangent[-1])
    along = frame.chart.encode(*_re_expressed(old, ahead, problem)) - frame.xi
    plane = directions[-2:]
    first, second = plane @ (plane.T @ plane @ along)
    row = unit(plane.T @ np.array([-second, first]))
    tolerance = max(old.tolerance, min(10 * rounding, LOOSEST))
    problem = Shooting(old.flow, MAPS[name], tolerance)
    return Crossing(problem, problem.relative_frame(x, period), row)


def _first_point(crossing: Crossing, point: Point, amplitude: float) -> Point:
    """The first orbit off the old branch; raises ContinuationError if none is found."""
    problem, frame, row = crossing
    step = np.nan
    attempt = Attempt(False, "not tried", [], frame.xi)
    for step in amplitude * FRACTIONS:
        attempt = frame.solve(frame.xi + step * row, row, row @ frame.xi + step)
        astray = float(np.linalg.norm(attempt.xi - frame.xi - step * row)) > ASTRAY * step
        if attempt.converged and not astray:
            first = frame.measures(attempt, frame.tangent_towards(attempt.xi, row))
            # Near a tongue's tip Newton's method may end on another branch's orbit, passed several times.
            if repetitions(problem, first) == 1:
                return first
    why = f"the last attempt, at {step:g}: {attempt.reason}; residuals {attempt.residuals}"
    remedy = f"increase nnm.tolerance (now {problem.tolerance:.1g}), or change nnm.switch_amplitude"
    raise ContinuationError(f"no orbit of a crossing branch is found at E = {point.energy:.9g} J ({why}): {remedy}")


def _re_expressed(old: Shooting, point: Point, new: Shooting) -> tuple[np.ndarray, float]:
    """Initial values and period of a special point's orbit for another map; the period is doubled where it doubles."""
    period = point.period
    if point.kind == "period-doubling":
        period *= 2
    if old.map.start == new.map.start:
        return point.x, period
    return old.end(old.arc(point.x, point.period))[old.system.dofs :], period  # the centre of a quarter-period orbit
