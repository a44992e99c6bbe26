"""Departures of contacts from what they are at rest, and which of an orbit's are images of one another.

A *departure* is a time in which a contact that is open at rest is closed, or one that is pressed at rest is open. A
symmetry of the system (a lattice that is its own mirror image, equal stops on both sides) that takes an orbit to itself
takes the departures of one contact to those of another, or of its other side: at the same instants, where it keeps the
phase, or half a period later, where it turns the motion round. Orbits between two instants of rest also run back as
they came. Such images last equally long; they begin and vanish together along a whole branch, however short its steps.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

# The tolerance on phases, in periods, and on squares of lengths. Orbits that are symmetric are so to about 1e-12; a
# short contact's depth, the square of its length, is that accurate, and the length itself is not.
SAME_PHASE = 1e-6
SAME_SQUARE = 1e-9


class Departure(NamedTuple):
    """The ``middle`` of a departure, counted from an instant of rest or of the centre, and its ``length``, in periods.

    A departure that goes on beyond an instant of rest has all of its length, and its middle is that instant.
    """

    middle: float
    length: float

    def is_image(self, other: "Departure") -> bool:
        """Whether a symmetry may take this departure to the ``other`` one: half a period later, or run backwards."""
        is_as_long = abs(self.length**2 - other.length**2) <= SAME_SQUARE
        return is_as_long and abs(self._to_rest - other._to_rest) <= SAME_PHASE

    @property
    def _to_rest(self) -> float:
        """The time from the middle to the nearest multiple of half a period."""
        return abs(self.middle - round(2 * self.middle) / 2)


def within_arc(spans: Iterable[tuple[float, float]], fraction: float, rest_after: bool) -> list[Departure]:
    """Departures by their begins and ends in periods, of an arc of that ``fraction`` of the period.

    One that is cut off by the arc's start, or by its end if that is at rest (``rest_after``), goes on as its mirror
    image.
    """
    departures = []
    for begin, end in spans:
        if begin <= 0:
            begin = -end
        if end >= fraction and rest_after:
            end = 2 * fraction - begin
        departures.append(Departure(middle=(begin + end) / 2, length=end - begin))
    return departures


def families(departures: Sequence[Departure]) -> Counter[int]:
    """How many families of so many images each there are among the ``departures`` of an orbit, by their size."""
    groups: list[list[Departure]] = []
    for departure in departures:
        for family in groups:
            if family[0].is_image(departure):
                family.append(departure)
                break
        else:
            groups.append([departure])
    return Counter(len(family) for family in groups)


def changed_families(before: Sequence[Departure], after: Sequence[Departure]) -> int:
    """How many families of images one orbit has and the other one has not: those that appear, and those that vanish.

    A family that gains or loses members counts twice, as one that vanishes and another one that appears.
    """
    old = families(before)
    new = families(after)
    return (old - new).total() + (new - old).total()
