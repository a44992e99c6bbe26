"""First roots and values of quintic Hermite interpolants, against dense sampling."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BPoly

from vipetsc.contact.search import bernstein, evaluate, first_upcrossing, first_upcrossing_after_start

coefficient = st.floats(-1, 1, allow_subnormal=False)


def quintic(w0, v0, a0, w1, v1, a1, h):
    b = np.empty(6)
    bernstein(np.array([w0, v0, a0]), np.array([w1, v1, a1]), h, b)
    return b


@given(st.tuples(*[coefficient] * 6), st.floats(0.1, 3))
def test_bernstein_form_matches_the_hermite_data(data, h):
    w0, v0, a0, w1, v1, a1 = data
    b = quintic(*data, h)
    oracle = BPoly.from_derivatives([0, h], [[w0, v0, a0], [w1, v1, a1]])
    s = np.linspace(0, 1, 17)
    np.testing.assert_allclose([evaluate(b, x, np.empty(6)) for x in s], oracle(s * h), atol=1e-12)


@given(st.lists(coefficient, min_size=6, max_size=6))
def test_first_rise_is_the_first_sign_change(b):
    b = np.array(b)
    root = first_upcrossing(b)
    s = np.linspace(0, 1, 4001)
    values = BPoly(b[:, None], [0, 1])(s)
    positive = np.nonzero(values > 1e-12)[0]
    if root > 1:
        assert positive.size == 0
        return
    before = values[s < root - 1e-9]
    assert np.all(before <= 1e-12)
    if b[0] < -1e-9:
        assert abs(evaluate(b, root, np.empty(6))) < 1e-9


def test_a_pair_of_crossings_inside_one_step_is_found():
    """The interpolant is below zero at both ends and above it for a thousandth of the step."""
    peak, width = 0.37, 5e-4
    # -(s - a)(s - b)(1 + s^2) with a, b = peak -+ width: exactly of degree four.
    polynomial = -np.poly1d([1, -2 * peak, peak**2 - width**2]) * np.poly1d([1, 0, 1])
    first, second = polynomial.deriv(), polynomial.deriv(2)
    b = quintic(polynomial(0), first(0), second(0), polynomial(1), first(1), second(1), 1.0)
    assert b[0] < 0
    assert b[5] < 0
    np.testing.assert_allclose(first_upcrossing(b), peak - width, atol=1e-10)
    np.testing.assert_allclose(first_upcrossing(b - 1.01 * polynomial(peak)), 2)


def test_a_start_that_has_just_landed_is_no_crossing():
    """s (s - .4), raised by the rounding of a landing: on zero and falling at first."""
    b = np.array([0.0, -0.2, 0.6]) + 1e-12
    assert first_upcrossing(b) == 0.0
    np.testing.assert_allclose(first_upcrossing_after_start(b, 1e-10), 0.4, atol=1e-10)
    assert first_upcrossing_after_start(b, 1e-13) == 0.0
    assert first_upcrossing_after_start(-b, 1e-10) == 0.0
