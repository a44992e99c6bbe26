"""Series of a free motion: shifts, copies, and the first onset at a clearance."""

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.contact.law import create_contacts
from vipetsc.dynamics.propagator.taylor import copy, evaluate, first_onset, shift

# The value of first_onset if there is no onset.
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

    # A workspace for more DoFs keeps the other rows.
    room = np.full((5, 7), 9.0)
    shift(taylor, -0.6, room)
    np.testing.assert_array_equal(room[:3], expected)
    assert (room[3:] == 9.0).all()


@pytest.mark.parametrize(
    ("series", "clearances", "length", "onset"),
    [
        # Motions of constant velocity to either side: the length is just long enough or not; one side has no stop.
        ([0.0, 1.0], (0.4, 0.4), 1.0, 0.4),
        ([0.0, -1.0], (0.4, 0.4), 1.0, 0.4),
        ([0.0, -1.0], (0.4, 0.3), 1.0, 0.3),
        ([0.0, -1.0], (0.4, 0.3), 0.35, 0.3),
        ([0.0, -1.0], (0.4, np.inf), 1.0, NONE),
        ([0.0, 1.0], (np.inf, 0.4), 1.0, NONE),
        ([0.0, 1.0], (0.4, 0.4), 0.39, NONE),
        # Motions from rest: the bound on w'' is that of the parabola itself, which the first step of the search finds.
        ([0.0, 0.0, 1.0], (0.2, 0.2), 0.5, 0.2**0.5),
        ([0.0, 0.0, 1.0], (0.3, 0.3), 0.5, NONE),
        # Motions that reach both sides within the length have the earlier onset.
        ([0.0, 2.0, -6.0], (0.1, 0.1), 1.0, (1 - 0.4**0.5) / 6),
        ([0.0, -2.0, 6.0], (0.1, 0.1), 1.0, (1 - 0.4**0.5) / 6),
        # Motions that begin at a clearance: away from it and back, outwards, and outwards from a little beyond it.
        ([0.3, -1.0, 1.0], (0.3, 0.3), 1.2, 1.0),
        ([0.3, 1.0, 0.0], (0.3, 0.3), 1.2, 0.0),
        ([0.3 * (1 + 1e-12), 1.0, 0.0], (0.3, 0.3), 1.2, 0.0),
        # A motion from rest at a clearance to the other side, and one almost at rest just before a clearance.
        ([0.3, 0.0, -1.0], (0.3, 0.3), 1.0, 0.6**0.5),
        ([0.3 - 1e-13, 1e-11, 1.0], (0.3, 0.3), 1.0, 0.0),
        # The motion w = 4 s^3 - s goes away first and returns faster and faster.
        ([0.0, -1.0, 0.0, 4.0], (0.3, 0.3), 1.0, np.roots([4.0, 0.0, -1.0, -0.3]).real.max()),
        # A motion of high curvature; motions that turn just before the clearance, or just beyond it.
        ([0.0, 0.0, 0.0, 40.0], (0.3, 0.3), 1.0, (0.3 / 40) ** (1 / 3)),
        ([0.0, 1.0, -1.0], (0.25 + 1e-7, 0.25 + 1e-7), 1.0, NONE),
        ([0.0, 1.0, -1.0], (0.25 - 1e-7, 0.25 - 1e-7), 1.0, 0.5 - 1e-7**0.5),
    ],
)
def test_the_first_onset_is_met_to_rounding(series, clearances, length, onset):
    """The first onset of a polynomial motion is its first root at a clearance, in closed form."""
    site = create_contacts(small_case().model().chain.sites[0].law, [clearances])[0]
    # A distance from the clearance below the tolerance of a landing, 2e-13 here, counts as an onset.
    assert first_onset(np.array(series), site, length) == pytest.approx(onset, rel=2e-10, abs=1e-14)
