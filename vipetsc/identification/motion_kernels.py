"""Compiled motion of a lattice from rest together with its derivatives with respect to parameters.

The equations are in the docstring of the package. Runge and Kutta's method is Dormand and Prince's pair of order 8(5,3)
(Hairer, Norsett and Wanner 1993, sec. II.10), whose steps end on every sample, on every kink of a drive and on every
change of a contact's mode: inside a step all right-hand sides are smooth.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.compiled import kernel, njit
from vipetsc.contact.changes import first_change, switching
from vipetsc.contact.law import CLIPPED, FREE, elastic_force_and_slope, gap_of
from vipetsc.contact.search import LANDED, SEARCH, Landing, correct, shorten
from vipetsc.contact.tracker import Tracks, shortest_impact, switch_sites, with_room
from vipetsc.dynamics.drives import Drives, drive_force, select_piece
from vipetsc.modes.shooting.dop853 import E3, E5, STAGES, A, B

# Errors allowed per step, relative to the largest motion and the largest derivative so far.
RTOL = 1e-11
RTOL_DERIVATIVE = 1e-8
# A step is at most one radian of the fastest mode, and this fraction of the duration of an impact in contact.
OF_IMPACT = 0.25
# First step after an onset, as a fraction of the impact: Hertz's force begins as a power 3/2.
AFTER_ONSET = 0.01
SAFETY = 0.9
LEAST_FACTOR = 0.2
MOST_FACTOR = 6.0
SMALLEST_ERROR = 1e-12
SMALLEST_STEP = 1e-14
LANDING_GOAL = 1e-4
# Fraction of a period over which the rate of a drive's force is differenced.
SHORT = 1e-6

# Outcomes: all samples are reached, or the step became too small.
DONE, STUCK = range(2)


class Slopes(NamedTuple):
    """Derivatives of the lattice's coefficients with respect to each parameter.

    ``masses`` (parameter, n), ``stiffness`` and ``damping`` (parameter, entry); ``gaps`` (parameter, site, 2) on the
    sides + and -; ``laws`` (parameter, site, 3) of the contact stiffness, the exponent and the damping c; ``drives``
    (parameter, drive), relative to the drive's amplitude. ``linear`` (parameter,): whether a mass, a spring or a
    dashpot depends on it.
    """

    masses: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    gaps: np.ndarray
    laws: np.ndarray
    drives: np.ndarray
    linear: np.ndarray


class Lattice(NamedTuple):
    """A lattice: its rows of K and C have the entries ``first[i]`` to ``first[i + 1]`` in ``columns`` (entry,).

    ``ends`` (site, 2): host, -1 for the ground, and resonator of the ``contacts`` (site,) of dtype ``SITE``; the
    ``target`` of each row of ``drives`` is a mass.
    """

    inverse_mass: np.ndarray
    first: np.ndarray
    columns: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    contacts: np.ndarray
    ends: np.ndarray
    drives: Drives
    slopes: Slopes


class Motion(NamedTuple):
    """State and workspace. Column 0 is the motion, column 1 + p its derivative with respect to parameter p.

    ``state`` and ``end`` (2n, column), ``stages`` (stage, 2n, column), ``rates`` (2n, column) at the end; ``estimates``
    (2, 2n, column) are those of errors, ``approach`` (site, column) derivatives of w'_minus; ``before`` and ``after``
    (site, 3) hold w, w', w'' at both ends of a step, ``largest`` (column,) the largest values so far.
    """

    state: np.ndarray
    end: np.ndarray
    stages: np.ndarray
    rates: np.ndarray
    estimates: np.ndarray
    approach: np.ndarray
    before: np.ndarray
    after: np.ndarray
    largest: np.ndarray
    room: np.ndarray


@kernel
def _difference(y: np.ndarray, ends: np.ndarray, i: int, first: int, j: int) -> float:
    """Resonator's less host's entry of column ``j`` of ``y``, from row ``first`` on, of site ``i``."""
    value = y[first + ends[i, 1], j]
    if ends[i, 0] >= 0:
        value -= y[first + ends[i, 0], j]
    return value


@kernel
def _add_contact(lattice: Lattice, i: int, y: np.ndarray, approach: np.ndarray, out: np.ndarray) -> None:
    """Add the force of the closed site ``i`` and its derivatives to ``out`` (2n, column), in the rows of velocities."""
    n = lattice.inverse_mass.size
    site = lattice.contacts[i]
    slopes = lattice.slopes
    side = 1.0 if site.mode > 0 else -1.0
    which = 0 if site.mode > 0 else 1
    w = _difference(y, lattice.ends, i, 0, 0)
    rate = _difference(y, lattice.ends, i, n, 0)
    x = side * w - gap_of(site, side)
    elastic, slope = elastic_force_and_slope(site.elastic, x)
    g = 1.0 + site.damping * rate / site.approach
    by_rate = side * elastic * site.damping / site.approach
    by_approach = -by_rate * rate / site.approach
    # x^n log x vanishes at the onset, before which the law is continued as an odd function.
    by_exponent = elastic * np.log(x) if x > 0.0 else 0.0

    host = lattice.ends[i, 0]
    resonator = lattice.ends[i, 1]
    for j in range(y.shape[1]):
        force = side * elastic * g
        if j > 0:
            force = slope * g * _difference(y, lattice.ends, i, 0, j)
            force += by_rate * _difference(y, lattice.ends, i, n, j)
            force += by_approach * approach[i, j]
            force -= side * slope * g * slopes.gaps[j - 1, i, which]
            force += side * g * elastic / site.elastic.stiffness * slopes.laws[j - 1, i, 0]
            force += side * g * by_exponent * slopes.laws[j - 1, i, 1]
            force += side * elastic * rate / site.approach * slopes.laws[j - 1, i, 2]
        out[n + resonator, j] -= force
        if host >= 0:
            out[n + host, j] += force


@kernel
def _add_springs(lattice: Lattice, y: np.ndarray, out: np.ndarray) -> None:
    """Add the forces of springs and dashpots and their derivatives to ``out``, in the rows of velocities."""
    n = lattice.inverse_mass.size
    slopes = lattice.slopes
    for i in range(n):
        for e in range(lattice.first[i], lattice.first[i + 1]):
            c = lattice.columns[e]
            stiffness = lattice.stiffness[e]
            damping = lattice.damping[e]
            for j in range(y.shape[1]):
                out[n + i, j] -= stiffness * y[c, j]
            if damping != 0.0:
                for j in range(y.shape[1]):
                    out[n + i, j] -= damping * y[n + c, j]
            for p in range(slopes.linear.size):
                if slopes.linear[p]:
                    out[n + i, 1 + p] -= slopes.stiffness[p, e] * y[c, 0] + slopes.damping[p, e] * y[n + c, 0]


@kernel
def _rates(lattice: Lattice, t: float, y: np.ndarray, approach: np.ndarray, out: np.ndarray) -> None:
    """Time derivatives ``out`` of the motion and its derivatives in ``y`` (2n, column) at time t in s."""
    n = lattice.inverse_mass.size
    slopes = lattice.slopes
    for i in range(n):
        for j in range(y.shape[1]):
            out[i, j] = y[n + i, j]
            out[n + i, j] = 0.0
    _add_springs(lattice, y, out)

    for d in range(lattice.drives.rows.size):
        force = drive_force(lattice.drives, d, t)
        target = n + lattice.drives.rows[d].target
        out[target, 0] += force
        for p in range(slopes.linear.size):
            out[target, 1 + p] += slopes.drives[p, d] * force
    for i in range(lattice.contacts.size):
        mode = abs(lattice.contacts[i].mode)
        if mode != FREE and mode != CLIPPED:
            _add_contact(lattice, i, y, approach, out)

    for i in range(n):
        for j in range(y.shape[1]):
            out[n + i, j] *= lattice.inverse_mass[i]
        # (M + dM) u'' = f + df: dM times the acceleration acts as a force.
        for p in range(slopes.linear.size):
            if slopes.linear[p]:
                out[n + i, 1 + p] -= slopes.masses[p, i] * lattice.inverse_mass[i] * out[n + i, 0]


@kernel
def _observe(lattice: Lattice, y: np.ndarray, rates: np.ndarray, motion: np.ndarray) -> None:
    """Put w, w' and w'' of every site into ``motion`` (site, 3)."""
    n = lattice.inverse_mass.size
    for i in range(lattice.contacts.size):
        motion[i, 0] = _difference(y, lattice.ends, i, 0, 0)
        motion[i, 1] = _difference(y, lattice.ends, i, n, 0)
        motion[i, 2] = _difference(rates, lattice.ends, i, n, 0)


@kernel
def _scaled_error(motion: Motion, n: int, omega: float, h: float) -> float:
    """The largest error of a column over what is allowed."""
    size = motion.end.size
    stages = motion.stages.reshape(STAGES, size)
    estimates = motion.estimates
    flat = estimates.reshape(2, size)
    for e in range(size):
        flat[0, e] = 0.0
        flat[1, e] = 0.0
    for s in range(STAGES):
        for e in range(size):
            flat[0, e] += E3[s] * stages[s, e]
            flat[1, e] += E5[s] * stages[s, e]

    error = 0.0
    for j in range(motion.state.shape[1]):
        fifth = 0.0
        third = 0.0
        scale = motion.largest[j]
        for i in range(2 * n):
            unit = 1.0 if i < n else 1.0 / omega
            third = max(third, abs(estimates[0, i, j]) * unit)
            fifth = max(fifth, abs(estimates[1, i, j]) * unit)
            scale = max(scale, abs(motion.end[i, j]) * unit)
        if not np.isfinite(fifth + third):
            return np.inf
        if fifth > 0.0:
            allowed = (RTOL if j == 0 else RTOL_DERIVATIVE) * scale
            error = max(error, h * fifth * fifth / np.sqrt(fifth * fifth + 0.01 * third * third) / allowed)
    return error


@kernel
def _step(lattice: Lattice, motion: Motion, t: float, h: float, omega: float) -> float:
    """One step of length ``h`` from the state, whose rates are the first stage; returns the scaled error."""
    rows, columns = motion.state.shape
    size = rows * columns
    state = motion.state.reshape(size)
    end = motion.end.reshape(size)
    stages = motion.stages.reshape(STAGES, size)
    for s in range(1, STAGES + 1):
        weights = A[s] if s < STAGES else B
        fraction = 0.0
        for e in range(size):
            end[e] = state[e]
        for r in range(s):
            weight = h * weights[r]
            fraction += weights[r]
            if weight != 0.0:
                for e in range(size):
                    end[e] += weight * stages[r, e]
        if s < STAGES:
            _rates(lattice, t + fraction * h, motion.end, motion.approach, motion.stages[s])
    error = _scaled_error(motion, rows // 2, omega, h)
    _rates(lattice, t + h, motion.end, motion.approach, motion.rates)
    _observe(lattice, motion.end, motion.rates, motion.after)
    return error


@kernel
def _land(lattice: Lattice, motion: Motion, t: float, h: float, omega: float) -> tuple[float, bool]:
    """Repeat a step that was just tried so that it ends on its first change of a mode: its length, whether it does."""
    change = first_change(lattice.contacts, motion.before, motion.after, h, motion.room)
    if change.position > 1.0:
        return h, False

    landing = Landing(change.position * h, h, np.inf, 0)
    while True:
        if landing.length <= SMALLEST_STEP * h:
            start = switching(lattice.contacts, change.site, change.function, motion.before[change.site])
            return 0.0, start.value > start.tolerance or (start.value >= -start.tolerance and start.rate > 0.0)
        _step(lattice, motion, t, landing.length, omega)
        end = switching(lattice.contacts, change.site, change.function, motion.after[change.site])
        landing, outcome = correct(landing, end.value, end.rate, end.tolerance, LANDING_GOAL * end.tolerance)
        if outcome == SEARCH:
            earlier = first_change(lattice.contacts, motion.before, motion.after, landing.length, motion.room)
            if earlier.position > 1.0:
                return landing.length, False
            change = earlier
            landing = shorten(landing, earlier.position)
        elif outcome != 1:
            return landing.length, outcome == LANDED


@njit(error_model="numpy")
def _switch(lattice: Lattice, motion: Motion, tracks: Tracks, t: float) -> Tracks:
    """Switch every site that has landed, and begin the derivatives of w'_minus of those that close.

    With the onset at side w - D = 0 the instant moves by -(dw - side dD)/w', and w'_minus by dw' + w'' times that.
    """
    n = lattice.inverse_mass.size
    contacts = lattice.contacts
    modes = contacts["mode"].copy()
    tracks = with_room(tracks)
    switch_sites(contacts, tracks, motion.before, np.zeros(contacts.size), t)
    for i in range(contacts.size):
        if modes[i] != FREE or contacts[i].mode == FREE:
            continue
        side = 1.0 if contacts[i].mode > 0 else -1.0
        which = 0 if contacts[i].mode > 0 else 1
        rate = motion.before[i, 1]
        for j in range(1, motion.state.shape[1]):
            moved = _difference(motion.state, lattice.ends, i, 0, j) - side * lattice.slopes.gaps[j - 1, i, which]
            change = _difference(motion.state, lattice.ends, i, n, j) - motion.before[i, 2] * moved / rate
            # Below the floor w'_minus is held and does not vary.
            motion.approach[i, j] = 0.0 if abs(rate) < contacts[i].floor else change
    return tracks


@kernel
def _jerk(lattice: Lattice, motion: Motion, t: float, i: int) -> float:
    """Rate of the acceleration in m/s^3 of mass ``i`` in the state, whose rates are the first stage."""
    n = lattice.inverse_mass.size
    rates = motion.stages[0]
    total = 0.0
    for e in range(lattice.first[i], lattice.first[i + 1]):
        c = lattice.columns[e]
        total -= lattice.stiffness[e] * rates[c, 0] + lattice.damping[e] * rates[n + c, 0]
    for d in range(lattice.drives.rows.size):
        row = lattice.drives.rows[d]
        if row.target == i and row.highest > 0.0:
            short = SHORT / row.highest
            change = drive_force(lattice.drives, d, t + short) - drive_force(lattice.drives, d, t - short)
            total += change / (2.0 * short)
    for c in range(lattice.contacts.size):
        site = lattice.contacts[c]
        is_host = lattice.ends[c, 0] == i
        if not (is_host or lattice.ends[c, 1] == i) or site.mode == FREE or abs(site.mode) == CLIPPED:
            continue
        side = 1.0 if site.mode > 0 else -1.0
        x = side * motion.before[c, 0] - gap_of(site, side)
        elastic, slope = elastic_force_and_slope(site.elastic, x)
        g = 1.0 + site.damping * motion.before[c, 1] / site.approach
        change = slope * g * motion.before[c, 1]
        change += side * elastic * site.damping / site.approach * motion.before[c, 2]
        total += change if is_host else -change
    return total * lattice.inverse_mass[i]


@kernel
def _sample(lattice: Lattice, motion: Motion, t: float, watched: np.ndarray, out: np.ndarray) -> None:
    """Put u, u', u'' of the masses ``watched`` into ``out`` (watched, 4, column); row 3 has the jerk in column 0."""
    n = lattice.inverse_mass.size
    for k in range(watched.size):
        i = watched[k]
        for j in range(motion.state.shape[1]):
            out[k, 0, j] = motion.state[i, j]
            out[k, 1, j] = motion.state[n + i, j]
            out[k, 2, j] = motion.stages[0, n + i, j]
        out[k, 3, 0] = _jerk(lattice, motion, t, i)


@njit(error_model="numpy")
def integrate(
    lattice: Lattice, motion: Motion, tracks: Tracks, omega: float, times: np.ndarray, watched: np.ndarray
) -> tuple[int, Tracks, np.ndarray, np.ndarray]:
    """Go from t = 0 through the rising ``times`` (sample,) in s.

    ``omega`` in rad/s is the fastest mode's. Returns the outcome, the log of contacts, samples (sample, watched, 4,
    column) as ``_sample`` puts them, and the largest |w| (site, 2) in m on the sides + and -, at ends of steps.
    """
    out = np.zeros((times.size, watched.size, 4, motion.state.shape[1]))
    reached = np.zeros((lattice.contacts.size, 2))
    breaks = np.zeros(lattice.drives.rows.size)
    for d in range(breaks.size):
        breaks[d] = select_piece(lattice.drives, d, 0.0)
    t = 0.0
    h = 0.05 / omega
    _rates(lattice, t, motion.state, motion.approach, motion.stages[0])
    _observe(lattice, motion.state, motion.stages[0], motion.before)

    sample = 0
    while sample < times.size:
        # A sample before the beginning is that of rest.
        if times[sample] <= t:
            if times[sample] >= 0.0:
                _sample(lattice, motion, t, watched, out[sample])
            sample += 1
            continue

        target = times[sample]
        for d in range(breaks.size):
            if t < breaks[d] < target:
                target = breaks[d]
        h = min(h, 1.0 / omega, OF_IMPACT * shortest_impact(lattice.contacts))
        # A remainder that would be tiny is avoided by two steps of equal length.
        wanted = h
        left = target - t
        if h >= left * (1.0 - 1e-12):
            h = left
        elif h > 0.5 * left:
            h = 0.5 * left
        if h < SMALLEST_STEP * times[-1] and h < left:
            return STUCK, tracks, out, reached

        error = _step(lattice, motion, t, h, omega)
        if not error < 1.0:
            h *= max(LEAST_FACTOR, SAFETY * error ** (-0.125)) if error < 1e300 else 0.1
            continue
        grown = h * min(MOST_FACTOR, SAFETY * max(error, SMALLEST_ERROR) ** (-0.125))
        whole = h == left
        length, landed = _land(lattice, motion, t, h, omega)
        if length == 0.0 and not landed:
            # A root at the very beginning that does not rise is none: a step so short that no change is missed.
            length = min(h, 1e-7 / omega)
            _step(lattice, motion, t, length, omega)

        if length > 0.0:
            for i in range(motion.state.shape[0]):
                for j in range(motion.state.shape[1]):
                    motion.state[i, j] = motion.end[i, j]
            for j in range(motion.state.shape[1]):
                for i in range(motion.state.shape[0]):
                    unit = 1.0 if 2 * i < motion.state.shape[0] else 1.0 / omega
                    motion.largest[j] = max(motion.largest[j], abs(motion.state[i, j]) * unit)
            t = target if whole and length == h else t + length
        h = max(grown, wanted) if whole else grown
        for d in range(breaks.size):
            if t >= breaks[d] * (1.0 - 1e-14):
                breaks[d] = select_piece(lattice.drives, d, t * (1.0 + 1e-14))
        _rates(lattice, t, motion.state, motion.approach, motion.stages[0])
        _observe(lattice, motion.state, motion.stages[0], motion.before)
        for i in range(reached.shape[0]):
            reached[i, 0] = max(reached[i, 0], motion.before[i, 0])
            reached[i, 1] = max(reached[i, 1], -motion.before[i, 0])
        if landed:
            tracks = _switch(lattice, motion, tracks, t)
            h = min(h, AFTER_ONSET * shortest_impact(lattice.contacts))
            _rates(lattice, t, motion.state, motion.approach, motion.stages[0])
            _observe(lattice, motion.state, motion.stages[0], motion.before)
    return DONE, tracks, out, reached
