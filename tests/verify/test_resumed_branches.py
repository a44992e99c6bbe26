"""Branches that go on after a stop or a failure: they end as others do, with the same findings."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py

from tests.models import KERSCHEN
from vipetsc.case import NnmCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.endings import Ending
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import Listener, follow_all
from vipetsc.parallel import StopRequest


def follow(folder: Path, listener: Listener | None = None, stop: StopRequest | None = None, **nnm: Any) -> Branch[Any]:
    """The out-of-phase branch of the two masses in ``folder``, begun or continued; ``nnm`` updates its table [nnm]."""
    folder.mkdir(exist_ok=True)
    nnm = {"modes": [2], "start_energy": 1.0, "energy": [0.5, 20.0], "first_step": 0.05} | nnm
    case = NnmCase.from_table({"name": "x", "nnm": {"system": "own", "own": KERSCHEN} | nnm})
    (branch,) = follow_all(case, folder, MPI.COMM_SELF, resume=True, listener=listener, stop=stop)
    return branch


def stopped_at(folder: Path, index: int, **nnm: Any) -> Branch[Any]:
    """The branch that was stopped at its point ``index``."""
    stop = StopRequest()

    def listener(branch: Branch[Any], point: Any) -> None:
        stop.requested = point.index == index

    branch = follow(folder, listener, stop, **nnm)
    assert branch.ended.sentence == f"stopped on request after point {index}; continue with --resume"
    return branch


def file_of(folder: Path) -> Branch[Any]:
    """The branch in the file of ``folder``."""
    return read_branch(folder / "branch-out-of-phase.h5")


def test_a_branch_that_other_sources_began_is_computed_again(tmp_path):
    """The points of other sources are dropped while a branch is not complete, and stay where it is."""
    stopped_at(tmp_path, 3)
    path = tmp_path / "branch-out-of-phase.h5"
    with h5py.File(path, "r+") as file:
        file.attrs["source"] = "0.1.0+other"
        file["energy"][0] = -1.0
    whole = follow(tmp_path)
    assert whole.complete and whole.points[0].energy > 0

    with h5py.File(path, "r+") as file:
        file.attrs["source"] = "0.1.0+other"
    before = path.read_bytes()
    follow(tmp_path)
    assert path.read_bytes() == before


def test_a_branch_that_goes_on_has_the_orbits_that_it_lacked(tmp_path):
    """A branch of few points, continued, says of each energy once that it is missing, and only of those that are."""
    nnm = {"orbits_at": [10.0, 100.0], "locate": False}
    first = follow(tmp_path, points=3, **nnm)
    assert first.missing == ["the branch has no orbit of 10 J", "the branch has no orbit of 100 J"]

    follow(tmp_path, **nnm)

    assert file_of(tmp_path).missing == ["the branch has no orbit of 100 J"]


def test_a_closed_curve_that_is_resumed_ends_where_it_began(tmp_path):
    """A closed curve of doubled periods that had used up its points ends at its first point, as a whole one does."""
    with (files("vipetsc.examples") / "period-doubling.toml").open("rb") as file:
        table = tomllib.load(file)
    curves = []
    for points in (100, 200):
        table["nfrc"] |= {"points": points, "harmonics": 11}
        case = NfrcCase.from_table(table)
        _, crossing, *_ = follow_all(case, tmp_path, MPI.COMM_SELF, resume=True)
        curves.append(crossing)

    used_up, closed = curves
    assert used_up.ended.ending is Ending.POINTS_USED
    assert "increase nfrc.points" in used_up.ended.sentence and "--resume" in used_up.ended.sentence
    assert closed.ended.ending is Ending.CLOSED
    assert closed.points[-1].xi.tolist() == closed.points[0].xi.tolist()
