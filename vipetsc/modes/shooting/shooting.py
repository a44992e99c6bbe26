"""Periodic orbits as solutions of boundary value problems over a part of their period, by PETSc's SNES.

Newton's method works in the unknowns xi (n + 1,) of a chart (``charts``), in place of initial values x (n,) and the
period. ``Shooting`` has the matrix of the flow's sensitivities; a lattice without one uses ``ShootingEquations``, too.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.point import Point
from vipetsc.modes.problem import Attempt, ContinuationError, FlowError, Frame, SpecialKind, unit
from vipetsc.modes.shooting.charts import CHARTS, Chart, DenseChart, Relative, near_grazing
from vipetsc.modes.shooting.flow import Arc, Flow
from vipetsc.modes.shooting.graze import Touch, graze
from vipetsc.modes.shooting.maps import ShootingMap
from vipetsc.modes.shooting.orbit import resonance
from vipetsc.modes.shooting.stability import HalfTraceAbove, half_traces, multipliers, real_half_traces
from vipetsc.modes.system import System

# A half-trace is (lambda + 1/lambda)/2 of a pair of multipliers. Along narrow tongues it only touches +-1: a change of
# sign smaller than this is rounding, and no special point.
LEAST_CROSSING = 1e-6
# Singular values of the Jacobian below this fraction of the largest leave the tangent open.
DEGENERATE = 1e-12


class AnyArc(Protocol):
    """Interface of the arcs of all flows: the quantities of the orbit."""

    @property
    def duration(self) -> float:
        """Length of the arc in s."""

    @property
    def episodes(self) -> int:
        """Number of contact episodes in the arc."""

    @property
    def closed(self) -> float:
        """Time in s with a contact closed."""


A = TypeVar("A", bound=AnyArc)


class ShootingFrame(Generic[A]):
    """The shooting equations in the unknowns of a ``chart`` at one orbit.

    The argument ``tangent`` (n + 1,) is d(x, period) along the branch, or empty where there is none yet. The attribute
    is its unit image in the chart's unknowns, and is there only with a tangent. ``unit`` is that of the residual: the
    chart's, times the frequency where velocities should vanish at the end of an arc that starts with displacements.
    """

    tangent: np.ndarray

    def __init__(
        self, problem: "ShootingEquations[A]", chart: Chart, x: np.ndarray, period: float, tangent: np.ndarray
    ) -> None:
        self.problem = problem
        self.chart = chart
        self.unit = chart.size * problem.map.end_unit(period)
        self.xi = chart.encode(x, period)
        if tangent.size:
            self.tangent = unit(chart.to_unknowns(self.xi, tangent))

    def encode(self, point: Point) -> np.ndarray:
        """The unknowns of another orbit."""
        return self.chart.encode(point.x, point.period)

    def direction(self, point: Point) -> np.ndarray:
        """The branch's direction at another orbit, of any length."""
        return self.chart.to_unknowns(self.encode(point), point.tangent)

    def arc(self, xi: np.ndarray) -> A:
        """The arc from the unknowns ``xi``; raises FlowError where there is none."""
        if not np.all(np.isfinite(xi)) or self.chart.decode(xi)[1] <= 0:
            raise FlowError("Newton's method left the domain: the period is not positive")
        return self.problem.arc(*self.chart.decode(xi))

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """The residual (n,) at the arc's end, which vanishes for an orbit, over its unit."""
        return self.problem.residual(self.arc(xi)) / self.unit

    def correct(self, guess: np.ndarray, arclength: float) -> Attempt:
        """Newton's method from ``guess`` for the orbit at an ``arclength`` along the tangent."""
        return self.solve(guess, self.tangent, self.tangent @ self.xi + arclength)

    @abstractmethod
    def solve(self, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        """Newton's method from ``guess`` (n + 1,) for the orbit with row . xi = value."""

    @abstractmethod
    def tangent_at(self, xi: np.ndarray) -> np.ndarray:
        """The unit tangent at a solution, on the side of the frame's own."""

    def measures(self, attempt: Attempt, direction: np.ndarray | None = None) -> Point:
        """The orbit that an attempt has converged to, where ``direction`` is the branch's unit tangent or None."""
        problem = self.problem
        chart = self.chart
        x, period = chart.decode(attempt.xi)
        arc = problem.arc(x, period)
        traces, largest = problem.stability(arc)
        size = float(np.abs(x).max()) * problem.map.end_unit(period)

        tangent = np.empty(0)
        energy_tangent = slope = np.nan
        if direction is not None:
            # df/dE from the tangent: along a vertical piece of the branch the energy stands still.
            tangent = chart.to_changes(attempt.xi, direction)
            energy_tangent = float(problem.energy_gradient(x) @ tangent[:-1])
            slope = float(-tangent[-1] / period**2 / energy_tangent) if energy_tangent else np.inf

        return Point(
            x=x,
            period=period,
            energy=problem.energy(x),
            residual=float(np.abs(problem.residual(arc)).max()) / size,
            half_traces=traces,
            multiplier=largest,
            episodes=arc.episodes,
            closed=arc.closed / arc.duration,
            newton=len(attempt.history) - 1,
            tangent=tangent,
            slope=slope,
            energy_tangent=energy_tangent,
        )


class ShootingEquations(ABC, Generic[A]):
    """Periodic orbits of a ``system``: initial values x (n,) and a period.

    The ``shooting_map`` says over which part of the period an arc goes, and whether it starts and ends at rest or at
    the centre; for an orbit half of the state vanishes at its end. x are displacements in m for a map that starts at
    rest, velocities in m/s for one that starts at the centre. Raises ValueError if the map needs an odd system and the
    system is not.
    """

    has_half_traces: bool
    guards: frozenset[str]

    def __init__(self, system: System, shooting_map: ShootingMap, tolerance: float) -> None:
        if "centre" in (shooting_map.start, shooting_map.end) and not system.odd:
            raise ValueError(
                f"the {shooting_map.name} map needs forces that change sign with the displacement; "
                "this system's do not: use map = 'half'"
            )
        self.system = system
        self.map = shooting_map
        self.tolerance = tolerance
        n = system.dofs
        displacements = slice(0, n)
        velocities = slice(n, 2 * n)
        # the half of the state that is free at the arc's start, and the half that should vanish at its end
        self.free = displacements if shooting_map.start == "rest" else velocities
        self.zero = velocities if shooting_map.end == "rest" else displacements
        self._latest: tuple[np.ndarray, float, A] | None = None

    def start(self, x: np.ndarray) -> np.ndarray:
        """The state (2n,) at the start of the arc from initial values ``x``."""
        state = np.zeros(2 * self.system.dofs)
        state[self.free] = x
        return state

    def arc(self, x: np.ndarray, period: float) -> A:
        """The arc from initial values ``x``; raises FlowError where the flow fails. The latest one is kept."""
        if self._latest is None or self._latest[1] != period or not np.array_equal(self._latest[0], x):
            self._latest = x.copy(), period, self._integrate(self.start(x), period)
        return self._latest[2]

    @abstractmethod
    def _integrate(self, start: np.ndarray, period: float) -> A:
        """The arc from a state ``start`` (2n,) over the map's fraction of the ``period``."""

    @abstractmethod
    def end(self, arc: A) -> np.ndarray:
        """The state (2n,) at an arc's end."""

    @abstractmethod
    def stability(self, arc: A) -> tuple[np.ndarray, float]:
        """Half-traces of an orbit, and the largest modulus of its multipliers; empty and NaN without a matrix."""

    def residual(self, arc: A) -> np.ndarray:
        """The residual (n,) at the arc's end, which vanishes for an orbit: displacements in m or velocities in m/s."""
        return self.end(arc)[self.zero]

    def end_rate(self, arc: A) -> np.ndarray:
        """Time derivative (n,) of what should vanish at the arc's end."""
        n = self.system.dofs
        end = self.end(arc)
        if self.map.end == "centre":
            return end[n:]
        return -self.system.forces(end[:n]) / self.system.masses

    def energy(self, x: np.ndarray) -> float:
        """Energy in J of the orbit with initial values ``x``."""
        zero = np.zeros_like(x)
        return self.system.energy(x, zero) if self.map.start == "rest" else self.system.energy(zero, x)

    def energy_gradient(self, x: np.ndarray) -> np.ndarray:
        """dE/dx (n,) in J over the unit of ``x``."""
        return self.system.forces(x) if self.map.start == "rest" else self.system.masses * x

    @abstractmethod
    def frame_at(self, chart: str, x: np.ndarray, period: float, tangent: np.ndarray) -> ShootingFrame[A]:
        """The frame at any initial values and period; ``tangent`` may be empty."""

    def frame(self, point: Point, chart: str = "auto") -> ShootingFrame[A]:
        """The frame at an orbit; the chart ``auto`` is grazing if the orbit starts near a touch, else relative."""
        if chart == "auto":
            at_rest = self.map.start == "rest"
            chart = "grazing" if at_rest and near_grazing(self.system, point.x) else "relative"
        return self.frame_at(chart, point.x, point.period, point.tangent)

    @abstractmethod
    def null_vector(self, start: Point) -> np.ndarray:
        """Tangent d(x, period) at a corrected orbit, of either sign; raises ContinuationError if it is not unique."""

    def first_tangent(self, start: Point, direction: int) -> np.ndarray:
        """Tangent d(x, period) at a corrected orbit, towards growing (+1) or falling (-1) energy.

        Raises ContinuationError at a branch point, where the tangent is not unique.
        """
        tangent = self.null_vector(start)
        # The null vector has either sign; where the energy is stationary, the sign is arbitrary.
        energy_tangent = self.energy_gradient(start.x) @ tangent[:-1]
        return tangent * (np.sign(energy_tangent) * direction or direction)

    def turn(self, before: Point, after: Point) -> float:
        """Angle in rad between the tangents of two orbits in relative units at the first; 0 without a tangent."""
        if not (before.tangent.size and after.tangent.size):
            return 0.0
        chart = self.relative_chart(before.x, before.period)
        tangents = np.column_stack([before.tangent, after.tangent])
        first, second = chart.to_unknowns(chart.encode(before.x, before.period), tangents).T
        # The product of two unit vectors may be beyond 1 by rounding.
        return float(np.arccos(np.clip(unit(first) @ unit(second), -1.0, 1.0)))

    @abstractmethod
    def relative_chart(self, x: np.ndarray, period: float) -> Chart:
        """The chart ``relative``, with the gaps of contacts only where they are at the start of the map."""

    def special_kinds(self, left: Point, right: Point) -> Iterator[SpecialKind[Point]]:
        """Folds of the energy and of the frequency."""
        # Where all contacts are as at rest an orbit may lie on a linear branch, whose energy and frequency turn by
        # rounding alone: folds are then sought between two orbits that both have contacts which close or open.
        if not self.system.is_linear_at_rest or (left.episodes and right.episodes):
            yield SpecialKind("fold-energy", lambda p: p.energy_tangent, finish=self.with_resonance)
            yield SpecialKind("fold-frequency", lambda p: float(p.tangent[-1] / p.period))

    def with_resonance(self, fold: Point, left: Point, right: Point) -> Point:
        """The ``fold`` of the energy; a subclass may add the resonance whose tongue it begins or ends."""
        return fold


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

    def solve(self, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        """Newton's method from ``guess`` (n + 1,) for the orbit with row . xi = value."""
        return self.problem.newton.solve(self, guess, row, value, self.problem.tolerance)

    def tangent_at(self, xi: np.ndarray) -> np.ndarray:
        """The unit tangent at a solution, on the side of the frame's own."""
        return self.tangent_towards(xi, self.tangent)

    def tangent_towards(self, xi: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """The unit tangent at a solution, on the side of ``reference``."""
        direction = np.linalg.svd(self.jacobian(xi))[2][-1]  # the null vector
        return -direction if direction @ reference < 0 else direction


class Shooting(ShootingEquations[Arc]):
    """Periodic orbits of a ``flow``'s system: initial values x (n,) and period, by Newton's method (PETSc SNES).

    Newton's method solves the n equations and one more linear row in the unknowns of a chart; it ends at a scaled
    residual of ``tolerance``, after a step below ``STEP_TOLERANCE``, where rounding allows no more, or after
    ``max_newton`` steps. Raises ValueError if the map needs an odd system and the system is not.
    """

    has_half_traces = True
    guards = frozenset({"half_trace", "turn_relative"})

    def __init__(self, flow: Flow, shooting_map: ShootingMap, tolerance: float = 1e-13, max_newton: int = 7) -> None:
        super().__init__(flow.system, shooting_map, tolerance)
        self.flow = flow
        # From rest to rest the momentum of a system that nothing holds is 0 whatever the start: its centre of mass is
        # kept where it is at rest instead. From the centre on the arc itself does so.
        self._kept = flow.system.mean_motion if shooting_map.start == shooting_map.end == "rest" else None
        self.newton = DenseNewton(flow.system.dofs + 1, max_newton)

    def _integrate(self, start: np.ndarray, period: float) -> Arc:
        return self.flow.arc(start, self.map.fraction * period, period)

    def end(self, arc: Arc) -> np.ndarray:
        """The state (2n,) at an arc's end."""
        return arc.end

    def stability(self, arc: Arc) -> tuple[np.ndarray, float]:
        """Half-traces (n - 1,) of an orbit and the largest modulus of its multipliers."""
        traces = half_traces(self.system, self.map, arc)
        # A single mass has the trivial pair alone, whose multiplier is 1.
        return traces, float(np.abs(multipliers(traces, self.map.quarter)).max(initial=1.0))

    def residual(self, arc: Arc) -> np.ndarray:
        """What vanishes at the arc's end (n,), and the displacement of the centre of mass times a frequency."""
        end = super().residual(arc)
        return end if self._kept is None else end + self.flow.omega * (self._kept @ arc.start[self.free])

    def jacobian(self, arc: Arc) -> np.ndarray:
        """Derivative (n, n + 1) of the residual with respect to initial values and period."""
        sensitivity = arc.sensitivity[self.zero, self.free]
        if self._kept is not None:
            sensitivity = sensitivity + self.flow.omega * self._kept
        return np.column_stack([sensitivity, self.map.fraction * self.end_rate(arc)])

    def frame_at(self, chart: str, x: np.ndarray, period: float, tangent: np.ndarray | None = None) -> DenseFrame:
        """The frame at any initial values and period, in the ``chart`` of that name."""
        given = np.empty(0) if tangent is None else tangent
        return DenseFrame(self, CHARTS[chart](self.system, x, period), x, period, given)

    def relative_frame(self, x: np.ndarray, period: float) -> DenseFrame:
        """The unknowns of ``relative_chart``."""
        return DenseFrame(self, self.relative_chart(x, period), x, period, np.empty(0))

    def relative_chart(self, x: np.ndarray, period: float) -> Relative:
        """The chart ``relative``, with the gaps of contacts only where the map starts at rest."""
        return Relative(self.system, x, period, rest=self.map.start == "rest")

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
        # Pairs that stay complex are not even looked for, each search being a dozen integrations; where two half-traces
        # meet within the step, what is found has to be real.
        for level, name in levels.items():
            for i in real_half_traces(left, right):
                test = HalfTraceAbove(i, level)
                yield SpecialKind(name, test, LEAST_CROSSING, accept=test.is_real)
        if left.episodes != right.episodes:
            yield SpecialKind(
                "grazing",
                lambda p: 1.0 if p.episodes == right.episodes else -1.0,
                seek=self.seek_touch,
                finish=without_touch,
            )

    def seek_touch(self, frame: Frame[Point], guess: np.ndarray, left: Point, right: Point) -> np.ndarray:
        """Unknowns of the orbit near ``guess`` at which a contact grazes that only one of two orbits has."""
        assert isinstance(frame, DenseFrame)
        touching = max(left, right, key=lambda p: p.episodes)
        touch = Touch.nearest(self.arc(touching.x, touching.period), self.map)
        return graze(self, frame.chart, guess, touch)

    def with_resonance(self, fold: Point, left: Point, right: Point) -> Point:
        """A fold of the energy with the resonance whose tongue it begins or ends."""
        return replace(fold, resonance=resonance(self, fold))


def without_touch(grazing: Point, left: Point, right: Point) -> Point:
    """A grazing orbit with the episodes of the neighbour that has fewer: what just touches is not counted."""
    return replace(grazing, episodes=min(left.episodes, right.episodes))
