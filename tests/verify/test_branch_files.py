"""Files of branches: written and read back, opened by xarray, drawn, stopped and resumed to the same bits."""

from __future__ import annotations

import csv
from dataclasses import fields, replace
from pathlib import Path

from mpi4py import MPI

import h5py
import numpy as np
import pytest
import xarray as xr

from vipetsc.case.nnm import NnmCase
from vipetsc.endings import Ending
from vipetsc.figures.frequency_energy import backbone
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.branch_checks import sampled
from vipetsc.modes.branches.files import read_branch, table, to_dataset, write_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.orbits import ShootingMethod
from vipetsc.modes.branches.regions import regions
from vipetsc.modes.problem import FlowError

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


def table_of(branch: Branch) -> str:
    """Return the CSV table of a branch as text."""
    return table(to_dataset(branch), branch.kind)


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
            patch.setattr("vipetsc.modes.branches.growth.SAVE_EVERY", 0.0)
        return follow_all(case, folder, MPI.COMM_SELF, resume=resume, listener=listener, stop=stop)[0]


@pytest.mark.slow
def test_a_branch_file_is_read_back(branch, tmp_path):
    """Every quantity of every point, the table and how the branch ended survive a file."""
    write_branch(branch, tmp_path, {"ranks": 1})
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{NAME}.csv", f"{NAME}.h5"]

    restored = read_branch(tmp_path / f"{NAME}.h5")

    for read, written in zip(restored.points, branch.points, strict=True):
        # The next step stands with the branch, not with each point.
        for name in {field.name for field in fields(written)} - {"next_step"}:
            same = np.array_equal(getattr(read, name), getattr(written, name), equal_nan=name != "kind")
            assert same, name
    assert restored.next_step == branch.next_step
    assert table_of(restored) == table_of(branch)
    assert restored.ended == branch.ended
    assert restored.complete
    assert restored.findings == ["a", "b"]


def test_the_table_of_a_branch_has_its_points(branch, tmp_path):
    """A row of the CSV file holds a point's energy, slope, contacts, region and kind, in columns of these names."""
    write_branch(branch, tmp_path, {"ranks": 1})

    with (tmp_path / f"{NAME}.csv").open() as file:
        rows = list(csv.DictReader(file))

    assert list(rows[0])[-6:] == ["half_trace", "multiplier_max", "slope", "contacts", "region", "kind"]
    assert [float(row["energy"]) for row in rows] == [point.energy for point in branch.points]
    assert [int(row["region"]) for row in rows] == regions(branch).tolist()
    # The first orbit is linear, with no slope: NaN differs from itself.
    for row, point in zip(rows[1:], branch.points[1:], strict=True):
        assert float(row["slope"]) == point.slope
        assert int(row["contacts"]) == point.episodes
        assert row["kind"] == point.kind


def test_files_from_before_kinds_were_named_are_read(branch, tmp_path):
    """A file without ``branch_kind``, which earlier versions left, is read as a branch of orbits."""
    write_branch(branch, tmp_path, {})
    path = tmp_path / f"{NAME}.h5"
    with h5py.File(path, "a") as file:
        del file.attrs["branch_kind"]

    restored = read_branch(path)

    assert restored.kind == branch.kind
    assert [point.energy for point in restored.points] == [point.energy for point in branch.points]


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


def files_of(folder: Path) -> dict[str, str]:
    """The files of branches in a folder by name: the text of tables, and ending, findings and table of HDF5 files."""
    found = {}
    for path in sorted(folder.glob("branch-*")):
        if path.suffix == ".h5":
            branch = read_branch(path)
            found[path.name] = f"{branch.ended}{branch.findings}{branch.missing}{table_of(branch)}"
        else:
            found[path.name] = path.read_text()
    return found


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
        assert np.abs(np.subtract.outer(expected, curve) / curve).min(axis=1).max() < 1e-12


def test_a_step_whose_point_cannot_be_assessed_is_repeated_as_a_whole(tmp_path, monkeypatch):
    """A resumed branch repeats the step of a point that failed: its special points and findings appear once."""
    nnm = {"start_energy": 0.029, "energy": [0.0, 0.0291]}
    assess = ShootingMethod.assess

    def locate(problem, left, right, missed, **options):
        missed.append(f"nothing is located after point {left.index}")
        return [replace(right, kind="period-doubling")]

    def fail_at_2(method, problem, point):
        if point.kind == "regular" and point.index == 2:
            raise FlowError("the loss is not found")
        return assess(method, problem, point)

    monkeypatch.setattr("vipetsc.modes.branches.growth.locate", locate)
    whole = follow(tmp_path / "whole", **nnm)
    assert len(whole.regular()) > 2
    parts = tmp_path / "parts"
    with monkeypatch.context() as patch:
        patch.setattr(ShootingMethod, "assess", fail_at_2)
        failed = follow(parts, **nnm)
    assert failed.ended.sentence == "failed: the loss is not found"
    assert [(point.index, point.kind) for point in failed.points] == [
        (0, "regular"),
        (1, "period-doubling"),
        (1, "regular"),
    ]

    follow(parts, resume=True, **nnm)
    assert files_of(parts) == files_of(tmp_path / "whole")


def test_a_kill_at_the_end_of_a_branch_does_not_lengthen_it(tmp_path, monkeypatch):
    """A branch's last point is written together with the mark that it is complete, so that a kill before adds none."""
    nnm = {"start_energy": 0.029, "energy": [0.0, 0.0291], "locate": False}
    follow(tmp_path / "whole", **nnm)
    parts = tmp_path / "parts"

    def kill(*_):
        raise KeyboardInterrupt

    # Orbits are sampled after the last point, before the branch is written as a whole.
    monkeypatch.setattr("vipetsc.modes.branches.orbits.sampled", kill)
    with pytest.raises(KeyboardInterrupt):
        follow(parts, saves_all=True, **nnm)
    monkeypatch.undo()
    follow(parts, resume=True, **nnm)

    assert files_of(parts) == files_of(tmp_path / "whole")


def test_a_table_that_cannot_be_written_costs_no_branch(tmp_path, monkeypatch, caplog):
    """A complete branch whose table cannot be written is read and not followed again; a warning gives the reason."""
    short = {"energy": [0.0, 0.0295], "locate": False}
    whole = follow(tmp_path, **short)
    (tmp_path / f"{NAME}.csv").unlink()

    def refuse(*_):
        raise OSError("the disk is full")

    monkeypatch.setattr("vipetsc.modes.branches.follow.restore_table", refuse)
    followed = []
    branch = follow(tmp_path, lambda *_: followed.append(1), resume=True, **short)
    assert not followed
    assert table_of(branch) == table_of(whole)
    assert "the table of branch out-of-phase is not written: the disk is full" in caplog.text
