"""The paper's plan: case files in the package, steps and their states, and figures that are stale by content alone."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

import pytest

import vipetsc
from tests.conftest import assert_same_bits, datasets, put_members
from tests.faults.inject import Injector
from vipetsc.case import Case
from vipetsc.io.folder import FolderError, claimed
from vipetsc.io.kinds import SEARCH
from vipetsc.paper import make
from vipetsc.paper.cell_search import search_design
from vipetsc.paper.claims.criteria import UNMEASURED
from vipetsc.paper.claims.measure import measure_claims
from vipetsc.paper.paper_figures import TRANSFER
from vipetsc.paper.plan import BEGUN, DONE, FULL, MISSING, STALE, PaperStep, Plan, paper_plan
from vipetsc.paper.steps import read_record
from vipetsc.parallel import StopRequest

ROOT = Path(__file__).parents[2]
PACKAGE = Path(vipetsc.__file__).parent


def test_every_case_file_comes_with_the_package():
    """Each step's case file, and no other, is a regular file of the package that its declaration installs."""
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    shipped = {path for pattern in declared["vipetsc.paper"] for path in (PACKAGE / "paper").glob(pattern)}

    needed = {step.file for step in paper_plan(FULL).steps}
    assert needed <= shipped
    assert PACKAGE / "paper" / "report.html" in shipped
    assert all(PACKAGE in path.parents and path.is_file() and not path.is_symlink() for path in needed)
    assert {path for path in shipped if path.parent.name == "cases"} == needed
    assert set((PACKAGE / "paper").rglob("*.toml")) <= shipped


def test_examples_of_the_same_name_are_the_same_files():
    """An example with the name of a step's case is a link to it, so that they cannot differ."""
    for path in {step.file for step in paper_plan(FULL).steps}:
        assert (ROOT / "runs/examples" / path.name).resolve() == path


def test_every_step_is_a_case_that_can_be_used():
    """Each step's text is read by its kind of case and written out unchanged."""
    for step in paper_plan(FULL).steps:
        assert step.kind.from_toml(step.text).to_toml() == step.text


SMALL = ("design.lambda.count=3", "design.eta.count=3", "design.wavenumbers=11")


@pytest.fixture
def searched(tmp_path) -> tuple[Plan, Path]:
    """Make the search of a plan that has no other step, and return the plan and its folder."""
    plan = paper_plan(FULL)
    step = replace(step_of(plan, "design"), changes=SMALL)
    # The figures are one of the search and one that needs no step.
    figures = [figure for figure in plan.figures if figure.id in ("figS3", "fig10")]

    search_design(step.case, tmp_path / "design")

    return replace(plan, steps=(step,), figures=figures), tmp_path


def step_of(plan: Plan, name: str) -> PaperStep:
    """Return the step of a name."""
    return next(step for step in plan.steps if step.name == name)


def test_a_sweep_of_which_members_failed_is_not_finished(tmp_path):
    """A sweep with failed members is among the steps that are left; without failures no step is left."""
    plan = paper_plan(FULL)
    step = replace(
        step_of(plan, TRANSFER),
        changes=('sweep.contacts.law=["hertz"]', "sweep.contacts.sites=[1]", "sweep.drive.cycles=[5]"),
    )
    plan = replace(plan, steps=(step,))

    for failing in ({0, 2}, set()):
        root = tmp_path / f"failing-{len(failing)}"

        def outcome(number: int, case: Case, failing: set[int] = failing) -> dict[str, Any] | str:
            if number in failing:
                return "a fault"
            statistics = {"episodes": 0, "work": 2.0, "dissipated": 0.0, "ledger_error": 0.0, "engine": "ts"}
            return {"statistics": statistics, "measures": {}}

        put_members(step.folder(root), step.case, outcome)
        assert step.failures(root) == len(failing)
        assert set(plan.left(root)) == ({TRANSFER} if failing else set())

    # As after a kill before the ensemble: the sweep has to be called again, which writes the ensemble.
    assert step.state(root) == DONE
    (step.folder(root) / "ensemble.h5").unlink()
    assert step.state(root) == BEGUN


def test_times_of_files_make_nothing_stale(searched):
    """Newer times of files change neither the state of a step nor the inputs of figures and claims."""
    plan, root = searched
    before = plan.inputs(root)

    for path in root.rglob("*"):
        os.utime(path, ns=(2**61, 2**61))

    assert plan.steps[0].state(root) == DONE
    assert plan.inputs(root) == before
    assert set(before) == {"figS3", "fig10", "claims"}


def test_another_case_is_another_input_and_a_stale_step(searched):
    """A step whose case has changed is stale, begun once its folder is claimed, and done when it has ended."""
    plan, root = searched
    step = replace(plan.steps[0], changes=(*SMALL, "design.eta.count=4"))

    assert step.state(root) == STALE
    assert step.identity(root) != plan.steps[0].identity(root)
    assert plan.steps[0].state(root / "none") == MISSING

    # The folder is claimed and empty, as after a kill; a step that was begun is continued.
    with claimed(MPI.COMM_SELF, step.folder(root), SEARCH, step.text, force=True):
        pass
    assert step.state(root) == BEGUN

    with step.claimed(root, MPI.COMM_SELF, StopRequest(), False) as claimed_step:
        claimed_step.make(*step.parts)
    assert step.state(root) == DONE


def test_no_claim_is_measured_from_results_that_are_stale_or_a_part(searched):
    """Where another part of the paper is made, the claims of a step whose case has changed are not measured."""
    plan, root = searched
    given: list[Mapping[str, str]] = []

    def measured(root: Path, unusable: Mapping[str, str]) -> list[dict[str, Any]]:
        given.append(unusable)
        return measure_claims(root, unusable)

    def rows(step: PaperStep) -> list[dict[str, Any]]:
        # Without the file the claims are measured again, whatever their inputs were.
        (root / "claims.json").unlink(missing_ok=True)
        whole = replace(plan, steps=(step,), figures=[], measure=measured)
        nothing = replace(whole, steps=())
        made = make._make_paper(whole, nothing, root, MPI.COMM_SELF, StopRequest(), lambda text: None)
        return [row for row in made.claims if row["id"] == "C10"]

    step = plan.steps[0]
    assert all(row["files"] == ["design/design.h5"] for row in rows(step))
    for row in rows(replace(step, changes=(*SMALL, "design.eta.count=4"))):
        assert row["verdict"] == UNMEASURED and not row["files"]
        assert "design has results of another case or version" in row["reason"]
    assert [set(unusable) for unusable in given] == [set(), {"design"}]


@pytest.mark.usefixtures("plain_pictures")
def test_a_failed_step_is_reported_and_cut_files_are_computed_again(searched, tmp_path):
    """A step's failure is noted and costs no other step; cut files are computed again to the same bits."""
    plan, _ = searched
    root = tmp_path / "paper"
    step = plan.steps[0]
    figures = [figure for figure in plan.figures if figure.id == "fig10"]
    plan = replace(plan, steps=(replace(step, name="other"), step), figures=figures, measure=lambda root, unusable: [])
    injector = Injector()
    injector.arm("member", 1, "exception")

    failed = make.make_paper(plan, root)
    assert failed.notes == ["failed: other: InjectedError: a fault at member"]
    assert failed.new_steps == ("design",)
    assert not failed.complete

    # The same command repeats the failed step and draws no picture again.
    whole = make.make_paper(plan, root)
    assert whole.new_steps == ("other",)
    assert whole.complete
    assert not whole.drawn
    assert set(read_record(root)["cpu"]["steps"]) == {"other", "design"}
    assert "CPU time" in (root / "report.html").read_text()

    result = root / "design" / "design.h5"
    before = datasets(result)
    claims = (root / "claims.json").read_bytes()
    picture = next((root / "figures").glob("*.png"))
    os.truncate(result, result.stat().st_size // 2)
    for path in (root / "claims.json", root / "made.json", root / "report.html", picture):
        os.truncate(path, 0)

    repaired = make.make_paper(plan, root)
    assert repaired.new_steps == ("design",)
    assert repaired.complete
    assert picture in repaired.drawn
    assert_same_bits(datasets(result), before)
    assert (root / "claims.json").read_bytes() == claims
    # The picture is whole: it ends with the last chunk of a PNG.
    assert picture.read_bytes()[-8:-4] == b"IEND"

    (root / "plan.json").write_text("")
    with pytest.raises(FolderError, match=r"plan\.json cannot be read; remove it if the folder holds"):
        make.make_paper(plan, root)
