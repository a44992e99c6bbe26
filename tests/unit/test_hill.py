"""Hill's method: what a count of zeros says, and growth where the determinant is large."""

import numpy as np
import pytest

from vipetsc.lattice import Contact, DenseCompliance
from vipetsc.modes.balance import hill
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.balance.hill import ContourLine, Hill
from vipetsc.modes.balance.stops import Stops


@pytest.mark.parametrize(
    ("half_turns", "count"), [(0.0, 0), (-2.1, 2), (0.1, 0), (-1.5, -1), (2.0, -1), (1.0, -1), (np.nan, -1)]
)
def test_only_a_whole_number_of_turns_counts_zeros(half_turns, count):
    """D turns by half a circle in the negative sense for a zero; a pole, or no number, decides nothing."""
    logs = np.array([0.0, 1j * np.pi * half_turns])
    assert ContourLine(np.array([0.0, 0.5]), logs, (1.0, 1.0)).zeros_beyond() == count


def test_growth_is_found_where_the_determinant_is_cut_off(monkeypatch):
    """Beside a stiff spring D is e^60: its phases alone would not do for guesses of the exponents."""
    monkeypatch.setattr(hill, "LARGEST_LOG", 20.0)
    order = 41
    touching = Stops.both(Contact("bilinear", 30.0), 1.0)
    closed = Stops(Contact("bilinear", 1e3), -1.0, np.inf)

    def fastest(*stops: Stops) -> complex | None:
        z = np.zeros((len(stops), order + 1), complex)
        z[0, 1] = 1.3
        stiffness = np.diag([0.49, 2.2][: len(stops)])
        compliance = DenseCompliance(np.ones(len(stops)), stiffness, np.eye(len(stops)))
        series = SiteForces(stops).series(z, 1.0)
        return Hill(compliance, 1.0, order, odd=False, finite=True).fastest(series)

    alone = fastest(touching)
    assert alone is not None
    assert alone.real > 0.5
    assert fastest(touching, closed) == pytest.approx(alone, rel=1e-9)
