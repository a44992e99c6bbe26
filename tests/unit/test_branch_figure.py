"""Figures of branches: curves through points and tangents, kinds of branches, axes, rows, and what is left out."""

import errno
from functools import partial
from pathlib import Path
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.nnm import NnmCase
from vipetsc.cli.drawing import draw_pictures
from vipetsc.cli.verbs.branch_verbs import PICTURES, parameter_unit
from vipetsc.figures import branch_curves, nfrc, registry, response_family, response_outputs, style
from vipetsc.figures.series import SPACING, Series
from vipetsc.figures.style import LeftOut, NoPicture
from vipetsc.io import branch_kinds
from vipetsc.io.kinds import BRANCHES
from vipetsc.io.netcdf import open_netcdf, write_netcdf
from vipetsc.modes.branches.files import stored_states

EXAMPLES = Path(__file__).parents[2] / "vipetsc" / "examples"


def branch_of(**columns: np.ndarray | list) -> xr.Dataset:
    """Return a branch with these values (point,)."""
    branch = xr.Dataset({name: ("point", values) for name, values in columns.items()})
    if "multiplier_max" in branch:
        branch["multiplier_max"].attrs["unstable_beyond"] = 1.5
    if "kind" in branch:
        branch["kind"].attrs["flag_meanings"] = "regular"
    return branch


def test_a_branch_is_drawn_through_its_points_along_its_tangents():
    """Points lie on a circle in logarithms, 40 degrees apart: a cubic stays within 3e-4 of its radius, 0.1."""
    angle = np.radians(np.arange(0, 330, 40.0))
    frequency = 100 * np.exp(0.1 * np.sin(angle))
    energy = np.exp(0.1 * np.cos(angle))
    frequency_rate = 0.1 * np.cos(angle) * frequency
    energy_rate = -0.1 * np.sin(angle) * energy
    # The slope is infinite where the energy turns.
    with np.errstate(divide="ignore"):
        slope = frequency_rate / energy_rate
    branch = branch_of(
        energy=energy,
        frequency=frequency,
        slope=slope,
        tangent_period=-frequency_rate / frequency**2,
        kind=np.full(len(angle), "regular"),
    )

    fine_energy, fine_frequency = branch_curves.smooth(branch)

    assert np.allclose(fine_energy[:: branch_curves.FINE], energy)
    assert np.allclose(fine_frequency[:: branch_curves.FINE], frequency)
    radius = np.hypot(np.log(fine_energy), np.log(fine_frequency / 100))
    # Straight lines between the points would be off by 6e-3.
    assert np.abs(radius - 0.1).max() < 3e-4


def test_an_unstable_part_is_drawn_from_its_first_point_to_its_last():
    """The curve has several points for each step; those of the part's last step go to the end of the step."""
    energy = np.geomspace(1.0, 2.0, 8)
    # Beyond 1 and up to the file's threshold a point is stable.
    multiplier = np.where((np.arange(8) >= 3) & (np.arange(8) <= 5), 2.0, 1.4)
    branch = branch_of(
        energy=energy,
        frequency=energy**0.1,
        slope=0.1 * energy**-0.9,
        tangent_period=-0.1 * energy**-1.1,
        multiplier_max=multiplier,
        kind=np.full(8, "regular"),
    )
    axes = Figure().subplots()
    branch_curves.draw_branch(axes, branch)

    (unstable,) = [line for line in axes.lines if line.get_label() == "unstable"]
    drawn = unstable.get_xdata()[np.isfinite(unstable.get_ydata())]
    assert len(drawn) == 2 * branch_curves.FINE + 1
    np.testing.assert_allclose(drawn[[0, -1]], energy[[3, 5]])


@pytest.mark.parametrize("slope_at_grazing", [1e-9, 50.0])
def test_a_branch_keeps_a_corner_where_a_contact_grazes(slope_at_grazing):
    """A curve follows two lines that meet at a grazing point, where the tangent is that of one of them."""

    def exact(energy: np.ndarray) -> np.ndarray:
        return np.where(energy > 4, 100 * (energy / 4) ** 2, 100.0)

    energy = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    frequency = exact(energy)
    # Slopes are not zero, since the direction of a tangent is taken from their logarithm.
    slope = np.array([1e-12, 1e-12, slope_at_grazing, 2 * frequency[3] / 8.0, 2 * frequency[4] / 16.0])
    branch = branch_of(
        energy=energy,
        frequency=frequency,
        slope=slope,
        tangent_period=-slope / frequency**2,
        kind=["regular", "regular", "grazing", "regular", "regular"],
    )

    fine_energy, fine_frequency = branch_curves.smooth(branch)

    assert fine_frequency == pytest.approx(exact(fine_energy), rel=1e-9)


def test_of_states_with_one_energy_that_of_the_lowest_frequency_is_marked():
    """The state of the lowest frequency at its energy is marked.

    The branch returns from 4 J to 2 J at higher frequencies, where no state is marked, and goes on at lower ones.
    """
    branch = branch_of(energy=[1.0, 3.0, 4.0, 3.5, 2.0, 2.5, 5.0], frequency=[1.0, 3.0, 4.0, 5.0, 2.9, 1.0, 5.9])
    assert branch_curves.lowest(branch).tolist() == [True, False, False, False, False, True, True]


def test_a_branch_file_names_its_kind():
    """The kind of a branch is the one that its file states; an unknown kind is one of a later version."""
    for kind in branch_kinds.BRANCH_KINDS:
        # The stated kind decides, although the variable ``share`` would stand for responses.
        branch = branch_of(share=[1.0]).assign_attrs(branch_kind=kind)
        assert branch_kinds.branch_kind(branch) == kind
    with pytest.raises(ValueError, match="later version"):
        branch_kinds.branch_kind(xr.Dataset(attrs={"branch_kind": "quasiperiodic"}))


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        (branch_kinds.RESPONSES, ("share", "harmonics")),
        (branch_kinds.CONDENSED, ("harmonics",)),
        (branch_kinds.ORBITS, ("orbits/number", "states/number")),
    ],
)
def test_an_older_branch_file_is_recognised_by_its_variables(kind, names):
    branch = branch_of(**{name: [1.0] for name in names})
    assert branch_kinds.branch_kind(branch) == kind


def test_every_kind_of_branch_has_a_figure_and_no_two_figures_one_name():
    assert set(registry.BRANCH_FIGURES) == set(branch_kinds.BRANCH_KINDS)
    assert len(registry.FIGURES) == len(registry._SPECS)


@pytest.mark.parametrize(
    ("options", "label"),
    [
        ({"source": "wave"}, "amplitude of the wave / clearance"),
        ({"source": "force"}, "amplitude (N)"),
        ({"source": "wave", "over": "frequency", "range": [900.0, 1100.0], "fixed": [1.0]}, "frequency (rad/s)"),
    ],
)
def test_the_axis_of_a_response_names_what_drives_the_sites(options, label):
    """The label of the parameter's axis names the amplitude of a wave or a force, or the frequency, with its unit."""
    case = NfrcCase.from_table({"lattice": {"preset": "four-band"}, "contacts": {"sites": 1}, "nfrc": options})
    branch = xr.Dataset(attrs={"over": case.nfrc.over, "case": case.to_toml()})
    assert nfrc.parameter_label(branch) == label


@pytest.mark.parametrize(
    ("clearance", "unstable", "axis", "legend"),
    [
        (1e-3, [0, 0, 0], "largest |w| / clearance", ["stable"]),
        (1e-3, [0, 2, 0], "largest |w| / clearance", ["unstable", "stable"]),
        (0.0, [0, 2, -1], "largest |w| (mm)", ["unstable", "stable", "undecided"]),
        (0.0, [-1, -1, 0], "largest |w| (mm)", ["stable", "undecided"]),
    ],
)
def test_the_panel_of_displacements_is_named_by_them(clearance, unstable, axis, legend):
    """The axis is that of the displacement, and the legend names the states that the curve has."""
    branch = branch_of(amplitude=[0.5, 0.9, 1.2], unstable=unstable, kind=[0, 0, 0])
    branch["largest"] = (("point", "site"), [[5e-4], [9e-4], [1.1e-3]])
    branch["clearance"] = ("site", [clearance])
    branch["up_point"] = ("up", [0, 1, 2])
    branch["down_point"] = ("down", [2, 1, 0])
    branch.attrs["over"] = "amplitude"
    axes = Figure().subplots()
    nfrc._draw_displacement(axes, branch)
    assert axes.get_ylabel() == axis
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["sweep up", "sweep down", *legend]
    assert crosses_of(axes) == [i for i in range(3) if unstable[i] < 0]


def crosses_of(axes: Axes) -> list[float]:
    """Return amplitudes 0.5, 0.9 and 1.2 at which a panel has crosses, as 0, 1 and 2."""
    crossed = [line.get_xdata() for line in axes.lines if line.get_marker() == "x"]
    return np.searchsorted([0.5, 0.9, 1.2], np.concatenate([[], *crossed])).tolist()


@pytest.mark.parametrize("unstable", [[0, 0, 0], [0, 2, 0], [0, -1, 2], [-1, 0, -1], [-1, -1, -1]])
@pytest.mark.parametrize(
    "draw",
    [
        nfrc._draw_phase,
        nfrc._draw_energies,
        partial(response_outputs._draw_amplitude, quantity="displacement"),
        response_outputs._draw_lag,
        response_outputs._draw_forces,
        lambda axes, branch: response_family._draw_curve(axes, branch, np.arange(3.0), "curve", "black"),
    ],
    ids=["phase", "energies", "amplitude", "lag", "forces", "family"],
)
def test_undecided_states_look_the_same_in_all_panels_of_responses(draw, unstable):
    """Every panel has a broad line at stable states, a thin one through all, and crosses at the undecided ones."""
    branch = branch_of(amplitude=[0.5, 0.9, 1.2], unstable=unstable, kind=[0, 0, 0])
    branch["harmonics"] = (("point", "site", "harmonic"), np.ones((3, 1, 2)))
    branch["harmonics_imaginary"] = branch["harmonics"]
    branch["share"] = (("point", "way"), [[0.6], [0.5], [0.4]])
    for name in ("lag", "peak_displacement", "first_displacement"):
        branch[name] = (("point", "location"), [[1.0], [2.0], [3.0]])
    branch["largest_force"] = (("point", "site"), [[1.0], [2.0], [3.0]])
    branch = branch.assign_coords(site=[1], way=["lost"], location=["mass"])
    branch.attrs["over"] = "amplitude"

    axes = Figure().subplots()
    draw(axes, branch)
    assert crosses_of(axes) == [i for i in range(3) if unstable[i] < 0]
    (broad,) = [line for line in axes.lines if line.get_linewidth() > 1 and line.get_marker() == "None"]
    assert np.isfinite(broad.get_ydata()).tolist() == [count == 0 for count in unstable]
    thin = [line for line in axes.lines if line.get_linewidth() <= 0.6 and line.get_alpha() is None]
    assert np.isfinite(thin[0].get_ydata()).all()
    if axes.get_legend():
        names = [text.get_text() for text in axes.get_legend().get_texts()]
        assert names.count("undecided") == (min(unstable) < 0)


def test_crosses_of_many_states_keep_apart_and_that_of_one_state_is_drawn():
    """Of a hundred states side by side few have crosses, at equal distances; a state alone has one."""
    unstable = np.full(103, -1)
    unstable[[0, 101]] = 0
    axes = Figure(figsize=(3.0, 3.0)).subplots()
    Series(np.arange(103.0), np.arange(103.0), {"color": "black"}, unstable=unstable).draw(axes)
    along, alone = [line for line in axes.lines if line.get_marker() == "x"]
    assert along.get_xdata().tolist() == list(range(1, 101))
    assert along.get_markevery() == SPACING
    assert alone.get_xdata().tolist() == [102]
    assert alone.get_markevery() is None


def test_fractions_that_are_rounding_have_no_panel():
    """Fractions of energy have no panel where all are NaN or rounding.

    This happens in a finite lattice that takes up no energy or whose contacts have no loss.
    """
    nothing = np.full((3, 4), np.nan)
    assert not nfrc.has_fractions(xr.Dataset({"share": (("point", "way"), nothing)}))
    for loss, is_shown in ((1e-15, False), (0.02, True)):
        lost = nothing.copy()
        lost[1:, 3] = loss
        assert nfrc.has_fractions(xr.Dataset({"share": (("point", "way"), lost)})) == is_shown


@pytest.mark.parametrize(
    ("variables", "rows"),
    [
        ([["lag"], ["largest_force"]], 0),
        ([["lag", "largest_force"], ["largest_force"]], 1),
        ([["lag", "largest_force"], ["lag"]], 4),
        ([["lag", "largest_force"], ["lag", "largest_force"]], 5),
    ],
)
def test_outputs_on_one_page_are_those_that_all_curves_have(monkeypatch, variables, rows):
    """Rows of a page are those for which all curves have the variables.

    The lag yields four rows, three amplitudes and a phase of masses, and the largest force yields one.
    """
    curves = [xr.Dataset(dict.fromkeys(names, 1.0)) for names in variables]
    monkeypatch.setattr(response_outputs, "responses_in", lambda paths: curves)
    monkeypatch.setattr(response_outputs, "response_page", lambda curves, drawn, height: len(drawn))
    if rows:
        assert response_outputs.response_outputs([]) == rows
    else:
        with pytest.raises(NoPicture, match="needs"):
            response_outputs.response_outputs([])


def put_condensed_branch(path: Path, points: int, places: int = 1) -> None:
    """Write a condensed branch as it stands before its end: without motions."""
    case = NnmCase.load(EXAMPLES / "breather.toml")
    branch = branch_of(energy=[1.0, 2.0, 3.0], frequency=[1.0, 2.0, 3.0], multiplier_max=[1.0, 2.0, 3.0])
    branch["kind"] = xr.Variable("point", np.zeros(3, np.int8), {"flag_meanings": "regular fold-energy"})
    branch["elongation"] = (("point", "place"), np.ones((3, places)))
    branch["harmonics"] = (("point", "place"), np.ones((3, places)))
    branch = branch.assign_coords(point=[0, 1, 2], place=np.arange(places) + 1)
    branch.attrs = {"branch_kind": branch_kinds.CONDENSED, "case": case.to_toml(), "name": "breather"}
    write_netcdf(path, branch.isel(point=slice(points)))


def test_a_condensed_branch_that_was_interrupted_is_drawn_without_motions(tmp_path):
    put_condensed_branch(tmp_path / "branch-begun.h5", 3)
    with style.rc_style():
        figure = registry.branch([tmp_path / "branch-begun.h5"])
    assert [text.get_text() for text in figure.axes[2].texts] == ["no motions stored"]


def test_every_contact_and_every_motion_of_a_condensed_branch_has_a_curve(tmp_path):
    """Seven contacts and seven motions, more than there are colours, have curves that all look different."""
    path = tmp_path / "branch-many.h5"
    put_condensed_branch(path, 3, places=7)
    with open_netcdf(path, "branch") as file:
        branch = file.load()
    path.unlink()
    points = [SimpleNamespace(energy=energy, period=1.0, index=0) for energy in np.linspace(1.0, 3.0, 7)]
    write_netcdf(path, branch.assign(stored_states(points, range(4), np.ones((7, 4, 1)))))

    with style.rc_style():
        figure = registry.branch([path])
    frequency, elongation, motions = figure.axes
    assert len([line for line in frequency.lines if line.get_marker() == "x"]) == 7
    for axes in (elongation, motions):
        assert len({(line.get_color(), line.get_linestyle()) for line in axes.lines}) == 7


def test_a_branch_without_points_is_no_file(tmp_path):
    """A branch without points is named in place of a picture."""
    put_condensed_branch(tmp_path / "branch-empty.h5", 0)
    alone = LeftOut()
    assert registry.draw(BRANCHES.source, [tmp_path], left_out=alone) == []
    assert not alone.drawn
    assert [*alone.reasons[registry.BRANCH]] == ["branch-empty"]
    put_condensed_branch(tmp_path / "branch-begun.h5", 3)
    both = LeftOut()
    assert [path.name for path in registry.draw(BRANCHES.source, [tmp_path], left_out=both)] == ["branch-begun.png"]
    assert [*both.reasons[registry.BRANCH]] == ["branch-empty"]
    assert both.drawn == {registry.BRANCH}


def test_a_full_disk_is_no_error_of_the_branch_that_is_drawn(tmp_path, monkeypatch):
    """A picture that cannot be written raises no ValueError, which would mean bad input: the branch can be read."""
    put_condensed_branch(tmp_path / "branch-begun.h5", 3)

    def fail(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(style, "_print", fail)
    with pytest.raises(OSError, match="No space left") as raised:
        draw_pictures(PICTURES, [tmp_path], MPI.COMM_WORLD)
    assert not isinstance(raised.value, ValueError)


@pytest.mark.parametrize(
    ("nfrc_section", "drive", "unit"),
    [
        ({"source": "wave"}, {}, "clearances"),
        ({"source": "force"}, {}, "N"),
        ({"source": "force"}, {"end": "left"}, "m"),
        ({"source": "force", "over": "frequency", "range": [400.0, 600.0], "fixed": [1e-4]}, {"end": "left"}, "rad/s"),
        ({"source": "force", "over": "contacts.clearance", "range": [1e-4, 2e-4], "fixed": [1e-4]}, {}, "mm"),
    ],
)
def test_printed_special_points_have_the_unit_of_the_parameter(nfrc_section, drive, unit):
    """Special points have the unit of the parameter.

    Amplitudes of a wave, a force and a moving wall are in clearances, N and m, frequencies in rad/s; the unit of any
    other key is an attribute of the curve.
    """
    table = {
        "lattice": {"preset": "four-band", "cells": 6},
        "contacts": {"sites": [3], "clearance": 1e-3},
        "drive": {"waveform": "harmonic", "frequency": 1000.0} | drive,
        "nfrc": nfrc_section,
    }
    curve = SimpleNamespace(about={"unit": "mm"})
    assert parameter_unit(NfrcCase.from_table(table), curve) == unit
