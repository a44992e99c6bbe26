"""The curve of a branch, and which of its states are at the bottom."""

import numpy as np
import pytest
import xarray as xr

from vipetsc.figures import frequency_energy


def test_a_branch_is_drawn_through_its_points_along_its_tangents_and_keeps_a_corner_where_a_contact_grazes():
    """Points of a circle in logarithms; a cubic between points 40 degrees apart stays within 3e-4 of a tenth of it."""
    angle = np.radians(np.arange(0, 330, 40.0))
    frequency, energy = 100 * np.exp(0.1 * np.sin(angle)), np.exp(0.1 * np.cos(angle))
    rate, energy_rate = 0.1 * np.cos(angle) * frequency, -0.1 * np.sin(angle) * energy
    with np.errstate(divide="ignore"):
        columns = {"tangent_period": -rate / frequency**2, "slope": rate / energy_rate}
    columns |= {"energy": energy, "frequency": frequency, "kind": np.full(len(angle), "regular")}
    branch = xr.Dataset({name: ("point", values) for name, values in columns.items()})
    fine_energy, fine_frequency = frequency_energy.smooth(branch)
    assert np.allclose(fine_energy[:: frequency_energy.FINE], energy) and np.allclose(
        fine_frequency[:: frequency_energy.FINE], frequency
    )
    assert np.abs(np.hypot(np.log(fine_energy), np.log(fine_frequency / 100)) - 0.1).max() < 3e-4  # a chord: 6e-3
    # Two straight lines that meet at a grazing point, whose tangent is that of either: no step leaves its line.
    level = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    frequency = np.where(level > 4, 100 * (level / 4) ** 2, 100.0)
    for at_grazing in (1e-9, 50.0):
        slope = np.where(level > 4, 2 * frequency / level, np.where(level < 4, 1e-12, at_grazing))
        columns = {"energy": level, "frequency": frequency, "slope": slope, "tangent_period": -slope / frequency**2}
        columns["kind"] = np.array(["regular", "regular", "grazing", "regular", "regular"])
        fine_energy, fine_frequency = frequency_energy.smooth(xr.Dataset({n: ("point", v) for n, v in columns.items()}))
        exact = np.where(fine_energy > 4, 100 * (fine_energy / 4) ** 2, 100.0)
        assert fine_frequency == pytest.approx(exact, rel=1e-9)


def test_of_states_with_one_energy_that_of_the_lowest_frequency_is_marked():
    """A branch that goes back from 4 J to 2 J at higher frequencies, and on at lower ones."""
    branch = xr.Dataset(
        {
            "energy": ("point", [1.0, 3.0, 4.0, 3.5, 2.0, 2.5, 5.0]),
            "frequency": ("point", [1.0, 3.0, 4.0, 5.0, 2.9, 1.0, 5.9]),
        }
    )
    assert frequency_energy.lowest(branch).tolist() == [True, False, False, False, False, True, True]
