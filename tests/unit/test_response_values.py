"""The largest value of a frequency response and the widest range below a level, for curves in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from vipetsc.spectra.responses import CurvePart, largest_response, widest_gap


def part(parameter, values, is_regular=None) -> CurvePart:
    """Return the part of a curve through these points, with absolute values of complex ones and its length."""
    p = np.asarray(parameter, float)
    y = np.asarray(values)
    length = np.append(0.0, np.cumsum(np.hypot(np.diff(p), np.abs(np.diff(y)))))
    regular = np.ones(len(p), bool) if is_regular is None else np.asarray(is_regular)
    return CurvePart(p, np.abs(y), length, regular)


def resonance(p):
    """Return the values of a resonance 1/(1 + i (p - 0.3137)/0.2), whose largest absolute value is 1 at p = 0.3137."""
    return 1 / (1 + 1j * (p - 0.3137) / 0.2)


def test_the_largest_value_between_points_converges():
    """The error of the parabola through three points falls by more than 8 with twice the points, wherever they lie."""
    errors = []
    for count in (21, 41, 81):
        p, spacing = np.linspace(-1, 1, count, retstep=True)
        of_places = []
        for shift in np.linspace(0, spacing, 10, endpoint=False):
            of_places.append(abs(largest_response([part(p, resonance(p + shift))], -1, 1) - 1))
        errors.append(max(of_places))
    assert errors[0] < 5e-3
    assert errors[1] < errors[0] / 8
    assert errors[2] < errors[1] / 8


def test_the_largest_value_is_that_of_the_range_and_of_all_parts():
    """The largest value includes the ends of the range and all parts of a curve; without points it is NaN."""
    p = np.linspace(-1, 1, 401)
    whole = part(p, resonance(p))
    assert largest_response([whole], -1, 0.0123) == pytest.approx(abs(resonance(0.0123)), abs=5e-5)
    assert largest_response([whole, part([0.1, 0.2], [3.0, 2.0])], -1, 0.15) == 3.0
    assert np.isnan(largest_response([whole], 2, 3))


def test_special_points_close_to_others_do_not_spoil_the_parabola():
    """Points that are not regular count as values and not for the parabola; uneven points yield the largest one."""
    y = [0.0, 1.0, 0.9, 0.0]
    steep = part([0.0, 1.0, 1.001, 2.0], y, is_regular=[True, True, False, True])
    assert largest_response([steep], 0, 2) == pytest.approx(1.0, abs=0.1)
    uneven = CurvePart(np.array([0.0, 1.0, 1.001]), np.array(y[:3]), np.array([0.0, 1.0, 1.001]), np.ones(3, bool))
    assert largest_response([uneven], 0, 2) == 1.0


def test_gaps_of_a_resonance_are_those_of_its_formula():
    """|y| < 1/2 holds beyond 0.2 sqrt(3) from the resonance on either side; the wider one of both ranges counts.

    The gap below a level above all values is the whole range.
    """
    p = np.linspace(-1, 1, 2001)
    curve = [part(p, resonance(p))]
    half_width = 0.2 * np.sqrt(3)
    assert widest_gap(curve, 0.5, -1, 1) == pytest.approx(0.3137 - half_width + 1, abs=1e-5)
    assert widest_gap(curve, 0.5, 0.2, 1) == pytest.approx(1 - 0.3137 - half_width, abs=1e-5)
    assert widest_gap(curve, 2.0, -1, 1) == 2.0
    assert widest_gap(curve, 1e-3, -1, 1) == 0.0


def test_where_a_curve_folds_its_largest_state_counts():
    """A state on the upper part of a fold, or of an isolated curve, closes the gap below it."""
    folded = part([0.0, 3.0, 2.0, 5.0], [0.0, 3.0, 0.5, 0.5])
    assert widest_gap([folded], 1.0, 0, 5) == pytest.approx(2.0)  # 0 to 1, then 3 to 5
    isolated = part([3.5, 4.0, 3.5], [2.0, 2.0, 2.0])
    assert widest_gap([folded, isolated], 1.0, 0, 5) == pytest.approx(1.0)
    within = part([2.5, 2.6], [2.0, 2.0])
    assert widest_gap([folded, within], 1.0, 0, 5) == pytest.approx(2.0)
