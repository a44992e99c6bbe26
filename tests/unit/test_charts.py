"""Charts of a branch: unknowns of order one for initial displacements and period, and their derivative."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.models import CLEARANCE, reduced_model
from vipetsc.modes.shooting.charts import Chart, Grazing, Logarithmic, Relative

# In clearances, on either side of rest: no mass is at rest, where the logarithmic chart ends.
displacement = st.floats(0.2, 5).flatmap(lambda value: st.sampled_from([value, -value]))


@given(
    in_clearances=st.tuples(displacement, displacement),
    period=st.floats(1e-4, 10),
    kind=st.sampled_from([Relative, Logarithmic, Grazing]),
)
@settings(max_examples=60)
def test_charts_encode_decode_and_differentiate(in_clearances, period, kind):
    """Decoding inverts encoding, and the derivative is that of differences."""
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
    # In clearances; the larger of the two displacements is 5.
    in_clearances = [5.0 - gap, 5.0] if gap > 0 else [5.0, 5.0 + gap]
    x = CLEARANCE * np.array(in_clearances)

    xi = Relative(reduced_model(), x, 0.01).encode(x, 0.01)

    assert xi == pytest.approx([x[0] / (5 * CLEARANCE), gap / scale, 1.0], rel=1e-12)
