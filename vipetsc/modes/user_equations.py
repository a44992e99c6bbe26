"""Continuation of a user's own equations F(x, p) = 0, n equations for n unknowns x and a parameter p.

    import vipetsc
    for curve in vipetsc.follow(lambda x, p: p * x - x**3, [0.0], -1.0, 1.0):
        print(curve.attrs["name"], curve["p"].values, curve["x"].values, curve["kind"].values)

The unknowns of the continuation (``continuation.arclength``) are xi = (x/scale, p/half the range). Between neighbouring
points two kinds of special points are looked for. At a *fold* the parameter's component of the tangent t changes sign.
At a *branch point*, where another curve crosses, the determinant of the derivative bordered by t does, which passes
folds without a zero. ``crossing`` says how the other curve is begun; it is followed both ways.

As equilibria of x' = F(x, p), points are stable if no eigenvalue of dF/dx has a positive real part. Their number is
``unstable``.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vipetsc.endings import Ended, Ending
from vipetsc.modes.continuation.arclength import Continuation, Verdict, locate
from vipetsc.modes.continuation.crossing import crossing_row, step_across
from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.problem import (
    Attempt,
    ContinuationError,
    FlowError,
    NoMotionError,
    SpecialKind,
    nearest_on_chords,
    unit,
)
from vipetsc.modes.response.state import Response
from vipetsc.modes.response.turning import BoundedTurn, RangeProblem

if TYPE_CHECKING:
    import xarray as xr

Function = Callable[[np.ndarray, float], np.ndarray]

# Step of central differences in unknowns of order one: their error is about 1e-11 of the derivative.
DIFFERENCE = 6e-6
# A direction is a null direction if its singular value is below this fraction of the largest: at a located branch point
# it is 1e-9 or less, at the points of the tests next to one 1e-3.
SINGULAR = 1e-6
# First steps along a crossing curve that are tried, over ``largest_step``.
FRACTIONS = np.array([1.0, 0.1, 0.01])
# Branch points nearer than this in unknowns of order one are the same.
SAME = 1e-4
# The first point on a crossing curve belongs to a curve that is nearer to it than this fraction of its distance from
# the branch point. The curve that is crossed there is about that distance away, a chord of the other one 0.03 of it.
NEAR = 0.3


class UserFrame:
    """The equations near a point, with its unknowns ``xi`` (n + 1,) of order one and unit ``tangent`` (n + 1,)."""

    def __init__(self, problem: "UserProblem", xi: np.ndarray, tangent: np.ndarray) -> None:
        self.problem = problem
        self.xi = xi
        self.tangent = tangent

    def encode(self, point: Response) -> np.ndarray:
        """Return the unknowns (n + 1,) of another point."""
        return point.xi

    def direction(self, point: Response) -> np.ndarray:
        """Return the curve's direction (n + 1,) at another point."""
        return point.tangent

    def correct(self, guess: np.ndarray, arclength: float) -> Attempt:
        """Solve for the point at an ``arclength`` along the tangent, from ``guess`` (n + 1,)."""
        return self.problem.solve(guess, self.tangent, self.tangent @ (self.xi + arclength * self.tangent))

    def tangent_at(self, xi: np.ndarray) -> np.ndarray:
        """Return the unit tangent (n + 1,) at a solution, on the side of the frame's own.

        At a branch point, which has two null vectors, it is the frame's tangent projected on their plane.
        """
        null_vectors = self.problem.null_vectors(xi)
        return unit(null_vectors.T @ (null_vectors @ self.tangent))

    def measures(self, attempt: Attempt, direction: np.ndarray) -> Response:
        """Return the point that an attempt has converged to, where ``direction`` (n + 1,) is the unit tangent."""
        return Response(xi=attempt.xi, tangent=direction)


class UserProblem(RangeProblem):
    """The equations F(x, p) = 0 in unknowns of order one (``PeriodicProblem``).

    ``jacobian`` gives dF/dx (n, n); without one both derivatives are central differences. ``scales`` (n + 1,) are the
    units of x and p. The residual is F over a ``unit``, the size of its derivative where the curve begins, so that an
    error of the residual is about one of the unknowns.
    """

    def __init__(
        self, function: Function, jacobian: Function | None, scales: np.ndarray, tolerance: float, max_newton: int
    ) -> None:
        self.function = function
        self.derivative = jacobian
        self.scales = scales
        self.tolerance = tolerance
        self.newton = DenseNewton(len(scales), max_newton)
        self.unit = 1.0

    def begin(self, xi: np.ndarray) -> None:
        """Take the ``unit`` of the residual from the derivative at the unknowns ``xi`` (n + 1,)."""
        self.unit = float(np.linalg.norm(self.jacobian(xi), np.inf)) or 1.0

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """Return F (n,) over its unit at the unknowns ``xi`` (n + 1,); raises ValueError if it has another shape."""
        values = np.asarray(self.function(xi[:-1] * self.scales[:-1], float(xi[-1] * self.scales[-1])), float)
        if values.shape != (len(xi) - 1,):
            raise ValueError(
                f"F(x, p) has the shape {values.shape}; return one value for each of {len(xi) - 1} unknowns"
            )
        return values / self.unit

    def jacobian(self, xi: np.ndarray) -> np.ndarray:
        """Return the derivative (n, n + 1) of ``residual``."""
        steps = DIFFERENCE * np.eye(len(xi))
        if self.derivative is None:
            return np.column_stack([self._difference(xi, step) for step in steps])
        x = xi[:-1] * self.scales[:-1]
        matrix = np.asarray(self.derivative(x, float(xi[-1] * self.scales[-1])), float) * self.scales[:-1] / self.unit
        return np.column_stack([matrix, self._difference(xi, steps[-1])])

    def _difference(self, xi: np.ndarray, step: np.ndarray) -> np.ndarray:
        return (self.residual(xi + step) - self.residual(xi - step)) / (2 * DIFFERENCE)

    def solve(self, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        """Solve for the point (n + 1,) with row . xi = value, from ``guess``."""
        return self.newton.solve(self, guess, row, value, self.tolerance)

    def at(self, guess: np.ndarray, p: float) -> np.ndarray:
        """Return the unknowns (n + 1,) of the solution at the scaled parameter ``p``, or raise ContinuationError."""
        attempt = self.solve(np.append(guess[:-1], p), np.eye(len(guess))[-1], p)
        if not attempt.converged:
            value = p * self.scales[-1]
            raise ContinuationError(f"no solution at p = {value:.6g}: {attempt.reason}; residuals {attempt.residuals}")
        return attempt.xi

    def null_vectors(self, xi: np.ndarray) -> np.ndarray:
        """Return orthonormal null vectors of the derivative: (1, n + 1), or (2, n + 1) at a branch point."""
        jacobian = self.jacobian(xi)
        if not np.isfinite(jacobian).all():
            raise FlowError("the derivative of F is not finite")
        values, directions = np.linalg.svd(jacobian)[1:]
        regular = int(np.sum(values > SINGULAR * max(values[0], 1.0)))
        return directions[max(regular, len(xi) - 2) :]

    def unstable(self, xi: np.ndarray) -> int:
        """Return the number of eigenvalues of dF/dx with a positive real part, beyond rounding."""
        eigenvalues = np.linalg.eigvals(self.jacobian(xi)[:, :-1] / self.scales[:-1])
        return int(np.sum(eigenvalues.real > 1e-9 * np.abs(eigenvalues).max()))

    def frame(self, point: Response, chart: str = "auto") -> UserFrame:
        """Return the frame at a point; there is one ``chart``."""
        return UserFrame(self, point.xi, point.tangent)

    def first_tangent(self, start: Response, direction: int) -> np.ndarray:
        """Return the tangent (n + 1,) at the first point, along which p grows (``direction`` 1) or falls (-1)."""
        return UserFrame(self, start.xi, np.eye(len(start.xi))[-1] * direction).tangent_at(start.xi)

    def special_kinds(self, left: Response, right: Response) -> Iterator[SpecialKind[Response]]:
        """Yield folds and branch points."""
        yield SpecialKind("fold", lambda point: float(point.tangent[-1]))
        _, size = self._determinant(left)

        def bordered(point: Response) -> float:
            sign, logarithm = self._determinant(point)
            return sign * float(np.exp(logarithm - size))

        yield SpecialKind("branch-point", bordered)

    def _determinant(self, point: Response) -> tuple[float, float]:
        """Return sign and logarithm of the determinant of the derivative bordered by the tangent."""
        sign, logarithm = np.linalg.slogdet(np.vstack([self.jacobian(point.xi), point.tangent]))
        return float(sign), float(logarithm)


class UserSteps(BoundedTurn):
    """Steps to an end of the range ``ends`` (2,) of the scaled parameter, or back to the ``first`` point."""

    smallest_step = 1e-9
    problem: UserProblem

    def __init__(
        self, problem: UserProblem, first: Response, ends: np.ndarray, points: int, largest_step: float
    ) -> None:
        super().__init__(problem, points, ends, first)
        self.first_step = 0.1 * largest_step
        self.largest_step = largest_step

    def ended_at(self, bound: float) -> Ended:
        """Return that the parameter came to its end."""
        return Ending.END_OF_PARAMETER.with_numbers(end=bound * self.problem.scales[-1])

    def stuck(self, last: Response, attempt: Attempt | None, verdict: Verdict) -> str:
        """Return where and why the curve cannot go on."""
        p = last.xi[-1] * self.problem.scales[-1]
        why = verdict.why or "the next step is too short"
        return f"no step from the last good point, p = {p:.8g}: {why}; change scale, largest_step or tolerance"


def follow(
    function: Function,
    x0: Sequence[float] | np.ndarray,
    p0: float,
    p1: float,
    *,
    jacobian: Function | None = None,
    scale: float = 1.0,
    branches: int = 8,
    points: int = 1000,
    largest_step: float = 0.1,
    tolerance: float = 1e-11,
    max_newton: int = 10,
) -> "list[xr.Dataset]":
    """Follow solutions of F(x, p) = 0 from p0 towards p1, with folds, branch points and the curves that cross there.

    ``function`` is F(x, p) (n,), Newton's method begins at ``x0`` (n,), and a curve ends where p leaves the range from
    p0 to p1. ``jacobian`` is dF/dx(x, p) (n, n), by default from differences; ``scale`` is the size of x. Of the curves
    that cross, both halves are followed, ``branches`` halves at most. ``points`` bounds the number of points of a
    curve, ``largest_step`` is in units of ``scale`` and half the range; Newton's method ends at a residual of
    ``tolerance``.

    Returns the curves as datasets: ``p`` (point,), ``x`` (point, unknown), ``kind`` (regular, fold or branch-point) and
    ``unstable``, the number of eigenvalues of dF/dx with a positive real part. Attributes are ``name`` and ``ending``.
    Raises ContinuationError if there is no solution to begin with.
    """
    x0 = np.atleast_1d(np.asarray(x0, float))
    if p0 == p1 or not np.isfinite([p0, p1]).all():
        raise ValueError(f"p0 = {p0} and p1 = {p1}: set two different finite ends of the range")
    scales = np.append(np.full(len(x0), float(scale)), abs(p1 - p0) / 2)
    problem = UserProblem(function, jacobian, scales, tolerance, max_newton)
    ends = np.sort([p0, p1]) / scales[-1]
    guess = np.append(x0, p0) / scales
    problem.begin(guess)
    start = Response(xi=problem.at(guess, guess[-1]))
    start = replace(start, tangent=problem.first_tangent(start, int(np.sign(p1 - p0))))

    curves: list[list[Response]] = []
    datasets = []
    crossed: list[np.ndarray] = []
    waiting = [[start]]
    while waiting and len(curves) <= branches:
        first = waiting.pop(0)
        # A curve that comes back may have passed here: both of its halves, or a second branch point, begin it.
        if any(_passes(curve, first) for curve in curves):
            continue
        name = "curve" if not curves else f"branch-{len(curves)}"
        solutions, ending = _followed(problem, first, UserSteps(problem, first[-1], ends, points, largest_step))
        curves.append(solutions)
        datasets.append(_dataset(problem, solutions, name, ending))

        for point in solutions[len(first) :]:
            if point.kind == "branch-point" and not any(np.linalg.norm(point.xi - xi) < SAME for xi in crossed):
                crossed.append(point.xi)
                waiting += [[point, half] for half in _halves(problem, point, largest_step)]
    return datasets


def _passes(curve: list[Response], first: list[Response]) -> bool:
    """Return whether a ``curve`` passes the last of the points ``first``: nearer than a part of their distance."""
    nodes = np.array([point.xi for point in curve])
    _, distances, _ = nearest_on_chords(first[-1].xi, nodes[:-1], nodes[1:])
    return bool(distances.min(initial=np.inf) < NEAR * np.linalg.norm(first[-1].xi - first[0].xi))


def _followed(problem: UserProblem, first: list[Response], rule: UserSteps) -> tuple[list[Response], str]:
    """Return all points of a curve that begins with the points ``first``, and how it ended."""
    solutions = [*first]
    curve = Continuation(problem, first[-1], rule)
    before = None
    last = curve.point
    try:
        for point in curve:
            solutions += [*locate(problem, last, curve.passed, before=before), point]
            before = last
            last = point
    except NoMotionError as error:
        return solutions, Ending.FAILED.with_numbers(reason=error).sentence
    if not curve.finished:
        return solutions, f"{rule.points} points reached"
    return solutions, curve.ended.sentence


def _halves(problem: UserProblem, point: Response, largest_step: float) -> Iterator[Response]:
    """Yield first points, with tangents, on the two halves of the curve that crosses at a branch ``point``."""
    null_vectors = problem.null_vectors(point.xi)
    if len(null_vectors) != 2:
        return
    row = crossing_row(null_vectors, point.tangent)
    for side in (row, -row):
        attempt, _ = step_across(problem.solve, point.xi, side, largest_step * FRACTIONS)
        if attempt.converged:
            yield Response(xi=attempt.xi, tangent=UserFrame(problem, attempt.xi, side).tangent_at(attempt.xi))


def _dataset(problem: UserProblem, solutions: list[Response], name: str, ending: str) -> "xr.Dataset":
    """Return the points of a curve as a dataset."""
    import xarray as xr

    xi = np.array([point.xi for point in solutions]) * problem.scales
    variables = {
        "p": ("point", xi[:, -1], {"long_name": "parameter"}),
        "x": (("point", "unknown"), xi[:, :-1], {"long_name": "unknowns"}),
        "kind": ("point", np.array([point.kind for point in solutions]), {"long_name": "kind of point"}),
        "unstable": (
            "point",
            np.array([problem.unstable(point.xi) for point in solutions]),
            {"long_name": "eigenvalues of dF/dx with a positive real part"},
        ),
    }
    return xr.Dataset(variables, attrs={"name": name, "ending": ending})
