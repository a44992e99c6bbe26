"""Panels of the paper's figures from synthetic data: entropy histories, energies, dispersions of cells, wavelets."""

import numpy as np
import pytest
import tomli_w
import xarray as xr

from vipetsc.figures.style import rc_style
from vipetsc.figures.sweep_members import Files, Sweeps
from vipetsc.paper.paper_figures import PAGES

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
