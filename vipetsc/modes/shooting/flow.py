"""Arcs of orbits, and the system in compiled form with its rates and contact changes, for every flow.

Flows are those of the conservative system: contacts act by their elastic laws, and dashpots are left out. The set of
closed contacts is frozen inside a step, so that the force is smooth there. After each step the gap of every contact is
searched, and a flow's ``_advance`` repeats the step so that it ends on the first change. At a change the force of a
contact is 0 on both sides, so that the rates are continuous: variations pass it without a jump (see the package's
docstring).
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from vipetsc.compiled import inlined, kernel
from vipetsc.contact.law import ELASTIC, elastic_force_and_slope, elastic_records
from vipetsc.dynamics.spring_law import nonlinear_force, nonlinear_slope, spring_laws
from vipetsc.modes.shooting.arc_limits import ArcLimits
from vipetsc.modes.shooting.landing import EXTREMUM, NONE, Change, first_rise, hermite
from vipetsc.modes.system import System

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
