"""The first change of a gap within a step: pairs of changes, near misses and starts on a change, in closed form."""

from __future__ import annotations

from math import comb

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from scipy.integrate import DOP853

from vipetsc.modes import flow
from vipetsc.modes.flow import NONE, UNDECIDED

# Rounding of a gap of order one.
ROUNDING = 1e-12


def first_rise(coefficients: np.ndarray) -> float:
    """Return the position at which a gap first rises, by its coefficients in powers of the position."""
    bernstein = [sum(comb(k, i) / comb(5, i) * coefficients[i] for i in range(k + 1)) for k in range(6)]
    return flow.first_rise(np.array(bernstein), 1e-15, np.empty(6))


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


@given(
    mantissas=st.tuples(*[st.floats(-1, 1)] * 6),
    exponents=st.tuples(*[st.floats(-3, 0)] * 6),
    start=st.sampled_from(["below", "landed", "extremum"]),
)
@example((0.0, 0.0, 0.5, -1.0, 0.0, 1.0), (0.0, 0.0, -3.0, -2.25, 0.0, -1.0), "below")
# The slope falls through zero in the quarter in which it also rises from zero.
@example((-8e-75, 0.0, 2e-190, 1.0, 0.0, -1.0), (0.0, 0.0, 0.0, -2.0, 0.0, -1.0), "below")
@settings(max_examples=150)
def test_the_first_change_of_a_gap_is_found(mantissas, exponents, start):
    """No sampled gap above the interpolant's error is missed, and none comes before the change that is found."""
    coefficients = starting_gap(mantissas, exponents, start)
    margin = interpolation_error(coefficients)

    position = first_rise(coefficients)

    sampled = np.linspace(0, 1, 4001)[1:]
    gap = Polynomial(coefficients)(sampled)
    # Gaps count from 1.01 margins on, since rounding decides on the margin itself.
    clearly_above = np.nonzero(gap > 1.01 * margin + ROUNDING)[0]
    if clearly_above.size:
        assert position != NONE
        assert position <= sampled[clearly_above[0]]
    if position == NONE:
        assert gap.max() <= ROUNDING + 1.01 * margin
    elif position != UNDECIDED:
        before = gap[sampled < position - 0.5 * flow.DECIDED]
        assert before.max(initial=-1.0) <= ROUNDING + margin
        # The root is as near as the interpolant's error is decided.
        near = np.abs(sampled - position) <= flow.DECIDED
        assert gap[near].min(initial=0.0) <= ROUNDING + margin
        assert gap[near].max(initial=0.0) >= -ROUNDING - margin


def test_a_hump_within_the_interpolants_error_comes_before_the_root_behind_it():
    """A maximum of the gap that is smaller than the interpolant's error keeps the root behind it undecided.

    The slope (x - 0.05)(x - 0.15) has a maximum at 0.05, and the gap rises again within the same quarter of the step.
    """
    rise = Polynomial.fromroots([0.05, 0.15]).integ().coef
    # The coefficient of order 5 makes the error 1e-5 at the end and 5e-7 at the maximum, whose value is 1e-7.
    coefficients = np.append(rise, [0.0, 1e-3])
    coefficients[0] = 1e-7 - Polynomial(coefficients)(0.05)

    assert first_rise(coefficients) == UNDECIDED


def test_the_second_hump_of_a_gap_is_found_in_a_shorter_step():
    """The change before the second maximum is found, where the first one is below zero.

    The slope -(x - 0.1)(x - 0.45)(x - 0.9) has maxima at 0.1, of -2e-3, and at 0.9, of 2.3e-3.
    """
    slope = -Polynomial.fromroots([0.1, 0.45, 0.9])
    gap = slope.integ() - 2e-3 - slope.integ()(0.1)
    halves = [gap(Polynomial([begin, 0.5])) for begin in (0.0, 0.5)]
    # The root is at 0.768.
    shorter = gap(Polynomial([0.7, 0.1]))

    assert first_rise(np.append(gap.coef, 0.0)) == UNDECIDED
    assert first_rise(np.append(halves[0].coef, 0.0)) == NONE
    position = first_rise(np.append(shorter.coef, 0.0))
    assert shorter(position) == pytest.approx(0, abs=1e-5)
    assert 0.0 < position < 1.0


@pytest.mark.parametrize(
    ("largest_in_errors", "expected"), [(0.2, UNDECIDED), (-0.2, UNDECIDED), (-2, NONE), (2e4, None)]
)
def test_a_gap_that_nearly_closes_is_left_to_shorter_steps(largest_in_errors, expected):
    """A maximum near 0.4 that is zero up to the interpolant's error decides nothing; others are changes or none."""
    coefficients = np.array([0.0, 0.8, -1.0, 0.0, 0.0, -1e-6])
    turns = Polynomial(coefficients).deriv().roots()
    inside = (turns.imag == 0) & (turns.real > 0) & (turns.real < 1)
    top = turns[inside].real[0]
    coefficients[0] = largest_in_errors * interpolation_error(coefficients) - Polynomial(coefficients)(top)

    position = first_rise(coefficients)

    if expected is None:
        assert Polynomial(coefficients)(position) == pytest.approx(0, abs=1e-7)
        assert position < top
    else:
        assert position == expected


@pytest.mark.parametrize("rounding", [1e-17, 0.0, -1e-17])
def test_a_step_that_starts_on_a_near_miss_leaves_it(rounding):
    """A gap that starts at a maximum below zero, with a slope that is zero but for rounding, has no change."""
    assert first_rise((-0.05, rounding, -1.0, 0.0, 0.5, 0.3)) == NONE


def test_the_tableau_is_the_one_of_dop853():
    """The coefficients in the package's table are SciPy's to the bit."""
    for name in ("A", "B", "E3", "E5"):
        ours = getattr(flow, name)
        reference = getattr(DOP853, name)
        # SciPy's tables also have the stages of a dense output, which the flow does not use.
        same_part = reference[tuple(slice(n) for n in ours.shape)]
        assert np.array_equal(ours, same_part), name
