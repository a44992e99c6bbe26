"""Every picture of a run and its analysis, from small run files of every shape that a run can have."""

import json
import re
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import pytest
import xarray as xr
from matplotlib.image import imread
from scipy.integrate import trapezoid

from tests.readable import complaints
from vipetsc.case import Case
from vipetsc.figures.lattice_strip import draw_lattice
from vipetsc.figures.log_ticks import label_log_axis
from vipetsc.figures.panels import label_panels
from vipetsc.figures.registry import draw, draw_bands, figure_names
from vipetsc.figures.runs import phase
from vipetsc.figures.schematics import draw_unit_cell
from vipetsc.figures.style import SCREEN, LeftOut, NoPicture, new_figure, rc_style, save
from vipetsc.io.kinds import BRANCHES, OPTIMUM
from vipetsc.io.read import open_run
from vipetsc.lattice import Chain, Spring, UnitCell, diatomic, four_band
from vipetsc.lattice.chain import Pair
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


def assert_not_blank(path: Path) -> None:
    image = imread(path)[..., :3]
    # The deviation of a page of one colour is zero.
    assert image.std() > 0.005
    # Nothing is cut off: the outermost pixels belong to the page.
    edge = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    assert np.all(edge == 1)


@pytest.mark.slow
def test_every_figure_is_drawn_from_every_shape_of_run(measured, plain_pictures):
    """Every figure is drawn but those of ``WITHOUT``: a further reason would keep a picture from being drawn."""
    folder, shape = measured
    left_out = LeftOut()
    paths = draw("run", [folder], left_out=left_out)
    assert left_out.reasons.keys() == WITHOUT.get(shape, set()) | OF_POINTS | OF_STRIPS
    assert {path.stem for path in paths} == {*figure_names("run")} - left_out.reasons.keys()
    # No temporary file stays.
    assert not list((folder / "figures").glob(".*"))


def test_a_site_that_was_not_reached_has_no_portrait(tmp_path):
    """A run that ends before a wave has reached the first site has no phase portraits, which would be empty axes."""
    write_run(tmp_path / "run.h5")
    with open_run(tmp_path / "run.h5") as run, pytest.raises(NoPicture, match="cell 8, the first site, was at rest"):
        phase(run.assign(displacement=xr.zeros_like(run["displacement"])), None)


def test_the_analysis_names_what_it_left_out(measured):
    """The analysis has the measures that the record allows, and names those left out."""
    folder, shape = measured
    with h5py.File(folder / "analysis.h5") as file:
        assert ("dispersion" in file) == (shape not in ("single cell", "no velocity"))
        assert ("dispersion_before" in file) == (shape in COMPLETE)
        assert ("ibtet" in file) == (shape != "no velocity")
        assert (file.attrs["left_out"] == "") == (shape in COMPLETE)
    assert not list(folder.glob(".*"))


@pytest.mark.slow
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


@pytest.mark.slow
def test_ranks_divide_the_figures_among_them(tmp_path):
    write_run(tmp_path / "run.h5")
    written = []
    left_out = LeftOut()
    for rank in range(2):
        # Each of two ranks draws every second picture.
        paths = draw("run", [tmp_path], formats=("pdf",), turns=count(rank, 2), left_out=left_out)
        written += [path.name for path in paths]
    drawable = {*figure_names("run")} - {*left_out.reasons}
    assert sorted(written) == sorted(f"{name}.pdf" for name in drawable)


def test_a_misspelt_figure_is_refused_with_the_nearest_name(tmp_path):
    write_run(tmp_path / "run.h5")
    with pytest.raises(KeyError, match="ledger"):
        draw("run", [tmp_path], ["leger"])


@pytest.mark.parametrize(
    ("source", "name", "message"),
    [
        (BRANCHES.source, "brunch", "no figure 'brunch' of branches; did you mean 'branch'"),
        (OPTIMUM.source, "converge", "no figure 'converge' of an optimum; did you mean 'convergence'"),
    ],
)
def test_a_figure_that_a_source_does_not_have_is_refused(source, name, message):
    with pytest.raises(KeyError, match=re.escape(message)):
        figure_names(source, [name])


def test_panels_of_a_large_grid_have_letters_as_far_as_there_are_numerals():
    """Twelve of fourteen rows of panels, as in a sweep over fourteen wavenumbers, have letters and numerals."""
    with rc_style():
        grid = new_figure(4, 14).subplots(14, 2)
        for axes in grid.flat:
            axes.set_title("title")
        label_panels(grid)
    titles = [axes.get_title("left") for axes in grid[:, 1]]
    assert titles[0] == "(b.i) title"
    assert titles[11:] == ["(b.xii) title", "title", "title"]


def test_a_file_that_is_no_run_is_not_measured(tmp_path):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(ValueError, match="not a run"):
        measure_run(tmp_path)
    # An incomplete analysis would be taken for the whole one.
    assert not (tmp_path / "analysis.h5").exists()


def test_a_lone_mass_is_drawn_with_what_its_contacts_join():
    """A cell of one mass is drawn with the next cell's mass that its contact joins to it, or with the ground."""
    cell = UnitCell(masses=(0.01,), springs=(), host=0, resonator=0)
    texts = []
    # -1 is the ground.
    for pairs in ((), (Pair(0, 0, offset=1),), (Pair(-1, 0),)):
        with rc_style():
            axes = new_figure(5, 2).subplots()
            draw_unit_cell(axes, cell, pairs)
        texts.append([text.get_text() for text in axes.texts])
    lone, bead, grounded = texts
    assert "contact, Δ" not in lone
    assert "contact, Δ" in bead
    assert bead.count("$m_{1}$") == 2
    assert "contact, Δ" in grounded
    assert grounded.count("$m_{1}$") == 1


@pytest.mark.parametrize(
    ("pairs", "has_stops"), [((), True), ((Pair(0, 0, offset=1),), False), ((Pair(0, 0, offset=1), Pair(0, 1)), True)]
)
def test_a_resonator_in_its_host_has_stops_where_it_meets_the_host(pairs, has_stops):
    """A grain whose contacts join it to the next grain alone is drawn without stops around its resonator."""
    cell = UnitCell(masses=(0.01, 0.02), springs=(Spring(0, 1, 1e3),), host=0, resonator=1)
    with rc_style():
        axes = new_figure(5, 2).subplots()
        draw_unit_cell(axes, cell, pairs)
    texts = [text.get_text() for text in axes.texts]
    assert ("Δ" in texts) == has_stops
    # Without other masses in contact nothing is drawn beyond the cell.
    assert ("contact, Δ" in texts) == bool(pairs)
    assert texts.count("$m_{1}$") == len(pairs[:1])
    assert texts.count("$m_{2}$") == 1


# A cell of five masses, two of which have springs to the next cell; and a chain with a separate pair of masses.
ODD_CELL = UnitCell(
    masses=(0.01, 0.02, 0.03, 0.004, 0.005),
    springs=(
        Spring(0, 1, 1e4),
        Spring(1, 2, 2e4),
        Spring(0, 2, 500.0),
        Spring(2, 0, 3e4, offset=1),
        Spring(1, 3, 1.0),
        Spring(3, 4, 7e3),
        Spring(1, 1, 50.0, offset=1),
    ),
    host=1,
    resonator=3,
)
UNCONNECTED_CELL = UnitCell(
    masses=(1.0, 2.0, 3.0), springs=(Spring(0, 0, 5.0, offset=1), Spring(1, 2, 1.0)), host=0, resonator=2
)


@pytest.mark.slow
@pytest.mark.parametrize("cell", [diatomic(), four_band(), ODD_CELL, UNCONNECTED_CELL])
def test_any_cell_can_be_drawn(tmp_path, cell):
    with rc_style():
        figure = new_figure(5, 6)
        upper, *lower = figure.subplots(4, 1)
        draw_unit_cell(upper, cell)
        for axes, ends in zip(lower, ("fixed", "free", "periodic"), strict=True):
            draw_lattice(axes, Chain(cell, 30, ends, (3, 4, 20), (1e-3,) * 3), 2, ((1e-3, 1e-3),) * 3)
        figure.savefig(tmp_path / "cell.png")

    labels = [text.get_text() for text in upper.texts]
    for number in range(1, cell.dofs + 1):
        assert any(f"m_{{{number}}}" in label for label in labels)
    # Every strip shows something.
    image = imread(tmp_path / "cell.png")[..., :3]
    assert all(part.std() > 0.005 for part in np.array_split(image, 4))
    assert_not_blank(draw_bands(cell, tmp_path / "bands.png"))


def height_with_warnings(folder: Path, warnings: Sequence[str]) -> int:
    """Return the height in pixels of a picture of the run in ``folder`` with these warnings."""
    with h5py.File(folder / "run.h5", "a") as file:
        file.attrs["warnings"] = json.dumps(list(warnings))
    (path,) = draw("run", [folder], ["ledger"])
    return imread(path).shape[0]


@pytest.mark.slow
def test_warnings_about_a_run_stand_below_its_pictures_each_once(tmp_path):
    write_run(tmp_path / "run.h5")
    plain = height_with_warnings(tmp_path, [])
    wide = "a sentence that is wider than the picture " * 4
    # Lines are about 0.16 inches high: these warnings take three lines or more, and any number of them four at most.
    assert height_with_warnings(tmp_path, ["one", wide, "one"]) >= plain + 3 * 0.15 * SCREEN
    # Warnings differ in letters here, since those that differ in numbers alone are counted and stand once.
    many = [f"warning {chr(number)}" for number in range(300, 600)]
    assert height_with_warnings(tmp_path, many) <= plain + 4 * 0.17 * SCREEN


def test_a_note_leaves_the_picture_above_it_as_it_is(tmp_path):
    """A note adds a strip below and moves no pixel above it, not even a legend at the lower end of the page."""
    pixels = []
    for number, label in enumerate(("", "a warning\nand another one")):
        with rc_style():
            figure = new_figure(3, 2, "a heading")
            axes = figure.subplots()
            (line,) = axes.plot([0, 1], [2, 3])
            figure.get_layout_engine().set(rect=(0, 0.15, 1, 0.85))
            figure.legend([line], ["a curve"], loc="lower center")
            figure.set_label(label)
            pixels.append(imread(save(figure, tmp_path / f"{number}.png"))[..., :3])
    plain, noted = pixels
    assert len(noted) > len(plain)
    # The upper rows of pixels are those of the page without a note.
    np.testing.assert_array_equal(noted[: len(plain)], plain)


def test_fonts_of_a_pdf_are_outlines(tmp_path):
    """Fonts are embedded as TrueType, which editors and printers accept, and not as Type 3."""
    with rc_style():
        figure = new_figure(2, 2, r"plain and $\kappa^2$")
        figure.subplots()
        path = save(figure, tmp_path / "text.pdf")
    assert b"/Type3" not in path.read_bytes()
    assert b"/CIDFontType2" in path.read_bytes()


@pytest.mark.parametrize("low", [1e-7, 0.3, 2.0, 900.0])
@pytest.mark.parametrize("ratio", [1.3, 4.0, 30.0, 1e3, 1e12])
def test_logarithmic_axes_have_three_labels_or_more(low, ratio, tmp_path):
    """Logarithmic axes of any range have three labels or more, none over another, also on a small panel."""
    with rc_style():
        figure = new_figure(2.4, 1.5)
        axes = figure.subplots()
        axes.loglog([low, low * ratio], [low, low * ratio])
        save(figure, tmp_path / "ranges.png")
        assert complaints(figure) == []


def test_a_decade_without_room_for_a_label_has_a_tick():
    """The decade 0.01, for whose label there is no room, has a tick: without it labels would seem evenly spaced."""
    axis = new_figure(2, 2).subplots().xaxis
    label_log_axis(axis, 6e-4, 5.0, length=1.2)
    assert axis.get_majorticklocs().tolist() == [0.001, 0.1, 1.0]
    assert axis.get_minorticklocs().tolist() == [0.01]


def test_a_long_heading_takes_lines(tmp_path):
    with rc_style():
        figure = new_figure(2, 2, "a heading that is longer than the page is wide, which is two inches and no more")
        figure.subplots()
        save(figure, tmp_path / "heading.png")
        assert complaints(figure) == []
