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


def prediction(level: float = 0.2, onset: float = 1.0) -> Figure:
    # All energies are equal, hence curves coincide and differ in their style alone.
    energies = np.full((3, 4), level)
    data = {"sites/cell": ("site", [5, 9, 12])}
    for kind in ("predicted", "simulated"):
        data |= {f"{kind}/bands": (("amplitude", "band"), energies)}
        data |= {f"{kind}/{name}": ("amplitude", energies[:, 0]) for name in ("upper", "dissipated")}
    data |= {"predicted/z": (("amplitude", "site"), np.outer(X, [1.0, 1.1, 1.2]))}
    about = {"drive_band": 2, "onset_amplitude": onset}
    coords = {"amplitude": ("amplitude", X, {"units": "N"}), "band": [*BANDS]}
    return predicted_energies.prediction(xr.Dataset(data, coords, about))


def law() -> Figure:
    share = np.full((3, 4, 2), 0.1)
    data = {"share": (("z", "band", "direction"), share), "share_scatter": (("z", "band", "direction"), share)}
    for name in law_panels.LABELS:
        data |= {name: ("z", share[:, 0, 0]), f"{name}_scatter": ("z", share[:, 0, 0])}
    data |= {"efficiency": ("z", X)}
    coords = {"z": X, "band": [*BANDS], "direction": ["forward", "backward"]}
    return law_panels.law(xr.Dataset(data, coords, {"drive_band": 2, "matched_z": np.nan}))


def parts() -> Figure:
    figure = style.new_figure(3, 2)
    # Measures have gaps between the bands; a gap takes no colour of a band.
    names = [name for band in BANDS for name in (f"band {band}", f"gap {band}")]
    transfer.draw_parts(figure.subplots(), X, names, [X] * len(names))
    return figure


def share() -> Figure:
    (drawing,) = measure_pages.measure_pages(ensemble_of(AMPLITUDES, parts=5), "bands/share")
    return drawing.draw()


@pytest.mark.parametrize("make", [prediction, law, parts, share])
def test_bands_have_their_colours_by_name(make):
    """Curves with the name of a band have the band's colour in every picture."""
    with style.rc_style():
        figure = make()
    lines = [line for axes in figure.get_axes() for line in axes.lines if line.get_label().startswith("band ")]
    colours = {line.get_label(): to_hex(line.get_color()).upper() for line in lines}
    assert colours == {f"band {band}": style.band_colour(band) for band in BANDS}


@pytest.mark.parametrize("level", [1.0, 0.2, 1e-3])
def test_legends_of_a_prediction_touch_nothing(level, tmp_path):
    """Energies as large as the work and as small as the axes show lie below the legends, all along the axes."""
    with style.rc_style():
        figure = prediction(level)
        style.save(figure, tmp_path / "prediction.png")
    boxes = [(axes, axes.get_legend().get_window_extent()) for axes in figure.get_axes() if axes.get_legend()]
    assert len(boxes) == 3
    for axes, box in boxes:
        drawn = [axes.transData.transform(line.get_xydata()) for line in axes.lines if len(line.get_xydata()) == len(X)]
        assert box.y0 > max(points[:, 1].max() for points in drawn)
        # A legend as wide as its axes would leave no place for the curves.
        assert box.x1 < axes.bbox.x1


@pytest.mark.parametrize(("level", "onset", "least"), [(1e-16, 8.0, 1e-4), (1e-6, 0.5, 1e-4), (0.3, 0.5, 0.2)])
def test_the_axis_of_transferred_energies_rises(level, onset, least):
    """The axis rises from 1e-4, or from the smallest energy with contact, also where nothing is as large as that."""
    with style.rc_style():
        low, high = prediction(level, onset).get_axes()[0].get_ylim()
    assert low == pytest.approx(least)
    assert high > max(level, least)


@pytest.mark.parametrize("make", [panels.band_diagram, runs.bands])
def test_branches_have_the_colours_of_their_bands(make):
    """Branches have the colours of their bands in a band diagram alone and in the figure with the group velocity."""
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
