"""The paper's plan comes with the package; what is made from results is stale by content alone."""

from __future__ import annotations

import os
import tomllib
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

import vipetsc
from tests.conftest import assert_same_bits, datasets
from tests.faults.inject import Injector
from vipetsc.case import Case, Sweep, case_id
from vipetsc.io.folder import SEARCH, FolderError, claimed
from vipetsc.io.netcdf import open_netcdf
from vipetsc.paper import make
from vipetsc.paper.figures import TRANSFER
from vipetsc.paper.make import read_record
from vipetsc.paper.plan import BEGUN, DONE, FULL, MISSING, RELATION, STALE, Plan, fingerprint, paper_plan
from vipetsc.parallel import StoppedError, StopRequest
from vipetsc.studies.design import search_design

ROOT = Path(__file__).parents[2]
PACKAGE = Path(vipetsc.__file__).parent


def test_every_case_file_comes_with_the_package():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    shipped = {path for pattern in declared["vipetsc.paper"] for path in (PACKAGE / "paper").glob(pattern)}
    needed = {step.file for step in paper_plan(FULL).steps}
    assert needed <= shipped
    assert PACKAGE / "paper" / "report.html" in shipped
    assert all(PACKAGE in path.parents and path.is_file() and not path.is_symlink() for path in needed)
    assert {path for path in shipped if path.parent.name == "cases"} == needed
    assert set((PACKAGE / "paper").rglob("*.toml")) <= shipped


def test_examples_of_the_same_name_are_the_same_files():
    for path in {step.file for step in paper_plan(FULL).steps}:
        assert (ROOT / "runs" / path.name).resolve() == path


def test_every_step_is_a_case_that_can_be_used():
    for step in paper_plan(FULL).steps:
        assert step.kind.from_toml(step.text).to_toml() == step.text


SMALL = ("design.lambda.count=3", "design.eta.count=3", "design.wavenumbers=11")


@pytest.fixture
def searched(tmp_path) -> tuple[Plan, Path]:
    """A plan of the search alone, done."""
    step = next(step for step in paper_plan(FULL).steps if step.name == "design")
    step = replace(step, changes=SMALL)
    search_design(step.case, tmp_path / "design")
    plan = paper_plan(FULL)
    return replace(plan, steps=(step,), figures=[f for f in plan.figures if f.id in ("figS3", "fig10")]), tmp_path


def touch(root: Path) -> None:
    for path in root.rglob("*"):
        os.utime(path, ns=(2**61, 2**61))


def test_times_of_files_make_nothing_stale(searched, monkeypatch):
    plan, root = searched
    before = plan.inputs(root)
    touch(root)
    assert plan.steps[0].state(root) == DONE
    assert plan.inputs(root) == before
    assert set(before) == {"figS3", "fig10", "claims"}


def test_a_result_of_other_content_is_another_input(searched):
    plan, root = searched
    before = plan.inputs(root)
    path = root / "design" / "design.h5"
    path.write_bytes(path.read_bytes() + b"\0")
    after = plan.inputs(root)
    assert {key for key in before if before[key] != after[key]} == {"figS3", "claims"}


def test_another_version_of_the_package_is_another_input(searched, monkeypatch):
    plan, root = searched
    before = plan.inputs(root)
    monkeypatch.setattr(vipetsc, "__version__", "0.0.0")
    assert all(before[key] != value for key, value in plan.inputs(root).items())


def test_another_case_is_another_input_and_a_stale_step(searched):
    plan, root = searched
    step = replace(plan.steps[0], changes=(*SMALL, "design.eta.count=4"))
    assert step.state(root) == STALE
    assert step.identity(root) != plan.steps[0].identity(root)
    assert plan.steps[0].state(root / "none") == MISSING
    with claimed(MPI.COMM_SELF, step.folder(root), SEARCH, step.text, force=True):
        pass  # killed before it was made anew: what was begun is gone on with
    assert step.state(root) == BEGUN
    step.make(root, MPI.COMM_SELF, StopRequest(), False)
    assert step.state(root) == DONE


def test_a_relation_that_changes_is_another_input(tmp_path):
    step = next(step for step in paper_plan(FULL).steps if step.name == TRANSFER)
    (tmp_path / TRANSFER).mkdir()
    before = step.identity(tmp_path)
    (tmp_path / TRANSFER / RELATION).write_bytes(b"another")
    assert step.identity(tmp_path) != before


def test_stale_pictures_go_before_new_ones_are_drawn(searched):
    plan, root = searched
    (root / "figures").mkdir()
    old, other = root / "figures" / "figS3-old.png", root / "figures" / "figS30-other.png"
    old.touch()
    other.touch()
    make._drop_stale(plan, root)
    assert not old.exists() and other.exists()
    old.touch()  # drawn from the inputs of now
    record = make._drop_stale(plan, root)
    assert old.exists() and record == read_record(root)


def test_a_request_to_stop_makes_nothing_more_and_has_no_result(tmp_path):
    stop, told = StopRequest(), []
    stop.requested = True
    with pytest.raises(StoppedError):
        make.make_paper(replace(paper_plan(FULL), figures=()), tmp_path, stop=stop, tell=told.append)
    assert told == [] and [path.name for path in tmp_path.iterdir()] == ["plan.json"]


def test_fingerprints_tell_parts_apart():
    assert fingerprint("ab", "c") != fingerprint("a", "bc") != fingerprint("abc")
    assert fingerprint("ab") == fingerprint(b"ab")


def test_the_plan_names_what_it_does_not_know():
    with pytest.raises(FolderError, match=r"--only fig99 C18: figures are fig01"):
        paper_plan(FULL).only(["fig99", "C18", "C1"])
    assert paper_plan(FULL).only(["c1"]).figures


def test_a_search_is_done_when_its_file_has_its_case(searched):
    plan, root = searched
    with open_netcdf(root / "design" / "design.h5", "search") as search:
        assert tomllib.loads(search.attrs["case"]) == tomllib.loads(plan.steps[0].text)
    assert plan.steps[0].results(root) == [root / "design" / "design.h5"]


def test_a_step_that_fails_is_told_and_what_was_cut_is_made_again(searched, tmp_path):
    plan, root = searched[0], tmp_path / "paper"
    plan = replace(plan, steps=(replace(plan.steps[0], name="other"), *plan.steps), measure=lambda root: [])
    plan = replace(plan, figures=[figure for figure in plan.figures if figure.id == "fig10"])
    injector = Injector()
    injector.arm("member", 1, "exception")
    result = make.make_paper(plan, root)
    assert result.notes == ["failed: other: a fault at member"] and result.made == ("design",) and not result.complete
    whole = make.make_paper(plan, root)
    assert whole.made == ("other",) and whole.complete and not whole.drawn
    found, claims = datasets(root / "design" / "design.h5"), (root / "claims.json").read_bytes()
    picture = next((root / "figures").glob("*.png"))
    for path in (
        root / "design" / "design.h5",
        root / "claims.json",
        root / "made.json",
        root / "report.html",
        picture,
    ):
        os.truncate(path, path.stat().st_size // 2 if path.suffix == ".h5" else 0)
    again = make.make_paper(plan, root)
    assert again.made == ("design",) and again.complete and picture in again.drawn
    assert_same_bits(datasets(root / "design" / "design.h5"), found)
    assert (root / "claims.json").read_bytes() == claims and picture.read_bytes()[-8:-4] == b"IEND"
    (root / "plan.json").write_text("")
    with pytest.raises(FolderError, match=r"plan\.json cannot be read; remove it if the folder holds"):
        make.make_paper(plan, root)


def test_a_sample_has_one_member_of_every_curve_and_is_the_same_again():
    steps = {step.name: step for step in paper_plan(FULL).steps}
    sweeps = {name for name, step in steps.items() if step.kind is Sweep and not step.checks}
    assert sweeps == {step.checks for step in steps.values() if step.checks}

    def curve(case: Case) -> str:
        return str((case.lattice.reading, case.contacts.law, case.contacts.sites, case.drive.cycles))

    for name in ("interband", "scattering-neighbours"):
        sweep, step = steps[name].case, steps[f"{name}-ts"]
        members, sample = ([member.case for member in case.members()] for case in (sweep, step.case))
        assert set(map(curve, sample)) == set(map(curve, members))
        assert len(sample) == max(len(set(map(curve, members))), int(np.ceil(0.02 * len(members))))
        assert {case.time.engine for case in sample} == {"ts"}
        tables = (case.model_dump(by_alias=True, exclude_none=True) | {"name": name} for case in sample)
        assert {case_id(Case.from_table(t, ["time.engine=auto"])) for t in tables} <= set(map(case_id, members))
        assert step.text == replace(step).text
