r"""Least squares within bounds with few Jacobians: SciPy's trust region (Branch, Coleman and Li 1999).

A Jacobian J costs one motion or two for each coordinate, a step one motion. Two things save Jacobians.

**Updates** (Broyden 1965). A step s that changes the residuals r by y as the Jacobian foretells leads to a place where

    J + (y - J s) s^T/(s^T s)

serves as the next one: the nearest matrix that foretells the step just made. It is computed anew where the foretold
gain does not come, and at the end of a precise fit: an old Jacobian would end the fit where J^T r = 0 with the old J.

**The end.** SciPy asks for the Jacobian after every step that is taken, and checks only then whether the fit ends with
that step. Here the same check comes first, and ends the fit.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

TOLERANCE = 1e-12  # relative change of cost or coordinates; a sum of a thousand squares is rounded at 1e-14
# Least reduction of the cost in a step, over the one expected from the Jacobian, for a small reduction to end the fit.
# SciPy has the same number: below it the linear model of the step is bad, and the next step may reduce the cost more.
# A Jacobian is updated only after steps that gain as much.
LEAST_RATIO = 0.25
# A precise fit ends with an updated Jacobian if the cost has fallen by less than this fraction since one was computed.
# A sum of a thousand squares over the noise then is within 1e-6 of the least, coordinates within 1e-3 standard errors,
# and over such distances a Jacobian hardly changes.
NEAR = 1e-9


class Precision(NamedTuple):
    """How a fit ends.

    It ends after so many ``steps`` (None: those of the case), or where the relative change of the ``cost`` or of the
    coordinates, ``step``, is less than these. ``has_prior``: a prior holds the coordinates near those at which the fit
    begins. ``is_rough``: derivatives are one-sided differences, and those at the end may be updates.
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
    """The ``coordinates`` (coordinate,) of a minimum; ``slopes`` (datum, coordinate) of the residuals, or an update."""

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
    descent = _Descent(residuals, jacobian, precision, slopes)
    # SciPy moves a start on a bound inside and refuses one outside, where rounding may have put it.
    x = np.clip(start, *bounds)
    while True:
        try:
            solution = least_squares(
                descent.evaluate,
                x,
                jac=descent.differentiate,
                bounds=bounds,
                method="trf",
                x_scale=1.0,
                xtol=precision.step,
                ftol=precision.cost,
                gtol=TOLERANCE,
                max_nfev=steps - descent.evaluations,
            )
            x = np.asarray(solution.x)
        except _FitEnd as end:
            x = end.solution
        if descent.is_over or descent.evaluations >= steps:
            return Minimum(x, descent.slopes_at(x))
        # Once more from here, with better slopes.
        descent.restart()


class _FitEnd(Exception):
    """A descent that ends at ``solution`` (active,)."""

    def __init__(self, solution: np.ndarray) -> None:
        super().__init__("the fit has come to its end")
        self.solution = solution


class _Step(NamedTuple):
    """Where a step begins: coordinates ``x`` (active,), ``residuals`` (datum,) and their ``slopes`` (datum, active)."""

    x: np.ndarray
    residuals: np.ndarray
    slopes: np.ndarray

    def ends_at(self, x: np.ndarray, residuals: np.ndarray, precision: Precision) -> bool:
        """Return whether a fit ends with the step to ``x`` (active,), where the residuals are ``residuals`` (datum,).

        The conditions are SciPy's for a small step, relative to where it begins, and for a small reduction of the cost,
        the latter without the terms by which its trust region keeps away from the bounds.
        """
        moved = x - self.x
        if np.linalg.norm(moved) < precision.step * (precision.step + np.linalg.norm(self.x)):
            return True
        gain = _cost(self.residuals) - _cost(residuals)
        return gain < precision.cost * _cost(self.residuals) and self.foretells(x, residuals)

    def foretells(self, x: np.ndarray, residuals: np.ndarray) -> bool:
        """Return whether the slopes let expect what the step to ``x`` gains, where ``residuals`` (datum,) are left."""
        cost = _cost(self.residuals)
        expected = cost - _cost(self.residuals + self.slopes @ (x - self.x))
        return cost - _cost(residuals) > LEAST_RATIO * expected

    def updated(self, x: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        """Return the nearest slopes (datum, active) to those of this step that foretell ``residuals`` at ``x``."""
        moved = x - self.x
        square = moved @ moved
        if square == 0:
            return self.slopes
        missed = residuals - self.residuals - self.slopes @ moved
        return self.slopes + np.outer(missed, moved / square)


def _cost(residuals: np.ndarray) -> float:
    """Return the sum of squares of ``residuals`` (datum,)."""
    return float(residuals @ residuals)


class _Descent:
    """Residuals and derivatives as SciPy asks for them, by which a fit of some ``precision`` comes to its end.

    ``evaluations`` counts the residuals that were computed. ``is_over`` says after a fit has ended whether the
    derivatives at its end are good enough for that; if not, the fit is to go on after ``restart``.
    """

    def __init__(
        self, residuals: Function, jacobian: Function, precision: Precision, slopes: np.ndarray | None
    ) -> None:
        self._residuals = residuals
        self._jacobian = jacobian
        self._precision = precision
        # Slopes for the next start of SciPy; None are to be computed.
        self._given = slopes
        # Where SciPy's last step begins, and whether the slopes there are computed, not updates.
        self._step: _Step | None = None
        self._is_computed = False
        # The cost where slopes were computed last, and the residuals that were asked for last.
        self._computed_at = np.inf
        self._latest = np.zeros(0)
        # Steps that have failed since slopes were computed, and whether the fit has ended with one.
        self._failures = 0
        self._has_failed = False
        self.evaluations = 0

    @property
    def is_over(self) -> bool:
        """Whether the slopes at the end of a fit are computed, or as good; a rough fit trusts updates that serve."""
        if self._is_computed:
            return True
        if self._has_failed:
            return False
        if self._precision.is_rough:
            return not self._failures
        cost = _cost(self._latest)
        return self._computed_at - cost < NEAR * cost

    def restart(self) -> None:
        """Prepare for another start where the fit has ended."""
        # The first step that fails improves the slopes; after another one, and at an uncertain end, they are computed.
        if not self._has_failed or self._failures > 1:
            self._given = None
        self._step = None
        self._has_failed = False

    def slopes_at(self, x: np.ndarray) -> np.ndarray:
        """Return the slopes (datum, active) at the end ``x`` (active,) of a fit."""
        assert self._step is not None
        if _cost(self._latest) > _cost(self._step.residuals):
            return self._step.slopes
        return self._step.updated(x, self._latest)

    def evaluate(self, x: np.ndarray) -> np.ndarray:
        """Return the residuals (datum,) at ``x`` (active,); ends the fit where an updated Jacobian has failed."""
        self.evaluations += 1
        self._latest = self._residuals(x)
        step = self._step
        if step is not None and not self._is_computed and not _cost(self._latest) < _cost(step.residuals):
            self._failures += 1
            self._has_failed = True
            self._given = step.updated(x, self._latest)
            raise _FitEnd(step.x.copy())
        return self._latest

    def differentiate(self, x: np.ndarray) -> np.ndarray:
        """Return the slopes (datum, active) at ``x`` (active,): computed, updated, or those that were given.

        Ends the fit where the step to ``x`` does.
        """
        # SciPy calls this at the start and after every step that is taken: the latest residuals are those at x.
        slopes = self._given
        step = self._step
        if step is not None:
            if step.ends_at(x, self._latest, self._precision):
                raise _FitEnd(x.copy())
            slopes = None
            if step.foretells(x, self._latest):
                slopes = step.updated(x, self._latest)

        self._is_computed = slopes is None
        if slopes is None:
            slopes = self._jacobian(x)
            self._failures = 0
            self._computed_at = _cost(self._latest)
        self._step = _Step(x.copy(), self._latest, slopes)
        return slopes
