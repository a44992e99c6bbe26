"""The analysis of a run measures the host's wave from its arrival on, in memory or in its file alike."""

import numpy as np
import pytest
import xarray as xr

from vipetsc import spectra
from vipetsc.case import Case
from vipetsc.io.netcdf import write_netcdf
from vipetsc.io.read import open_run
from vipetsc.studies import analysis
from vipetsc.studies.analysis import analyse


@pytest.fixture
def run():
    """A run of noise on 24 cells; the sites are 15 and 9, the drive is at cell 3."""
    case = Case.load(overrides=["lattice.cells=24", "contacts.sites=[15, 9]", "drive.cell=3", "drive.cycles=3"])
    time, cells = np.arange(400) * 2e-4, np.arange(1, 25)
    data = {"time": time, "cell": cells, "dof": np.arange(1, 5), "site": [1, 2], "sites/cell": ("site", [15, 9])}
    noise = np.random.default_rng(1).standard_normal((400, 24, 4))
    data |= {"velocity": (("time", "cell", "dof"), noise), "energy/kinetic": ("time", time)}
    return xr.Dataset(data, attrs={"case": case.to_toml(), "status": "complete"})


def test_entropy_is_that_of_the_host_from_the_arrival_on(run):
    model = Case.of(run).model()
    host = np.ascontiguousarray(run["velocity"].values[..., model.chain.cell.host])
    measured = analyse(run, ("entropy",), arrival=0.0399)
    expected = spectra.entropy(host, 200)
    assert measured.attrs["entropy/start"] == pytest.approx(0.04)
    assert measured["entropy/energy_weighted"].item() == expected.energy_weighted
    assert np.array_equal(measured["entropy/history"].values, expected.snapshot)
    estimate = 0.5 * model.drive.duration + 6 / model.speed  # without a linear run: to the leading site, cell 9
    start = analyse(run, ("entropy",)).attrs["entropy/start"]
    assert estimate < start < estimate + 2e-4


def test_a_field_that_is_read_mass_by_mass_gives_the_same(run, tmp_path, monkeypatch):
    write_netcdf(tmp_path / "run.h5", run)
    whole = analyse(run)
    assert {"dispersion_before", "partition/energy", "bands/energy", "entropy/local"} <= set(whole.variables)
    monkeypatch.setattr(analysis, "IN_MEMORY", 0)
    with open_run(tmp_path / "run.h5") as stored:
        xr.testing.assert_identical(analyse(stored), whole)


def test_cells_before_and_after_the_first_site_are_told_apart(run):
    # Of a wave that lives before cell 9 alone, nothing is measured behind it.
    run["velocity"].values[:, 8:] = 0.0
    measured = analyse(run, ("wavenumber", "dispersion"))
    assert measured["dispersion_before"].values.max() > 0
    assert measured["dispersion_after"].values.max() == 0
