"""Compiled search of a step for the first change of a site's mode; extremes within the step, shortest contact times.

A site's motion is (w, w', w''), w = u_resonator - u_host, in rows of arrays (sites, 3). Every change is an upcrossing
of one of two switching functions of the site's mode, each affine in w:

- free: w - D and -w - D, an onset on either side;
- closed: D - side w, the separation;
- resting: D - side w and side w - D, both less a distance far beyond the tolerance of a landing;
- unswitched: side w - D and D - side w, where the masses meet and part. The mode stays: only a search for kinks, by an
  engine whose steps end on them, asks for these.

A stuck site does not move: its row of a motion is (R, R', 0), its reaction in N, positive where it pushes, and the rate
of that. It changes where the reaction turns to pull.
"""

from typing import Any, NamedTuple

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.contact.law import (
    CLOSED,
    FREE,
    RESTING,
    SHORTEST_FLIGHT,
    STUCK,
    UNSWITCHED,
    contact_force,
    gap_of,
    impact_time,
    landed_side,
    side_of,
)
from vipetsc.contact.search import bernstein, evaluate, first_upcrossing, first_upcrossing_after_start

# A site at rest in contact has opened or closed when it is so many tolerances away from D. A return to D from there is
# a motion of its own, on which the site may land again.
MOVED = 100.0
# A stuck site is released where its reaction pulls by this fraction of the force that stops it within the
# shortest period, to half of it, so that the
# reaction pulls whatever the error of the landing. Reactions below that are not resolved: they begin as a high power of
# time where a wave begins, of which a cubic makes a pull.
RELEASED = 1e-10

# The largest force in a step is sampled at the ends of so many intervals, then sought by golden sections between the
# neighbours of the largest sample. These are a quarter of the step apart; 24 sections leave 2e-6 of the step, over
# which a force next to its maximum changes by less than 1e-11 of itself.
_INTERVALS = 8
_GOLDEN = 0.6180339887498949
_SECTIONS = 24


class AffineForm(NamedTuple):
    """A switching function ``factor`` w + ``offset``.

    ``tolerance`` is that of a landing on its zero, ``mode`` the mode of the site from there on. The offset is -inf
    where the site's mode has no such function, so that it never crosses zero.
    """

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
    """The first change in a step: ``position`` in it, from 0 to 1 (2 if there is none), ``site`` and its ``function``.

    ``function`` is the number, 0 or 1, of the switching function that crosses zero.
    """

    position: float
    site: int
    function: int


class Extremes(NamedTuple):
    """Extremes of a contact in a step: largest ``indentation`` in m, largest and smallest force on the host in N.

    Forces are positive where the contact pushes. The ``impulse`` in N s is the integral of the force over the step.
    """

    indentation: float
    force: float
    smallest_force: float
    impulse: float


@kernel
def _affine_form(contacts: np.ndarray, i: int, function: int) -> AffineForm:
    """Return the switching ``function``, 0 or 1, of site ``i`` of ``contacts`` (site,) in its mode."""
    site = contacts[i]
    tolerance = site.tolerance
    if site.mode == FREE:
        # Function 0 is the onset on the side 1, function 1 that on the side -1.
        side = 1 - 2 * function
        gap = gap_of(site, side)
        return AffineForm(factor=float(side), offset=-gap, tolerance=tolerance, mode=side * CLOSED)

    side = side_of(site.mode)
    gap = gap_of(site, side)
    if abs(site.mode) == UNSWITCHED:
        # Its force has a kink at D, where the masses meet (function 0) or part (function 1).
        rises = 1 - 2 * function
        near = MOVED * site.tolerance
        return AffineForm(factor=float(rises * side), offset=-rises * gap, tolerance=near, mode=site.mode)

    if abs(site.mode) == RESTING:
        # Not on D itself, where the motion has as many roots as before the site came to rest.
        moved = MOVED * site.tolerance
        if function == 0:
            return AffineForm(factor=float(-side), offset=gap - moved, tolerance=tolerance, mode=FREE)
        return AffineForm(factor=float(side), offset=-gap - moved, tolerance=tolerance, mode=side * CLOSED)

    # Closed: function 0 is the separation, and there is no other.
    if function == 0:
        return AffineForm(factor=float(-side), offset=gap, tolerance=tolerance, mode=FREE)
    return AffineForm(factor=0.0, offset=-np.inf, tolerance=0.0, mode=site.mode)


@kernel
def _least_pull(site: Any) -> float:
    """Return the pull in N on which a stuck ``site`` is released."""
    # The force that stops its reduced mass from the speed of the motion within the shortest period.
    force_scale = site.reduced_mass * abs(site.approach) * SHORTEST_FLIGHT / site.flight
    return RELEASED * force_scale


@kernel
def switching(contacts: np.ndarray, i: int, function: int, motion: np.ndarray) -> Switching:
    """Return switching ``function``, 0 or 1, of site ``i`` of ``contacts`` (site,) at its ``motion`` (3,): w, w', w''.

    The value is -inf if the site's mode has no such function.
    """
    if abs(contacts[i].mode) == STUCK:
        if function == 1:
            return Switching(value=-np.inf, rate=0.0, tolerance=0.0, mode=FREE)
        least = _least_pull(contacts[i])
        return Switching(value=-motion[0] - least, rate=-motion[1], tolerance=0.5 * least, mode=FREE)
    form = _affine_form(contacts, i, function)
    value = form.factor * motion[0] + form.offset
    rate = form.factor * motion[1]
    return Switching(value=value, rate=rate, tolerance=form.tolerance, mode=form.mode)


@kernel
def _stays_free(site: Any, b: np.ndarray) -> bool:
    """Return whether a free ``site`` is within both clearances in a step with the Bernstein form ``b`` (6,) of w.

    False for a site in another mode.
    """
    if site.mode != FREE:
        return False
    plus = site.clearance - site.tolerance
    minus = site.clearance_minus - site.tolerance
    within = True
    for w in b:
        within &= -minus < w < plus
    return within


@kernel
def stays_landed(site: Any, start: np.ndarray, end: np.ndarray, h: float, b: np.ndarray) -> bool:
    """Return whether a site that may rest stays within the tolerance of a landing in a step, ``start`` to ``end`` (3,).

    The step has ``h`` seconds; ``b`` (6,) is overwritten.
    """
    if abs(site.mode) == STUCK:
        return False
    side = landed_side(site, start[0])
    if side == 0:
        return False
    # A rigid site only rests, and is stuck then, where it is pressed so that no flight would leave the tolerance.
    if site.rigid and not 0.5 * end[1] * end[1] <= side * end[2] * site.tolerance:
        return False
    # A fast one comes from beyond the tolerance, however short the step: one that ends just before an onset leaves next
    # to nothing for the step after it.
    if site.mode == FREE and side * end[1] > 0.0 and 0.5 * end[1] * end[1] > MOVED * site.tolerance * abs(end[2]):
        return False
    # A contact may be so stiff that an impact of any speed ends within the tolerance: its separation is not rest.
    if site.mode != FREE and gap_of(site, side) > 0.0:
        return False
    bernstein(start, end, h, b)
    stays = True
    for w in b:
        stays &= abs(side * w - gap_of(site, side)) <= site.tolerance
    return stays


@kernel
def _passes_kink(site: Any, b: np.ndarray) -> bool:
    """Return whether an unswitched ``site`` may open or close inside a step with the Bernstein form ``b`` (6,) of w."""
    side = side_of(site.mode)
    gap = gap_of(site, side)
    near = MOVED * site.tolerance
    lowest = np.inf
    highest = -np.inf
    for w in b:
        lowest = min(lowest, side * w - gap)
        highest = max(highest, side * w - gap)
    # A step that ends on the kink does not have it inside. Depths up to ``near`` do not count: their force, and the
    # kink in it, is below the errors of a step.
    return highest > near and lowest < 0.0 and abs(side * b[5] - gap) > near


@kernel
def _next_kink(site: Any, motion: np.ndarray) -> int:
    """Return switching function of an unswitched ``site`` that crosses zero next: 0, the masses meet, or 1, they part.

    ``motion`` (3,) are w, w', w'' at present. Where the masses just touch, w' decides.
    """
    side = side_of(site.mode)
    depth = side * motion[0] - gap_of(site, side)
    near = MOVED * site.tolerance
    if depth > near or (depth >= -near and side * motion[1] > 0.0):
        return 1
    return 0


@kernel
def _first_pull(site: Any, start: np.ndarray, end: np.ndarray, h: float, c: np.ndarray) -> float:
    """Return position at which the reaction of a stuck ``site`` first turns to pull in a step of ``h`` seconds, else 2.

    The reaction is the cubic with the values and rates at both ends, ``start`` and ``end`` (3,); ``c`` (4,) is
    overwritten by the Bernstein form of the pull.
    """
    least = _least_pull(site)
    c[0] = -start[0] - least
    c[3] = -end[0] - least
    c[1] = c[0] - h * start[1] / 3.0
    c[2] = c[3] + h * end[1] / 3.0
    return first_upcrossing(c)


@kernel
def first_change(
    contacts: np.ndarray, start: np.ndarray, end: np.ndarray, h: float, room: np.ndarray, kinks: bool = False
) -> ModeChange:
    """Return first change of any site's mode in the step of ``h`` seconds from motion ``start`` to ``end`` (sites, 3).

    With ``kinks`` an unswitched contact that opens or closes counts, too, although its mode stays. ``room`` (2, 6) is
    overwritten.
    """
    first = ModeChange(position=2.0, site=-1, function=0)
    b = room[0]
    c = room[1]
    for i in range(contacts.size):
        unswitched = abs(contacts[i].mode) == UNSWITCHED
        if unswitched and not kinks:
            continue
        if abs(contacts[i].mode) == STUCK:
            position = _first_pull(contacts[i], start[i], end[i], h, c[:4])
            if position < first.position:
                first = ModeChange(position=position, site=i, function=0)
            continue
        bernstein(start[i], end[i], h, b)
        if unswitched and not _passes_kink(contacts[i], b):
            continue
        # The coefficients bound the motion: nearly all free sites are done here, without a search.
        if _stays_free(contacts[i], b):
            continue

        for function in range(2):
            if unswitched and function != _next_kink(contacts[i], start[i]):
                continue
            form = _affine_form(contacts, i, function)
            if form.offset == -np.inf:
                continue
            # An offset adds to every coefficient.
            for k in range(6):
                c[k] = form.factor * b[k] + form.offset
            near = form.tolerance
            if contacts[i].rigid:
                # What stays within the tolerance strikes nothing: the front of a wave has roots at all magnitudes, on
                # which impacts that are no motion would follow one another without an end.
                if max(-c.min(), c.max()) <= near:
                    continue
                # A blow on another site may have left it a little beyond its stop: it lands where it comes back there.
                near = max(near, c[0])
            position = first_upcrossing_after_start(c, near)
            # Strictly less: of changes at one time that of the first site is landed on, and the others land with it.
            if position < first.position:
                first = ModeChange(position=position, site=i, function=function)
    return first


@kernel
def _push(contacts: np.ndarray, i: int, b: np.ndarray, d: np.ndarray, s: float, room: np.ndarray) -> float:
    """Return the contact force in N at position ``s`` in a step with the Bernstein forms ``b`` of w and ``d`` of w'."""
    force, _ = contact_force(contacts, i, evaluate(b, s, room), evaluate(d, s, room))
    return side_of(contacts[i].mode) * force


@kernel
def extremes(contacts: np.ndarray, i: int, start: np.ndarray, end: np.ndarray, h: float) -> Extremes:
    """Return extremes of site ``i`` in a step of ``h`` seconds between the motions ``start`` and ``end`` (sites, 3)."""
    return _extremes(contacts, i, start, end, h, np.empty((4, 6)))


# Apart from ``extremes``, since a function that allocates counts references to every row that it looks at.
@kernel
def _extremes(contacts: np.ndarray, i: int, start: np.ndarray, end: np.ndarray, h: float, rows: np.ndarray) -> Extremes:
    """Return the ``extremes``; ``rows`` (4, 6) are overwritten."""
    b = rows[0]
    d = rows[1, :5]
    recoil = rows[2, :5]
    room = rows[3]
    bernstein(start[i], end[i], h, b)
    for k in range(5):
        d[k] = 5.0 * (b[k + 1] - b[k]) / h
    side = side_of(contacts[i].mode)

    # The site is deepest at an end, or where side w' falls through zero inside. The first such place is enough: steps
    # in contact are a fraction of an impact, too short for a contact to turn twice.
    deepest = max(side * b[0], side * b[5])
    for k in range(5):
        recoil[k] = side * (b[k] - b[k + 1])
    if recoil[0] < 0.0:
        turn = first_upcrossing(recoil)
        if turn <= 1.0:
            deepest = max(deepest, side * evaluate(b, turn, room))

    # The smallest force only tells whether the contact has pulled: samples are exact enough.
    largest = smallest = impulse = _push(contacts, i, b, d, 0.0, room)
    best = 0.0
    for k in range(1, _INTERVALS + 1):
        force = _push(contacts, i, b, d, k / _INTERVALS, room)
        smallest = min(smallest, force)
        # Simpson's rule: 1, 4, 2, 4, ..., 4, 1.
        impulse += force if k == _INTERVALS else (2.0 + 2.0 * (k % 2)) * force
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
    impulse *= h / (3.0 * _INTERVALS)
    return Extremes(deepest - gap_of(contacts[i], side), largest, smallest, impulse)


@kernel
def shortest_beginning(contacts: np.ndarray, motion: np.ndarray) -> float:
    """Return the smallest ``impact_time`` in s of the unswitched contacts that close at this ``motion`` (sites, 3).

    A contact closes if |side w - D| is at most ``MOVED`` tolerances and w approaches; inf if none does.
    """
    shortest = np.inf
    for i in range(contacts.size):
        site = contacts[i]
        if abs(site.mode) == UNSWITCHED:
            side = side_of(site.mode)
            rate = side * motion[i, 1]
            if rate > 0.0 and abs(side * motion[i, 0] - gap_of(site, side)) <= MOVED * site.tolerance:
                shortest = min(shortest, impact_time(site, rate))
    return shortest


@kernel
def shortest_impact(contacts: np.ndarray) -> float:
    """Return least ``impact_time`` in s of closed ``contacts`` (site,) at their approach velocities; inf for none."""
    shortest = np.inf
    for i in range(contacts.size):
        if abs(contacts[i].mode) == CLOSED:
            shortest = min(shortest, impact_time(contacts[i], abs(contacts[i].approach)))
    return shortest
