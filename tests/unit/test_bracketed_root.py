"""Zeros of functions whose values are costly: how exact they are, and how many values they need."""

import math

import pytest

from vipetsc.modes.continuation.bracketed_root import bracketed_root

TOLERANCE = 1e-10
ROOT = 0.37


def smooth(x: float) -> float:
    return math.exp(x) - math.exp(ROOT)


def steep(x: float) -> float:
    return math.atan(1e4 * (x - ROOT))


def root_like(x: float) -> float:
    return math.copysign(math.sqrt(abs(x - ROOT)), x - ROOT)


def step(x: float) -> float:
    return math.copysign(1.0, x - ROOT)


def flat(x: float) -> float:
    return x**20 - ROOT**20


def flatter(x: float) -> float:
    return x**60 - ROOT**60


# Values that each function needs at most beyond those at both ends: as many as scipy's brentq, or fewer.
@pytest.mark.parametrize(
    ("function", "most"), [(smooth, 5), (steep, 20), (root_like, 30), (step, 40), (flat, 20), (flatter, 30)]
)
def test_a_zero_is_found_with_few_values(function, most):
    """The zero is within the tolerance, after as many values as Brent's method needs or fewer."""
    places = []

    def value(x):
        places.append(x)
        assert len(places) - 2 <= most
        return function(x)

    found = bracketed_root(value, 0.0, 1.0, TOLERANCE, {})
    assert abs(found - ROOT) <= TOLERANCE
    # The zero is one of the arguments: callers keep what they computed at an argument.
    assert found in places


def test_a_value_outside_the_bracket_gives_a_better_estimate():
    """The first estimate from three values is the zero of the parabola through them, which is exact for a parabola."""

    def parabola(x):
        return (x - ROOT) * (x + 2.0)

    counts = []
    for outside in ({}, {-1.0: parabola(-1.0)}):
        places = []

        def value(x, places=places):
            places.append(x)
            return parabola(x)

        assert abs(bracketed_root(value, 0.0, 1.0, TOLERANCE, outside) - ROOT) <= TOLERANCE
        counts.append(len(places) - 2)
    # Three values determine the parabola: the first estimate is its zero.
    assert counts[1] == 1
    assert counts[0] > 1


def test_a_value_outside_that_is_no_number_is_not_used():
    """A NaN outside the bracket does not change the result."""
    assert abs(bracketed_root(smooth, 0.0, 1.0, TOLERANCE, {-1.0: math.nan}) - ROOT) <= TOLERANCE


@pytest.mark.parametrize("end", [0.0, 1.0])
def test_an_end_may_be_the_zero(end):
    """A zero at an end of the bracket is found exactly."""
    assert bracketed_root(lambda x: x - end, 0.0, 1.0, TOLERANCE, {}) == end


def test_ends_of_one_sign_are_refused():
    with pytest.raises(ValueError, match="no change of sign between 0 and 1: 1 and 2"):
        bracketed_root(lambda x: 1.0 + x, 0.0, 1.0, TOLERANCE, {})
