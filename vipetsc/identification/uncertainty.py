"""Uncertainty of fitted parameters: covariance, correlation, singular values, and the effect of one more sensor."""

from typing import NamedTuple

import numpy as np
import scipy

# A coordinate is determined if its standard error is at most this: 0.5 is a factor of 1.6 of a logarithmic parameter,
# and half the range between the bounds of a linear one. With more, a linearised interval means nothing.
DETERMINED = 0.5
# Singular values below this fraction of the largest one are rounding. They are raised to it, so that errors are finite.
SMALLEST = 1e-12


class Uncertainty(NamedTuple):
    """Uncertainty of coordinates (parameter,): ``errors`` (parameter,), ``correlation`` (parameter, parameter).

    ``singular`` (direction,) are the singular values of the Jacobian, ``directions`` (direction, parameter) its right
    singular vectors: 1/s is the standard error along one. ``determined`` (parameter,).
    """

    errors: np.ndarray
    correlation: np.ndarray
    singular: np.ndarray
    directions: np.ndarray
    determined: np.ndarray


def uncertainty_of(jacobian: np.ndarray) -> Uncertainty:
    """The uncertainty by the ``jacobian`` J (datum, parameter) of residuals over the noise; covariance (J^T J)^-1."""
    count = jacobian.shape[1]
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    # Without any slope all errors are large, and finite.
    floor = SMALLEST * max(float(np.max(singular, initial=0.0)), 1.0)
    deviations = 1 / np.maximum(singular, floor)
    factors = directions * deviations[:, None]
    covariance = factors.T @ factors
    errors = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(errors, errors)
    return Uncertainty(
        errors=errors,
        correlation=np.clip(correlation, -1.0, 1.0),
        singular=np.pad(singular, (0, count - len(singular))),
        directions=np.pad(directions, ((0, count - len(directions)), (0, 0))),
        determined=errors <= DETERMINED,
    )


def marginal_jacobian(jacobian: np.ndarray, count: int) -> np.ndarray:
    """The Jacobian (count, count) of the first ``count`` coordinates alone, whatever the others are.

    Its information matrix is the Schur complement A - B D^-1 B^T of J^T J: in J = Q R with the other coordinates first
    it is the last block of R. Without others it is the ``jacobian`` (datum, coordinate) itself.
    """
    others = jacobian.shape[1] - count
    if not others:
        return jacobian
    _, upper = np.linalg.qr(np.roll(jacobian, others, axis=1))
    return np.asarray(upper[others:, others:])


def quantile(confidence: float) -> float:
    """Standard errors on each side of a value that make an interval of that ``confidence`` for normal errors."""
    return float(scipy.stats.norm.ppf(0.5 + confidence / 2))


def errors_with_sensor(uncertainty: Uncertainty, slopes: np.ndarray, noise: float) -> np.ndarray:
    """Standard errors (mass, parameter) with one more sensor at each mass.

    ``slopes`` (sample, mass, parameter) are derivatives of what the sensor measures, ``noise`` that of its values.
    """
    scaled = uncertainty.directions * uncertainty.singular[:, None]
    information = scaled.T @ scaled
    # Directions that the data do not determine would make the matrix singular: they are given an error of 1e6.
    information = information + 1e-12 * np.eye(len(information))
    errors = []
    for mass in range(slopes.shape[1]):
        scaled_slopes = slopes[:, mass] / noise
        errors.append(np.sqrt(np.diag(np.linalg.inv(information + scaled_slopes.T @ scaled_slopes))))
    return np.array(errors)
