"""The analysis of a run measures the host's wave from its arrival on, in memory or in its file alike."""

import json

import numpy as np
import pytest
import xarray as xr

from vipetsc import spectra
from vipetsc.case import Case
from vipetsc.case.schema import AnalysisTable
from vipetsc.io.netcdf import write_netcdf
from vipetsc.io.read import open_run
from vipetsc.studies import velocity_record as velocities
from vipetsc.studies.analysis import analyse
from vipetsc.studies.sweep_runs import leading_cell


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
    expected = spectra.entropy(host, 200, 2, 2)
    assert measured.attrs["entropy/start"] == pytest.approx(0.04)
    assert measured["entropy/energy_weighted"].item() == expected.energy_weighted
    assert np.array_equal(measured["entropy/history"].values, expected.snapshot)
    estimate = 0.5 * model.drive.duration + 6 / model.speed  # without a linear run: to the leading site, cell 9
    start = analyse(run, ("entropy",)).attrs["entropy/start"]
    assert estimate < start < estimate + 4e-4


@pytest.mark.parametrize("kept, limit", [(600, 20_000), (7, 60_000)])
def test_little_memory_gives_the_same(run, tmp_path, monkeypatch, kept, limit):
    """Of the field, 307 KB, no more than the limit is read at once; a row of a map of 7 takes 45 KB."""
    write_netcdf(tmp_path / "run.h5", run)
    little, read = limit / 2**30, []

    def slice_of(field, index):
        read.append(np.asarray(field._field[index].values))
        return read[-1]

    monkeypatch.setattr(velocities._StoredField, "__getitem__", slice_of)
    whole = analyse(run, options=AnalysisTable(pixels=kept, snapshot_stride=20))
    assert {"dispersion_before", "partition/energy", "bands/energy", "entropy/local"} <= set(whole.variables)
    assert max(whole["kinetic_energy"].shape) <= kept and len(whole["bands/sample"]) == 400
    with open_run(tmp_path / "run.h5") as stored:
        blocks = analyse(stored, options=AnalysisTable(pixels=kept, snapshot_stride=20, memory=little))
    xr.testing.assert_allclose(blocks, whole, rtol=1e-6)
    assert blocks.attrs == whole.attrs and read and max(v.nbytes for v in read if v.ndim == 3) <= limit


def test_maps_are_means_and_spectra_sums_of_what_a_page_cannot_show(run):
    fine, coarse = (analyse(run, options=AnalysisTable(pixels=pixels)) for pixels in (600, 8))
    expected = fine["kinetic_energy"].values.reshape(8, 50, 8, 3).mean(axis=(1, 3))
    assert coarse["kinetic_energy"].values == pytest.approx(expected, rel=1e-5)
    assert coarse["time"].values == pytest.approx(fine["time"].values.reshape(8, 50).mean(axis=1))
    assert coarse["cell"].values.tolist() == list(range(2, 25, 3))
    totals = [data["wavenumber_content"].values.sum(axis=1).mean() for data in (fine, coarse)]
    totals += [data["bands/total"].values.mean() for data in (fine, coarse)]
    assert totals == pytest.approx([totals[0]] * 4, rel=1e-5)
    for name in ("dispersion", "dispersion_before"):
        assert coarse[name].shape == (7, 14) and coarse[name].sum().item() == pytest.approx(
            fine[name].sum().item(), rel=1e-5
        )
    bands = [data["bands/kinetic_energy"].values.mean(axis=(1, 2)) for data in (fine, coarse)]
    assert bands[0] == pytest.approx(bands[1], rel=1e-5) and fine["bands/kinetic_energy"].dtype == np.float32


def test_cells_before_and_after_the_first_site_are_told_apart(run):
    # Of a wave that lives before cell 9 alone, nothing is measured behind it.
    run["velocity"].values[:, 8:] = 0.0
    measured = analyse(run, ("wavenumber", "dispersion"))
    assert measured["dispersion_before"].values.max() > 0
    assert measured["dispersion_after"].values.max() == 0


def test_what_was_kept_too_coarsely_is_named_and_not_measured(run):
    # The top band ends at 3645 rad/s: a sample every .8 ms resolves it, one every 1 ms does not.
    resolved, aliased = (analyse(run.isel(time=slice(None, None, stride))) for stride in (4, 5))
    assert {"ibtet", "dispersion"} <= set(resolved.variables) and json.loads(resolved.attrs["warnings"]) == []
    assert not {"ibtet", "bands/energy", "dispersion"} & set(aliased.variables)
    assert {"entropy/masked", "partition/energy", "kinetic_energy"} <= set(aliased.variables)
    (warning,) = json.loads(aliased.attrs["warnings"])
    assert "every 0.001 s resolve 3141.6 of 3644.8 rad/s: dispersion, bands and ibtet are not" in warning
    assert warning in aliased.attrs["left_out"]
    thinned = analyse(run.isel(cell=slice(None, None, 2)))
    names = {name.partition("/")[0] for name in map(str, thinned.variables)}
    assert not names & {"wavenumber_content", "dispersion", "entropy", "partition"} and "ibtet" in names
    assert "one cell in 2 do not resolve waves shorter than 4 cells" in json.loads(thinned.attrs["warnings"])[0]


def test_the_ends_of_a_record_are_not_in_the_means(run):
    measured = analyse(run, ("bands", "maps"))
    about, energy = measured["ibtet"].attrs, measured["bands/energy"].values
    first, last = (round(about[key] / 2e-4) for key in ("start", "end"))
    assert first >= 8 and last == 391 and "before the last 2% of the record" in about["ends_when"]
    judged = energy[:, first : last + 1]
    above = measured["bands/above"].values.astype(bool)
    assert measured["ibtet"].item() == np.mean(judged[above].sum(axis=0) / judged.sum(axis=0))
    assert measured["bands/share"].values == pytest.approx((judged / judged.sum(axis=0)).mean(axis=1))


def test_on_a_ring_the_first_site_is_the_nearest_either_way(run):
    # From cell 3 it is 6 cells to cell 9, and 5 to cell 22 the other way around.
    run["sites/cell"].values[:] = [22, 9]
    ring = Case.load(overrides=["lattice.cells=24", "contacts.sites=[22, 9]", "drive.cell=3", "drive.cycles=3",
                                "lattice.ends=periodic"])  # fmt: skip
    assert leading_cell(ring) == 22 and leading_cell(Case.of(run)) == 9
    joined = analyse(run.assign_attrs(case=ring.to_toml()))
    assert "cell 22" in joined["ibtet"].attrs["starts_when"]
    assert not {"dispersion_before", "dispersion_after"} & set(joined.variables)
    assert "dispersion_before, dispersion_after: on a ring the wave goes both ways" in joined.attrs["left_out"]
    model = ring.model()
    estimate = 0.5 * model.drive.duration + 5 / model.speed
    assert estimate <= joined.attrs["entropy/start"] < estimate + 4e-4
