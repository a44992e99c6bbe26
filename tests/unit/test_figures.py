"""Every picture and the analysis, from small run files of every shape a run can have."""

import json

import h5py
import numpy as np
import pytest
from matplotlib.image import imread
from scipy.integrate import trapezoid

from vipetsc.case import Case
from vipetsc.figures.registry import BRANCHES, draw, draw_bands, figure_names
from vipetsc.figures.schematics import draw_lattice, draw_unit_cell
from vipetsc.figures.style import SCREEN, new_figure, rc_style
from vipetsc.lattice import Chain, Spring, UnitCell, diatomic, four_band
from vipetsc.spectra import kinetic_energy
from vipetsc.studies.reanalysis import measure_run

NT, CELLS, INTERVAL = 240, 24, 2e-4
ENERGIES = ("kinetic", "spring", "contact", "work", "dissipated")
IMPACTS = ("site", "side", "onset", "approach_velocity", "separation", "indentation", "force", "loss")


def write_run(path, *, sites=(8, 16), window=None, stride=1, episodes=6, fields=("displacement", "velocity")):
    """A run of a 24-cell lattice with a travelling wave in it, as the store lays it out."""
    overrides = [f"lattice.cells={CELLS}", f"contacts.sites={list(sites)}", f"time.end={(NT - 1) * INTERVAL}"]
    overrides += ["contacts.clearance=0.001"] if sites else []
    case = Case.load(overrides=[*overrides, f"time.sample_interval={INTERVAL}"])
    t = np.arange(NT) * INTERVAL
    number = np.arange(1, CELLS + 1) if window is None else np.arange(window[0], window[1] + 1)
    at = t[::stride]
    phase = 1.8 * number[None, :, None] - 1023.0 * at[:, None, None] + 0.3 * np.arange(4)
    envelope = np.exp(-(((number[None, :, None] - 430 * at[:, None, None]) / 5) ** 2))
    field = {"displacement": 1e-3 * envelope * np.cos(phase), "velocity": 1.023 * envelope * np.sin(phase)}
    with h5py.File(path, "w") as file:

        def put(name, values, units, *dims):
            data = file.create_dataset(name, data=values)
            data.attrs["units"] = units
            if not dims:
                data.make_scale(name)
            for axis, dim in enumerate(dims):
                data.dims[axis].attach_scale(file[dim])

        put("time", t, "s")
        put("cell", number, "1")
        put("dof", np.arange(1, 5), "1")
        put("site", np.arange(1, len(sites) + 1), "1")
        put("episode", np.arange(1, episodes + 1), "1")
        when = "time"
        if stride > 1:
            put("field_time", at, "s")
            when = "field_time"
        for name in fields:
            put(name, field[name], {"displacement": "m", "velocity": "m/s"}[name], when, "cell", "dof")
        for name in ENERGIES:
            put(f"energy/{name}", np.minimum(t / t[-1], 0.5) * (2 if name == "work" else 1), "J", "time")
        put("energy/dissipated_by_site", np.zeros((NT, len(sites))), "J", "time", "site")
        put("sites/cell", np.array(sites, int), "1", "site")
        put("sites/clearance", np.full(len(sites), 1e-3), "m", "site")
        for name in IMPACTS:
            values = np.linspace(0.01, 0.04, episodes)
            if name in ("site", "side"):
                values = np.resize([1, 2] if name == "site" else [1, -1], episodes)
            if name == "separation" and episodes:
                values[-1] = np.nan
            put(f"impacts/{name}", values, "1", "episode")
        file.attrs["case"], file.attrs["status"], file.attrs["complete"] = case.to_toml(), "at the end", True


SHAPES = {
    "whole": {},
    "no sites": {"sites": (), "episodes": 0},
    "no impacts": {"episodes": 0},
    "window after the site": {"window": (10, 20)},
    "single cell": {"window": (8, 8)},
    "two cells": {"window": (7, 8)},
    "every third sample": {"stride": 3},
    "no velocity": {"fields": ("displacement",)},
}


@pytest.fixture(scope="module", params=SHAPES, ids=lambda s: s.replace(" ", "-"))
def folder(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("run")
    write_run(path / "run.h5", **SHAPES[request.param])
    measure_run(path)
    return path, request.param


def assert_not_blank(path):
    image = imread(path)[..., :3]
    assert image.std() > 0.005
    # Nothing is cut off: the outermost pixels belong to the page.
    edge = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    assert np.all(edge == 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", figure_names("run"))
def test_every_figure_draws(folder, name):
    (path,) = draw("run", [folder[0]], [name])
    assert path == folder[0] / "figures" / f"{name}.png"
    assert_not_blank(path)
    assert not list(path.parent.glob(".*"))


def test_analysis_says_what_it_left_out(folder):
    path, shape = folder
    with h5py.File(path / "analysis.h5") as file:
        left_out = file.attrs["left_out"]
        assert ("dispersion" in file) == (shape not in ("single cell", "no velocity"))
        assert ("dispersion_before" in file) == (shape in ("whole", "no impacts", "every third sample"))
        assert ("ibtet" in file) == (shape != "no velocity")
        complete = shape in ("whole", "no impacts", "every third sample")
        assert (left_out == "") == complete
    assert not list(path.glob(".*"))


def test_analysis_opens_in_xarray_and_agrees_with_the_run(tmp_path):
    xarray = pytest.importorskip("xarray")
    write_run(tmp_path / "run.h5")
    measure_run(tmp_path)
    with h5py.File(tmp_path / "run.h5") as run:
        kinetic = kinetic_energy(run["velocity"][...], four_band().masses)
    with xarray.open_dataset(tmp_path / "analysis.h5", engine="h5netcdf") as data:
        assert data.kinetic_energy.dims == ("time", "cell")
        assert data.dispersion.dims == ("wavenumber", "frequency")
        assert all("units" in v.attrs for v in data.variables.values())
        assert np.allclose(data.kinetic_energy, kinetic, rtol=1e-7)
        assert np.allclose(data.wavenumber_content.sum("wavenumber"), kinetic.sum(axis=1), rtol=1e-6)
        assert 0 <= float(data.ibtet) < 0.05
    with xarray.open_dataset(tmp_path / "analysis.h5", engine="h5netcdf", group="bands") as bands:
        assert bands.energy.dims == ("part", "sample")
        assert trapezoid(bands.total) == pytest.approx(trapezoid(kinetic.sum(axis=1)), rel=1e-12)
        # Only what lies above the bands is not taken at every sample.
        assert trapezoid(bands.energy.sum("part")) == pytest.approx(trapezoid(kinetic.sum(axis=1)), rel=1e-3)


@pytest.mark.slow
def test_ranks_share_the_figures_and_formats(tmp_path):
    write_run(tmp_path / "run.h5")
    written = [p.name for rank in range(2) for p in draw("run", [tmp_path], formats=("pdf",), rank=rank, ranks=2)]
    assert sorted(written) == sorted(f"{n}.pdf" for n in figure_names("run"))


def test_a_wrong_name_and_a_foreign_file_are_refused(tmp_path):
    write_run(tmp_path / "run.h5")
    with pytest.raises(KeyError, match="ledger"):
        draw("run", [tmp_path], ["leger"])
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(ValueError, match="not a run"):
        measure_run(tmp_path)
    assert not (tmp_path / "analysis.h5").exists()


ODD = UnitCell(
    (0.01, 0.02, 0.03, 0.004, 0.005),
    (Spring(0, 1, 1e4), Spring(1, 2, 2e4), Spring(0, 2, 500.0), Spring(2, 0, 3e4, True), Spring(1, 3, 1.0),
     Spring(3, 4, 7e3), Spring(1, 1, 50.0, True)),
    host=1, resonator=3,
)  # fmt: skip
APART = UnitCell((1.0, 2.0, 3.0), (Spring(0, 0, 5.0, True), Spring(1, 2, 1.0)), host=0, resonator=2)


@pytest.mark.slow
@pytest.mark.parametrize("cell", [diatomic(), four_band(), ODD, APART])
@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_any_cell_can_be_drawn(tmp_path, cell, ends):
    with rc_style():
        figure = new_figure(5, 3)
        upper, lower = figure.subplots(2, 1)
        draw_unit_cell(upper, cell)
        draw_lattice(lower, Chain(cell, 30, ends, (3, 4, 20), (1e-3,) * 3), 2)
        figure.savefig(tmp_path / "cell.png")
    labels = {text.get_text() for text in upper.texts}
    assert all(any(f"m_{{{i + 1}}}" in text for text in labels) for i in range(cell.dofs))
    assert imread(tmp_path / "cell.png").std() > 0.005
    assert_not_blank(draw_bands(cell, tmp_path / "bands.png"))


@pytest.mark.slow
def test_warnings_about_a_run_stand_below_its_pictures_each_once(tmp_path):
    write_run(tmp_path / "run.h5")
    (plain,) = draw("run", [tmp_path], ["ledger"])
    height = imread(plain).shape[0]
    with h5py.File(tmp_path / "run.h5", "a") as file:
        file.attrs["warnings"] = json.dumps(["one", "a sentence that is wider than the picture " * 4, "one"])
    (warned,) = draw("run", [tmp_path], ["ledger"])
    assert imread(warned).shape[0] >= height + 3 * 0.15 * SCREEN
    with h5py.File(tmp_path / "run.h5", "a") as file:
        file.attrs["warnings"] = json.dumps([f"warning {i}" for i in range(300)])
    (crowded,) = draw("run", [tmp_path], ["ledger"])
    assert imread(crowded).shape[0] <= height + 4 * 0.17 * SCREEN


def test_a_figure_that_branches_do_not_have_is_refused():
    with pytest.raises(KeyError, match="no figure 'foo' of branches; did you mean 'branch'"):
        figure_names(BRANCHES, ["foo"])
