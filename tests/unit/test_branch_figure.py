"""Figures of branches: curves through points and tangents, kinds of branches, axes, rows, and what is left out."""

from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case.nnm import NnmCase
from vipetsc.figures import branch_curves, nfrc, registry, response_family, response_outputs, style
from vipetsc.figures.frequency_energy import slope
from vipetsc.io import branch_kinds
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


@pytest.mark.parametrize("change", [1e-14, 1e-8])
def test_the_slope_of_a_linear_motion_is_not_drawn(change):
    """It is the rounding of the period: a sentence takes its place."""
    energy = np.geomspace(1e-7, 1e-4, 8)
    columns = {
        "energy": energy,
        "frequency": np.full(8, 90.0),
        "slope": 90 * change / energy * np.resize([1.0, -0.5], 8),
        "kind": np.full(8, "regular"),
        "contacts": np.zeros(8),
        "region": np.ones(8),
    }
    axes = Figure().subplots()
    slope(axes, xr.Dataset({name: ("point", values) for name, values in columns.items()}))
    assert bool(axes.lines) == (change > 1e-12)
    said = ["the frequency does not change with the energy"] * (not axes.lines)
    assert [text.get_text() for text in axes.texts] == said


def test_every_kind_of_branch_has_a_figure_and_no_two_figures_one_name():
    assert set(registry.BRANCH_FIGURES) == set(branch_kinds.BRANCH_KINDS)
    assert len(registry.FIGURES) == len(registry._SPECS)


def crosses_of(axes: Axes) -> list[float]:
    """Return amplitudes 0.5, 0.9 and 1.2 at which a panel has crosses, as 0, 1 and 2."""
    crossed = [line.get_xdata() for line in axes.lines if line.get_marker() == "x"]
    return np.searchsorted([0.5, 0.9, 1.2], np.concatenate([[], *crossed])).tolist()


@pytest.mark.parametrize("unstable", [[0, 2, 0], [0, -1, 2], [-1, -1, -1]])
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
    if draw is nfrc._draw_energies:
        # Its lines are told apart in grey by their dashes.
        assert axes.get_legend().handlelength == style.DASHES_SEEN
    (broad,) = [line for line in axes.lines if line.get_linewidth() > 1 and line.get_marker() == "None"]
    assert np.isfinite(broad.get_ydata()).tolist() == [count == 0 for count in unstable]
    thin = [line for line in axes.lines if line.get_linewidth() <= 0.6 and line.get_alpha() is None]
    assert np.isfinite(thin[0].get_ydata()).all()
    if axes.get_legend():
        names = [text.get_text() for text in axes.get_legend().get_texts()]
        assert names.count("undecided") == (min(unstable) < 0)


def put_condensed_branch(path: Path, points: int, places: int = 1) -> None:
    """Write a condensed branch as it stands before its end: without motions."""
    case = NnmCase.load(EXAMPLES / "breather.toml")
    branch = branch_of(energy=[1.0, 2.0, 3.0], frequency=[1.0, 2.0, 3.0], multiplier_max=[1.0, 2.0, 3.0])
    branch["kind"] = xr.Variable("point", np.zeros(3, np.int8), {"flag_meanings": "regular fold-energy"})
    branch["elongation"] = (("point", "pair"), np.ones((3, places)))
    branch["harmonics"] = (("point", "pair"), np.ones((3, places)))
    branch = branch.assign_coords(point=[0, 1, 2], pair=np.arange(places) + 1)
    branch.attrs = {"branch_kind": branch_kinds.BALANCE, "case": case.to_toml(), "name": "breather"}
    write_netcdf(path, branch.isel(point=slice(points)))


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
