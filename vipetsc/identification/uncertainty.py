"""Uncertainty of fitted parameters: covariance, correlation, singular values, and the effect of one more sensor."""

from typing import NamedTuple

import numpy as np
import scipy

# A coordinate is determined if its standard error is at most this: a factor of 1.6 of a logarithmic parameter, and half
# the range between the bounds of a linear one. The model is not linear over larger errors, by which intervals would be
# drawn.
DETERMINED = 0.5
# Singular values below this fraction of the largest one are rounding. They are raised to it, so that errors are finite.
SMALLEST = 1e-12


class Uncertainty(NamedTuple):
    """Uncertainty of coordinates (parameter,): ``errors`` (parameter,), ``correlation`` (parameter, parameter).

    ``singular`` (direction,) are the singular values s of the Jacobian, ``directions`` (direction, parameter) its right
    singular vectors: 1/s is the standard error along one. ``determined`` (parameter,): whether the error is small
    enough for an interval.
    """

    errors: np.ndarray
    correlation: np.ndarray
    singular: np.ndarray
    directions: np.ndarray
    determined: np.ndarray


def uncertainty_of(jacobian: np.ndarray) -> Uncertainty:
    """Return the uncertainty by the ``jacobian`` J (datum, parameter) of weighted residuals: (J^T J)^-1."""
    # With fewer data than parameters rows of zeros stand for those that are missing: without them the singular value
    # decomposition would leave out as many directions, along which the data determine nothing.
    missing = jacobian.shape[1] - len(jacobian)
    if missing > 0:
        jacobian = np.pad(jacobian, ((0, missing), (0, 0)))
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    # If nothing depends on any parameter, all errors are 1e12.
    floor = SMALLEST * max(float(np.max(singular, initial=0.0)), 1.0)
    deviations = 1 / np.maximum(singular, floor)
    factors = directions * deviations[:, None]
    covariance = factors.T @ factors
    errors = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(errors, errors)
    return Uncertainty(
        errors=errors,
        correlation=np.clip(correlation, -1.0, 1.0),
        singular=singular,
        directions=directions,
        determined=errors <= DETERMINED,
    )


def marginal_jacobian(jacobian: np.ndarray, count: int) -> np.ndarray:
    """Return a Jacobian (count, count) of the first ``count`` coordinates, with the others left free.

    Its uncertainty is that of these coordinates by the whole ``jacobian`` J (datum, coordinate): its product with its
    transpose is the Schur complement A - B D^-1 B^T of J^T J, with the blocks A of these coordinates and D of the
    others. In J = Q R with the other coordinates first it is the last block of R. Without others it is J itself.
    """
    others = jacobian.shape[1] - count
    if not others:
        return jacobian
    _, upper = np.linalg.qr(np.roll(jacobian, others, axis=1))
    return np.asarray(upper[others:, others:])


def quantile(confidence: float, freedom: float = np.inf) -> float:
    """Return the number of standard errors on either side of a value in an interval of that ``confidence``.

    ``freedom`` are the degrees of freedom of the noise: data less what is fitted to them where the noise is estimated
    from their residuals (Student's t), infinite where it is given (normal errors).
    """
    return float(scipy.stats.t.ppf(0.5 + confidence / 2, freedom))


def errors_with_sensor(uncertainty: Uncertainty, slopes: np.ndarray, noise: float) -> np.ndarray:
    """Return standard errors (mass, parameter) with one more sensor at each mass.

    ``uncertainty`` is that without this sensor. ``slopes`` (sample, mass, parameter) are derivatives of what the sensor
    measures, ``noise`` is the standard deviation of its errors, in the same unit.
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


# Autocorrelations that are tested at most.
MOST_LAGS = 20


class Whiteness(NamedTuple):
    """The ``statistic`` Q of ``lags`` autocorrelations and the ``probability`` that white noise has one as large."""

    statistic: float
    lags: int
    probability: float


def ljung_box(residuals: np.ndarray) -> Whiteness:
    """Test evenly sampled ``residuals`` (sample,): Q = n (n + 2) sum_k r_k^2/(n - k) of n residuals.

    r_k are the autocorrelations at lags up to a fifth of the samples, and not more than 20. Of white noise Q is
    distributed as chi-squared with as many degrees of freedom as there are lags.
    """
    count = len(residuals)
    lags = max(min(MOST_LAGS, count // 5), 1)
    centred = residuals - residuals.mean()
    power = float(centred @ centred)
    # Residuals that are all equal have no correlation.
    if power == 0:
        return Whiteness(0.0, lags, 1.0)
    correlation = np.array([centred[k:] @ centred[:-k] for k in range(1, lags + 1)]) / power
    statistic = float(count * (count + 2) * np.sum(correlation**2 / (count - np.arange(1, lags + 1))))
    return Whiteness(statistic, lags, float(scipy.stats.chi2.sf(statistic, lags)))
