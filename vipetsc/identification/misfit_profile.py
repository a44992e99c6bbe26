"""Profiles of the misfit: one parameter is held at some values, and all others are fitted to each of them.

The fits of one side follow each other outwards, each from the one before. If all began at the middle and only moved in
the direction of the covariance, the model might lose a contact that just grazes its stop. The misfit then jumps, and no
derivative leads back to a motion with that contact, though the least misfit may have it.
"""

from typing import Literal, NamedTuple

import numpy as np

from vipetsc.identification.growing_windows import GrowingWindows
from vipetsc.identification.least_squares import Precision
from vipetsc.identification.uncertainty import uncertainty_of

# Distance in standard errors of the outermost values of a profile.
REACH = 3.0
# The cost is about the number of data, and rises by about ten over the reach of a profile: by REACH^2 = 9 where the
# problem is linear. For a thousand data the relative tolerance of 1e-5 is an error of 0.01 in the cost.
PRECISION = Precision(steps=30, cost=1e-5, is_rough=True)
# A step to the next value that changes the contacts is halved, down to this fraction of the distance: four halvings.
# Contacts that change within a smaller step are taken to change in the motion of the least misfit, too.
SMALLEST_STEP = 1 / 16
# Coordinates, numbers of order one, count as equal within their rounding.
SAME = 1e-12

Side = Literal["below", "above"]
SIDES: tuple[Side, ...] = ("below", "above")


class ProfileCosts(NamedTuple):
    """The least ``costs`` (parameter, place) with each parameter held at the coordinates ``places`` (parameter, place).

    Costs are NaN on a side of the fit on which they could not be computed.
    """

    places: np.ndarray
    costs: np.ndarray


class MisfitProfile(NamedTuple):
    """Coordinates ``places`` (parameter, place) at which each parameter is held.

    ``along`` (parameter, coordinate) is how far each coordinate moves, by the covariance, with a parameter that is held
    at a coordinate larger by 1. ``slopes`` (datum, coordinate) are the derivatives of the residuals at the fit.
    """

    places: np.ndarray
    along: np.ndarray
    slopes: np.ndarray

    def outwards(self, number: int, middle: float, side: Side) -> np.ndarray:
        """Return numbers (place,) of the places of parameter ``number`` on one ``side`` of the coordinate ``middle``.

        The nearest comes first. A place at the middle itself counts as one above it.
        """
        places = self.places[number]
        if side == "above":
            return np.flatnonzero(places >= middle - SAME)
        return np.flatnonzero(places < middle - SAME)[::-1]


def profile_about(windows: GrowingWindows, z: np.ndarray, count: int) -> MisfitProfile:
    """Return the profiles with ``count`` places a parameter about the fit ``z`` (coordinate,), within the bounds."""
    slopes = windows.misfit.whole_jacobian(z, windows.last)
    uncertainty = uncertainty_of(slopes)
    errors = uncertainty.errors
    sought = range(windows.misfit.count)
    # A parameter that is not determined is held at values between its bounds.
    reach = np.where(uncertainty.determined, REACH * errors, np.inf)
    low = np.maximum(z - reach, windows.low)[sought]
    high = np.minimum(z + reach, windows.high)[sought]
    # In a linear problem the fit with coordinate i held at a distance of 1 has coordinate j moved by cov_ij/cov_ii.
    along = (uncertainty.correlation * errors / errors[:, None])[sought]
    along = np.where(uncertainty.determined[sought, None], along, 0.0)
    data = len(slopes) - len(windows.misfit.prior())
    return MisfitProfile(np.linspace(low, high, count, axis=1), along, slopes[:data])


def profile_costs(
    windows: GrowingWindows, z: np.ndarray, profile: MisfitProfile, number: int, side: Side
) -> list[float]:
    """Return the least costs at the places of parameter ``number`` on one ``side`` of the fit ``z`` (coordinate,).

    The nearest place comes first. Raises CaseError, MotionError.
    """
    others = np.delete(np.arange(len(z)), number)
    held = _Held(z.copy(), profile.along[number], profile.slopes[:, others])
    costs = []
    for place in profile.outwards(number, float(z[number]), side):
        held = _follow(windows, held, number, float(profile.places[number, place]))
        costs.append(windows.misfit.cost(held.z, windows.last))
    return costs


class _Held(NamedTuple):
    """A fit ``z`` (coordinate,) with one coordinate held.

    ``along`` (coordinate,) is how far each coordinate moves over the one that is held. ``slopes`` (datum, other
    coordinate) are the derivatives of the residuals there.
    """

    z: np.ndarray
    along: np.ndarray
    slopes: np.ndarray


def _follow(windows: GrowingWindows, held: _Held, number: int, value: float) -> _Held:
    """Return the fit with coordinate ``number`` held at ``value``, from the fit ``held`` on.

    Steps in which a contact comes or goes are halved.
    """
    z, along, slopes = held
    others = [other for other in range(len(z)) if other != number]
    contacts = _contacts(windows, z)
    fraction = 1.0
    while abs(value - z[number]) > SAME:
        step = fraction * (value - z[number])
        begin = np.clip(z + along * step, windows.low, windows.high)
        # The last step ends on the value itself, not on a sum that is rounded.
        begin[number] = value
        if fraction < 1:
            begin[number] = z[number] + step
        if _contacts(windows, begin) != contacts and fraction > SMALLEST_STEP:
            fraction /= 2
            continue

        fitted = begin
        if others:
            # Between neighbouring fits derivatives change little.
            fitted, slopes = windows.minimum(begin, windows.last, others, PRECISION, slopes)
        along = (fitted - z) / (fitted[number] - z[number])
        z = fitted
        contacts = _contacts(windows, z)
        fraction = 1.0
    return _Held(z, along, slopes)


def _contacts(windows: GrowingWindows, z: np.ndarray) -> list[int]:
    """Return the numbers of the model's contacts, one a record."""
    return [len(windows.onsets(z, number, end)) for number, end in enumerate(windows.last)]
