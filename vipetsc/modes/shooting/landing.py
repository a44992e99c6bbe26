"""Contact changes within a step: where they are on the interpolant, and Newton's method for landing on them.

A contact changes when its gap rises through zero: sigma w - D while it is open, D - sigma w while it is closed. A
step's quintic Hermite interpolant of the gap is cut into its monotone pieces by ``contact.search``, so that no pair
of changes is missed, however short. Where the largest value of a gap is zero to within the interpolant's error, the
flow decides whether there is a change.

The roots are bisected in monomial form on the quarters of the step. A method that ends on a neighbouring float could
change the points of a branch: a later orbit might need another number of Newton steps, on which the next step depends.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.contact.search import first_upcrossing_after_start

# Outcomes of a search: no change; a change; an extremum so near zero that only the flow can tell.
NONE, CROSSING, EXTREMUM = range(3)
# Largest number of attempts at one extremum, and of one landing in all. Bisection of a step to rounding takes about 54:
# that to the root before an extremum has room after all attempts at the extremum.
EXTREMUM_ATTEMPTS = 40
MOST_ATTEMPTS = 120
# Coefficients of a polynomial of degree 5 in the position in a step, from 0 to 1, the lowest first.
Coefficients = tuple[float, float, float, float, float, float]
# A slope at the start below this fraction of the curvature is the rounding of an extremum.
ROUNDING = 1e-8


class Change(NamedTuple):
    """The change of a ``contact`` to or from a ``side``, and an attempt to end a step of ``length`` s on it.

    The gap sign w - offset rises through zero between the lengths ``low`` and ``high``; an ``extremum`` is landed on
    where that gap is largest. ``attempts`` counts those at this change. Without a change, ``contact`` is -1.
    """

    contact: int
    side: int
    sign: float
    offset: float
    extremum: bool
    low: float
    high: float
    length: float
    attempts: int


@kernel
def correct(change: Change, motion: np.ndarray, floor: float) -> tuple[Change, int]:
    """The next attempt after one that ended with (w, w', w'') = ``motion``: Newton's method, or bisection.

    The outcome is CROSSING when the length is found to ``floor`` seconds, EXTREMUM when the gap's largest value is
    found so and not above zero, and NONE when another attempt is needed. ``contact.search`` stops at a tolerance on
    w; the sensitivities of an orbit with many contacts need the length to rounding.
    """
    contact, side, sign, offset, extremum, low, high, length, attempts = change
    gap = sign * motion[0] - offset
    value = gap
    rate = sign * motion[1]
    if extremum:  # where the slope turns negative
        value = -sign * motion[1]
        rate = -sign * motion[2]
    if value > 0.0:
        high = min(high, length)
    else:
        low = max(low, length)
    attempts += 1

    # Without a rise there is no Newton step: one beyond the bracket stands for it, and leads to its bisection.
    newton = high
    if rate > 0.0:
        newton = -value / rate
    # A root's bracket shrinks to its floor. Rounding of w' may keep Newton's method from an extremum for ever.
    goes_on = high - low > floor
    if extremum:
        goes_on = attempts < EXTREMUM_ATTEMPTS
    if goes_on and abs(newton) > floor:
        target = length + newton
        if not low < target < high:
            target = 0.5 * (low + high)
        return Change(contact, side, sign, offset, extremum, low, high, target, attempts), NONE

    if not extremum:
        return change, CROSSING
    if gap <= 0.0:
        return change, EXTREMUM
    # The flow is beyond zero where the interpolant could not tell: the root lies before, and is sought as such.
    return Change(contact, side, sign, offset, False, 0.0, length, 0.5 * length, 0), NONE


@kernel
def hermite(a: np.ndarray, b: np.ndarray, h: float, sign: float, offset: float) -> Coefficients:
    """Coefficients of sign * w - offset on [0, 1] from (w, w', w'') at both ends of a step h."""
    g0 = sign * a[0] - offset
    r0 = sign * a[1] * h
    s0 = sign * a[2] * h * h
    g1 = sign * b[0] - offset
    r1 = sign * b[1] * h
    s1 = sign * b[2] * h * h
    d = g1 - g0 - r0 - 0.5 * s0
    e = r1 - r0 - s0
    f = s1 - s0
    return g0, r0, 0.5 * s0, 10.0 * d - 4.0 * e + 0.5 * f, -15.0 * d + 7.0 * e - f, 6.0 * d - 3.0 * e + 0.5 * f


@kernel
def _value(c: Coefficients, x: float) -> float:
    return c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * (c[4] + x * c[5]))))


@kernel
def _slope(c: Coefficients, x: float) -> float:
    """Slope at x; just after 0, for a step that starts on an extremum."""
    if x == 0.0 and abs(c[1]) <= ROUNDING * abs(c[2]):
        return c[2]
    return c[1] + x * (2.0 * c[2] + x * (3.0 * c[3] + x * (4.0 * c[4] + x * 5.0 * c[5])))


@kernel
def _bisect(c: Coefficients, low: float, high: float, sign: float) -> float:
    """Root between low and high, where the polynomial turns positive; given a ``sign``, where its slope loses it."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        if sign == 0.0:
            is_beyond = _value(c, middle) > 0.0
        else:
            is_beyond = sign * _slope(c, middle) <= 0.0
        if is_beyond:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)


@kernel
def _extremum(c: Coefficients, position: float) -> float:
    """The zero of the slope near ``position``, in its quarter of the step."""
    low = 0.25 * min(np.floor(4.0 * position), 3.0)
    sign = _slope(c, low)
    # Two zeros in one quarter leave no change of sign to bisect.
    if sign * _slope(c, low + 0.25) >= 0.0:
        return position
    return _bisect(c, low, low + 0.25, sign)


@kernel
def _next_turn(slope: np.ndarray, low: float, sign: float) -> float:
    """Position at which ``sign`` times the slope (5,) on [low, 1] turns positive, or 2; cuts the slope there."""
    turn = first_upcrossing_after_start(sign * slope, 0.0)
    if turn > 1.0:
        return turn
    if turn > 0.0:
        # De Casteljau's scheme leaves the coefficients on the part after the turn, which begins with 0.
        for k in range(1, slope.size):
            for i in range(slope.size - k):
                slope[i] = (1.0 - turn) * slope[i] + turn * slope[i + 1]
        slope[0] = 0.0
    return low + turn * (1.0 - low)


@kernel
def first_rise(c: Coefficients) -> tuple[float, int]:
    """Position in the step at which a gap that starts at or below zero first rises through it, and the outcome."""
    # Above the interpolant's error, which is that of the next power of the position.
    margin = 0.01 * (abs(c[5]) + 0.3 * abs(c[4]))
    # Bernstein coefficients bound the gap: nearly every call ends here.
    b1 = c[0] + c[1] / 5.0
    b2 = c[0] + (4.0 * c[1] + c[2]) / 10.0
    b3 = c[0] + (6.0 * c[1] + 3.0 * c[2] + c[3]) / 10.0
    b4 = c[0] + (4.0 * c[1] + 3.0 * c[2] + 2.0 * c[3] + c[4]) / 5.0
    b5 = _value(c, 1.0)
    if max(b1, b2, b3, b4, b5) <= -margin:
        return 1.0, NONE

    start = b1 - c[0]
    if abs(c[1]) <= ROUNDING * abs(c[2]):
        start = 0.0
    slope = np.array([start, b2 - b1, b3 - b2, b4 - b3, b5 - b4])
    high = 0.0
    # The pieces on which the gap rises, each from ``left`` to ``top``: a quartic slope has at most two pairs of zeros.
    for _ in range(3):
        low = _next_turn(slope, high, 1.0)
        if low > 1.0:
            break
        high = _next_turn(slope, low, -1.0)
        left = 0.0
        if low > 0.0:
            left = _extremum(c, low)
        top = 1.0
        if high <= 1.0:
            top = _extremum(c, high)

        # The root is in the first quarter of the step that ends above zero.
        for part in range(1, 5):
            end = 0.25 * part
            if end <= left:
                continue
            root = 2.0
            if _value(c, end) > 0.0:
                root = _bisect(c, left, end, 0.0)
            if root <= top:
                return root, CROSSING
            if end >= top:
                break
            left = end
        if high > 1.0:
            break

        # Not above zero at the ends of quarters: between them the largest value decides, unless it is within the error.
        peak = _value(c, top)
        if peak > margin:
            return _bisect(c, left, top, 0.0), CROSSING
        if peak > -margin:
            return top, EXTREMUM
    return 1.0, NONE
