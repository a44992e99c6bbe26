"""Figures of wavenumber scattering show the values in two small sweeps, one with full fields and one of curves."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from matplotlib.colors import to_rgba

from vipetsc.case import Case, Sweep
from vipetsc.figures import style as house
from vipetsc.figures.registry import FIGURES
from vipetsc.figures.scattering import KC
from vipetsc.figures.style import GREY, rc_style
from vipetsc.figures.sweep_members import DrivenWave, Files, Sweeps, series_of
from vipetsc.figures.wavenumber_bins import bin_colours, shown_bins
from vipetsc.io.read import field_time, open_ensemble, open_run, select, whole_members
from vipetsc.lattice import bloch
from vipetsc.paper.entropy_pages import AVERAGES
from vipetsc.paper.paper_figures import PAGES
from vipetsc.spectra import normalised, transform
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


@pytest.mark.parametrize("average", AVERAGES)
@pytest.mark.parametrize(("column", "sites"), [(1, 3)])
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
