"""A branch seen closer: jumps, retracing and the return to the linear mode; its orbits, by its and by other flows."""

import itertools
from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from vipetsc.case.nnm import Guards, NnmTable
from vipetsc.io.netcdf import Variables, variable
from vipetsc.modes.continuation.arclength import Continuation, half_trace_change, relative_turn
from vipetsc.modes.point import Point, repetitions, sample_orbit
from vipetsc.modes.problem import ContinuationError, FlowError
from vipetsc.modes.shooting.flow import Flow
from vipetsc.modes.shooting.shooting import Relative, Shooting

# Points between two looks whether a branch has passed on to another one.
REPETITIONS_EVERY = 50


def suspects(problem: Shooting, points: list[Point]) -> Iterator[tuple[int, str]]:
    """Steps of a branch that violate a default guard: (place of the left point, which guard and by how much)."""
    guards = Guards()
    for i, (a, b) in enumerate(itertools.pairwise(points)):
        change, turn = half_trace_change(a, b), relative_turn(problem, a, b)
        if abs(a.episodes - b.episodes) > guards.contacts:
            yield i, f"contacts {a.episodes} -> {b.episodes}"
        elif change > 2 * guards.half_trace:
            yield i, f"asinh of a half-trace changes by {change:.2g}"
        elif turn > 2 * guards.turn_relative:
            yield i, f"the branch turns by {turn:.2g} rad"


def is_jump(problem: Shooting, left: Point, right: Point, control: NnmTable) -> bool:
    """Whether the guarded branch from ``left`` misses ``right``.

    Follows the branch from the left point with the guards on, until it passes the right one, is further from the left
    point than three times the step, or cannot go on.
    """
    chart = problem.chart("relative", left.x, left.period)
    origin, goal = chart.encode(left.x, left.period), chart.encode(right.x, right.period)
    reach = float(np.linalg.norm(goal - origin))
    last, first, anywhere = origin, min(control.first_step, reach / 4), [0.0, np.inf]
    steps = {"first_step": first, "largest_step": reach / 4, "points": 400, "chart": "relative", "guards": Guards()}
    guarded = control.model_copy(update={**steps, "energy": anywhere, "frequency": anywhere})
    with suppress(ContinuationError, FlowError):
        for point in Continuation(problem, left, guarded):
            here = chart.encode(point.x, point.period)
            share, missed, length = (float(a[0]) for a in _nearest(goal, last[None, :], here[None, :]))
            # a smooth arc leaves its chord by its length times the turn allowed
            if 0 < share < 1 and missed <= guarded.guards.turn * length:
                return missed > 0.02 * reach
            if np.linalg.norm(here - origin) > 3 * reach:
                break
            last = here
    return True


def jumps(points: list[Point], problem: Shooting, control: NnmTable) -> Iterator[str]:
    """Sentences about steps that jumped to another arc; only suspicious ones are followed again."""
    for i, why in suspects(problem, points):
        a, b = points[i], points[i + 1]
        if is_jump(problem, a, b, control):
            yield (
                f"jump between points {a.index} and {b.index} (E = {a.energy:.6g} -> {b.energy:.6g} J, "
                f"f = {a.frequency:.6g} -> {b.frequency:.6g} Hz): {why}; both satisfy the equations "
                f"(residuals {a.residual:.0e}, {b.residual:.0e})"
            )


def _nearest(place: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where each chord is nearest to ``place``, as a share of the chord; the distance there; the chords' lengths."""
    chords = ends - starts
    squared = np.einsum("ij,ij->i", chords, chords)
    share = np.clip(np.einsum("ij,ij->i", place - starts, chords) / np.maximum(squared, 1e-300), 0, 1)
    return share, np.linalg.norm(starts + share[:, None] * chords - place, axis=1), np.sqrt(squared)


class BranchMonitor:
    """Tells when a growing branch retraces itself, stands still, returns to a linear mode or passes on to another."""

    def __init__(self, problem: Shooting, guards: Guards) -> None:
        self._problem, self._guards = problem, guards
        self._linear = problem.system.linear_modes()[0] / (2 * np.pi) if problem.dense else np.full(1, np.inf)
        self._track = np.empty((0, problem.system.dofs + 2))
        self._touched = self._repeats = False

    def check(self, point: Point) -> str | None:
        """A sentence when the branch does what it should not; None otherwise."""
        size = np.abs(point.x).max()
        here = np.array([*(point.x / size), np.log(size), np.log(point.period)])
        track, self._track = self._track, np.vstack([self._track, here])
        detuning = np.abs(point.frequency / self._linear - 1)
        if point.episodes > 0:
            self._touched = True
        elif self._touched and detuning.min() < 1e-9:
            where = f"at E = {point.energy:.6g} J (point {point.index})"
            return f"returned to linear mode {detuning.argmin() + 1} {where}"
        places = self._guards.standstill
        if 0 < places <= len(track) and np.ptp(self._track[-places:], axis=0).max() <= self._guards.advance:
            return f"does not advance: {places} points up to {point.index} are one, at E = {point.energy:.9g} J"
        if point.index % REPETITIONS_EVERY == 0 and self._problem.dense:
            times = repetitions(self._problem, point)
            twice, self._repeats = self._repeats and times > 1, times > 1  # once, it may be at the tip of a tongue
            if twice:
                return f"left its branch: the orbit of point {point.index} is another one passed {times} times"
        if len(track) < 10 or not self._touched:
            return None
        starts, ends = track[:-6], track[1:-5]
        _, distance, length = _nearest(here, starts, ends)
        i, step = int(distance.argmin()), here - track[-1]
        size = np.linalg.norm(step)
        along = (ends[i] - starts[i]) @ step / max(length[i] * size, 1e-300)
        if distance[i] >= 1e-4 * size or abs(along) <= 0.999:
            return None
        where = f"point {point.index} lies on the step after point {i + 1}"
        return f"retraces itself: {where}, backwards" if along < 0 else f"closed on itself: {where}"


def sampled(problem: Shooting, points: list[Point]) -> Variables:
    """The orbits of ``points`` as variables of the branch's file."""
    displacement, velocity = zip(*(sample_orbit(problem, p) for p in points), strict=True)
    samples, axes = len(displacement[0]), ("orbit", "phase", "dof")
    return {
        "orbit": variable("orbit", np.arange(len(points)), "1", "stored orbit"),
        "phase": variable("phase", np.arange(samples) / samples, "1", "time over the period"),
        "orbits/energy": variable("orbit", [p.energy for p in points], "J", "energy"),
        "orbits/period": variable("orbit", [p.period for p in points], "s", "period"),
        "orbits/number": variable("orbit", [p.index for p in points], "1", "number of the regular point"),
        "orbits/displacement": variable(axes, displacement, "m", "displacement"),
        "orbits/velocity": variable(axes, velocity, "m/s", "velocity"),
    }


def compare(reference: Shooting, points: list[Point], flow: Flow) -> Variables:
    """What ``flow`` gives on every fourth of ``points``, as variables of the branch's file; NaN where it fails.

    The points are corrected keeping the first contact's w (or the largest displacement): at the same energy or
    frequency the comparison would be ill-posed where the branch is vertical or flat. The differences are the flow's
    values over the branch's, less 1.
    """
    problem = Shooting(flow, reference.map, max(reference.tolerance, 1e-12))
    contacts, chosen = problem.system.contacts, points[::4]
    difference = np.full((2, len(chosen)), np.nan)
    for i, point in enumerate(chosen):
        chart = Relative(problem.system, point.x, point.period, rest=problem.map.start == "rest")
        xi = chart.encode(point.x, point.period)
        row = np.zeros(len(xi))
        row[contacts[0].resonator if contacts else int(np.abs(point.x).argmax())] = 1.0
        # begin beside the orbit, or a flow whose residual passes there would not move at all
        attempt = problem.solve(chart, xi + 1e-6 * (1 - row), row, row @ xi)
        if attempt.converged:
            x, period = chart.decode(attempt.xi)
            difference[:, i] = problem.energy(x) / point.energy - 1, point.period / period - 1
    axis, group = f"compared_{flow.name}", f"flows/{flow.name}"
    text = "relative {} difference of " + f"{flow.name} at the same amplitude"
    return {
        axis: variable(axis, [p.index for p in chosen], "1", f"number of the point compared with {flow.name}"),
        f"{group}/energy": variable(axis, [p.energy for p in chosen], "J", "energy of the branch"),
        f"{group}/energy_difference": variable(axis, difference[0], "1", text.format("energy")),
        f"{group}/frequency_difference": variable(axis, difference[1], "1", text.format("frequency")),
    }
