"""Charts of a branch: unknowns of order one for initial displacements and period, and their derivative."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.models import CLEARANCE, reduced_model
from vipetsc.lattice import Contact
from vipetsc.modes.shooting import Chart, Grazing, Relative
from vipetsc.modes.system import ContactPair, System

# A displacement in clearances, of either sign and never zero.
displacement = st.floats(0.2, 5).flatmap(lambda value: st.sampled_from([value, -value]))


@given(
    in_clearances=st.tuples(displacement, displacement),
    period=st.floats(1e-4, 10),
    kind=st.sampled_from([Relative, Grazing]),
)
@settings(max_examples=60)
def test_charts_encode_decode_and_differentiate(in_clearances, period, kind):
    """Decoding inverts encoding, and the derivative agrees with central differences."""
    x = CLEARANCE * np.array(in_clearances)
    gap = abs(x[1] - x[0]) / CLEARANCE
    # The grazing chart is singular at grazing itself.
    assume(abs(gap - 1) >= 1e-3)
    chart: Chart = kind(reduced_model(), x, period)

    xi = chart.encode(x, period)
    decoded, decoded_period = chart.decode(xi)
    assert decoded == pytest.approx(x, rel=1e-11, abs=1e-11 * CLEARANCE)
    assert decoded_period == pytest.approx(period, rel=1e-13)

    step = 1e-6
    for i, column in enumerate(chart.derivative(xi).T):
        move = step * np.eye(3)[i]
        forward = np.append(*chart.decode(xi + move))
        backward = np.append(*chart.decode(xi - move))
        difference = (forward - backward) / (2 * step)
        assert column == pytest.approx(difference, rel=1e-5, abs=1e-5 * np.abs(column).max())


@pytest.mark.parametrize(("gap", "scale"), [(0.1, 1.0), (-2.0, 2.0), (6.0, 5.0)])
def test_the_relative_chart_weighs_gaps_by_the_larger_of_gap_and_clearance(gap, scale):
    """A gap is divided by the clearance or by itself, whichever is more, but by no more than the largest amplitude."""
    # Displacements are in clearances, and the larger one is 5.
    in_clearances = [5.0 - gap, 5.0] if gap > 0 else [5.0, 5.0 + gap]
    x = CLEARANCE * np.array(in_clearances)

    xi = Relative(reduced_model(), x, 0.01).encode(x, 0.01)

    assert xi == pytest.approx([x[0] / (5 * CLEARANCE), gap / scale, 1.0], rel=1e-12)


def masses_in_contact(*pairs: tuple[int | None, int]) -> System:
    """Return three masses on springs to the ground and to each other, with contacts of these (host, resonator)."""
    law = Contact("bilinear", 5.0)
    springs = [(None, 0, 1.0), (None, 1, 1.0), (None, 2, 1.0), (0, 1, 0.5), (1, 2, 0.7), (2, 0, 0.9)]
    contacts = [ContactPair(host, resonator, 0.1 + 0.01 * i, law) for i, (host, resonator) in enumerate(pairs)]
    return System.assemble([1.0, 1.0, 1.0], springs, contacts)


@pytest.mark.parametrize(
    ("pairs", "unknowns"),
    [
        # The contacts form a ring, whose elongations add up to zero.
        (((0, 1), (1, 2), (2, 0)), {1: 0, 2: 1}),
        (((1, 0), (0, 1), (1, 2)), {0: 0, 2: 2}),
        # The contacts form a chain; then two have one resonator, whose unknown is the elongation of the last one.
        (((0, 1), (1, 2)), {1: 0, 2: 1}),
        (((None, 1), (0, 1)), {1: 1}),
    ],
)
def test_the_relative_chart_has_as_many_elongations_as_are_independent(pairs, unknowns):
    """Unknowns are the elongations of independent contacts and, for the other masses, displacements.

    ``unknowns`` names for each mass the contact whose elongation replaces its displacement.
    """
    system = masses_in_contact(*pairs)
    x = np.array([0.3, -0.2, 0.1])
    chart = Relative(system, x, 1.0)

    assert np.linalg.cond(chart.weights) < 10
    assert chart.decode(chart.encode(x, 1.0))[0] == pytest.approx(x, rel=1e-12)
    for mass in range(3):
        row = np.eye(3)[mass]
        if mass in unknowns:
            row = system.contact_rows[unknowns[mass]]
        weights = chart.weights[mass]
        assert weights / np.abs(weights).max() == pytest.approx(row / np.abs(row).max())
