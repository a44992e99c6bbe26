"""Power laws y = a x^b by a straight line through the logarithms or by nonlinear least squares.

Both are as in any textbook on regression; intervals are Student's with n - 2 degrees of freedom, and R^2 is adjusted
for the two parameters.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.special import stdtrit

LEVEL = 0.95  # confidence of intervals
FEWEST = 4  # points of a power law: by chance three often lie near the curve of some power law

Method = Literal["log-log", "nonlinear"]


@dataclass(frozen=True)
class PowerLaw:
    """y = ``factor`` x^``exponent``, with the 95 % confidence interval (low, high) of the exponent.

    ``r2_adjusted`` is that of the logarithms for the log-log line, and of the values for the nonlinear fit.
    """

    factor: float
    exponent: float
    r2_adjusted: float
    exponent_interval: tuple[float, float]


def doubt(points: float, r2: float) -> str:
    """Return why a fit over so many ``points`` is not a power law, empty if it is one; ``r2`` is its adjusted R^2.

    It is one if the exponent differs from zero, at the confidence ``LEVEL``: t^2 = R^2 (n - 2)/(1 - R^2), with the R^2
    that is not adjusted, then exceeds the square of Student's quantile.
    """
    if points < FEWEST:
        return f"too few points ({points:g})"
    if np.isnan(r2):
        return "no fit"
    freedom = points - 2
    plain = 1 - (1 - r2) * freedom / (points - 1)
    if plain * freedom < (1 - plain) * stdtrit(freedom, 0.5 + LEVEL / 2) ** 2:
        return f"adjusted R² {r2:.2g}"
    return ""


def r2_adjusted(y: ArrayLike, fitted: ArrayLike) -> float:
    """Return 1 - (1 - R^2)(n - 1)/(n - 2) of a fit ``fitted`` (n,) with two parameters to ``y`` (n,), or NaN.

    R^2 compares the squared residuals with those of the mean of y: the model must include constants.
    """
    y = np.asarray(y, dtype=float)
    fitted = np.asarray(fitted, dtype=float)
    scatter = np.sum((y - y.mean()) ** 2)
    # The mean of constant values has no residuals with which a fit could be compared.
    if scatter == 0:
        return float("nan")
    return float(1 - np.sum((y - fitted) ** 2) / scatter * (len(y) - 1) / (len(y) - 2))


@np.errstate(over="ignore", invalid="ignore")
def power_law(x: ArrayLike, y: ArrayLike, method: Method = "log-log") -> PowerLaw:
    """Fit y = a x^b to points ``x`` (n,) and ``y`` (n,), positive both.

    The log-log line minimises the squares of relative errors, the nonlinear fit those of the errors, from the line's
    parameters on. A nonlinear fit need not have a minimum: where the squares keep falling as the exponent grows and
    the curve vanishes at all points but the last, all results are NaN.

    Raises
    ------
    ValueError
        For fewer than 3 points, fewer than 2 different x, or values that are not positive and finite.
    """
    x = np.asarray(x, dtype=float)
    y = np.asarray(y, dtype=float)
    if x.shape != y.shape or x.ndim != 1:
        raise ValueError(f"power law: x {x.shape} and y {y.shape} are not two lists of the same length")
    if len(x) < 3 or np.ptp(x) == 0:
        raise ValueError(f"power law: {len(x)} points at {len(np.unique(x))} different x; 3 points at 2 are needed")
    if not (np.all(x > 0) and np.all(y > 0) and np.all(np.isfinite(x)) and np.all(np.isfinite(y))):
        raise ValueError("power law: x and y must be positive and finite")

    # Centred and scaled the law is v = b u or w = c exp(b u): neither fit depends on the units of x and y.
    lx = np.log(x)
    ly = np.log(y)
    cx = lx.mean()
    cy = ly.mean()
    u = lx - cx
    v = ly - cy
    w = y / np.exp(cy)

    # The line of least squares passes through the means of the logarithms: v = b u has no constant, and c = 1.
    freedom = len(x) - 2
    c = 1.0
    b = float(u @ v / (u @ u))
    if method == "log-log":
        r2 = r2_adjusted(v, b * u)
        variance = float(np.sum((v - b * u) ** 2)) / freedom / (u @ u)
    else:
        # A fit of a few numbers costs little: it ends where rounding ends it.
        tolerances = {"ftol": 1e-14, "xtol": 1e-14, "gtol": 1e-14, "maxfev": 2000}
        try:
            (c, b), covariance = scipy.optimize.curve_fit(_exponential, u, w, p0=(c, b), jac=_gradient, **tolerances)
            r2 = r2_adjusted(w, _exponential(u, c, b))
            variance = covariance[1, 1]
        except RuntimeError:  # no convergence within ``maxfev`` evaluations: the squares have no minimum
            c = b = r2 = variance = float("nan")

    half = float(stdtrit(freedom, 0.5 + LEVEL / 2) * np.sqrt(variance))
    return PowerLaw(
        factor=float(c * np.exp(cy - b * cx)),
        exponent=float(b),
        r2_adjusted=r2,
        exponent_interval=(float(b) - half, float(b) + half),
    )


def _exponential(u: np.ndarray, c: float, b: float) -> np.ndarray:
    """Return the model c exp(b u) (n)."""
    return np.asarray(c * np.exp(b * u))


def _gradient(u: np.ndarray, c: float, b: float) -> np.ndarray:
    """Return derivatives (n, 2) of the model by c and b."""
    return np.stack([np.exp(b * u), c * u * np.exp(b * u)], axis=1)


def normalised(y: ArrayLike, low: float = 0.01, high: float = 1.0) -> np.ndarray:
    """Return a curve ``y`` (n,) scaled linearly to the range from ``low`` to ``high``; NaN stays NaN.

    Raises ValueError if the curve is constant.
    """
    y = np.asarray(y, dtype=float)
    least = np.nanmin(y)
    most = np.nanmax(y)
    if not most > least:
        raise ValueError(f"normalised: the curve is constant, {least:g}")
    # Exact at both ends, which low + (high - low) position is not.
    position = (y - least) / (most - least)
    return np.asarray(low * (1 - position) + high * position)
