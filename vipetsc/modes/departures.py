"""Departures of contacts from their state at rest, and which departures of an orbit are images of one another.

A *departure* is an interval of time in which a contact that is open at rest is closed, or one that is pressed at rest
is open. If the system has a symmetry (a lattice that is its own mirror image, equal stops on both sides) and an orbit
has it, too, the symmetry maps the departures of one contact to those of another contact, or of the other side: to the
same instants, or to instants half a period later if it reverses the sign of the motion. An orbit that is at rest twice
in a period also runs back as it came, so that a departure has an image in reversed time. Images are of equal length,
and appear and vanish together along a whole branch, however short the steps.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

# The tolerances on phases, in periods, and on squares of lengths. Symmetric orbits are symmetric to about 1e-12. So is
# the depth of a short contact, which is proportional to the square of its length; the length itself is less accurate.
SAME_PHASE = 1e-6
SAME_SQUARE = 1e-9


class Departure(NamedTuple):
    """The ``middle`` of a departure, counted from the start of the arc, and its ``length``, both in periods.

    The arc starts at rest or at the centre (u = 0). A departure that lasts over an instant of rest is counted whole:
    its middle is that instant, and its length includes the part beyond.
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


def union_length(intervals: np.ndarray) -> float:
    """Length of the union of ``intervals`` (number, 2), begin and end each, which may overlap."""
    if not len(intervals):
        return 0.0
    # Sorted by ends and by beginnings apart, the gaps between neighbours are those of the union.
    times = np.sort(intervals, axis=0)
    gaps = np.maximum(times[1:, 0] - times[:-1, 1], 0.0).sum()
    return float(times[-1, 1] - times[0, 0] - gaps)


def families(departures: Sequence[Departure]) -> Counter[int]:
    """The number of families of images among the ``departures`` of an orbit, for each size of a family."""
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
    """The number of families of images that only one of two orbits has: those that appear, and those that vanish.

    A family that gains or loses members counts twice, as one that vanishes and another one that appears.
    """
    old = families(before)
    new = families(after)
    return (old - new).total() + (new - old).total()
