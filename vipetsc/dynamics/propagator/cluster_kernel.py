"""Compiled parts of the march of a cluster of contact sites through one linear step.

Members are the sites (relative displacement w) and, where it is in reach, the driven mass (its displacement).
Each carries a jet: the Taylor series in s = t/H of the motion it would have if no force acted from now on. A
force on member l adds to member i the integral of G(s - x) f_l(x), G(u) = sum gamma_m u^(2m+1).

While nothing acts, jets are exact. Otherwise forces are collocated at Gauss nodes of a substep.
"""

from __future__ import annotations

import numpy as np
from scipy.special import binom

from vipetsc.compiled import njit
from vipetsc.contact.contact_kernel import LANDED
from vipetsc.dynamics.propagator.collocation import NODES
from vipetsc.dynamics.propagator.series import MOST_TERMS
from vipetsc.dynamics.ts.kernel import (
    APPROACH,
    CLEARANCE,
    FREE,
    SITE_MODE,
    SITES,
    contact_force,
    drive_force,
)

# Words of the clock: time at the step's begin, H, place s, next substep, end of the drive (s), longest substep.
BEGIN, INTERVAL, PLACE, SUBSTEP, DRIVE_END, LONGEST, RTOL, ATOL, TOP = range(9)
ROUNDING = 1e-15  # a share of a step that is none
MOST_SWEEPS = 60
BINOMIALS = binom(*np.ogrid[: 2 * MOST_TERMS, : 2 * MOST_TERMS])
# Share of the estimated error (interpolation of the force) that the end of a substep is left with.
SUPERCONVERGENCE = 0.02

_options = {"cache": True, "error_model": "numpy", "boundscheck": False}


@njit("void(f8[::1], f8)", **_options)
def shift(jet, s):
    """Expand a series about s instead of 0."""
    for k in range(jet.size - 1):
        for i in range(jet.size - 2, k - 1, -1):
            jet[i] += s * jet[i + 1]


@njit("UniTuple(f8, 2)(f8[::1], f8)", **_options)
def _at(jet, s):
    """Value and slope of a series."""
    value = slope = 0.0
    for k in range(jet.size - 1, -1, -1):
        slope = slope * s + value
        value = value * s + jet[k]
    return value, slope


@njit("f8(f8[::1], f8, f8)", **_options)
def first_onset(jet, clearance, length):
    """First s in [0, length] at which |w| comes within rounding of the clearance and grows; 2 if none does.

    |w''| has a bound over the whole length, so that a parabola bounds |w| from above: up to where that meets the
    clearance nothing can have happened.
    """
    bound = bend = 0.0
    scale = 1.0
    for k in range(jet.size):
        bound += abs(jet[k]) * scale
        if k >= 2:
            bend += k * (k - 1) * abs(jet[k]) * scale / (length * length)
        scale *= length
    tolerance = LANDED * clearance
    if bound < clearance - tolerance:
        return 2.0
    first = 2.0
    for side in (1.0, -1.0):
        s = 0.0
        while s <= length:
            w, rate = _at(jet, s)
            gap, closing = clearance - side * w, side * rate
            if gap < 0.5 * tolerance and closing > 0.0:
                polish = gap / closing
                first = min(first, max(s + polish, 0.0) if bend * polish * polish < tolerance else s)
                break
            gap += tolerance
            root = np.sqrt(max(closing * closing + 2.0 * bend * gap, 0.0))
            # The root of bend/2 d^2 + closing d = gap, without cancellation.
            step = 2.0 * gap / (closing + root) if closing > 0.0 else (root - closing) / bend
            s += max(step, ROUNDING)
    return first


@njit("void(i8[::1], f8[::1], f8[::1], b1, f8[:, ::1], f8[:, :, ::1], f8[:, ::1])", **_options)
def motion(q, p, clock, driven, jets, gamma, motion):
    """w, w', w'' of every site from its jet and the forces that act, at the clock's place."""
    sites, h = q[SITES], clock[INTERVAL]
    forces = np.zeros(jets.shape[0])
    for i in range(sites):
        motion[i, 0], motion[i, 1] = jets[i, 0], jets[i, 1] / h
        if q[q[SITE_MODE] + i] != FREE:
            forces[i] = -contact_force(q, p, i, motion[i, 0], motion[i, 1])[0]
    if driven:
        forces[sites] = drive_force(clock[BEGIN] + clock[PLACE] * h, p, q)
    for i in range(sites):
        acceleration = 2.0 * jets[i, 2]
        for j in range(forces.size):
            acceleration += gamma[i, j, 0] * forces[j]
        motion[i, 2] = acceleration / (h * h)


@njit(
    "b1(i8[::1], f8[::1], f8[::1], i8, f8, f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, :, ::1], i8[::1],"
    " f8[:, ::1], f8[:, ::1], f8[:, ::1])",
    **_options,
)
def collocate(q, p, clock, kind, length, jets, gamma, share, powers, active, f, w, v):
    """Forces ``f`` and motion ``w``, ``v`` (member, node) of the active members in a substep; whether it converged."""
    sites, h, n = q[SITES], clock[INTERVAL], active.size
    terms = gamma.shape[2]
    free_w, free_v = np.empty((n, NODES)), np.empty((n, NODES))
    for a in range(n):
        for j in range(NODES):
            at = length * share[kind, j]
            free_w[a, j], slope = _at(jets[active[a]], at)
            free_v[a, j] = slope / h
            if active[a] == sites:
                f[sites, j] = drive_force(clock[BEGIN] + (clock[PLACE] + at) * h, p, q)
    to_w, to_v = np.zeros((n, n, NODES, NODES)), np.zeros((n, n, NODES, NODES))
    near = np.zeros((n, n), np.bool_)
    for a in range(n):
        for b in range(n):
            power, size = length, 1.0
            for m in range(terms):
                g = gamma[active[a], active[b], m]
                if g != 0.0:
                    near[a, b] = True
                    by_w, by_v = g * power * length, g * power * (2 * m + 1) / h
                    for k in range(NODES):
                        for j in range(NODES):
                            to_w[a, b, k, j] += by_w * powers[kind, 2 * m + 1, k, j]
                            to_v[a, b, k, j] += by_v * powers[kind, 2 * m, k, j]
                power *= length * length
                size *= (clock[TOP] * length) ** 2 / ((2 * m + 2) * (2 * m + 3))
                if size < 1e-18:
                    break
    last = np.inf
    x, y = np.empty(NODES), np.empty(NODES)
    for _ in range(MOST_SWEEPS):
        change = 0.0
        for a in range(n):
            i = active[a]
            x[:] = free_w[a]
            y[:] = free_v[a]
            for b in range(n):
                if near[a, b]:
                    for k in range(NODES):
                        force = f[active[b], k]
                        for j in range(NODES):
                            x[j] += to_w[a, b, k, j] * force
                            y[j] += to_v[a, b, k, j] * force
            for j in range(NODES):
                if not abs(x[j]) + abs(y[j]) < np.inf:
                    f[:sites] = 0.0
                    return False
                if i < sites:
                    # Changes count against the clearance and against the approach.
                    change = max(change, abs(x[j] - w[i, j]) / p[q[CLEARANCE] + i])
                    change = max(change, abs(y[j] - v[i, j]) / (abs(y[j]) + abs(p[q[APPROACH] + i])))
                w[i, j], v[i, j] = x[j], y[j]
        if change < 1e-15 or (change < 1e-13 and change >= last):
            return True
        last = change
        for a in range(n):
            i = active[a]
            if i < sites:
                for j in range(NODES):
                    f[i, j] = -contact_force(q, p, i, w[i, j], v[i, j])[0]
    f[:sites] = 0.0
    return False


@njit("void(i8, f8, f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1])", **_options)
def renew(kind, length, jets, gamma, share, weight, active, f, trial):
    """Jets of all members at the end of a substep in which the forces ``f`` acted."""
    members, terms = jets.shape[0], gamma.shape[2]
    # All members' series at once: the loops over them are the contiguous ones.
    turned = np.empty((2 * terms, members))
    for k in range(2 * terms):
        for i in range(members):
            turned[k, i] = jets[i, k]
    for k in range(2 * terms - 1):
        for i in range(2 * terms - 2, k - 1, -1):
            for j in range(members):
                turned[i, j] += length * turned[i + 1, j]
    for k in range(2 * terms):
        for i in range(members):
            trial[i, k] = turned[k, i]
    moments, series = np.empty(2 * terms), np.empty((terms, 2 * terms))
    for a in range(active.size):
        source = active[a]
        moments[:] = 0.0
        for j in range(NODES):
            amount, lag = length * weight[kind, j] * f[source, j], length * (1.0 - share[kind, j])
            for k in range(2 * terms):
                moments[k] += amount
                amount *= lag
        for m in range(terms):
            for k in range(2 * m + 2):
                series[m, k] = BINOMIALS[2 * m + 1, k] * moments[2 * m + 1 - k]
        for i in range(members):
            for m in range(terms):
                g = gamma[i, source, m]
                if g != 0.0:
                    for k in range(2 * m + 2):
                        trial[i, k] += g * series[m, k]


@njit("f8(i8[::1], f8[::1], f8[::1], f8, f8[:, :, ::1], f8[:, ::1], i8[::1], f8[:, ::1])", **_options)
def error(q, p, clock, length, gamma, tail, active, f):
    """Estimated error of a substep over the allowed one: the forces' last two Legendre coefficients."""
    worst = 0.0
    for a in range(active.size):
        i = active[a]
        if i >= q[SITES]:
            continue
        left = 0.0
        for row in range(2):
            coefficient = 0.0
            for j in range(NODES):
                coefficient += tail[row, j] * f[i, j]
            left += abs(coefficient)
        allowed = clock[RTOL] * abs(p[q[APPROACH] + i]) + clock[ATOL]
        worst = max(worst, SUPERCONVERGENCE * left * length * gamma[i, i, 0] / clock[INTERVAL] / allowed)
    return worst


@njit(
    "void(i8[::1], f8[::1], f8[::1], i8, f8, f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1],"
    " f8[:, ::1], f8[::1])",
    **_options,
)
def book(q, p, clock, kind, length, share, weight, active, f, w, v, moments, energy):
    """Add a substep's forces to the moments about the end of the step, and its work and losses to ``energy``."""
    sites, h = q[SITES], clock[INTERVAL]
    for a in range(active.size):
        i = active[a]
        for j in range(NODES):
            duration = h * length * weight[kind, j]
            power = f[i, j] * v[i, j]
            if i < sites:
                power = contact_force(q, p, i, w[i, j], v[i, j])[1]
            energy[i] += duration * power
            left = 1.0 - clock[PLACE] - length * share[kind, j]
            amount = duration * f[i, j]
            for k in range(moments.shape[1]):
                moments[i, k] += amount
                amount *= left
