"""The equations of periodic orbits over a part of their period, whatever flow and derivative they are given.

Newton's method works in the unknowns xi (n + 1,) of a chart (``charts``), in place of initial values x (n,) and the
period. A subclass gives the flow, and the solution of the linear systems: ``Shooting`` by the matrix of the flow's
sensitivities, ``modes.lattice`` without a matrix.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from vipetsc.modes.departures import Departure, within_arc
from vipetsc.modes.newton import BorderedNewton
from vipetsc.modes.point import Point
from vipetsc.modes.problem import Attempt, FlowError, SpecialKind, unit
from vipetsc.modes.shooting.arc_limits import MOST_LONGER, ArcLimits
from vipetsc.modes.shooting.charts import Chart, near_grazing
from vipetsc.modes.shooting.maps import ShootingMap
from vipetsc.modes.system import System


class AnyArc(Protocol):
    """Interface of the arcs of all flows: the quantities of the orbit."""

    @property
    def duration(self) -> float:
        """Length of the arc in s."""

    @property
    def steps(self) -> int:
        """Number of steps that the flow has tried."""

    @property
    def episodes(self) -> int:
        """Number of contact episodes in the arc."""

    @property
    def closed(self) -> float:
        """Time in s with a contact closed."""

    def spans(self) -> Iterable[tuple[float, float]]:
        """Begin and end in s of every contact episode, cut off at the arc's start and end."""


A = TypeVar("A", bound=AnyArc)


class ShootingFrame(Generic[A]):
    """The shooting equations in the unknowns of a ``chart`` at one orbit.

    The argument ``tangent`` (n + 1,) is d(x, period) along the branch, of any length, or empty where there is none yet.
    The attribute ``tangent`` is the same direction in the chart's unknowns, of unit length; without the argument there
    is none. ``unit`` is that of the residual: the chart's, times ``ShootingMap.end_unit``, since velocities may have to
    vanish at the end of an arc that starts with displacements.
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
        """The unknowns (n + 1,) of another orbit."""
        return self.chart.encode(point.x, point.period)

    def direction(self, point: Point) -> np.ndarray:
        """The branch's direction (n + 1,) at another orbit, of any length."""
        return self.chart.to_unknowns(self.encode(point), point.tangent)

    def arc(self, xi: np.ndarray) -> A:
        """The arc from the unknowns ``xi`` (n + 1,); raises FlowError where there is none."""
        if np.all(np.isfinite(xi)):
            x, period = self.chart.decode(xi)
            if period > 0:
                return self.problem.arc(x, period)
        raise FlowError("Newton's method left the domain: the period is not positive")

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """The residual (n,) at the arc's end, which vanishes for an orbit, over its unit."""
        return self.problem.residual(self.arc(xi)) / self.unit

    def correct(self, guess: np.ndarray, arclength: float) -> Attempt:
        """Newton's method from ``guess`` (n + 1,) for the orbit at an ``arclength`` along the tangent."""
        return self.solve(guess, self.tangent, self.tangent @ self.xi + arclength)

    def solve(self, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        """Newton's method from ``guess`` (n + 1,) for the orbit with row . xi = value.

        It fails where it comes to an arc of ``MOST_LONGER`` times the steps of that at the guess. Raises StoppedError
        in a block of ``ArcLimits.stopped_by``.
        """
        problem = self.problem
        try:
            with problem.limits.attempt():
                longest = MOST_LONGER * self.arc(guess).steps
        except FlowError as error:
            return Attempt(converged=False, reason=str(error), history=[], xi=guess, left_domain=True)
        with problem.limits.attempt(longest):
            rounding = problem.rounding(self.chart.period)
            return problem.newton.solve(self, guess, row, value, problem.tolerance, rounding)

    @abstractmethod
    def tangent_at(self, xi: np.ndarray) -> np.ndarray:
        """The unit tangent (n + 1,) at a solution ``xi`` (n + 1,), on the side of the frame's own."""

    def measures(self, attempt: Attempt, direction: np.ndarray | None = None) -> Point:
        """The orbit that an attempt has converged to; ``direction`` (n + 1,) is the branch's unit tangent or None."""
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
            slope = np.inf
            if energy_tangent:
                slope = float(-tangent[-1] / period**2 / energy_tangent)

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
    the centre; for an orbit half of the state vanishes at its end. ``limits`` are those of the flow's arcs. x are
    displacements in m for a map that starts at rest, velocities in m/s for one that starts at the centre. Raises
    ValueError if the map needs an odd system and the system is not.
    """

    guards: frozenset[str]
    limits: ArcLimits
    newton: BorderedNewton[Any]

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
        # The half of the state that is free at the arc's start, and the half that should vanish at its end.
        self.free = velocities
        if shooting_map.starts_at_rest:
            self.free = displacements
        self.zero = displacements
        if shooting_map.ends_at_rest:
            self.zero = velocities
        self._latest: tuple[bytes, float, A] | None = None

    def start(self, x: np.ndarray) -> np.ndarray:
        """The state (2n,) at the start of the arc from initial values ``x``."""
        state = np.zeros(2 * self.system.dofs)
        state[self.free] = x
        return state

    def arc(self, x: np.ndarray, period: float) -> A:
        """The arc from initial values ``x`` (n,); raises FlowError where the flow fails. The latest one is kept."""
        # Bytes are compared faster than arrays of a few numbers.
        values = x.tobytes()
        if self._latest is None or self._latest[:2] != (values, period):
            self._latest = values, period, self._integrate(self.start(x), period)
        return self._latest[2]

    @abstractmethod
    def _integrate(self, start: np.ndarray, period: float) -> A:
        """The arc from a state ``start`` (2n,) over the map's fraction of the ``period``."""

    def rounding(self, period: float) -> float:
        """The largest scaled residual that rounding may leave of an orbit of a ``period`` in s; 0 if it is unknown."""
        return 0.0

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
        # At rest velocities should vanish, whose rates are accelerations; at the centre displacements.
        if self.map.ends_at_rest:
            return -self.system.forces(end[:n]) / self.system.masses
        return end[n:]

    def energy(self, x: np.ndarray) -> float:
        """Energy in J of the orbit with initial values ``x`` (n,)."""
        zero = np.zeros_like(x)
        if self.map.starts_at_rest:
            return self.system.energy(u=x, v=zero)
        return self.system.energy(u=zero, v=x)

    def energy_gradient(self, x: np.ndarray) -> np.ndarray:
        """dE/dx (n,) in J over the unit of ``x``."""
        if self.map.starts_at_rest:
            return self.system.forces(x)
        return self.system.masses * x

    @abstractmethod
    def frame_at(self, chart: str, x: np.ndarray, period: float, tangent: np.ndarray) -> ShootingFrame[A]:
        """The frame at any initial values ``x`` (n,) and period; ``tangent`` (n + 1,) may be empty."""

    def frame(self, point: Point, chart: str = "auto") -> ShootingFrame[A]:
        """The frame at an orbit; the chart ``auto`` is grazing if the orbit starts near a touch, else relative."""
        if chart == "auto":
            chart = "relative"
            if self.map.starts_at_rest and near_grazing(self.system, point.x):
                chart = "grazing"
        return self.frame_at(chart, point.x, point.period, point.tangent)

    def departures(self, point: Point) -> list[Departure]:
        """The times in the arc of an orbit in which contacts are not what they are at rest; all ranks must call it.

        Raises FlowError if the arc cannot be integrated.
        """
        spans = self.arc(point.x, point.period).spans()
        in_periods = [(begin / point.period, end / point.period) for begin, end in spans]
        return within_arc(in_periods, self.map.fraction, self.map.ends_at_rest)

    def grazing(self, point: Point) -> list[int]:
        """No contact: a subclass whose orbits have all masses on one rank may look for those that graze."""
        return []

    def acceleration(self, point: Point) -> float:
        """The largest acceleration where an orbit rests, over that of a harmonic motion of the same size and period.

        It is 0 at an equilibrium, and infinite for maps from centre to centre. Of two rests the smaller value counts.
        All ranks must call it.
        """
        n = self.system.dofs
        rests = []
        if self.map.starts_at_rest:
            rests.append(point.x)
        if self.map.ends_at_rest and self.map.fraction < 1:
            rests.append(self.end(self.arc(point.x, point.period))[:n])
        accelerations = [np.abs(self.system.forces(u) / self.system.masses).max() for u in rests]
        size = max((np.abs(u).max() for u in rests), default=1.0)
        return float(min(accelerations, default=np.inf) / size * (point.period / (2 * np.pi)) ** 2)

    @abstractmethod
    def null_vector(self, start: Point) -> np.ndarray:
        """Tangent d(x, period) at a corrected orbit, of either sign; raises ContinuationError if it is not unique."""

    def first_tangent(self, start: Point, direction: int) -> np.ndarray:
        """Tangent d(x, period) at a corrected orbit, towards growing (+1) or falling (-1) energy.

        Raises ContinuationError at a branch point, where the tangent is not unique.
        """
        tangent = self.null_vector(start)
        energy_tangent = self.energy_gradient(start.x) @ tangent[:-1]
        # Where the energy is stationary neither sign is towards growing energy: the null vector is taken as it is.
        sign = np.sign(energy_tangent) or 1.0
        return tangent * (sign * direction)

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
        """The chart ``relative`` near the initial values ``x`` (n,) and the period in s.

        It has the gaps of contacts only where they are at the start of the map.
        """

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
