"""Files of branches: written and read back, opened by xarray, drawn, stopped and resumed to the same bits."""

from __future__ import annotations

import json
from pathlib import Path

from mpi4py import MPI

import h5py
import numpy as np
import pytest
import xarray as xr

from vipetsc.case.nnm import NnmCase
from vipetsc.endings import Ending
from vipetsc.figures.frequency_energy import backbone
from vipetsc.figures.registry import drawings
from vipetsc.figures.sweep_members import Files
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.branch_checks import sampled
from vipetsc.modes.branches.files import read_branch, write_branch
from vipetsc.modes.branches.follow import follow_all

NAME = "branch-out-of-phase"


@pytest.fixture(scope="module")
def branch(short_branch) -> Branch:
    """The short branch with its last orbit sampled, as ``follow_all`` makes it."""
    points = short_branch.points
    return Branch(
        name="out-of-phase",
        case="name = 'x'",
        dofs=2,
        points=points,
        next_step=0.1,
        ended=Ending.CLOSED.with_numbers(),
        findings=["a", "b"],
        extra=sampled(short_branch.problem, points[-1:]),
    )


def follow(folder: Path, listener=None, stop=None, resume=False, saves_all=False, **nnm) -> Branch:
    """Follow the out-of-phase branch of linear stops as a case asks for it; ``nnm`` updates its table [nnm].

    With ``saves_all`` the branch is written after every point, whatever the clock says.
    """
    folder.mkdir(exist_ok=True)
    table = {
        "name": "x",
        "lattice": {"preset": "four-band", "reading": "printed"},
        "contacts": {"law": "bilinear", "modulus": 1e8},
        "nnm": {"modes": [2], "chart": "auto"} | nnm,
    }
    case = NnmCase.from_table(table)
    with pytest.MonkeyPatch.context() as patch:
        if saves_all:
            patch.setattr("vipetsc.modes.branches.follow.SAVE_EVERY", 0.0)
        return follow_all(case, folder, MPI.COMM_SELF, resume=resume, listener=listener, stop=stop)[0]


def test_xarray_opens_a_branch(branch, tmp_path):
    """xarray finds units and named dimensions, and sampled orbits in a group of their own, which begin at rest."""
    write_branch(branch, tmp_path, {})
    path = tmp_path / f"{NAME}.h5"

    with xr.open_dataset(path, engine="h5netcdf") as data:
        assert data.frequency.attrs["units"] == "Hz"
        assert data.initial.dims == ("point", "dof")
        assert float(data.energy[0]) == branch.points[0].energy

    last = branch.points[-1]
    with xr.open_dataset(path, engine="h5netcdf", group="orbits") as orbits:
        assert np.array_equal(orbits.displacement[0, 0], last.x)
        assert np.all(orbits.velocity[0, 0] == 0)
        assert float(orbits.energy[0]) == last.energy
        assert int(orbits.number[0]) == last.index


def test_orbits_have_the_energies_that_are_asked_for(tmp_path):
    """A branch samples its orbits at the energies asked for: three orbits between its folds at 0.0264 and 0.02934 J."""
    branch = follow(tmp_path / "a", energy=[0.0, 0.05], orbits_at=[0.028, 0.0316, 9.0], locate=False)

    # The orbits asked for come after the orbits that every branch samples.
    energies = branch.extra["orbits/energy"].values[-4:]
    periods = branch.extra["orbits/period"].values[-4:]
    assert energies == pytest.approx([0.028] * 3 + [0.0316], rel=1e-12)
    assert len(set(periods)) == 4
    assert branch.missing == ["the branch has no orbit of 9 J"]


BOTH = {"direction": "both", "start_energy": 0.029, "energy": [0.01, 0.0295], "locate": False}


def test_both_directions_are_two_branches(tmp_path):
    """Each has files of its own, and both begin at one point; the picture joins them in the order of the curve."""
    whole = follow(tmp_path, **BOTH)
    down = read_branch(tmp_path / f"{NAME}-down.h5")
    assert whole.complete
    assert down.complete
    assert whole.points[0].energy == down.points[0].energy
    assert whole.points[1].energy > whole.points[0].energy
    assert down.points[-1].energy < 0.01 < down.points[-2].energy
    energies = [point.energy for point in [*reversed(down.points[1:]), *whole.points]]
    for name, expected in ((NAME, energies), (f"{NAME}-down", [point.energy for point in down.points])):
        drawn = backbone([tmp_path / f"{name}.h5"]).get_axes()[0]
        assert drawn.get_xlim() == (min(expected), max(expected))
        curve = max((line.get_xdata() for line in drawn.lines), key=len)
        distances = np.abs(np.subtract.outer(expected, curve) / curve)
        assert distances.min(axis=1).max() < 1e-12
        assert (np.diff(distances.argmin(axis=1)) > 0).all()

    # Warnings of the part towards smaller energies are those of the joined picture, too.
    with h5py.File(tmp_path / f"{NAME}-down.h5", "r+") as file:
        file.attrs["warnings"] = json.dumps(["a warning"])
    with Files() as files:
        labels = {one.stem: one.draw().get_label() for one in drawings("branches", [tmp_path], files, ["branch"])}
    assert set(labels) == {NAME, f"{NAME}-down"}
    assert all("a warning" in label for label in labels.values())
