"""Figures of inter-band transfer show the values in a sweep's files, and are left out where files are missing."""

from __future__ import annotations

from mpi4py import MPI

import h5py
import matplotlib.figure
import numpy as np
import pytest
from scipy.integrate import trapezoid

from tests.hertz_branch import GRAZING, write_branch
from vipetsc.case import Sweep
from vipetsc.figures import transfer_curves
from vipetsc.figures.panels import block_means
from vipetsc.figures.registry import FIGURES
from vipetsc.figures.style import rc_style
from vipetsc.figures.sweep_members import Files, MemberRun, Sweeps
from vipetsc.figures.transfer import closing_error
from vipetsc.io.read import curves, member_folder, open_ensemble, open_run, select, whole_members
from vipetsc.paper.paper_figures import PAGES
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


@pytest.fixture(scope="module")
def transfer_pictures(whole):
    """The figures of both members' fields, drawn once, since drawing takes longer than all checks of them."""
    return offered_figures("transfer", whole)


def contact_motion(folder):
    """The motion of the contact cell's two masses, as phase portraits show it."""
    with MemberRun.open(folder) as member:
        return transfer_curves.ContactMotion.of(member)


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


def test_floor_is_that_of_members_without_contact(reduced):
    found = list(transfer_curves.transfer_curves([open_ensemble(reduced)]))
    assert [c.case.contacts.law for c in found] == ["hertz", "bilinear"]

    for curve in found:
        transfer = curve.data["ibtet"].values
        peak = curve.data["peak"]
        assert curve.data["floor"] == pytest.approx(transfer[0], rel=1e-9)
        assert peak == int(np.argmax(transfer))
        assert peak > 1


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

    _, number = next(curves(open_ensemble(reduced)))
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


def test_transfer_has_a_panel_a_band_and_both_segments(whole, transfer_pictures):
    assert list(transfer_pictures) == [f"hertz-calibrated-1-site-4-cycles-{a}N" for a in (1, 60)]

    figure = transfer_pictures["hertz-calibrated-1-site-4-cycles-60N"]
    # Matplotlib before 3.8 has no public access to a figure's title.
    heading = figure.get_suptitle() if hasattr(figure, "get_suptitle") else figure._suptitle.get_text()
    assert heading == "Hertz, calibrated, 1 site, 4 cycles, 60 N"

    titles = [a.get_title(loc="left") for a in all_axes(figure) if a.get_title(loc="left")]
    assert [t.split()[0] for t in titles] == [f"({x})" for x in "abcdefghi"]
    assert [t[4:] for t in titles[1:5]] == ["Band 1", "Band 2", "Band 3", "Band 4"]
    assert titles[7:] == ["(h) Velocity spectra, cell 5", "(i) Velocity spectra, cell 10"]

    # The whole and its parts have one scale of colours.
    (norm,) = {id(a.images[0].norm) for a in all_axes(figure) if a.get_title(loc="left")[:3] in ("(a)", "(b)", "(e)")}
    assert norm

    with h5py.File(member_folder(open_ensemble(whole).isel(law=0, amplitude=1)) / "analysis.h5") as file:
        for band, tag in enumerate("bcde"):
            shown = panel(figure, f"({tag})").images[0]
            np.testing.assert_allclose(shown.get_array(), block_means(file["bands/kinetic_energy"][band].T), rtol=1e-6)
        assert shown.get_extent()[1] == pytest.approx(file["bands/sample"][-1], rel=0.02)


def test_band_energies_sum_to_the_total(whole):
    """Energies of the parts sum to the total over the whole record, in which parts are orthogonal.

    Running means differ from the total by cross terms.
    """
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


def test_regimes_show_the_motion_of_the_contact_cell(whole, reduced):
    """The figure has two points on the curve of transfer, and for each the phase portrait of host and resonator."""
    (figure,) = offered_figures("phase_regimes", whole, reduced).values()
    curve, first, second = (a for a in all_axes(figure) if a.get_title(loc="left"))
    grey = curve.lines[0].get_xydata().T
    np.testing.assert_array_equal(grey[1], select(open_ensemble(reduced), law="hertz")["ibtet"])

    ensemble = open_ensemble(whole)
    points = np.array([line.get_xydata()[0] for line in curve.lines[1:]])
    np.testing.assert_array_equal(points[:, 0], ensemble["amplitude"])
    np.testing.assert_array_equal(points[:, 1], ensemble["ibtet"].values.ravel())

    folder = member_folder(ensemble.isel(law=0, amplitude=1))
    motion = contact_motion(folder)
    with open_run(folder / "run.h5") as run:
        u = run["displacement"].sel(cell=run["sites/cell"].values[0]).values
        w = u[:, 2] - u[:, 1]
        clearance = run["sites/clearance"].values[0]

    assert [a.get_title(loc="left") for a in (first, second)] == ["(b.1) 1 N", "(b.2) 60 N"]

    shown = np.diff(motion.displacement, axis=1)
    assert np.abs(shown).max() >= np.abs(w).max() > clearance

    resonator, host = (line.get_xydata().T for line in second.lines)
    np.testing.assert_array_equal(resonator[0], 1e3 * motion.displacement[:, 1])
    np.testing.assert_array_equal(host[1], motion.velocity[:, 0])
