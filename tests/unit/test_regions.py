"""Regions of a branch and power laws of its slope in them, from slopes with known exponents."""

from __future__ import annotations

import numpy as np
import pytest

from vipetsc.modes.branches.regions import assign_regions, fit_slope

# The energy in J at which the contacts of the branches below begin.
FIRST_CONTACT = 1e-2


def two_powers(energy: np.ndarray, factor: float, peak: float, exponent: float) -> tuple[np.ndarray, np.ndarray]:
    """Return factor/E + peak (E/E_0)^exponent beyond the first contact E_0, and the second term's fraction of it."""
    touched = energy > FIRST_CONTACT
    second = peak * (energy / FIRST_CONTACT) ** exponent
    slope = np.where(touched, factor / energy + second, 0.0)
    return slope, second / np.where(touched, slope, 1.0)


def test_regions_and_power_law_of_a_constructed_branch():
    """A slope of E^-1 after a steep grazing peak has regions I to IV in this order, and the exponent -1 in IV."""
    energy = np.geomspace(1e-3, 1e6, 400)
    touched = energy > FIRST_CONTACT
    slope, _ = two_powers(energy, factor=1e3, peak=1e4, exponent=-6.0)
    # The fraction of time in contact approaches 1, as the clearance becomes negligible.
    decades = np.log10(np.maximum(energy / FIRST_CONTACT, 1))
    closed = np.where(touched, 1 - 0.5 / (1 + decades**2), 0.0)

    region = assign_regions(energy, slope, touched.astype(int), closed)

    assert np.all(np.diff(region) >= 0)
    assert set(region) == {1, 2, 3, 4}
    assert np.all((region == 1) == ~touched)
    assert closed[region == 4].min() >= 0.95 > closed[region == 3].max()

    law = fit_slope(energy, slope, region)["IV"]
    # In region IV the rest of the peak changes the exponent by less than a thousandth.
    assert law["exponent"] == pytest.approx(-1, abs=1e-3)
    assert law["adjusted_r2"] > 0.9999
    assert law["points"] == np.sum(region == 4)


def test_the_law_of_region_two_is_that_of_its_falling_part():
    """The law of region II is fitted after the peak of the slope and the last point where the branch goes backwards."""
    energy = np.geomspace(1, 100, 60)
    first = np.full(5, 9.0)
    backwards = [-1.0]
    rising = energy[6:20] ** 3
    falling = energy[20:] ** -2.5 * energy[20] ** 5.5
    slope = np.concatenate([first, backwards, rising, falling])

    laws = fit_slope(energy, slope, np.full(60, 2))

    assert laws["II"]["exponent"] == pytest.approx(-2.5, abs=1e-12)
    assert laws["II"]["points"] == len(falling)


def test_a_steep_fall_from_the_peak_is_grazing_even_where_it_is_steady():
    """A steady exponent of -3 after the peak is region II; region III begins where it has settled above -2.

    The slope E^-1 + c E^-3 has the exponent -1 - 2 a, which grows by 4 a (1 - a): by 1/2 at a (1 - a) = 1/8.
    """
    energy = np.geomspace(1e-3, 1e6, 4000)
    touched = energy > FIRST_CONTACT
    slope, fraction = two_powers(energy, factor=1.0, peak=1e8, exponent=-3.0)

    region = assign_regions(energy, slope, touched.astype(int), np.zeros(4000))

    assert fraction[region == 3].max() == pytest.approx((1 - np.sqrt(0.5)) / 2, rel=0.02)


def test_regions_without_contacts():
    """A linear branch is region I throughout; one of smooth springs alone belongs to no region."""
    energy = np.geomspace(1e-3, 1e3, 50)
    episodes = np.zeros(50, int)
    closed = np.zeros(50)

    assert set(assign_regions(energy, np.zeros(50), episodes, closed)) == {1}
    assert set(assign_regions(energy, 1 / energy, episodes, closed)) == {0}
