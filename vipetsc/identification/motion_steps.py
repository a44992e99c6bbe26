"""Compiled motion of a lattice from an initial state together with its derivatives with respect to parameters.

The method is the Runge-Kutta pair of order 8(5,3) of Dormand and Prince (Hairer, Norsett and Wanner 1993, sec. II.10).
Steps end on every sample, on every kink of a drive and on every change of a contact's mode: inside a step all
right-hand sides are smooth.
"""

import numpy as np

from vipetsc.compiled import kernel, njit
from vipetsc.contact.changes import first_change, shortest_impact, switching
from vipetsc.contact.law import FREE, side_of
from vipetsc.contact.search import LANDED, RETRY, SEARCH, Landing, correct, shorten
from vipetsc.contact.tracker import Tracks, switch_sites, with_room
from vipetsc.dynamics.drives import select_piece
from vipetsc.identification.motion_rates import Lattice, MotionState, difference, jerk, observe, rates_of
from vipetsc.modes.shooting.dop853_step import E3, E5, STAGES, A, B

# None of the numbers of steps below is sharp. For two sites in 12 cells at 400 N, with derivatives by the clearance and
# the restitution (166 contacts with Hertz's law, 441 with the bilinear one), each was halved and doubled, SAFETY set
# to 0.8 and 0.95: CPU time changes by 9 % at most. The error against a tolerance of 1e-13 stays 7e-11 to 2e-9 of the
# motion and 2e-7 to 4e-6 of the derivatives; with the bilinear law, whose impacts amplify errors more, 8e-6 to 3e-5 and
# .8 to 3 %.
# A step is at most one radian of the fastest mode, and this fraction of the duration of an impact in contact.
OF_IMPACT = 0.25
# Longest step after a change of mode, as a fraction of the impact: Hertz's force begins as the power 3/2 of the
# indentation, so that its derivatives are largest there.
AFTER_ONSET = 0.01
# First step, in radians of the fastest mode, a twentieth of the longest one. Errors decide from there on.
FIRST_STEP = 0.05
# The fraction of the step that would just be allowed that is tried, and bounds of its shrinking and growth. Errors
# below the smallest one count as that one, for which the bound of growth holds already.
SAFETY = 0.9
LEAST_FACTOR = 0.2
MOST_FACTOR = 6.0
SMALLEST_ERROR = 1e-12
# Shrinking of a step whose error overflows, of which no power can be taken.
OVERFLOW_FACTOR = 0.1
# Shortest step, as a fraction of the largest time, whose rounding is 1e-16. The integration is stuck below it.
SMALLEST_STEP = 1e-14
# Landings go on to this fraction of their tolerance, which is 1e-10 of the clearance: to about the rounding of w.
LANDING_GOAL = 1e-4
# Longest step, in radians of the fastest mode, that is taken without a search: none of its motions turns in so short a
# time.
BLIND = 1e-7
# Outcomes: all samples are reached, or the step became too small.
DONE, STUCK = range(2)


@kernel
def _scaled_error(motion: MotionState, n: int, omega: float, h: float) -> float:
    """The largest error of a column over what is allowed, in a step of ``h`` s; infinite if it overflowed.

    With the estimates e5 and e3 of orders 5 and 3 the error of a column is h e5^2/(e5^2 + 0.01 e3^2)^(1/2) (Hairer,
    Norsett and Wanner, eq. II.10.17), here in the largest norm over its rows. ``n`` is the number of masses, ``omega``
    the highest frequency in rad/s, which makes displacements of velocities.
    """
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
            allowed = motion.tolerances[min(j, 1)] * scale
            error = max(error, h * fifth * fifth / np.sqrt(fifth * fifth + 0.01 * third * third) / allowed)
    return error


@kernel
def _step(lattice: Lattice, motion: MotionState, t: float, h: float, omega: float) -> float:
    """One step of length ``h`` from the state, whose rates are the first stage; returns the scaled error."""
    rows, columns = motion.state.shape
    size = rows * columns
    state = motion.state.reshape(size)
    end = motion.end.reshape(size)
    stages = motion.stages.reshape(STAGES, size)
    # Stage by stage, and as the last one the end of the step itself, with the weights B.
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
            rates_of(lattice, t + fraction * h, motion.end, motion.approach, motion.stages[s])
    error = _scaled_error(motion, rows // 2, omega, h)
    rates_of(lattice, t + h, motion.end, motion.approach, motion.rates)
    observe(lattice, motion.end, motion.rates, motion.after)
    return error


@kernel
def _land(lattice: Lattice, motion: MotionState, t: float, h: float, omega: float) -> tuple[float, bool]:
    """Repeat a step of ``h`` s, just tried from ``t`` on, so that it ends on its first change of a mode.

    Returns the length in s of the step as it was tried last, and whether it ends on a change. The length is 0 if the
    change is at the beginning of the step.
    """
    change = first_change(lattice.contacts, motion.before, motion.after, h, motion.room)
    if change.position > 1.0:
        return h, False

    landing = Landing(length=change.position * h, longest=h, residual=np.inf, attempts=0)
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
        elif outcome != RETRY:
            return landing.length, outcome == LANDED


@njit(error_model="numpy")
def _switch(lattice: Lattice, motion: MotionState, tracks: Tracks, t: float) -> Tracks:
    """Switch every site that has landed at ``t`` in s, and set the derivatives of w'_minus of those that close.

    With the onset at side w - D = 0 the instant moves by -(dw - side dD)/w', and w'_minus by dw' + w'' times that.
    Returns ``tracks``, with as much room in the log as was needed.
    """
    n = lattice.inverse_mass.size
    contacts = lattice.contacts
    modes = contacts["mode"].copy()
    tracks = with_room(tracks)
    # No ledger is kept: losses are those of nothing.
    switch_sites(contacts, tracks, motion.before, np.zeros(contacts.size), t)
    for i in range(contacts.size):
        if modes[i] != FREE or contacts[i].mode == FREE:
            continue
        side = side_of(contacts[i].mode)
        which = 0 if contacts[i].mode > 0 else 1
        rate = motion.before[i, 1]
        for j in range(1, motion.state.shape[1]):
            moved = difference(motion.state, lattice.ends, i, 0, j) - side * lattice.slopes.gaps[j - 1, i, which]
            change = difference(motion.state, lattice.ends, i, n, j) - motion.before[i, 2] * moved / rate
            # Below the floor w'_minus is held and does not vary.
            motion.approach[i, j] = 0.0 if abs(rate) < contacts[i].floor else change
    return tracks


@kernel
def _sample(lattice: Lattice, motion: MotionState, t: float, watched: np.ndarray, out: np.ndarray) -> None:
    """Put u, u', u'' of the masses ``watched`` into ``out`` (watched, 4, column); row 3 has the jerk in column 0."""
    n = lattice.inverse_mass.size
    for k in range(watched.size):
        i = watched[k]
        for j in range(motion.state.shape[1]):
            out[k, 0, j] = motion.state[i, j]
            out[k, 1, j] = motion.state[n + i, j]
            out[k, 2, j] = motion.stages[0, n + i, j]
        out[k, 3, 0] = jerk(lattice, motion, t, i)


@kernel
def _refresh(lattice: Lattice, motion: MotionState, t: float) -> None:
    """Evaluate the rates of the state, and the motion of the sites, at time t in s."""
    rates_of(lattice, t, motion.state, motion.approach, motion.stages[0])
    observe(lattice, motion.state, motion.stages[0], motion.before)


@kernel
def _accept(motion: MotionState, omega: float) -> None:
    """Take the end of a step as the state, and update the largest values; ``omega`` as in ``_scaled_error``."""
    rows, columns = motion.state.shape
    for i in range(rows):
        unit = 1.0 if 2 * i < rows else 1.0 / omega
        for j in range(columns):
            motion.state[i, j] = motion.end[i, j]
            motion.largest[j] = max(motion.largest[j], abs(motion.state[i, j]) * unit)


@kernel
def _select_pieces(lattice: Lattice, breaks: np.ndarray, t: float) -> None:
    """Turn on the pieces of drives that begin by the time ``t`` in s; ``breaks`` (drive,) in s are when the next begin.

    A drive is a sequence of smooth pieces. A time within rounding of a break is on it.
    """
    for d in range(breaks.size):
        if t >= breaks[d] * (1.0 - 1e-14):
            breaks[d] = select_piece(lattice.drives, d, t * (1.0 + 1e-14))


@kernel
def _length_to(left: float, h: float) -> float:
    """A step of at most ``h`` s towards a time that is ``left`` s away; the last two steps have the same length."""
    if h >= left * (1.0 - 1e-12):
        return left
    # A full step would leave less than another one, perhaps a tiny remainder.
    if h > 0.5 * left:
        return 0.5 * left
    return h


@njit(error_model="numpy")
def integrate(
    lattice: Lattice,
    motion: MotionState,
    tracks: Tracks,
    omega: float,
    begin: float,
    times: np.ndarray,
    watched: np.ndarray,
) -> tuple[int, Tracks, np.ndarray, np.ndarray]:
    """Go from the time ``begin`` in s through the rising ``times`` (sample,) in s; those before ``begin`` have zeros.

    ``omega`` in rad/s is the fastest mode's frequency, or a bound of it; ``watched`` (watched mass,) are the masses
    that are sampled. Returns the outcome, DONE or STUCK, the log of contacts, samples (sample, watched mass, 4, column)
    as ``_sample`` puts them, and the largest w and -w (site, 2) in m at ends of steps, at least 0.
    """
    out = np.zeros((times.size, watched.size, 4, motion.state.shape[1]))
    reached = np.zeros((lattice.contacts.size, 2))
    # Before t = 0 all drives are off, and t = 0 is a break.
    breaks = np.zeros(lattice.drives.rows.size)
    _select_pieces(lattice, breaks, begin)
    t = begin
    longest = max(abs(begin), abs(times[-1]))
    h = FIRST_STEP / omega
    _refresh(lattice, motion, t)

    sample = 0
    while sample < times.size:
        if times[sample] <= t:
            if times[sample] >= begin:
                _sample(lattice, motion, t, watched, out[sample])
            sample += 1
            continue

        # The length of the step: towards the next sample or break, within all bounds.
        target = times[sample]
        for instant in breaks:
            if t < instant < target:
                target = instant
        wanted = min(h, 1.0 / omega, OF_IMPACT * shortest_impact(lattice.contacts))
        left = target - t
        h = _length_to(left, wanted)
        if h < SMALLEST_STEP * longest and h < left:
            return STUCK, tracks, out, reached

        # An error of the power 8 of h. One that is no number is not less than 1.
        error = _step(lattice, motion, t, h, omega)
        if not error < 1.0:
            factor = OVERFLOW_FACTOR
            if error < 1e300:
                factor = max(LEAST_FACTOR, SAFETY * error ** (-0.125))
            h *= factor
            continue

        grown = h * min(MOST_FACTOR, SAFETY * max(error, SMALLEST_ERROR) ** (-0.125))
        length, landed = _land(lattice, motion, t, h, omega)
        if length == 0.0 and not landed:
            # The search found a root at the very beginning of the step, but nothing changes there: the motion has just
            # landed on it. A step that is too short for another change leads past it.
            length = min(h, BLIND / omega)
            _step(lattice, motion, t, length, omega)

        if length > 0.0:
            _accept(motion, omega)
            t = target if length == left else t + length
        # A step that was short only because it ended on a sample or a break does not shorten the next one.
        h = max(grown, wanted) if h == left else grown
        _select_pieces(lattice, breaks, t)
        _refresh(lattice, motion, t)
        for i in range(reached.shape[0]):
            reached[i, 0] = max(reached[i, 0], motion.before[i, 0])
            reached[i, 1] = max(reached[i, 1], -motion.before[i, 0])
        if landed:
            tracks = _switch(lattice, motion, tracks, t)
            h = min(h, AFTER_ONSET * shortest_impact(lattice.contacts))
            _refresh(lattice, motion, t)
    return DONE, tracks, out, reached
