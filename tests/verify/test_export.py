"""Results for other programs: XDMF files with references into run.h5, CSV tables, ``vipetsc.open``, plain xarray."""

from __future__ import annotations

import shutil
from xml.etree import ElementTree

from mpi4py import MPI

import h5py
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import vipetsc as package
from tests.conftest import assert_same_bits, datasets, small_case
from vipetsc.case import Case, Sweep
from vipetsc.dynamics import simulate
from vipetsc.io import export
from vipetsc.io.branch_kinds import RESPONSES
from vipetsc.io.netcdf import variable, write_netcdf
from vipetsc.io.read import open_run
from vipetsc.studies.sweep import run_sweep

FAST = {"time": {"end": 0.03, "engine": "propagator"}, "lattice": {"cells": 16}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A short run with contacts that records its fields in a window, at every second cell and every third sample."""
    path = tmp_path_factory.mktemp("run")
    # Strides in time and space differ from 1, so that a reference that ignores them fails.
    simulate(small_case(**FAST, output={"window": [3, 15], "every": 2, "stride": 3}), path)
    export.write_xdmf(path)
    return path


def sizes(item: ElementTree.Element) -> list[int]:
    """The dimensions that an XDMF element states."""
    return [int(size) for size in item.get("Dimensions").split()]


def slab(item: ElementTree.Element, folder) -> np.ndarray:
    """The values to which a hyperslab of an XDMF file refers; asserts that its description fits the dataset."""
    selection, source = item.findall("DataItem")
    start, stride, count = np.array(selection.text.split(), int).reshape(sizes(selection))
    name, _, path = source.text.strip().partition(":")
    with h5py.File(folder / name) as file:
        dataset = file[path]
        assert sizes(source) == list(dataset.shape)
        assert source.get("NumberType") == "Float"
        assert int(source.get("Precision")) == dataset.dtype.itemsize
        # A reader fails on a slab that leaves its dataset.
        assert all(start + (count - 1) * stride < dataset.shape)
        part = dataset[tuple(slice(a, a + n * s, s) for a, n, s in zip(start, count, stride, strict=True))]
    return part.reshape(sizes(item))


def test_every_reference_of_the_mesh_leads_to_its_field(folder):
    grids = ElementTree.parse(folder / "run.xdmf").getroot().findall("Domain/Grid/Grid")
    with open_run(folder / "run.h5") as run:
        displacement = run["displacement"].values
        velocity = run["velocity"].values
        times = run["field_time"].values
        cells = run["cell"].values

    assert len(grids) == len(times) == len(displacement)
    assert [float(grid.find("Time").get("Value")) for grid in grids] == times.tolist()

    for row, grid in enumerate(grids):
        fields = {item.get("Name"): slab(item.find("DataItem"), folder) for item in grid.findall("Attribute")}
        assert fields["displacement (m)"].tobytes() == displacement[row].tobytes()
        assert fields["velocity (m/s)"].tobytes() == velocity[row].tobytes()

        # Cells and masses form a grid whose first coordinate is the number of the cell.
        assert sizes(grid.find("Topology")) == list(displacement.shape[1:])
        origin, spacing = ([float(x) for x in item.text.split()] for item in grid.findall("Geometry/DataItem"))
        assert (origin[0] + spacing[0] * np.arange(len(cells))).tolist() == cells.tolist()


def test_groups_carry_their_time_in_plain_xarray(folder):
    """Plain xarray, which opens one group at a time, finds coordinates of the file, since they are linked into each."""
    with xr.open_dataset(folder / "run.h5", engine="h5netcdf") as run:
        time = run.time.values
    with xr.open_dataset(folder / "run.h5", engine="h5netcdf", group="energy") as energy:
        assert energy.work.time.values.tolist() == time.tolist()
        assert energy.time.attrs["units"] == "s"
    with xr.open_dataset(folder / "run.h5", engine="h5netcdf", group="impacts") as impacts:
        assert "onset" in impacts.loss.coords
        assert impacts.onset.attrs["units"] == "s"
        assert impacts.loss.sizes["episode"] > 2


def test_open_gives_units_and_the_case(folder):
    with package.open(folder) as run, package.open(folder / "run.h5") as same:
        assert run["velocity"].attrs["units"] == "m/s"
        assert run["energy/work"].coords["time"].attrs["units"] == "s"
        assert "impacts/onset" in run["impacts/force"].coords
        assert Case.of(run) == Case.of(same)
        assert Case.of(run).lattice.cells == 16
        assert set(run.variables) == set(datasets(folder / "run.h5"))


def test_curves_are_tables_with_units_and_every_digit(folder, in_process):
    before = datasets(folder / "run.h5")

    ended = in_process("export", folder)

    assert ended.returncode == 0, ended.stderr

    # Pandas' faster parser loses the last digit.
    ledger = pd.read_csv(folder / "curves/run-time.csv", float_precision="round_trip")
    impacts = pd.read_csv(folder / "curves/run-impacts.csv", float_precision="round_trip")
    with open_run(folder / "run.h5") as run:
        assert ledger["energy/work (J)"].values.tobytes() == run["energy/work"].values.tobytes()
        assert ledger["time (s)"].values.tobytes() == run["time"].values.tobytes()
        assert impacts["force (N)"].values.tobytes() == run["impacts/force"].values.tobytes()
        assert impacts["onset (s)"].values.tobytes() == run["impacts/onset"].values.tobytes()

    assert f"  {folder / 'run.xdmf'}" in ended.stdout.splitlines()
    assert_same_bits(before, datasets(folder / "run.h5"))


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
def test_a_file_without_results_next_to_a_run_is_refused_before_anything_is_written(folder, in_process, tmp_path, name):
    """Bad input leaves no file: neither a missing file nor one of another kind brings the mesh of the run beside it."""
    shutil.copy(folder / "run.h5", tmp_path / "run.h5")
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


def response_of_two(kind: str) -> xr.Dataset:
    """Return a branch of a ``kind`` with two points, and the largest force at two sites in each of them."""
    data = {
        "point": variable("point", [0, 1], "1", "point"),
        "site": variable("site", [1, 2], "1", "site"),
        "force": variable(("point", "site"), [[1.0, 2.0], [3.0, 4.0]], "N", "largest force"),
        "shape": variable(("point", "mass"), np.eye(2), "m", "not of the sites"),
        "mass": variable("mass", [1, 2], "1", "mass"),
        "energy": variable("point", [5.0, 6.0], "J", "energy"),
    }
    return xr.Dataset(data, attrs={"case": "", "branch_kind": kind})


@pytest.mark.parametrize(
    ("data", "file", "columns"),
    [
        (
            search_of_two(),
            "optimum-design.csv",
            {"design": [0, 1], "excess": [0, 0.5], "clearance 1 (m)": [1e-4, 2e-4], "law": [1, 2]}
            | {"1: ibtet": [0.3, 0.4], "work": [5, 6]},
        ),
        (
            response_of_two(RESPONSES),
            "optimum-point.csv",
            {"point": [0, 1], "energy (J)": [5, 6], "force/1 (N)": [1, 3], "force/2 (N)": [2, 4]},
        ),
        (response_of_two("another"), "optimum-point.csv", {"point": [0, 1], "energy (J)": [5, 6]}),
    ],
)
def test_labels_of_a_second_dimension_are_columns_with_their_units(tmp_path, data, file, columns):
    """A table has a column for each variable, objective and constraint of a search, and each site of a response."""
    write_netcdf(tmp_path / "optimum.h5", data)
    written = export.write_curves(tmp_path / "optimum.h5")
    assert tmp_path / "curves" / file in written
    table = pd.read_csv(tmp_path / "curves" / file, float_precision="round_trip")
    assert table.to_dict("list") == columns
