"""Every picture of a run and its analysis, from small run files of every shape that a run can have."""

from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import pytest
from scipy.integrate import trapezoid

from tests.readable import complaints
from vipetsc.case import Case
from vipetsc.figures.registry import draw, figure_names
from vipetsc.figures.style import LeftOut, new_figure, rc_style, save
from vipetsc.lattice import four_band
from vipetsc.spectra import kinetic_energy
from vipetsc.studies.reanalysis import measure_run

SAMPLES = 240
CELLS = 24
INTERVAL = 2e-4  # s
UNITS = {"displacement": "m", "velocity": "m/s"}


class RunShape(NamedTuple):
    """Contents of a run: ``sites`` (cells, from 1), first and last recorded cell, field stride, episodes, fields."""

    sites: tuple[int, ...] = (8, 16)
    window: tuple[int, int] = (1, CELLS)
    stride: int = 1
    episodes: int = 6
    fields: tuple[str, ...] = ("displacement", "velocity")


WHOLE = RunShape()


def case_of(shape: RunShape) -> Case:
    overrides = [
        f"lattice.cells={CELLS}",
        f"contacts.sites={list(shape.sites)}",
        f"time.end={(SAMPLES - 1) * INTERVAL}",
        f"time.sample_interval={INTERVAL}",
    ]
    if shape.sites:
        overrides.append("contacts.clearance=0.001")
    return Case.load(overrides=overrides)


def travelling_wave(cells: np.ndarray, time: np.ndarray) -> dict[str, np.ndarray]:
    """Return displacements and velocities (t, cell, dof) of a packet of 1 mm at 430 cells/s and 1023 rad/s."""
    x = cells[None, :, None]
    t = time[:, None, None]
    # The frequency lies in the second band of the built-in cell, so that measures of its bands are not zero.
    phase = 1.8 * x - 1023.0 * t + 0.3 * np.arange(4)
    envelope = np.exp(-(((x - 430 * t) / 5) ** 2))
    return {"displacement": 1e-3 * envelope * np.cos(phase), "velocity": 1.023 * envelope * np.sin(phase)}


def impacts(episodes: int) -> dict[str, np.ndarray]:
    """Return columns (episode,) of contacts at two sites on both sides, of which the last one has not ended."""
    values = np.linspace(0.01, 0.04, episodes)
    table = {
        "site": np.resize([1, 2], episodes),
        "side": np.resize([1, -1], episodes),
        "onset": values,
        "approach_velocity": values,
        "separation": values.copy(),
        "indentation": values,
        "impulse": values,
        "force": values,
        "loss": values,
    }
    # A contact that is closed as the run ends has no separation.
    table["separation"][-1:] = np.nan
    return table


def write_run(path: Path, shape: RunShape = WHOLE) -> None:
    """Write a run of a 24-cell lattice with a travelling wave in it, as the store lays it out."""
    time = np.arange(SAMPLES) * INTERVAL
    field_time = time[:: shape.stride]
    cells = np.arange(shape.window[0], shape.window[1] + 1)
    with h5py.File(path, "w") as file:

        def put(name: str, values: np.ndarray, units: str, *dims: str) -> None:
            data = file.create_dataset(name, data=values)
            data.attrs["units"] = units
            if not dims:
                # The store writes scales, from which xarray takes the names of dimensions.
                data.make_scale(name)
            for axis, dim in enumerate(dims):
                data.dims[axis].attach_scale(file[dim])

        put("time", time, "s")
        put("cell", cells, "1")
        put("dof", np.arange(1, 5), "1")
        put("site", np.arange(1, len(shape.sites) + 1), "1")
        put("episode", np.arange(1, shape.episodes + 1), "1")
        axis = "time"
        if shape.stride > 1:
            axis = "field_time"
            put(axis, field_time, "s")

        fields = travelling_wave(cells, field_time)
        for name in shape.fields:
            put(name, fields[name], UNITS[name], axis, "cell", "dof")

        energy = np.minimum(time / time[-1], 0.5)
        for name in ("kinetic", "spring", "contact", "dissipated"):
            put(f"energy/{name}", energy, "J", "time")
        # Half of the work is dissipated, so that no curve lies on the axis.
        put("energy/work", 2 * energy, "J", "time")
        put("energy/dissipated_by_site", np.zeros((SAMPLES, len(shape.sites))), "J", "time", "site")
        put("sites/cell", np.array(shape.sites, int), "1", "site")
        put("sites/clearance", np.full(len(shape.sites), 1e-3), "m", "site")
        for name, values in impacts(shape.episodes).items():
            put(f"impacts/{name}", values, "1", "episode")

        file.attrs["case"] = case_of(shape).to_toml()
        file.attrs["status"] = "at the end"
        file.attrs["complete"] = True


SHAPES = {
    "whole": WHOLE,
    "no sites": RunShape(sites=(), episodes=0),
    "no impacts": RunShape(episodes=0),
    "window after the site": RunShape(window=(10, 20)),
    "single cell": RunShape(window=(8, 8)),
    "two cells": RunShape(window=(7, 8)),
    "every third sample": RunShape(stride=3),
    "no velocity": RunShape(fields=("displacement",)),
}
# Figures that a shape of run does not have.
WITHOUT = {
    "no sites": {"phase", "impacts"},
    "no impacts": {"impacts"},
    "window after the site": {"modal_energies", "phase"},
    "single cell": {"modal_energies", "dispersion"},
    "two cells": {"modal_energies"},
    "no velocity": {"modal_energies", "spacetime", "dispersion", "phase"},
}
OF_POINTS = {"points", "poincare"}  # of runs without named points, as all of these
OF_STRIPS = {"snapshots", "envelope", "wave_vectors"}  # of chains, as all of these
# Shapes of runs of which everything can be measured.
COMPLETE = ("whole", "no impacts", "every third sample")


@pytest.fixture(scope="module", params=SHAPES, ids=lambda name: name.replace(" ", "-"))
def measured(request, tmp_path_factory):
    """Return a folder with a run and its analysis, and the name of the run's shape."""
    folder = tmp_path_factory.mktemp("run")
    write_run(folder / "run.h5", SHAPES[request.param])
    measure_run(folder)
    return folder, request.param


def test_every_figure_is_drawn_from_every_shape_of_run(measured, plain_pictures):
    """Every figure is drawn but those of ``WITHOUT``: a further reason would keep a picture from being drawn."""
    folder, shape = measured
    left_out = LeftOut()
    paths = draw("run", [folder], left_out=left_out)
    assert left_out.reasons.keys() == WITHOUT.get(shape, set()) | OF_POINTS | OF_STRIPS
    assert {path.stem for path in paths} == {*figure_names("run")} - left_out.reasons.keys()
    # No temporary file stays.
    assert not list((folder / "figures").glob(".*"))


def test_the_analysis_names_what_it_left_out(measured):
    """The analysis has the measures that the record allows, and names those left out."""
    folder, shape = measured
    with h5py.File(folder / "analysis.h5") as file:
        assert ("dispersion" in file) == (shape not in ("single cell", "no velocity"))
        assert ("dispersion_before" in file) == (shape in COMPLETE)
        assert ("ibtet" in file) == (shape != "no velocity")
        assert (file.attrs["left_out"] == "") == (shape in COMPLETE)
    assert not list(folder.glob(".*"))


def test_the_analysis_opens_in_plain_xarray_and_agrees_with_the_run(tmp_path):
    """xarray reads the analysis with dimensions and units; energies are those of the run; parts sum to the total."""
    xarray = pytest.importorskip("xarray")
    write_run(tmp_path / "run.h5")
    measure_run(tmp_path)
    with h5py.File(tmp_path / "run.h5") as run:
        # The reference is the formula with the velocities of the file.
        kinetic = kinetic_energy(run["velocity"][...], four_band().masses)

    with xarray.open_dataset(tmp_path / "analysis.h5", engine="h5netcdf") as data:
        assert data.kinetic_energy.dims == ("time", "cell")
        assert data.dispersion.dims == ("wavenumber", "frequency")
        assert all("units" in variable.attrs for variable in data.variables.values())
        # Fields are stored in single precision.
        assert np.allclose(data.kinetic_energy, kinetic, rtol=1e-7)
        assert np.allclose(data.wavenumber_content.sum("wavenumber"), kinetic.sum(axis=1), rtol=1e-6)
        # The wave has no energy in bands above the driven one.
        assert 0 <= float(data.ibtet) < 0.05

    with xarray.open_dataset(tmp_path / "analysis.h5", engine="h5netcdf", group="bands") as bands:
        total = trapezoid(kinetic.sum(axis=1))
        assert bands.energy.dims == ("part", "sample")
        assert trapezoid(bands.total) == pytest.approx(total, rel=1e-12)
        # The part above the bands alone is not measured at every sample.
        assert trapezoid(bands.energy.sum("part")) == pytest.approx(total, rel=1e-3)


@pytest.mark.parametrize("low", [1e-7, 2.0])
@pytest.mark.parametrize("ratio", [1.3, 30.0, 1e12])
def test_logarithmic_axes_have_three_labels_or_more(low, ratio, tmp_path):
    """Logarithmic axes of any range have three labels or more, none over another, also on a small panel."""
    with rc_style():
        figure = new_figure(2.4, 1.5)
        axes = figure.subplots()
        axes.loglog([low, low * ratio], [low, low * ratio])
        save(figure, tmp_path / "ranges.png")
        assert complaints(figure) == []
