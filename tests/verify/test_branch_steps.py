"""Steps along a branch: their arclength, the guards that bound them, and where a branch ends, jumps or stands still."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from tests.models import CLEARANCE, IN_PHASE, OUT_OF_PHASE, reduced_model
from vipetsc.case.nnm import Guards, NnmTable
from vipetsc.endings import Ending
from vipetsc.modes.branches.branch_checks import BranchMonitor
from vipetsc.modes.continuation.arclength import Continuation, half_trace_change
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.point import Point
from vipetsc.modes.problem import unit
from vipetsc.modes.shooting import Relative, Shooting, linear_start


def test_steps_have_the_arclength_that_they_say(short_branch):
    """Each step s satisfies t . (xi - xi0) = s in the chart of the point before, whose unknowns are of order one."""
    for before, after in itertools.pairwise(short_branch.points):
        chart = Relative(reduced_model(), before.x, before.period)
        xi = chart.encode(before.x, before.period)
        gap = before.x[1] - before.x[0]
        size = np.abs(before.x).max()
        scale = min(max(abs(gap), CLEARANCE), size)
        assert xi == pytest.approx([before.x[0] / size, gap / scale, 1.0], rel=1e-12)

        tangent = np.linalg.solve(chart.derivative(xi), before.tangent)
        chord = chart.encode(after.x, after.period) - xi
        assert tangent @ chord / np.linalg.norm(tangent) == pytest.approx(after.step, rel=1e-6)
        assert after.index == before.index + 1


@pytest.mark.parametrize(
    ("name", "bound", "sentence"),
    [
        ("energy", [0.0, 0.0294], "left the energy range 0 to 0.0294 J"),
        ("frequency", [0.0, 2981.4], "left the frequency range 0 to 2981.4 rad/s"),
    ],
)
def test_a_branch_ends_with_the_first_point_beyond_a_range(name, bound, sentence):
    """The last point of a branch, and no other, is beyond the range that it says it has left."""
    problem = Shooting(Dop853Flow(reduced_model()), MAPS["quarter"])
    continuation = Continuation(problem, linear_start(problem, OUT_OF_PHASE, 0.02), NnmTable(**{name: bound}))

    points = list(continuation)

    assert continuation.ended.sentence == sentence
    assert continuation.finished
    unit = {"energy": 1.0, "frequency": 2 * np.pi}[name]  # frequencies of points are in Hz
    outside = [number for number, point in enumerate(points, 1) if unit * getattr(point, name) > bound[1]]
    assert outside == [len(points)]


def test_a_branch_that_has_used_up_its_points_is_not_finished():
    """A branch that ends at the number of its points can go on, and says how."""
    problem = Shooting(Dop853Flow(reduced_model()), MAPS["quarter"])
    continuation = Continuation(problem, linear_start(problem, OUT_OF_PHASE, 0.02), NnmTable(points=3))

    points = list(continuation)

    assert len(points) == 3
    assert continuation.ended.sentence == "3 points reached: increase nnm.points and resume to continue"
    assert not continuation.finished


def test_guards_are_what_the_points_obey(short_branch):
    """No step strains a guard beyond its bound; some are held back by the half-trace, some by the turn."""
    guards = Guards()
    turns = []
    changes = []
    for before, after in itertools.pairwise(short_branch.points):
        chart = Relative(reduced_model(), before.x, before.period)
        derivative = chart.derivative(chart.encode(before.x, before.period))
        first, second = (unit(np.linalg.solve(derivative, point.tangent)) for point in (before, after))

        turns.append(np.arccos(np.clip(first @ second, -1, 1)))
        changes.append(half_trace_change(before, after))

    # Bounds that no step comes near would not be tested by this branch.
    assert 0.3 * guards.half_trace < max(changes) <= guards.half_trace
    assert 0.3 * guards.turn < max(turns) <= guards.turn


def in_phase_hertz(**control) -> tuple[Shooting, list[Point]]:
    """Follow the in-phase Hertz branch in the chart auto, up to just behind the tip of its 3:1 tongue."""
    system = reduced_model("hertz")
    problem = Shooting(Dop853Flow(system), MAPS["quarter"])
    start = linear_start(problem, IN_PHASE, system.grazing_energy(IN_PHASE) / 100)
    table = {"points": 150, "chart": "auto", "energy": [0, 6e9]} | control
    continuation = Continuation(problem, start, NnmTable(**table))
    return problem, [continuation.point, *continuation]


def findings(problem: Shooting, points: list[Point]) -> list[str]:
    """Return what the monitor of a growing branch reports at its points."""
    monitor = BranchMonitor(problem, Guards())
    return [ended.sentence for ended in map(monitor.check, points) if ended]


# The tip of the in-phase Hertz branch's 3:1 tongue lies on the out-of-phase branch. A step too long for the turn at the
# tip leads onto the out-of-phase branch, and the grazing chart hides that turn. The true branch comes back from the
# tip, where it passes c = 1, and none of its orbits repeats another one.
def test_guarded_the_in_phase_hertz_branch_comes_back_from_the_tip():
    """With the guard on turns the in-phase branch comes back from the tip, and no check reports anything."""
    problem, points = in_phase_hertz()

    assert max(problem.turn(a, b) for a, b in itertools.pairwise(points)) > 0.2
    assert findings(problem, points) == []
    assert points[-1].energy < points[124].energy < 0.031


def test_a_branch_comes_back_to_a_mode_of_a_lattice_that_is_free_to_move():
    """A branch has returned to a linear mode when it has the mode's frequency and no contact.

    The rigid motion of the free lattice has frequency 0, to which no branch returns.
    """
    omega = 2 * np.pi * np.array([0.0, 3.0, 5.0])
    system = SimpleNamespace(dofs=3, linear_modes=lambda: (omega, np.eye(3)))
    monitor = BranchMonitor(SimpleNamespace(system=system), Guards())
    with np.errstate(all="raise"):
        assert monitor._returned(SimpleNamespace(episodes=2, frequency=4.0)) is None
        assert monitor._returned(SimpleNamespace(episodes=0, frequency=5.1)) is None
        found = monitor._returned(SimpleNamespace(episodes=0, frequency=5.0 + 1e-12, energy=2.0, index=7))
    assert found == Ending.LINEAR_MODE.with_numbers(mode=3, energy=2.0, point=7)
