"""Arcs of contact: the intervals of phase on which a periodic motion is beyond an offset, cut and joined.

Their ends are roots of the quintics that interpolate uniform samples of the motion z and of its two derivatives z' and
z'' by phase, found by ``vipetsc.contact.search``, which misses no root of a quintic. A contact so slight
that the quintic does not reach the offset is missed: quintics differ from motions by 7e-9 of the last harmonic
(``harmonics.DENSITY``).
"""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.contact.search import bernstein, first_upcrossing, first_upcrossing_after_start

# With K harmonics, and 24 K samples or more, a motion exceeds its samples by (2 pi/24)^2/16 = 0.4 % of its range at
# most, since |z''| <= K^2 range/2 by Bernstein's inequality. No root need be sought where the offset is above the
# samples by this fraction of their range, which is taken much larger than the bound.
OVERSHOOT = 0.1


@kernel
def _crossings(motion: np.ndarray, offset: float, out: np.ndarray) -> int:
    """Write the phases where a motion passes ``offset`` into ``out``, in order, and return their number.

    ``motion`` (samples, 3) holds (z, z', z'') over a period. The first crossing is upwards unless the period begins
    above; then they alternate. A value that equals the offset counts as below.
    """
    # Bernstein coefficients b enclose the quintic: where all have one sign it has no root, and none is sought.
    samples = motion.shape[0]
    h = 2.0 * np.pi / samples
    count = 0
    above = motion[0, 0] > offset
    b = np.empty(6)
    c = np.empty(6)
    for i in range(samples):
        bernstein(motion[i], motion[(i + 1) % samples], h, b)
        stays_below = True
        stays_above = True
        for k in range(6):
            b[k] -= offset
            stays_below &= b[k] <= 0.0
            stays_above &= b[k] > 0.0
        if (stays_below and not above) or (stays_above and above):
            continue

        # The search finds where a polynomial turns positive (2 if nowhere); downcrossings are those of its negative.
        sign = -1.0 if above else 1.0
        for k in range(6):
            c[k] = sign * b[k]
        begin = 0.0
        root = first_upcrossing(c)
        while root <= 1.0 and count < out.size:
            begin += root * (1.0 - begin)
            out[count] = (i + begin) * h
            count += 1
            above = not above
            if begin >= 1.0:
                break

            # De Casteljau's scheme: coefficients on the part of the interval after the root, where the value is 0.
            for k in range(1, 6):
                for j in range(6 - k):
                    c[j] = (1.0 - root) * c[j] + root * c[j + 1]
            c[0] = 0.0
            for k in range(1, 6):
                c[k] = -c[k]
            root = first_upcrossing_after_start(c, 0.0)
    return count


def arcs(motion: np.ndarray, offset: float) -> list[tuple[float, float]]:
    """Intervals of phase (begin, end), begin < end, on which a periodic motion is above ``offset``.

    ``motion`` (samples, 3) holds (z, z', z'') over a period. A motion that is always above has the interval (0, 2 pi).
    An interval that contains phase 0 is not split there: it begins at a negative phase.
    """
    if motion[:, 0].max() + OVERSHOOT * np.ptp(motion[:, 0]) <= offset:
        return []
    # More roots than any motion of the samples has: one with K harmonics passes an offset 2 K times at most.
    out = np.empty(4 * len(motion))
    roots = out[: _crossings(motion, offset, out)]
    if len(roots) % 2 and motion[0, 0] <= offset:
        # The motion comes down to the offset exactly at the period's end, whose value counts as below already.
        roots = np.append(roots, 2 * np.pi)
    begins_above = motion[0, 0] > offset
    if len(roots) < 2:
        if begins_above:
            return [(0.0, 2 * np.pi)]
        return []

    # A period ends as it began, so that crossings are even in number. If it begins above, the first crossing is
    # downwards: the last one, upwards, is moved back by a period and comes first.
    if begins_above:
        roots = np.concatenate([[roots[-1] - 2 * np.pi], roots[:-1]])
    return [(a, b) for a, b in zip(roots[::2].tolist(), roots[1::2].tolist(), strict=True) if b > a]


def minima(slope: np.ndarray) -> np.ndarray:
    """Phases (minimum,) in rad of the minima of a periodic motion, near enough to cut arcs there.

    ``slope`` (sample,) is its derivative at equal phases of one period. A minimum is where the straight line between
    two samples passes zero upwards.
    """
    after = np.append(slope[1:], slope[:1])
    (before_minimum,) = np.nonzero((slope < 0) & (after >= 0))
    falling = slope[before_minimum]
    change = falling - after[before_minimum]
    return (before_minimum + falling / change) * (2 * np.pi / len(slope))


def cut(a: float, b: float, places: np.ndarray) -> Iterator[tuple[float, float]]:
    """The interval from ``a`` to ``b``, phases in rad, cut at ``places`` (place,) of period 2 pi.

    A whole period stays whole.
    """
    if b - a >= 2 * np.pi:
        yield a, b
        return
    # An interval that contains phase 0 begins at a negative phase (``arcs``).
    turns = np.concatenate([places - 2 * np.pi, places])
    inside = np.sort(turns[(turns > a) & (turns < b)]).tolist()
    yield from itertools.pairwise([a, *inside, b])


def common(
    pieces: Sequence[tuple[float, float]], others: Sequence[tuple[float, float]]
) -> Iterator[tuple[float, float]]:
    """The parts of ``pieces`` that lie in one of ``others``, both of period 2 pi."""
    for (a, b), (c, d), turn in itertools.product(pieces, others, (-2 * np.pi, 0.0, 2 * np.pi)):
        low = max(a, c + turn)
        high = min(b, d + turn)
        if high > low:
            yield low, high
