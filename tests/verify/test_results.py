"""Results: files for other programs, windows, chunks, memory, provenance, warnings, a second analysis."""

from __future__ import annotations

import json
import platform
import shutil
import subprocess
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

from mpi4py import MPI

import h5py
import numpy as np
import pandas as pd
import pytest
import xarray
import xarray as xr

import vipetsc as package
from tests.conftest import assert_same_bits, datasets, run_of, small_case
from vipetsc.case import Case, Sweep
from vipetsc.case.schema import AnalysisTable
from vipetsc.cli.main import main
from vipetsc.dynamics import recorded_sizes, simulate
from vipetsc.dynamics.result import Result
from vipetsc.io import export
from vipetsc.io import folder as io_folder
from vipetsc.io.lock import FolderError
from vipetsc.io.netcdf import open_netcdf, variable, write_netcdf
from vipetsc.io.read import open_run
from vipetsc.io.store import RunMemory
from vipetsc.parallel import StopRequest
from vipetsc.studies.analysis import analyse
from vipetsc.studies.analysis_options import is_measured
from vipetsc.studies.reanalysis import measure_run, reanalyse_folders
from vipetsc.studies.sweep import run_sweep


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


PART = {"output": {"window": [3, 17], "every": 4, "stride": 5}}


@pytest.mark.parametrize("sections", [{}, PART, {"output": {"fields": []}}])
def test_the_length_of_a_chunk_does_not_show(folder, monkeypatch, sections):
    """A run has the same bits with chunks of any length."""
    case = small_case(**sections, time={"end": 0.04})
    simulate(case, folder / "long")

    # Seven divides neither the number of samples nor the strides.
    monkeypatch.setattr(recorded_sizes, "CHUNK_SAMPLES", 7)
    simulate(case, folder / "short")

    assert_same_bits(datasets(folder / "long" / "run.h5"), datasets(folder / "short" / "run.h5"))


@pytest.mark.parametrize("sections", [{}, PART, {"contacts": {"sites": []}}])
def test_a_run_in_memory_is_the_run_of_the_file(folder, sections):
    case = small_case(**sections, time={"end": 0.04})
    result = simulate(case, folder / "run")
    memory = RunMemory()
    assert simulate(case, memory).folder is None
    assert memory.dataset is not None

    # Only a dataset in memory has the state at the end, with all cells.
    held = memory.dataset.drop_vars(["end/displacement", "end/velocity"])
    with open_netcdf(folder / "run" / "run.h5", "run") as run:
        assert held.variables.keys() == run.variables.keys()
        for name, item in run.variables.items():
            assert memory.dataset[name].dims == item.dims, name
            assert memory.dataset[name].attrs == item.attrs, name
            assert memory.dataset[name].values.tobytes() == item.values.tobytes(), name
        assert memory.dataset.attrs.keys() == run.attrs.keys()
        assert json.loads(run.attrs["statistics"]) == result.statistics
    write_netcdf(folder / "saved.h5", held)

    assert_same_bits(datasets(folder / "run" / "run.h5"), datasets(folder / "saved.h5"))


def test_contacts_that_still_last_at_the_end_are_logged(folder):
    """A run that ends within a contact logs it, without a separation."""
    simulate(small_case(), folder / "whole")
    whole = datasets(folder / "whole" / "run.h5")
    onset = whole["impacts/onset"]
    separation = whole["impacts/separation"]

    # The run ends at the first sample that lies in a contact.
    interval = small_case().model().sample_interval
    holds_a_sample = np.floor(separation / interval) > np.ceil(onset / interval)
    end = float(np.ceil(onset[holds_a_sample][0] / interval) * interval)
    result = simulate(small_case(time={"end": end}), folder / "cut")

    cut = datasets(folder / "cut" / "run.h5")
    expected = onset <= end
    assert cut["impacts/onset"].tolist() == onset[expected].tolist()
    assert np.isnan(cut["impacts/separation"]).tolist() == (separation[expected] > end).tolist()
    assert np.isnan(cut["impacts/separation"]).any()
    assert result.statistics["episodes"] == expected.sum()


def small_sweep(**options) -> Sweep:
    """Return a sweep of two members that touch nothing, so that they are scaled from one short run."""
    table = {
        "lattice": {"preset": "four-band", "cells": 24},
        "contacts": {"sites": [6], "clearance": 2e-3},
        "drive": {"cycles": 3},
        "time": {"end": 0.01},
        "sweep": {"drive": {"amplitude": [1.0, 2.0]}, "measures": ["transfer"]} | options,
    }
    return Sweep.from_table(table)


def test_a_sweep_without_a_folder_is_the_sweep_with_one(tmp_path, monkeypatch):
    """A sweep in memory has the ensemble of a sweep in a folder, and removes its temporary folder."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    plan = small_sweep()
    held = run_sweep(plan)
    # Temporary folders that stay would fill the disk in a long session.
    assert list(tmp_path.iterdir()) == []
    assert held.folder is None
    assert held.complete
    assert json.loads(held.dataset.attrs["failed"]) == []

    stored = run_sweep(plan, tmp_path / "sweep")
    xr.testing.assert_equal(
        # CPU times differ from call to call.
        held.dataset.drop_vars("cpu_seconds", errors="ignore"),
        stored.dataset.drop_vars("cpu_seconds", errors="ignore"),
    )
    assert np.isfinite(held.dataset["ibtet"]).all()
    assert "sweep of 2 members" in held._repr_html_()


def test_a_sweep_that_is_stopped_stays_where_it_is(tmp_path, monkeypatch):
    """A stopped sweep in memory keeps its temporary folder, with the complete members, and can go on from it."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    stop = StopRequest()
    stop.requested = True
    stopped = run_sweep(small_sweep(), stop=stop)
    assert stopped.resumable
    assert stopped.dataset is None
    assert stopped.folder is not None
    assert Path(stopped.folder).parent == tmp_path

    assert run_sweep(small_sweep(), stopped.folder).complete


WANTED = {"vipetsc_version", "petsc_version", "revision", "command", "petsc_options", "date", "host"}
SHORT = {
    "lattice": {"preset": "four-band", "cells": 12},
    "contacts": {"sites": [4], "clearance": 2e-4},
    "drive": {"cycles": 3},
    "time": {"end": 0.02, "engine": "propagator"},
}


def attributes(path: Path) -> dict:
    """The global attributes of a result file."""
    with open_netcdf(path, "result") as data:
        return data.attrs


def test_every_output_says_when_where_and_from_what(tmp_path, monkeypatch, in_process):
    # Dates are written in whole seconds.
    before = datetime.now(UTC).replace(microsecond=0)
    simulate(small_case(**SHORT), tmp_path / "run")
    measure_run(tmp_path / "run")
    plan = Sweep.from_table(SHORT | {"sweep": {"drive": {"amplitude": [1.0, 30.0]}}})
    run_sweep(plan, tmp_path / "sweep", MPI.COMM_SELF)

    for name in ("run/run.h5", "run/analysis.h5", "sweep/ensemble.h5"):
        given = attributes(tmp_path / name)
        assert given.keys() >= WANTED, name
        assert before <= datetime.fromisoformat(given["date"]) <= datetime.now(UTC)
        assert given["host"] == platform.node()

    assert json.loads((tmp_path / "run/summary.json").read_text()).keys() >= WANTED

    in_process("bands", "--out", tmp_path / "bands")
    assert json.loads((tmp_path / "bands/bands.json").read_text()).keys() >= WANTED

    # Another date, host and revision leave the bits of the results.
    monkeypatch.setattr(io_folder, "revision", lambda: "other")
    monkeypatch.setattr(platform, "node", lambda: "elsewhere")
    simulate(small_case(**SHORT), tmp_path / "again")
    assert attributes(tmp_path / "again/run.h5")["host"] == "elsewhere"
    assert attributes(tmp_path / "again/run.h5")["revision"] == "other"
    assert_same_bits(datasets(tmp_path / "run/run.h5"), datasets(tmp_path / "again/run.h5"))


def test_the_revision_is_that_of_git(tmp_path, monkeypatch):
    (tmp_path / "pyproject.toml").touch()
    for words in ("init -q", "add .", "-c user.name=a -c user.email=a@b commit -qm one"):
        subprocess.run(["git", "-C", tmp_path, *words.split()], check=True)
    head = subprocess.run(["git", "-C", tmp_path, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
    monkeypatch.setattr(package, "__file__", str(tmp_path / "vipetsc/__init__.py"))

    assert io_folder.revision.__wrapped__() == head.stdout[:12]

    (tmp_path / "pyproject.toml").write_text("changed")
    assert io_folder.revision.__wrapped__() == head.stdout[:12] + "+"


HALF = {"time": {"end": 0.04}}


def warnings_of(result: Result) -> list[str]:
    """The warnings of a result; asserts that its files have the same."""
    summary = json.loads((result.folder / "summary.json").read_text())
    with h5py.File(result.folder / "run.h5") as file:
        assert json.loads(file.attrs["warnings"]) == summary["warnings"] == result.warnings
    return result.warnings


def test_indentations_beyond_the_radius(folder):
    """A run warns of indentations beyond the radius, where Hertz's law does not hold, but not with a bilinear law."""

    def warnings(name, **contacts):
        case = small_case(**HALF, drive={"amplitude": 400.0}, contacts={"modulus": 1e5} | contacts)
        # That a wave is large beside its clearance is told too.
        return [text for text in warnings_of(simulate(case, folder / name)) if "times the clearance" not in text]

    (warning,) = warnings("soft")
    assert "exceeds the contacts' radius of 0.005 m: Hertz" in warning
    assert warnings("larger", radius=1.0) == []
    assert warnings("bilinear", law="bilinear") == []


def test_an_energy_balance_that_does_not_close(folder, petsc_options, capsys):
    """Fixed steps too long for the energy balance to close give a warning, from Python and from the command line."""
    petsc_options(ts_rk_type="3bs", ts_adapt_type="none", ts_dt=1e-4)
    result = simulate(small_case(**HALF), folder / "run")
    assert result.complete

    (warning,) = (text for text in warnings_of(result) if text.startswith("the error of the energy balance is "))
    assert f"{result.statistics['ledger_error']:.2g} of the work, above 1e-08" in warning

    words = ["run", "--out", str(folder / "out")]
    for override in ("lattice.cells=24", "contacts.sites=[6]", "time.end=0.02", "output.figures=false"):
        words += ["--set", override]
    assert main(words) == 0
    assert "vipetsc: warning: the error of the energy balance is" in capsys.readouterr().err


FAST = {"time": {"end": 0.03, "engine": "propagator"}, "lattice": {"cells": 16}}


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A short run with contacts that records its fields in a window, at every second cell and every third sample."""
    path = tmp_path_factory.mktemp("run")
    # Strides in time and space differ from 1, so that a reference that ignores them fails.
    simulate(small_case(**FAST, output={"window": [3, 15], "every": 2, "stride": 3}), path)
    export.write_xdmf(path)
    return path


def sizes(item: ElementTree.Element) -> list[int]:
    """The dimensions that an XDMF element states."""
    return [int(size) for size in item.get("Dimensions").split()]


def slab(item: ElementTree.Element, exported) -> np.ndarray:
    """The values to which a hyperslab of an XDMF file refers; asserts that its description fits the dataset."""
    selection, source = item.findall("DataItem")
    start, stride, count = np.array(selection.text.split(), int).reshape(sizes(selection))
    name, _, path = source.text.strip().partition(":")
    with h5py.File(exported / name) as file:
        dataset = file[path]
        assert sizes(source) == list(dataset.shape)
        assert source.get("NumberType") == "Float"
        assert int(source.get("Precision")) == dataset.dtype.itemsize
        # A reader fails on a slab that leaves its dataset.
        assert all(start + (count - 1) * stride < dataset.shape)
        part = dataset[tuple(slice(a, a + n * s, s) for a, n, s in zip(start, count, stride, strict=True))]
    return part.reshape(sizes(item))


def test_every_reference_of_the_mesh_leads_to_its_field(exported):
    grids = ElementTree.parse(exported / "run.xdmf").getroot().findall("Domain/Grid/Grid")
    with open_run(exported / "run.h5") as run:
        displacement = run["displacement"].values
        velocity = run["velocity"].values
        times = run["field_time"].values
        cells = run["cell"].values

    assert len(grids) == len(times) == len(displacement)
    assert [float(grid.find("Time").get("Value")) for grid in grids] == times.tolist()

    for row, grid in enumerate(grids):
        fields = {item.get("Name"): slab(item.find("DataItem"), exported) for item in grid.findall("Attribute")}
        assert fields["displacement (m)"].tobytes() == displacement[row].tobytes()
        assert fields["velocity (m/s)"].tobytes() == velocity[row].tobytes()

        # Cells and masses form a grid whose first coordinate is the number of the cell.
        assert sizes(grid.find("Topology")) == list(displacement.shape[1:])
        origin, spacing = ([float(x) for x in item.text.split()] for item in grid.findall("Geometry/DataItem"))
        assert (origin[0] + spacing[0] * np.arange(len(cells))).tolist() == cells.tolist()


def test_open_gives_units_and_the_case(exported):
    with package.open(exported) as run, package.open(exported / "run.h5") as same:
        assert run["velocity"].attrs["units"] == "m/s"
        assert run["energy/work"].coords["time"].attrs["units"] == "s"
        assert "impacts/onset" in run["impacts/force"].coords
        assert Case.of(run) == Case.of(same)
        assert Case.of(run).lattice.cells == 16
        assert set(run.variables) == set(datasets(exported / "run.h5"))


def test_curves_are_tables_with_units_and_every_digit(exported, in_process):
    before = datasets(exported / "run.h5")

    ended = in_process("export", exported)

    assert ended.returncode == 0, ended.stderr

    # Pandas' faster parser loses the last digit.
    ledger = pd.read_csv(exported / "curves/run-time.csv", float_precision="round_trip")
    impacts = pd.read_csv(exported / "curves/run-impacts.csv", float_precision="round_trip")
    with open_run(exported / "run.h5") as run:
        assert ledger["energy/work (J)"].values.tobytes() == run["energy/work"].values.tobytes()
        assert ledger["time (s)"].values.tobytes() == run["time"].values.tobytes()
        assert impacts["force (N)"].values.tobytes() == run["impacts/force"].values.tobytes()
        assert impacts["onset (s)"].values.tobytes() == run["impacts/onset"].values.tobytes()

    assert f"  {exported / 'run.xdmf'}" in ended.stdout.splitlines()
    assert_same_bits(before, datasets(exported / "run.h5"))


def test_a_sweep_is_one_table_of_members(tmp_path):
    table = {"lattice": {"preset": "four-band", "cells": 12}, "contacts": {"sites": [4], "clearance": 2e-4}}
    axes = {"drive": {"amplitude": [1.0, 30.0]}, "contacts": {"restitution": [0.5, 1.0]}}
    plan = Sweep.from_table(table | {"drive": {"cycles": 3}, "time": {"end": 0.02}, "sweep": axes})
    run_sweep(plan, tmp_path, MPI.COMM_SELF)

    written = [path.name for path in export.write_curves(tmp_path)]
    assert [name for name in written if "members" in name] == ["ensemble-members.csv"]

    members = pd.read_csv(tmp_path / "curves/ensemble-members.csv", float_precision="round_trip")
    with package.open(tmp_path) as ensemble:
        picked = ensemble.sel(amplitude=30.0, restitution=0.5)
        row = members[(members["amplitude (N)"] == 30.0) & (members["restitution"] == 0.5)]
        assert len(members) == 4
        assert row["ibtet"].item() == picked["ibtet"].item()


@pytest.mark.parametrize("name", ["missing.h5", "case.toml"])
def test_a_file_without_results_next_to_a_run_is_refused_before_anything_is_written(
    exported, in_process, tmp_path, name
):
    """Bad input leaves no file: neither a missing file nor one of another kind brings the mesh of the run beside it."""
    shutil.copy(exported / "run.h5", tmp_path / "run.h5")
    (tmp_path / "case.toml").write_text("no results")
    ended = in_process("export", tmp_path / name)
    assert ended.returncode == 2
    assert name in ended.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["case.toml", "run.h5"]


def search_of_two() -> xr.Dataset:
    """Return the file of a search of two designs over a length and a choice."""
    labels = {"variable": ["clearance 1", "law"], "objective": ["1: ibtet"], "constraint": ["work"]}
    data = {label: variable(label, np.array(names, dtype=object), "1", label) for label, names in labels.items()}
    data["design"] = variable("design", [0, 1], "1", "design")
    data["unit"] = variable("variable", np.array(["m", "1"], dtype=object), "1", "unit")
    data["parameter"] = variable(("design", "variable"), [[1e-4, 1.0], [2e-4, 2.0]], "1", "parameter")
    data["value"] = variable(("design", "objective"), [[0.3], [0.4]], "1", "value")
    data["constrained"] = variable(("design", "constraint"), [[5.0], [6.0]], "1", "constrained")
    data["excess"] = variable("design", [0.0, 0.5], "1", "excess")
    data["other"] = variable(("variable", "objective"), [[7.0], [8.0]], "1", "not of the designs")
    return xr.Dataset(data, attrs={"case": ""})


def test_a_table_of_designs_has_a_column_for_each_variable_objective_and_constraint(tmp_path):
    write_netcdf(tmp_path / "optimum.h5", search_of_two())
    assert tmp_path / "curves" / "optimum-design.csv" in export.write_curves(tmp_path / "optimum.h5")
    table = pd.read_csv(tmp_path / "curves" / "optimum-design.csv", float_precision="round_trip")
    columns = {"design": [0, 1], "excess": [0, 0.5], "clearance 1 (m)": [1e-4, 2e-4], "law": [1, 2]}
    assert table.to_dict("list") == columns | {"1: ibtet": [0.3, 0.4], "work": [5, 6]}
