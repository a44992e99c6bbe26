r"""Least squares within bounds by SciPy's trust region (Branch, Coleman and Li 1999), and how exact a fit has to be."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

TOLERANCE = 1e-12  # relative change of cost or coordinates; a sum of a thousand squares is rounded at 1e-14


class Precision(NamedTuple):
    """How a fit ends.

    It ends after so many ``steps`` (None: those of the case), or where the relative change of the ``cost`` or of the
    coordinates, ``step``, is less than these. ``has_prior``: a prior holds the coordinates near those at which the fit
    begins. ``is_rough``: derivatives are one-sided differences.
    """

    steps: int | None = None
    cost: float = TOLERANCE
    step: float = TOLERANCE
    has_prior: bool = False
    is_rough: bool = False


# While windows grow a fit only has to stay in its valley; the next window goes on from there.
GROWING = Precision(cost=1e-2, step=1e-3, has_prior=True, is_rough=True)
# A fit after which the noise is estimated, or from which a precise one begins.
CLOSE = Precision(cost=1e-6, step=1e-6, is_rough=True)
FINAL = Precision()

Function = Callable[[np.ndarray], np.ndarray]


class Minimum(NamedTuple):
    """The ``coordinates`` (coordinate,) of a minimum; ``slopes`` (datum, coordinate) of the residuals there."""

    coordinates: np.ndarray
    slopes: np.ndarray


def least_residuals(
    residuals: Function,
    jacobian: Function,
    start: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    precision: Precision,
    steps: int,
    slopes: np.ndarray | None = None,
) -> Minimum:
    """Return the coordinates (active,) with the least squares of ``residuals`` (datum,), from ``start`` (active,) on.

    ``jacobian`` gives derivatives (datum, active), and ``slopes`` are those near the start if they are known;
    ``bounds`` are the lowest and the highest coordinates (active,). The residuals are evaluated ``steps`` times at
    most. Raises what ``residuals`` and ``jacobian`` raise.
    """
    given = slopes

    def differentiate(x: np.ndarray) -> np.ndarray:
        # SciPy asks for the derivatives at the start first.
        nonlocal given
        first = given
        given = None
        if first is not None:
            return first
        return jacobian(x)

    solution = least_squares(
        residuals,
        # SciPy moves a start on a bound inside and refuses one outside, where rounding may have put it.
        np.clip(start, *bounds),
        jac=differentiate,
        bounds=bounds,
        method="trf",
        x_scale=1.0,
        xtol=precision.step,
        ftol=precision.cost,
        gtol=TOLERANCE,
        max_nfev=steps,
    )
    return Minimum(np.asarray(solution.x), solution.jac)
