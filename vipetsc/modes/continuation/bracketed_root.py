"""The zero of a function whose values are costly, between two places where its signs differ.

A value of a test function along a branch costs a solution by Newton's method. Methods of low order, such as bisection,
need too many; Brent's method uses three values, this one four, and values that are known outside the bracket as well.
"""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.optimize import brentq

from vipetsc.modes.problem import NoMotionError

# Values through which the polynomial goes. More of them lie further away, and say less about the function at its zero.
POINTS = 4


def bracketed_root(
    value: Callable[[float], float], low: float, high: float, tolerance: float, outside: Mapping[float, float]
) -> float:
    """A place between ``low`` and ``high``, at most ``tolerance`` from a zero of ``value``, at which it was called.

    Each next place is the zero, within the bracket, of the polynomial through ``POINTS`` values: those at the bracket's
    ends, and the nearest of the others, which include the values known ``outside`` it, by place. For a smooth function
    with a simple zero the error of a place is of an order above 1.6 in that of the place before, the order of the
    secant method. Where a step from place to place is more than half the one before, as for a function with a jump, the
    bracket is halved instead.

    The search ends where the bracket is no longer than the ``tolerance``. It ends before where the next place is within
    the ``tolerance`` of the last one, and the value there is at most half of the smaller one at the ends. Raises
    NoMotionError if the values at both ends have one sign.
    """
    values = {low: value(low), high: value(high)}
    for end in (low, high):
        if values[end] == 0:
            return end
    if not values[low] * values[high] < 0:
        raise NoMotionError(f"no change of sign between {low:g} and {high:g}: {values[low]:g} and {values[high]:g}")
    # Two places may also be near each other where the function is flat; a value as large as at an end is no zero.
    small = 0.5 * min(abs(number) for number in values.values())
    values |= {place: number for place, number in outside.items() if np.isfinite(number)}

    last = low
    # Length that the next step may have.
    longest = np.inf
    while high - low > tolerance:
        place = _zero(values, low, high)
        step = abs(place - last)
        if step <= tolerance and abs(values[last]) <= small:
            break
        # Beyond a flat part of the function the zero may be far away, though the next place is near.
        if step > longest or step <= tolerance:
            place = 0.5 * (low + high)
            step = np.inf

        last = place
        longest = 0.5 * step
        values[place] = value(place)
        if values[place] == 0:
            break
        if values[place] * values[low] > 0:
            low = place
        else:
            high = place
    return last


def _zero(values: Mapping[float, float], low: float, high: float) -> float:
    """The zero between ``low`` and ``high`` of the polynomial through their ``values`` and the nearest others."""
    middle = 0.5 * (low + high)
    others = sorted((place for place in values if place not in (low, high)), key=lambda place: abs(place - middle))
    places = np.array([low, high, *others[: POINTS - 2]])
    numbers = np.array([values[place] for place in places])

    # Newton's form of the polynomial, of which the divided differences are the coefficients.
    differences = numbers.copy()
    for order in range(1, len(places)):
        differences[order:] = (differences[order:] - differences[order - 1 : -1]) / (places[order:] - places[:-order])

    def polynomial(x: float) -> float:
        total = 0.0
        for difference, place in zip(differences[::-1].tolist(), places[::-1].tolist(), strict=True):
            total = total * (x - place) + difference
        return total

    return float(brentq(polynomial, low, high, xtol=1e-15 * (high - low), rtol=1e-15))
