"""Branch switching: the first point of a branch of less symmetry that crosses at a special point.

``crossing`` has the equations of that point. A map that assumes the symmetry which the new orbits lack does not see
them: its derivative has one null vector there. Orbits of the quarter-period map are symmetric twice, u(-t) = u(t) and
u(t + T/2) = -u(t). A crossing branch may keep the first, from rest to rest in half a period, or the product of both,
u(T/2 - t) = -u(t), from centre to centre. At a period doubling the new orbits close after 2 T, and T is doubled in the
unknowns.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vipetsc.modes.continuation.crossing import crossing_row
from vipetsc.modes.flow import MAPS
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError
from vipetsc.modes.shooting import Shooting, ShootingFrame, repetitions

# The numbers below were measured at eleven special points of the benchmark of Kerschen and Peeters and of the paper's
# model with either law. At seven of these points another branch crosses.

# First steps s along a crossing branch that are tried, over the orbit's size. The first leads to it at six of the seven
# crossings, the second at the one next to grazing.
STEPS = np.array([1e-3, 1e-4, 1e-5, 1e-6])
# Largest correction by Newton's method, over s. The crossing branch may leave at an angle to r: there the correction is
# up to 5 s on the paper's branches, and beyond 100 s where the method ends on another branch.
ASTRAY = 20.0
# The tolerance for a crossing branch is the one asked for, or this many times the residual of the special point in the
# map that sees the crossing if that is larger, but ``LOOSEST`` at most.
ROUNDINGS = 10
LOOSEST = 1e-9
# A special point with a larger residual is no orbit of the map: an orbit that closes after two periods, for instance,
# has no quarter from rest to the centre. Residuals of orbits are up to 2e-11, those of other orbits about 1.
NO_ORBIT = 1e-6
# A map has a second null direction if the ratio of the smallest singular value to the largest is below this. The ratio
# is 1e-9 or less at a crossing, and 3e-3 or more in maps that do not see it.
SINGULAR = 1e-5
# Step of the difference, as a fraction of the tangent, by which the old branch's direction is found in the unknowns of
# another map. With ten times this step or a tenth of it r turns by 1e-6 rad at most, in the maps taken.
ALONG = 1e-6


class Crossing(NamedTuple):
    """A crossing as the map of ``problem`` sees it (module docstring).

    xi_0 are the unknowns of the ``frame`` at the special point, and the ``row`` (n + 1,) is r.
    """

    problem: Shooting
    frame: ShootingFrame
    row: np.ndarray


def switch(old: Shooting, point: Point) -> tuple[Shooting, Point]:
    """Return the problem and a first point, with its tangent, on the branch that crosses at a special ``point``.

    The new orbits have less symmetry: they are shot over half a period, from rest to rest or from centre to centre,
    whichever map has a second null direction at ``point``; over the doubled period at a period doubling. The new
    problem has the tolerance that the map's rounding at the special point allows, and as many Newton steps as ``old``.
    Raises ContinuationError if no map has a second null direction, or no orbit off the old branch is found.
    """
    # A crossing branch may keep either of the quarter map's two symmetries; the quarter map sees one that keeps both.
    names: tuple[str, ...] = (old.map.name,)
    if old.map.quarter:
        names = ("quarter", "half", "half-centre")

    singular: list[str] = []
    for name in names:
        crossing = _crossing(old, point, name, singular)
        if crossing is not None:
            return crossing.problem, _first_point(crossing, point)
    where = f"at E = {point.energy:.9g} J, f = {point.frequency:.9g} Hz"
    raise ContinuationError(f"no branch crosses {where}: smallest singular values {', '.join(singular)}")


def _crossing(old: Shooting, point: Point, name: str, singular: list[str]) -> Crossing | None:
    """Return the crossing seen by the map of that name, or None if it has no second null direction there.

    A text with the smallest singular value is appended to ``singular``.
    """
    max_newton = old.newton.max_newton
    problem = Shooting(old.flow, MAPS[name], tolerance=old.tolerance, max_newton=max_newton)
    x, period = _re_expressed(old, point, problem)
    frame = problem.relative_frame(x, period)
    # The special point solves the equations of the old map; here they show whether it is an orbit of this map, too.
    rounding = float(np.abs(problem.residual(problem.arc(x, period))).max() / frame.unit)
    if rounding > NO_ORBIT:
        return None

    # The last right singular vector is the null vector that always exists. The one before belongs to the smallest
    # singular value, and is the second null vector if that vanishes.
    values, directions = np.linalg.svd(frame.jacobian_of(problem.arc(x, period), frame.xi))[1:]
    singular.append(f"{name} {values[-1] / values[0]:.1e}")
    if values[-1] > SINGULAR * values[0]:
        return None

    # The old branch's direction in the unknowns of this map, by a difference.
    ahead = replace(point, x=point.x + ALONG * point.tangent[:-1], period=point.period + ALONG * point.tangent[-1])
    along = frame.chart.encode(*_re_expressed(old, ahead, problem)) - frame.xi
    row = crossing_row(directions[-2:], along)
    tolerance = max(old.tolerance, min(ROUNDINGS * rounding, LOOSEST))
    problem = Shooting(old.flow, MAPS[name], tolerance=tolerance, max_newton=max_newton)
    return Crossing(problem=problem, frame=problem.relative_frame(x, period), row=row)


def _first_point(crossing: Crossing, point: Point) -> Point:
    """Return first orbit off the old branch, which crosses at ``point``; raises ContinuationError if none is found."""
    problem, frame, row = crossing
    for step in STEPS:
        attempt = frame.solve(frame.xi + step * row, row, row @ frame.xi + step)
        astray = float(np.linalg.norm(attempt.xi - frame.xi - step * row)) > ASTRAY * step
        if attempt.converged and not astray:
            first = frame.measures(attempt, frame.tangent_towards(attempt.xi, row))
            # Near a tongue's tip Newton's method may end on another branch's orbit, passed several times.
            if repetitions(problem, first) == 1:
                return first
    why = f"the last attempt, at {step:g}: {attempt.reason}; residuals {attempt.residuals}"
    remedy = f"increase nnm.tolerance (now {problem.tolerance:.1g})"
    raise ContinuationError(f"no orbit of a crossing branch is found at E = {point.energy:.9g} J ({why}): {remedy}")


def _re_expressed(old: Shooting, point: Point, new: Shooting) -> tuple[np.ndarray, float]:
    """Return initial values (n,) and period in s of the orbit of a ``point`` of the ``old`` problem, for ``new``.

    The period is doubled at a period doubling.
    """
    period = point.period
    if point.kind == "period-doubling":
        period *= 2
    if old.map.start == new.map.start:
        return point.x, period
    # A map from the centre begins with the velocities there, at the end of the quarter from rest.
    return old.arc(point.x, point.period).end[old.system.dofs :], period
