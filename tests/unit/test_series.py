"""Series of a free motion: shifted, copied, and met with a clearance for the first time."""

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.contact.law import create_contacts
from vipetsc.dynamics.propagator.taylor import copy, evaluate, first_onset, shift

# What first_onset returns without an onset.
NONE = 2.0


def test_a_shifted_series_is_the_same_function():
    """A series shifted by 0.37 has at 0.43 the value that the series had at 0.80."""
    taylor = np.random.default_rng(2).normal(size=(3, 12))
    moved = np.empty_like(taylor)

    shift(taylor, 0.37, moved)

    for series, other in zip(taylor, moved, strict=True):
        np.testing.assert_allclose(evaluate(series, 0.8), evaluate(other, 0.43), rtol=1e-12)


def test_a_series_is_shifted_in_place_and_its_rows_are_copied_in_part():
    """A shift may write over its source; source and destination may have different numbers of rows."""
    taylor = np.random.default_rng(4).normal(size=(3, 7))
    expected = np.empty_like(taylor)
    shift(taylor, -0.6, expected)

    in_place = taylor.copy()
    shift(in_place, -0.6, in_place)
    assert in_place.tobytes() == expected.tobytes()

    rows = np.zeros((2, 7))
    copy(taylor, rows)
    np.testing.assert_array_equal(rows, taylor[:2])

    # A workspace for more DoFs keeps what it had of the others.
    room = np.full((5, 7), 9.0)
    shift(taylor, -0.6, room)
    np.testing.assert_array_equal(room[:3], expected)
    assert (room[3:] == 9.0).all()


@pytest.mark.parametrize(
    ("series", "clearances", "length", "onset"),
    [
        # At constant velocity: towards either side, the length just long enough or not, and no stop on one side.
        ([0.0, 1.0], (0.4, 0.4), 1.0, 0.4),
        ([0.0, -1.0], (0.4, 0.4), 1.0, 0.4),
        ([0.0, -1.0], (0.4, 0.3), 1.0, 0.3),
        ([0.0, -1.0], (0.4, 0.3), 0.35, 0.3),
        ([0.0, -1.0], (0.4, np.inf), 1.0, NONE),
        ([0.0, 1.0], (np.inf, 0.4), 1.0, NONE),
        ([0.0, 1.0], (0.4, 0.4), 0.39, NONE),
        # From rest: the bound on w'' is the parabola itself, which the first step of the search meets.
        ([0.0, 0.0, 1.0], (0.2, 0.2), 0.5, 0.2**0.5),
        ([0.0, 0.0, 1.0], (0.3, 0.3), 0.5, NONE),
        # Both sides within the length: the first of the two.
        ([0.0, 2.0, -6.0], (0.1, 0.1), 1.0, (1 - 0.4**0.5) / 6),
        ([0.0, -2.0, 6.0], (0.1, 0.1), 1.0, (1 - 0.4**0.5) / 6),
        # Away from a clearance on which it begins, and back; towards it; a little beyond it.
        ([0.3, -1.0, 1.0], (0.3, 0.3), 1.2, 1.0),
        ([0.3, 1.0, 0.0], (0.3, 0.3), 1.2, 0.0),
        ([0.3 * (1 + 1e-12), 1.0, 0.0], (0.3, 0.3), 1.2, 0.0),
        # At rest on a clearance, then away to the other side; almost at rest just before it.
        ([0.3, 0.0, -1.0], (0.3, 0.3), 1.0, 0.6**0.5),
        ([0.3 - 1e-11, 1e-9, 1.0], (0.3, 0.3), 1.0, 0.0),
        # Away at first, and back faster and faster: w = 4 s^3 - s.
        ([0.0, -1.0, 0.0, 4.0], (0.3, 0.3), 1.0, np.roots([4.0, 0.0, -1.0, -0.3]).real.max()),
        # A short approach with much curvature; one that turns just short of the clearance, or just beyond.
        ([0.0, 0.0, 0.0, 40.0], (0.3, 0.3), 1.0, (0.3 / 40) ** (1 / 3)),
        ([0.0, 1.0, -1.0], (0.25 + 1e-7, 0.25 + 1e-7), 1.0, NONE),
        ([0.0, 1.0, -1.0], (0.25 - 1e-7, 0.25 - 1e-7), 1.0, 0.5 - 1e-7**0.5),
    ],
)
def test_the_first_onset_is_met_to_rounding(series, clearances, length, onset):
    """The first onset of a polynomial motion is its first root at a clearance, in closed form."""
    site = create_contacts(small_case().model().contact, [clearances])[0]
    # An approach to LANDED_W, 1e-10 of a clearance, counts as an onset.
    assert first_onset(np.array(series), site, length) == pytest.approx(onset, rel=2e-10, abs=1e-14)
