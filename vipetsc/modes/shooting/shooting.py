"""Shooting with matrices: periodic orbits by Newton's method of PETSc's SNES and the flow's sensitivities."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from vipetsc.modes.grazing import grazing_contacts
from vipetsc.modes.latest import LatestValues
from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError, SpecialKind
from vipetsc.modes.shooting.charts import CHARTS, DenseChart, Relative
from vipetsc.modes.shooting.flow import Arc, Flow
from vipetsc.modes.shooting.maps import ShootingMap
from vipetsc.modes.shooting.orbit import resonance
from vipetsc.modes.shooting.shooting_equations import ShootingEquations, ShootingFrame
from vipetsc.modes.shooting.stability import HalfTraceAbove, half_traces, multipliers, real_half_traces

# A half-trace is (mu + 1/mu)/2 of a pair of multipliers. Along narrow tongues it only touches +-1: if it lies within
# this of the level, on either side, a change of sign is rounding and no special point.
LEAST_CROSSING = 1e-6
# Residuals that rounding leaves are up to this many times eps r^(3/2) (``Shooting.rounding``). Those of two masses, of
# chains and of pressed contacts with r from 7 to 2,400 are up to 3.6 times that in the map of half a period, 6 times
# in that of the whole, and 0.7 times in that of a quarter.
ROUNDING = 8
# If the smallest singular value of the derivative is below this fraction of the largest, there is a second null vector,
# and the tangent is not unique.
DEGENERATE = 1e-12
# Samples of an arc in which contacts that graze are looked for: a parabola through three of them has to err by less
# than ``grazing.TOUCH``.
SAMPLES = 2000


class DenseFrame(ShootingFrame[Arc]):
    """Shooting equations with the matrix of their derivative."""

    problem: "Shooting"
    chart: DenseChart

    def jacobian(self, xi: np.ndarray) -> np.ndarray:
        """Derivative (n, n + 1) of the residual."""
        return self.jacobian_of(self.arc(xi), xi)

    def jacobian_of(self, arc: Arc, xi: np.ndarray) -> np.ndarray:
        """Derivative (n, n + 1) of the residual at the unknowns ``xi`` of an ``arc``."""
        return self.problem.jacobian(arc) @ self.chart.derivative(xi) / self.unit

    def tangent_at(self, xi: np.ndarray) -> np.ndarray:
        """The unit tangent (n + 1,) at a solution ``xi`` (n + 1,), on the side of the frame's own."""
        return self.tangent_towards(xi, self.tangent)

    def tangent_towards(self, xi: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """The unit tangent (n + 1,) at a solution ``xi`` (n + 1,), on the side of ``reference`` (n + 1,)."""
        # The null vector, of either sign.
        direction = np.linalg.svd(self.jacobian(xi))[2][-1]
        if direction @ reference < 0:
            return -direction
        return direction


class Shooting(ShootingEquations[Arc]):
    """Periodic orbits of a ``flow``'s system: initial values x (n,) and period, by Newton's method (PETSc SNES).

    Newton's method solves the n equations and one more linear row in the unknowns of a chart; it ends at a scaled
    residual of ``tolerance``, after a step below ``STEP_TOLERANCE``, where the residual stagnates within its
    ``rounding``, or after ``max_newton`` steps. Raises ValueError if the map needs an odd system and the system is not.
    """

    guards = frozenset({"half_trace", "turn_relative"})

    def __init__(self, flow: Flow, shooting_map: ShootingMap, tolerance: float = 1e-13, max_newton: int = 7) -> None:
        super().__init__(flow.system, shooting_map, tolerance)
        self.flow = flow
        self.limits = flow.limits
        # If nothing holds the system, its momentum stays 0 in an arc from rest to rest, whatever the start: one
        # equation is lost. The centre of mass is kept in its place instead. An arc that starts at the centre (u = 0)
        # has it there.
        self._kept = None
        if shooting_map.starts_at_rest and shooting_map.ends_at_rest:
            self._kept = flow.system.mean_motion
        self.newton = DenseNewton(flow.system.dofs + 1, max_newton)
        self._frames: LatestValues[tuple[Point, str], ShootingFrame[Arc]] = LatestValues(1)

    def _integrate(self, start: np.ndarray, period: float) -> Arc:
        return self.flow.arc(start, self.map.fraction * period, period)

    def end(self, arc: Arc) -> np.ndarray:
        """The state (2n,) at an arc's end."""
        return arc.end

    def rounding(self, period: float) -> float:
        """The largest scaled residual that rounding may leave of an orbit of that ``period`` in s.

        Let the fastest mode be r times as fast as the orbit. A step of the flow is a radian of that mode or less, and
        rounds its velocity, which may be r times that of the orbit, to eps r. The mode sums the errors of some r steps
        as a random walk, to eps r^(3/2) of the orbit's velocity.
        """
        ratio = self.flow.omega_ref(period) * period / (2 * np.pi)
        return float(ROUNDING * np.finfo(float).eps * ratio**1.5)

    def stability(self, arc: Arc) -> tuple[np.ndarray, float]:
        """Half-traces (n - 1,) of an orbit and the largest modulus of its multipliers."""
        traces = half_traces(self.system, self.map, arc)
        # A single mass has the trivial pair alone, whose multiplier is 1.
        return traces, float(np.abs(multipliers(traces, self.map.quarter)).max(initial=1.0))

    def residual(self, arc: Arc) -> np.ndarray:
        """Values (n,) that vanish at the arc's end, plus the displacement of the centre of mass times a frequency."""
        end = super().residual(arc)
        if self._kept is None:
            return end
        return end + self.flow.omega * (self._kept @ arc.start[self.free])

    def jacobian(self, arc: Arc) -> np.ndarray:
        """Derivative (n, n + 1) of the residual with respect to initial values and period."""
        sensitivity = arc.sensitivity[self.zero, self.free]
        if self._kept is not None:
            sensitivity = sensitivity + self.flow.omega * self._kept
        return np.column_stack([sensitivity, self.map.fraction * self.end_rate(arc)])

    def frame(self, point: Point, chart: str = "auto") -> ShootingFrame[Arc]:
        """The frame at an orbit, as ``ShootingEquations.frame`` describes it; the latest one is kept."""
        # A step of a branch and the search for its special points begin at the same orbit.
        return self._frames.get((point, chart), lambda: super(Shooting, self).frame(point, chart))

    def frame_at(self, chart: str, x: np.ndarray, period: float, tangent: np.ndarray | None = None) -> DenseFrame:
        """The frame at any initial values ``x`` (n,) and period, in the ``chart`` of that name."""
        if tangent is None:
            tangent = np.empty(0)
        return DenseFrame(self, CHARTS[chart](self.system, x, period), x, period, tangent)

    def relative_frame(self, x: np.ndarray, period: float) -> DenseFrame:
        """The unknowns of ``relative_chart`` for initial values ``x`` (n,)."""
        return DenseFrame(self, self.relative_chart(x, period), x, period, np.empty(0))

    def relative_chart(self, x: np.ndarray, period: float) -> Relative:
        """The chart ``relative`` near the initial values ``x`` (n,) and the period in s.

        It has the gaps of contacts only where the map starts at rest.
        """
        return Relative(self.system, x, period, rest=self.map.starts_at_rest)

    def null_vector(self, start: Point) -> np.ndarray:
        """Tangent d(x, period) at a corrected orbit, of either sign; raises ContinuationError if it is not unique."""
        chart = CHARTS["relative"](self.system, start.x, start.period)
        xi = chart.encode(start.x, start.period)
        matrix = self.jacobian(self.arc(*chart.decode(xi))) @ chart.derivative(xi)
        values, directions = np.linalg.svd(matrix)[1:]
        if values[-1] < DEGENERATE * values[0]:
            raise ContinuationError(
                f"degenerate tangent at E = {start.energy:.6g} J, f = {start.frequency:.9g} Hz: singular values "
                f"{values}; start at another energy (nnm.start_energy) or switch branches there"
            )
        return chart.derivative(xi) @ directions[-1]

    def grazing(self, point: Point) -> list[int]:
        """The numbers, from 1, of contacts that graze in an orbit; raises FlowError if it cannot be integrated."""
        start = self.arc(point.x, point.period).start
        interval = self.map.fraction * point.period / SAMPLES
        u = self.flow.states(start, interval, SAMPLES, point.period)[:, : self.system.dofs]
        return grazing_contacts(self.system, u)

    def special_kinds(self, left: Point, right: Point) -> Iterator[SpecialKind[Point]]:
        """Folds, what the half-traces tell, and a contact that just touches.

        A half-trace of 1 is a branch point (or a fold) that keeps the map's symmetry; -1 breaks it (quarter period) or
        doubles the period (the others); 0 doubles the period of quarter-period orbits.
        """
        yield from super().special_kinds(left, right)
        if self.system.is_linear_at_rest and not (left.episodes or right.episodes):
            return
        # The half-traces of a quarter map belong to half a period. There a multiplier of -1 returns after the whole
        # period, which breaks the symmetry; multipliers +-i, half-trace 0, are -1 over the period and double it.
        levels = {1.0: "branch-point", -1.0: "period-doubling"}
        if self.map.quarter:
            levels = {1.0: "branch-point", -1.0: "symmetry-breaking", 0.0: "period-doubling"}
        # Each search takes a dozen integrations: half-traces that are complex at both points are left out. Two real
        # ones may meet within the step and be complex in between, so that a point that is found must have a real one.
        for level, name in levels.items():
            for i in real_half_traces(left, right):
                test = HalfTraceAbove(i, level)
                yield SpecialKind(name, test, floor=LEAST_CROSSING, accept=test.is_real)

        # Several contacts may begin within one step, one after the other or, by a symmetry, at one point.
        fewest, most = sorted((left.episodes, right.episodes))
        for count in range(fewest + 1, most + 1):
            yield touch_of(count)

    def with_resonance(self, fold: Point, left: Point, right: Point) -> Point:
        """A fold of the energy with the resonance whose tongue it begins or ends."""
        return replace(fold, resonance=resonance(self, fold))


def touch_of(count: int) -> SpecialKind[Point]:
    """Points at which the number of contact episodes becomes ``count``, or falls below it.

    A mere touch is no episode: such a point has one fewer.
    """

    def above(point: Point) -> float:
        return 1.0 if point.episodes >= count else -1.0

    return SpecialKind("grazing", above, finish=lambda point, left, right: replace(point, episodes=count - 1))
