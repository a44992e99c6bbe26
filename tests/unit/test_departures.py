"""Departures of contacts: the images of one departure form a family, and two orbits differ by a number of families."""

import pytest

from vipetsc.modes.departures import Departure, changed_families, families, within_arc

A = Departure(middle=0.03, length=0.1)


@pytest.mark.parametrize(
    "image",
    [
        A,
        Departure(0.53, 0.1),  # half a period later
        Departure(-0.03, 0.1),  # run backwards
        Departure(0.47, 0.1),  # both
        Departure(1.03, 0.1),
    ],
)
def test_symmetries_keep_the_length_and_move_by_half_a_period(image):
    """A departure's image by half a period, by reversal of time, by both or by a period is in its family."""
    assert families([A, image]) == {2: 1}


@pytest.mark.parametrize("other", [Departure(0.03, 0.11), Departure(0.05, 0.1), Departure(0.28, 0.1)])
def test_contacts_at_other_instants_or_of_other_lengths_are_none(other):
    """A contact of another length or at another instant, such as a quarter of a period later, is no image."""
    assert families([A, other]) == {1: 2}


def test_short_contacts_are_compared_by_their_depth():
    """Contacts are equal if the squares of their lengths are, as the depth goes with the square.

    Rounding of the depth changes the length of a grazing contact by much more.
    """
    assert families([Departure(0, 1e-6), Departure(0, 2e-6)]) == {2: 1}
    assert families([Departure(0, 1e-2), Departure(0, 2e-2)]) == {1: 2}


def test_images_that_appear_together_are_one_change():
    """Departures that appear or vanish with their images are one changed family."""
    pair = [A, Departure(0.47, 0.1)]
    assert changed_families([], pair) == 1
    assert changed_families([Departure(0, 0.3), *pair], [Departure(0, 0.3)]) == 1
    assert changed_families(pair, [*pair, Departure(0.1, 0.02), Departure(0.4, 0.02)]) == 1


def test_orbits_of_another_symmetry_are_as_many_changes_as_families():
    """Three contacts without images differ from rest by three families, and from three pairs of images by six."""
    three = [Departure(0.01 * i, 0.1 + 0.01 * i) for i in range(3)]
    doubled = three + [departure._replace(middle=departure.middle + 0.5) for departure in three]
    assert changed_families([], three) == 3
    assert changed_families(three, doubled) == 6
    assert changed_families([A], [A, A, A]) == 2


def test_what_an_arc_cuts_off_goes_on_as_its_mirror_image():
    """A contact that the end of an arc from rest to rest cuts off is as long again beyond it, by reflection.

    The three contacts are closed at the start, in the middle and at the end of half a period.
    """
    spans = [(0.0, 0.05), (0.2, 0.3), (0.45, 0.5)]
    assert within_arc(spans, 0.5, rest_after=True) == [
        Departure(0.0, pytest.approx(0.1)),
        Departure(0.25, pytest.approx(0.1)),
        Departure(0.5, pytest.approx(0.1)),
    ]
    # An arc over a quarter of a period ends at the centre, where contacts are not reflected.
    assert within_arc([(0.2, 0.25)], 0.25, rest_after=False) == [Departure(0.225, pytest.approx(0.05))]
