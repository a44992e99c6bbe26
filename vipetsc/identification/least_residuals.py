"""Least squares by SciPy's trust region within bounds, without the derivatives at the end of the fit.

SciPy asks for the Jacobian after every step that is taken, and checks only then whether the fit ends with that step. A
fit of two or three steps computes a third of its Jacobians for nothing, and each costs several times as much as a
motion. Here the same check comes first, and ends the fit.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from vipetsc.identification.precision import TOLERANCE, Precision

# Least reduction of the cost in a step, over the one expected from the Jacobian, for a small reduction to end the fit.
# SciPy has the same number: below it the linear model of the step is bad, and the next step may reduce the cost more.
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

    ``jacobian`` gives derivatives (datum, active); ``bounds`` are the lowest and the highest coordinates (active,). The
    residuals are evaluated ``steps`` times at most. Raises what ``residuals`` and ``jacobian`` raise.
    """
    latest = np.zeros(0)
    # The step that SciPy has taken last, by the state in which it began.
    step: _Step | None = None

    def evaluate(x: np.ndarray) -> np.ndarray:
        nonlocal latest
        latest = residuals(x)
        return latest

    def differentiate(x: np.ndarray) -> np.ndarray:
        nonlocal step
        # SciPy calls this at the start and after every step that is taken: the latest residuals are those at x.
        if step is not None and step.ends_at(x, latest, precision):
            raise _FitEnd(x.copy())
        slopes = jacobian(x)
        step = _Step(x.copy(), latest, slopes)
        return slopes

    low, high = bounds
    try:
        solution = least_squares(
            evaluate,
            # SciPy moves a start on a bound inside and refuses one outside, where rounding may have put it.
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
        """Whether a fit ends with the step to ``x`` (active,), where the residuals are ``residuals`` (datum,).

        The conditions are SciPy's for a small step, relative to where it begins, and for a small reduction of the cost,
        the latter without the terms by which its trust region keeps away from the bounds.
        """
        moved = x - self.x
        if np.linalg.norm(moved) < precision.step * (precision.step + np.linalg.norm(self.x)):
            return True

        cost = float(self.residuals @ self.residuals)
        gain = cost - float(residuals @ residuals)
        # The reduction that the Jacobian at the beginning of the step let expect.
        linear = self.residuals + self.slopes @ moved
        expected = cost - float(linear @ linear)
        return gain < precision.cost * cost and gain > LEAST_RATIO * expected
