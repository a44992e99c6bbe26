"""Arcs of orbits with their derivative by the initial state: DOP853, landing on every contact change.

Flows are those of the conservative system M u'' + K u + f(u) = 0: contacts act by their elastic laws, and dashpots are
left out. The derivative S by the initial state obeys the variational equations

    S' = [[0, I], [-M^-1 (K + f'(u)), 0]] S,

which are integrated together with the orbit. At a contact change h(u) = |w| - D = 0 the slope f' jumps, and S passes it
with the saltation matrix (Leine and Nijmeijer 2004, ch. 7)

    S+ = (I + (g+ - g-) grad h^T / (grad h^T g-)) S-,

g-/+ being y' before and after it. Contact forces are continuous, g+ = g-: the saltation is the identity if the step
ends exactly on the change and each step uses one f'. The set of closed contacts is therefore frozen inside a step, so
that the force is smooth there, each step is searched for its first change, and repeated so that it ends there.

**Steps** are those of Dormand and Prince's pair of order 8(5,3) (Hairer, Norsett and Wanner, Solving Ordinary
Differential Equations I, 2nd ed. 1993, sec. II.5 and II.10, and the authors' code DOP853). Stage s is y + h sum_r
A[s, r] k_r, the new state y + h sum_r B[r] k_r; E5 and E3 give the estimates of orders 5 and 3, which II.10 combines
into err5^2 / sqrt(err5^2 + err3^2 / 100).

**Changes.** A contact changes when its gap rises through zero: sigma w - D while it is open, D - sigma w while it is
closed. A step's quintic Hermite interpolant of the gap is cut into its monotone pieces by ``contact.search``, so that
no pair of changes is missed, however short. Where the largest value of a gap is zero to within the interpolant's error,
the flow decides whether there is a change.

**Limits.** From a good guess Newton's method goes to orbits near it, whose arcs take about as many steps of the flow as
the arc of the guess. Where the derivative is almost singular, as near a second branch, a step of the method may lead to
any period or amplitude, and an arc from there may take longer than any computation: it ends the attempt
(``ArcLimits``).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from vipetsc.compiled import inlined, kernel
from vipetsc.contact.law import ELASTIC, elastic_force_and_slope, elastic_records
from vipetsc.contact.search import first_upcrossing_after_start
from vipetsc.dynamics.spring_law import nonlinear_force, nonlinear_slope, spring_laws
from vipetsc.modes.problem import FlowError
from vipetsc.modes.system import System
from vipetsc.parallel import StoppedError, StopRequest

# Steps of an arc of Newton's method at most, over those of the arc at its guess. In 428 attempts along the out-of-phase
# branches of the paper's model up to 10 kJ, with either law, the largest ratio is 2.8. Of 60 small systems on nonlinear
# springs, of which frequencies are multiples of others, two have attempts with ratios of 240 and 4,800 (and no orbit).
MOST_LONGER = 100
# More steps than any arc has.
UNLIMITED = 2**62


class ArcLimits:
    """Limits of the arcs of one flow, which calls ``check`` as it makes its steps.

    They act within a block of ``attempt`` alone. ``every`` is the number of steps, those of several arcs counted
    together, between two looks at requests to stop.
    """

    def __init__(self, every: int) -> None:
        self._every = every
        self._stop = StopRequest()
        self._is_attempt = False
        self._longest = UNLIMITED
        # Steps of the present arc, and those of all arcs since the last look.
        self._steps = 0
        self._since = 0

    @contextmanager
    def stopped_by(self, stop: StopRequest) -> Iterator[None]:
        """Let attempts within the block raise StoppedError where a ``stop`` is requested."""
        earlier = self._stop
        self._stop = stop
        try:
            yield
        finally:
            self._stop = earlier

    @contextmanager
    def attempt(self, longest: int = UNLIMITED) -> Iterator[None]:
        """A block in which Newton's method takes arcs of at most ``longest`` steps."""
        self._is_attempt = True
        self._longest = longest
        try:
            yield
        finally:
            self._is_attempt = False
            self._longest = UNLIMITED

    def refuse(self, steps: float) -> None:
        """Raise FlowError if an arc may not have so many ``steps``."""
        if steps > self._longest:
            raise FlowError(
                f"an arc of more than {self._longest} steps, {MOST_LONGER} times those of the arc at the guess"
            )

    def check(self, steps: int) -> int:
        """Note that the present arc has made so many ``steps``, 0 where it begins; returns at how many to call again.

        Within an attempt it raises FlowError if these are too many, and StoppedError if a stop is requested.
        """
        self.refuse(steps)
        if steps > 0:
            self.count(steps - self._steps)
        self._steps = steps
        return steps + min(self._every - self._since, self._longest + 1 - steps)

    def count(self, steps: int) -> None:
        """Count so many ``steps`` more; within an attempt it raises StoppedError, at a look, if a stop is requested."""
        self._since += steps
        if self._since < self._every:
            return
        self._since = 0
        if self._is_attempt and self._stop.requested:
            raise StoppedError("stopped on request; continue with --resume")


# Outcomes of a search: no change; a change; an extremum so near zero that only the flow can tell.
NONE, CROSSING, EXTREMUM = range(3)
# Largest number of attempts at one extremum, and of one landing in all. Bisection of a step to rounding takes about 54:
# that to the root before an extremum has room after all attempts at the extremum.
EXTREMUM_ATTEMPTS = 40
MOST_ATTEMPTS = 120
# Coefficients of a polynomial of degree 5 in the position in a step, from 0 to 1, the lowest first.
Coefficients = tuple[float, float, float, float, float, float]
# A slope at the start below this fraction of the curvature is the rounding of an extremum.
ROUNDING = 1e-8


class Change(NamedTuple):
    """The change of a ``contact`` to or from a ``side``, and an attempt to end a step of ``length`` s on it.

    The gap sign w - offset rises through zero between the lengths ``low`` and ``high``; an ``extremum`` is landed on
    where that gap is largest. ``attempts`` counts those at this change. Without a change, ``contact`` is -1.
    """

    contact: int
    side: int
    sign: float
    offset: float
    extremum: bool
    low: float
    high: float
    length: float
    attempts: int


@kernel
def correct(change: Change, motion: np.ndarray, floor: float) -> tuple[Change, int]:
    """The next attempt after one that ended with (w, w', w'') = ``motion``: Newton's method, or bisection.

    The outcome is CROSSING when the length is found to ``floor`` seconds, EXTREMUM when the gap's largest value is
    found so and not above zero, and NONE when another attempt is needed. ``contact.search`` stops at a tolerance on
    w; the sensitivities of an orbit with many contacts need the length to rounding.
    """
    contact, side, sign, offset, extremum, low, high, length, attempts = change
    gap = sign * motion[0] - offset
    value = gap
    rate = sign * motion[1]
    if extremum:  # where the slope turns negative
        value = -sign * motion[1]
        rate = -sign * motion[2]
    if value > 0.0:
        high = min(high, length)
    else:
        low = max(low, length)
    attempts += 1

    # Without a rise there is no Newton step: one beyond the bracket stands for it, and leads to its bisection.
    newton = high
    if rate > 0.0:
        newton = -value / rate
    # A root's bracket shrinks to its floor. Rounding of w' may keep Newton's method from an extremum for ever.
    goes_on = high - low > floor
    if extremum:
        goes_on = attempts < EXTREMUM_ATTEMPTS
    if goes_on and abs(newton) > floor:
        target = length + newton
        if not low < target < high:
            target = 0.5 * (low + high)
        return Change(contact, side, sign, offset, extremum, low, high, target, attempts), NONE

    if not extremum:
        return change, CROSSING
    if gap <= 0.0:
        return change, EXTREMUM
    # The flow is beyond zero where the interpolant could not tell: the root lies before, and is sought as such.
    return Change(contact, side, sign, offset, False, 0.0, length, 0.5 * length, 0), NONE


@kernel
def hermite(a: np.ndarray, b: np.ndarray, h: float, sign: float, offset: float) -> Coefficients:
    """Coefficients of sign * w - offset on [0, 1] from (w, w', w'') at both ends of a step h."""
    g0 = sign * a[0] - offset
    r0 = sign * a[1] * h
    s0 = sign * a[2] * h * h
    g1 = sign * b[0] - offset
    r1 = sign * b[1] * h
    s1 = sign * b[2] * h * h
    d = g1 - g0 - r0 - 0.5 * s0
    e = r1 - r0 - s0
    f = s1 - s0
    return g0, r0, 0.5 * s0, 10.0 * d - 4.0 * e + 0.5 * f, -15.0 * d + 7.0 * e - f, 6.0 * d - 3.0 * e + 0.5 * f


@kernel
def _value(c: Coefficients, x: float) -> float:
    return c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * (c[4] + x * c[5]))))


@kernel
def _slope(c: Coefficients, x: float) -> float:
    """Slope at x; just after 0, for a step that starts on an extremum."""
    if x == 0.0 and abs(c[1]) <= ROUNDING * abs(c[2]):
        return c[2]
    return c[1] + x * (2.0 * c[2] + x * (3.0 * c[3] + x * (4.0 * c[4] + x * 5.0 * c[5])))


@kernel
def _bisect(c: Coefficients, low: float, high: float, sign: float) -> float:
    """Root between low and high, where the polynomial turns positive; given a ``sign``, where its slope loses it."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        if sign == 0.0:
            is_beyond = _value(c, middle) > 0.0
        else:
            is_beyond = sign * _slope(c, middle) <= 0.0
        if is_beyond:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)


@kernel
def _extremum(c: Coefficients, position: float, sign: float) -> float:
    """Return the extremum near ``position``, in its quarter: a maximum for the ``sign`` 1, a minimum for -1."""
    low = 0.25 * min(np.floor(4.0 * position), 3.0)
    # Two extrema in one quarter leave no change of sign to bisect, or that of the other one.
    if sign * _slope(c, low) <= 0.0 or sign * _slope(c, low + 0.25) >= 0.0:
        return position
    return _bisect(c, low, low + 0.25, sign)


@kernel
def _next_turn(slope: np.ndarray, low: float, sign: float) -> float:
    """Position at which ``sign`` times the slope (5,) on [low, 1] turns positive, or 2; cuts the slope there."""
    turn = first_upcrossing_after_start(sign * slope, 0.0)
    if turn > 1.0:
        return turn
    if turn > 0.0:
        # De Casteljau's scheme leaves the coefficients on the part after the turn, which begins with 0.
        for k in range(1, slope.size):
            for i in range(slope.size - k):
                slope[i] = (1.0 - turn) * slope[i] + turn * slope[i + 1]
        slope[0] = 0.0
    return low + turn * (1.0 - low)


@kernel
def first_rise(c: Coefficients) -> tuple[float, int]:
    """Position in the step at which a gap that starts at or below zero first rises through it, and the outcome."""
    # Above the interpolant's error, which is that of the next power of the position.
    margin = 0.01 * (abs(c[5]) + 0.3 * abs(c[4]))
    # Bernstein coefficients bound the gap: nearly every call ends here.
    b1 = c[0] + c[1] / 5.0
    b2 = c[0] + (4.0 * c[1] + c[2]) / 10.0
    b3 = c[0] + (6.0 * c[1] + 3.0 * c[2] + c[3]) / 10.0
    b4 = c[0] + (4.0 * c[1] + 3.0 * c[2] + 2.0 * c[3] + c[4]) / 5.0
    b5 = _value(c, 1.0)
    if max(b1, b2, b3, b4, b5) <= -margin:
        return 1.0, NONE

    start = b1 - c[0]
    if abs(c[1]) <= ROUNDING * abs(c[2]):
        start = 0.0
    slope = np.array([start, b2 - b1, b3 - b2, b4 - b3, b5 - b4])
    high = 0.0
    # The pieces on which the gap rises, each from ``left`` to ``top``: a quartic slope has at most two pairs of zeros.
    for _ in range(3):
        low = _next_turn(slope, high, 1.0)
        if low > 1.0:
            break
        high = _next_turn(slope, low, -1.0)
        left = 0.0
        if low > 0.0:
            left = _extremum(c, low, -1.0)
        top = 1.0
        if high <= 1.0:
            top = _extremum(c, high, 1.0)

        # The root is in the first quarter of the step that ends above zero.
        for part in range(1, 5):
            end = 0.25 * part
            if end <= left:
                continue
            root = 2.0
            if _value(c, end) > 0.0:
                root = _bisect(c, left, end, 0.0)
            if root <= top:
                return root, CROSSING
            if end >= top:
                break
            left = end
        if high > 1.0:
            break

        # Not above zero at the ends of quarters: between them the largest value decides, unless it is within the error.
        peak = _value(c, top)
        if peak > margin:
            return _bisect(c, left, top, 0.0), CROSSING
        if peak > -margin:
            return top, EXTREMUM
    return 1.0, NONE


CONTACT = np.dtype([("plus", np.float64), ("minus", np.float64), ("elastic", ELASTIC)])
"""A contact: its clearances in m on the sides + and -, inf where there is no stop; its elastic law.

The clearance of a contact that is pressed at rest is negative, and it has no stop on the other side.
"""
Shape = tuple[int, int, int]
"""Where ``restore`` puts forces, and how many: the first of their rows, the displacements n, the columns 1 + m."""
# Kinds of changes in an arc's list of events.
ONSET = 1
SEPARATION = -1
# A step below this fraction of the arc's duration means that the flow is stuck: for a flow's ``_advance``.
SMALLEST_STEP = 1e-15
# Steps between two looks at requests to stop, times the entries of a state with its variations: a fraction of a second.
ENTRIES_BETWEEN_LOOKS = 5_000_000


class CompiledSystem(NamedTuple):
    """A ``System`` for kernels: ``rows`` (contacts, n) with w = rows u, ``spring_rows`` (springs, n) likewise.

    ``load`` (n,) in N are static forces on the masses, which balance contacts that are pressed at rest.
    """

    inverse_mass: np.ndarray
    stiffness: np.ndarray
    rows: np.ndarray
    contacts: np.ndarray
    spring_rows: np.ndarray
    springs: np.ndarray
    load: np.ndarray


class FlowStep(NamedTuple):
    """Result of a step of a system, for the search of contact changes.

    ``side`` (contacts,) of closed contacts, 1 or -1, 0 for open ones; ``start`` and ``end`` (contacts, 3) hold
    w, w' and w'' at both ends.
    """

    system: CompiledSystem
    side: np.ndarray
    start: np.ndarray
    end: np.ndarray


@inlined
def clearance_on(contact: Any, side: int) -> float:
    """Clearance in m of a ``CONTACT`` on one side, 1 or -1."""
    return contact.plus if side > 0 else contact.minus


@inlined
def elongation(rows: np.ndarray, c: int, y: np.ndarray, first: int, j: int, n: int) -> float:
    """Row ``c`` of ``rows`` (rows, n) times n entries of column ``j`` of ``y``, from ``first`` on."""
    z = 0.0
    for k in range(n):
        z += rows[c, k] * y[first + k, j]
    return z


@inlined
def _add(rows: np.ndarray, c: int, law: tuple[float, float], y: np.ndarray, pull: np.ndarray, shape: Shape) -> None:
    """Add the pull of a spring with the elongations z = ``rows[c]`` u by its ``law``, force f and slope f' there.

    The force on the orbit is -rows^T f, and that on a variation du is its derivative, -rows^T f' rows du.
    """
    force, slope = law
    first, n, columns = shape
    for i in range(n):
        pull[first + i, 0] -= rows[c, i] * force
    for j in range(1, columns):
        along = slope * elongation(rows, c, y, 0, j, n)
        for i in range(n):
            pull[first + i, j] -= rows[c, i] * along


@inlined
def restore(system: CompiledSystem, side: np.ndarray, y: np.ndarray, pull: np.ndarray, shape: Shape) -> None:
    """Forces in N that pull back the orbit, column 0 of ``y`` (n or more, 1 + m), and its variations.

    ``shape`` has the first row of ``pull`` that is filled, n and 1 + m; a caller may give constants, so that the
    compiler knows the lengths of all loops. ``rates`` has the rows of the velocities' rates filled, and then divides
    them by the masses.
    """
    first, n, columns = shape
    # The static load, which acts on the orbit alone, and the springs: -K times each column.
    for i in range(n):
        for j in range(columns):
            pull[first + i, j] = 0.0
        pull[first + i, 0] = system.load[i]
        for k in range(n):
            s = system.stiffness[i, k]
            if s != 0.0:
                for j in range(columns):
                    pull[first + i, j] -= s * y[k, j]

    for c in range(side.size):
        if side[c] != 0:
            contact = system.contacts[c]
            x = side[c] * elongation(system.rows, c, y, 0, 0, n) - clearance_on(contact, side[c])
            # Not cut off at x = 0, but continued as an odd function: within a step the force is smooth, and steps end
            # where the masses part.
            force, slope = elastic_force_and_slope(contact.elastic, x)
            _add(system.rows, c, (side[c] * force, slope), y, pull, shape)

    for s in range(system.springs.size):
        z = elongation(system.spring_rows, s, y, 0, 0, n)
        law = nonlinear_force(system.springs[s], z), nonlinear_slope(system.springs[s], z)
        _add(system.spring_rows, s, law, y, pull, shape)


@kernel
def rates(system: CompiledSystem, side: np.ndarray, y: np.ndarray, dy: np.ndarray) -> None:
    """Time derivative ``dy`` of the orbit, column 0, and variations of ``y`` (2n, 1 + m): displacements, velocities."""
    n = system.inverse_mass.size
    columns = y.shape[1]
    if n == 2 and columns == 6:  # the reduced model in padded arrays: numbers that the compiler knows
        restore(system, side, y, dy, (2, 2, 6))
    else:
        restore(system, side, y, dy, (n, n, columns))
    for i in range(n):
        for j in range(columns):
            dy[i, j] = y[n + i, j]
            dy[n + i, j] *= system.inverse_mass[i]


@kernel
def observe(step: FlowStep, y: np.ndarray, dy: np.ndarray, motion: np.ndarray) -> None:
    """Rates ``dy`` of the state ``y``, and w, w' and w'' of every contact into ``motion`` (contacts, 3)."""
    rates(step.system, step.side, y, dy)
    n = step.system.inverse_mass.size
    rows = step.system.rows
    for c in range(motion.shape[0]):
        motion[c, 0] = elongation(rows, c, y, 0, 0, n)
        motion[c, 1] = elongation(rows, c, y, n, 0, n)
        motion[c, 2] = elongation(rows, c, dy, n, 0, n)


@kernel
def close(system: CompiledSystem, y: np.ndarray, side: np.ndarray) -> None:
    """Put the sides, 1 or -1, on which the contacts are closed into ``side`` (contact,), 0 for open ones.

    Column 0 of ``y`` (2n, 1 + m) is the state, displacements in m before velocities.
    """
    for c in range(side.size):
        w = elongation(system.rows, c, y, 0, 0, system.inverse_mass.size)
        side[c] = 0
        if w > system.contacts[c].plus:
            side[c] = 1
        elif -w > system.contacts[c].minus:
            side[c] = -1


@kernel
def begin(system: CompiledSystem, y: np.ndarray) -> FlowStep:
    """The record of a flow's steps, which begins at the state in column 0 of ``y`` (2n, 1 + m)."""
    contacts = system.contacts.size
    side = np.empty(contacts, np.int64)
    step = FlowStep(system, side, np.empty((contacts, 3)), np.empty((contacts, 3)))
    close(system, y, step.side)
    return step


@kernel
def first_change(step: FlowStep, h: float) -> Change:
    """The first change of a contact in a step of length ``h``, with the first attempt at it."""
    # A rise at the very end, position 1, is found at the start of the next step.
    first = 1.0
    change = Change(contact=-1, side=0, sign=0.0, offset=0.0, extremum=False, low=0.0, high=h, length=h, attempts=0)
    for c in range(step.side.size):
        for s in (-1, 1):
            clearance = clearance_on(step.system.contacts[c], s)
            if clearance == np.inf or (step.side[c] != 0 and step.side[c] != s):
                continue
            # An open contact's gap s w - D rises at an onset, a closed one's D - s w at its separation.
            sign = float(s)
            offset = clearance
            if step.side[c] != 0:
                sign = -sign
                offset = -offset
            position, outcome = first_rise(hermite(step.start[c], step.end[c], h, sign, offset))
            if outcome != NONE and position < first:
                first = position
                change = Change(
                    contact=c,
                    side=s,
                    sign=sign,
                    offset=offset,
                    extremum=outcome == EXTREMUM,
                    low=0.0,
                    high=h,
                    length=position * h,
                    attempts=0,
                )
    return change


@kernel
def switch(step: FlowStep, change: Change) -> int:
    """Close or open the contact of a ``change``; returns ``ONSET`` or ``SEPARATION``."""
    if step.side[change.contact] == 0:
        step.side[change.contact] = change.side
        return ONSET
    step.side[change.contact] = 0
    return SEPARATION


@dataclass(frozen=True)
class ShootingMap:
    """Sections at which an arc starts and ends, and the fraction of the period that it takes.

    ``rest`` is v = 0, ``centre`` is u = 0. An odd system's symmetric orbit goes from rest to the centre in a
    quarter period; any reversible one from rest to rest in a half.
    """

    name: str
    start: str
    end: str
    fraction: float

    @property
    def starts_at_rest(self) -> bool:
        """Whether an arc starts with v = 0, else with u = 0: its initial values are displacements, else velocities."""
        return self.start == "rest"

    @property
    def ends_at_rest(self) -> bool:
        """Whether an arc ends with v = 0, else with u = 0."""
        return self.end == "rest"

    @property
    def quarter(self) -> bool:
        """Whether an arc goes from one section to the other; the orbit is then odd about the arc's end."""
        return self.start != self.end

    def end_unit(self, period: float) -> float:
        """Unit of what vanishes at the end over that of the initial values, for an orbit of that ``period`` in s.

        From rest to rest, velocities over displacements, it is the frequency in rad/s, rounded to a power of two, by
        which numbers are multiplied without rounding.
        """
        if self.quarter:
            return 1.0
        frequency = float(2.0 ** np.round(np.log2(2 * np.pi / period)))
        if not self.starts_at_rest:
            return 1 / frequency
        return frequency


# The whole period is for comparison, by the case key ``nnm.map``. The derivative of its equations has a condition
# number 4 to 55 times that of the quarter (median), 4e5 times at most, on the paper's branches up to 100 J.
MAPS = {
    "quarter": ShootingMap("quarter", "rest", "centre", 0.25),
    "half": ShootingMap("half", "rest", "rest", 0.5),
    "whole": ShootingMap("whole", "rest", "rest", 1.0),
    "half-centre": ShootingMap("half-centre", "centre", "centre", 0.5),
}


class Advance(NamedTuple):
    """What a flow's ``_advance`` gives: the ``state`` (2n, 1 + 2n) at the end, of the orbit and its variations.

    ``events`` and ``closed`` are those of ``Arc``; ``steps`` is the number of steps that were tried.
    """

    state: np.ndarray
    events: np.ndarray
    closed: float
    steps: int


@dataclass(frozen=True, eq=False)
class Arc:
    """A piece of an orbit of ``duration`` seconds, for which the flow has tried so many ``steps``.

    ``start`` and ``end`` (2n,) hold displacements in m, then velocities in m/s; ``sensitivity`` (2n, 2n) is
    d end/d start; ``events`` (changes, 4) lists time in s, contact, side (1 or -1), kind (``ONSET``, ``SEPARATION``);
    ``episodes`` counts how often contacts close, or open if they are pressed at rest, within the arc: one that goes on
    at the start counts as one that begins there. ``closed`` are the seconds with one or more contacts closed.
    ``away_at_start`` (contacts,) says of each contact whether an episode goes on at the start.
    """

    duration: float
    start: np.ndarray
    end: np.ndarray
    sensitivity: np.ndarray
    events: np.ndarray
    episodes: int
    closed: float
    away_at_start: np.ndarray
    steps: int

    def spans(self) -> Iterator[tuple[float, float]]:
        """Begin and end in s of every episode; those that go on at the start begin at 0, the last may end with the arc.

        Changes of a contact alternate between away from what it is at rest and back to that: one that is pressed at
        rest has a single stop, on which alone it closes.
        """
        for contact, is_away in enumerate(self.away_at_start):
            times = self.events[self.events[:, 1] == contact, 0].tolist()
            if is_away:
                times = [0.0, *times]
            if len(times) % 2:
                times.append(self.duration)
            yield from zip(times[::2], times[1::2], strict=True)


class Flow(ABC):
    """Arcs of the orbits of a ``system``; a subclass gives its ``name`` in case files and ``_advance``."""

    name: ClassVar[str]

    def __init__(self, system: System) -> None:
        self.system = system
        contacts = np.zeros(len(system.contacts), CONTACT)
        contacts["plus"], contacts["minus"] = system.clearances.T
        contacts["elastic"] = elastic_records([pair.law for pair in system.contacts])
        self.compiled = CompiledSystem(
            inverse_mass=1 / np.asarray(system.masses, float),
            stiffness=np.ascontiguousarray(system.stiffness, float),
            rows=system.contact_rows,
            contacts=contacts,
            spring_rows=system.spring_rows,
            springs=spring_laws([spring.law for spring in system.springs]),
            load=np.array([pair.stops.load for pair in system.contacts]) @ system.contact_rows,
        )
        self.omega = float(system.linear_modes()[0][-1])
        n = system.dofs
        self.limits = ArcLimits(every=max(ENTRIES_BETWEEN_LOOKS // (2 * n * (1 + 2 * n)), 1))
        self._variations = np.eye(2 * n, 1 + 2 * n, k=1)  # at the start of an arc, behind the column of the orbit
        self._away = np.where(system.is_pressed, SEPARATION, ONSET)

    def omega_ref(self, period: float) -> float:
        """Frequency in rad/s that makes velocities displacements: the larger of the fastest mode's and the orbit's."""
        return max(self.omega, 2 * np.pi / period)

    def arc(self, start: np.ndarray, duration: float, period: float) -> Arc:
        """The orbit from ``start`` (2n,) over ``duration`` seconds; ``period`` helps to choose steps.

        Raises FlowError if the time cannot be covered.
        """
        y = self._variations.copy()
        y[:, 0] = start
        advance = self._advance(y, duration, period)
        events = advance.events

        # Contacts that are not at the start as they are at rest, and changes away from what they are at rest. A w is a
        # difference of two displacements, so that this product has the bits of ``close``, by which the flow began.
        plus, minus = self.system.clearances.T
        w = self.system.contact_rows @ start[: self.system.dofs]
        is_closed = (w > plus) | (-w > minus)
        is_away = is_closed != self.system.is_pressed
        away = self._away[events[:, 1].astype(int)]
        episodes = np.count_nonzero(is_away) + np.count_nonzero(events[:, 3] == away)
        return Arc(
            duration=duration,
            start=start,
            end=advance.state[:, 0].copy(),
            sensitivity=advance.state[:, 1:].copy(),
            events=events,
            episodes=episodes,
            closed=advance.closed,
            away_at_start=is_away,
            steps=advance.steps,
        )

    def states(self, start: np.ndarray, interval: float, count: int, period: float) -> np.ndarray:
        """The states (1 + count, 2n) of the orbit from ``start`` (2n,) on, every ``interval`` seconds.

        ``period`` helps to choose steps. Raises FlowError if the time cannot be covered.
        """
        states = [np.asarray(start, float)]
        for _ in range(count):
            states.append(self.arc(states[-1], interval, period).end)
        return np.array(states)

    @abstractmethod
    def _advance(self, y: np.ndarray, duration: float, period: float) -> Advance:
        """Advance state and variations ``y`` (2n, 1 + 2n) by ``duration`` seconds, within ``limits``; ``y`` is lost."""


# Errors allowed per step, relative to the size of the orbit and of each variation.
RTOL = 1e-13
RTOL_SENSITIVITY = 1e-11
STAGES = 12
_TABLEAU = np.loadtxt(Path(__file__).with_name("dop853.csv"), delimiter=",")
A = _TABLEAU[:STAGES]
B, E3, E5 = _TABLEAU[STAGES:]
# The new step is this fraction of the one that would have the error allowed, and within these factors of the last. The
# fraction and the largest factor are those of the authors' code, whose smallest factor is 1/3.
SAFETY = 0.9
LEAST_FACTOR = 0.2
MOST_FACTOR = 6.0
# Lower bound of the error in the formula of the new step, which divides by it; the largest factor is met long before.
SMALLEST_ERROR = 1e-12


class Stepper(NamedTuple):
    """Arrays of a step: rates at its ``stages`` (STAGES, rows, 1 + m), states at its ``start`` and ``end``.

    Velocities count as displacements over a radian of ``omega_ref`` (rad/s), and a step is at most one radian. Rows or
    columns are padded with zeros. Sums over stages are done on ``flat``: stages, errors, start and end
    with one dimension in place of two. ``errors`` (2, rows, 1 + m): of orders 3 and 5, over h.
    """

    step: FlowStep
    omega_ref: float
    stages: np.ndarray
    errors: np.ndarray
    start: np.ndarray
    end: np.ndarray
    end_rates: np.ndarray
    flat: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@kernel
def _combine(stepper: Stepper, weights: np.ndarray, h: float) -> None:
    """Put the start plus ``h`` times the weighted sum of the rates of all stages into the end.

    ``weights`` (STAGES,) are 0 for stages that are not known yet: a loop over all of them has a length that the
    compiler knows.
    """
    k, _, y, end = stepper.flat
    for e in range(end.size):
        total = 0.0
        for r in range(STAGES):
            total += weights[r] * k[r, e]
        end[e] = y[e] + h * total


@kernel
def _scaled_error(stepper: Stepper, h: float) -> float:
    """The largest error of a column over what is allowed; infinite if the step overflowed."""
    y = stepper.start
    end = stepper.end
    errors = stepper.errors

    # 0 times a number that is not finite is NaN, which makes the sum differ from zero. A test of each number would cost
    # a branch in the loop.
    zero = 0.0
    for value in stepper.flat[3]:
        zero += 0.0 * value
    if zero != 0.0:
        return np.inf

    k, estimates, _, _ = stepper.flat
    for e in range(estimates.shape[1]):
        e3 = 0.0
        e5 = 0.0
        for r in range(STAGES):
            e3 += E3[r] * k[r, e]
            e5 += E5[r] * k[r, e]
        estimates[0, e] = e3
        estimates[1, e] = e5

    # The orbit and each variation are judged by themselves: a variation may be many times as large as another one.
    n = stepper.step.system.inverse_mass.size
    error = 0.0
    for j in range(y.shape[1]):
        fifth = 0.0
        third = 0.0
        scale = 0.0
        for i in range(2 * n):
            unit = 1.0
            if i >= n:
                unit = 1.0 / stepper.omega_ref
            fifth = max(fifth, abs(errors[1, i, j]) * unit)
            third = max(third, abs(errors[0, i, j]) * unit)
            scale = max(scale, abs(end[i, j]) * unit, abs(y[i, j]) * unit)
        if fifth > 0.0:
            allowed = RTOL_SENSITIVITY * scale
            if j == 0:
                allowed = RTOL * scale
            error = max(error, h * fifth * fifth / np.sqrt(fifth * fifth + 0.01 * third * third) / allowed)
    return error


@kernel
def advance(stepper: Stepper, h: float) -> None:
    """One step of length ``h`` from the start, whose rates are the first stage."""
    step = stepper.step
    for s in range(1, STAGES):
        _combine(stepper, A[s], h)
        rates(step.system, step.side, stepper.end, stepper.stages[s])
    _combine(stepper, B, h)


@kernel
def tried(stepper: Stepper, h: float) -> float:
    """Make a step of length ``h``, and return its scaled error."""
    advance(stepper, h)
    return _scaled_error(stepper, h)


@kernel
def shortened(h: float, error: float) -> float:
    """The length to try after a step of length ``h`` whose scaled ``error`` is not below 1."""
    # A number that has overflowed says nothing of the next length.
    if not error < 1e300:
        return h * 0.1
    return h * max(LEAST_FACTOR, SAFETY * error ** (-0.125))


@kernel
def grown(h: float, error: float, largest: float) -> float:
    """The length of the next step, at most ``largest``, after one of length ``h`` whose scaled ``error`` is below 1."""
    return min(largest, h * min(MOST_FACTOR, SAFETY * max(error, SMALLEST_ERROR) ** (-0.125)))


# Outcomes of a flow: the time is covered; a step is too small; there are more changes than can be listed; the steps
# that were allowed are done, and the flow can go on.
DONE, STUCK, FULL, PAUSED = range(4)
# Contact changes of one arc beyond which a flow gives up: thirty times as many as the in-phase branch of the paper's
# model (bilinear) has in a quarter period up to 5 J, 67.
MOST_CHANGES = 2000
# A step shorter than this fraction of the arc's time is taken as it was tried if its search for a contact change finds
# one at the step's very beginning: a contact at rest at its clearance hardly moves in it, and rounding decides.
SHORT = 1e-6
COUNTS = [(name, np.int64) for name in ("interval", "has_begun", "steps", "pause", "changes")]
PROGRESS = np.dtype([*COUNTS, ("time", float), ("length", float), ("closed", float)])
"""How far a flow has come: the number of its present interval, and 1 if that has begun; the steps tried so far, and how
many are allowed; in that interval the changes, the time in s, the next step's in s, the seconds with a contact closed.
"""


@kernel
def _take_orbit(orbit: Stepper, stepper: Stepper) -> None:
    """Let the ``orbit`` begin where the ``stepper`` begins, without the variations."""
    # Rates that an earlier attempt has left infinite or NaN would stay in the sums, even with the weight 0.
    orbit.stages[1:] = 0.0
    for i in range(2 * stepper.step.system.inverse_mass.size):
        orbit.start[i, 0] = stepper.start[i, 0]
        orbit.stages[0, i, 0] = stepper.stages[0, i, 0]


@kernel
def _land(stepper: Stepper, orbit: Stepper, t: float, h: float, change: Change) -> tuple[float, bool]:
    """Repeat the step of length ``h`` at time ``t`` so that it ends on a ``change``.

    Returns the new length, and whether there is a change at its end; otherwise the gap has a largest
    value there, not above zero. The ``orbit``, a stepper without variations, makes the attempts. The ``stepper`` makes
    one step, of the length that is found, with the variations.
    """
    step = orbit.step
    _take_orbit(orbit, stepper)
    for _ in range(MOST_ATTEMPTS):
        # Each attempt is a whole step from the start: its end has the order of the pair, an interpolant has not.
        length = change.length
        advance(orbit, length)
        observe(step, orbit.end, orbit.end_rates, step.end)
        # A root is sought to the rounding of the arc's time; an extremum, near which the gap is flat, to that of h.
        floor = 1e-16 * (t + h)
        if change.extremum:
            floor = 1e-15 * h
        change, outcome = correct(change, step.end[change.contact], floor)
        if outcome != NONE:
            break
    advance(stepper, length)
    return length, outcome != EXTREMUM


@kernel
def _end_on_change(stepper: Stepper, orbit: Stepper, t: float, h: float, duration: float) -> tuple[float, Change, int]:
    """Let a step of length ``h`` at time ``t``, which is made, end on its first change.

    Returns the new length, the change, and how the step ends: without a change (NONE), on the change (CROSSING), or
    where a gap is largest and not above zero (EXTREMUM).
    """
    step = stepper.step
    observe(step, stepper.end, stepper.end_rates, step.end)
    change = first_change(step, h)
    if change.contact < 0:
        return h, change, NONE

    length, changed = _land(stepper, orbit, t, h, change)
    if changed:
        return length, change, CROSSING
    # The landing has shortened the step to nothing: rounding took the step's beginning for an extremum.
    if t + length == t and h <= SHORT * duration:
        advance(stepper, h)
        observe(step, stepper.end, stepper.end_rates, step.end)
        return h, change, NONE
    return length, change, EXTREMUM


@kernel
def _begin_at_end(stepper: Stepper, smooth: bool) -> None:
    """Begin the next step at the end of the last one; after a ``smooth`` one, without a change, its rates are known."""
    _, _, start, end = stepper.flat
    for e in range(end.size):
        start[e] = end[e]
    if not smooth:
        return

    # The same contacts are closed: rates and motions are those of the end.
    rows, columns = stepper.end_rates.shape
    for i in range(rows):
        for j in range(columns):
            stepper.stages[0, i, j] = stepper.end_rates[i, j]
    step = stepper.step
    for c in range(step.side.size):
        for k in range(3):
            step.start[c, k] = step.end[c, k]


@kernel
def _fill_event(event: np.ndarray, t: float, change: Change, kind: int) -> None:
    """Fill a row of the events: time, contact, side and kind (1 onset, -1 separation)."""
    event[0] = t
    event[1] = change.contact
    event[2] = change.side
    event[3] = kind


@kernel
def _begin(stepper: Stepper, length: float, progress: Any) -> None:
    """Begin a flow at the ``start`` of a stepper, with a first step of ``length`` s."""
    progress.has_begun = 1
    progress.changes = 0
    progress.time = 0.0
    progress.length = length
    progress.closed = 0.0

    step = stepper.step
    close(step.system, stepper.start, step.side)
    observe(step, stepper.start, stepper.stages[0], step.start)


@kernel
def _flow(stepper: Stepper, orbit: Stepper, duration: float, events: np.ndarray, progress: Any) -> int:
    """Advance the ``start`` in place over ``duration`` seconds; the ``orbit`` is a stepper for its first column alone.

    ``progress`` is a record of dtype ``PROGRESS``, from which the flow goes on. Its changes are in as many rows of
    ``events`` (capacity, 4): time, contact, side and kind (1 onset, -1 separation). Returns the outcome.
    """
    step = stepper.step
    # At most a radian of the fastest motion: beyond, the quintic that is searched for changes would miss some.
    largest = 1.0 / stepper.omega_ref
    if progress.has_begun == 0:
        _begin(stepper, min(0.1 * largest, duration), progress)
    t = progress.time
    h = progress.length
    outcome = DONE

    while t < duration:
        if progress.steps >= progress.pause:
            outcome = PAUSED
            break
        progress.steps += 1
        last = t + h >= duration * (1.0 - 1e-15)
        if last:
            h = duration - t
        elif h < SMALLEST_STEP * duration:
            outcome = STUCK
            break

        error = tried(stepper, h)
        if not error < 1.0:
            # After an overflow: see ``_take_orbit``.
            if not error < 1e300:
                stepper.stages[1:] = 0.0
            h = shortened(h, error)
            continue
        next_length = grown(h, error, largest)

        h, change, end = _end_on_change(stepper, orbit, t, h, duration)
        if end == EXTREMUM and t + h == t:
            outcome = STUCK
            break

        _begin_at_end(stepper, end == NONE)
        if np.any(step.side):
            progress.closed += h
        t += h
        # The end is set exactly: a sum of steps is rounded.
        if last and end == NONE:
            t = duration
        h = next_length
        if end == CROSSING:
            if progress.changes >= events.shape[0]:
                outcome = FULL
                break
            _fill_event(events[progress.changes], t, change, switch(step, change))
            progress.changes += 1
        if end != NONE:
            observe(step, stepper.start, stepper.stages[0], step.start)

    progress.time = t
    progress.length = h
    return outcome


def _padded(rows: int, columns: int) -> tuple[int, int]:
    """The least numbers of rows and columns with a multiple of 8 entries: sums over them then have no remainder."""
    more_rows = -(-rows // 8) * 8, columns
    least = 8 // math.gcd(rows, 8)
    more_columns = rows, -(-columns // least) * least
    return min(more_rows, more_columns, key=math.prod)


@kernel
def _flow_through(
    stepper: Stepper, orbit: Stepper, interval: float, states: np.ndarray, events: np.ndarray, so_far: np.ndarray
) -> int:
    """Advance by the ``interval`` in s as often as there are ``states`` (count, 2n), which are those of the orbit.

    The flow goes on from ``so_far`` (1,) of dtype ``PROGRESS``. Returns the outcome of the last interval, or of the
    first that is not covered.
    """
    progress = so_far[0]
    outcome = DONE
    while progress.interval < states.shape[0]:
        outcome = _flow(stepper, orbit, interval, events, progress)
        if outcome != DONE:
            break
        for i in range(states.shape[1]):
            states[progress.interval, i] = stepper.start[i, 0]
        progress.interval += 1
        progress.has_begun = 0
    return outcome


class Dop853Flow(Flow):
    """Dormand and Prince's 8(5,3) pair, landing on every contact change."""

    name = "compiled"

    def __init__(self, system: System) -> None:
        super().__init__(system)
        self._columns = 1 + 2 * system.dofs
        self._stepper = self._allocate(self._columns)
        self._orbit = self._allocate(1)
        # The orbit where no variations are asked for, and its end.
        self._alone = self._allocate(1)
        self._end = np.empty((1, 2 * system.dofs))
        self._events = np.empty((MOST_CHANGES, 4))

    def _allocate(self, columns: int) -> Stepper:
        """The arrays for steps of the orbit and its variations, in ``columns`` columns together."""
        shape = _padded(2 * self.system.dofs, columns)
        block = np.zeros((STAGES + 5, *shape))
        flat = block.reshape(len(block), -1)
        stages, errors, (start, end, end_rates) = np.split(block, [STAGES, STAGES + 2])
        sums = flat[:STAGES], flat[STAGES : STAGES + 2], flat[STAGES + 2], flat[STAGES + 3]
        step = begin(self.compiled, start)
        return Stepper(step, 1.0, stages, errors, start, end, end_rates, sums)

    def _advance(self, y: np.ndarray, duration: float, period: float) -> Advance:
        # The flow takes a step for each radian at least.
        self.limits.refuse(self.omega_ref(period) * duration)
        state = self._stepper.start[: len(y), : self._columns]
        state[:] = y
        progress = self._flow_through(self._stepper, duration, self._end, period)
        events = self._events[: progress["changes"]].copy()
        return Advance(state=state, events=events, closed=float(progress["closed"]), steps=int(progress["steps"]))

    def states(self, start: np.ndarray, interval: float, count: int, period: float) -> np.ndarray:
        """The states that ``Flow.states`` describes, computed without variations."""
        states = np.empty((1 + count, 2 * self.system.dofs))
        states[0] = start
        self._alone.start[: states.shape[1], 0] = start
        self._flow_through(self._alone, interval, states[1:], period)
        return states

    def _flow_through(self, stepper: Stepper, interval: float, states: np.ndarray, period: float) -> np.void:
        """Advance a ``stepper`` by an ``interval`` in s for each of the ``states``, which are filled.

        Returns how far it has come, a record of dtype ``PROGRESS``. Raises FlowError if the time cannot be covered.
        """
        stepper = stepper._replace(omega_ref=self.omega_ref(period))
        # Contacts that are closed in a step are so for both.
        orbit = self._orbit._replace(step=stepper.step)
        progress = np.zeros(1, PROGRESS)
        outcome = PAUSED
        while outcome == PAUSED:
            progress["pause"] = self.limits.check(int(progress["steps"][0]))
            outcome = _flow_through(stepper, orbit, interval, states, self._events, progress)
        self.limits.check(int(progress["steps"][0]))
        if outcome != DONE:
            why = {STUCK: "the step became too small", FULL: f"more than {MOST_CHANGES} contact changes"}
            count = progress["changes"][0]
            raise FlowError(f"the flow stopped after {count} contact changes in {interval:.6g} s: {why[outcome]}")
        return progress[0]
