"""Landing on a change: which length of the step to try next.

The trajectory is known at the end of a step only, and each engine takes its own kind of step. What they share is the
safeguarded Newton iteration on the switching function at the end of the repeated step. (``vipetsc.modes.changes`` keeps
a bracket instead: it lands to the rounding of the time, where a residual no longer halves.)
"""

from typing import NamedTuple

import numpy as np

from vipetsc.compiled import njit

# Newton steps for one landing before the search is repeated on a shorter step, and all attempts.
NEWTON_STEPS = 8
MOST_ATTEMPTS = 16

# What the last attempt was: on the change; to be repeated at the new length; to be searched again; given up.
LANDED, RETRY, SEARCH, MISSED = range(4)


class Landing(NamedTuple):
    """An attempt: the step's ``length``, the ``longest`` allowed, the ``residual`` before it, the attempts so far."""

    length: float
    longest: float
    residual: float
    attempts: int


@njit(error_model="numpy")
def begin_landing(share: float, longest: float) -> Landing:
    """The first attempt at a change that a search found at a ``share`` of the step ``longest``."""
    return Landing(share * longest, longest, np.inf, 0)


@njit(error_model="numpy")
def correct(landing: Landing, value: float, rate: float, tolerance: float, goal: float) -> tuple[Landing, int]:
    """Judge an attempt that ended at the ``value`` and ``rate`` (per unit of length) of the switching function.

    It has landed when |value| is within ``goal``, or within ``tolerance`` >= goal and Newton's method no longer
    halves it. Returns the next attempt and LANDED, RETRY, SEARCH (``shorten`` it by what a search on the attempt's
    step finds, or take that step as it is if it finds nothing), or MISSED (no attempts are left; take the step).
    """
    distance = abs(value)
    better = distance < 0.5 * landing.residual
    if distance <= goal or (distance <= tolerance and not better):
        return landing, LANDED
    newton = landing.length - value / rate if rate != 0.0 else np.inf
    attempts = landing.attempts + 1
    if landing.attempts < NEWTON_STEPS and 0.0 < newton <= landing.longest and better:
        return Landing(newton, landing.longest, distance, attempts), RETRY
    if distance <= tolerance:
        return landing, LANDED
    if attempts >= MOST_ATTEMPTS:
        return landing, MISSED
    return Landing(landing.length, landing.longest, landing.residual, attempts), SEARCH


@njit(error_model="numpy")
def shorten(landing: Landing, share: float) -> Landing:
    """The attempt at a ``share`` of the last one's length."""
    return Landing(landing.length * share, landing.longest, landing.residual, landing.attempts)
