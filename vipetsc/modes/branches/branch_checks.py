"""Checks of a branch: retracing and the return to the linear mode; its orbits in files."""

import numpy as np

from vipetsc.case.nnm import Guards
from vipetsc.endings import Ended, Ending
from vipetsc.io.netcdf import Variables, variable
from vipetsc.modes.point import Point
from vipetsc.modes.problem import nearest_on_chords
from vipetsc.modes.shooting import Shooting, repetitions, sample_orbit

# Points between two checks whether a branch has passed on to another one; each check integrates fifteen arcs.
REPETITIONS_EVERY = 50
# A branch without contact whose frequency is within this of a linear mode's has returned to it.
LINEAR = 1e-9
# A branch retraces itself at a point whose distance from an earlier step is below this fraction of its own step, with
# the same direction to this cosine.
SAME_PLACE = 1e-4
SAME_DIRECTION = 0.999
# The latest steps, which lie near the point anyway, are left out of that, and branches with few points are not checked.
LATEST = 6
FEWEST = 10


class BranchMonitor:
    """Finds when a growing branch retraces itself, stands still, returns to a linear mode or passes on to another."""

    def __init__(self, problem: Shooting, guards: Guards) -> None:
        self._problem = problem
        self._guards = guards
        self._linear = problem.system.linear_modes()[0] / (2 * np.pi)
        # Orbits so far: shape, and the logarithms of size and period, so that distances are relative at any energy.
        self._track = np.empty((0, problem.system.dofs + 2))
        self._touched = False
        self._repeats = False

    def check(self, point: Point) -> Ended | None:
        """Return the ending by the first check that the branch fails at ``point``; None if it passes all."""
        size = np.abs(point.x).max()
        here = np.array([*(point.x / size), np.log(size), np.log(point.period)])
        track = self._track
        self._track = np.vstack([track, here])
        ended = self._returned(point)
        if ended is None:
            ended = self._stands_still(point)
        if ended is None:
            ended = self._repeats_another(point)
        if ended is None:
            ended = self._retraces(point, track, here)
        return ended

    def _returned(self, point: Point) -> Ended | None:
        """Return the ending if the branch is back on a linear mode after it has touched a contact; else None."""
        if point.episodes > 0:
            self._touched = True
            return None
        # Over the frequency of the point: a motion as a rigid body has none.
        detuning = np.abs(self._linear / point.frequency - 1)
        if not self._touched or detuning.min() >= LINEAR:
            return None
        return Ending.LINEAR_MODE.with_numbers(mode=detuning.argmin() + 1, energy=point.energy, point=point.index)

    def _stands_still(self, point: Point) -> Ended | None:
        """Return the ending if the latest points are one; else None."""
        places = self._guards.standstill
        if not 0 < places <= len(self._track) - 1:
            return None
        if np.ptp(self._track[-places:], axis=0).max() > self._guards.advance:
            return None
        return Ending.STANDSTILL.with_numbers(places=places, point=point.index, energy=point.energy)

    def _repeats_another(self, point: Point) -> Ended | None:
        """Return the ending if two checks in a row find orbits of another branch, passed several times; else None.

        A single such orbit may lie at the tip of a tongue.
        """
        if point.index % REPETITIONS_EVERY != 0:
            return None
        times = repetitions(self._problem, point)
        twice = self._repeats and times > 1
        self._repeats = times > 1
        if not twice:
            return None
        return Ending.OTHER_BRANCH.with_numbers(point=point.index, times=times)

    def _retraces(self, point: Point, track: np.ndarray, here: np.ndarray) -> Ended | None:
        """Return the ending if the branch, which is ``here`` now, lies on its earlier ``track``; else None."""
        # Without contact a branch is its linear mode at every energy.
        if len(track) < FEWEST or not self._touched:
            return None

        step = here - track[-1]
        size = np.linalg.norm(step)
        starts = track[:-LATEST]
        ends = track[1 : 1 - LATEST]
        # A step of other periods is too far away, and a branch has thousands of steps.
        low = np.minimum(starts[:, -1], ends[:, -1]) - SAME_PLACE * size
        high = np.maximum(starts[:, -1], ends[:, -1]) + SAME_PLACE * size
        (near,) = np.nonzero((low <= here[-1]) & (here[-1] <= high))
        if not near.size:
            return None

        starts = starts[near]
        ends = ends[near]
        _, distance, length = nearest_on_chords(here, starts, ends)
        i = int(distance.argmin())
        along = (ends[i] - starts[i]) @ step / max(length[i] * size, 1e-300)

        if distance[i] >= SAME_PLACE * size or abs(along) <= SAME_DIRECTION:
            return None
        where = f"point {point.index} lies on the step after point {near[i] + 1}"
        if along < 0:
            return Ending.RETRACED.with_numbers(where=where)
        return Ending.CLOSED_ON_ITSELF.with_numbers(where=where)


def sampled(problem: Shooting, points: list[Point]) -> Variables:
    """Return the orbits of ``points`` as variables of the branch's file."""
    displacement, velocity = zip(*(sample_orbit(problem, p) for p in points), strict=True)
    samples = len(displacement[0])
    axes = "orbit", "phase", "dof"
    return {
        "orbit": variable("orbit", np.arange(len(points)), "1", "stored orbit"),
        "phase": variable("phase", np.arange(samples) / samples, "1", "time over the period"),
        "orbits/energy": variable("orbit", [p.energy for p in points], "J", "energy"),
        "orbits/period": variable("orbit", [p.period for p in points], "s", "period"),
        "orbits/number": variable("orbit", [p.index for p in points], "1", "number of the regular point"),
        "orbits/displacement": variable(axes, displacement, "m", "displacement"),
        "orbits/velocity": variable(axes, velocity, "m/s", "velocity"),
    }
