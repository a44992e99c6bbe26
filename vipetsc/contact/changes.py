"""Compiled search of a step for the first change of a site's mode, and the extremes of a contact within the step.

A site's motion is (w, w', w''), w = u_resonator - u_host, in rows of arrays (sites, 3). Every change is an upcrossing
of one of two switching functions of the site's mode, each affine in w or in w':

- free: w - D and -w - D, an onset on either side;
- closed: D - side w, the separation, and with clipping -g (the force would turn into a pull);
- clipped: D - side w, and g.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.compiled import allocating, kernel
from vipetsc.contact.law import CLIPPED, CLOSED, FREE, PERMANENT, contact_force, gap_of
from vipetsc.contact.search import bernstein, evaluate, first_upcrossing, first_upcrossing_after_start

# A site has landed on its clearance when |side w - D| is within this share of D (of its ``scale``).
LANDED_W = 1e-10
# ... and on g = 0 when |g| is within this.
LANDED_G = 1e-9

_INTERVALS = 8
_GOLDEN = 0.6180339887498949


class Switching(NamedTuple):
    """A switching function at one time: value, rate in 1/s, tolerance of a landing, mode to which it leads."""

    value: float
    rate: float
    tolerance: float
    mode: int


class Change(NamedTuple):
    """The first change in a step: its ``share`` of the step (2 if there is none), the site, the switching function."""

    share: float
    site: int
    function: int


class Extremes(NamedTuple):
    """Of a contact in a step: largest indentation in m, largest and smallest force in N, positive when it pushes."""

    indentation: float
    force: float
    smallest_force: float


@kernel
def _affine_form(contacts: np.ndarray, i: int, function: int) -> tuple[int, float, float, float, int]:
    """Order k, factor, offset of a switching function ``factor`` d^k w/dt^k + ``offset``; its tolerance and mode.

    The offset is -inf where the site's mode has no such function.
    """
    site = contacts[i]
    tolerance = LANDED_W * site.scale
    if site.mode == FREE:
        side = 1 - 2 * function
        return 0, float(side), -gap_of(site, side), tolerance, side * CLOSED
    if abs(site.mode) == PERMANENT:
        return 1, 0.0, -np.inf, 0.0, site.mode
    side = 1 if site.mode > 0 else -1
    if function == 0:
        return 0, float(-side), gap_of(site, side), tolerance, FREE
    if not site.clip:
        return 1, 0.0, -np.inf, 0.0, site.mode
    clipped = abs(site.mode) == CLIPPED
    sign = 1.0 if clipped else -1.0
    factor = sign * (site.damping / site.approach)
    return 1, factor, sign, LANDED_G, side * (CLOSED if clipped else CLIPPED)


@kernel
def switching(contacts: np.ndarray, i: int, function: int, motion: np.ndarray) -> Switching:
    """Switching function 0 or 1 of site ``i`` at ``motion`` (3,); the value is -inf if it does not apply."""
    order, factor, offset, tolerance, mode = _affine_form(contacts, i, function)
    return Switching(factor * motion[order] + offset, factor * motion[order + 1], tolerance, mode)


@kernel
def first_change(contacts: np.ndarray, start: np.ndarray, end: np.ndarray, h: float, room: np.ndarray) -> Change:
    """The first change of any site's mode in the step of ``h`` seconds from motion ``start`` to ``end`` (sites, 3).

    ``room`` (2, 6) is overwritten.
    """
    first, b, c = Change(2.0, -1, 0), room[0], room[1]
    for i in range(contacts.size):
        site = contacts[i]
        if abs(site.mode) == PERMANENT:
            continue
        bernstein(start[i], end[i], h, b)
        room_plus, room_minus = site.clearance - LANDED_W * site.scale, site.clearance_minus - LANDED_W * site.scale
        within = site.mode == FREE
        for w in b:
            within &= -room_minus < w < room_plus
        if within:
            continue
        for function in range(2):
            order, factor, offset, tolerance, _ = _affine_form(contacts, i, function)
            if offset == -np.inf:
                continue
            for k in range(6 - order):
                c[k] = factor * b[k] + offset if order == 0 else factor * 5.0 * (b[k + 1] - b[k]) / h + offset
            share = first_upcrossing_after_start(c[: 6 - order], tolerance)
            if share < first.share:
                first = Change(share, i, function)
    return first


@kernel
def _push(contacts: np.ndarray, i: int, b: np.ndarray, d: np.ndarray, s: float, room: np.ndarray) -> float:
    """Contact force in N at share ``s`` of a step with the Bernstein forms ``b`` of w and ``d`` of w'."""
    force, _ = contact_force(contacts, i, evaluate(b, s, room), evaluate(d, s, room))
    return force if contacts[i].mode > 0 else -force


@allocating
def extremes(contacts: np.ndarray, i: int, start: np.ndarray, end: np.ndarray, h: float) -> Extremes:
    """Extremes of site ``i`` in a step of ``h`` seconds between the motions ``start`` and ``end`` (sites, 3)."""
    b, room = np.empty(6), np.empty(6)
    bernstein(start[i], end[i], h, b)
    d = 5.0 * (b[1:] - b[:5]) / h
    site = contacts[i]
    side = 1.0 if site.mode > 0 else -1.0
    deepest = max(side * b[0], side * b[5])
    recoil = side * (b[:5] - b[1:])
    if recoil[0] < 0.0:
        turn = first_upcrossing(recoil)
        if turn <= 1.0:
            deepest = max(deepest, side * evaluate(b, turn, room))
    largest = smallest = _push(contacts, i, b, d, 0.0, room)
    best = 0.0
    for k in range(1, _INTERVALS + 1):
        force = _push(contacts, i, b, d, k / _INTERVALS, room)
        smallest = min(smallest, force)
        if force > largest:
            largest, best = force, k / _INTERVALS
    # Golden section around the largest of the samples.
    low, high = max(best - 1.0 / _INTERVALS, 0.0), min(best + 1.0 / _INTERVALS, 1.0)
    for _ in range(24):
        left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        if _push(contacts, i, b, d, left, room) > _push(contacts, i, b, d, right, room):
            high = right
        else:
            low = left
    largest = max(largest, _push(contacts, i, b, d, 0.5 * (low + high), room))
    return Extremes(deepest - gap_of(site, side), largest, smallest)
