"""Shooting: periodic orbits of a flow as boundary value problems over a part of their period.

``flow`` gives the flow phi_t of an initial state and its derivative S = d phi_t/d y0; the unknowns are initial values x
and the period T. The flow is reversible, t -> -t with v -> -v, so that an orbit that is at rest (v = 0) twice, at 0 and
T/2, is periodic: half a period is enough, with the n unknowns u(0) and the n equations v(T/2; u0, 0) = 0. If f is odd
the orbit u(t + T/2) = -u(t) passes the centre u = 0 at T/4: a quarter is enough,

    H(x, T) = u(T/4; x, 0) = 0,    dH/dx = A,    dH/dT = v(T/4)/4,    S = [[A, B], [C, D]].

The n equations for n + 1 unknowns leave a curve of solutions, the branch. The whole period may be shot as well, for
comparison, but its equations are worse conditioned (``MAPS``).

**Charts** are the unknowns xi (n + 1,) of order one in place of x (n,) and T. A chart belongs to a point of the branch,
with the initial values x_0 and the period T_0. It encodes (x, T) as xi, decodes it, and gives d(x, T)/dxi (n + 1,
n + 1); ``size`` = max |x_0| is the unit of initial values. Initial values are displacements in m where an arc starts at
rest, velocities in m/s where it starts at the centre. The last unknown is T/T_0, the others are

    relative       x_i/size; in the place of a site's resonator w/scale, with w = c . x, where the arc starts at rest
    grazing        x_i/size; in the place of one site's resonator y, where y |y| = (sigma w - D)/D

w is the elongation of a contact, c its row with 1 at the resonator and -1 at the other mass, if there is one, and D its
clearance in m on the side sigma. D is not 0: ``System`` refuses contacts that touch at rest, about which no motion is
linear.

**Why grazing needs a chart.** An orbit that starts at rest on its largest sigma w, beyond D, is in contact for the time
2 [2 (sigma w - D)/|w''|]^1/2. The impulse of a force that grows as (sigma w - D)^n then changes the orbit by the order
(sigma w - D)^(n + 1/2). For the bilinear contact, n = 1, its derivative by w is a square root, whose slope at D is
infinite: tangents turn without bound there. In y the change is of the order y^(2 n + 1), and smooth enough.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from vipetsc.modes.cache import BoundedCache
from vipetsc.modes.flow import MOST_LONGER, UNLIMITED, Arc, Flow, ShootingMap
from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.point import OrbitProblem, Point
from vipetsc.modes.problem import Attempt, ContinuationError, Corner, FlowError, SpecialKind, unit
from vipetsc.modes.shared_frequencies import check_start
from vipetsc.modes.stability import HalfTraceAbove, half_traces, multipliers, real_half_traces
from vipetsc.modes.system import ContactPair, System

# A contact grazes if the largest value of its gap is within this fraction of the clearance of zero. The parabola below
# errs by less.
TOUCH = 1e-5


def grazing_contacts(system: System, u: np.ndarray) -> list[int]:
    """Return the numbers, from 1, of contacts that graze along displacements ``u`` (samples, n) in m at equal times.

    At each local maximum among the samples a parabola through it and its two neighbours gives the largest value.
    """
    # The gap is positive where a contact is closed; its negative, of a contact pressed at rest, where it is open.
    beyond = np.where(system.is_pressed, -1.0, 1.0) * system.gaps(u)
    clearances = np.abs(system.clearances_at(u @ system.contact_rows.T)).min(axis=0)
    numbers = []
    for contact, (values, clearance) in enumerate(zip(beyond.T, clearances, strict=True)):
        # The motion has only been on a side without a stop.
        if not np.isfinite(clearance):
            continue
        # While w is on a side without a stop its gap is -inf, of which no parabola can be formed.
        values = np.maximum(values, -1e3 * clearance)
        peaks = [values[0], values[-1]]
        is_peak = (values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])
        for i in np.flatnonzero(is_peak) + 1:
            before, at, after = values[i - 1 : i + 2]
            bend = before - 2 * at + after
            peaks.append(at - (after - before) ** 2 / (8 * bend) if bend < 0 else at)
        if np.min(np.abs(peaks)) <= TOUCH * clearance:
            numbers.append(contact + 1)
    return numbers


# The chart ``grazing`` is chosen if |w| at the start is within this fraction of the clearance of it.
NEAR_GRAZING = 0.05
# Lower bound of |y| in the derivative of w by y, 2 D |y|, which vanishes at the touch itself. The smallest gap beside 0
# is a rounding error of 1e-16 of D, with a y of 1e-8: the bound acts at the touch alone.
SMALLEST_ROOT = 1e-9


class Chart(ABC):
    """Unknowns for initial values and period at and near one orbit."""

    size: float
    period: float

    @abstractmethod
    def encode(self, x: np.ndarray, period: float) -> np.ndarray:
        """Return the unknowns (n + 1,) of initial values ``x`` (n,) and period."""

    @abstractmethod
    def decode(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Return initial values (n,) and period in s at the unknowns ``xi`` (n + 1,)."""

    @abstractmethod
    def derivative(self, xi: np.ndarray) -> np.ndarray:
        """Return the matrix d(x, period)/d xi (n + 1, n + 1) at the unknowns ``xi`` (n + 1,)."""

    def to_changes(self, xi: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Return changes of (x, period) that ``changes`` (n + 1,) of the unknowns at ``xi`` make."""
        return self.derivative(xi) @ changes

    def to_unknowns(self, xi: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Return changes of the unknowns at ``xi`` that make the ``changes`` (n + 1,) or (n + 1, m) of (x, period)."""
        return np.linalg.solve(self.derivative(xi), changes)


class Relative(Chart):
    """Initial values over the largest one, and elongations of contacts over a scale of their own.

    The scale of w is max(|w_0|, |D|), with the smaller clearance D of the contact, and ``size`` at most. Over ``size``
    itself a large common motion would hide the changes of w that make and break contacts. Without ``rest``, where an
    arc starts at the centre, all initial values are over ``size``: they are velocities, and all w are 0.

    Of contacts that form a closed ring one has no unknown of its own: its w is the sum of the others, so that with it
    the chart could not be inverted.
    """

    def __init__(self, system: System, x: np.ndarray, period: float, rest: bool = True) -> None:
        self.size = float(np.abs(x).max())
        self.period = period
        self.weights = np.eye(len(x)) / self.size
        if rest:
            for number in _without_rings(system.contacts):
                row = system.contact_rows[number]
                pair = system.contacts[number]
                scale = min(max(abs(row @ x), abs(pair.stops.clearance)), self.size)
                self.weights[pair.resonator] = row / scale
        self.inverse = np.linalg.inv(self.weights)
        n = len(x)
        self._derivative = np.zeros((n + 1, n + 1))
        self._derivative[:n, :n] = self.inverse
        self._derivative[n, n] = period

    def encode(self, x: np.ndarray, period: float) -> np.ndarray:
        """Return the unknowns (n + 1,) of initial values ``x`` (n,) and period."""
        return np.append(self.weights @ x, period / self.period)

    def decode(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Return initial values (n,) and period in s at the unknowns ``xi`` (n + 1,)."""
        return self.inverse @ xi[:-1], float(xi[-1] * self.period)

    def derivative(self, xi: np.ndarray) -> np.ndarray:
        """Return d(x, period)/d xi."""
        return self._derivative


class Grazing(Chart):
    """Initial values over the largest one, with y for the contact that is nearest to its clearance.

    Nearest is the contact with the smallest |sigma w/D - 1|, sigma being the side of w. If it has no stop on that side,
    y is the root of the gap to the stop on the other side. ``contact`` is the number of the contact, ``sign`` is sigma,
    and ``index`` the place of y among the unknowns.
    """

    def __init__(self, system: System, x: np.ndarray, period: float) -> None:
        self.size = float(np.abs(x).max())
        self.period = period
        w = system.contact_rows @ x
        nearest = int(np.abs(system.sides_at(w) * w / system.clearances_at(w) - 1).argmin())
        self.contact = nearest
        self.row = system.contact_rows[nearest]
        self.index = system.contacts[nearest].resonator
        self.sign = float(system.sides_at(w)[nearest])
        self.clearance = float(system.clearances_at(w)[nearest])
        if self.clearance == np.inf:
            self.sign = -self.sign
            self.clearance = system.contacts[nearest].stops.clearance

    def encode(self, x: np.ndarray, period: float) -> np.ndarray:
        """Return the unknowns (n + 1,) of initial values ``x`` (n,) and period."""
        xi = np.append(x / self.size, period / self.period)
        gap = self.sign * (self.row @ x) / self.clearance - 1
        xi[self.index] = np.sign(gap) * np.sqrt(np.abs(gap))
        return xi

    def decode(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Return initial values (n,) and period in s at the unknowns ``xi`` (n + 1,)."""
        x = xi[:-1] * self.size
        y = xi[self.index]
        x[self.index] = 0.0
        x[self.index] = self.sign * self.clearance * (1 + y * abs(y)) - self.row @ x
        return x, float(xi[-1] * self.period)

    def derivative(self, xi: np.ndarray) -> np.ndarray:
        """Return d(x, period)/d xi."""
        d = np.diag(np.append(np.full(len(xi) - 1, self.size), self.period))
        d[self.index, :-1] = -self.row * self.size
        d[self.index, self.index] = self.sign * self.clearance * 2 * max(abs(xi[self.index]), SMALLEST_ROOT)
        return d


CHARTS: dict[str, type[Relative | Grazing]] = {"relative": Relative, "grazing": Grazing}


def _without_rings(contacts: Sequence[ContactPair]) -> Iterator[int]:
    """Yield sets of ``contacts`` whose elongations may be unknowns in the places of their resonators.

    Left out are contacts that close a ring, each from a host to a resonator that is the host of the next.
    """
    # If several contacts have one resonator, the elongation of the last one is the unknown in its place.
    host_of: dict[int, int | None] = {}
    for number, pair in enumerate(contacts):
        mass = pair.host
        while mass is not None and mass != pair.resonator:
            mass = host_of.get(mass)
        if mass is None:
            host_of[pair.resonator] = pair.host
            yield number


def near_grazing(system: System, x: np.ndarray) -> bool:
    """Return whether a contact of an orbit that starts at rest at ``x`` (n,) is near its clearance there."""
    w = system.contact_rows @ x
    distance = np.abs(system.sides_at(w) * w / system.clearances_at(w) - 1)
    return bool(distance.min(initial=np.inf) < NEAR_GRAZING)


# A half-trace is (mu + 1/mu)/2 of a pair of multipliers. Along narrow tongues it only touches +-1: if it lies within
# this of the level, on either side, a change of sign is rounding and no special point.
LEAST_CROSSING = 1e-6
# Residuals that rounding leaves are up to this many times eps r^(3/2) (``Shooting.rounding``).
ROUNDING = 8
# If the smallest singular value of the derivative is below this fraction of the largest, there is a second null vector,
# and the tangent is not unique.
DEGENERATE = 1e-12
# Part of the interval of two samples by which an arc to a touch ends before it.
AHEAD = 0.01
# Rows of touches that differ by less than this are those of one contact, of which samples are near each touch.
ALIKE = 0.01
# A motion whose rest is within this fraction of the clearance of a rigid stop is at it. It is the last of its branch.
RESTS = 1e-9
# Samples of an arc in which contacts that graze are looked for: a parabola through three of them has to err by less
# than ``TOUCH``.
SAMPLES = 2000


class ShootingFrame:
    """The shooting equations in the unknowns of a ``chart`` at one orbit.

    The argument ``tangent`` (n + 1,) is d(x, period) along the branch, of any length, or empty where there is none yet.
    The attribute ``tangent`` is the same direction in the chart's unknowns, of unit length; without the argument there
    is none. ``unit`` is that of the residual: the chart's, times ``ShootingMap.end_unit``, since velocities may have to
    vanish at the end of an arc that starts with displacements.
    """

    tangent: np.ndarray

    def __init__(self, problem: "Shooting", chart: Chart, x: np.ndarray, period: float, tangent: np.ndarray) -> None:
        self.problem = problem
        self.chart = chart
        self.unit = chart.size * problem.map.end_unit(period)
        self.xi = chart.encode(x, period)
        if tangent.size:
            self.tangent = unit(chart.to_unknowns(self.xi, tangent))

    def encode(self, point: Point) -> np.ndarray:
        """Return the unknowns (n + 1,) of another orbit."""
        return self.chart.encode(point.x, point.period)

    def direction(self, point: Point) -> np.ndarray:
        """Return the branch's direction (n + 1,) at another orbit, of any length."""
        return self.chart.to_unknowns(self.encode(point), point.tangent)

    def arc(self, xi: np.ndarray) -> Arc:
        """Return the arc from the unknowns ``xi`` (n + 1,); raises FlowError where there is none."""
        if np.all(np.isfinite(xi)):
            x, period = self.chart.decode(xi)
            if period > 0:
                return self.problem.arc(x, period)
        raise FlowError("Newton's method left the domain: the period is not positive")

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """Return the residual (n,) at the arc's end, which vanishes for an orbit, over its unit."""
        return self.problem.residual(self.arc(xi)) / self.unit

    def correct(self, guess: np.ndarray, arclength: float) -> Attempt:
        """Solve for the orbit at an ``arclength`` along the tangent, from ``guess`` (n + 1,)."""
        return self.solve(guess, self.tangent, self.tangent @ self.xi + arclength)

    def solve(self, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        """Solve for the orbit with row . xi = value, from ``guess`` (n + 1,).

        It fails where it comes to an arc of ``MOST_LONGER`` times the steps of that at the guess. Raises StoppedError
        where ``Shooting.stop`` is requested.
        """
        problem = self.problem
        try:
            with problem.flow.limited(UNLIMITED, problem.stop):
                longest = MOST_LONGER * self.arc(guess).steps
        except FlowError as error:
            return Attempt(converged=False, reason=str(error), history=[], xi=guess, left_domain=True)
        with problem.flow.limited(longest, problem.stop):
            rounding = problem.rounding(self.chart.period)
            return problem.newton.solve(self, guess, row, value, problem.tolerance, rounding)

    def jacobian(self, xi: np.ndarray) -> np.ndarray:
        """Return the derivative (n, n + 1) of the residual."""
        return self.jacobian_of(self.arc(xi), xi)

    def jacobian_of(self, arc: Arc, xi: np.ndarray) -> np.ndarray:
        """Return the derivative (n, n + 1) of the residual at the unknowns ``xi`` of an ``arc``."""
        return self.problem.jacobian(arc) @ self.chart.derivative(xi) / self.unit

    def tangent_at(self, xi: np.ndarray) -> np.ndarray:
        """Return the unit tangent (n + 1,) at a solution ``xi`` (n + 1,), on the side of the frame's own."""
        return self.tangent_towards(xi, self.tangent)

    def tangent_towards(self, xi: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Return the unit tangent (n + 1,) at a solution ``xi`` (n + 1,), on the side of ``reference`` (n + 1,)."""
        # The null vector, of either sign.
        direction = np.linalg.svd(self.jacobian(xi))[2][-1]
        if direction @ reference < 0:
            return -direction
        return direction

    def measures(self, attempt: Attempt, direction: np.ndarray | None = None) -> Point:
        """Return the orbit of a converged attempt; ``direction`` (n + 1,) is the branch's unit tangent or None."""
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


class Shooting(OrbitProblem):
    """Periodic orbits of a ``flow``'s system: initial values x (n,) and period, by Newton's method (PETSc SNES).

    The ``shooting_map`` says over which part of the period an arc goes, and whether it starts and ends at rest or at
    the centre; for an orbit half of the state vanishes at its end. x are displacements in m for a map that starts at
    rest, velocities in m/s for one that starts at the centre.

    Newton's method solves the n equations and one more linear row in the unknowns of a chart; it ends at a scaled
    residual of ``tolerance``, after a step below ``STEP_TOLERANCE``, where the residual stagnates within its
    ``rounding``, or after ``max_newton`` steps. Raises ValueError if the map needs an odd system and the system is not.
    """

    guards = frozenset({"half_trace", "turn_relative"})

    def __init__(self, flow: Flow, shooting_map: ShootingMap, tolerance: float = 1e-13, max_newton: int = 7) -> None:
        system = flow.system
        if "centre" in (shooting_map.start, shooting_map.end) and not system.odd:
            raise ValueError(
                f"the {shooting_map.name} map needs forces that change sign with the displacement; "
                "this system's do not: use map = 'half'"
            )
        self.flow = flow
        self.system = system
        self.map = shooting_map
        self.tolerance = tolerance
        self.newton = DenseNewton(system.dofs + 1, max_newton)

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

        # If nothing holds the system, its momentum stays 0 in an arc from rest to rest, whatever the start: one
        # equation is lost. The centre of mass is kept in its place instead. An arc that starts at the centre (u = 0)
        # has it there.
        self._kept = None
        if shooting_map.starts_at_rest and shooting_map.ends_at_rest:
            self._kept = system.mean_motion
        self._arcs: BoundedCache[tuple[bytes, float], Arc] = BoundedCache(1)
        self._frames: BoundedCache[tuple[Point, str], ShootingFrame] = BoundedCache(1)

    def start(self, x: np.ndarray) -> np.ndarray:
        """Return the state (2n,) at the start of the arc from initial values ``x``."""
        state = np.zeros(2 * self.system.dofs)
        state[self.free] = x
        return state

    def arc(self, x: np.ndarray, period: float) -> Arc:
        """Return arc from initial values ``x`` (n,); raises FlowError where the flow fails. The latest one is kept."""
        # Bytes are compared faster than arrays of a few numbers.
        duration = self.map.fraction * period
        return self._arcs.get((x.tobytes(), period), lambda: self.flow.arc(self.start(x), duration, period))

    def rounding(self, period: float) -> float:
        """Return the largest scaled residual that rounding may leave of an orbit of that ``period`` in s.

        Let the fastest mode be r times as fast as the orbit. A step of the flow is a radian of that mode or less, and
        rounds its velocity, which may be r times that of the orbit, to eps r. The mode sums the errors of some r steps
        as a random walk, to eps r^(3/2) of the orbit's velocity.
        """
        ratio = self.flow.omega_ref(period) * period / (2 * np.pi)
        return float(ROUNDING * np.finfo(float).eps * ratio**1.5)

    def stability(self, arc: Arc) -> tuple[np.ndarray, float]:
        """Return half-traces (n - 1,) of an orbit and the largest modulus of its multipliers."""
        traces = half_traces(self.system, self.map, arc)
        # A single mass has the trivial pair alone, whose multiplier is 1.
        return traces, float(np.abs(multipliers(traces, self.map.quarter)).max(initial=1.0))

    def residual(self, arc: Arc) -> np.ndarray:
        """Return what vanishes at the arc's end for an orbit (n,): displacements in m or velocities in m/s.

        In a system that nothing holds, the displacement of the centre of mass times a frequency is added.
        """
        end = arc.end[self.zero]
        if self._kept is None:
            return end
        return end + self.flow.omega * (self._kept @ arc.start[self.free])

    def jacobian(self, arc: Arc) -> np.ndarray:
        """Return the derivative (n, n + 1) of the residual with respect to initial values and period."""
        sensitivity = arc.sensitivity[self.zero, self.free]
        if self._kept is not None:
            sensitivity = sensitivity + self.flow.omega * self._kept
        return np.column_stack([sensitivity, self.map.fraction * self.end_rate(arc)])

    def end_rate(self, arc: Arc) -> np.ndarray:
        """Return time derivative (n,) of what should vanish at the arc's end."""
        n = self.system.dofs
        end = arc.end
        # At rest velocities should vanish, whose rates are accelerations; at the centre displacements.
        if self.map.ends_at_rest:
            return -self.system.forces(end[:n]) / self.system.masses
        return end[n:]

    def energy(self, x: np.ndarray) -> float:
        """Return the energy in J of the orbit with initial values ``x`` (n,)."""
        zero = np.zeros_like(x)
        if self.map.starts_at_rest:
            return self.system.energy(u=x, v=zero)
        return self.system.energy(u=zero, v=x)

    def energy_gradient(self, x: np.ndarray) -> np.ndarray:
        """Return dE/dx (n,) in J over the unit of ``x``."""
        if self.map.starts_at_rest:
            return self.system.forces(x)
        return self.system.masses * x

    def frame(self, point: Point, chart: str = "auto") -> ShootingFrame:
        """Return frame at an orbit; the chart ``auto`` is grazing if the orbit starts near a touch, else relative."""

        def make() -> ShootingFrame:
            name = chart
            if chart == "auto":
                name = "relative"
                if self.map.starts_at_rest and near_grazing(self.system, point.x):
                    name = "grazing"
            return self.frame_at(name, point.x, point.period, point.tangent)

        # A step of a branch and the search for its special points begin at the same orbit.
        return self._frames.get((point, chart), make)

    def frame_at(self, chart: str, x: np.ndarray, period: float, tangent: np.ndarray | None = None) -> ShootingFrame:
        """Return the frame at any initial values ``x`` (n,) and period, in the ``chart`` of that name."""
        if tangent is None:
            tangent = np.empty(0)
        return ShootingFrame(self, CHARTS[chart](self.system, x, period), x, period, tangent)

    def relative_frame(self, x: np.ndarray, period: float) -> ShootingFrame:
        """Return the unknowns of ``relative_chart`` for initial values ``x`` (n,)."""
        return ShootingFrame(self, self.relative_chart(x, period), x, period, np.empty(0))

    def relative_chart(self, x: np.ndarray, period: float) -> Relative:
        """Return the chart ``relative`` near the initial values ``x`` (n,) and the period in s.

        It has the gaps of contacts only where the map starts at rest.
        """
        return Relative(self.system, x, period, rest=self.map.starts_at_rest)

    def null_vector(self, start: Point) -> np.ndarray:
        """Return the tangent d(x, period) at an orbit, of either sign; raises ContinuationError if it is not unique."""
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

    def first_tangent(self, start: Point, direction: int) -> np.ndarray:
        """Return the tangent d(x, period) at a corrected orbit, towards growing (+1) or falling (-1) energy.

        Raises ContinuationError at a branch point, where the tangent is not unique.
        """
        tangent = self.null_vector(start)
        energy_tangent = self.energy_gradient(start.x) @ tangent[:-1]
        # Where the energy is stationary neither sign is towards growing energy: the null vector is taken as it is.
        sign = np.sign(energy_tangent) or 1.0
        return tangent * (sign * direction)

    def turn(self, before: Point, after: Point) -> float:
        """Return the angle in rad between the tangents of two orbits in units of the first; 0 without a tangent."""
        if not (before.tangent.size and after.tangent.size):
            return 0.0
        chart = self.relative_chart(before.x, before.period)
        tangents = np.column_stack([before.tangent, after.tangent])
        first, second = chart.to_unknowns(chart.encode(before.x, before.period), tangents).T
        # The product of two unit vectors may be beyond 1 by rounding.
        return float(np.arccos(np.clip(unit(first) @ unit(second), -1.0, 1.0)))

    def grazing(self, point: Point) -> list[int]:
        """Return numbers, from 1, of contacts that graze in an orbit; raises FlowError if it cannot be integrated."""
        arc = self.arc(point.x, point.period)
        u = self._samples(arc, point.period)
        # Wherever a rigid stop is struck the contact is on it: that is no touch.
        touched = {number + 1 for number, _ in self._touches(arc, u)}
        yields = np.flatnonzero(~self.system.is_rigid) + 1
        return sorted(touched.union(set(grazing_contacts(self.system, u)).intersection(yields.tolist())))

    def _samples(self, arc: Arc, period: float) -> np.ndarray:
        """Return displacements (1 + SAMPLES, n) in m along an ``arc`` at equal times."""
        interval = arc.duration / SAMPLES
        return self.flow.states(arc.start, interval, SAMPLES, period)[:, : self.system.dofs]

    def _touches(self, arc: Arc, u: np.ndarray) -> list[tuple[int, int]]:
        """Return contacts, from 0, whose rigid stops an ``arc`` touches at no speed, each with the sample of ``u``."""
        touches = []
        gaps = self.system.gaps(u)
        for number in np.flatnonzero(self.system.is_rigid).tolist():
            of_contact = gaps[:, number]
            is_touch = of_contact[1:-1] >= np.maximum(of_contact[:-2], of_contact[2:])
            is_touch &= np.abs(of_contact[1:-1]) <= 2 * TOUCH * self.system.contacts[number].stops.clearance
            impacts = arc.events[arc.events[:, 1] == number, 0] * SAMPLES / arc.duration
            for place in np.flatnonzero(is_touch) + 1:
                if np.abs(impacts - place).min(initial=np.inf) > 2:
                    touches.append((number, int(place)))
        return touches

    def turned_at_corner(self, point: Point) -> Corner[Point] | None:
        """Return the corner at an orbit that touches a rigid stop, beyond which the stop is struck; None without one.

        Let the speed there be s. To first order the orbit changes by a jump of the velocity, -2 mu s M^-1 h^T at the
        instant of the touch, while the largest w, without the jump, exceeds D by s^2/(2 |w''|): H' (dx, dT) and what
        the jump makes of H add up to 0, and dw = 0. To second order x changes along the gradients of w: where the first
        order changes w' at the touch by dw', the largest w grows by dw'^2/(2 |w''|) in any case.
        """
        arc = self.arc(point.x, point.period)
        u = self._samples(arc, point.period)
        touches = self._touches(arc, u)
        if not touches:
            return None

        n = self.system.dofs
        jump = np.zeros(n)
        rises = []
        rates = []
        stops = []
        # Several touches at one speed, by a symmetry, count each.
        for number, place in touches:
            row = self.system.contact_rows[number]
            moved = row / self.system.masses
            side = np.sign(u[place] @ row)
            # A little before the touch, so that the arc to it strikes nothing; first by the sample, then by w' there.
            interval = arc.duration / SAMPLES
            ahead = AHEAD * interval
            time = place * interval - ahead
            near = self.flow.arc(arc.start, time, point.period).end
            stop = abs(moved @ self.system.forces(near[:n]))
            time += side * (row @ near[n:]) / stop - ahead
            before = self.flow.arc(arc.start, time, point.period).sensitivity
            rest = np.linalg.solve(before.T, arc.sensitivity[self.zero].T).T
            jump += rest[:, n:] @ (-2 * side * moved / (row @ moved))
            rate = side * row @ before[n:, self.free]
            rises.append(side * row @ before[:n, self.free] + ahead * rate)
            rates.append(rate)
            stops.append(stop)

        # By least squares, since the touches of one contact have equal rows. The shortest bend has all speeds alike.
        matrix = np.vstack([self.jacobian(arc), np.pad(rises, [(0, 0), (0, 1)])])
        tangent = np.linalg.lstsq(matrix, np.append(-jump, np.zeros(len(rises))), rcond=None)[0]
        bends = (1.0 - (np.array(rates) @ tangent[:-1]) ** 2) / (2.0 * np.array(stops))
        bend = np.linalg.lstsq(np.array(rises), bends, rcond=ALIKE)[0]
        return Corner(replace(point, tangent=tangent), np.append(bend, 0.0))

    def rests_on_stop(self, point: Point) -> bool:
        """Return whether an orbit begins at rest on a rigid stop, as far as steps resolve it."""
        if not (self.map.starts_at_rest and self.system.has_rigid_stops):
            return False
        w = self.system.contact_rows @ point.x
        clearances = self.system.clearances_at(w)
        return bool((self.system.is_rigid & (np.abs(w) >= (1 - RESTS) * clearances)).any())

    def has_corner(self, before: Point, after: Point) -> bool:
        """Return whether a rigid stop is first struck, or no longer, between two points."""
        if before.episodes == after.episodes or not self.system.has_rigid_stops:
            return False
        # Contacts that yield make no corner.
        return bool(self.system.is_rigid.all()) or self._impacts(before) != self._impacts(after)

    def _impacts(self, point: Point) -> int:
        """Return the number of impacts on rigid stops in the arc of an orbit."""
        events = self.arc(point.x, point.period).events
        return np.count_nonzero(self.system.is_rigid[events[:, 1].astype(int)])

    def acceleration(self, point: Point) -> float:
        """Return largest acceleration where an orbit rests, over that of a harmonic motion of the same size and period.

        It is 0 at an equilibrium, and infinite for maps from centre to centre. Of two rests the smaller value counts.
        """
        n = self.system.dofs
        rests = []
        if self.map.starts_at_rest:
            rests.append(point.x)
        if self.map.ends_at_rest and self.map.fraction < 1:
            rests.append(self.arc(point.x, point.period).end[:n])
        accelerations = [np.abs(self.system.forces(u) / self.system.masses).max() for u in rests]
        size = max((np.abs(u).max() for u in rests), default=1.0)
        return float(min(accelerations, default=np.inf) / size * (point.period / (2 * np.pi)) ** 2)

    def special_kinds(self, left: Point, right: Point) -> Iterator[SpecialKind[Point]]:
        """Yield folds, what the half-traces tell, and a contact that just touches.

        A half-trace of 1 is a branch point (or a fold) that keeps the map's symmetry; -1 breaks it (quarter period) or
        doubles the period (the others); 0 doubles the period of quarter-period orbits.
        """
        # Tangents and half-traces are others on the two sides of a corner.
        if self.has_corner(left, right):
            yield touch_of(max(left.episodes, right.episodes), corner=True)
            return
        # Where all contacts are as at rest an orbit may lie on a linear branch, whose energy and frequency turn by
        # rounding alone: folds are then sought between two orbits that both have contacts which close or open.
        if not self.system.is_linear_at_rest or (left.episodes and right.episodes):
            yield SpecialKind("fold-energy", lambda p: p.energy_tangent, finish=self._with_resonance)
            yield SpecialKind("fold-frequency", lambda p: float(p.tangent[-1] / p.period))
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

    def _with_resonance(self, fold: Point, left: Point, right: Point) -> Point:
        """Return a fold of the energy with the resonance whose tongue it begins or ends."""
        return replace(fold, resonance=resonance(self, fold))


# An orbit that comes back after a part of its period to within this fraction of its size repeats itself.
SAME = 1e-6
# Numbers of repetitions that are looked for. A motion passed n times repeats itself for each prime factor of n, and one
# that is passed more often without any of these factors is not found.
PRIMES = 2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47


def sample_orbit(problem: Shooting, point: Point, samples: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Return displacements in m and velocities in m/s (samples, n) at uniform times, the end of the period left out.

    Only the arc that was shot is integrated; its mirror images make up the period. ``samples`` is a multiple of 4.
    """
    start = problem.arc(point.x, point.period).start
    count = round(problem.map.fraction * samples)
    u, v = np.hsplit(problem.flow.states(start, point.period / samples, count, point.period), 2)
    return whole_period(u, problem.map, samples, 1), whole_period(v, problem.map, samples, -1)


def whole_period(part: np.ndarray, shooting_map: ShootingMap, samples: int, parity: int) -> np.ndarray:
    """Return values (samples, ...) at uniform times of a period, from those of an arc, its start and its end included.

    ``parity`` is 1 of displacements, which are even about a rest and odd about the centre, and -1 of velocities.
    """
    # A quarter ends at the centre, about which displacements are odd: the part then ends at rest.
    if shooting_map.quarter:
        part = np.concatenate([part, -parity * part[-2::-1]])
    if len(part) < samples:
        sign = 1
        if not (shooting_map.starts_at_rest or shooting_map.ends_at_rest):
            sign = -1
        part = np.concatenate([part, parity * sign * part[-2::-1]])
    return part[:samples]


def resonance(problem: Shooting, point: Point, samples: int = 1024) -> int:
    """Return the number k of the k:1 internal resonance to whose tongue an orbit belongs; 1 without a resonance.

    It is the number of zeros in half a period of the contacts' relative motion, or, without contacts, of displacements:
    the largest over all of them. On the tongue the higher mode oscillates k times in a period of the lower one.
    """
    u, _ = sample_orbit(problem, point, samples)
    rows = problem.system.contact_rows
    w = u
    if len(rows):
        w = u @ rows.T
    # A contact at a node of the motion moves by rounding alone, and passes zero at random.
    amplitude = np.abs(w).max(axis=0)
    positive = w[:, amplitude > SAME * amplitude.max()] > 0
    passes = np.sum(positive != np.roll(positive, 1, axis=0), axis=0)
    return int(passes.max()) // 2


def repetitions(problem: Shooting, point: Point) -> int:
    """Return how often an orbit passes one motion in its period: the smallest such number in ``PRIMES``, else 1.

    Along a branch from a linear mode it is 1, except where a tongue of a k:1 internal resonance crosses the branch of
    another mode: there the orbit is that mode's, passed k times.
    """
    # Displacements are compared with the orbit's size, velocities with the size times a frequency.
    start = problem.arc(point.x, point.period).start
    rate = problem.flow.omega_ref(point.period)
    size = np.abs(start).max()
    if not problem.map.starts_at_rest:
        size = size / rate
    scale = size * np.repeat([1.0, rate], problem.system.dofs)

    for count in PRIMES:
        later = problem.flow.arc(start, point.period / count, point.period).end
        if np.all(np.abs(later - start) <= SAME * scale):
            return count
    return 1


def touch_of(count: int, corner: bool = False) -> SpecialKind[Point]:
    """Return points at which the number of contact episodes becomes ``count``, or falls below it.

    A mere touch is no episode: such a point has one fewer. A rigid stop makes a ``corner`` of the branch there.
    """

    def above(point: Point) -> float:
        return 1.0 if point.episodes >= count else -1.0

    def finish(point: Point, left: Point, right: Point) -> Point:
        # Several stops may be struck from a corner on, by a symmetry; the point itself has the episodes before it.
        return point if corner else replace(point, episodes=count - 1)

    return SpecialKind("grazing", above, finish=finish, corner=corner)


def linear_start(problem: Shooting, mode: int, energy: float) -> Point:
    """Return the periodic orbit of linear mode ``mode`` (0-based) at a small ``energy`` in J, corrected.

    Raises ContinuationError if the mode has no stiffness, if other modes share its frequency, or if Newton's method
    does not converge from the linear mode at that energy.
    """
    omega, shapes = problem.system.linear_modes()
    if not omega[mode] > 0:
        raise ContinuationError(f"mode {mode + 1} is a rigid-body motion; it has no period")
    check_start(problem.system, mode, energy)
    # The energy of a mass-normalised mode q is (q'^2 + omega^2 q^2)/2: from rest all of it is potential, from the
    # centre, where the initial values are velocities, all of it is kinetic.
    amplitude = np.sqrt(2 * energy)
    if problem.map.starts_at_rest:
        amplitude /= omega[mode]
    x = shapes[:, mode] * amplitude
    if problem.system.has_rigid_stops and problem.map.starts_at_rest:
        # The arc begins on the side on which the motion comes to its stops last.
        w = problem.system.contact_rows @ x
        reach, reach_of_opposite = (np.max(np.abs(w) / problem.system.clearances_at(side)) for side in (w, -w))
        if reach_of_opposite < reach:
            x = -x
    frame = problem.frame_at("relative", x, 2 * np.pi / omega[mode], np.empty(0))
    row = np.append(x / np.linalg.norm(x), 0.0)  # keep the amplitude
    attempt = frame.solve(frame.xi, row, row @ frame.xi)
    if not attempt.converged:
        why = f"({attempt.reason}; residuals {attempt.residuals}): lower nnm.start_energy or increase nnm.tolerance"
        raise ContinuationError(f"no periodic orbit near linear mode {mode + 1} at E = {energy:g} J {why}")
    return frame.measures(attempt)
