"""The compiled flow: Dormand and Prince's 8(5,3) pair between contact changes, landing on every change.

The set of active contacts is frozen inside a step, so the force is smooth there. After each step the gap of
every contact is searched on its quintic Hermite interpolant, interior extrema included, so that a pair of
changes inside one step is found; the step is then repeated so that it ends exactly on the first change. Contact
forces are continuous, hence so are the variational equations' solutions (saltation is the identity).

Coefficients: Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, code DOP853.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate._ivp import dop853_coefficients as pair

from vipetsc.compiled import njit
from vipetsc.modes.interpolant import first_upcrossing, hermite

_A = np.ascontiguousarray(pair.A[:12, :12])
_B = np.ascontiguousarray(pair.B)
_E3 = np.ascontiguousarray(pair.E3[:12])
_E5 = np.ascontiguousarray(pair.E5[:12])

SMALLEST_STEP = 1e-15
"""A step below this fraction of the interval means that the flow is stuck."""


@njit("void(f8[:,::1], f8[:,::1], f8[::1], f8, f8)", cache=True)
def _add(y, dy, row, force, slope):
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


@njit("void(f8[:,::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], i8[::1])", cache=True)
def rates(y, dy, inverse_mass, stiffness, rows, law, spring_rows, springs, side):
    """Time derivative of state and variations for a frozen contact set.

    ``y`` (2n, 1 + m): displacements over velocities; column 0 the orbit, the others variations. ``rows``
    (contacts, n), ``law`` (contacts, 3) = clearance, stiffness, exponent; ``springs`` (springs, 2) =
    quadratic, cubic; ``side`` (contacts,) is -1, 0 or 1.
    """
    n, columns = y.shape[0] // 2, y.shape[1]
    for i in range(n):
        for j in range(columns):
            dy[i, j] = y[n + i, j]
            dy[n + i, j] = 0.0
        for k in range(n):
            s = stiffness[i, k]
            if s != 0.0:
                for j in range(columns):
                    dy[n + i, j] -= s * y[k, j]
    for c in range(rows.shape[0]):
        if side[c] != 0:
            w = 0.0
            for k in range(n):
                w += rows[c, k] * y[k, 0]
            x = side[c] * w - law[c, 0]
            if law[c, 2] == 1.0:
                force, slope = law[c, 1] * x, law[c, 1]
            else:  # odd continuation past the exit, which is landed on anyway
                size = abs(x)
                slope = law[c, 1] * law[c, 2] * size ** (law[c, 2] - 1.0)
                force = slope * x / law[c, 2]
            _add(y, dy, rows[c], side[c] * force, slope)
    for c in range(spring_rows.shape[0]):
        z = 0.0
        for k in range(n):
            z += spring_rows[c, k] * y[k, 0]
        _add(
            y, dy, spring_rows[c],
            (springs[c, 0] + springs[c, 1] * z) * z * z,
            (2.0 * springs[c, 0] + 3.0 * springs[c, 1] * z) * z,
        )  # fmt: skip
    for i in range(n):
        for j in range(columns):
            dy[n + i, j] *= inverse_mass[i]


@njit(
    "f8(f8[:,::1], f8[:,::1], f8[:,:,::1], f8, f8, f8, f8, f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1],"
    "f8[:,::1], i8[::1])",
    cache=True,
)
def _step(y, out, k, h, rtol, loose, pace, inverse_mass, stiffness, rows, law, spring_rows, springs, side):
    """One step of length ``h`` from ``y`` (whose rates are in k[0]) to ``out``; returns the scaled error."""
    size, columns = y.shape
    for s in range(1, 12):
        for i in range(size):
            for j in range(columns):
                total = 0.0
                for r in range(s):
                    total += _A[s, r] * k[r, i, j]
                out[i, j] = y[i, j] + h * total
        rates(out, k[s], inverse_mass, stiffness, rows, law, spring_rows, springs, side)
    n = size // 2
    error = 0.0
    for j in range(columns):
        fifth, third, scale = 0.0, 0.0, 0.0
        for i in range(size):
            total, e5, e3 = 0.0, 0.0, 0.0
            for r in range(12):
                total += _B[r] * k[r, i, j]
                e5 += _E5[r] * k[r, i, j]
                e3 += _E3[r] * k[r, i, j]
            out[i, j] = y[i, j] + h * total
            unit = 1.0 if i < n else 1.0 / pace  # velocities count as displacements over a radian
            fifth = max(fifth, abs(e5) * unit)
            third = max(third, abs(e3) * unit)
            scale = max(scale, abs(out[i, j]) * unit, abs(y[i, j]) * unit)
        if fifth > 0.0:
            tolerance = rtol if j == 0 else loose
            error = max(error, h * fifth * fifth / np.sqrt(fifth * fifth + 0.01 * third * third) / (tolerance * scale))
    return error


@njit("void(f8[:,::1], f8[:,::1], f8[::1], f8[::1])", cache=True)
def _relative(y, dy, row, out):
    """Relative displacement w, its rate and its acceleration into ``out`` (3,)."""
    n = y.shape[0] // 2
    out[:] = 0.0
    for i in range(n):
        out[0] += row[i] * y[i, 0]
        out[1] += row[i] * y[n + i, 0]
        out[2] += row[i] * dy[n + i, 0]


@njit(
    "Tuple((i8, i8, f8, i8))(f8[:,::1], f8, f8, f8, f8, f8, f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1],"
    "f8[:,::1], f8[:,::1])",
    cache=True,
)
def flow(y, duration, rtol, loose, pace, reach, inverse_mass, stiffness, rows, law, spring_rows, springs, events):
    """Advance ``y`` (2n, 1 + m) in place over ``duration`` seconds.

    Parameters
    ----------
    rtol, loose
        Error allowed per step, relative to each column's size: of the orbit, and of the variations.
    pace
        Frequency in rad/s that makes velocities comparable to displacements.
    reach
        Frequency in rad/s that bounds the step: at most one radian of it, so that interpolation resolves w.
    events
        (capacity, 4), filled with time, contact, side and kind (1 onset, -1 separation).

    Returns
    -------
    status, events, closed, steps
        status 0 done, 1 step too small, 2 more events than fit; number of events; seconds with any contact
        closed; steps taken.
    """
    size, columns = y.shape
    contacts = rows.shape[0]
    k = np.empty((12, size, columns))
    out, dy = np.empty((size, columns)), np.empty((size, columns))
    a, b, c = np.empty((contacts, 3)), np.empty(3), np.empty(6)
    side = np.zeros(contacts, np.int64)
    for i in range(contacts):
        w = 0.0
        for j in range(size // 2):
            w += rows[i, j] * y[j, 0]
        side[i] = 1 if w > law[i, 0] else (-1 if w < -law[i, 0] else 0)
    t, closed, count, steps = 0.0, 0.0, 0, 0
    largest = 1.0 / reach
    h = min(0.1 * largest, duration)
    while t < duration:
        rates(y, k[0], inverse_mass, stiffness, rows, law, spring_rows, springs, side)
        for i in range(contacts):
            _relative(y, k[0], rows[i], a[i])
        last = t + h >= duration * (1.0 - 1e-15)
        if last:
            h = duration - t
        if h < SMALLEST_STEP * duration and not last:
            return 1, count, closed, steps
        error = _step(y, out, k, h, rtol, loose, pace, inverse_mass, stiffness, rows, law, spring_rows, springs, side)
        steps += 1
        if not error < 1.0:
            h *= max(0.2, 0.9 * error ** (-0.125)) if error < 1e300 else 0.1
            continue
        grown = min(largest, h * min(6.0, 0.9 * max(error, 1e-12) ** (-0.125)))
        rates(out, dy, inverse_mass, stiffness, rows, law, spring_rows, springs, side)
        place, verdict, which, sense = 1.0, 0, -1, 0
        for i in range(contacts):
            _relative(out, dy, rows[i], b)
            for s in (-1, 1):
                if side[i] == 0:  # the gap s w - D must not rise through zero
                    hermite(a[i], b, h, float(s), law[i, 0], c)
                elif side[i] == s:  # the indentation must not fall through zero
                    hermite(a[i], b, h, -float(s), -law[i, 0], c)
                else:
                    continue
                # a contact that changed a moment ago sits on zero and moves away from it
                x, found = first_upcrossing(c)
                if found > 0 and x < place:
                    place, verdict, which, sense = x, found, i, s
        if verdict == 0:
            y[:] = out
            if np.any(side != 0):
                closed += h
            t = duration if last else t + h
            h = grown
            continue
        # repeat the step so that it ends on the extremum, or on the change
        sign = float(sense) if side[which] == 0 else -float(sense)
        offset = law[which, 0] if side[which] == 0 else -law[which, 0]
        low, high, target = 0.0, h, place * h
        if verdict == 2:
            for _ in range(40):
                _step(
                    y, out, k, target, rtol, loose, pace, inverse_mass, stiffness, rows, law, spring_rows, springs, side
                )
                rates(out, dy, inverse_mass, stiffness, rows, law, spring_rows, springs, side)
                _relative(out, dy, rows[which], b)
                if sign * b[1] > 0.0:
                    low = target
                else:
                    high = target
                shift = -b[1] / b[2] if b[2] != 0.0 else 0.0
                if abs(shift) <= 1e-15 * h:
                    break
                trial = target + shift
                target = trial if low < trial < high else 0.5 * (low + high)
            if sign * b[0] - offset <= 0.0:  # only a near miss: the step may end here
                y[:] = out
                if np.any(side != 0):
                    closed += target
                t += target
                h = grown
                continue
            low, high, target = 0.0, target, 0.5 * target
        else:
            high = h
        for _ in range(80):
            _step(y, out, k, target, rtol, loose, pace, inverse_mass, stiffness, rows, law, spring_rows, springs, side)
            _relative(out, dy, rows[which], b)
            g = sign * b[0] - offset
            if g > 0.0:
                high = min(high, target)
            else:
                low = max(low, target)
            rate = sign * b[1]
            shift = -g / rate if rate > 0.0 else h
            if abs(shift) <= 1e-16 * (t + h) or high - low <= 1e-16 * (t + h):
                break
            trial = target + shift
            target = trial if low < trial < high else 0.5 * (low + high)
        y[:] = out
        if np.any(side != 0):
            closed += target
        t += target
        if count >= events.shape[0]:
            return 2, count, closed, steps
        kind = 1 if side[which] == 0 else -1
        events[count, 0], events[count, 1], events[count, 2], events[count, 3] = t, which, sense, kind
        count += 1
        side[which] = sense if kind == 1 else 0
        h = min(grown, largest)
    return 0, count, closed, steps
