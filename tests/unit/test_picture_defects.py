"""What pictures must not do: hide parts without a note, mix prefixes on an axis, draw what was not fitted as fitted."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from tests.conftest import run_of, small_case
from vipetsc.figures import identified, registry, style
from vipetsc.figures.modal import MOST_ROWS, MovedEnergies
from vipetsc.figures.prefixed_units import prefix_units
from vipetsc.figures.sweep_members import Files
from vipetsc.figures.transfer_curves import TransferCurve, _of_contact, _superposition
from vipetsc.figures.warning_lines import warned
from vipetsc.io.errors import ResultFileError
from vipetsc.io.netcdf import write_netcdf
from vipetsc.lattice.sites import Pair, sites_at
from vipetsc.lattice.topology import Topology


@pytest.fixture(autouse=True)
def house_style():
    with style.rc_style():
        yield


@pytest.mark.parametrize(
    ("largest", "label", "expected", "texts"),
    [
        (2e-5, "Energy lost (J)", "Energy lost (µJ)", ["0", "10", "20"]),
        (3e-10, "w (m)", "w (pm)", ["0", "150", "300"]),
        (2.5e4, "Force (N)", "Force (kN)", ["0", "12.5", "25"]),
        (4e-4, "Velocity (m/s)", "Velocity (µm/s)", ["0", "200", "400"]),
        # Numbers that can be read, labels without a unit that takes a prefix.
        (1.2, "Energy (J)", "Energy (J)", ["0.0", "0.6", "1.2"]),
        (2e-5, "Time (ms)", "Time (ms)", None),
        (2e-5, "misfit", "misfit", None),
    ],
)
@pytest.mark.parametrize("which", ["x", "y"])
def test_an_axis_has_one_unit_and_no_power_of_ten(largest, label, expected, texts, which):
    """Small and large numbers have a prefix of their unit, the same for all ticks, and none is written at the end."""
    figure = Figure()
    axes = figure.subplots()
    axes.set(**{f"{which}lim": (0, largest), f"{which}label": label, f"{which}ticks": [0, largest / 2, largest]})
    prefix_units(figure)
    figure.draw_without_rendering()
    axis = getattr(axes, f"{which}axis")
    assert axis.get_label_text() == expected
    if texts:
        assert [tick.get_text() for tick in axis.get_ticklabels()] == texts
        assert not axis.get_offset_text().get_text()


def identification(channels: int, starts: int = 1) -> xr.Dataset:
    """Return an identification of a record with so many ``channels``, each of 20 values."""
    names = [f"channel {number}" for number in range(channels)]
    number = np.repeat(np.arange(channels), 20)
    return xr.Dataset(
        {
            "data/channel": ("datum", number),
            "data/time": ("datum", np.tile(np.arange(20.0), channels)),
            "data/measured": ("datum", np.sin(np.arange(20.0 * channels))),
            "data/model": ("datum", np.zeros(20 * channels)),
            "channels/unit": ("channel", np.full(channels, "m/s")),
            "channels/noise": ("channel", np.ones(channels)),
            "channels/probability": ("channel", np.ones(channels)),
            "windows/misfit": ("window", [1.0, 2.0]),
            "windows/impacts": ("window", [3, 4]),
            "windows/value": (("window", "parameter"), np.zeros((2, 0))),
            "starts/valley": ("start", np.arange(1, starts + 1)),
            "starts/deviance": ("start", np.arange(float(starts))),
        },
        coords={"channel": names, "window": [1, 2]},
    )


@pytest.mark.parametrize("draw", [identified.record_and_model, identified.residual_correlations])
def test_channels_that_are_left_out_are_counted(draw):
    """Below a page without all channels stands how many there are, before the warnings of the results."""
    assert draw(identification(8)).get_label() == ""
    assert "8 of 9 channels" in draw(identification(9)).get_label()

    shown = style.Shown("", [xr.Dataset(attrs={"warnings": '["a warning"]'})])
    note, warning = warned(lambda: draw(identification(11)), [shown])().get_label().splitlines()
    assert "8 of 11" in note
    assert warning == "a warning"


@pytest.mark.parametrize("sites", [MOST_ROWS, MOST_ROWS + 6])
def test_energies_moved_keep_the_largest_rows_and_count_all(sites):
    """Of more sites than have room those with the largest transfers stay; a contact closed at the end loses 0."""
    loss = np.ones(sites)
    loss[1] = np.nan
    run = xr.Dataset(
        {
            "impacts/site": ("episode", np.arange(1, sites + 1)),
            "impacts/loss": ("episode", loss),
            "sites/cell": ("site", np.arange(1, sites + 1)),
        }
    )
    transfer = np.arange(float(sites))[:, None]
    analysis = xr.Dataset(
        {
            "bands/transfer": (("cluster", "part"), transfer),
            "bands/cluster_of_episode": ("episode", np.arange(1, sites + 1)),
        }
    )
    moved = MovedEnergies.of(run, analysis, [0])
    assert moved.rows == sites
    assert len(moved.labels) == MOST_ROWS
    assert moved.labels[-1] == str(sites)
    assert np.isfinite(moved.energy).all()


@pytest.mark.parametrize("sign", [1, -1])
def test_a_slope_that_was_not_fitted_is_not_drawn_as_fitted(sign):
    """The dashed line and the grey one with the floor show rising frequencies alone; falling ones are dotted."""
    energy = np.geomspace(1.0, 100.0, 6)
    slope = np.array([0.0, 1.0, sign * 2.0, sign * 3.0, 1.0, 0.5])
    data = {
        "energy": energy,
        "ibtet": 1 / energy,
        "fitted": np.ones(6),
        "branch/energy": energy,
        "branch/region": np.array([1, 3, 3, 3, 3, 3]),
        "branch/slope": slope,
        "grazing_energy": 2.0,
        "floor": 1e-6,
        "divisor": 10.0,
        "slope_exponent": -1.0,
        "factor": 1.0,
        "exponent": -1.0,
        "r2_adjusted": 0.99,
        "branch_reading": "printed",
    }
    axes = Figure().subplots()
    _superposition(axes, TransferCurve(small_case(), data))
    lines = {line.get_label().partition(",")[0]: line.get_ydata() for line in axes.lines}
    expected = np.where(slope > 0, slope / 10, np.nan)
    np.testing.assert_array_equal(lines["slope"], expected)
    np.testing.assert_array_equal(np.isnan(lines["slope + floor"][1:]), slope < 0)
    assert ("slope < 0" in lines) == (sign < 0)
    if sign < 0:
        np.testing.assert_array_equal(lines["slope < 0"], np.where(slope < 0, -slope / 10, np.nan))


@pytest.mark.parametrize(
    ("pair", "host", "resonator"),
    [
        (Pair(1, 2), 301.0, 302.0),
        (Pair(0, 3), 300.0, 303.0),
        (Pair(-1, 2), 0.0, 302.0),
        (Pair(3, 0, offset=1), 303.0, 400.0),
    ],
)
def test_a_portrait_shows_the_masses_that_its_contact_joins(pair, host, resonator):
    """The motion of mass d in cell c is 100 c + d: the contact in cell 3 is that of its own pair, or of the ground."""
    motion = 100.0 * np.arange(1, 6)[:, None] + np.arange(4)
    run = xr.Dataset(
        {"displacement": (("time", "cell", "dof"), motion[None]), "sites/cell": ("site", [3])},
        {"cell": np.arange(1, 6)},
    )
    model = SimpleNamespace(chain=SimpleNamespace(sites=sites_at([2], pair), topology=Topology(5)))
    assert _of_contact(run, model, "displacement").tolist() == [[host, resonator]]


@pytest.mark.parametrize("name", ["energy/kinetic", "impacts/loss", "sites/clearance"])
def test_a_run_that_lacks_a_variable_is_refused_by_its_name(tmp_path, name):
    """The message about a file without a variable names both, and is no KeyError from a figure."""
    run = run_of(small_case(time={"end": 0.01})).drop_vars(name)
    write_netcdf(tmp_path / "run.h5", run)
    with Files() as files, pytest.raises(ResultFileError, match=name):
        registry.run_and_analysis(tmp_path, files)
