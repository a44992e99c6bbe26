"""A pass band has one colour in every picture, from one function."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from tests.unit.test_measure_pages import AMPLITUDES, ensemble_of
from vipetsc.figures import law_panels, measure_pages, panels, predicted_energies, runs, style, transfer
from vipetsc.lattice import four_band

BANDS = (1, 2, 3, 4)
X = np.array([1.0, 2.0, 4.0])


def prediction() -> Figure:
    energies = np.full((3, 4), 0.2)
    data = {"predicted/bands": (("amplitude", "band"), energies), "predicted/upper": ("amplitude", energies[:, 0])}
    data |= {"predicted/dissipated": ("amplitude", energies[:, 0]), "sites/cell": ("site", [5])}
    data |= {"predicted/z": (("amplitude", "site"), X[:, None])}
    about = {"drive_band": 2, "onset_amplitude": 1.0}
    return predicted_energies.prediction(xr.Dataset(data, {"amplitude": X, "band": [*BANDS]}, about))


def law() -> Figure:
    share = np.full((3, 4, 2), 0.1)
    data = {"share": (("z", "band", "direction"), share), "share_scatter": (("z", "band", "direction"), share)}
    for name in law_panels.ENERGIES:
        data |= {name: ("z", share[:, 0, 0]), f"{name}_scatter": ("z", share[:, 0, 0])}
    data |= {"efficiency": ("z", X)}
    coords = {"z": X, "band": [*BANDS], "direction": ["forward", "backward"]}
    return law_panels.law(xr.Dataset(data, coords, {"drive_band": 2, "matched_z": np.nan}))


def parts() -> Figure:
    figure = style.new_figure(3, 2)
    names = [name for band in BANDS for name in (f"band {band}", f"gap {band}")]
    transfer.draw_parts(figure.subplots(), X, names, [X] * len(names))
    return figure


def share() -> Figure:
    (drawing,) = measure_pages.measure_pages(ensemble_of(AMPLITUDES, parts=5), "bands/share")
    return drawing.draw()


@pytest.mark.parametrize("make", [prediction, law, parts, share])
def test_bands_have_their_colours_by_name(make):
    with style.rc_style():
        figure = make()
    lines = [line for axes in figure.get_axes() for line in axes.lines if line.get_label().startswith("band ")]
    colours = {line.get_label(): to_hex(line.get_color()).upper() for line in lines}
    assert colours == {f"band {band}": style.band_colour(band) for band in BANDS}


@pytest.mark.parametrize("make", [panels.band_diagram, runs.bands])
def test_branches_have_the_colours_of_their_bands(make):
    """In a diagram alone, and over the group velocity as well."""
    with style.rc_style():
        if make is runs.bands:
            drawn = make(four_band()).get_axes()
        else:
            drawn = [style.new_figure(3, 2).subplots()]
            make(drawn[0], four_band())
    for axes in drawn:
        assert [to_hex(line.get_color()).upper() for line in axes.lines[:4]] == [style.band_colour(b) for b in BANDS]


@pytest.mark.parametrize(
    ("part", "number"), [("band 2", 2), ("band 2+3", 2), ("gap 1", None), ("above", None), ("below", None)]
)
def test_parts_of_the_frequency_axis_are_bands_by_their_names(part, number):
    assert style.band_number(part) == number
