"""Curves of steady states: the variables of their files, and numbers that are measured of a whole curve."""

from typing import NamedTuple

import numpy as np


class Stored(NamedTuple):
    """A measure in a file: its dimensions after that of the points, its units and text."""

    dimensions: str
    units: str
    text: str


LAYOUT = {
    "frequency": Stored("", "rad/s", "frequency"),
    "amplitude": Stored(
        "", "1", "amplitude: of a wave over the first site's clearance, of a force in N, of a wall in m"
    ),
    "largest": Stored("site", "m", "largest relative displacement"),
    "share": Stored("way", "1", "outgoing or dissipated energy over the incident energy"),
    "unstable": Stored("", "1", "number of growing perturbations (Hill's method); -1: undecided"),
    "growth": Stored("", "1", "largest growth rate over the frequency; 0 if none, NaN if not found"),
    "sideband": Stored("", "1", "frequency of the fastest growing perturbation over that of the drive; 1/2 at most"),
    "closed": Stored("site", "1", "fraction of the time in contact"),
    "episodes": Stored("", "1", "contact episodes per period"),
    "truncation": Stored("", "1", "estimated size of the neglected harmonics over those included"),
    "harmonics": Stored("site order", "m", "harmonics Z of w = Re sum Z exp(i k Om t), real part"),
    "harmonics_imaginary": Stored("site order", "m", "harmonics of w, imaginary part"),
}
"""The measures that every file of a curve of steady states has."""

OUTPUTS = {
    "parameter": Stored("", "", "value of the key that varies along the curve, see the attribute over"),
    "peak_displacement": Stored("location", "m", "largest displacement"),
    "peak_velocity": Stored("location", "m/s", "largest velocity"),
    "peak_acceleration": Stored("location", "m/s2", "largest acceleration"),
    "first_displacement": Stored("location", "m", "first harmonic of the displacement"),
    "first_velocity": Stored("location", "m/s", "first harmonic of the velocity"),
    "first_acceleration": Stored("location", "m/s2", "first harmonic of the acceleration"),
    "lag": Stored("location", "degree", "phase of the first harmonic of the displacement behind the drive"),
    "largest_elongation": Stored("spring", "m", "largest elongation of a spring that is not linear"),
    "spring_harmonics": Stored("spring order", "m", "harmonics of the elongation, real part"),
    "spring_harmonics_imaginary": Stored("spring order", "m", "harmonics of the elongation, imaginary part"),
    "location_harmonics": Stored("location order", "m", "harmonics of the displacement, real part"),
    "location_harmonics_imaginary": Stored("location order", "m", "harmonics of the displacement, imaginary part"),
    "transmission": Stored("pair", "1", "rms velocity of the second location over that of the first"),
    "steady_transmission": Stored("pair", "1", "first harmonic at the second location over that at the first"),
    "largest_force": Stored("site", "N", "largest contact force"),
    "first_force": Stored("site", "N", "first harmonic of the contact force"),
    "force_lag": Stored("site", "degree", "phase of the first harmonic of the contact force behind the drive"),
    "largest_wall_force": Stored("wall", "N", "largest force on the wall"),
    "first_wall_force": Stored("wall", "N", "first harmonic of the force on the wall"),
    "wall_force_lag": Stored("wall", "degree", "phase of the first harmonic of the force on the wall behind the drive"),
}
"""The measures that a file has if its case asks for them in ``[output]``, and the ``parameter``, if a key varies."""

LINEAR = "linear"
"""The dimension of linear motions, which the files of nonlinear curves have for comparison."""

LINEAR_OUTPUTS = (
    *(f"peak_{quantity}" for quantity in ("displacement", "velocity", "acceleration")),
    "lag",
    "largest_elongation",
    "transmission",
    "largest_wall_force",
)
"""The outputs that they have of these motions, named ``linear_<output>``."""


class CurvePart(NamedTuple):
    """A part of a curve (point,): the ``parameter`` that varies, the ``values`` of a response, the ``length`` along it.

    ``is_regular`` are the points that continuation steps led to; between them lie special points, such as folds.
    """

    parameter: np.ndarray
    values: np.ndarray
    length: np.ndarray
    is_regular: np.ndarray


# Largest ratio r of the distances from the middle of three points to the others for a parabola through them. Where only
# the nearer point is lower, the vertex exceeds the middle value by r^2/(4 (1 + r)) of that drop: by an eighth for even
# distances, by 0.8 with r = 4, and without bound as r grows.
UNEVEN = 4.0


def largest_response(parts: list[CurvePart], low: float, high: float) -> float:
    """Return largest value at parameters from ``low`` to ``high`` of all ``parts`` of a curve; NaN if none lies there.

    Between points it is the vertex of the parabola, over the length, through the largest value and its two neighbours.
    """
    largest = -np.inf
    for part in parts:
        inside = (part.parameter >= low) & (part.parameter <= high)
        largest = max(largest, part.values[inside].max(initial=-np.inf), *_at_ends(part, low, high))

        # Special points lie so near to others that a parabola through them would be that of their errors.
        regular = np.flatnonzero(part.is_regular)
        s = part.length[regular]
        y = part.values[regular]
        # Where the curve leaves the range and comes back, points of the range on either side are no neighbours.
        is_inside = inside[regular]
        middles = np.flatnonzero(is_inside[:-2] & is_inside[1:-1] & is_inside[2:]) + 1
        if len(middles):
            middle = int(middles[np.argmax(y[middles])])
            largest = max(largest, _vertex(s[middle - 1 : middle + 2], y[middle - 1 : middle + 2]))
    if not np.isfinite(largest):
        return np.nan
    return float(largest)


def _at_ends(part: CurvePart, low: float, high: float) -> list[float]:
    """Return values where a ``part`` passes the parameters ``low`` and ``high``, linear between points, and -inf.

    The last is the largest one of a part that passes neither.
    """
    values = [-np.inf]
    for end in (low, high):
        beyond = part.parameter - end
        for i in np.flatnonzero(beyond[:-1] * beyond[1:] < 0):
            fraction = beyond[i] / (beyond[i] - beyond[i + 1])
            values.append(float(part.values[i] + fraction * (part.values[i + 1] - part.values[i])))
    return values


def _vertex(s: np.ndarray, y: np.ndarray) -> float:
    """Return largest value of the parabola through three points with the values ``y`` (3,) at the lengths ``s`` (3,).

    The value in the middle where it is not the largest, or the distances are too uneven for a parabola.
    """
    before, after = np.diff(s)
    if not (y[1] >= y[0] and y[1] >= y[2] and 0 < max(before, after) < UNEVEN * min(before, after)):
        return float(y[1])
    rise = (y[1] - y[0]) / before
    fall = (y[2] - y[1]) / after
    bend = (fall - rise) / (before + after)
    # Three equal values, whose parabola has no vertex.
    if bend == 0:
        return float(y[1])
    # At the middle point, from which the parabola is y_1 + slope x + bend x^2.
    slope = rise + bend * before
    return float(y[1] - slope**2 / (4 * bend))


def widest_gap(parts: list[CurvePart], level: float, low: float, high: float) -> float:
    """Return width of the widest range of the parameter, from ``low`` to ``high``, with responses below a ``level``.

    Between points responses are linear. Where a curve has several states, the largest one counts. A range in which it
    has none counts as below: the ``parts`` must cover all from ``low`` to ``high``.
    """
    above: list[tuple[float, float]] = []
    for part in parts:
        for i in range(len(part.values) - 1):
            ends = part.parameter[i : i + 2]
            excess = part.values[i : i + 2] - level
            if max(excess) < 0:
                continue
            # Above the level at one end only: from there to where the line between the points crosses it.
            if min(excess) < 0:
                crossing = ends[0] + (ends[1] - ends[0]) * excess[0] / (excess[0] - excess[1])
                ends = np.array([ends[int(np.argmax(excess))], crossing])
            above.append((float(min(ends)), float(max(ends))))

    # What is left between the intervals in which some state is above the level.
    widest = 0.0
    reached = low
    # Sorted by their begins, intervals that overlap merge in one pass.
    for begin, end in sorted(above):
        widest = max(widest, min(begin, high) - reached)
        reached = max(reached, end)
    return max(widest, high - reached)
