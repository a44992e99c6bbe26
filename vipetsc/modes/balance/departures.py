"""When contacts in a motion given by its harmonics are not what they are at rest: closed, or open if pressed at rest.

Shooting integrates a part of the period, the arc, after which the motion repeats itself by a symmetry, counts the
episodes in it, and measures the time with a contact closed. The same is done here, so that points of both methods can
be compared.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from vipetsc.modes.balance.harmonics import Episode, ForceSeries, SiteForces
from vipetsc.modes.departures import Departure, union_length

# An episode centred on an end of the arc counts. Rounding may put its middle outside by up to 1e-9 rad at either end,
# here as a part of the period.
ROUNDING = 1e-9 / (2 * np.pi)


def departures_of(forces: SiteForces, episodes: Iterable[Episode]) -> list[Departure]:
    """When contacts close, or open if they are pressed at rest, from phase 0 to where the motion repeats.

    That is half a period for a motion at rest at phase 0, and a quarter if it is symmetric as well: the arcs that
    shooting integrates, with whose counts these are compared. A contact that is pressed at rest and stays closed for
    the whole period, or open, has none. The middle and the length of a departure are over the period.
    """
    end = 0.5
    if forces.odd:
        end = 0.25
    by_pair: dict[int, list[tuple[float, float]]] = {pair: [] for pair in range(len(forces.contacts))}
    for episode in episodes:
        by_pair[episode.pair].append((episode.onset, episode.onset + episode.length))

    departures = []
    for pair, stops in enumerate(forces.contacts):
        spans = by_pair[pair]
        if stops.is_pressed:
            spans = _between(spans)
        for begin, stop in spans:
            middle = (begin + stop) / (4 * np.pi)
            # Whether it lies within the arc that is longer by the rounding at both ends, counted from its beginning.
            if (middle + ROUNDING) % 1 < end + 2 * ROUNDING:
                departures.append(Departure(middle=middle, length=(stop - begin) / (2 * np.pi)))
    return departures


def fraction_closed(series: ForceSeries) -> float:
    """The fraction of the period in which one contact or more is closed, as shooting counts it."""
    # The episodes of one contact do not overlap.
    if np.count_nonzero(series.closed) < 2:
        return float(series.closed.max(initial=0.0))

    intervals = []
    for episode in series.episodes:
        begin = episode.onset
        if begin < 0:
            # An episode that contains phase 0 begins before it, at the end of the period.
            intervals.append((begin + 2 * np.pi, 2 * np.pi))
        intervals.append((max(begin, 0.0), episode.onset + episode.length))
    return union_length(np.array(intervals)) / (2 * np.pi)


def _between(spans: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The intervals of phase between ``spans``, which are sorted and do not overlap.

    The last interval ends where the first span begins, one turn later.
    """
    after = [*spans[1:], *((begin + 2 * np.pi, stop) for begin, stop in spans[:1])]
    gaps = [(stop, begin) for (_, stop), (begin, _) in zip(spans, after, strict=True)]
    return [(begin, stop) for begin, stop in gaps if stop > begin]
