"""Least squares by SciPy's trust region within bounds, which ends before derivatives that nothing uses.

SciPy asks for the Jacobian behind every step that is taken, and looks only then whether the fit ends with this step. Of
a fit with two or three steps these are a third of all derivatives, which cost several times as much as a motion.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from vipetsc.identification.precision import TOLERANCE, Precision

# Least reduction of the cost over the one expected, as SciPy's: with a smaller one the model of the step is a bad one,
# and a small reduction says nothing of how near the end is.
LEAST_RATIO = 0.25

Function = Callable[[np.ndarray], np.ndarray]


def least_residuals(
    residuals: Function,
    jacobian: Function,
    start: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
    precision: Precision,
    steps: int,
) -> np.ndarray:
    """The coordinates (active,) with the least squares of ``residuals`` (datum,), from ``start`` (active,) on.

    ``jacobian`` gives derivatives (datum, active); ``bounds`` are the lowest and highest coordinates. The fit has
    ``steps`` evaluations at most.
    """
    latest = np.zeros(0)
    taken: list[_Step] = []

    def evaluate(x: np.ndarray) -> np.ndarray:
        nonlocal latest
        latest = residuals(x)
        return latest

    def differentiate(x: np.ndarray) -> np.ndarray:
        # Asked for at the start and behind every step that is taken, whose residuals are the latest.
        if taken and taken[-1].ends_at(x, latest, precision):
            raise _FitEnd(x.copy())
        slopes = jacobian(x)
        taken[:] = [_Step(x.copy(), latest, slopes)]
        return slopes

    low, high = bounds
    try:
        solution = least_squares(
            evaluate,
            # A start on a bound is moved inside by the method, and a start outside is refused.
            np.clip(start, low, high),
            jac=differentiate,
            bounds=bounds,
            method="trf",
            x_scale=1.0,
            xtol=precision.step,
            ftol=precision.cost,
            gtol=TOLERANCE,
            max_nfev=steps,
        )
    except _FitEnd as end:
        return end.solution
    return np.asarray(solution.x)


class _FitEnd(Exception):
    """A fit that has come to its ``solution`` (active,)."""

    def __init__(self, solution: np.ndarray) -> None:
        super().__init__("the fit has come to its end")
        self.solution = solution


class _Step(NamedTuple):
    """Where a step begins: coordinates ``x`` (active,), ``residuals`` (datum,) and their ``slopes`` (datum, active)."""

    x: np.ndarray
    residuals: np.ndarray
    slopes: np.ndarray

    def ends_at(self, x: np.ndarray, residuals: np.ndarray, precision: Precision) -> bool:
        """Whether a fit ends with the step to ``x`` (active,), where ``residuals`` (datum,) are, as SciPy does."""
        moved = x - self.x
        if np.linalg.norm(moved) < precision.step * (precision.step + np.linalg.norm(x)):
            return True

        cost = float(self.residuals @ self.residuals)
        gain = cost - float(residuals @ residuals)
        linear = self.residuals + self.slopes @ moved
        expected = cost - float(linear @ linear)
        return gain < precision.cost * cost and gain > LEAST_RATIO * expected
