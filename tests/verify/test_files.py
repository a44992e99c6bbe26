"""Result files opened by xarray, with units, windows and strides; runs that end early; a second analysis of a run."""

from __future__ import annotations

import json
import shutil

from mpi4py import MPI

import numpy as np
import pytest
import xarray

from tests.conftest import datasets, run_of, small_case
from vipetsc import Case, simulate
from vipetsc.case.schema import AnalysisTable
from vipetsc.dynamics.ts import integrator
from vipetsc.io.lock import FolderError
from vipetsc.studies.analysis import analyse
from vipetsc.studies.analysis_options import is_measured
from vipetsc.studies.reanalysis import measure_run, reanalyse_folders


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """The folder of the small case's run and its analysis."""
    run = tmp_path_factory.mktemp("run_folder") / "run"
    simulate(small_case(), run)
    measure_run(run)
    return run


def test_every_file_opens_in_xarray_with_units(run_folder):
    groups = {"run.h5": [None, "energy", "sites", "impacts"], "analysis.h5": [None, "bands"]}
    for name, members in groups.items():
        for group in members:
            with xarray.open_dataset(run_folder / name, engine="h5netcdf", group=group) as data:
                assert data.variables
                for key, variable in data.variables.items():
                    assert variable.attrs.get("units"), (name, group, key)
    with xarray.open_dataset(run_folder / "run.h5", engine="h5netcdf") as run:
        assert run.velocity.dims == ("time", "cell", "dof")
        assert run.velocity.sel(cell=24, dof=4).sizes == {"time": run.sizes["time"]}
        assert Case.from_toml(run.attrs["case"]) == small_case()
        assert {"vipetsc_version", "petsc_version", "mpi_version", "ranks", "command", "status"} <= run.attrs.keys()


def test_windows_and_strides_are_parts_of_the_whole(run_folder, folder):
    output = {"window": [3, 17], "every": 4, "stride": 5, "fields": ["velocity"]}
    simulate(small_case(output=output), folder / "part")

    whole = datasets(run_folder / "run.h5")
    part = datasets(folder / "part" / "run.h5")
    assert part["cell"].tolist() == [3, 7, 11, 15]
    np.testing.assert_array_equal(part["velocity"], whole["velocity"][::5, 2:17:4])
    np.testing.assert_array_equal(part["field_time"], whole["time"][::5])
    np.testing.assert_array_equal(part["energy/kinetic"], whole["energy/kinetic"])
    assert "displacement" not in part


def test_impact_log_is_complete_and_ordered(run_folder):
    """Episodes are in the order of their onsets, their losses sum to those of the sites, their peaks bound samples."""
    run = datasets(run_folder / "run.h5")
    log = {name.removeprefix("impacts/"): values for name, values in run.items() if name.startswith("impacts/")}
    assert np.all(np.diff(log["onset"]) >= 0)

    # At the end each of the three sites may be in contact.
    ended = np.isfinite(log["separation"])
    assert ended.sum() >= len(ended) - 3
    assert np.all(log["separation"][ended] > log["onset"][ended])
    assert np.all(log["side"] * log["approach_velocity"] > 0)
    assert np.all(log["indentation"] > 0)
    assert np.all(log["force"] > 0)

    losses = np.bincount(log["site"] - 1, weights=log["loss"], minlength=3)
    np.testing.assert_allclose(losses, run["energy/dissipated_by_site"][-1], rtol=1e-6, atol=1e-12)

    # The logged peak is the largest at any time: no sampled indentation exceeds it.
    w = run["displacement"][..., 2] - run["displacement"][..., 1]
    for site, cell in enumerate((6, 12, 13)):
        inside = np.abs(w[:, cell - 1]) - run["sites/clearance"][site]
        assert inside.max() <= log["indentation"][log["site"] == site + 1].max() * (1 + 1e-6)


def test_a_stalled_run_states_when_and_where_and_keeps_its_samples(folder, monkeypatch):
    # Two trials for the one site now count as stalled, and the step at a steep onset needs more.
    monkeypatch.setattr(integrator, "MOST_TRIALS", 1)
    result = simulate(small_case(), folder / "run")
    assert not result.complete
    assert not result.resumable
    for text in ("stalled", "at t = ", "nearest site 1 in cell 6", "last good sample"):
        assert text in result.sentence

    run = datasets(folder / "run" / "run.h5")
    assert 10 < len(run["time"]) < small_case().model().samples
    assert np.isfinite(run["velocity"]).all()

    summary = json.loads((folder / "run" / "summary.json").read_text())
    assert not summary["complete"]
    assert summary["status"] == result.sentence


def test_another_analysis_of_the_same_run(run_folder, folder):
    """With other keys of [analysis] a run is measured anew, not simulated; any other key makes another case."""
    shutil.copytree(run_folder, folder / "run")
    assert is_measured(folder / "run")

    finer = small_case(analysis={"cell_stride": 1})
    assert simulate(finer, folder / "run").complete
    assert not is_measured(folder / "run")

    measure_run(folder / "run")
    assert is_measured(folder / "run")

    reanalyse_folders([folder / "run"], MPI.COMM_SELF, ["analysis.snapshot_stride=3"])
    with xarray.open_dataset(folder / "run/analysis.h5", engine="h5netcdf") as analysis:
        options = json.loads(analysis.attrs["analysis"])
    assert options["cell_stride"] == 1
    assert options["snapshot_stride"] == 3

    for overrides in (["drive.amplitude=2.0"], ["output.stride=2"]):
        with pytest.raises(FolderError, match=r"only \[analysis\] can change"):
            reanalyse_folders([folder / "run"], MPI.COMM_SELF, overrides)
    with pytest.raises(FolderError, match=r"drive\.amplitude"):
        simulate(small_case(drive={"amplitude": 2.0}), folder / "run")


def test_the_default_analysis_is_near_the_full_one():
    """The default strides of the analysis change its measures little; each measure states strides and sampling error.

    The run has hundreds of impacts.
    """
    time = {"engine": "propagator", "rtol": 1e-6}
    run = run_of(Case.from_table({"lattice": {"preset": "four-band", "cells": 60}, "time": time}))
    everything = AnalysisTable(band_stride=1, snapshot_stride=1, cell_stride=1)
    default = analyse(run, ["ibtet", "entropy"])
    full = analyse(run, ["ibtet", "entropy"], options=everything)

    assert default["ibtet"].item() == pytest.approx(full["ibtet"].item(), abs=5e-4)
    assert default["ibtet_whole"].item() == pytest.approx(full["ibtet_whole"].item(), abs=5e-4)
    # Both energies carry rounding errors of about 1e-13 of the largest.
    by_default = default["bands/energy"][:-1]
    by_all = full["bands/energy"][:-1]
    np.testing.assert_allclose(by_default, by_all, rtol=1e-12, atol=1e-13 * float(by_all.max()))
    assert default["ibtet"].attrs["band_stride"] == 10
    assert full["ibtet"].attrs["sampling_error"] == 0
    assert json.loads(default.attrs["analysis"])["cell_stride"] == 2

    for name in ("energy_weighted", "masked", "joint"):
        measure = default[f"entropy/{name}"]
        assert measure.item() == pytest.approx(full[f"entropy/{name}"].item(), rel=1e-3)
        assert measure.attrs["snapshot_stride"] == measure.attrs["cell_stride"] == 2
        assert 0 < measure.attrs["sampling_error"] < 0.01 * measure.item()
