"""Pseudo-arclength continuation as an iterator over points; the caller owns the loop."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse import spmatrix
from scipy.sparse.linalg import spsolve

from vipetsc.case.nnm import NnmTable
from vipetsc.modes.newton import Attempt
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError
from vipetsc.modes.shooting.shooting import Shooting

# What a guard holds down, for messages, and where it is set.
GUARDED = {
    "half_trace": ("the half-trace changes too much", "nnm.guards.half_trace"),
    "contacts": ("more than one contact appears or goes", "nnm.guards.contacts"),
    "corrector": ("the corrector goes too far", "nnm.guards.corrector"),
    "turn": ("the branch turns too sharply", "nnm.guards.turn"),
    "turn_relative": ("the branch turns too sharply in the relative chart", "nnm.guards.turn_relative"),
    "truncation": ("the harmonics left out are too large", "nnm.harmonics or nnm.truncation"),
}


class Frame:
    """The chart at a point of a branch, the unknowns ``xi`` (n + 1,) of the point and the unit ``tangent`` there.

    The chart ``auto`` is grazing within 5 % of it and relative elsewhere.
    """

    def __init__(self, problem: Shooting, chart: str, point: Point) -> None:
        if chart == "auto":
            gaps = problem.system.gaps(point.x) if problem.map.start == "rest" else np.array([np.inf])
            near = np.abs(gaps / problem.system.clearances).min(initial=np.inf) < 0.05
            chart = "grazing" if near else "relative"
        self.problem: Any = problem
        self.chart: Any = problem.chart(chart, point.x, point.period)
        self.xi = self.chart.encode(point.x, point.period)
        self.tangent = unit(self.direction(point))

    def direction(self, point: Point) -> np.ndarray:
        """The branch's direction at another ``point``, of any length, in these unknowns."""
        derivative = self.chart.derivative(self.chart.encode(point.x, point.period))
        return solved(derivative, point.tangent)

    def correct(self, guess: np.ndarray, step: float) -> Attempt:
        """Newton's method from ``guess`` for the orbit at the arclength ``step`` along the tangent."""
        return self.problem.solve(self.chart, guess, self.tangent, self.tangent @ self.xi + step)

    def point(self, attempt: Attempt, index: int, step: float) -> tuple[Point, np.ndarray]:
        """The point that an attempt has converged to, and the unit tangent there in this chart."""
        direction = self.problem.tangent(attempt.xi, self.tangent)
        point = Point.of(self.problem, attempt, self.chart, direction)
        return replace(point, index=index, step=step), direction


class Continuation:
    """Iterates over the points of a branch, from ``start`` in the direction of growing or falling energy.

    Of the section [nnm], ``control``, it takes the ``chart`` (``auto``: grazing near a contact at the arc's start, else
    relative), the steps in units of the chart, the ``guards``, and where the branch ends: outside ``energy`` (J),
    outside ``frequency`` (Hz) or after ``points`` points. Each point is yielded when it has been accepted; ``ending``
    says in a sentence how the branch ended, ``finished`` whether it left its range. The whole state is the last point
    and the next step: a stored branch can be resumed. Raises ContinuationError if the step falls below the smallest or
    the tangent at the start is degenerate.
    """

    frame: Callable[..., Frame] = Frame

    def __init__(
        self, problem: Shooting, start: Point, control: NnmTable, direction: int = 1, step: float | None = None
    ) -> None:
        self.problem: Any = problem
        self.control, self.point = control, start
        if not start.tangent.size:
            self.point = replace(start, tangent=self.first_tangent(start, direction))
        self.step = control.first_step if step is None else step
        self.ending, self.finished = "not finished", False

    def __iter__(self) -> Iterator[Point]:
        for _ in range(self.control.points):
            point = self.point = self._next()
            for name, value, unit_name in (("frequency", point.frequency, "Hz"), ("energy", point.energy, "J")):
                low, high = getattr(self.control, name)
                if not low <= value <= high:
                    self.finished, self.ending = True, f"left the {name} range {low:g} to {high:g} {unit_name}"
            yield point
            if self.finished:
                return
        self.ending = f"{self.control.points} points reached: raise nnm.points and resume to go on"

    def _next(self) -> Point:
        last, frame = self.point, self.frame(self.problem, self.control.chart, self.point)
        residuals, why, knob = "none", "no step tried", "nnm.max_newton or nnm.tolerance"
        while self.step >= self.control.smallest_step:
            attempt = frame.correct(frame.xi + self.step * frame.tangent, self.step)
            residuals = attempt.residuals
            if not attempt.converged:
                why, knob = f"no convergence ({attempt.reason})", "nnm.max_newton or nnm.tolerance"
                self.step *= 0.4
                continue
            point, strain, guard = self._judge(frame, attempt)
            if strain <= 1.0:
                effort = max(strain / 0.7, point.newton / 5, 0.5)  # a step at most doubles
                self.step = min(self.step / effort, self.control.largest_step)
                return point
            why, knob = GUARDED[guard]
            self.step *= min(max(0.8 / strain, 0.1), 0.7)
        raise ContinuationError(
            f"step below {self.control.smallest_step:g} after point {last.index} "
            f"(E = {last.energy:.9g} J, f = {last.frequency:.9g} Hz): {why}; "
            f"residuals of the last attempt: {residuals}; turn nnm.smallest_step or {knob}"
        )

    def _judge(self, frame: Frame, attempt: Attempt) -> tuple[Point, float, str]:
        """The corrected point, how far it strains the guards (1 is the bound), and which guard most."""
        last, step = self.point, self.step
        point, direction = frame.point(attempt, last.index + 1, step)
        changes = {
            "contacts": abs(point.episodes - last.episodes),
            "corrector": float(np.linalg.norm(attempt.xi - frame.xi - step * frame.tangent)) / step,
            "turn": float(np.arccos(min(direction @ frame.tangent, 1.0))),
            **self.changes(last, point),
        }
        bounds = {guard: getattr(self.control.guards, guard, 1.0) or np.inf for guard in changes}
        strains = {guard: change / bounds[guard] for guard, change in changes.items()}
        for guard in strains.keys() & {"contacts", "turn_relative", "truncation"}:  # no reason to slow down within
            strains[guard] *= strains[guard] > 1
        worst = max(strains, key=lambda guard: strains[guard])
        return point, strains[worst], worst

    def changes(self, last: Point, point: Point) -> dict[str, float]:
        """What else is guarded from point to point."""
        return {"half_trace": half_trace_change(last, point), "turn_relative": relative_turn(self.problem, last, point)}

    def first_tangent(self, start: Point, direction: int) -> np.ndarray:
        """Tangent at a corrected point, towards growing (+1) or falling (-1) energy."""
        return first_tangent(self.problem, start, direction)


def solved(derivative: np.ndarray | spmatrix, vectors: np.ndarray) -> np.ndarray:
    """The derivative of a chart, dense or sparse, solved for ``vectors`` (n,) or (n, m)."""
    return np.linalg.solve(derivative, vectors) if isinstance(derivative, np.ndarray) else spsolve(derivative, vectors)


def unit(vector: np.ndarray) -> np.ndarray:
    """The vector over its length."""
    return vector / np.linalg.norm(vector)


def half_trace_change(a: Point, b: Point) -> float:
    """Distance between the sets of asinh(c) of two points: no half-trace is further from the other set.

    Half-traces may meet and turn into a complex pair, so that they have no lasting order. 0 for one degree of
    freedom.
    """

    def squashed(c: np.ndarray) -> np.ndarray:
        size = np.maximum(np.abs(c), np.finfo(float).tiny)
        return c * (np.arcsinh(size) / size)  # with the number's own phase: asinh itself jumps on the imaginary axis

    distance = np.abs(squashed(a.half_traces)[:, None] - squashed(b.half_traces)[None, :])
    return float(max(distance.min(axis=axis, initial=np.inf).max(initial=0.0) for axis in (0, 1)))


def relative_turn(problem: Shooting, a: Point, b: Point) -> float:
    """Angle in rad between the tangents of two points in the chart ``relative`` at the first; 0 without a tangent."""
    if not (a.tangent.size and b.tangent.size):
        return 0.0
    chart = problem.chart("relative", a.x, a.period, rest=problem.map.start == "rest")
    scale = chart.derivative(chart.encode(a.x, a.period))
    before, after = solved(scale, np.column_stack([a.tangent, b.tangent])).T
    return float(np.arccos(min(unit(before) @ unit(after), 1.0)))


def first_tangent(problem: Shooting, start: Point, direction: int) -> np.ndarray:
    """Tangent d(x, period) at a corrected point, towards growing (+1) or falling (-1) energy.

    Raises ContinuationError at a branch point, where the tangent is not unique.
    """
    chart = problem.chart("relative", start.x, start.period)
    xi = chart.encode(start.x, start.period)
    values, null = problem.null_vector(chart, xi)
    if values[-1] < 1e-12 * values[0]:
        raise ContinuationError(
            f"degenerate tangent at E = {start.energy:.6g} J, f = {start.frequency:.9g} Hz: singular values {values}; "
            "start elsewhere (nnm.start_energy) or switch branches there"
        )
    tangent = chart.derivative(xi) @ null
    energy_tangent = problem.energy_gradient(start.x) @ tangent[:-1]
    return tangent * (np.sign(energy_tangent) * direction or direction)
