"""Compiled loops of the lattice: right-hand side, energies, and one mass's acceleration.

All loops read one block of 8-byte words, seen as integers ``q`` (sizes, indices, contact modes) and as floats
``p`` (stiffnesses, masses, clearances). ``q[0:HEADER]`` holds sizes and the offsets of the tables behind it,
so that a single pointer carries everything through PETSc's callback.

A cell's sums run over its springs in the cell's order, whichever rank owns it and wherever in the loop it
falls: the result does not depend on the partition, to the last bit.
"""

from __future__ import annotations

import numpy as np

from vipetsc.compiled import njit

# Words of the header: sizes and indices, then where each table starts.
CELLS, DOFS, SPRINGS, SITES, WORK, DISSIPATED, DRIVEN, LEFT_GHOST, RIGHT_GHOST = range(9)
LEFT_FREE, RIGHT_FREE, HOST, RESONATOR, HERTZ, CLIP = range(9, 15)
WORDS, OWNED, GHOSTED, EXCHANGE, SLOT = range(15, 20)
FIRST, OFFSET, OTHER, SPRING_START, SPRING_END, SPRING_NEXT, SITE_CELL, SITE_MODE = range(20, 28)
STIFFNESS, INVERSE_MASS, SPRING_STIFFNESS, CLEARANCE, APPROACH, DRIVE, CONTACT = range(28, 35)
HEADER = 35

# Contact modes of a site: the sign is the side.
FREE, CONTACT_MODE, CLIPPED = 0, 1, 2

# Energies count in whole numbers up to the largest; added to floats of at most 2^51, _WHOLE rounds to whole numbers.
_LARGEST = 2.0**50
_WHOLE = 2.0**52 + 2.0**51
_WHOLE_BITS = int(np.float64(_WHOLE).view(np.int64))

# Cells in one pass: what a pass touches stays in the first-level cache.
CHUNK = 512

_options = {"cache": True, "error_model": "numpy", "boundscheck": False}


@njit("f8(f8, f8[::1], i8[::1])", **_options)
def drive_force(t, p, q):
    """Force in N of the tone burst at time t, Eq. (3)."""
    d = q[DRIVE]
    if t <= 0.0 or t >= p[d + 3]:
        return 0.0
    phase = p[d + 1] * t
    return p[d] * (1.0 - np.cos(phase / p[d + 2])) * np.sin(phase)


@njit("f8(f8[::1], i8[::1], i8, i8, i8)", **_options)
def displacement(y, q, cell, offset, mass):
    """Displacement of ``mass`` in the cell ``offset`` (-1, 0, 1) from owned ``cell``; zero in a wall."""
    n = q[CELLS]
    c = cell + offset
    if c < 0:
        return y[q[LEFT_GHOST] + mass] if q[LEFT_GHOST] >= 0 else 0.0
    if c >= n:
        return y[q[RIGHT_GHOST] + mass] if q[RIGHT_GHOST] >= 0 else 0.0
    return y[mass * n + c]


@njit("f8(f8[::1], i8[::1], f8[::1], i8, i8)", **_options)
def spring_acceleration(y, q, p, cell, mass):
    """Acceleration of one mass by its springs; the same sums as the chunked loop, bit for bit."""
    n = q[CELLS]
    own = y[mass * n + cell]
    total = 0.0
    for s in range(q[q[FIRST] + mass], q[q[FIRST] + mass + 1]):
        offset = q[q[OFFSET] + s]
        c = cell + offset
        if (c < 0 and q[LEFT_FREE] == 1) or (c >= n and q[RIGHT_FREE] == 1):
            continue
        total += p[q[STIFFNESS] + s] * (displacement(y, q, cell, offset, q[q[OTHER] + s]) - own)
    return total * p[q[INVERSE_MASS] + mass]


@njit("UniTuple(f8, 2)(i8[::1], f8[::1], i8, f8, f8)", **_options)
def contact_force(q, p, site, w, rate):
    """Contact force on the host in N and dissipated power in W of a site in its present mode.

    Inside a step the mode is frozen: the law is continued as an odd function through x = 0, so that no kink
    lies within a step.
    """
    mode = q[q[SITE_MODE] + site]
    if mode == FREE:
        return 0.0, 0.0
    side = 1.0 if mode > 0 else -1.0
    x = side * w - p[q[CLEARANCE] + site]
    elastic = x * np.sqrt(abs(x)) if q[HERTZ] == 1 else x
    elastic *= p[q[CONTACT]]
    g = 0.0
    if abs(mode) != CLIPPED:
        g = 1.0 + p[q[CONTACT] + 1] * rate / p[q[APPROACH] + site]
    return side * elastic * g, side * elastic * (g - 1.0) * rate


@njit("UniTuple(f8, 3)(f8, f8[::1], i8[::1], f8[::1], i8)", **_options)
def relative_motion(t, y, q, p, site):
    """w, w' and w'' of a site, w = u_resonator - u_host."""
    n, d = q[CELLS], q[DOFS]
    cell, host, resonator = q[q[SITE_CELL] + site], q[HOST], q[RESONATOR]
    w = y[resonator * n + cell] - y[host * n + cell]
    rate = y[(d + resonator) * n + cell] - y[(d + host) * n + cell]
    force, _ = contact_force(q, p, site, w, rate)
    at_host = spring_acceleration(y, q, p, cell, host) + force * p[q[INVERSE_MASS] + host]
    at_resonator = spring_acceleration(y, q, p, cell, resonator) - force * p[q[INVERSE_MASS] + resonator]
    if q[DRIVEN] == (d + host) * n + cell:
        at_host += drive_force(t, p, q) * p[q[INVERSE_MASS] + host]
    if q[DRIVEN] == (d + resonator) * n + cell:
        at_resonator += drive_force(t, p, q) * p[q[INVERSE_MASS] + resonator]
    return w, rate, at_resonator - at_host


@njit("void(f8[::1], f8[::1], f8[::1], f8)", **_options)
def _stretch(out, other, own, stiffness):
    for i in range(out.size):
        out[i] += stiffness * (other[i] - own[i])


@njit("void(f8, f8[::1], f8[::1], i8[::1], f8[::1])", **_options)
def right_hand_side(t, y, f, q, p):
    """Time derivative ``f`` of the owned state ``y`` (ghosts behind it): velocities, accelerations, powers."""
    n, d = q[CELLS], q[DOFS]
    f[: d * n] = y[d * n : 2 * d * n]
    for mass in range(d):
        acceleration = f[(d + mass) * n : (d + mass + 1) * n]
        own = y[mass * n : (mass + 1) * n]
        inverse_mass = p[q[INVERSE_MASS] + mass]
        first, last = q[q[FIRST] + mass], q[q[FIRST] + mass + 1]
        for a in range(1, n - 1, CHUNK):
            b = min(a + CHUNK, n - 1)
            out = acceleration[a:b]
            out[:] = 0.0
            for s in range(first, last):
                other, offset = q[q[OTHER] + s] * n, q[q[OFFSET] + s]
                _stretch(out, y[other + a + offset : other + b + offset], own[a:b], p[q[STIFFNESS] + s])
            for i in range(out.size):
                out[i] *= inverse_mass
        if n > 0:
            acceleration[0] = spring_acceleration(y, q, p, 0, mass)
        if n > 1:
            acceleration[n - 1] = spring_acceleration(y, q, p, n - 1, mass)
    host, resonator = q[HOST], q[RESONATOR]
    for site in range(q[SITES]):
        power = 0.0
        if q[q[SITE_MODE] + site] != FREE:
            cell = q[q[SITE_CELL] + site]
            w = y[resonator * n + cell] - y[host * n + cell]
            rate = y[(d + resonator) * n + cell] - y[(d + host) * n + cell]
            force, power = contact_force(q, p, site, w, rate)
            f[(d + host) * n + cell] += force * p[q[INVERSE_MASS] + host]
            f[(d + resonator) * n + cell] -= force * p[q[INVERSE_MASS] + resonator]
        f[q[DISSIPATED] + site] = power
    driven = q[DRIVEN]
    if driven >= 0:
        force = drive_force(t, p, q)
        f[driven] += force * p[q[INVERSE_MASS] + driven // n - d]
        f[q[WORK]] = force * y[driven]


@njit("void(i8[::1], i8, f8, f8)", **_options)
def _add_exactly(sums, at, value, unit):
    coarse = np.rint(value / unit)
    if not abs(coarse) < _LARGEST:
        coarse = _LARGEST  # not finite or far beyond the scale: the guard sees a runaway energy
        value = coarse * unit
    sums[at] += np.int64(coarse)
    sums[at + 1] += np.int64(np.rint((value - coarse * unit) / unit * 2.0**40))


@njit("void(f8[::1], i8[::1], f8, i8[::1])", **_options)
def add_dissipated(y, q, unit, sums):
    """Add the owned sites' dissipated energies to ``sums[6:8]``, as ``add_energies`` does."""
    for site in range(q[SITES]):
        _add_exactly(sums, 6, y[q[DISSIPATED] + site], unit)


@njit("void(f8[::1], f8[::1], f8)", **_options)
def _add_kinetic(out, v, inverse_mass):
    for i in range(out.size):
        out[i] += 0.5 * v[i] * v[i] / inverse_mass


@njit("void(f8[::1], f8[::1], f8[::1], f8)", **_options)
def _add_spring(out, end, start, stiffness):
    for i in range(out.size):
        stretch = end[i] - start[i]
        out[i] += 0.5 * stiffness * stretch * stretch


@njit("void(f8[::1], f8[::1], f8[::1], f8)", **_options)
def _as_multiples(values, coarse, fine, unit):
    """Whole numbers of ``unit`` in ``values``, at most 2^50, and of unit/2^40 in the rest, both plus ``_WHOLE``.

    A float near 2^52 + 2^51 has units of one: adding it leaves whole numbers in the lowest bits.
    """
    for i in range(values.size):
        value = values[i]
        whole = np.rint(value * (1.0 / unit))
        fits = abs(whole) < _LARGEST  # not finite or far beyond the scale: the guard sees a runaway energy
        whole = whole if fits else _LARGEST
        coarse[i] = whole + _WHOLE
        fine[i] = (np.rint((value * (1.0 / unit) - whole) * 2.0**40) if fits else 0.0) + _WHOLE


@njit("void(f8[::1], f8[::1], f8[::1], f8, i8[::1], i8)", **_options)
def _add_all_exactly(values, coarse, fine, unit, sums, at):
    _as_multiples(values, coarse, fine, unit)
    for part in range(2):
        bits = (coarse if part == 0 else fine).view(np.int64)
        total = 0
        for i in range(values.size):
            total += bits[i] - _WHOLE_BITS
        sums[at + part] += total


@njit("UniTuple(f8, 2)(f8[::1], i8[::1], f8[::1], i8)", **_options)
def _cell_energies(y, q, p, cell):
    """Kinetic and spring energy of one cell, its springs to the next cell and a wall on its left included."""
    n, d = q[CELLS], q[DOFS]
    kinetic = spring = 0.0
    for mass in range(d):
        v = y[(d + mass) * n + cell]
        kinetic += 0.5 * v * v / p[q[INVERSE_MASS] + mass]
    for s in range(q[SPRINGS]):
        start, end = q[q[SPRING_START] + s], q[q[SPRING_END] + s]
        k, next_cell = p[q[SPRING_STIFFNESS] + s], q[q[SPRING_NEXT] + s]
        if not (next_cell == 1 and cell == n - 1 and q[RIGHT_FREE] == 1):
            stretch = displacement(y, q, cell, next_cell, end) - y[start * n + cell]
            spring += 0.5 * k * stretch * stretch
        if next_cell == 1 and cell == 0 and q[LEFT_GHOST] < 0 and q[LEFT_FREE] == 0:
            spring += 0.5 * k * y[end * n] * y[end * n]
    return kinetic, spring


@njit("void(f8[::1], i8[::1], f8[::1], f8, i8[::1])", **_options)
def add_energies(y, q, p, unit, sums):
    """Add this rank's kinetic, spring and contact energy to ``sums`` (2 integers each, in units of J).

    Each cell's energy goes in as a multiple of ``unit`` and the rest as one of unit/2^40: integer sums do not
    depend on the order or on the partition.
    """
    n, d = q[CELLS], q[DOFS]
    kinetic, spring, coarse, fine = np.empty(CHUNK), np.empty(CHUNK), np.empty(CHUNK), np.empty(CHUNK)
    for a in range(0, n, CHUNK):
        b = min(a + CHUNK, n)
        held, stretched = kinetic[: b - a], spring[: b - a]
        held[:] = 0.0
        stretched[:] = 0.0
        for mass in range(d):
            _add_kinetic(held, y[(d + mass) * n + a : (d + mass) * n + b], p[q[INVERSE_MASS] + mass])
        for s in range(q[SPRINGS]):
            start, end, ahead = q[q[SPRING_START] + s] * n, q[q[SPRING_END] + s] * n, q[q[SPRING_NEXT] + s]
            last = min(b, n - ahead)
            _add_spring(stretched[: last - a], y[end + a + ahead : end + last + ahead], y[start + a : start + last],
                        p[q[SPRING_STIFFNESS] + s])  # fmt: skip
        for cell in (0, n - 1):
            if a <= cell < b:
                held[cell - a], stretched[cell - a] = _cell_energies(y, q, p, cell)
        _add_all_exactly(held, coarse[: b - a], fine[: b - a], unit, sums, 0)
        _add_all_exactly(stretched, coarse[: b - a], fine[: b - a], unit, sums, 2)
    host, resonator = q[HOST], q[RESONATOR]
    for site in range(q[SITES]):
        cell = q[q[SITE_CELL] + site]
        x = abs(y[resonator * n + cell] - y[host * n + cell]) - p[q[CLEARANCE] + site]
        if x > 0.0:
            kc = p[q[CONTACT]]
            energy = kc * x * x * np.sqrt(x) / 2.5 if q[HERTZ] == 1 else 0.5 * kc * x * x
            _add_exactly(sums, 4, energy, unit)


@njit("void(f8[::1], i8[::1], f8[::1], f8, f8[::1])", **_options)
def measure(y, q, p, unit, total):
    """Kinetic, spring, contact and dissipated energy of this rank into ``total`` (2 whole numbers each), and its work.

    Carrying leaves every number below 2^53: their sums over ranks, as floats, are exact.
    """
    sums = np.zeros(8, np.int64)
    add_energies(y, q, p, unit, sums)
    add_dissipated(y, q, unit, sums)
    for i in range(4):
        carried = sums[2 * i + 1] >> 40
        total[2 * i] = sums[2 * i] + carried
        total[2 * i + 1] = sums[2 * i + 1] - (carried << 40)
    total[8] = y[q[WORK]] if q[WORK] >= 0 else 0.0
