"""First roots and values of quintic Hermite interpolants, against dense sampling."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BPoly

from vipetsc.contact.search import bernstein, evaluate, first_upcrossing_after_start

coefficient = st.floats(-1, 1, allow_subnormal=False)


def quintic(start, end, length):
    """Return the Bernstein coefficients of the quintic through (w, w', w'') at ``start`` and ``end``."""
    coefficients = np.empty(6)
    bernstein(np.array(start), np.array(end), length, coefficients)
    return coefficients


def first_upcrossing(coefficients):
    """Return the first upcrossing, the start included: no start is within a negative tolerance."""
    return first_upcrossing_after_start(coefficients, -1.0)


@given(
    start=st.tuples(coefficient, coefficient, coefficient),
    end=st.tuples(coefficient, coefficient, coefficient),
    length=st.floats(0.1, 3),
)
def test_bernstein_form_matches_the_hermite_data(start, end, length):
    """Between the two ends the quintic is SciPy's interpolant of the same values and derivatives."""
    coefficients = quintic(start, end, length)
    expected = BPoly.from_derivatives([0, length], [list(start), list(end)])

    position = np.linspace(0, 1, 17)
    values = [evaluate(coefficients, s, np.empty(6)) for s in position]
    np.testing.assert_allclose(values, expected(position * length), atol=1e-12)


@given(st.lists(coefficient, min_size=6, max_size=6))
def test_first_rise_is_the_first_sign_change(coefficients):
    """Nothing is positive before the first upcrossing, nor anywhere if there is none; the value there is zero."""
    coefficients = np.array(coefficients)
    root = first_upcrossing(coefficients)
    position = np.linspace(0, 1, 4001)
    values = BPoly(coefficients[:, None], [0, 1])(position)

    # The search returns 2 if there is no root. Values that are positive by rounding alone may be missed.
    if root > 1:
        assert values.max() <= 1e-12
        return

    before = values[position < root - 1e-9]
    assert np.all(before <= 1e-12)
    # An interpolant that begins at zero, within rounding, has its root there.
    if coefficients[0] < -1e-9:
        assert abs(evaluate(coefficients, root, np.empty(6))) < 1e-9


def test_a_pair_of_crossings_inside_one_step_is_found():
    """The interpolant is below zero at both ends and above it for a thousandth of the step."""
    peak = 0.37
    width = 5e-4
    # -(s - a)(s - b)(1 + s^2) with a, b = peak -+ width: exactly of degree four.
    polynomial = -np.poly1d([1, -2 * peak, peak**2 - width**2]) * np.poly1d([1, 0, 1])
    first = polynomial.deriv()
    second = polynomial.deriv(2)

    at_ends = [[polynomial(s), first(s), second(s)] for s in (0, 1)]
    coefficients = quintic(*at_ends, 1.0)

    assert coefficients[0] < 0
    assert coefficients[5] < 0
    np.testing.assert_allclose(first_upcrossing(coefficients), peak - width, atol=1e-10)
    # Lowered by a little more than its peak, it never rises through zero.
    np.testing.assert_allclose(first_upcrossing(coefficients - 1.01 * polynomial(peak)), 2)


def test_the_first_of_three_roots_is_found():
    """The first root of (s - 0.2)(s - 0.3)(s - 0.9) is found, though bisection of the whole step leads to the last."""
    # The coefficients are those of s^3 - 1.4 s^2 + 0.51 s - 0.054 in Bernstein's form.
    coefficients = np.array([-0.054, -0.054 + 0.51 / 3, -0.054 + (2 * 0.51 - 1.4) / 3, 0.056])

    np.testing.assert_allclose(evaluate(coefficients, 0.5, np.empty(6)), 0.3 * 0.2 * -0.4)
    np.testing.assert_allclose(first_upcrossing(coefficients), 0.2, atol=1e-12)


def test_a_start_that_has_just_landed_is_no_crossing():
    """The start of s (s - 0.4), raised by the rounding of a landing, is no crossing: the next root, 0.4, is found."""
    coefficients = np.array([0.0, -0.2, 0.6]) + 1e-12

    assert first_upcrossing(coefficients) == 0.0
    np.testing.assert_allclose(first_upcrossing_after_start(coefficients, 1e-10), 0.4, atol=1e-10)
    # The start is a crossing with a tolerance below that rounding, and for a polynomial that rises at once.
    assert first_upcrossing_after_start(coefficients, 1e-13) == 0.0
    assert first_upcrossing_after_start(-coefficients, 1e-10) == 0.0
