"""The guaranteed search for the first root of a polynomial in Bernstein form, and landing on roots of a trajectory.

Method and references: the package's docstring. A trajectory is known at the ends of steps alone, and each engine has
steps of its own kind. An engine repeats a step until it ends on the root, and asks ``correct`` after each attempt what
to do next: that is Newton's iteration on the switching function, with safeguards.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.compiled import kernel

# An interval of this length, as a fraction of the step, that may still hold a root counts as one: it holds two roots
# near each other, or the polynomial comes as near to zero as its rounding. It is a thousand roundings of a position.
_NARROWEST = 1e-13
# Intervals that wait to be searched. Halvings of [0, 1] end after 44, at 2^-44 = 6e-14, and each leaves one half.
_DEPTH = 64
# Newton steps for one landing before the search is repeated on a shorter step, and all attempts. They only bound the
# work where a motion grazes: of 1,161 landings of ``ts`` in five lattices of 60 cells 959 are on the change at the
# first attempt, and the others at the second.
NEWTON_STEPS = 8
MOST_ATTEMPTS = 16

# Outcomes of an attempt: on the change; to be repeated at the new length; to be searched again; given up.
LANDED, RETRY, SEARCH, MISSED = range(4)


@kernel
def bernstein(start: np.ndarray, end: np.ndarray, h: float, b: np.ndarray) -> None:
    """Coefficients ``b`` (6,) on [0, 1] of the quintic with (w, w', w'') given at both ends of a step h.

    ``start`` and ``end`` (3,) hold them there.
    """
    b[0] = start[0]
    b[1] = start[0] + h * start[1] / 5.0
    b[2] = start[0] + 2.0 * h * start[1] / 5.0 + h * h * start[2] / 20.0
    b[3] = end[0] - 2.0 * h * end[1] / 5.0 + h * h * end[2] / 20.0
    b[4] = end[0] - h * end[1] / 5.0
    b[5] = end[0]


@kernel
def evaluate(b: np.ndarray, s: float, room: np.ndarray) -> float:
    """Return the value at s in [0, 1] of the polynomial ``b`` (n <= 6,) by de Casteljau's scheme in ``room`` (6,)."""
    for i in range(b.size):
        room[i] = b[i]
    for k in range(1, b.size):
        for i in range(b.size - k):
            room[i] = (1.0 - s) * room[i] + s * room[i + 1]
    return room[0]


@kernel
def _bisect(c: np.ndarray, room: np.ndarray) -> float:
    """Return the root in [0, 1] of a polynomial ``c`` (n,) that turns positive once; ``room`` (6,) is scratch."""
    low, high = 0.0, 1.0
    # The interval is then 2^-53 long, half the rounding unit of 1.
    for _ in range(53):
        s = 0.5 * (low + high)
        if evaluate(c, s, room) > 0.0:
            high = s
        else:
            low = s
    return high


@kernel
def _halve(c: np.ndarray, left: np.ndarray) -> None:
    """De Casteljau's scheme: the form on the left half goes to ``left`` (n,), that on the right half stays in ``c``."""
    n = c.size
    for k in range(1, n):
        left[k - 1] = c[0]
        for i in range(n - k):
            c[i] = 0.5 * (c[i] + c[i + 1])
    left[n - 1] = c[0]


@kernel
def _copy(source: np.ndarray, target: np.ndarray) -> None:
    """Copy the coefficients ``source`` (n,) to ``target`` (n,)."""
    for i in range(source.size):
        target[i] = source[i]


@kernel
def _may_turn_positive(c: np.ndarray) -> bool:
    """Return whether any coefficient ``c`` (n,) is positive or NaN; no value of a polynomial exceeds all of them."""
    may_turn = False
    for coefficient in c:
        # Not "coefficient > 0", which is false for NaN: a motion that is no number must not pass for one without roots.
        may_turn |= not coefficient <= 0.0
    return may_turn


@kernel
def _count_changes(c: np.ndarray) -> int:
    """Return changes of sign from one coefficient ``c`` (n,) to the next: at least as many as roots in ]0, 1[.

    Zero counts as negative, since a polynomial that touches zero from below has not crossed it.
    """
    changes = 0
    for i in range(c.size - 1):
        changes += (c[i] <= 0.0) != (c[i + 1] <= 0.0)
    return changes


@kernel
def first_upcrossing(b: np.ndarray) -> float:
    """Return the smallest s in [0, 1] at which a polynomial turns positive; 2 if it never does.

    ``b`` (n,), n <= 6, are its Bernstein coefficients. Method: see the package's docstring.
    """
    # Nearly every call ends here: what follows allocates.
    if b[0] > 0.0:
        return 0.0
    if not _may_turn_positive(b):
        return 2.0
    return _search(b, np.empty((_DEPTH + 2, 8)), np.empty((3, 6)))


# Apart from ``first_upcrossing``, since a function that allocates counts references to every row that it looks at.
@kernel
def _search(b: np.ndarray, stack: np.ndarray, room: np.ndarray) -> float:
    """Return the root of ``first_upcrossing`` where the coefficients ``b`` (n,) do not tell it at once.

    ``stack`` (interval, 8) takes the intervals that wait to be searched, the leftmost on top: the n coefficients on
    each, and in the last two columns its beginning and its width. ``room`` (3, 6) is overwritten, too.
    """
    n = b.size
    c = room[0, :n]
    left = room[1, :n]
    _copy(b, stack[0])
    stack[0, 6] = 0.0
    stack[0, 7] = 1.0
    top = 0
    while top >= 0:
        _copy(stack[top, :n], c)
        begin = stack[top, 6]
        size = stack[top, 7]
        top -= 1

        # No interval begins above zero: in the one before it, which ends there, a crossing would have been found.
        if not _may_turn_positive(c):
            continue
        # One change of sign and opposite signs at the ends: one root.
        if c[n - 1] > 0.0 and _count_changes(c) == 1:
            return begin + size * _bisect(c, room[2])
        if size < _NARROWEST:
            return begin

        # The left half is on top: the right one is searched only if the left one has no crossing.
        _halve(c, left)
        top += 1
        _copy(c, stack[top])
        stack[top, 6] = begin + 0.5 * size
        stack[top, 7] = 0.5 * size
        top += 1
        _copy(left, stack[top])
        stack[top, 6] = begin
        stack[top, 7] = 0.5 * size
    return 2.0


@kernel
def first_upcrossing_after_start(b: np.ndarray, tolerance: float) -> float:
    """Return the smallest s in [0, 1] at which a polynomial turns positive; 2 if it never does.

    ``b`` (n,), n <= 6, are its Bernstein coefficients. A start within ``tolerance`` of zero is the root that was landed
    on last: it is a crossing, s = 0, only if the polynomial rises from there. Other crossings are then those of the
    start's value, which is zero within the tolerance.
    """
    if abs(b[0]) > tolerance:
        return first_upcrossing(b)
    # The polynomial is b_0 + s q(s): q has the other roots, and its value at 0 has the sign of the slope there. By
    # s B_i,n-1(s) = (i + 1)/n B_i+1,n(s) its coefficients are (b_i+1 - b_0) n/(i + 1).
    n = b.size - 1
    quotient = np.empty(n)
    for i in range(n):
        quotient[i] = (b[i + 1] - b[0]) * n / (i + 1)
    return first_upcrossing(quotient)


class Landing(NamedTuple):
    """An attempt to end a step on a change: the step's ``length``, in the engine's unit of time, at most ``longest``.

    ``residual`` is the magnitude of the switching function at the end of the attempt before. The first attempt ends
    where a search of the longest step found the change; its residual is infinite. ``attempts`` came before this one.
    """

    length: float
    longest: float
    residual: float
    attempts: int


@kernel
def correct(landing: Landing, value: float, rate: float, tolerance: float, goal: float) -> tuple[Landing, int]:
    """Judge an attempt that ended at the ``value`` and ``rate`` (per unit of length) of the switching function.

    It has landed when |value| is within ``goal``, or within ``tolerance`` >= goal and Newton's method no longer
    halves it. Returns the next attempt and what to do:

    - LANDED: the step ends on the change.
    - RETRY: repeat the step at the new length.
    - SEARCH: search the attempt's step for a change, and ``shorten`` the attempt to it; without one take the step.
    - MISSED: no attempts are left; take the step as it is.
    """
    distance = abs(value)
    # Newton's method squares the distance where it converges: one that does not even halve it has left its root.
    better = distance < 0.5 * landing.residual
    if distance <= goal or (distance <= tolerance and not better):
        return landing, LANDED

    attempts = landing.attempts + 1
    newton = np.inf
    if rate != 0.0:
        newton = landing.length - value / rate
    if landing.attempts < NEWTON_STEPS and 0.0 < newton <= landing.longest and better:
        return Landing(length=newton, longest=landing.longest, residual=distance, attempts=attempts), RETRY
    if distance <= tolerance:
        return landing, LANDED
    if attempts >= MOST_ATTEMPTS:
        return landing, MISSED
    # The length stays until a search has found another one, and the residual with it.
    return Landing(length=landing.length, longest=landing.longest, residual=landing.residual, attempts=attempts), SEARCH


@kernel
def shorten(landing: Landing, position: float) -> Landing:
    """Return the attempt that ends at a ``position``, from 0 to 1, in the step of the attempt ``landing``."""
    return Landing(
        length=landing.length * position, longest=landing.longest, residual=landing.residual, attempts=landing.attempts
    )
