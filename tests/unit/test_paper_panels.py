"""Panels of the paper's figures from synthetic data: entropy histories, energies, dispersions of cells, wavelets."""

from types import SimpleNamespace

import numpy as np
import pytest
import tomli_w
import xarray as xr

from vipetsc.figures import cost_maps, scattering, transfer, wavenumber_bins
from vipetsc.figures.style import rc_style
from vipetsc.figures.sweep_members import Files, Sweeps
from vipetsc.paper.pages import PAGES
from vipetsc.spectra import entropies, filter_bank

AMPLITUDES = [1.0, 4.0, 16.0, 64.0, 256.0]  # N


@pytest.fixture(autouse=True)
def style():
    with rc_style():
        yield


def entropy_ensemble(amplitudes: list[float], episodes: list[float]) -> xr.Dataset:
    """Return a sweep over ``amplitudes`` with H(t) and numbers of contact ``episodes``, NaN for a failed member."""
    failed = np.isnan(episodes)
    times = np.where(failed[:, None], np.nan, np.linspace(0.0, 1.0, 6))
    variables = {
        "status": ("amplitude", failed.astype(np.int8)),
        "number": ("amplitude", np.arange(len(amplitudes))),
        "contact_episodes": ("amplitude", episodes),
        "entropy/energy_weighted": ("amplitude", np.where(failed, np.nan, 2.0)),
        "entropy/start": ("amplitude", np.where(failed, np.nan, 0.1)),
        "entropy/history": (("amplitude", "entropy/sample"), times + 1.0),
        "entropy/time": (("amplitude", "entropy/sample"), times),
    }
    case = {
        "name": "tried",
        "lattice": {"cells": 20, "reading": "printed"},
        "drive": {"wavenumber": "5 pi/9", "band": 2},
        "sweep": {"drive": {"amplitude": amplitudes}},
    }
    ensemble = xr.Dataset(variables, {"amplitude": amplitudes}, {"case": tomli_w.dumps(case)})
    ensemble["amplitude"].attrs["long_name"] = "drive.amplitude"
    return ensemble


def history(amplitudes: list[float], episodes: list[float]):
    """Return the axes that show H(t) of the sweep."""
    (offered,) = PAGES["entropy_history"].function(Sweeps([entropy_ensemble(amplitudes, episodes)], Files()))
    return offered.draw().axes[0]


@pytest.mark.parametrize(
    ("episodes", "onset"),
    [
        ([0, 0, 3, 9, 20], 8.0),
        # A failed member gives no information about contact.
        ([0, np.nan, 3, 9, 20], 4.0),
        ([3, np.nan, 9, 20, 30], None),
        ([np.nan, 3, 9, 20, 30], None),
        # The member without contact has the higher amplitude.
        ([3, 0, 9, 20, 30], None),
        ([0, 0, 0, 0, 0], None),
    ],
)
def test_contact_begins_between_a_member_without_and_one_with_it(episodes, onset):
    """The dotted line is at the geometric mean of the last amplitude without contact and the first one with it."""
    dotted = [line for line in history(AMPLITUDES, episodes).lines if line.get_linestyle() == ":"]
    assert [line.get_ydata()[0] for line in dotted] == pytest.approx([] if onset is None else [onset])


def test_rows_of_a_history_meet_halfway_on_the_logarithmic_axis():
    """Edges of rows are geometric means of amplitudes; a failed member without a drive has no row."""
    axes = history([0.0, *AMPLITUDES], [np.nan, 0, 0, 3, 9, 20])
    (mesh,) = axes.collections
    edges = mesh.get_coordinates()[:, 0, 1]
    np.testing.assert_allclose(edges, 2.0 * np.array([*AMPLITUDES, 1024.0]) / 4.0)
    (onset,) = [line.get_ydata()[0] for line in axes.lines if line.get_linestyle() == ":"]
    assert onset == pytest.approx(8.0)


def test_energies_of_a_record_shorter_than_a_period_are_drawn():
    """Energies of a record shorter than a period of the drive are means over the whole record."""
    parts = np.array([[4.0, 3.0, 2.0], [1.0, 1.0, 1.0]])
    analysis = xr.Dataset(
        {
            "bands/energy": (("bands/part", "bands/sample"), parts, {"parts": ["band 1", "gap"]}),
            "bands/total": ("bands/sample", parts.sum(axis=0)),
        },
        {"bands/sample": [0.0, 0.1, 0.2]},
    )
    drive = SimpleNamespace(frequency=2 * np.pi)
    member = SimpleNamespace(
        analysis=analysis, model=SimpleNamespace(drive=drive), labels=SimpleNamespace(member="Hertz")
    )
    upper, _ = transfer.energies_over_time(member).axes
    means = {line.get_label(): line.get_xydata().tolist() for line in upper.lines}
    assert means["total"] == [pytest.approx([0.1, 4.0])]
    assert means["band 1"] == [pytest.approx([0.1, 3.0])]


def cell_search(highest: list[float]) -> xr.Dataset:
    """Return a search of cells of two readings, whose bands end at the ``highest`` frequencies in rad/s."""
    grid = ("reading", "lambda", "eta")
    frequency = np.ones((2, 3, 3, 5, 4)) * np.array(highest)[:, None, None, None, None]
    # A cell far from the best one has bands three times as high.
    frequency[:, -1, -1] *= 3
    optimum = np.full((2, 3), 0.2)
    return xr.Dataset(
        {
            "frequency": ((*grid, "wavenumber", "band"), frequency),
            "optimum_lambda": (("reading", "cost"), optimum),
            "optimum_eta": (("reading", "cost"), optimum),
        },
        {
            "reading": ["printed", "calibrated"],
            "lambda": [0.1, 0.2, 0.3],
            "eta": [0.1, 0.2, 0.3],
            "wavenumber": np.linspace(0.0, np.pi, 5),
            "band": [1, 2, 3, 4],
            "cost": ["deflection", "group_velocity", "weighted"],
        },
    )


def test_each_reading_has_frequencies_up_to_those_of_its_best_cell():
    """The axes of each reading end above its best cell's bands; titles name the highest frequency of curves beyond."""
    figure = cost_maps.dispersions(cell_search([1e3, 4e3]), along="lambda", other="eta")
    rows = np.reshape(figure.axes[:6], (2, 3))
    for row, highest in zip(rows, (1.0, 4.0), strict=True):
        for axes in row:
            assert axes.get_ylim() == pytest.approx((0.0, cost_maps.HEADROOM * highest))
        announced = [axes.get_title("right") for axes in row]
        assert announced == ["", "", f"up to {3 * highest:.3g} krad/s ↑"]


def test_pictures_of_wavelets_have_the_parameters_of_the_measures():
    """The wavelets of pictures have the parameter kc of the entropies, and those of bins the one of the filter bank."""
    assert scattering.KC == entropies.KC
    bank = filter_bank(60)
    assert np.array_equal(filter_bank(60, wavenumber_bins.BINS_KC).transfer, bank.transfer)
