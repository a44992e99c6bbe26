"""Results are read by names and values: the variables and nearest site of a run, members of a sweep, their folders."""

import h5py
import numpy as np
import pytest
import xarray as xr

from tests.conftest import with_every_variable
from vipetsc.case import Case
from vipetsc.io.netcdf import write_netcdf
from vipetsc.io.read import (
    RUN_NEEDS,
    curves,
    field_interval,
    field_time,
    nearest_cell,
    open_ensemble,
    open_run,
    over_samples,
    select,
    whole_members,
)

ENSEMBLE = """
name = "small"
[sweep]
fields = true
zip = [["contacts.sites", "drive.cycles"]]
[sweep.contacts]
law = ["hertz", "bilinear"]
sites = [5, 5, 1]
[sweep.drive]
cycles = [30, 15, 30]
amplitude = [0.1, 0.3]
"""
LAWS = ["hertz", "bilinear"]
AMPLITUDES = [0.1, 0.3]


@pytest.fixture
def run(tmp_path):
    """Write a run of 30 cells: every third from the second on is recorded, with every second sample's fields."""
    time = np.arange(9) * 0.5
    cells = np.arange(2, 31, 3)
    velocity = np.arange(5 * len(cells) * 2.0).reshape(5, -1, 2)
    data = {
        "time": ("time", time),
        "field_time": ("field_time", time[::2]),
        "cell": ("cell", cells),
        "dof": ("dof", [1, 2]),
        "site": ("site", [1, 2, 3]),
        "sites/cell": ("site", [3, 20, 14]),
        "energy/kinetic": ("time", time**2),
        "velocity": (("field_time", "cell", "dof"), velocity),
    }

    path = tmp_path / "run.h5"
    case = '[lattice]\ncells = 30\nends = "fixed"\n[drive]\ncell = 12'
    write_netcdf(path, with_every_variable(xr.Dataset(data, attrs={"case": case})))
    return path


@pytest.fixture
def folder(tmp_path):
    """Write a sweep over law, (sites, cycles) and amplitude; the first member of the second law failed."""
    dims = ("law", "sites", "amplitude")
    # Each member's value is its number, so that a selection shows which members it has.
    value = np.arange(12.0).reshape(2, 3, 2)
    names = np.array([f"m{i:02d}" for i in range(12)], dtype=object).reshape(2, 3, 2)
    data = {
        "law": ("law", LAWS),
        "sites": ("sites", [5, 5, 1]),
        "cycles": ("sites", [30, 15, 30], {"long_name": "drive.cycles"}),
        "amplitude": ("amplitude", AMPLITUDES),
        "status": (dims, np.zeros((2, 3, 2), np.int8)),
        "member": (dims, names),
        "contact_episodes": (dims, np.where(value == 6, np.nan, value)),
        "ibtet": (dims, value),
        "entropy/masked": (dims, -value),
        "fits/ibtet/exponent": (dims[:2], value[..., 0]),
    }
    write_netcdf(tmp_path / "ensemble.h5", xr.Dataset(data, attrs={"case": ENSEMBLE}))

    # Two members were kept whole.
    for name in ("m00", "m07"):
        (tmp_path / name).mkdir()
        for file in ("run.h5", "analysis.h5"):
            (tmp_path / name / file).touch()
    return tmp_path


def test_a_run_is_read_by_name(run):
    """A run's variables, the site nearest to the drive, the nearest recorded cell and the fields' times."""
    with open_run(run) as data:
        # The cells of the sites differ from the coordinate ``cell``, the recorded cells.
        assert list(data["sites/cell"].values) == [3, 20, 14]
        # The drive is in cell 12, two cells from the third site.
        assert Case.of(data).nearest_site(data["sites/cell"].values) == 2

        assert [nearest_cell(data, cell) for cell in (1, 4, 20, 99)] == [0, 1, 6, 9]
        assert list(field_time(data)) == [0, 1, 2, 3, 4]
        assert field_interval(data) == 1
        assert data["velocity"][3, 2].values.tolist() == [64, 65]
        assert data.encoding["source"] == str(run)


@pytest.mark.parametrize("name", RUN_NEEDS)
def test_a_run_that_lacks_a_variable_is_refused(run, tmp_path, name):
    with h5py.File(run, "r+") as file:
        if name == "case":
            del file.attrs[name]
        else:
            del file[name]
    with pytest.raises(ValueError, match=f"it lacks ({name}|the coordinate)"):
        open_run(run)


@pytest.mark.filterwarnings("error")
def test_members_are_selected_by_the_values_of_swept_keys(folder):
    """Members are selected by values of swept keys, single or together; a value that no member has is named."""
    ensemble = open_ensemble(folder)
    assert dict(ensemble["cycles"].sizes) == {"sites": 3}
    # Without an axis of samples there is nothing to average.
    assert over_samples(ensemble) is ensemble
    assert "cycles" in ensemble.coords

    # Keys that vary together have to meet in one member.
    assert select(ensemble, sites=1, cycles=30)["ibtet"].values.tolist() == [[4, 5], [10, 11]]
    assert select(ensemble, law="bilinear", sites=5, cycles=15)["entropy/masked"].values.tolist() == [-8, -9]
    # A value that several members have takes the first of them.
    assert select(ensemble, sites=5)["ibtet"].values.tolist() == [[0, 1], [6, 7]]
    # 0.1 + 0.2 differs from 0.3 by a rounding.
    assert select(ensemble["ibtet"], law="hertz", amplitude=0.1 + 0.2).values.tolist() == [1, 3, 5]
    assert select(ensemble, law="bilinear")["fits/ibtet/exponent"].values.tolist() == [6, 8, 10]

    with pytest.raises(KeyError, match="no member has cycles = 15 at the given sites"):
        select(ensemble, sites=1, cycles=15)
    with pytest.raises(KeyError, match=r"amplitude = 0\.2"):
        select(ensemble, amplitude=0.2)
    with pytest.raises(KeyError, match="ibtet is not a coordinate"):
        select(ensemble, ibtet=3.0)
    # A value of another type is one that no member has.
    with pytest.raises(KeyError, match="no member has amplitude = 'large'"):
        select(ensemble, amplitude="large")
    with pytest.raises(KeyError, match="no member has law = 3"):
        select(ensemble, law=3)


def test_members_lead_to_their_folders(folder):
    """Each curve has the number of its first member that did not fail; members that were kept lead to their folders."""
    ensemble = open_ensemble(folder)

    found = list(curves(ensemble))
    assert [number for _, number in found] == [0, 2, 4, 7, 8, 10]
    assert [curve["ibtet"].values.tolist() for curve, _ in found] == np.arange(12).reshape(6, 2).tolist()
    assert not list(curves(ensemble, "wavenumber"))

    whole = [(float(member["ibtet"]), path) for member, path in whole_members(ensemble)]
    assert whole == [(0, folder / "m00"), (7, folder / "m07")]
