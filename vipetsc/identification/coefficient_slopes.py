"""Derivatives of the coefficients of a record's motion with respect to parameters, by differences of trial cases.

Masses, stiffnesses, gaps and so on follow from a case. The case is therefore built at two values of a parameter, and
the difference of its coefficients is taken: no quantity needs a formula of its own. Where all coefficients are affine
in the value of a parameter, one difference serves the whole fit. It is multiplied by the derivative of the value by the
coordinate, which may be the value's logarithm.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vipetsc.case import CaseError, Model
from vipetsc.case.sought import SoughtParameter
from vipetsc.case.trial import TrialCases
from vipetsc.identification.initial_state import state_of
from vipetsc.identification.motion import MotionCoefficients, scaled_slopes, slopes_between
from vipetsc.identification.motion_rates import Slopes

# Differences of coefficients are taken between coordinates that are 2 h apart; this is h. The error of the central
# difference, h^2/6 of the third derivative, and that of rounding, 1e-16/h, are then both about 1e-11.
HALF_WIDTH = 1e-5
AFFINE = ("clearance", "clearance_minus", "stiffness", "mass", "spring", "quadratic", "cubic", "dashpot", "grounding")
"""Quantities in which coefficients of the motion are affine: derivatives by their values are the same everywhere."""
FOLLOWING_CELL = ("mode", "packet")
"""Initial motions whose displacements and velocities depend on masses and springs of the cell."""


class ParameterSlope(NamedTuple):
    """Derivatives by one parameter: of the ``coefficients`` of the motion, and of the ``state`` in which it begins.

    ``coefficients`` have no axis of parameters; ``state`` (2n,) is 0.0 if the parameter does not change that state.
    """

    coefficients: Slopes
    state: np.ndarray | float = 0.0


def values_at(parameters: Sequence[SoughtParameter], z: np.ndarray) -> np.ndarray:
    """The values (parameter,) at the coordinates ``z`` (coordinate,), which begin with those of ``parameters``."""
    first = z[: len(parameters)]
    return np.array([parameter.from_coordinate(x) for parameter, x in zip(parameters, first, strict=True)])


class CoefficientSlopes:
    """Derivatives by ``parameters`` of the coefficients of a record's motion, whose cases are ``trials``."""

    def __init__(self, parameters: Sequence[SoughtParameter], trials: TrialCases) -> None:
        self._parameters = parameters
        self._trials = trials
        self._by_value = lru_cache(maxsize=None)(self._new_by_value)

    def at(self, z: np.ndarray, p: int, model: Model, middle: MotionCoefficients) -> ParameterSlope:
        """Derivatives of ``middle``, the coefficients of the ``model`` at ``z`` (coordinate,), by coordinate number p.

        Raises CaseError if a neighbouring case is impossible.
        """
        parameter = self._parameters[p]
        if parameter.quantity in AFFINE:
            by_value = self._by_value(p)
            if by_value is not None:
                return ParameterSlope(scaled_slopes(by_value, parameter.slope(z[p])))

        below, above = self._neighbours(z, p)
        low, high = (self._trials.case(self._values_with(z, p, x)).model() for x in (below, above))
        slopes = slopes_between(low, high, width=above - below, model=model, middle=middle)
        # Other initial motions are given in numbers: no parameter changes them.
        if model.initial is not None and model.initial.kind in FOLLOWING_CELL:
            return ParameterSlope(slopes, (state_of(high) - state_of(low)) / (above - below))
        return ParameterSlope(slopes)

    def _neighbours(self, z: np.ndarray, p: int) -> tuple[float, float]:
        """Coordinates below and above that of parameter ``p`` in ``z`` (coordinate,), within the bounds.

        Where z is at a bound, one of them is that of z, and the difference between them is one-sided.
        """
        parameter = self._parameters[p]
        below = max(z[p] - HALF_WIDTH, parameter.to_coordinate(parameter.low))
        above = min(z[p] + HALF_WIDTH, parameter.to_coordinate(parameter.high))
        return below, above

    def _values_with(self, z: np.ndarray, p: int, coordinate: float) -> np.ndarray:
        """The values (parameter,) at ``z`` (coordinate,) with another ``coordinate`` of parameter ``p``."""
        values = values_at(self._parameters, z)
        values[p] = self._parameters[p].from_coordinate(coordinate)
        return values

    def _new_by_value(self, p: int) -> Slopes | None:
        """Derivatives of a record's coefficients by the value of parameter ``p``; None if they depend on the values.

        None also if no case has the values at the start.
        """
        # The difference is taken at the start values of the case, not where the fit is: a fit that goes on after a stop
        # then has the same bits.
        z = np.array([parameter.to_coordinate(parameter.start) for parameter in self._parameters])
        below, above = self._neighbours(z, p)
        low, high = (self._values_with(z, p, x) for x in (below, above))
        try:
            model = self._trials.case(values_at(self._parameters, z)).model()
            lower = self._trials.case(low).model()
            upper = self._trials.case(high).model()
        except CaseError:
            return None
        if model.initial is not None and model.initial.kind in FOLLOWING_CELL:
            return None

        width = float(high[p] - low[p])
        slopes = slopes_between(lower, upper, width=width, model=model, middle=MotionCoefficients.of(model))
        # The force of a moved wall is proportional to the stiffness k of its spring. Derivatives of drives are relative
        # to their forces: that by k is 1/k, which is not constant.
        if slopes.drives.any():
            return None
        return slopes
