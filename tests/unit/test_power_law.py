"""Power-law fits: exact laws, textbook statistics, and how they scale."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from vipetsc.spectra import doubt, normalised, power_law
from vipetsc.spectra.fits import r2_adjusted

METHODS = ("log-log", "nonlinear")
X = np.geomspace(0.1, 20, 12)


def scattered(seed=0, exponent=-1.3, spread=0.1):
    return 3.0 * X**exponent * np.exp(spread * np.random.default_rng(seed).standard_normal(len(X)))


@settings(max_examples=50)
@given(st.floats(-4, 4), st.floats(1e-6, 1e6), st.integers(3, 30))
def test_an_exact_law_is_recovered(exponent, factor, count):
    x = np.geomspace(0.1, 20, count)
    for method in METHODS:
        fit = power_law(x, factor * x**exponent, method)
        assert fit.exponent == pytest.approx(exponent, abs=1e-9)
        assert fit.factor == pytest.approx(factor, rel=1e-8)
        if abs(exponent) > 0.01:
            assert fit.r2_adjusted == pytest.approx(1, abs=1e-9)
        assert fit.exponent_interval[0] <= fit.exponent <= fit.exponent_interval[1]


def test_the_line_has_the_textbook_statistics():
    y = scattered()
    law = power_law(X, y)
    book = stats.linregress(np.log(X), np.log(y))
    half = stats.t.ppf(0.975, len(X) - 2) * book.stderr
    assert law.exponent == pytest.approx(book.slope, rel=1e-12)
    assert law.factor == pytest.approx(np.exp(book.intercept), rel=1e-12)
    assert law.exponent_interval == pytest.approx((book.slope - half, book.slope + half), rel=1e-10)
    r2 = book.rvalue**2
    assert law.r2_adjusted == pytest.approx(1 - (1 - r2) * (len(X) - 1) / (len(X) - 2), rel=1e-12)


def test_the_nonlinear_fit_is_least_in_squares():
    y = scattered()
    fit = power_law(X, y, "nonlinear")
    fitted = fit.factor * X**fit.exponent
    least = np.sum((y - fitted) ** 2)
    for factor, shift in ((1.001, 0), (0.999, 0), (1, 1e-3), (1, -1e-3)):
        assert np.sum((y - factor * fit.factor * X ** (fit.exponent + shift)) ** 2) > least
    jacobian = np.stack([X**fit.exponent, fitted * np.log(X)], axis=1)
    covariance = np.linalg.inv(jacobian.T @ jacobian) * least / (len(X) - 2)
    half = stats.t.ppf(0.975, len(X) - 2) * np.sqrt(covariance[1, 1])
    assert fit.exponent_interval == pytest.approx((fit.exponent - half, fit.exponent + half), rel=1e-5)
    r2 = 1 - least / np.sum((y - y.mean()) ** 2)
    assert fit.r2_adjusted == pytest.approx(1 - (1 - r2) * 11 / 10, rel=1e-9)


@settings(max_examples=30)
@given(st.integers(0, 99), st.floats(1e-8, 1e8), st.floats(1e-3, 1e3))
def test_units_change_the_factor_alone(seed, up, along):
    y = scattered(seed)
    for method, rel in zip(METHODS, (1e-9, 1e-6), strict=True):
        a, b = power_law(X, y, method), power_law(along * X, up * y, method)
        assert b.exponent == pytest.approx(a.exponent, rel=rel)
        assert b.r2_adjusted == pytest.approx(a.r2_adjusted, rel=rel)
        assert b.exponent_interval == pytest.approx(a.exponent_interval, rel=100 * rel)
        assert b.factor == pytest.approx(up * a.factor * along**-a.exponent, rel=100 * rel)


def test_intervals_cover_the_truth_as_often_as_they_say():
    inside = [
        low <= -1.3 <= high for seed in range(400) for low, high in [power_law(X, scattered(seed)).exponent_interval]
    ]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.04)


def test_a_fit_that_runs_away_is_nan():
    """The last point alone stands out: the steeper the law, the smaller the squares."""
    line, curved = (power_law([1.0, 2.0, 3.0, 3.01], [1e-3, 2e-6, 1e-9, 1.0], method) for method in METHODS)
    assert np.isfinite(line.exponent)
    assert np.isnan([curved.exponent, curved.r2_adjusted, *curved.exponent_interval]).all()


@settings(max_examples=30)
@given(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=20, unique=True))
def test_normalised_spans_its_range(values):
    scaled = normalised(values)
    assert (scaled.min(), scaled.max()) == (0.01, 1.0)
    assert np.all(np.diff(scaled[np.argsort(values)]) >= 0)
    assert normalised(np.array(values) * 4.0) == pytest.approx(scaled, abs=1e-9)


def test_normalised_keeps_gaps_and_refuses_a_constant():
    assert normalised([1.0, np.nan, 3.0, 2.0], 0, 10) == pytest.approx([0, np.nan, 10, 5], nan_ok=True)
    with pytest.raises(ValueError, match="constant"):
        normalised([2.0, 2.0])


def test_bad_points_are_named():
    with pytest.raises(ValueError, match="2 points"):
        power_law([1.0, 2.0], [1.0, 2.0])
    with pytest.raises(ValueError, match="at 1 places"):
        power_law([1.0, 1.0, 1.0], [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="positive"):
        power_law([1.0, 2.0, 3.0], [1.0, 0.0, 3.0])
    with pytest.raises(ValueError, match="positive"):
        power_law([1.0, 2.0, 3.0], [1.0, np.nan, 3.0])
    with pytest.raises(ValueError, match="same length"):
        power_law([1.0, 2.0, 3.0], [1.0, 2.0])
    assert np.isnan(r2_adjusted([1.0, 1.0, 1.0], [1.0, 1.0, 1.0]))


def test_three_points_or_a_fit_worse_than_the_mean_are_no_power_law():
    assert [doubt(*fit) for fit in ((4, 0.0), (9, 0.99))] == ["", ""]
    assert doubt(3, 0.999) == "too few points (3)" and doubt(5, -0.04) == "adjusted R² -0.04"
    assert doubt(5, np.nan) == doubt(np.nan, np.nan) == "no fit"
