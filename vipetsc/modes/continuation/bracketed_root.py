"""The zero of a function whose values are costly, between two places where its signs differ."""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.optimize import brentq

# Values through which a polynomial goes. More of them are further away, and say less of the function at its zero.
POINTS = 4


def bracketed_root(
    value: Callable[[float], float], low: float, high: float, tolerance: float, outside: Mapping[float, float]
) -> float:
    """A place between ``low`` and ``high`` where ``value`` was taken, and is zero to within ``tolerance``.

    Each place is the zero of the polynomial through the nearest values so far, those of the bracket and those by place
    that are known ``outside`` it. For a smooth function with a simple zero its error falls faster than to the power 1.6
    from place to place. Where the places do not come closer to each other by half, as for a function with a step, the
    bracket is halved. The search ends at the last place if the next one is not further away than the ``tolerance`` and
    the value is less than half of those at the ends, or if the bracket is not longer. Raises ValueError if the values
    at both ends have one sign.
    """
    values = {low: value(low), high: value(high)}
    for end in (low, high):
        if values[end] == 0:
            return end
    if not values[low] * values[high] < 0:
        raise ValueError(f"no change of sign between {low:g} and {high:g}: {values[low]:g} and {values[high]:g}")
    small = 0.5 * min(abs(number) for number in values.values())
    values |= {place: number for place, number in outside.items() if np.isfinite(number)}

    last = low
    longest = np.inf  # that the next step may have
    while high - low > tolerance:
        place = _zero(values, low, high)
        step = abs(place - last)
        if step <= tolerance and abs(values[last]) <= small:
            break
        # Behind a flat part of the function the next place may be near, and the zero far away.
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

    # Newton's form: divided differences.
    differences = numbers.copy()
    for order in range(1, len(places)):
        differences[order:] = (differences[order:] - differences[order - 1 : -1]) / (places[order:] - places[:-order])

    def polynomial(x: float) -> float:
        total = 0.0
        for difference, place in zip(differences[::-1].tolist(), places[::-1].tolist(), strict=True):
            total = total * (x - place) + difference
        return total

    return float(brentq(polynomial, low, high, xtol=1e-15 * (high - low), rtol=1e-15))
