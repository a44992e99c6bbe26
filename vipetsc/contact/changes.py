"""Compiled search of a step for the first change of a site's mode, and the extremes of a contact within the step.

A site's motion is (w, w', w''), w = u_resonator - u_host, in rows of arrays (sites, 3). Every change is an upcrossing
of one of two switching functions of the site's mode, each affine in w or in w':

- free: w - D and -w - D, an onset on either side;
- closed: D - side w, the separation, and with clipping -g (the force would turn into a pull);
- clipped: D - side w, and g;
- resting: D - side w and side w - D, both less a distance far beyond the tolerance of a landing.
"""

from typing import Any, NamedTuple

import numpy as np

from vipetsc.compiled import allocating, kernel
from vipetsc.contact.law import CLIPPED, CLOSED, FREE, PERMANENT, RESTING, contact_force, gap_of, resting_side, side_of
from vipetsc.contact.search import bernstein, evaluate, first_upcrossing, first_upcrossing_after_start

# A site has landed on its clearance when |side w - D| is within this fraction of D (of its ``scale``).
LANDED_W = 1e-10
# ... and on g = 0 when |g| is within this.
LANDED_G = 1e-9
# A site at rest in contact has opened or closed when it is this fraction of its scale away from D: the many landings
# by which it came to rest are over, and it lands at D again.
MOVED_W = 100 * LANDED_W

# The largest force in a step is sampled at the ends of so many intervals, then narrowed by golden sections.
_INTERVALS = 8
_GOLDEN = 0.6180339887498949
_SECTIONS = 24


class AffineForm(NamedTuple):
    """A switching function ``factor`` d^k w/dt^k + ``offset`` with k = ``order``, 0 or 1.

    ``tolerance`` is that of a landing, ``mode`` the one it leads to. The offset is -inf where the site's mode has no
    such function: it never crosses zero.
    """

    order: int
    factor: float
    offset: float
    tolerance: float
    mode: int


class Switching(NamedTuple):
    """A switching function at one time: value, rate in 1/s, tolerance of a landing, mode to which it leads."""

    value: float
    rate: float
    tolerance: float
    mode: int


class ModeChange(NamedTuple):
    """The first change in a step: its ``position`` in the step, from 0 to 1 (2 if there is none), site and function."""

    position: float
    site: int
    function: int


class Extremes(NamedTuple):
    """Extremes of a contact in a step: indentation in m, largest and smallest force in N, positive when it pushes."""

    indentation: float
    force: float
    smallest_force: float


@kernel
def _affine_form(contacts: np.ndarray, i: int, function: int) -> AffineForm:
    """Switching function 0 or 1 of site ``i`` in its mode."""
    site = contacts[i]
    tolerance = LANDED_W * site.scale
    if site.mode == FREE:
        side = 1 - 2 * function
        return AffineForm(0, float(side), -gap_of(site, side), tolerance, side * CLOSED)
    side = side_of(site.mode)
    if abs(site.mode) == PERMANENT:
        # Its force has a kink at D, where the masses meet (function 0) or part.
        rises = 1 - 2 * function
        near = MOVED_W * site.scale
        return AffineForm(0, float(rises * side), -rises * gap_of(site, side), near, site.mode)

    if abs(site.mode) == RESTING:
        # Not on D itself: there the many landings would begin again by which the site came to rest.
        moved = MOVED_W * site.scale
        if function == 0:
            return AffineForm(0, float(-side), gap_of(site, side) - moved, tolerance, FREE)
        return AffineForm(0, float(side), -gap_of(site, side) - moved, tolerance, side * CLOSED)
    if function == 0:
        return AffineForm(0, float(-side), gap_of(site, side), tolerance, FREE)
    if not site.clip:
        return AffineForm(1, 0.0, -np.inf, 0.0, site.mode)

    # g = 1 + c w'/w'_minus falls through zero where clipping begins, and rises through it where it ends.
    slope = site.damping / site.approach
    if abs(site.mode) == CLIPPED:
        return AffineForm(1, slope, 1.0, LANDED_G, side * CLOSED)
    return AffineForm(1, -slope, -1.0, LANDED_G, side * CLIPPED)


@kernel
def switching(contacts: np.ndarray, i: int, function: int, motion: np.ndarray) -> Switching:
    """Switching function 0 or 1 of site ``i`` at ``motion`` (3,); the value is -inf if it does not apply."""
    form = _affine_form(contacts, i, function)
    value = form.factor * motion[form.order] + form.offset
    rate = form.factor * motion[form.order + 1]
    return Switching(value, rate, form.tolerance, form.mode)


@kernel
def _stays_free(site: Any, b: np.ndarray) -> bool:
    """Whether a free site is within both clearances all through a step with the Bernstein form ``b`` of w."""
    if site.mode != FREE:
        return False
    plus = site.clearance - LANDED_W * site.scale
    minus = site.clearance_minus - LANDED_W * site.scale
    within = True
    for w in b:
        within &= -minus < w < plus
    return within


@kernel
def stays_landed(site: Any, start: np.ndarray, end: np.ndarray, h: float, b: np.ndarray) -> bool:
    """Whether a site that can rest stays within the tolerance of a landing in the step from ``start`` to ``end`` (3,).

    ``b`` (6,) is overwritten.
    """
    if resting_side(site) == 0:
        return False
    bernstein(start, end, h, b)
    stays = True
    for w in b:
        stays &= abs(w) <= LANDED_W * site.scale
    return stays


@kernel
def _passes_kink(site: Any, b: np.ndarray) -> bool:
    """Whether a permanent ``site`` may open or close in a step with the Bernstein form ``b`` of w, before its end."""
    side = side_of(site.mode)
    gap = gap_of(site, side)
    near = MOVED_W * site.scale
    lowest = np.inf
    highest = -np.inf
    for w in b:
        lowest = min(lowest, side * w - gap)
        highest = max(highest, side * w - gap)
    # A step that ends on the kink has it not inside; near the kink the force is no force.
    return highest > near and lowest < 0.0 and abs(side * b[5] - gap) > near


@kernel
def _next_kink(site: Any, motion: np.ndarray) -> int:
    """The switching function of a permanent ``site`` that crosses zero next.

    It is 0 where the masses will meet and 1 where they will part. ``motion`` (3,) are w, w', w''; on the kink itself
    the direction decides.
    """
    side = side_of(site.mode)
    depth = side * motion[0] - gap_of(site, side)
    near = MOVED_W * site.scale
    if depth > near or (depth >= -near and side * motion[1] > 0.0):
        return 1
    return 0


@kernel
def first_change(
    contacts: np.ndarray, start: np.ndarray, end: np.ndarray, h: float, room: np.ndarray, kinks: bool = False
) -> ModeChange:
    """The first change of any site's mode in the step of ``h`` seconds from motion ``start`` to ``end`` (sites, 3).

    With ``kinks`` also where a permanent contact opens or closes, which changes no mode. ``room`` (2, 6) is
    overwritten.
    """
    first = ModeChange(2.0, -1, 0)
    b = room[0]
    c = room[1]
    for i in range(contacts.size):
        permanent = abs(contacts[i].mode) == PERMANENT
        if permanent and not kinks:
            continue
        bernstein(start[i], end[i], h, b)
        if permanent and not _passes_kink(contacts[i], b):
            continue
        # The coefficients bound the motion: nearly all free sites are done here, without a search.
        if _stays_free(contacts[i], b):
            continue

        for function in range(2):
            if permanent and function != _next_kink(contacts[i], start[i]):
                continue
            form = _affine_form(contacts, i, function)
            if form.offset == -np.inf:
                continue
            for k in range(6 - form.order):
                if form.order == 0:
                    c[k] = form.factor * b[k] + form.offset
                else:
                    c[k] = form.factor * 5.0 * (b[k + 1] - b[k]) / h + form.offset
            position = first_upcrossing_after_start(c[: 6 - form.order], form.tolerance)
            # Strictly: of changes at one time the first site's is landed on, and the others land with it.
            if position < first.position:
                first = ModeChange(position, i, function)
    return first


@kernel
def _push(contacts: np.ndarray, i: int, b: np.ndarray, d: np.ndarray, s: float, room: np.ndarray) -> float:
    """Contact force in N at position ``s`` in a step with the Bernstein forms ``b`` of w and ``d`` of w'."""
    force, _ = contact_force(contacts, i, evaluate(b, s, room), evaluate(d, s, room))
    return side_of(contacts[i].mode) * force


@allocating
def extremes(contacts: np.ndarray, i: int, start: np.ndarray, end: np.ndarray, h: float) -> Extremes:
    """Extremes of site ``i`` in a step of ``h`` seconds between the motions ``start`` and ``end`` (sites, 3)."""
    b = np.empty(6)
    room = np.empty(6)
    bernstein(start[i], end[i], h, b)
    d = np.empty(5)
    for k in range(5):
        d[k] = 5.0 * (b[k + 1] - b[k]) / h
    side = side_of(contacts[i].mode)

    # Deepest at an end, or where side w' falls through zero inside.
    deepest = max(side * b[0], side * b[5])
    recoil = np.empty(5)
    for k in range(5):
        recoil[k] = side * (b[k] - b[k + 1])
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
            largest = force
            best = k / _INTERVALS

    # Golden sections between the neighbours of the largest sample.
    low = max(best - 1.0 / _INTERVALS, 0.0)
    high = min(best + 1.0 / _INTERVALS, 1.0)
    for _ in range(_SECTIONS):
        left = high - _GOLDEN * (high - low)
        right = low + _GOLDEN * (high - low)
        if _push(contacts, i, b, d, left, room) > _push(contacts, i, b, d, right, room):
            high = right
        else:
            low = left
    largest = max(largest, _push(contacts, i, b, d, 0.5 * (low + high), room))
    return Extremes(deepest - gap_of(contacts[i], side), largest, smallest)
