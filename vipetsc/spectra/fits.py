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

LEVEL = 0.95  # of confidence
FEWEST = 4  # points of a power law: three lie near some of them by chance

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
    """Reason not to call a fit over ``points`` with the adjusted R^2 ``r2`` a power law; empty if it is one."""
    if points < FEWEST:
        return f"too few points ({points:g})"
    if np.isnan(r2):
        return "no fit"
    if r2 < 0:
        # A constant fits better.
        return f"adjusted R² {r2:.2g}"
    return ""


def r2_adjusted(y: ArrayLike, fitted: ArrayLike) -> float:
    """1 - (1 - R^2)(n - 1)/(n - 2) of values ``fitted`` (n,) to ``y`` (n,) with two parameters; NaN if y is constant.

    One of the parameters must be a constant or a factor, so that R^2 is measured against the mean of y.
    """
    y = np.asarray(y, dtype=float)
    fitted = np.asarray(fitted, dtype=float)
    scatter = np.sum((y - y.mean()) ** 2)
    # A constant explains nothing: no fit is better or worse than the mean.
    if scatter == 0:
        return float("nan")
    return float(1 - np.sum((y - fitted) ** 2) / scatter * (len(y) - 1) / (len(y) - 2))


@np.errstate(over="ignore", invalid="ignore")
def power_law(x: ArrayLike, y: ArrayLike, method: Method = "log-log") -> PowerLaw:
    """Fit y = a x^b to points ``x`` (n,) and ``y`` (n,), positive both.

    The log-log line minimises relative errors, the nonlinear fit errors, starting from the line. A nonlinear fit
    without a minimum, whose exponent runs away to leave a single point standing, is all NaN.

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

    # Centred and scaled, v = b u and w = c exp(b u), so that neither fit depends on the units of x and y.
    lx = np.log(x)
    ly = np.log(y)
    cx = lx.mean()
    cy = ly.mean()
    u = lx - cx
    v = ly - cy
    w = y / np.exp(cy)

    # The line passes through the centre of the logarithms: there v = b u has no constant, and c = 1.
    freedom = len(x) - 2
    c = 1.0
    b = float(u @ v / (u @ u))
    if method == "log-log":
        r2 = r2_adjusted(v, b * u)
        variance = float(np.sum((v - b * u) ** 2)) / freedom / (u @ u)
    else:
        # As far as rounding allows.
        tolerances = {"ftol": 1e-14, "xtol": 1e-14, "gtol": 1e-14, "maxfev": 2000}
        try:
            (c, b), covariance = scipy.optimize.curve_fit(_exponential, u, w, p0=(c, b), jac=_gradient, **tolerances)
            r2 = r2_adjusted(w, _exponential(u, c, b))
            variance = covariance[1, 1]
        except RuntimeError:  # no convergence: the squares keep falling as the exponent runs away
            c = b = r2 = variance = float("nan")

    half = float(stdtrit(freedom, 0.5 + LEVEL / 2) * np.sqrt(variance))
    return PowerLaw(
        factor=float(c * np.exp(cy - b * cx)),
        exponent=float(b),
        r2_adjusted=r2,
        exponent_interval=(float(b) - half, float(b) + half),
    )


def _exponential(u: np.ndarray, c: float, b: float) -> np.ndarray:
    """The model c exp(b u) (n)."""
    return np.asarray(c * np.exp(b * u))


def _gradient(u: np.ndarray, c: float, b: float) -> np.ndarray:
    """Derivatives (n, 2) of the model by c and b."""
    return np.stack([np.exp(b * u), c * u * np.exp(b * u)], axis=1)


def normalised(y: ArrayLike, low: float = 0.01, high: float = 1.0) -> np.ndarray:
    """A curve ``y`` (n,) scaled linearly to run from ``low`` to ``high``; NaN stays. Raises ValueError if constant."""
    y = np.asarray(y, dtype=float)
    least = np.nanmin(y)
    most = np.nanmax(y)
    if not most > least:
        raise ValueError(f"normalised: the curve is constant, {least:g}")
    # Not low + (high - low) position: so both ends are exact.
    position = (y - least) / (most - least)
    return np.asarray(low * (1 - position) + high * position)
