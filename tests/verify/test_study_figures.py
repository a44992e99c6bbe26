"""Figures of wavenumber scattering show the values in two small sweeps, one with full fields and one of curves."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgba

from vipetsc.case import Case, Sweep
from vipetsc.figures import style as house
from vipetsc.figures import sweep_members
from vipetsc.figures.registry import FIGURES
from vipetsc.figures.scattering import KC, LEAST_WEIGHT, ROWS, amplitudes
from vipetsc.figures.style import GREY, SKY, rc_style
from vipetsc.figures.sweep_members import DrivenWave, Files, Sweeps, series_of
from vipetsc.figures.wavenumber_bins import FIELD, bin_colours, partition, partition_explained, shown_bins
from vipetsc.io.read import field_time, open_ensemble, open_run, select, whole_members
from vipetsc.lattice import bloch
from vipetsc.paper.entropy_pages import AVERAGES
from vipetsc.paper.pages import PAGES
from vipetsc.spectra import filter_bank, normalised, transform
from vipetsc.studies.sweep import run_sweep

CELLS = 40
BASE = {
    "lattice": {"preset": "diatomic", "cells": CELLS},
    "drive": {"band": 2, "wavenumber": "5pi/9", "cycles": 6},
    "time": {"samples": 121, "rtol": 1e-6},
}
WHOLE = {
    "name": "whole",
    "contacts": {"sites": 2},
    "sweep": {"fields": True, "measures": ["entropy"], "drive": {"amplitude": [0.1, 2.0, 20.0]}},
}
CURVES = {
    "name": "curves",
    # Curves need no fields: samples are measured while they are computed, and few are stored.
    "output": {"stride": 4},
    "sweep": {
        "measures": ["entropy"],
        "lattice": {"reading": ["calibrated", "printed"]},
        "drive": {"wavenumber": ["4pi/9", "5pi/9"], "amplitude": {"log": [0.1, 100.0], "count": 5}},
        "contacts": {"sites": [2, 3]},
    },
}
# The figures that need the members' fields, and the figures of the ensemble's curves.
OF_FIELDS = ("amplitudes", "wavelets", "partition", "partition_explained", "reconstruction", "entropy_maps")
OF_CURVES = ("entropy", "entropy_all", "entropy_history")


def swept(table, tmp_path_factory):
    """The ensemble of a sweep of ``BASE`` updated by ``table``."""
    folder = tmp_path_factory.mktemp(table["name"])
    assert run_sweep(Sweep.from_table(BASE | table), folder).complete
    return open_ensemble(folder)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The ensemble of three amplitudes with all fields: without contacts, with a few, and with many."""
    return swept(WHOLE, tmp_path_factory)


@pytest.fixture(scope="module")
def curves(tmp_path_factory):
    """The ensemble of both readings, two wavenumbers and two numbers of sites over five amplitudes."""
    return swept(CURVES, tmp_path_factory)


@pytest.fixture(scope="module")
def entropy_figures(curves):
    """Entropy figures by name: those of one reading and wavenumber, and one of the other reading and wavenumber.

    They are drawn once, since drawing takes longer than all checks of them.
    """
    offered = offered_drawings("entropy", [curves])
    assert len(offered) == 2 * 2 * len(AVERAGES)

    names = [f"calibrated-5pi-9-{average}" for average in AVERAGES]
    with rc_style():
        return {name: offered[name].draw() for name in (*names, "printed-4pi-9-masked")}


@pytest.fixture(autouse=True)
def style():
    """Draw all figures of the module in the package's style."""
    with rc_style():
        yield


def only(name, study):
    """The only figure of ``name`` that a study offers."""
    (drawing,) = offered_drawings(name, study).values()
    return drawing.draw()


def offered_drawings(name, study):
    """The drawings of ``name`` that a study offers, by their suffixes."""
    return {drawing.stem: drawing for drawing in (FIGURES | PAGES)[name].function(Sweeps(study, Files()))}


def maps(figure):
    """The images of a figure in the order in which they were drawn, without colour bars."""
    return [image for axes in figure.axes for image in axes.images]


def limits(images):
    """The different colour limits of some images."""
    return {image.get_clim() for image in images}


def members(ensemble):
    """The folders of the members with fields, in the order of their amplitudes."""
    return [folder for _, folder in whole_members(ensemble)]


@pytest.mark.slow
def test_no_figure_is_offered_where_its_data_lack(whole, curves):
    for name in OF_FIELDS:
        assert list((FIGURES | PAGES)[name].function(Sweeps([curves], Files()))) == []
        assert list((FIGURES | PAGES)[name].function(Sweeps([], Files()))) == []
    for name in OF_CURVES:
        assert list((FIGURES | PAGES)[name].function(Sweeps([whole], Files()))) == []


def test_suffixes_distinguish_figures(curves):
    names = [drawing.stem for drawing in PAGES["entropy_history"].function(Sweeps([curves], Files()))]
    assert names == ["calibrated-4pi-9", "calibrated-5pi-9", "printed-4pi-9", "printed-5pi-9"]

    # With several sweeps, names begin with that of the sweep.
    named = [drawing.stem for drawing in PAGES["entropy_history"].function(Sweeps([curves, curves], Files()))]
    assert named[:4] == [f"curves-{name}" for name in names]


@pytest.mark.slow
def test_amplitudes_have_common_scales_and_show_what_was_measured(whole):
    """Panels show energies divided by the square of the amplitude, each row on one scale, with branches and sites.

    The three rows are energies over cells, over wavenumbers and on the dispersion.
    """
    figure = only("amplitudes", [whole])
    assert figure._suptitle.get_text() == "Calibrated reading, 2 sites, κ* = 5π/9"

    panels = [axes for axes in figure.axes if axes.images and axes.get_title(loc="left")]
    assert len(panels) == 9

    for row, name in enumerate(("kinetic_energy", "wavenumber_content", "dispersion")):
        images = [axes.images[0] for axes in panels[3 * row : 3 * row + 3]]
        assert len(limits(images)) == 1

        # A row has one scale of colours, which ends at the row's largest value.
        largest = 0.0
        for image, folder, amplitude in zip(images, members(whole), (0.1, 2.0, 20.0), strict=True):
            with h5py.File(folder / "analysis.h5") as file:
                # Divided by the square of the amplitude, energies of three amplitudes fit on one scale.
                expected = file[name][...].T / amplitude**2
            np.testing.assert_allclose(image.get_array(), expected, rtol=1e-12)
            largest = max(largest, expected.max())
        assert images[0].get_clim()[1] == pytest.approx(largest)

    case = Sweep.of(whole).case(0)
    cell = case.model().chain.cell
    for axes in panels[6:]:
        for branch in range(2):
            kappa, frequency = axes.lines[branch].get_data()
            # The dashed branches are those of the linear lattice.
            assert axes.lines[branch].is_dashed()
            np.testing.assert_allclose(1e3 * frequency, bloch(cell, np.pi * kappa).frequency[:, branch])

    for axes in panels[:3]:
        marks = next(line for line in axes.lines if line.get_marker() == ">")
        assert list(marks.get_ydata()) == case.contacts.sites


@pytest.mark.slow
def test_wavelets_mark_the_driven_wavenumber_at_the_same_times(whole):
    """Panels show the transform of the host's velocity over the amplitude, at four times for three amplitudes."""
    figure = only("wavelets", [whole])
    panels = np.reshape([axes for axes in figure.axes if axes.images], (4, 3))
    assert len(limits([axes.images[0] for axes in panels.flat])) == 1

    for axes in panels.flat:
        black = next(line for line in axes.lines if to_rgba(line.get_color()) == (0, 0, 0, 1))
        # The wavenumber is in units of pi per cell.
        np.testing.assert_allclose(black.get_ydata(), 5 / 9, rtol=1e-9)
    for row in panels:
        assert len({axes.texts[0].get_text() for axes in row}) == 1

    (series,) = series_of(Sweeps([whole], Files()))
    times = series.snapshot_times()
    assert np.all(np.diff(times) > 0)

    with open_run(members(whole)[2] / "run.h5") as run:
        site = np.min(run["sites/cell"].values)
        wave = DrivenWave.of(Case.of(run))
        # The second snapshot is taken when the packet is halfway to the first site.
        assert times[1] - times[0] == pytest.approx(0.5 * (site - 1) / wave.speed)
        snapshot = int(np.argmin(np.abs(field_time(run) - times[1])))
        # The diatomic cell's first mass is the host.
        host = run["velocity"][snapshot, :, 0].values
    kappa = np.pi * np.arange(1, 121) / 120
    expected = np.abs(transform(host, kappa, KC)[:, :CELLS]) / 20.0
    np.testing.assert_allclose(panels[1, 2].images[0].get_array(), expected, rtol=1e-12)


@pytest.mark.slow
def test_partition_shows_seven_bins_and_all_colours(whole):
    figure = only("partition", [whole])
    with h5py.File(members(whole)[1] / "analysis.h5") as file:
        field = file["partition/kinetic_energy"][...]

    bins = shown_bins(5 * np.pi / 9, 12)
    images = maps(figure)[:7]
    assert len(limits(images)) == 1
    assert images[0].get_clim()[1] == pytest.approx(field[bins].max())
    for b, image in zip(bins, images, strict=True):
        assert image.axes.get_title(loc="left").endswith(f"$K_{{{b + 1}}}$")
        np.testing.assert_array_equal(image.get_array(), field[b].T)

    (band,) = [axes for axes in figure.axes if "Band 2" in axes.get_title(loc="left")]
    # Thick lines are the bins, in the colours of their panels.
    segments = [line for line in band.lines if line.get_linewidth() == 3]
    for line, colour in zip(segments, bin_colours(12), strict=True):
        np.testing.assert_allclose(to_rgba(line.get_color()), colour)
        kappa, frequency = line.get_data()
        expected = bloch(Sweep.of(whole).case(0).model().chain.cell, np.pi * kappa).frequency[:, 1]
        np.testing.assert_allclose(1e3 * frequency, expected)

    panels = [axes for axes in figure.axes if axes.get_title(loc="left").startswith("(b.")]
    assert len(panels) == 3
    assert all(axes.collections for axes in panels)


@pytest.mark.slow
def test_a_partition_into_one_bin_is_drawn(whole):
    """A partition into one bin has one map, of all the energy, and no panels of other bins."""
    with Files() as files:
        (series,) = series_of(Sweeps([whole], files), FIELD)
        runs = []
        for member in series.runs:
            field = member.analysis[FIELD]
            bins = field.dims[0]
            bounds = member.analysis["partition/bounds"][[0, -1]]
            others = member.analysis.drop_dims([bins, *bounds.dims])
            one_bin = {FIELD: field.sum(bins).expand_dims(bins), "partition/bounds": bounds}
            runs.append(member._replace(analysis=others.assign(one_bin)))
        with rc_style():
            figure = partition.__wrapped__(series._replace(runs=tuple(runs)))

        (image, *_) = maps(figure)
        np.testing.assert_array_equal(image.get_array(), runs[1].analysis[FIELD].values[0].T)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert [title for title in titles if title.startswith("(a.")] == ["(a.i) $K_{1}$"]


@pytest.mark.slow
def test_explained_inverse_is_the_filter_banks(whole):
    (drawing,) = FIGURES["partition_explained"].function(Sweeps([whole], Files()))
    # The figure shows one amplitude, and its caption must not name the others.
    assert [member.name for member in drawing.shown] == ["2 N"]
    figure = drawing.draw()
    titled = [(axes.get_title(loc="left"), axes) for axes in figure.axes]
    snapshot = next(axes for title, axes in titled if title.startswith("(a)")).lines[0].get_ydata()
    parts = filter_bank(CELLS).split(np.array(snapshot))

    # The shortest waves are at the top.
    bins = reversed(shown_bins(5 * np.pi / 9, 12, 4))
    for numeral, b in zip(("i", "ii", "iii", "iv"), bins, strict=True):
        title, trace = next(pair for pair in titled if pair[0].endswith(f"(m/s) of $K_{{{b + 1}}}$"))
        assert f"(c.{numeral})" in title
        np.testing.assert_allclose(trace.lines[0].get_ydata(), parts[b], atol=1e-10 * np.abs(snapshot).max())


@pytest.mark.slow
def test_bins_of_another_number_are_not_explained_with_those_of_this_program(whole):
    """An analysis with another number of bins than this program's is refused, as the traces would be of other bins."""
    with Files() as files:
        (series,) = series_of(Sweeps([whole], files), FIELD)
        fewer = [
            run._replace(analysis=run.analysis.isel({run.analysis[FIELD].dims[0]: slice(3)})) for run in series.runs
        ]
        with rc_style(), pytest.raises(ValueError, match="the analysis has 3 wavenumber bins, not 12"):
            partition_explained.__wrapped__(series._replace(runs=tuple(fewer)))


@pytest.mark.slow
@pytest.mark.parametrize("band", [0, 2])
def test_the_driven_wavenumber_is_marked_if_there_is_one(whole, band):
    """The driven wavenumber is marked in each column; a drive in a gap has no wavenumber and no mark."""
    with Files() as files:
        (series,) = series_of(Sweeps([whole], files), *ROWS)
        wave = series.wave
        if band == 0:
            wave = DrivenWave(band=0, wavenumber=np.nan, speed=np.nan)
        with rc_style():
            figure = amplitudes.__wrapped__(series._replace(wave=wave))
    # Contact sites have marks of the same colour, with a label.
    lines = [line for axes in figure.axes for line in axes.lines]
    marks = [line for line in lines if line.get_color() == SKY and line.get_label() != "contact sites"]
    assert len(marks) == (3 if band else 0)


@pytest.mark.parametrize(("swept", "shown"), [([0.0, 1.0, 2.0, 4.0, 8.0], [1.0, 4.0, 8.0]), ([0.0, 1.0, 2.0], [])])
def test_a_member_without_a_drive_is_none_of_the_three_amplitudes(monkeypatch, swept, shown):
    """A member with amplitude 0 is none of the three shown, as energies are divided by the amplitude's square."""
    monkeypatch.setattr(sweep_members, "axes", lambda _: ("amplitude",))
    rows = [xr.Dataset(coords={"amplitude": amplitude}) for amplitude in swept]
    monkeypatch.setattr(sweep_members, "whole_members", lambda _: [(row, Path()) for row in rows])

    triples = sweep_members._triples(xr.Dataset())
    assert [member.row["amplitude"].item() for triple in triples for member in triple] == shown


@pytest.mark.slow
def test_reconstruction_shows_energies_error_and_cross_terms(whole):
    figure = only("reconstruction", [whole])
    grid = np.reshape(figure.axes, (3, 3))
    for column, (folder, amplitude) in enumerate(zip(members(whole), (0.1, 2.0, 20.0), strict=True)):
        with h5py.File(folder / "analysis.h5") as file:
            measured = {name: data[...] for name, data in file["partition"].items()}
        energy, error, cross = grid[:, column]
        of_parts = measured["energy"].sum(0)

        expected = (measured["kinetic"], measured["reconstructed"], of_parts)
        for line, values in zip(energy.lines, expected, strict=True):
            np.testing.assert_allclose(line.get_ydata() * amplitude**2, values, rtol=1e-12)

        # The second line is the paper's claim C6, an error of at most one per cent.
        moving = measured["error"] > 0
        np.testing.assert_array_equal(error.lines[0].get_ydata()[moving], measured["error"][moving])
        assert list(error.lines[1].get_ydata()) == [0.01, 0.01]
        np.testing.assert_array_equal(cross.lines[0].get_ydata(), measured["cross_share"])

        # The cross terms are the part of the energy that the parts' energies miss, checked where the energy is large.
        late = measured["kinetic"] > 0.5 * measured["kinetic"].max()
        missing = 1 - of_parts[late] / measured["kinetic"][late]
        np.testing.assert_allclose(cross.lines[0].get_ydata()[late], missing, rtol=1e-9)


CALIBRATED = {"reading": "calibrated", "wavenumber": 5 * np.pi / 9}


@pytest.mark.slow
@pytest.mark.parametrize("average", AVERAGES)
@pytest.mark.parametrize(("column", "sites"), [(0, 2), (1, 3)])
def test_entropy_curves_and_error_bars_are_the_ensembles(curves, entropy_figures, average, column, sites):
    """Curves are the ensemble's, normalised to [0.01, 1] with their error bars; the other reading is grey."""
    grid = np.reshape(entropy_figures[f"calibrated-5pi-9-{average}"].axes, (2, 2))
    upper, lower = grid[:, column]
    assert (upper.get_yscale(), lower.get_xscale(), lower.get_yscale()) == ("linear", "log", "log")
    assert upper.get_title(loc="left").endswith(f".i) {sites} sites")

    row = select(curves, sites=sites, **CALIBRATED)
    raw = row[f"entropy/{average}"].values
    error = row["entropy/error"].values
    for axes in (upper, lower):
        (bars,) = axes.containers
        line, _, (sticks,) = bars.lines
        np.testing.assert_allclose(line.get_xdata(), curves["amplitude"].values)
        np.testing.assert_allclose(line.get_ydata(), normalised(raw))
        assert to_rgba(line.get_color()) == to_rgba(house.CURVES[f"entropy/{average}"]["color"])
        # A bar extends by the error in either direction.
        halves = [0.5 * np.ptp(segment[:, 1]) for segment in sticks.get_segments()]
        np.testing.assert_allclose(halves, 0.99 * error / np.ptp(raw))

    printed = select(curves, sites=sites, **CALIBRATED | {"reading": "printed"})[f"entropy/{average}"].values
    grey = [line for line in lower.lines if line.get_color() == GREY]
    np.testing.assert_allclose(grey[0].get_ydata(), normalised(printed))

    faint = {line.get_color() for line in upper.lines if line.get_alpha() == 0.5}
    assert faint == {house.CURVES[f"entropy/{name}"]["color"] for name in AVERAGES if name != average}


@pytest.mark.slow
@pytest.mark.parametrize("average", AVERAGES)
@pytest.mark.parametrize(("column", "sites"), [(0, 2), (1, 3)])
def test_entropy_fits_are_the_ensembles(curves, entropy_figures, average, column, sites):
    """A power law is drawn from the peak on with both adjusted R^2, or a sentence says why there is none."""
    lower = np.reshape(entropy_figures[f"calibrated-5pi-9-{average}"].axes, (2, 2))[1, column]
    row = select(curves, sites=sites, **CALIBRATED)
    names = ("factor", "exponent", "peak_amplitude", "points", "r2_log_log", "r2_nonlinear")
    fit = {name: row[f"normalised_fits/entropy/{average}/{name}"].item() for name in names}
    thick = [line for line in lower.lines if line.get_linewidth() == 2]
    text = lower.texts[0].get_text()

    if fit["points"] >= 4 and fit["r2_log_log"] >= 0:
        x, y = thick[0].get_data()
        assert x[0] == pytest.approx(fit["peak_amplitude"])
        assert len(x) == fit["points"]
        np.testing.assert_allclose(y, fit["factor"] * x ** fit["exponent"])
        assert f"{fit['r2_log_log']:.3f} ({fit['r2_nonlinear']:.3f})" in text
    else:
        assert not thick
        assert text.startswith(("no power law:\ntoo few points (", "no power law:\nadjusted R² -"))


def test_some_configuration_has_a_power_law(curves):
    # The test of the fits sees at least one power law.
    assert np.isfinite(curves["normalised_fits/entropy/energy_weighted/factor"]).any()


@pytest.mark.slow
def test_all_panels_by_wavenumber_and_configuration(curves):
    """A figure of one reading and one average has a row for each wavenumber and a column for each configuration."""
    offered = offered_drawings("entropy_all", [curves])
    assert len(offered) == 2 * len(AVERAGES)

    grid = np.reshape(offered["printed-masked"].draw().axes, (2, 2))
    assert [axes.get_ylabel() for axes in grid[:, 0]] == ["κ* = 4π/9", "κ* = 5π/9"]

    for row, wavenumber in enumerate(curves["wavenumber"].values):
        for column, sites in enumerate((2, 3)):
            chosen = select(curves, reading="printed", wavenumber=wavenumber, sites=sites)
            line = grid[row, column].containers[0].lines[0]
            np.testing.assert_allclose(line.get_ydata(), normalised(chosen["entropy/masked"].values))


@pytest.mark.slow
def test_entropy_maps_leave_quiet_cells_blank(whole):
    figure = only("entropy_maps", [whole])
    images = maps(figure)
    assert len(limits(images)) == 1

    overs = [axes for axes in figure.axes if any(line.get_label() == "H(t)" for line in axes.lines)]
    for image, over, folder in zip(images, overs, members(whole), strict=True):
        with h5py.File(folder / "analysis.h5") as file:
            local = file["entropy/local"][...].T
            weight = file["entropy/weight"][...].T
            history = file["entropy/history"][...]
            start = file["entropy"].attrs["start"]

        shown = np.ma.filled(image.get_array(), np.nan)
        above_threshold = weight > LEAST_WEIGHT * weight.max()
        np.testing.assert_array_equal(shown[above_threshold], local[above_threshold])
        assert np.isnan(shown[~above_threshold]).all()
        # Some cells are quiet.
        assert (~above_threshold).any()

        lines = {line.get_label(): line for line in over.lines}
        np.testing.assert_array_equal(lines["H(t)"].get_ydata(), history)
        assert list(lines["averages begin"].get_xdata()) == [start, start]
        assert over.get_ylim() == pytest.approx(image.get_clim())


@pytest.mark.slow
def test_entropy_history_is_an_image_over_amplitude(curves):
    figure = offered_drawings("entropy_history", [curves])["calibrated-5pi-9"].draw()
    for axes, sites in zip(figure.axes, (2, 3), strict=False):
        mesh = axes.collections[0]
        fixed = {"reading": "calibrated", "wavenumber": 5 * np.pi / 9, "sites": sites}
        row = select(curves, **fixed)
        expected = row["entropy/history"].values
        np.testing.assert_array_equal(np.reshape(mesh.get_array(), expected.shape), expected)
        # A PDF with vectors would have a polygon for each cell of the mesh.
        assert mesh.get_rasterized()

        # The onset by the linear wave lies below the first amplitude with contact.
        touched = curves["amplitude"].values[row["contact_episodes"].values > 0].min()
        onset = next(line for line in axes.lines if line.get_linestyle() == ":")
        assert 0.1 < onset.get_ydata()[0] < touched
