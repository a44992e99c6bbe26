"""Compiled search for contact changes inside a step, and the largest indentation and force in it.

A site is free, in contact on one side, or (with adhesion = "clip") in contact but held at zero force. Every
change is the rise of a switching function through zero:

- free: side w - D (onset), one for each side;
- in contact: D - side w (separation), and with clipping -g (the force would turn into a pull);
- clipped: D - side w, and g.
"""

from __future__ import annotations

import numpy as np

from vipetsc.compiled import njit
from vipetsc.contact.search import bernstein, evaluate, first_upcrossing
from vipetsc.dynamics.ts.kernel import (
    APPROACH,
    CLEARANCE,
    CLIP,
    CLIPPED,
    CONTACT,
    CONTACT_MODE,
    FREE,
    SITE_MODE,
    SITES,
    contact_force,
    relative_motion,
)

# A site has landed on its clearance when |side w - D| is within this share of D.
LANDED = 1e-10
# ... and on g = 0 when |g| is within this.
LANDED_G = 1e-9

_options = {"cache": True, "error_model": "numpy"}


@njit("void(f8, f8[::1], i8[::1], f8[::1], f8[:, ::1])", **_options)
def observe(t, y, q, p, motion):
    """w, w', w'' of every owned site into ``motion`` (sites, 3)."""
    for site in range(q[SITES]):
        motion[site, 0], motion[site, 1], motion[site, 2] = relative_motion(t, y, q, p, site)


@njit("void(i8[::1], f8[::1], i8, f8[:, ::1], f8[:, ::1])", **_options)
def switching(q, p, site, motion, values):
    """Switching functions of a site into ``values`` (2, 4): value, rate, landing tolerance, mode it leads to.

    A function that does not apply has value -inf.
    """
    mode = q[q[SITE_MODE] + site]
    clearance = p[q[CLEARANCE] + site]
    w, rate, acceleration = motion[site, 0], motion[site, 1], motion[site, 2]
    if mode == FREE:
        for i in range(2):
            side = 1 - 2 * i
            values[i, 0], values[i, 1] = side * w - clearance, side * rate
            values[i, 2], values[i, 3] = LANDED * clearance, side * CONTACT_MODE
        return
    side = 1 if mode > 0 else -1
    values[0, 0], values[0, 1] = clearance - side * w, -side * rate
    values[0, 2], values[0, 3] = LANDED * clearance, FREE
    values[1, 0], values[1, 1], values[1, 2], values[1, 3] = -np.inf, 0.0, 0.0, mode
    if q[CLIP] == 1:
        slope = p[q[CONTACT] + 1] / p[q[APPROACH] + site]
        sign = 1.0 if abs(mode) == CLIPPED else -1.0
        values[1, 0], values[1, 1] = sign * (1.0 + slope * rate), sign * slope * acceleration
        values[1, 2] = LANDED_G
        values[1, 3] = side * (CONTACT_MODE if abs(mode) == CLIPPED else CLIPPED)


@njit("f8(f8[::1], f8)", **_options)
def _rise(b, tolerance):
    """First rise through zero; a start that has just landed on zero does not count."""
    if abs(b[0]) > tolerance:
        return first_upcrossing(b)
    n = b.size - 1
    q = np.empty(n)
    for i in range(n):
        q[i] = b[i + 1] * n / (i + 1)
    return first_upcrossing(q)


@njit("UniTuple(f8, 3)(i8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8)", **_options)
def first_change(q, p, start, end, h):
    """Share of the step of length h at which an owned site first changes its mode, the site, the function.

    The share is 2 if none does; the function is the row of ``switching``.
    """
    first, which, row = 2.0, -1, 0
    b = np.empty(6)
    c = np.empty(6)
    for site in range(q[SITES]):
        bernstein(start[site], end[site], h, b)
        mode = q[q[SITE_MODE] + site]
        clearance = p[q[CLEARANCE] + site]
        tolerance = LANDED * clearance
        if mode == FREE and b.max() < clearance - tolerance and b.min() > tolerance - clearance:
            continue
        for i in range(2):
            if mode == FREE:
                c[:] = (1 - 2 * i) * b - clearance
                share = _rise(c, tolerance)
            elif i == 0:
                c[:] = clearance - (1.0 if mode > 0 else -1.0) * b
                share = _rise(c, tolerance)
            elif q[CLIP] == 1:
                slope = p[q[CONTACT] + 1] / p[q[APPROACH] + site]
                sign = 1.0 if abs(mode) == CLIPPED else -1.0
                for k in range(5):
                    c[k] = sign * (1.0 + slope * 5.0 * (b[k + 1] - b[k]) / h)
                share = _rise(c[:5], LANDED_G)
            else:
                share = 2.0
            if share < first:
                first, which, row = share, site, i
    return first, float(which), float(row)


@njit("f8(i8[::1], f8[::1], i8, f8[::1], f8, f8)", **_options)
def _pressure(q, p, site, b, h, s):
    """Contact force at share s of a step, positive when it pushes."""
    derivative = np.empty(5)
    for i in range(5):
        derivative[i] = 5.0 * (b[i + 1] - b[i]) / h
    force, _ = contact_force(q, p, site, evaluate(b, s), evaluate(derivative, s))
    return force if q[q[SITE_MODE] + site] > 0 else -force


@njit("UniTuple(f8, 3)(i8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8, i8)", **_options)
def peaks(q, p, start, end, h, site):
    """Largest indentation in m, largest and smallest contact force in N of a site in a step of length h."""
    b = np.empty(6)
    bernstein(start[site], end[site], h, b)
    side = 1.0 if q[q[SITE_MODE] + site] > 0 else -1.0
    deepest = max(side * b[0], side * b[5])
    recoil = np.empty(5)
    for i in range(5):
        recoil[i] = side * (b[i] - b[i + 1])
    if recoil[0] < 0.0:
        turn = first_upcrossing(recoil)
        if turn <= 1.0:
            deepest = max(deepest, side * evaluate(b, turn))
    parts = 8
    strongest = weakest = _pressure(q, p, site, b, h, 0.0)
    best = 0.0
    for i in range(1, parts + 1):
        force = _pressure(q, p, site, b, h, i / parts)
        weakest = min(weakest, force)
        if force > strongest:
            strongest, best = force, i / parts
    a, c = max(best - 1.0 / parts, 0.0), min(best + 1.0 / parts, 1.0)
    golden = 0.6180339887498949
    for _ in range(24):
        left, right = c - golden * (c - a), a + golden * (c - a)
        if _pressure(q, p, site, b, h, left) > _pressure(q, p, site, b, h, right):
            c = right
        else:
            a = left
    strongest = max(strongest, _pressure(q, p, site, b, h, 0.5 * (a + c)))
    return deepest - p[q[CLEARANCE] + site], strongest, weakest
