"""Figures of a laboratory's lattices: the losses of dashpots, the decay of waves, impacts at many sites."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from tests.conftest import small_case
from vipetsc.figures import impact_panels, runs
from vipetsc.lattice import four_band, max_group_velocity


def test_bands_of_a_damped_cell_show_its_decay():
    """A third panel shows the decay of waves per cell, zeta omega/v_g in a band and much more in a gap."""
    cell = small_case(lattice={"damping": {"loss": {"2": 0.02}}}).lattice.unit_cell()
    *_, decay = runs.bands(cell, 1000.0).axes
    rates = np.asarray(decay.lines[0].get_xdata())
    omega = np.asarray(decay.lines[0].get_ydata())

    # A loss of 0.02 is twice the damping ratio.
    _, frequency, speed = max_group_velocity(cell, 2)
    in_band = np.interp(frequency / 1e3, omega, rates)
    assert in_band == pytest.approx(0.01 * frequency / speed, rel=1e-2)
    in_gap = rates[np.argmin(np.abs(omega - 0.65))]
    assert in_gap > 20 * in_band

    # An undamped cell has no third panel.
    assert len(runs.bands(four_band(), 1000.0).axes) == 2


def impacts_of(sites: int, episodes: int, loss: float = 0.0) -> xr.Dataset:
    """A log of ``episodes`` impacts at one of ``sites`` after the other, on alternating sides, with growing speeds."""
    number = np.arange(episodes)
    logged = {"site": number % sites + 1, "side": np.where(number % 2, 1, -1), "onset": (number + 0.5) / episodes}
    logged |= {"approach_velocity": 1.0 + number, "loss": np.full(episodes, loss)}
    data = {f"impacts/{name}": ("episode", values) for name, values in logged.items()}
    data |= {"sites/cell": ("site", 10 * np.arange(1, sites + 1)), "time": [0.0, 1.0]}
    return xr.Dataset(data, attrs={"case": small_case().to_toml()})


def test_impacts_that_markers_do_not_distinguish_are_a_map():
    few = impact_panels.impacts(impacts_of(5, 20, 1e-6), None).axes
    assert len(few[0].collections) == 2
    assert not few[0].images
    assert few[1].get_title() == "(b) Loss, episodes"

    many = impact_panels.impacts(impacts_of(59, 35_400), None).axes
    (image,) = many[0].images
    largest = np.ma.filled(image.get_array(), np.nan)
    assert largest.shape == (59, impact_panels.MAP_COLUMNS)
    assert not many[0].collections

    # Episodes 3941 and 4000 are both of site 48 and in the same column of the map, which shows the faster one.
    episode = 4000
    column = int((episode + 0.5) / 35_400 * impact_panels.MAP_COLUMNS)
    assert largest[episode % 59, column] == 1.0 + episode

    assert len(many[0].get_yticks()) <= 13
    assert many[0].get_yticklabels()[1].get_text() == "60"
    assert many[1].get_title() == "(b) Episodes"
    assert {p.get_width() for p in many[1].patches} == {600}

    pooled = impact_panels.impacts(impacts_of(1000, 3000), None).axes[0].images[0]
    assert len(pooled.get_array()) <= impact_panels.MAP_ROWS
