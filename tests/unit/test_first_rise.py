"""The first change of a gap within a step: pairs of changes, near misses and starts on a change, in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from scipy.integrate import DOP853

from vipetsc.modes import flow
from vipetsc.modes.flow import CROSSING, EXTREMUM, NONE, first_rise

# Rounding of a gap of order one.
ROUNDING = 1e-12


def interpolation_error(coefficients: np.ndarray) -> float:
    """Return the error of the interpolant that the search allows, from its coefficients of orders 4 and 5."""
    return 0.01 * (abs(coefficients[5]) + 0.3 * abs(coefficients[4]))


def starting_gap(mantissas: tuple[float, ...], exponents: tuple[float, ...], start: str) -> np.ndarray:
    """Return a polynomial at or below zero at 0: anywhere, on zero and falling, or at an extremum."""
    coefficients = np.array(mantissas) * 10.0 ** np.array(exponents)
    coefficients[0] = -abs(coefficients[0])
    if start == "landed":
        coefficients[0] = 0.0
        coefficients[1] = -abs(coefficients[1])
    if start == "extremum":
        coefficients[1] = 0.0
    return coefficients


@pytest.mark.slow
@given(
    mantissas=st.tuples(*[st.floats(-1, 1)] * 6),
    exponents=st.tuples(*[st.floats(-3, 0)] * 6),
    start=st.sampled_from(["below", "landed", "extremum"]),
)
@example((0.0, 0.0, 0.5, -1.0, 0.0, 1.0), (0.0, 0.0, -3.0, -2.25, 0.0, -1.0), "below")
# The slope falls through zero in the quarter in which it also rises from zero.
@example((-8e-75, 0.0, 2e-190, 1.0, 0.0, -1.0), (0.0, 0.0, 0.0, -2.0, 0.0, -1.0), "below")
@settings(max_examples=400)
def test_the_first_change_of_a_gap_is_found(mantissas, exponents, start):
    """No sampled gap above the interpolant's error is missed, and none comes before the change that is found."""
    coefficients = starting_gap(mantissas, exponents, start)
    margin = interpolation_error(coefficients)

    position, outcome = first_rise(tuple(coefficients))

    sampled = np.linspace(0, 1, 4001)[1:]
    gap = Polynomial(coefficients)(sampled)
    # Gaps count from 1.01 margins on, since rounding decides on the margin itself.
    clearly_above = np.nonzero(gap > 1.01 * margin + ROUNDING)[0]
    if clearly_above.size:
        assert outcome != NONE
        assert position <= sampled[clearly_above[0]]

    if outcome == NONE:
        assert gap.max() <= ROUNDING + 1.01 * margin
    else:
        before = gap[sampled < position - 1e-9]
        assert before.max(initial=-1.0) <= ROUNDING + margin
        allowed = ROUNDING if outcome == CROSSING else margin + ROUNDING
        assert abs(Polynomial(coefficients)(position)) <= allowed


def test_a_hump_next_to_a_dip_in_one_quarter_of_a_step_is_found():
    """The gap of a contact that has just opened rises through zero and falls again in the first fifth of a step."""
    position, outcome = first_rise((0.0, -4.6e-4, 5.0e-2, -0.31, 2.2e-4, 1.4e-3))

    assert outcome == CROSSING
    assert 0 < position < 0.02


def test_a_hump_within_the_interpolants_error_comes_before_the_root_behind_it():
    """A maximum of the gap that is smaller than the interpolant's error is found before the root behind it.

    The slope (x - 0.05)(x - 0.15) has a maximum at 0.05, and the gap rises again within the same quarter of the step.
    """
    rise = Polynomial.fromroots([0.05, 0.15]).integ().coef
    # The coefficient of order 5 makes the error 1e-5, ten times the value 1e-6 at the maximum.
    coefficients = np.append(rise, [0.0, 1e-3])
    coefficients[0] = 1e-6 - Polynomial(coefficients)(0.05)

    position, outcome = first_rise(tuple(coefficients))

    assert outcome == EXTREMUM
    assert position == pytest.approx(0.05, abs=1e-3)


def test_the_second_hump_of_a_gap_is_found():
    """The change before the second maximum is found, where the first one is below zero.

    The slope -(x - 0.1)(x - 0.45)(x - 0.9) has maxima at 0.1, of -2e-3, and at 0.9, of 2.3e-3.
    """
    slope = -Polynomial.fromroots([0.1, 0.45, 0.9])
    coefficients = np.append(slope.integ().coef, 0.0)
    coefficients[0] = -2e-3 - slope.integ()(0.1)

    position, outcome = first_rise(tuple(coefficients))

    assert outcome == CROSSING
    assert 0.45 < position < 0.9
    assert Polynomial(coefficients)(position) == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize(
    ("largest_in_errors", "expected"), [(0.5, EXTREMUM), (-0.5, EXTREMUM), (-2, NONE), (2, CROSSING)]
)
def test_a_gap_that_nearly_closes_is_left_to_the_flow(largest_in_errors, expected):
    """A maximum near 0.4 is an extremum if it is zero up to the interpolant's error, else a crossing or no change."""
    coefficients = np.array([0.0, 0.8, -1.0, 0.0, 0.0, -0.02])
    turns = Polynomial(coefficients).deriv().roots()
    inside = (turns.imag == 0) & (turns.real > 0) & (turns.real < 1)
    top = turns[inside].real[0]
    coefficients[0] = largest_in_errors * interpolation_error(coefficients) - Polynomial(coefficients)(top)

    position, outcome = first_rise(tuple(coefficients))

    assert outcome == expected
    if outcome == EXTREMUM:
        assert position == pytest.approx(top, abs=1e-8)


@pytest.mark.parametrize("rounding", [1e-17, 0.0, -1e-17])
def test_a_step_that_starts_on_a_near_miss_leaves_it(rounding):
    """A gap that starts at a maximum below zero, with a slope that is zero but for rounding, has no change."""
    assert first_rise((-1e-4, rounding, -1.0, 0.0, 0.5, 0.3)) == (1.0, NONE)


def test_the_tableau_is_the_one_of_dop853():
    """The coefficients in the package's table are SciPy's to the bit."""
    for name in ("A", "B", "E3", "E5"):
        ours = getattr(flow, name)
        reference = getattr(DOP853, name)
        # SciPy's tables also have the stages of a dense output, which the flow does not use.
        same_part = reference[tuple(slice(n) for n in ours.shape)]
        assert np.array_equal(ours, same_part), name
