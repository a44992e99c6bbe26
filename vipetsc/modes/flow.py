"""What every flow shares: arcs of orbits, and the system in compiled form with its rates and contact changes.

The set of closed contacts is frozen inside a step, so that the force is smooth there. After each step the gap of every
contact is searched, and the step is repeated so that it ends on the first change (see the package's docstring).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from vipetsc.compiled import njit
from vipetsc.contact.law import ForceLaw, elastic_force_and_slope
from vipetsc.modes.changes import EXTREMUM, NONE, Change, first_rise, hermite
from vipetsc.modes.system import System

CONTACT = np.dtype([("clearance", np.float64), ("stiffness", np.float64), ("exponent", np.float64)])
SPRING = np.dtype([("quadratic", np.float64), ("cubic", np.float64)])
# A step below this fraction of the interval means that the flow is stuck.
SMALLEST_STEP = 1e-15


class CompiledSystem(NamedTuple):
    """A ``System`` for kernels: ``rows`` (contacts, n) with w = rows u, ``spring_rows`` (springs, n) likewise."""

    inverse_mass: np.ndarray
    stiffness: np.ndarray
    rows: np.ndarray
    contacts: np.ndarray
    spring_rows: np.ndarray
    springs: np.ndarray


class Step(NamedTuple):
    """What a step of a system leaves for the search.

    ``side`` (contacts,) of closed contacts, 1 or -1, 0 for open ones; ``start`` and ``end`` (contacts, 3) hold
    w, w' and w'' at both ends.
    """

    system: CompiledSystem
    side: np.ndarray
    start: np.ndarray
    end: np.ndarray


@njit
def elongation(row: np.ndarray, u: np.ndarray) -> float:
    """Row times displacements (n,)."""
    z = 0.0
    for k in range(row.size):
        z += row[k] * u[k]
    return z


@njit
def _add(u: np.ndarray, pull: np.ndarray, row: np.ndarray, force: float, slope: float) -> None:
    for j in range(u.shape[1]):
        along = force if j == 0 else slope * elongation(row, u[:, j])
        for i in range(row.size):
            pull[i, j] -= row[i] * along


@njit
def restore(system: CompiledSystem, side: np.ndarray, u: np.ndarray, pull: np.ndarray) -> None:
    """Forces that ``pull`` (n, 1 + m) back the orbit, column 0 of ``u`` (n, 1 + m), and its variations, in N."""
    n, columns = u.shape
    for i in range(n):
        pull[i] = 0.0
        for k in range(n):
            s = system.stiffness[i, k]
            if s != 0.0:
                for j in range(columns):
                    pull[i, j] -= s * u[k, j]
    for c in range(side.size):
        if side[c] != 0:
            contact, row = system.contacts[c], system.rows[c]
            x = side[c] * elongation(row, u[:, 0]) - contact.clearance
            # past the exit, which is landed on anyway, the law is odd
            force, slope = elastic_force_and_slope(ForceLaw(contact.stiffness, contact.exponent, 0.0, False, 0.0), x)
            _add(u, pull, row, side[c] * force, slope)
    for s in range(system.springs.size):
        a, b, z = system.springs[s].quadratic, system.springs[s].cubic, elongation(system.spring_rows[s], u[:, 0])
        _add(u, pull, system.spring_rows[s], (a + b * z) * z * z, (2.0 * a + 3.0 * b * z) * z)


@njit
def rates(system: CompiledSystem, side: np.ndarray, y: np.ndarray, dy: np.ndarray) -> None:
    """Time derivative ``dy`` of the orbit, column 0, and variations of ``y`` (2n, 1 + m): displacements, velocities."""
    n = y.shape[0] // 2
    restore(system, side, y[:n], dy[n:])
    dy[:n] = y[n:]
    for i in range(n):
        dy[n + i] *= system.inverse_mass[i]


@njit
def observe(step: Step, y: np.ndarray, dy: np.ndarray, motion: np.ndarray) -> None:
    """Rates ``dy`` of the state ``y``, and w, w' and w'' of every contact into ``motion`` (contacts, 3)."""
    rates(step.system, step.side, y, dy)
    n = y.shape[0] // 2
    for c in range(motion.shape[0]):
        row = step.system.rows[c]
        motion[c, 0], motion[c, 1] = elongation(row, y[:n, 0]), elongation(row, y[n:, 0])
        motion[c, 2] = elongation(row, dy[n:, 0])


@njit
def close(system: CompiledSystem, u: np.ndarray, side: np.ndarray) -> None:
    """The sides on which the contacts are closed at displacements ``u`` (n,), 0 for open ones."""
    for c in range(side.size):
        w = elongation(system.rows[c], u)
        side[c] = np.sign(w) if abs(w) > system.contacts[c].clearance else 0


@njit
def begin(system: CompiledSystem, y: np.ndarray) -> Step:
    """The record of a flow's steps, which begins at the state ``y``."""
    contacts = system.contacts.size
    step = Step(system, np.empty(contacts, np.int64), np.empty((contacts, 3)), np.empty((contacts, 3)))
    close(system, y[: y.shape[0] // 2, 0], step.side)
    return step


@njit
def first_change(step: Step, h: float) -> Change:
    """The first change of a contact in a step of length ``h``, with the first attempt at it."""
    gap, first = np.empty(6), 1.0
    change = Change(-1, 0, 0.0, 0.0, False, 0.0, h, h, 0)
    for c in range(step.side.size):
        clearance = step.system.contacts[c].clearance
        for s in (-1, 1):
            if step.side[c] == 0 or step.side[c] == s:
                sign, offset = (float(s), clearance) if step.side[c] == 0 else (-float(s), -clearance)
                hermite(step.start[c], step.end[c], h, sign, offset, gap)
                share, outcome = first_rise(gap)
                if outcome != NONE and share < first:
                    first = share
                    change = Change(c, s, sign, offset, outcome == EXTREMUM, 0.0, h, share * h, 0)
    return change


@njit
def switch(step: Step, change: Change) -> int:
    """Close or open the contact of a ``change``: 1 for an onset, -1 for a separation."""
    onset = step.side[change.contact] == 0
    step.side[change.contact] = change.side if onset else 0
    return 1 if onset else -1


class FlowError(RuntimeError):
    """The flow could not cover the requested time."""


@dataclass(frozen=True, eq=False)
class Arc:
    """A piece of an orbit of ``duration`` seconds.

    ``start`` and ``end`` (2n,) hold displacements in m, then velocities in m/s; ``sensitivity`` (2n, 2n) is
    d end/d start; ``acceleration`` (2, n) in m/s^2 at both ends; ``events`` (changes, 4) lists time in s,
    contact, side (1 or -1) and kind (1 onset, -1 separation); ``closed`` the seconds with a contact closed.
    """

    duration: float
    start: np.ndarray
    end: np.ndarray
    sensitivity: np.ndarray
    acceleration: np.ndarray
    events: np.ndarray
    episodes: int
    closed: float


class Flow(ABC):
    """What every flow offers; a subclass gives its ``name`` and ``_advance``."""

    name: ClassVar[str]

    def __init__(self, system: System) -> None:
        self.system = system
        contacts = [(p.clearance, p.law.stiffness, p.law.exponent) for p in system.contacts]
        self.compiled = CompiledSystem(
            1 / np.asarray(system.masses, float),
            np.ascontiguousarray(system.stiffness, float),
            system.contact_rows,
            np.array(contacts, CONTACT),
            system.spring_rows,
            np.array([(s.quadratic, s.cubic) for s in system.springs], SPRING),
        )
        self.omega = float(system.linear_modes()[0][-1])

    def omega_ref(self, period: float) -> float:
        """Frequency in rad/s by which velocities count as displacements: the fastest linear mode's, or the orbit's."""
        return max(self.omega, 2 * np.pi / period)

    def arc(self, start: np.ndarray, duration: float, period: float) -> Arc:
        """The orbit from ``start`` (2n,) over ``duration`` seconds; ``period`` helps to choose steps.

        Raises FlowError if the time cannot be covered.
        """
        y = np.hstack([np.asarray(start, float)[:, None], np.eye(len(start))])
        y, events, closed = self._advance(y, duration, period)
        n, system = self.system.dofs, self.system
        end, sensitivity = y[:, 0].copy(), y[:, 1:].copy()
        acceleration = np.array([-system.forces(z[:n]) / system.masses for z in (start, end)])
        episodes = int(np.sum(system.gaps(start[:n]) > 0) + np.sum(events[:, 3] == 1))
        return Arc(duration, start, end, sensitivity, acceleration, events, episodes, closed)

    @abstractmethod
    def _advance(self, y: np.ndarray, duration: float, period: float) -> tuple[np.ndarray, np.ndarray, float]:
        """State and variations (2n, 1 + 2n) after ``duration``, the arc's ``events`` and ``closed``; ``y`` is lost."""
