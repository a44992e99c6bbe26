"""Is a branch one branch? Jumps between arcs, retracing and the return to the linear mode, detected."""

import itertools
from collections.abc import Iterator

import numpy as np

from vipetsc.modes.continuation import Continuation, Guards, StepControl, chart_at, half_trace_change
from vipetsc.modes.point import Point
from vipetsc.modes.shooting import Corrector


def suspects(points: list[Point], guards: Guards | None = None) -> Iterator[tuple[int, str]]:
    """Steps of a branch that violate a guard: (place of the left point, which guard and by how much)."""
    guards = guards or Guards()
    for i, (a, b) in enumerate(itertools.pairwise(points)):
        change = half_trace_change(a, b)
        if abs(a.episodes - b.episodes) > guards.contacts:
            yield i, f"contacts {a.episodes} -> {b.episodes}"
        elif change > 2 * guards.half_trace:
            yield i, f"asinh of a half-trace changes by {change:.2g}"


def is_jump(corrector: Corrector, left: Point, right: Point, control: StepControl, points: int = 400) -> bool:
    """Whether the guarded branch from ``left`` misses ``right``.

    Follows the branch from the left point with the guards on, until it passes the right one or is further
    from the left point than three times the step.
    """
    chart = chart_at(corrector.problem, "relative", left)
    goal = chart.encode(right.x, right.period)
    origin = chart.encode(left.x, left.period)
    reach = float(np.linalg.norm(goal - origin))
    guarded = StepControl(
        first=min(control.first, reach / 4), smallest=control.smallest, largest=reach / 4, points=points
    )
    last = origin
    for point in Continuation(corrector, left, guarded):
        here = chart.encode(point.x, point.period)
        chord = here - last
        share = np.clip((goal - last) @ chord / (chord @ chord), 0.0, 1.0)
        missed = np.linalg.norm(last + share * chord - goal)
        # a smooth arc leaves its chord by its length times the turn allowed
        if 0 < share < 1 and missed <= guarded.guards.turn * np.linalg.norm(chord):
            return bool(missed > 0.02 * reach)
        if np.linalg.norm(here - origin) > 3 * reach:
            return True
        last = here
    return True


class BranchMonitor:
    """Tells when a growing branch retraces itself and when it returns to a linear mode."""

    def __init__(self, corrector: Corrector) -> None:
        self.problem = corrector.problem
        self._linear = corrector.problem.system.linear_modes()[0] / (2 * np.pi)
        self._track = np.empty((256, corrector.problem.system.dofs + 2))
        self._count = 0
        self._touched = False

    def check(self, point: Point) -> str | None:
        """A sentence when the branch does what it should not; None otherwise."""
        if self._count == len(self._track):
            self._track = np.vstack([self._track, np.empty_like(self._track)])
        size = np.abs(point.x).max()
        here = np.array([*(point.x / size), np.log(size), np.log(point.period)])
        track = self._track[: self._count]
        self._track[self._count] = here
        self._count += 1
        if point.episodes > 0:
            self._touched = True
        elif self._touched and np.abs(point.frequency / self._linear - 1).min() < 1e-9:
            mode = int(np.abs(point.frequency / self._linear - 1).argmin()) + 1
            return f"returned to linear mode {mode} at E = {point.energy:.6g} J (point {point.index})"
        if len(track) < 10 or not self._touched:
            return None
        starts, ends = track[:-6], track[1:-5]
        chords = ends - starts
        lengths = np.einsum("ij,ij->i", chords, chords)
        share = np.clip(np.einsum("ij,ij->i", here - starts, chords) / np.maximum(lengths, 1e-300), 0, 1)
        distance = np.linalg.norm(starts + share[:, None] * chords - here, axis=1)
        nearest = int(distance.argmin())
        step = here - track[-1]
        along = chords[nearest] @ step / max(np.sqrt(lengths[nearest]) * np.linalg.norm(step), 1e-300)
        close = distance[nearest] < 1e-4 * np.linalg.norm(step)
        if close and along < -0.999:
            return f"retraces itself: point {point.index} lies on the step after point {nearest + 1}, backwards"
        if close and along > 0.999:
            return f"closed on itself: point {point.index} lies on the step after point {nearest + 1}"
        return None
