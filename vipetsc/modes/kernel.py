"""The compiled flow: DOP853 between contact changes, landing on every change.

The set of closed contacts is frozen inside a step, so the force is smooth there; after each step the gap of every
contact is searched, and the step is repeated so that it ends on the first change. Contact forces are continuous,
hence so are the variational equations' solutions (saltation is the identity, see the package's docstring).
"""

from typing import NamedTuple

import numpy as np

from vipetsc.compiled import njit
from vipetsc.contact.law import ForceLaw, elastic_force_and_slope
from vipetsc.modes.changes import EXTREMUM, MOST_ATTEMPTS, NONE, Landing, correct, first_rise, hermite
from vipetsc.modes.tableau import E3, E5, STAGES, A, B

# Outcomes of a flow: the time is covered; a step is too small; there are more changes than can be listed.
DONE, STUCK, FULL = range(3)
# A step below this fraction of the interval means that the flow is stuck.
SMALLEST_STEP = 1e-15
CONTACT = np.dtype([("clearance", np.float64), ("stiffness", np.float64), ("exponent", np.float64)])
SPRING = np.dtype([("quadratic", np.float64), ("cubic", np.float64)])


class CompiledSystem(NamedTuple):
    """A ``System`` for kernels: ``rows`` (contacts, n) with w = rows u, ``spring_rows`` (springs, n) likewise."""

    inverse_mass: np.ndarray
    stiffness: np.ndarray
    rows: np.ndarray
    contacts: np.ndarray
    spring_rows: np.ndarray
    springs: np.ndarray


class Tolerances(NamedTuple):
    """Errors allowed per step, relative to the size of the orbit and of each variation.

    Velocities count as displacements over a radian of ``omega_ref`` (rad/s), and a step is at most one radian.
    """

    rtol: float
    rtol_sensitivity: float
    omega_ref: float


class Stepper(NamedTuple):
    """What a step reads and writes; ``side`` (contacts,) -1, 0 or 1; states (2n, 1 + m); motions (contacts, 3)."""

    system: CompiledSystem
    tolerances: Tolerances
    side: np.ndarray
    stages: np.ndarray
    end: np.ndarray
    end_rates: np.ndarray
    start_motion: np.ndarray
    end_motion: np.ndarray


class Change(NamedTuple):
    """The first change in a step: its share of the step, the outcome of the search, contact and side."""

    share: float
    outcome: int
    contact: int
    side: int


@njit
def create_stepper(system: CompiledSystem, tolerances: Tolerances, columns: int) -> Stepper:
    """A stepper for states with ``columns`` - 1 variations; its arrays are not filled."""
    shape = 2 * system.inverse_mass.size, columns
    contacts = system.contacts.size
    side, stages = np.empty(contacts, np.int64), np.empty((STAGES, shape[0], shape[1]))
    end, end_rates = np.empty(shape), np.empty(shape)
    return Stepper(system, tolerances, side, stages, end, end_rates, np.empty((contacts, 3)), np.empty((contacts, 3)))


@njit
def contact_force(system: CompiledSystem, c: int, x: float) -> tuple[float, float]:
    """Force in N and its slope in N/m of contact ``c`` at the indentation x in m, odd in x."""
    contact = system.contacts[c]
    return elastic_force_and_slope(ForceLaw(contact.stiffness, contact.exponent, 0.0, False, 0.0), x)


@njit
def spring_force(system: CompiledSystem, s: int, z: float) -> tuple[float, float]:
    """Force in N and its slope in N/m of the smooth spring ``s`` at the elongation z in m."""
    spring = system.springs[s]
    return (spring.quadratic + spring.cubic * z) * z * z, (2.0 * spring.quadratic + 3.0 * spring.cubic * z) * z


@njit
def _add(y: np.ndarray, dy: np.ndarray, row: np.ndarray, force: float, slope: float) -> None:
    """Add a force along ``row`` to the orbit's accelerations, its slope to the variations'."""
    n, columns = y.shape[0] // 2, y.shape[1]
    for i in range(n):
        if row[i] != 0.0:
            dy[n + i, 0] -= row[i] * force
    for j in range(1, columns):
        z = 0.0
        for k in range(n):
            z += row[k] * y[k, j]
        z *= slope
        for i in range(n):
            dy[n + i, j] -= row[i] * z


@njit
def elongation(row: np.ndarray, u: np.ndarray) -> float:
    """Row times displacements (n,)."""
    z = 0.0
    for k in range(row.size):
        z += row[k] * u[k]
    return z


@njit
def rates(system: CompiledSystem, side: np.ndarray, y: np.ndarray, dy: np.ndarray) -> None:
    """Time derivative ``dy`` of the orbit, column 0, and variations of ``y`` (2n, 1 + m): displacements, velocities."""
    n, columns = y.shape[0] // 2, y.shape[1]
    for i in range(n):
        for j in range(columns):
            dy[i, j] = y[n + i, j]
            dy[n + i, j] = 0.0
        for k in range(n):
            s = system.stiffness[i, k]
            if s != 0.0:
                for j in range(columns):
                    dy[n + i, j] -= s * y[k, j]
    for c in range(side.size):
        if side[c] != 0:
            x = side[c] * elongation(system.rows[c], y[:n, 0]) - system.contacts[c].clearance
            force, slope = contact_force(system, c, x)  # past the exit, which is landed on anyway, it is odd
            _add(y, dy, system.rows[c], side[c] * force, slope)
    for c in range(system.springs.size):
        force, slope = spring_force(system, c, elongation(system.spring_rows[c], y[:n, 0]))
        _add(y, dy, system.spring_rows[c], force, slope)
    for i in range(n):
        for j in range(columns):
            dy[n + i, j] *= system.inverse_mass[i]


@njit
def relative_motion(system: CompiledSystem, y: np.ndarray, dy: np.ndarray, motion: np.ndarray) -> None:
    """w, w' and w'' of every contact into ``motion`` (contacts, 3)."""
    n = y.shape[0] // 2
    for c in range(motion.shape[0]):
        motion[c, 0] = elongation(system.rows[c], y[:n, 0])
        motion[c, 1] = elongation(system.rows[c], y[n:, 0])
        motion[c, 2] = elongation(system.rows[c], dy[n:, 0])


@njit
def closed_sides(system: CompiledSystem, y: np.ndarray, side: np.ndarray) -> None:
    """The sides on which the contacts of a state are closed, 0 for open ones."""
    for c in range(side.size):
        w, clearance = elongation(system.rows[c], y[: y.shape[0] // 2, 0]), system.contacts[c].clearance
        side[c] = 1 if w > clearance else (-1 if w < -clearance else 0)


@njit
def _scaled_error(stepper: Stepper, y: np.ndarray, h: float) -> float:
    """The new state from the stages, and the largest error of a column over what is allowed."""
    k, out, tolerances = stepper.stages, stepper.end, stepper.tolerances
    size, columns = y.shape
    error = 0.0
    for j in range(columns):
        fifth, third, scale = 0.0, 0.0, 0.0
        for i in range(size):
            total, e5, e3 = 0.0, 0.0, 0.0
            for r in range(STAGES):
                total += B[r] * k[r, i, j]
                e5 += E5[r] * k[r, i, j]
                e3 += E3[r] * k[r, i, j]
            out[i, j] = y[i, j] + h * total
            unit = 1.0 if i < size // 2 else 1.0 / tolerances.omega_ref
            fifth = max(fifth, abs(e5) * unit)
            third = max(third, abs(e3) * unit)
            scale = max(scale, abs(out[i, j]) * unit, abs(y[i, j]) * unit)
        if fifth > 0.0:
            allowed = (tolerances.rtol if j == 0 else tolerances.rtol_sensitivity) * scale
            error = max(error, h * fifth * fifth / np.sqrt(fifth * fifth + 0.01 * third * third) / allowed)
    return error


@njit
def step(stepper: Stepper, y: np.ndarray, h: float) -> float:
    """One step of length ``h`` from ``y``, whose rates are the first stage; returns the scaled error."""
    k, out = stepper.stages, stepper.end
    size, columns = y.shape
    for s in range(1, STAGES):
        for i in range(size):
            for j in range(columns):
                total = 0.0
                for r in range(s):
                    total += A[s, r] * k[r, i, j]
                out[i, j] = y[i, j] + h * total
        rates(stepper.system, stepper.side, out, k[s])
    error = _scaled_error(stepper, y, h)
    rates(stepper.system, stepper.side, out, stepper.end_rates)
    relative_motion(stepper.system, out, stepper.end_rates, stepper.end_motion)
    return error


@njit
def gap_of(system: CompiledSystem, side: np.ndarray, c: int, s: int) -> tuple[float, float]:
    """(sign, offset) of the gap sign w - offset of contact ``c`` on side ``s``, whose rise through zero changes it."""
    clearance = system.contacts[c].clearance
    return (float(s), clearance) if side[c] == 0 else (-float(s), -clearance)


@njit
def first_change(stepper: Stepper, h: float) -> Change:
    """The first change of a contact in the step of length ``h``."""
    system, side = stepper.system, stepper.side
    gap = np.empty(6)
    change = Change(1.0, NONE, -1, 0)
    for c in range(side.size):
        for s in (-1, 1):
            if side[c] == 0 or side[c] == s:
                sign, offset = gap_of(system, side, c, s)
                hermite(stepper.start_motion[c], stepper.end_motion[c], h, sign, offset, gap)
                share, outcome = first_rise(gap)
                if outcome != NONE and share < change.share:
                    change = Change(share, outcome, c, s)
    return change


@njit
def begin_landing(stepper: Stepper, change: Change, h: float) -> Landing:
    """The first attempt at a change that was found in a step of length ``h``."""
    sign, offset = gap_of(stepper.system, stepper.side, change.contact, change.side)
    return Landing(sign, offset, change.outcome == EXTREMUM, 0.0, h, change.share * h, 0)


@njit
def _land(stepper: Stepper, y: np.ndarray, t: float, h: float, change: Change) -> tuple[float, bool]:
    """Repeat the step of length ``h`` at time ``t`` so that it ends on a change: its length, whether it is one."""
    landing = begin_landing(stepper, change, h)
    for _ in range(MOST_ATTEMPTS):
        length = landing.length
        step(stepper, y, length)
        floor = 1e-15 * h if landing.extremum else 1e-16 * (t + h)
        landing, outcome = correct(landing, stepper.end_motion[change.contact], floor)
        if outcome != NONE:
            break
    return length, outcome != EXTREMUM


@njit
def flow(
    system: CompiledSystem, tolerances: Tolerances, y: np.ndarray, duration: float, events: np.ndarray
) -> tuple[int, int, float, int]:
    """Advance ``y`` (2n, 1 + m) in place over ``duration`` seconds.

    Returns the outcome (DONE, STUCK or FULL), the number of ``events`` (capacity, 4) filled with time, contact, side
    and kind (1 onset, -1 separation), the seconds with a contact closed, and the steps taken.
    """
    stepper = create_stepper(system, tolerances, y.shape[1])
    side = stepper.side
    closed_sides(system, y, side)
    t, closed, count, steps = 0.0, 0.0, 0, 0
    largest = 1.0 / tolerances.omega_ref
    h = min(0.1 * largest, duration)
    while t < duration:
        rates(system, side, y, stepper.stages[0])
        relative_motion(system, y, stepper.stages[0], stepper.start_motion)
        last = t + h >= duration * (1.0 - 1e-15)
        if last:
            h = duration - t
        elif h < SMALLEST_STEP * duration:
            return STUCK, count, closed, steps
        error = step(stepper, y, h)
        steps += 1
        if not error < 1.0:
            h *= max(0.2, 0.9 * error ** (-0.125)) if error < 1e300 else 0.1
            continue
        grown = min(largest, h * min(6.0, 0.9 * max(error, 1e-12) ** (-0.125)))
        change = first_change(stepper, h)
        changed = False
        if change.outcome != NONE:
            h, changed = _land(stepper, y, t, h, change)
        y[:] = stepper.end
        closed += h if np.any(side != 0) else 0.0
        t = duration if last and change.outcome == NONE else t + h
        h = grown
        if changed:
            if count >= events.shape[0]:
                return FULL, count, closed, steps
            onset = side[change.contact] == 0
            events[count, 0], events[count, 1] = t, change.contact
            events[count, 2], events[count, 3] = change.side, 1 if onset else -1
            side[change.contact] = change.side if onset else 0
            count += 1
    return DONE, count, closed, steps
