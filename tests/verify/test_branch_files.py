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
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.branch_checks import sampled
from vipetsc.modes.branches.files import LAYOUTS, read_branch, write_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.orbits import ShootingMethod
from vipetsc.modes.branches.regions import regions
from vipetsc.modes.problem import FlowError
from vipetsc.parallel import StopRequest

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
        complete=True,
        ending="done",
        findings=["a", "b"],
        extra=sampled(short_branch.problem, points[-1:]),
    )


def table_of(branch: Branch) -> str:
    """Return the CSV table of a branch as text."""
    return str(LAYOUTS[branch.kind].table(branch))


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
    assert restored.ending == "done"
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


@pytest.mark.slow
def test_a_picture_is_drawn_from_the_file(branch, tmp_path):
    """A branch's file alone is enough for its picture."""
    # This import loads matplotlib, which no other test here needs.
    from vipetsc.figures.registry import draw

    write_branch(branch, tmp_path, {})

    (path,) = draw("branches", [tmp_path])

    assert path == tmp_path / "figures" / f"{NAME}.png"
    assert path.stat().st_size > 20000


def test_orbits_have_the_energies_that_are_asked_for(tmp_path):
    """A branch samples its orbits at the energies asked for: three orbits between its folds at 0.0264 and 0.02934 J."""
    branch = follow(tmp_path / "a", energy=[0.0, 0.05], orbits_at=[0.028, 0.0316, 9.0], locate=False)

    # The orbits asked for come after the orbits that every branch samples.
    energies = branch.extra["orbits/energy"].values[-4:]
    periods = branch.extra["orbits/period"].values[-4:]
    assert energies == pytest.approx([0.028] * 3 + [0.0316], rel=1e-12)
    assert len(set(periods)) == 4
    assert branch.findings == ["the branch has no orbit of 9 J"]


@pytest.mark.slow
def test_both_halves_of_a_branch_are_stopped_saved_and_resumed_to_the_same_bits(tmp_path):
    """A branch that is stopped and resumed in each of its halves leaves the files of one that is never stopped."""
    nnm = {"direction": "both", "start_energy": 0.029, "energy": [0.01, 0.05]}
    nnm |= {"switch": ["period-doubling"], "switch_points": 3}
    parts = tmp_path / "parts"
    whole = tmp_path / "whole"
    stop = StopRequest()
    saved = set()

    def listener(branch, point):
        saved.update(path.name for path in parts.iterdir())
        stop.requested = (branch.name, point.index) in {("out-of-phase-down", 5), ("out-of-phase", 7)}

    first = follow(parts, listener, stop, saves_all=True, **nnm)
    assert first.ending.startswith("stopped on request")
    assert not (parts / f"{NAME}.h5").exists()
    second = follow(parts, listener, stop, resume=True, saves_all=True, **nnm)
    assert second.ending == "stopped on request after point 7; continue with --resume"
    assert {f"{NAME}-down.h5", f"{NAME}.h5"} <= saved

    last = follow(parts, resume=True, **nnm)
    uninterrupted = follow(whole, **nnm)

    assert last.complete
    assert table_of(last) == table_of(uninterrupted)
    names = {path.name for path in whole.iterdir()}
    assert names == {path.name for path in parts.iterdir()}
    for name in names:
        if name.endswith("csv"):
            assert (parts / name).read_text() == (whole / name).read_text()

    # A crossing branch whose file is lost is followed again.
    crossing = next(name for name in names if "doubling" in name and name.endswith("h5"))
    (parts / crossing).unlink()
    follow(parts, resume=True, **nnm)
    assert (parts / crossing).exists()


class FailBelow:
    """A listener that raises ``error`` at point ``index`` of the part of a branch below its start."""

    def __init__(self, index: int, error: BaseException) -> None:
        self.index = index
        self.error = error

    def __call__(self, branch, point):
        if branch.name.endswith("-down") and point.index == self.index:
            raise self.error


BOTH = {"direction": "both", "start_energy": 0.029, "energy": [0.01, 0.0295], "locate": False}
# A branch that stays without contact above its start too, and has only a few points there.
SHORT = BOTH | {"energy": [0.015, 0.0291]}


def files_of(folder: Path) -> dict[str, str]:
    """The files of branches in a folder by name: the text of tables, and ending, findings and table of HDF5 files."""
    found = {}
    for path in sorted(folder.glob("branch-*")):
        if path.suffix == ".h5":
            branch = read_branch(path)
            found[path.name] = f"{branch.ending}{branch.complete}{branch.findings}{table_of(branch)}"
        else:
            found[path.name] = path.read_text()
    return found


def test_a_branch_whose_lower_part_fails_keeps_it_and_its_upper_part(tmp_path):
    """The file of a branch whose lower part failed has both parts, says what failed and is not complete."""
    failed = follow(tmp_path, FailBelow(3, FlowError("the flow ends here")), **BOTH)

    # Points go from the last one below the start through the start itself to the end above it.
    assert [point.index for point in failed.points[:5]] == [3, 2, 1, 0, 1]
    assert failed.points[0].energy < 0.029
    assert failed.points[-1].energy > 0.0295
    # Tangents point along the branch in both parts; the energy grows along it here. The start has no energy tangent.
    beside_start = failed.points[:3] + failed.points[4:5]
    assert all(point.energy_tangent > 0 for point in beside_start)
    assert all(point.tangent @ failed.points[4].tangent > 0 for point in failed.points[:4])
    assert failed.ending == "failed: below the start: the flow ends here"
    assert not failed.complete
    assert failed.findings == ["below the start: the flow ends here"]
    stored = read_branch(tmp_path / f"{NAME}.h5")
    assert stored.ending == failed.ending
    assert stored.failure_below == failed.failure_below
    assert not stored.complete
    assert list(files_of(tmp_path)) == [f"{NAME}.csv", f"{NAME}.h5"]


def test_a_lower_part_that_failed_is_tried_again_from_its_last_point(tmp_path):
    """A resumed branch goes on from the last point of the part that failed, and keeps its complete upper part.

    A second failure is reported like the first, with the points up to it. A try without a failure leaves the branch
    that never failed.
    """
    whole = follow(tmp_path / "whole", **BOTH)
    parts = tmp_path / "parts"
    first = follow(parts, FailBelow(3, FlowError("the flow ends here")), **BOTH)

    second = follow(parts, FailBelow(5, FlowError("the flow ends there")), resume=True, **BOTH)
    assert [point.index for point in second.points[:7]] == [5, 4, 3, 2, 1, 0, 1]
    assert len(second.points) == len(first.points) + 2
    assert second.ending == "failed: below the start: the flow ends there"
    assert second.findings == ["below the start: the flow ends there"]

    followed = set()
    third = follow(parts, lambda branch, point: followed.add(branch.name), resume=True, **BOTH)
    assert third.complete
    assert third.failure_below is None
    assert followed == {"out-of-phase-down"}
    assert files_of(parts) == files_of(tmp_path / "whole")
    assert third.ending == whole.ending


def test_both_parts_that_failed_are_tried_again(tmp_path):
    """A resumed branch tries its part below the start and then that above it, and becomes one that never failed."""
    follow(tmp_path / "whole", **BOTH)
    parts = tmp_path / "parts"

    def fail(branch, point):
        if point.index == 3:
            raise FlowError(f"{branch.name} ends here")

    failed = follow(parts, fail, **BOTH)
    assert failed.ending == "failed: out-of-phase ends here"
    assert failed.findings == ["below the start: out-of-phase-down ends here"]

    assert follow(parts, resume=True, **BOTH).complete
    assert files_of(parts) == files_of(tmp_path / "whole")


@pytest.mark.parametrize("killed", [False, True])
def test_a_lower_part_that_is_tried_again_is_stopped_and_resumed(tmp_path, killed):
    """A second try that a request or a kill stops keeps its points, and resumes to the branch that never failed."""
    follow(tmp_path / "whole", **SHORT)
    parts = tmp_path / "parts"
    follow(parts, FailBelow(3, FlowError("the flow ends here")), **SHORT)

    if killed:
        # An exception that is no failure of the method ends the command wherever it is, as a kill does.
        with pytest.raises(KeyboardInterrupt):
            follow(parts, FailBelow(6, KeyboardInterrupt()), resume=True, saves_all=True, **SHORT)
    else:
        stop = StopRequest()

        def stop_below(branch, point):
            stop.requested = point.index == 5

        stopped = follow(parts, stop_below, stop, resume=True, saves_all=True, **SHORT)
        assert stopped.ending == "stopped on request after point 5; continue with --resume"
        assert not stopped.complete
        assert list(files_of(parts)) == [f"{NAME}.csv", f"{NAME}.h5"]

    followed = []
    resumed = follow(parts, lambda branch, point: followed.append(point.index), resume=True, **SHORT)
    # The last point before the kill is in no file: the branch is written after the listener.
    assert followed[0] == 6
    assert resumed.complete
    assert files_of(parts) == files_of(tmp_path / "whole")


def test_a_kill_after_the_lower_part_has_ended_leaves_it_as_it_is(tmp_path):
    """After a kill in the upper part, the lower part, which had ended, is neither followed again nor extended."""
    follow(tmp_path / "whole", **SHORT)
    parts = tmp_path / "parts"

    def kill_above(branch, point):
        if branch.name == "out-of-phase":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        follow(parts, kill_above, saves_all=True, **SHORT)
    followed = set()
    follow(parts, lambda branch, point: followed.add(branch.name), resume=True, **SHORT)

    assert followed == {"out-of-phase"}
    assert files_of(parts) == files_of(tmp_path / "whole")


def test_a_kill_above_a_lower_part_that_failed_costs_no_point_of_it(tmp_path):
    """The lower part goes on from the point at which it failed, although no write was due at that point."""
    follow(tmp_path / "whole", **BOTH)
    parts = tmp_path / "parts"

    def fail_below_and_kill_above(branch, point):
        if branch.name == "out-of-phase-down" and point.index == 3:
            raise FlowError("the flow ends here")
        if branch.name == "out-of-phase" and point.index == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        follow(parts, fail_below_and_kill_above, saves_all=True, **BOTH)
    # The branch has been written together with its lower part, whose own files still exist.
    assert {f"{NAME}-down.h5", f"{NAME}.h5"} <= set(files_of(parts))
    followed = []
    follow(parts, lambda branch, point: followed.append((branch.name, point.index)), resume=True, **BOTH)

    assert followed[0] == ("out-of-phase-down", 4)
    assert files_of(parts) == files_of(tmp_path / "whole")


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
    assert failed.ending == "failed: the loss is not found"
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


@pytest.fixture
def marked_points(monkeypatch):
    """Mark the second and the fifth point of each part of a branch as period doublings.

    Linear motions have no special points: regular points stand for them, and the branch that crosses there is the
    branch itself.
    """

    def locate(problem, left, right, **options):
        return [replace(right, kind="period-doubling")] if right.index in (2, 5) else []

    def switch(shooting, point, amplitude):
        return shooting, replace(point, kind="regular", index=0)

    monkeypatch.setattr("vipetsc.modes.branches.growth.locate", locate)
    monkeypatch.setattr("vipetsc.modes.branches.orbits.switch", switch)


CROSSING = BOTH | {"locate": True, "switch": ["period-doubling"], "switch_points": 1}


@pytest.mark.slow
@pytest.mark.parametrize("stopped", [False, True])
def test_crossing_branches_follow_the_numbers_of_special_points_that_a_second_try_adds(
    tmp_path, marked_points, stopped
):
    """Crossing branches are named anew when a second try lengthens the lower part and shifts special points' numbers.

    Special points are numbered from the far end of the part below the start. A second try that is stopped after the
    special point gives the same names.
    """
    parts = tmp_path / "parts"
    follow(tmp_path / "whole", **CROSSING)
    follow(parts, FailBelow(3, FlowError("the flow ends here")), **CROSSING)
    before = files_of(parts)
    assert len(before) < len(files_of(tmp_path / "whole"))

    if stopped:
        stop = StopRequest()

        def stop_below(branch, point):
            stop.requested = branch.name.endswith("-down") and point.index == 5

        half = follow(parts, stop_below, stop, resume=True, **CROSSING)
        assert half.ending.startswith("stopped")
        # Both special points below the start exist already. The last try adds none, and would not mend a wrong number.
        above = [point.index for point in half.points].index(0)
        assert sum(point.kind != "regular" for point in half.points[:above]) == 2
    follow(parts, resume=True, **CROSSING)

    after = files_of(parts)
    assert after == files_of(tmp_path / "whole")
    assert all(text != after[name] for name, text in before.items() if name.endswith("csv"))


def regular_points(branch: Branch) -> int:
    """The number of regular points of a branch beyond its start."""
    return len(branch.regular()) - 1


def test_a_lower_part_that_is_tried_again_leaves_the_branch_its_number_of_points(tmp_path):
    """A second try counts the points above the start towards nnm.points; with more points the branch is completed."""
    whole = follow(tmp_path / "whole", **BOTH)
    # Three points lie below the start at the failure, and the part above takes the one that is left.
    points = 4
    parts = tmp_path / "parts"
    first = follow(parts, FailBelow(3, FlowError("the flow ends here")), points=points, **BOTH)
    assert regular_points(first) == points < regular_points(whole)

    second = follow(parts, resume=True, points=points, **BOTH)
    assert regular_points(second) == points
    assert not second.complete
    assert second.ending == "below the start: 4 points reached: increase nnm.points and resume to continue"

    third = follow(parts, resume=True, **BOTH)
    assert third.complete
    assert files_of(parts) == files_of(tmp_path / "whole")


def test_a_branch_that_has_used_up_its_points_below_its_start_goes_on_there(tmp_path):
    """A branch whose points end below its start, resumed with more points, becomes the one that had them at first."""
    follow(tmp_path / "whole", **BOTH)
    parts = tmp_path / "parts"
    first = follow(parts, points=3, **BOTH)
    assert [point.index for point in first.points] == [3, 2, 1, 0]
    assert first.ending == "below the start: 3 points reached: increase nnm.points and resume to continue"
    assert not first.complete
    assert list(files_of(parts)) == [f"{NAME}.csv", f"{NAME}.h5"]

    assert follow(parts, resume=True, **BOTH).complete
    assert files_of(parts) == files_of(tmp_path / "whole")


def test_a_table_that_cannot_be_written_costs_no_branch(tmp_path, monkeypatch, caplog):
    """A complete branch whose table cannot be written is read and not followed again; a warning gives the reason."""
    short = {"energy": [0.0, 0.0295], "locate": False}
    whole = follow(tmp_path, **short)
    (tmp_path / f"{NAME}.csv").unlink()

    def refuse(*_):
        raise OSError("the disk is full")

    monkeypatch.setattr("vipetsc.modes.branches.follower.restore_table", refuse)
    followed = []
    branch = follow(tmp_path, lambda *_: followed.append(1), resume=True, **short)
    assert not followed
    assert table_of(branch) == table_of(whole)
    assert "the table of branch out-of-phase is not written: the disk is full" in caplog.text
