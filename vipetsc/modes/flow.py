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

At a rigid stop, which conserves energy here, an impulse turns the velocity w' = h v of the contact with the row h,

    v+ = P v-,    P = I - 2 mu M^-1 h^T h,    1/mu = h M^-1 h^T.

Accelerations a depend on displacements alone, and are the same before and after it. With R = diag(I, P) the saltation
matrix R + (R g- - g+) grad h^T/(grad h^T g-) takes variations (du, dv) to

    du+ = P du-,    dv+ = P dv- + 2 mu M^-1 h^T (h a) (h du-)/w'-.

It has no limit for w' -> 0, where the stop is grazed. Of two stops of one mass that are struck at one instant each
order of the two has another derivative: there is none. A mass that is pressed on a stop without a speed stays there:
it no longer moves as those equations say.

**Steps** are those of Dormand and Prince's pair of order 8(5,3) (Hairer, Norsett and Wanner, Solving Ordinary
Differential Equations I, 2nd ed. 1993, sec. II.5 and II.10, and the authors' code DOP853). Stage s is y + h sum_r
A[s, r] k_r, the new state y + h sum_r B[r] k_r; E5 and E3 give the estimates of orders 5 and 3, which II.10 combines
into err5^2 / sqrt(err5^2 + err3^2 / 100).

**Changes.** A contact changes when its gap rises through zero: sigma w - D while it is open, D - sigma w while it is
closed. The quintic Hermite interpolant of a step's gap is searched by ``contact.search``, so that no pair of changes is
missed, however short. Where the interpolant's error, which falls as the fourth power of the step or faster, decides
whether there is a change, the step is halved; below rounding there is none. ``contact.search`` also lands on it.

**Limits.** From a good guess Newton's method goes to orbits near it, whose arcs take about as many steps of the flow as
the arc of the guess. Where the derivative is almost singular, as near a second branch, a step of the method may lead to
any period or amplitude, and an arc from there may take longer than any computation: it ends the attempt
(``Flow.limited``).
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
from vipetsc.contact.search import LANDED, RETRY, Landing, bernstein, correct, first_upcrossing_after_start
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


# Outcomes of a flow: the time is covered; a step is too small; there are more changes than can be listed; the steps
# that were allowed are done, and the flow can go on; rigid stops of one mass are struck together; one is pressed on.
DONE, STUCK, FULL, PAUSED, TOGETHER, PRESSED = range(6)
# Positions in a step of no change, and of a change that the interpolant cannot tell from a near miss.
NONE = 2.0
UNDECIDED = -1.0
# The largest difference of positions of one change, with the interpolant's error on either side.
DECIDED = 0.01
# Rounding of a gap, over the clearance and the size of the motion. An onset within it is none.
ROUNDING = 16 * np.finfo(float).eps
# The part of it at which a landing need not be improved.
EXACT = 1 / 8
# Contacts that are within so many of it are on their stops at one instant: landings of two of them differ by theirs.
NEAR = 4.0


class Change(NamedTuple):
    """The change of a ``contact`` to or from a ``side`` at a ``position`` in the step, from 0 to 1, or without one.

    There the gap sign w - offset rises through zero, with the rounding error ``tolerance`` in m.
    """

    contact: int
    side: int
    sign: float
    offset: float
    tolerance: float
    position: float


@kernel
def first_rise(gap: np.ndarray, tolerance: float, room: np.ndarray) -> float:
    """Return position at which a gap that begins at zero or below first rises through it; ``NONE``, or ``UNDECIDED``.

    ``gap`` (6,) are the coefficients of the interpolant in Bernstein's form, and the gap has the rounding error
    ``tolerance``; ``room`` (6,) is overwritten.
    """
    # The error is that of the next power of the position, a fraction of those of the orders 4 and 5. It vanishes at the
    # start: there it is taken to grow with the position, whose coefficients are k/5.
    fourth = gap[4] - 4.0 * gap[3] + 6.0 * gap[2] - 4.0 * gap[1] + gap[0]
    fifth = gap[5] - 5.0 * gap[4] + 10.0 * gap[3] - 10.0 * gap[2] + 5.0 * gap[1] - gap[0]
    margin = max(0.01 * (abs(fifth) + 1.5 * abs(fourth)), tolerance)
    for k in range(6):
        room[k] = gap[k] + 0.2 * k * margin
    earliest = first_upcrossing_after_start(room, tolerance)
    if earliest > 1.0:
        return NONE

    for k in range(6):
        room[k] = gap[k] - 0.2 * k * margin
    latest = first_upcrossing_after_start(room, tolerance)
    if latest - earliest <= DECIDED:
        return 0.5 * (earliest + latest)
    if margin > tolerance:
        return UNDECIDED
    return latest


CONTACT = np.dtype([("plus", np.float64), ("minus", np.float64), ("rigid", bool), ("elastic", ELASTIC)])
"""A contact: its clearances in m on the sides + and -, inf where there is no stop; if not ``rigid`` its elastic law.

The clearance of a contact that is pressed at rest is negative, and it has no stop on the other side.
"""
Shape = tuple[int, int, int]
"""Where ``restore`` puts forces, and how many: the first of their rows, the displacements n, the columns 1 + m."""
# Kinds of changes in an arc's list of events. An impact on a rigid stop is an onset, without a separation.
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
    w, w' and w'' at both ends. ``room`` (3, 6) is overwritten.
    """

    system: CompiledSystem
    side: np.ndarray
    start: np.ndarray
    end: np.ndarray
    room: np.ndarray


@inlined
def clearance_on(contact: Any, side: int) -> float:
    """Return the clearance in m of a ``CONTACT`` on one side, 1 or -1."""
    return contact.plus if side > 0 else contact.minus


@inlined
def elongation(rows: np.ndarray, c: int, y: np.ndarray, first: int, j: int, n: int) -> float:
    """Return the row ``c`` of ``rows`` (rows, n) times n entries of column ``j`` of ``y``, from ``first`` on."""
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
def find_site_motion(step: FlowStep, y: np.ndarray, dy: np.ndarray, motion: np.ndarray) -> None:
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
        # A motion on a rigid stop is not beyond it, whatever its rounding.
        if system.contacts[c].rigid:
            continue
        if w > system.contacts[c].plus:
            side[c] = 1
        elif -w > system.contacts[c].minus:
            side[c] = -1


@kernel
def begin(system: CompiledSystem, y: np.ndarray) -> FlowStep:
    """Return the record of a flow's steps, which begins at the state in column 0 of ``y`` (2n, 1 + m)."""
    contacts = system.contacts.size
    side = np.empty(contacts, np.int64)
    step = FlowStep(system, side, np.empty((contacts, 3)), np.empty((contacts, 3)), np.empty((3, 6)))
    close(system, y, step.side)
    return step


@kernel
def first_change(step: FlowStep, h: float, size: float) -> Change:
    """Return the first change of a contact in a step of length ``h``; ``size`` in m is that of the motion."""
    change = Change(contact=-1, side=0, sign=0.0, offset=0.0, tolerance=0.0, position=NONE)
    motion = step.room[0]
    gap = step.room[1]
    for c in range(step.side.size):
        bernstein(step.start[c], step.end[c], h, motion)
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
            for k in range(6):
                gap[k] = sign * motion[k] - offset
            tolerance = ROUNDING * (abs(clearance) + size)
            position = first_rise(gap, tolerance, step.room[2])
            # What is undecided comes first, as -1: the step is to be halved.
            if position < change.position:
                change = Change(c, s, sign, offset, tolerance, position)
    return change


@kernel
def switch(step: FlowStep, change: Change) -> int:
    """Close or open the contact of a ``change``; returns ``ONSET`` or ``SEPARATION``."""
    if step.side[change.contact] == 0:
        step.side[change.contact] = change.side
        return ONSET
    step.side[change.contact] = 0
    return SEPARATION


@kernel
def strike(step: FlowStep, change: Change, y: np.ndarray, dy: np.ndarray, near: float) -> int:
    """Let the masses of a rigid contact part at their ``change``; returns ``DONE``, or why it has no derivative.

    Column 0 of ``y`` (2n or more, 1 + m) is the state, the others are its variations; ``dy`` are their rates. Contacts
    within ``near`` in m of a stop are on it.
    """
    system = step.system
    n = system.inverse_mass.size
    c = change.contact
    mobility = 0.0
    for i in range(n):
        mobility += system.rows[c, i] ** 2 * system.inverse_mass[i]
    rate = elongation(system.rows, c, y, n, 0, n)
    acceleration = elongation(system.rows, c, dy, n, 0, n)
    # Pressed, and so slow that it does not leave the stop again.
    if change.sign * acceleration >= 0.0 and rate * rate <= 2.0 * abs(acceleration) * near:
        return PRESSED

    for j in range(y.shape[1]):
        before = elongation(system.rows, c, y, 0, j, n)
        impulse = 2.0 * elongation(system.rows, c, y, n, j, n) / mobility
        if j > 0:
            impulse -= 2.0 * before * acceleration / (rate * mobility)
        for i in range(n):
            moved = system.rows[c, i] * system.inverse_mass[i]
            y[n + i, j] -= moved * impulse
            if j > 0:
                y[i, j] -= moved * 2.0 * before / mobility

    for d in range(system.contacts.size):
        if d == c or not system.contacts[d].rigid:
            continue
        shared = 0.0
        for i in range(n):
            shared += system.rows[c, i] * system.rows[d, i] * system.inverse_mass[i]
        w = elongation(system.rows, d, y, 0, 0, n)
        if shared != 0.0 and (abs(w - system.contacts[d].plus) <= near or abs(w + system.contacts[d].minus) <= near):
            return TOGETHER
    return DONE


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
        """Return the unit of what vanishes at the end over that of the initial values, for an orbit of ``period`` in s.

        From rest to rest, velocities over displacements, it is the frequency in rad/s, rounded to a power of two, by
        which numbers are multiplied without rounding.
        """
        if self.quarter:
            return 1.0
        frequency = float(2.0 ** np.round(np.log2(2 * np.pi / period)))
        if not self.starts_at_rest:
            return 1 / frequency
        return frequency


# The derivative of the whole period's equations has a condition number 4 to 55 times that of the quarter (median),
# 4e5 times at most, on the paper's branches up to 100 J.
MAPS = {
    "quarter": ShootingMap("quarter", "rest", "centre", 0.25),
    "half": ShootingMap("half", "rest", "rest", 0.5),
    "whole": ShootingMap("whole", "rest", "rest", 1.0),
    "half-centre": ShootingMap("half-centre", "centre", "centre", 0.5),
}


def map_between_impacts(odd: bool) -> ShootingMap:
    """Return the map of orbits that strike rigid stops, where a motion turns: it has no impact at its start and end.

    An ``odd`` system's orbits pass the centre halfway between two impacts. Other orbits rest on the side on which they
    strike nothing, and have their impacts within a whole period from there on.
    """
    return MAPS["half-centre" if odd else "whole"]


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
    """

    duration: float
    start: np.ndarray
    end: np.ndarray
    sensitivity: np.ndarray
    events: np.ndarray
    episodes: int
    closed: float
    steps: int


class Flow(ABC):
    """Arcs of the orbits of a ``system``; a subclass gives its ``name`` in case files and ``_advance``."""

    name: ClassVar[str]

    def __init__(self, system: System) -> None:
        self.system = system
        contacts = np.zeros(len(system.contacts), CONTACT)
        contacts["plus"], contacts["minus"] = system.clearances.T
        contacts["rigid"] = system.is_rigid
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
        self.between_looks = max(ENTRIES_BETWEEN_LOOKS // (2 * n * (1 + 2 * n)), 1)
        self._longest = UNLIMITED
        self._stop: StopRequest | None = None
        self._variations = np.eye(2 * n, 1 + 2 * n, k=1)  # at the start of an arc, behind the column of the orbit
        self._away = np.where(system.is_pressed, SEPARATION, ONSET)

    @contextmanager
    def limited(self, longest: int, stop: StopRequest | None) -> Iterator[None]:
        """Let arcs in the block raise FlowError beyond ``longest`` steps, StoppedError where a ``stop`` is asked.

        Outside of it no arc is too long, and none is stopped.
        """
        self._longest = longest
        self._stop = stop
        try:
            yield
        finally:
            self._longest = UNLIMITED
            self._stop = None

    def check(self, steps: float) -> int:
        """Return at how many steps of an arc that has made so many ``steps`` to call again; raises as ``limited``."""
        if steps > self._longest:
            raise FlowError(
                f"an arc of more than {self._longest} steps, {MOST_LONGER} times those of the arc at the guess"
            )
        if self._stop is not None and self._stop.requested:
            raise StoppedError("stopped on request; continue with --resume")
        return min(int(steps) + self.between_looks, self._longest + 1)

    def omega_ref(self, period: float) -> float:
        """Return the frequency in rad/s that makes velocities displacements: the larger of fastest mode and orbit."""
        return max(self.omega, 2 * np.pi / period)

    def arc(self, start: np.ndarray, duration: float, period: float) -> Arc:
        """Return the orbit from ``start`` (2n,) over ``duration`` seconds; ``period`` helps to choose steps.

        Raises FlowError if the time cannot be covered.
        """
        self._check_start(start)
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
            steps=advance.steps,
        )

    def _check_start(self, start: np.ndarray) -> None:
        """Raise FlowError where the state ``start`` (2n,) is beyond a rigid stop."""
        if not self.system.has_rigid_stops:
            return
        u = start[: self.system.dofs]
        beyond = self.system.gaps(u)[self.system.is_rigid].max()
        if beyond > ROUNDING * (np.abs(u).max() + beyond):
            raise FlowError(f"the orbit starts {beyond:.3g} m beyond a rigid stop")

    def states(self, start: np.ndarray, interval: float, count: int, period: float) -> np.ndarray:
        """Return the states (1 + count, 2n) of the orbit from ``start`` (2n,) on, every ``interval`` seconds.

        ``period`` helps to choose steps. Raises FlowError if the time cannot be covered.
        """
        states = [np.asarray(start, float)]
        for _ in range(count):
            states.append(self.arc(states[-1], interval, period).end)
        return np.array(states)

    @abstractmethod
    def _advance(self, y: np.ndarray, duration: float, period: float) -> Advance:
        """Advance state and variations ``y`` (2n, 1 + 2n) by ``duration`` s and ``check`` its steps; ``y`` is lost."""


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
    """Return the largest error of a column over what is allowed; infinite if the step overflowed."""
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
    """Return the length to try after a step of length ``h`` whose scaled ``error`` is not below 1."""
    # A number that has overflowed says nothing of the next length.
    if not error < 1e300:
        return h * 0.1
    return h * max(LEAST_FACTOR, SAFETY * error ** (-0.125))


@kernel
def grown(h: float, error: float, largest: float) -> float:
    """Return the length of the next step, at most ``largest``, after one of ``h`` with a scaled ``error`` below 1."""
    return min(largest, h * min(MOST_FACTOR, SAFETY * max(error, SMALLEST_ERROR) ** (-0.125)))


# Contact changes of one arc beyond which a flow gives up: thirty times as many as the in-phase branch of the paper's
# model (bilinear) has in a quarter period up to 5 J, 67.
MOST_CHANGES = 2000
COUNTS = [(name, np.int64) for name in ("interval", "has_begun", "steps", "pause", "changes")]
PROGRESS = np.dtype([*COUNTS, ("time", float), ("length", float), ("closed", float)])
"""How far a flow has come: the number of its present interval, and 1 if that has begun; the steps tried so far, and how
many are allowed; in that interval the changes, the time in s, the next step's in s, the seconds with a contact closed.
"""


@kernel
def _size(stepper: Stepper) -> float:
    """Return size of the motion in m at the start of a step: the largest displacement, or velocity over a frequency."""
    n = stepper.step.system.inverse_mass.size
    size = 0.0
    for i in range(n):
        size = max(size, abs(stepper.start[i, 0]), abs(stepper.start[n + i, 0]) / stepper.omega_ref)
    return size


@kernel
def _take_orbit(orbit: Stepper, stepper: Stepper) -> None:
    """Let the ``orbit`` begin where the ``stepper`` begins, without the variations."""
    # Rates that an earlier attempt has left infinite or NaN would stay in the sums, even with the weight 0.
    orbit.stages[1:] = 0.0
    for i in range(2 * stepper.step.system.inverse_mass.size):
        orbit.start[i, 0] = stepper.start[i, 0]
        orbit.stages[0, i, 0] = stepper.stages[0, i, 0]


@kernel
def _land(stepper: Stepper, orbit: Stepper, h: float, change: Change) -> float:
    """Repeat a step of length ``h`` so that it ends on a ``change``; returns the new length, -1 if none is found.

    The ``orbit``, a stepper without variations, makes the attempts, and the ``stepper`` one step with the variations.
    """
    _take_orbit(orbit, stepper)
    step = orbit.step
    landing = Landing(length=change.position * h, longest=h, residual=np.inf, attempts=0)
    # A contact changes at once after one that changes with it, as by a symmetry.
    outcome = LANDED
    if landing.length > 0.0:
        outcome = RETRY
    while outcome == RETRY:
        # Each attempt is a whole step from the start: its end has the order of the pair, an interpolant has not.
        advance(orbit, landing.length)
        find_site_motion(step, orbit.end, orbit.end_rates, step.end)
        gap = change.sign * step.end[change.contact, 0] - change.offset
        rate = change.sign * step.end[change.contact, 1]
        landing, outcome = correct(landing, gap, rate, change.tolerance, EXACT * change.tolerance)
    if outcome != LANDED:
        return -1.0
    advance(stepper, landing.length)
    return landing.length


@kernel
def _end_on_change(stepper: Stepper, orbit: Stepper, h: float) -> tuple[float, Change]:
    """Let a step of length ``h``, which is made, end on its first change; returns its length, and the change.

    The length is -1 where the step is too long to tell whether there is a change, or to land on it.
    """
    step = stepper.step
    find_site_motion(step, stepper.end, stepper.end_rates, step.end)
    change = first_change(step, h, _size(stepper))
    length = h
    if change.position == UNDECIDED:
        length = -1.0
    elif change.contact >= 0:
        length = _land(stepper, orbit, h, change)
    return length, change


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
def _pass(stepper: Stepper, change: Change, t: float, event: np.ndarray) -> int:
    """Pass a ``change`` at the ``start`` of a stepper, at ``t`` in s, and fill its ``event``; returns the outcome."""
    step = stepper.step
    kind = ONSET
    if step.system.contacts[change.contact].rigid:
        find_site_motion(step, stepper.start, stepper.stages[0], step.start)
        outcome = strike(step, change, stepper.start, stepper.stages[0], NEAR * change.tolerance)
        if outcome != DONE:
            return outcome
    else:
        kind = switch(step, change)
    _fill_event(event, t, change, kind)
    find_site_motion(step, stepper.start, stepper.stages[0], step.start)
    return DONE


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
    find_site_motion(step, stepper.start, stepper.stages[0], step.start)


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

        length, change = _end_on_change(stepper, orbit, h)
        # In a shorter step the interpolant tells more, and a landing begins nearer to the change.
        if length < 0.0:
            h = 0.5 * h
            continue
        h = length
        changes = change.contact >= 0

        _begin_at_end(stepper, not changes)
        if np.any(step.side):
            progress.closed += h
        t += h
        # The end is set exactly: a sum of steps is rounded.
        if last and not changes:
            t = duration
        h = next_length
        if changes:
            if progress.changes >= events.shape[0]:
                outcome = FULL
                break
            outcome = _pass(stepper, change, t, events[progress.changes])
            if outcome != DONE:
                break
            progress.changes += 1

    progress.time = t
    progress.length = h
    return outcome


def _padded(rows: int, columns: int) -> tuple[int, int]:
    """Return least numbers of rows and columns with a multiple of 8 entries: sums over them then have no remainder."""
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
        """Return the arrays for steps of the orbit and its variations, in ``columns`` columns together."""
        shape = _padded(2 * self.system.dofs, columns)
        block = np.zeros((STAGES + 5, *shape))
        flat = block.reshape(len(block), -1)
        stages, errors, (start, end, end_rates) = np.split(block, [STAGES, STAGES + 2])
        sums = flat[:STAGES], flat[STAGES : STAGES + 2], flat[STAGES + 2], flat[STAGES + 3]
        step = begin(self.compiled, start)
        return Stepper(step, 1.0, stages, errors, start, end, end_rates, sums)

    def _advance(self, y: np.ndarray, duration: float, period: float) -> Advance:
        # The flow takes a step for each radian at least.
        self.check(self.omega_ref(period) * duration)
        state = self._stepper.start[: len(y), : self._columns]
        state[:] = y
        progress = self._flow_through(self._stepper, duration, self._end, period)
        events = self._events[: progress["changes"]].copy()
        return Advance(state=state, events=events, closed=float(progress["closed"]), steps=int(progress["steps"]))

    def states(self, start: np.ndarray, interval: float, count: int, period: float) -> np.ndarray:
        """Return the states that ``Flow.states`` describes, computed without variations."""
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
            progress["pause"] = self.check(int(progress["steps"][0]))
            outcome = _flow_through(stepper, orbit, interval, states, self._events, progress)
        if outcome != DONE:
            why = {
                STUCK: "the step became too small",
                FULL: f"more than {MOST_CHANGES} contact changes",
                TOGETHER: "rigid stops that share a mass are struck at one instant, where the motion has no derivative",
                PRESSED: "a mass is pressed on a rigid stop at no speed: it sticks there",
            }
            count = progress["changes"][0]
            raise FlowError(f"the flow stopped after {count} contact changes in {interval:.6g} s: {why[outcome]}")
        return progress[0]
