"""The analysis of a run measures the host's wave from its arrival on, in memory or in its file alike."""

import json

import numpy as np
import pytest
import xarray as xr

from tests.conftest import with_every_variable
from vipetsc import spectra
from vipetsc.case import Case
from vipetsc.case.schema import AnalysisTable
from vipetsc.io.netcdf import write_netcdf
from vipetsc.io.read import open_run
from vipetsc.studies import velocity_record
from vipetsc.studies.analysis import analyse

SAMPLES = 400
INTERVAL = 2e-4  # s


@pytest.fixture
def run():
    """Return a run whose velocities (400 samples, 24 cells, 4 masses) are noise; sites 15 and 9, drive at cell 3."""
    case = Case.load(overrides=["lattice.cells=24", "contacts.sites=[15, 9]", "drive.cell=3", "drive.cycles=3"])
    time = np.arange(SAMPLES) * INTERVAL
    noise = np.random.default_rng(1).standard_normal((SAMPLES, 24, 4))
    data = {
        "time": time,
        "cell": np.arange(1, 25),
        "dof": np.arange(1, 5),
        "site": [1, 2],
        "sites/cell": ("site", [15, 9]),
        "velocity": (("time", "cell", "dof"), noise),
        "energy/kinetic": ("time", time),
    }
    return xr.Dataset(data, attrs={"case": case.to_toml(), "status": "complete"})


def test_entropy_is_that_of_the_host_from_the_arrival_on(run):
    """The entropy is that of the hosts' velocities from the arrival of the wave on, which is estimated if not given."""
    model = Case.of(run).model()
    measured = analyse(run, ("entropy",), arrival=0.0399)

    # The first sample from the arrival on is the one at 0.04 s; samples and cells are thinned by two.
    host = np.ascontiguousarray(run["velocity"].values[..., model.chain.cell.host])
    expected = spectra.entropy(host, start=200, stride=2, every=2)
    assert measured.attrs["entropy/start"] == pytest.approx(0.04)
    assert measured["entropy/energy_weighted"].item() == expected.energy_weighted
    assert np.array_equal(measured["entropy/history"].values, expected.snapshot)

    # Without a linear run the arrival is estimated: half the burst, and 6 cells to the first site at the wave's speed.
    estimate = 0.5 * model.drive.duration + 6 / model.speed
    start = analyse(run, ("entropy",)).attrs["entropy/start"]
    assert estimate < start < estimate + 2 * INTERVAL


@pytest.mark.parametrize(("pixels", "limit"), [(600, 20_000), (7, 60_000)])
def test_little_memory_gives_the_same(run, tmp_path, monkeypatch, pixels, limit):
    """The analysis reads at most ``limit`` bytes of the field of 307 KB at once, and its results are the same.

    One row of a map of 7 pixels takes 45 KB.
    """
    write_netcdf(tmp_path / "run.h5", with_every_variable(run))
    whole = analyse(with_every_variable(run), options=AnalysisTable(pixels=pixels, snapshot_stride=20))
    read = []

    def read_slice(field, index):
        read.append(np.asarray(field._field[index].values))
        return read[-1]

    monkeypatch.setattr(velocity_record._StoredField, "__getitem__", read_slice)
    with open_run(tmp_path / "run.h5") as stored:
        options = AnalysisTable(pixels=pixels, snapshot_stride=20, memory=limit / 2**30)
        blocks = analyse(stored, options=options)

    assert {"dispersion_before", "partition/energy", "bands/energy", "entropy/local"} <= set(whole.variables)
    assert max(whole["kinetic_energy"].shape) <= pixels
    assert len(whole["bands/sample"]) == SAMPLES
    # Blocks overlap and are filtered apart: sums differ in rounding, single numbers near zero by more.
    xr.testing.assert_allclose(blocks, whole, rtol=1e-6)
    assert blocks.attrs == whole.attrs
    sizes = [values.nbytes for values in read if values.ndim == 3]
    assert sizes
    assert max(sizes) <= limit


def test_maps_are_means_and_spectra_sums_of_what_a_page_cannot_show(run):
    """A coarse map has means over pixels of a fine one, a coarse spectrum sums: energies do not depend on pixels."""
    fine = analyse(run, options=AnalysisTable(pixels=600))
    coarse = analyse(run, options=AnalysisTable(pixels=8))

    # A pixel of a map of 8 by 8 pixels has 50 samples and 3 cells.
    means = fine["kinetic_energy"].values.reshape(8, 50, 8, 3).mean(axis=(1, 3))
    assert coarse["kinetic_energy"].values == pytest.approx(means, rel=1e-5)
    assert coarse["time"].values == pytest.approx(fine["time"].values.reshape(8, 50).mean(axis=1))
    assert coarse["cell"].values.tolist() == list(range(2, 25, 3))

    # The energy is the same at all resolutions.
    totals = []
    for data in (fine, coarse):
        totals.append(data["wavenumber_content"].values.sum(axis=1).mean())
        totals.append(data["bands/total"].values.mean())
    assert totals == pytest.approx([totals[0]] * 4, rel=1e-5)

    # Fields are stored in single precision.
    for name in ("dispersion", "dispersion_before"):
        assert coarse[name].shape == (7, 14)
        assert coarse[name].sum().item() == pytest.approx(fine[name].sum().item(), rel=1e-5)
    coarse_bands = coarse["bands/kinetic_energy"].values.mean(axis=(1, 2))
    fine_bands = fine["bands/kinetic_energy"].values.mean(axis=(1, 2))
    assert fine_bands == pytest.approx(coarse_bands, rel=1e-5)
    assert fine["bands/kinetic_energy"].dtype == np.float32


def test_samples_too_rare_for_the_bands_are_named_and_spectra_left_out(run):
    """Spectra and bands need pi/interval above the top band; otherwise a warning names them and other measures stay."""
    # The top band ends at 3645 rad/s: a sample every 0.8 ms resolves it, one every 1 ms does not.
    resolved = analyse(run.isel(time=slice(None, None, 4)))
    aliased = analyse(run.isel(time=slice(None, None, 5)))

    assert {"ibtet", "dispersion"} <= set(resolved.variables)
    assert json.loads(resolved.attrs["warnings"]) == []

    assert not {"ibtet", "bands/energy", "dispersion"} & set(aliased.variables)
    assert {"entropy/masked", "partition/energy", "kinetic_energy"} <= set(aliased.variables)
    (warning,) = json.loads(aliased.attrs["warnings"])
    assert "every 0.001 s resolve 3141.6 of 3644.8 rad/s: dispersion, bands and ibtet are not" in warning
    assert warning in aliased.attrs["left_out"]


def test_what_is_asked_for_is_measured_and_what_is_left_out_has_one_reason(run):
    """Maps are not taken without being asked for; of several reasons the first one is named, without a warning."""
    assert set(analyse(run, ["kinetic_energy"]).data_vars) == {"kinetic_energy"}
    transfer = analyse(run, ["ibtet"])
    assert "bands/energy" in transfer
    assert not {"bands/kinetic_energy", "bands/total", "dispersion", "entropy/masked"} & set(transfer.variables)

    instant = analyse(run.isel(time=[0], cell=[0]))
    assert json.loads(instant.attrs["warnings"]) == []
    reasons = dict(sentence.split(": ")[::-1] for sentence in instant.attrs["left_out"].split("; "))
    assert reasons["fewer than two samples were recorded"] == "dispersion, partition, entropy, bands, ibtet"
    assert reasons["a single cell was recorded"] == "wavenumber_content"


def test_the_ends_of_a_record_are_not_in_the_means(run):
    """The transfer is the mean fraction of energy above the drive, without the last 2 % of the record."""
    measured = analyse(run, ["ibtet", "bands/kinetic_energy"])
    about = measured["ibtet"].attrs
    first = round(about["start"] / INTERVAL)
    last = round(about["end"] / INTERVAL)
    assert first >= 8
    assert last == 391
    assert "before the last 2% of the record" in about["ends_when"]

    energy = measured["bands/energy"].values[:, first : last + 1]
    is_above = measured["bands/above"].values.astype(bool)
    assert measured["ibtet"].item() == np.mean(energy[is_above].sum(axis=0) / energy.sum(axis=0))
    assert measured["bands/share"].values == pytest.approx((energy / energy.sum(axis=0)).mean(axis=1))


def test_without_a_band_above_the_driven_one_the_transfer_is_left_out_by_name(run):
    """Nothing can be transferred to a band above the highest: the analysis says so instead of a NaN without a word."""
    case = Case.load(overrides=["lattice.cells=24", "contacts.sites=[9, 14]", "drive.cycles=3", "drive.band=4"])
    measured = analyse(run.assign_attrs(case=case.to_toml()), ["ibtet"])
    assert np.isnan(measured["ibtet"])
    assert "ibtet: no pass band lies above" in measured.attrs["left_out"]
    assert "ibtet" not in analyse(run, ["ibtet"]).attrs["left_out"]
