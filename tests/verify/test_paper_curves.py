"""Figures of transfer and of scattering show the values in files of sweeps."""

from __future__ import annotations

from mpi4py import MPI

import h5py
import matplotlib.figure
import numpy as np
import pytest
from matplotlib.colors import to_rgba
from scipy.integrate import trapezoid

from tests.hertz_branch import GRAZING, write_branch
from vipetsc.case import Sweep
from vipetsc.figures import style as house
from vipetsc.figures.registry import FIGURES
from vipetsc.figures.style import GREY, rc_style
from vipetsc.figures.sweep_members import Files, Sweeps
from vipetsc.figures.transfer import closing_error
from vipetsc.io.read import curves as curves_of
from vipetsc.io.read import open_ensemble, select, whole_members
from vipetsc.lattice import bloch
from vipetsc.paper.entropy_pages import AVERAGES
from vipetsc.paper.paper_figures import PAGES
from vipetsc.spectra import normalised
from vipetsc.studies.backbone import initiation_of, relate_folders
from vipetsc.studies.sweep import run_sweep

AMPLITUDES = [1.0, 2.0, 30.0, 60.0, 120.0, 240.0, 500.0]
TABLE = {
    "lattice": {"preset": "four-band", "reading": "calibrated", "cells": 20},
    "contacts": {"sites": 1},
    "drive": {"band": 2, "at": "max-group-velocity", "cycles": 4},
    "time": {"rtol": 1e-7},
    "sweep": {"measures": ["transfer"], "contacts": {"law": ["hertz", "bilinear"]}, "drive": {"amplitude": AMPLITUDES}},
}


def swept(folder, **options):
    """Run a sweep of 20 cells with one site in ``folder``, which is returned; ``options`` update the table [sweep]."""
    table = TABLE | {"sweep": TABLE["sweep"] | options}
    result = run_sweep(Sweep.from_table(table), folder, MPI.COMM_SELF)
    assert result.complete
    return folder


@pytest.fixture(scope="module")
def reduced(tmp_path_factory):
    """A sweep over both laws and seven amplitudes without fields, related to a branch of the Hertz law."""
    folder = swept(tmp_path_factory.mktemp("reduced"))

    # The branch's slope is a power law of exponent -1 in region III.
    branch = tmp_path_factory.mktemp("branch")
    write_branch(branch, largest=1e6, last_region=1e5)

    assert relate_folders([folder, branch]) == [folder / "backbone.h5"]
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a sweep with two Hertz members with full fields, one without contact and one with it."""
    table = {"contacts": {"law": ["hertz"]}, "drive": {"amplitude": [1.0, 60.0]}, "fields": True}
    return swept(tmp_path_factory.mktemp("whole"), **table)


def offered_figures(name, *folders):
    """The figures of ``name`` from ``folders``, by their suffixes."""
    with rc_style():
        sweeps = Sweeps(map(open_ensemble, folders), Files())
        found = {drawing.stem: drawing.draw() for drawing in (FIGURES | PAGES)[name].function(sweeps)}
    assert all(isinstance(f, matplotlib.figure.Figure) for f in found.values())
    return found


def lines(axes):
    """The points (2, point) of the lines of ``axes``, by their labels."""
    return {line.get_label(): line.get_xydata().T for line in axes.lines}


def all_axes(figure):
    """The axes of a figure that are not colour bars."""
    return [a for a in figure.axes if a.get_label() != "<colorbar>"]


def panel(figure, text):
    """The only axes of a figure whose title contains ``text``."""
    (found,) = [a for a in figure.axes if text in a.get_title(loc="left")]
    return found


def test_ibtet_shows_the_ensembles_values(reduced):
    (figure,) = offered_figures("ibtet", reduced).values()
    for law in ("hertz", "bilinear"):
        for row in ("i", "ii"):
            axes = panel(figure, f".{row}) {law.capitalize()}, calibrated")
            x, y = lines(axes)["1 site, 4 cycles"]
            np.testing.assert_array_equal(x, AMPLITUDES)
            np.testing.assert_array_equal(y, select(open_ensemble(reduced), law=law)["ibtet"])

    linear = panel(figure, "(a.i)")
    logarithmic = panel(figure, "(a.ii)")
    assert linear.get_xscale() == linear.get_yscale() == "linear"
    assert logarithmic.get_xscale() == logarithmic.get_yscale() == "log"


def test_shares_are_the_ensembles_and_sum_to_one(reduced):
    figures = offered_figures("band_energies-shares", reduced)
    assert list(figures) == ["calibrated-1-site-4-cycles"]

    (figure,) = figures.values()
    share = select(open_ensemble(reduced), law="bilinear")["bands/share"]
    names = share.attrs["parts"]
    shown = lines(panel(figure, "Bilinear"))

    for name, values in zip(names, share.values.T, strict=True):
        np.testing.assert_allclose(shown[name][1], values, rtol=0, atol=1e-299)
    np.testing.assert_allclose(shown["sum"][1], 1.0, rtol=1e-12)


def test_backbone_is_aligned_exactly(reduced):
    """Energies are aligned with the branch at grazing, and the figure shows slope over divisor and the power law."""
    figures = offered_figures("ibtet_backbone", reduced)
    # No branch of the bilinear law was given.
    assert list(figures) == ["calibrated-1-site-4-cycles"]

    (axes,) = all_axes(figures["calibrated-1-site-4-cycles"])
    assert "branch of the printed reading" in axes.get_title(loc="left")

    with h5py.File(reduced / "backbone.h5") as file:
        assert "bilinear" in file.attrs["left_out"]
        (group,) = file.values()
        fit = dict(group.attrs)

    _, number = next(curves_of(open_ensemble(reduced)))
    start = initiation_of(reduced, Sweep.load(reduced / "case.toml").case(number))
    curve = select(open_ensemble(reduced), law="hertz")
    work = curve["work"].values
    touched = curve["contact_episodes"] > 0
    np.testing.assert_array_equal(touched, np.array(AMPLITUDES) > start.amplitude)
    assert fit["initiation_energy"] == start.energy
    assert fit["onset_amplitude"] == start.amplitude
    # Work is proportional to the square of the amplitude until waves from the first contact reach the drive.
    assert start.energy / start.amplitude**2 == pytest.approx(work[0], rel=1e-6)

    shown = lines(axes)
    np.testing.assert_allclose(shown["lattice"][0], work * GRAZING / start.energy, rtol=1e-12)

    grey = shown["slope + floor"]
    floor = fit["floor"]
    assert np.all(grey[1][grey[0] <= GRAZING] == floor)

    moving = grey[0] > GRAZING
    np.testing.assert_allclose(grey[1][moving], 700.0 / grey[0][moving] / fit["divisor"] + floor, rtol=1e-12)

    red = shown["in region III"]
    (green,) = [xy for label, xy in shown.items() if "adj." in label]
    np.testing.assert_allclose(green[1], fit["factor"] * red[0] ** fit["exponent"], rtol=1e-12)

    # The residual of least squares in logarithms is orthogonal to a constant and to the logarithm of the energy.
    residual = np.log(red[1] / green[1])
    assert abs(residual.sum()) < 1e-9
    assert abs(residual @ np.log(red[0])) < 1e-8


def test_band_energies_sum_to_the_total(whole):
    """Energies of the parts sum to the total over the whole record, in which parts are orthogonal."""
    figures = offered_figures("band_energies", whole)
    assert list(figures) == [f"hertz-calibrated-1-site-4-cycles-{a}N" for a in (1, 60)]

    for _, folder in whole_members(open_ensemble(whole)):
        with h5py.File(folder / "analysis.h5") as file:
            energy = file["bands/energy"][...]
            total = file["bands/total"][...]
        assert trapezoid(energy.sum(axis=0)) == pytest.approx(trapezoid(total), rel=0.01)

    shown = lines(panel(figures["hertz-calibrated-1-site-4-cycles-60N"], "(a)"))
    parts = sum(y for label, (_, y) in shown.items() if label.startswith(("band", "gap", "above")))
    np.testing.assert_allclose(shown["sum of parts"][1], parts, rtol=1e-9)


def test_closing_error_is_exact_for_parts_in_quadrature():
    """The closing error of cos 3t + cos 5t is zero for means over a common period, 400 samples, and not for others."""
    t = 2 * np.pi * np.arange(4000) / 400
    parts = np.array([np.cos(3 * t) ** 2, np.cos(5 * t) ** 2])
    total = (np.cos(3 * t) + np.cos(5 * t)) ** 2

    assert np.nanmax(closing_error(parts, total, 400)) < 1e-12
    assert np.nanmax(closing_error(parts, total, 130)) > 0.1
    # The error is NaN where there is no energy to divide by.
    assert np.isnan(closing_error(parts, np.append(total[:-500], np.zeros(500)), 10)[-1])


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


def swept_entropies(table, tmp_path_factory):
    """The ensemble of a sweep of ``BASE`` updated by ``table``."""
    folder = tmp_path_factory.mktemp(table["name"])
    assert run_sweep(Sweep.from_table(BASE | table), folder).complete
    return open_ensemble(folder)


@pytest.fixture(scope="module")
def whole_entropies(tmp_path_factory):
    """The ensemble of three amplitudes with all fields: without contacts, with a few, and with many."""
    return swept_entropies(WHOLE, tmp_path_factory)


@pytest.fixture(scope="module")
def curves(tmp_path_factory):
    """The ensemble of both readings, two wavenumbers and two numbers of sites over five amplitudes."""
    return swept_entropies(CURVES, tmp_path_factory)


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


def limits(images):
    """The different colour limits of some images."""
    return {image.get_clim() for image in images}


def members(ensemble):
    """The folders of the members with fields, in the order of their amplitudes."""
    return [folder for _, folder in whole_members(ensemble)]


def test_amplitudes_have_common_scales_and_show_what_was_measured(whole_entropies):
    """Panels show energies divided by the square of the amplitude, each row on one scale, with branches and sites."""
    figure = only("amplitudes", [whole_entropies])
    assert figure._suptitle.get_text() == "Calibrated reading, 2 sites, κ* = 5π/9"

    panels = [axes for axes in figure.axes if axes.images and axes.get_title(loc="left")]
    assert len(panels) == 9

    for row, name in enumerate(("kinetic_energy", "wavenumber_content", "dispersion")):
        images = [axes.images[0] for axes in panels[3 * row : 3 * row + 3]]
        assert len(limits(images)) == 1

        # A row has one scale of colours, which ends at the row's largest value.
        largest = 0.0
        for image, folder, amplitude in zip(images, members(whole_entropies), (0.1, 2.0, 20.0), strict=True):
            with h5py.File(folder / "analysis.h5") as file:
                # Divided by the square of the amplitude, energies of three amplitudes fit on one scale.
                expected = file[name][...].T / amplitude**2
            np.testing.assert_allclose(image.get_array(), expected, rtol=1e-12)
            largest = max(largest, expected.max())
        assert images[0].get_clim()[1] == pytest.approx(largest)

    case = Sweep.of(whole_entropies).case(0)
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


def test_reconstruction_shows_energies_error_and_cross_terms(whole_entropies):
    figure = only("reconstruction", [whole_entropies])
    grid = np.reshape(figure.axes, (3, 3))
    for column, (folder, amplitude) in enumerate(zip(members(whole_entropies), (0.1, 2.0, 20.0), strict=True)):
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
