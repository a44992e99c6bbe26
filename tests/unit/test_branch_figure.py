"""The curve of a branch, and which of its states are at the bottom."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.nnm import NnmCase
from vipetsc.figures import frequency_energy, nfrc, registry, style
from vipetsc.io import branch_kinds
from vipetsc.io.netcdf import write_netcdf

RUNS = Path(__file__).parents[2] / "runs"


def test_a_branch_is_drawn_through_its_points_along_its_tangents_and_keeps_a_corner_where_a_contact_grazes():
    """Points of a circle in logarithms; a cubic between points 40 degrees apart stays within 3e-4 of a tenth of it."""
    angle = np.radians(np.arange(0, 330, 40.0))
    frequency, energy = 100 * np.exp(0.1 * np.sin(angle)), np.exp(0.1 * np.cos(angle))
    rate, energy_rate = 0.1 * np.cos(angle) * frequency, -0.1 * np.sin(angle) * energy
    with np.errstate(divide="ignore"):
        columns = {"tangent_period": -rate / frequency**2, "slope": rate / energy_rate}
    columns |= {"energy": energy, "frequency": frequency, "kind": np.full(len(angle), "regular")}
    branch = xr.Dataset({name: ("point", values) for name, values in columns.items()})
    fine_energy, fine_frequency = frequency_energy.smooth(branch)
    assert np.allclose(fine_energy[:: frequency_energy.FINE], energy) and np.allclose(
        fine_frequency[:: frequency_energy.FINE], frequency
    )
    assert np.abs(np.hypot(np.log(fine_energy), np.log(fine_frequency / 100)) - 0.1).max() < 3e-4  # a chord: 6e-3
    # Two straight lines that meet at a grazing point, whose tangent is that of either: no step leaves its line.
    level = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    frequency = np.where(level > 4, 100 * (level / 4) ** 2, 100.0)
    for at_grazing in (1e-9, 50.0):
        slope = np.where(level > 4, 2 * frequency / level, np.where(level < 4, 1e-12, at_grazing))
        columns = {"energy": level, "frequency": frequency, "slope": slope, "tangent_period": -slope / frequency**2}
        columns["kind"] = np.array(["regular", "regular", "grazing", "regular", "regular"])
        fine_energy, fine_frequency = frequency_energy.smooth(xr.Dataset({n: ("point", v) for n, v in columns.items()}))
        exact = np.where(fine_energy > 4, 100 * (fine_energy / 4) ** 2, 100.0)
        assert fine_frequency == pytest.approx(exact, rel=1e-9)


def test_of_states_with_one_energy_that_of_the_lowest_frequency_is_marked():
    """A branch that goes back from 4 J to 2 J at higher frequencies, and on at lower ones."""
    branch = xr.Dataset(
        {
            "energy": ("point", [1.0, 3.0, 4.0, 3.5, 2.0, 2.5, 5.0]),
            "frequency": ("point", [1.0, 3.0, 4.0, 5.0, 2.9, 1.0, 5.9]),
        }
    )
    assert frequency_energy.lowest(branch).tolist() == [True, False, False, False, False, True, True]


def test_a_branch_file_names_its_kind_and_an_older_one_is_recognised_by_its_variables():
    for kind in branch_kinds.BRANCH_KINDS:
        assert branch_kinds.branch_kind(xr.Dataset({"share": ("point", [1.0])}, attrs={"branch_kind": kind})) == kind
    with pytest.raises(ValueError, match="later version"):
        branch_kinds.branch_kind(xr.Dataset(attrs={"branch_kind": "quasiperiodic"}))
    older = {
        branch_kinds.RESPONSES: ("share", "harmonics"),
        branch_kinds.CONDENSED: ("harmonics",),
        branch_kinds.ORBITS: ("orbits/number", "states/number"),
    }
    for kind, names in older.items():
        assert branch_kinds.branch_kind(xr.Dataset({name: ("point", [1.0]) for name in names})) == kind


def test_every_kind_of_branch_has_a_figure_and_no_two_figures_one_name():
    assert set(registry.BRANCH_FIGURES) == set(branch_kinds.BRANCH_KINDS)
    assert len(registry.FIGURES) == len(registry._SPECS)


@pytest.mark.parametrize(
    ("options", "label"),
    [
        ({"source": "wave"}, "amplitude of the wave / clearance"),
        ({"source": "force"}, "amplitude [N]"),
        ({"source": "wave", "over": "frequency", "range": [900.0, 1100.0], "fixed": [1.0]}, "frequency [rad/s]"),
    ],
)
def test_the_axis_of_a_response_says_what_drives_the_sites(options, label):
    case = NfrcCase.from_table({"lattice": {"preset": "four-band"}, "contacts": {"sites": 1}, "nfrc": options})
    branch = xr.Dataset(attrs={"over": case.nfrc.over, "case": case.to_toml()})
    assert nfrc._parameter_label(branch) == label


def test_a_condensed_branch_that_was_interrupted_is_drawn_without_motions(tmp_path):
    case = NnmCase.load(RUNS / "breather.toml")
    points = {name: ("point", [1.0, 2.0, 3.0]) for name in ("energy", "frequency", "multiplier_max")}
    kind = xr.Variable("point", np.zeros(3, np.int8), {"flag_meanings": "regular fold-energy"})
    tables = {"elongation": (("point", "place"), np.ones((3, 1))), "harmonics": (("point", "place"), np.ones((3, 1)))}
    places = {"point": [0, 1, 2], "place": [1]}
    about = {"branch_kind": branch_kinds.CONDENSED, "case": case.to_toml(), "name": "breather"}
    for name, count in (("begun", 3), ("empty", 0)):
        branch = xr.Dataset(points | tables | {"kind": kind}, places, about).isel(point=slice(count))
        write_netcdf(tmp_path / f"branch-{name}.h5", branch)
    with style.rc_style():
        figure = registry.branch([tmp_path / "branch-begun.h5"])
        assert [text.get_text() for text in figure.axes[2].texts] == ["no motions stored"]
        (axes,) = registry.branch([tmp_path / "branch-empty.h5"]).axes
        assert [text.get_text() for text in axes.texts] == ["no point of the branch was found"]
