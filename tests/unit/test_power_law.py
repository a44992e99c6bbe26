"""Power-law fits: exact laws, textbook statistics, changes of units, and fits that are refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from vipetsc.spectra import doubt, normalised, power_law
from vipetsc.spectra.fits import r2_adjusted

METHODS = ("log-log", "nonlinear")
X = np.geomspace(0.1, 20, 12)
EXPONENT = -1.3


def scattered_law(seed=0):
    """Return 3 x^-1.3 at ``X`` with a lognormal scatter of 10 %."""
    noise = np.random.default_rng(seed).standard_normal(len(X))
    return 3.0 * X**EXPONENT * np.exp(0.1 * noise)


def adjusted(r2):
    """Return the adjusted R^2 of a law of one exponent through the points ``X``."""
    return 1 - (1 - r2) * (len(X) - 1) / (len(X) - 2)


def student_factor():
    """Return the two-sided 95 % quantile of Student's t for the points ``X`` and two parameters."""
    return stats.t.ppf(0.975, len(X) - 2)


@settings(max_examples=50)
@given(exponent=st.floats(-4, 4), factor=st.floats(1e-6, 1e6), count=st.integers(3, 30))
def test_an_exact_law_is_recovered(exponent, factor, count):
    """Either method returns exponent and factor of points that lie on a power law, inside its interval."""
    x = np.geomspace(0.1, 20, count)
    for method in METHODS:
        fit = power_law(x, factor * x**exponent, method)

        assert fit.exponent == pytest.approx(exponent, abs=1e-9)
        assert fit.factor == pytest.approx(factor, rel=1e-8)
        assert fit.exponent_interval[0] <= fit.exponent <= fit.exponent_interval[1]
        # R^2 is 0/0 where nothing varies.
        if abs(exponent) > 0.01:
            assert fit.r2_adjusted == pytest.approx(1, abs=1e-9)


def test_the_line_has_the_textbook_statistics():
    """The log-log fit is SciPy's linear regression of the logarithms, with Student's interval of its slope."""
    y = scattered_law()

    law = power_law(X, y)

    line = stats.linregress(np.log(X), np.log(y))
    half = student_factor() * line.stderr
    assert law.exponent == pytest.approx(line.slope, rel=1e-12)
    assert law.factor == pytest.approx(np.exp(line.intercept), rel=1e-12)
    assert law.exponent_interval == pytest.approx((line.slope - half, line.slope + half), rel=1e-10)
    assert law.r2_adjusted == pytest.approx(adjusted(line.rvalue**2), rel=1e-12)


def test_the_nonlinear_fit_is_least_in_squares():
    """Nearby laws have larger sums of squares, and the interval follows from the Jacobian at the fit."""
    y = scattered_law()

    fit = power_law(X, y, "nonlinear")

    fitted = fit.factor * X**fit.exponent
    least = np.sum((y - fitted) ** 2)
    for change, shift in ((1.001, 0), (0.999, 0), (1, 1e-3), (1, -1e-3)):
        other = change * fit.factor * X ** (fit.exponent + shift)
        assert np.sum((y - other) ** 2) > least

    jacobian = np.stack([X**fit.exponent, fitted * np.log(X)], axis=1)
    covariance = np.linalg.inv(jacobian.T @ jacobian) * least / (len(X) - 2)
    half = student_factor() * np.sqrt(covariance[1, 1])
    assert fit.exponent_interval == pytest.approx((fit.exponent - half, fit.exponent + half), rel=1e-5)
    assert fit.r2_adjusted == pytest.approx(adjusted(1 - least / np.sum((y - y.mean()) ** 2)), rel=1e-9)


@settings(max_examples=30)
@given(seed=st.integers(0, 99), scale_y=st.floats(1e-8, 1e8), scale_x=st.floats(1e-3, 1e3))
def test_units_change_the_factor_alone(seed, scale_y, scale_x):
    """Other units of x and y change neither exponent nor R^2 nor interval; the factor follows them."""
    y = scattered_law(seed)
    # The nonlinear fit iterates until its parameters change by less than a tolerance.
    for method, rel in zip(METHODS, (1e-9, 1e-6), strict=True):
        fit = power_law(X, y, method)
        scaled = power_law(scale_x * X, scale_y * y, method)

        assert scaled.exponent == pytest.approx(fit.exponent, rel=rel)
        assert scaled.r2_adjusted == pytest.approx(fit.r2_adjusted, rel=rel)
        # The differences that make up an interval, and powers of x, lose two digits.
        assert scaled.exponent_interval == pytest.approx(fit.exponent_interval, rel=100 * rel)
        assert scaled.factor == pytest.approx(scale_y * fit.factor * scale_x**-fit.exponent, rel=100 * rel)


def test_intervals_cover_the_truth_as_often_as_they_say():
    """About 95 % of 400 intervals of 95 % contain the exact exponent."""
    inside = []
    for seed in range(400):
        low, high = power_law(X, scattered_law(seed)).exponent_interval
        inside.append(low <= EXPONENT <= high)

    # The standard deviation of the fraction is (0.95 * 0.05/400)^1/2 = 0.011.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.04)


def test_a_fit_that_runs_away_is_nan():
    """A fit without a minimum has NaN as its numbers.

    The last point alone is large: the steeper the law through it, the smaller the sum of squares.
    """
    x = [1.0, 2.0, 3.0, 3.01]
    y = [1e-3, 2e-6, 1e-9, 1.0]

    assert np.isfinite(power_law(x, y, "log-log").exponent)
    fit = power_law(x, y, "nonlinear")
    assert np.isnan([fit.exponent, fit.r2_adjusted, *fit.exponent_interval]).all()


@settings(max_examples=30)
@given(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=20, unique=True))
def test_normalised_spans_its_range(values):
    """Values are mapped to 0.01 to 1 in their order, independently of their unit."""
    scaled = normalised(values)

    assert scaled.min() == 0.01
    assert scaled.max() == 1.0
    assert np.all(np.diff(scaled[np.argsort(values)]) >= 0)
    assert normalised(np.array(values) * 4.0) == pytest.approx(scaled, abs=1e-9)


def test_normalised_keeps_gaps_and_refuses_a_constant():
    """NaN stays where it is; equal values have no range to be mapped from."""
    assert normalised([1.0, np.nan, 3.0, 2.0], 0, 10) == pytest.approx([0, np.nan, 10, 5], nan_ok=True)
    with pytest.raises(ValueError, match="constant"):
        normalised([2.0, 2.0])


@pytest.mark.parametrize(
    ("x", "y", "message"),
    [
        ([1.0, 2.0], [1.0, 2.0], "2 points"),
        ([1.0, 1.0, 1.0], [1.0, 2.0, 3.0], "at 1 different x"),
        ([1.0, 2.0, 3.0], [1.0, 0.0, 3.0], "positive"),
        ([1.0, 2.0, 3.0], [1.0, np.nan, 3.0], "positive"),
        ([1.0, 2.0, 3.0], [1.0, 2.0], "same length"),
    ],
)
def test_points_without_a_law_are_refused(x, y, message):
    """Too few points, all at one place, values without a logarithm or without an abscissa raise ValueError."""
    with pytest.raises(ValueError, match=message):
        power_law(x, y)


def test_a_constant_has_no_coefficient_of_determination():
    """R^2 of values that do not vary is 0/0: NaN, without an error."""
    assert np.isnan(r2_adjusted([1.0, 1.0, 1.0], [1.0, 1.0, 1.0]))


def test_three_points_or_no_fit_are_no_power_law():
    """A fit counts from four points on; otherwise a reason is given."""
    assert doubt(9, 0.99) == ""
    assert doubt(3, 0.999) == "too few points (3)"
    assert doubt(5, -0.04) == "adjusted R² -0.04"
    assert doubt(5, np.nan) == "no fit"
    assert doubt(np.nan, np.nan) == "no fit"


@pytest.mark.parametrize("points", [4, 5, 12, 40])
@pytest.mark.parametrize("slope", [0.0, -0.1, -0.3, 0.5, -2.0])
def test_a_power_law_is_a_fit_whose_exponent_is_not_zero(points, slope):
    """A fit is a power law exactly if the 95 % interval of its exponent does not contain 0."""
    x = np.geomspace(1.0, 100.0, points)
    scatter = np.random.default_rng(points).standard_normal((20, points))
    found = set()
    for noise in scatter:
        law = power_law(x, 2.0 * x**slope * np.exp(0.5 * noise))
        low, high = law.exponent_interval
        found.add(bool(low > 0 or high < 0))
        assert (doubt(points, law.r2_adjusted) == "") == (low > 0 or high < 0)
    if slope == -2.0 and points > 4:
        assert found == {True}
