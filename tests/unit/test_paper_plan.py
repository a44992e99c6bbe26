"""The paper's plan: case files in the package, steps and their states, and figures that are stale by content alone."""

from __future__ import annotations

import os
import shutil
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

import pytest
from PIL import Image

import vipetsc
from tests.conftest import assert_same_bits, datasets, put_members
from tests.faults.inject import Injector
from vipetsc.case import Case, case_id
from vipetsc.io.folder import FolderError, claimed
from vipetsc.io.kinds import SEARCH
from vipetsc.io.netcdf import open_netcdf
from vipetsc.paper import draw, make, steps
from vipetsc.paper.build_record import read_record, write_record
from vipetsc.paper.cell_search import search_design
from vipetsc.paper.claims.criteria import UNMEASURED
from vipetsc.paper.claims.measure import measure_claims
from vipetsc.paper.paper_figures import TRANSFER, PaperFigure
from vipetsc.paper.plan import BEGUN, DONE, FULL, MISSING, RELATION, STALE, PaperStep, Plan, fingerprint, paper_plan
from vipetsc.parallel import StoppedError, StopRequest

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


def test_a_result_of_other_content_is_another_input(searched):
    """A byte more in the result of the search changes the inputs of its figure and of the claims alone."""
    plan, root = searched
    before = plan.inputs(root)

    path = root / "design" / "design.h5"
    path.write_bytes(path.read_bytes() + b"\0")

    after = plan.inputs(root)
    assert {key for key in before if before[key] != after[key]} == {"figS3", "claims"}


def test_another_version_of_the_package_is_another_input(searched, monkeypatch):
    """Another version of the package changes the inputs of everything."""
    plan, root = searched
    before = plan.inputs(root)

    monkeypatch.setattr(vipetsc, "__version__", "0.0.0")
    assert all(before[key] != value for key, value in plan.inputs(root).items())


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


def test_a_relation_that_changes_is_another_input(tmp_path):
    """The scattering law that a prediction reads is a part of its identity."""
    step = step_of(paper_plan(FULL), TRANSFER)
    (tmp_path / TRANSFER).mkdir()
    before = step.identity(tmp_path)

    (tmp_path / TRANSFER / RELATION).write_bytes(b"another")
    assert step.identity(tmp_path) != before


def test_stale_pictures_go_before_new_ones_are_drawn(searched):
    """A figure's pictures from other inputs are removed, those of another figure and of the same inputs are not."""
    plan, root = searched
    figures = root / "figures"
    figures.mkdir()
    old = figures / "figS3-old.png"
    other = figures / "figS30-other.png"
    old.touch()
    other.touch()

    draw._drop_stale(plan, root, plan.inputs(root))
    assert not old.exists()
    assert other.exists()

    # The recorded inputs are the present ones, hence the picture counts as drawn from them.
    old.touch()
    record = draw._drop_stale(plan, root, plan.inputs(root))
    assert old.exists()
    assert record == read_record(root)


def test_a_request_to_stop_makes_nothing_more_and_has_no_result(tmp_path):
    """A request to stop before the first step leaves a folder with the plan alone, without a report."""
    stop = StopRequest()
    stop.requested = True
    reported = []

    with pytest.raises(StoppedError):
        make.make_paper(replace(paper_plan(FULL), figures=()), tmp_path, stop=stop, tell=reported.append)

    assert reported == []
    assert [path.name for path in tmp_path.iterdir()] == ["plan.json"]


def test_fingerprints_distinguish_parts():
    """A fingerprint depends on where one part ends and the next begins; text counts as its bytes."""
    assert len({fingerprint("ab", "c"), fingerprint("a", "bc"), fingerprint("abc")}) == 3
    assert fingerprint("ab") == fingerprint(b"ab")


def test_the_plan_names_what_it_does_not_know():
    """Unknown figures and claims are refused with a list of the known ones; claims may be in small letters."""
    with pytest.raises(FolderError, match=r"--only fig99 C99: figures are fig01"):
        paper_plan(FULL).only(["fig99", "C99", "C1"])
    assert paper_plan(FULL).only(["c1"]).figures


def test_a_search_is_done_when_its_file_has_its_case(searched):
    """The search's file holds the case that it was computed with, and is the step's result."""
    plan, root = searched
    with open_netcdf(root / "design" / "design.h5", "search") as search:
        assert tomllib.loads(search.attrs["case"]) == tomllib.loads(plan.steps[0].text)
    assert plan.steps[0].results(root) == [root / "design" / "design.h5"]


@pytest.mark.slow
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


@pytest.mark.parametrize("end", ["another case", "removed"])
def test_the_time_of_a_step_is_that_of_the_results_that_are_there(searched, tmp_path, end):
    """The time of a step is that of its present results, not of earlier ones that were replaced or removed."""
    plan = replace(searched[0], figures=[], measure=lambda root, unusable: [])
    root = tmp_path / "paper"
    make.make_paper(plan, root)
    record = read_record(root)
    record["cpu"]["steps"]["design"] = 1e6
    write_record(root, record)

    if end == "removed":
        shutil.rmtree(root / "design")
    else:
        plan = replace(plan, steps=(replace(plan.steps[0], changes=(*SMALL, "design.eta.count=4")),))
    assert make.make_paper(plan, root).new_steps == ("design",)
    assert 0 < read_record(root)["cpu"]["steps"]["design"] < 1e5


@pytest.mark.slow
def test_a_sample_has_members_of_different_curves_at_all_amplitudes_and_is_the_same_again():
    """The members that the engine ts computes, too, are of different curves, spread over the amplitudes, and fixed."""
    steps = {step.name: step for step in paper_plan(FULL).steps}
    checked = {step.checks for step in steps.values() if step.checks}
    assert checked == {"interband", "scattering", "scattering-neighbours"}

    def curve(case: Case) -> str:
        return str((case.lattice.reading, case.contacts.law, case.contacts.sites, case.drive.cycles))

    for name in ("interband", "scattering-neighbours"):
        sweep = steps[name].case
        step = steps[f"{name}-ts"]
        members, sample = ([member.case for member in case.members()] for case in (sweep, step.case))
        assert len(sample) == len(set(map(curve, sample))) == step.sample

        # The range of amplitudes, cut into as many parts as the sample has members, has one member in each part.
        amplitudes = sorted({case.drive.amplitude for case in members})
        places = sorted(amplitudes.index(case.drive.amplitude) for case in sample)
        assert [place * step.sample // len(amplitudes) for place in places] == list(range(step.sample))

        # Each case of the sample, with the engine of the sweep, is a member of the sweep.
        assert {case.time.engine for case in sample} == {"ts"}
        tables = (case.model_dump(by_alias=True, exclude_none=True) | {"name": name} for case in sample)
        assert {case_id(Case.from_table(t, ["time.engine=auto"])) for t in tables} <= set(map(case_id, members))
        assert step.text == replace(step).text


@pytest.mark.slow
@pytest.mark.usefixtures("plain_pictures")
def test_what_is_up_to_date_is_neither_offered_nor_encoded_again(searched, tmp_path, monkeypatch):
    """A second call draws nothing; a missing picture is drawn again, a missing report encodes its pictures again."""
    plan = replace(searched[0], measure=lambda root, unusable: [])
    root = tmp_path / "paper"
    offered: list[str] = []
    encoded: list[int] = []
    ordered: list[str] = []
    offers = PaperFigure.offers
    quantize = Image.Image.quantize
    draw_each = draw.draw_each

    def offers_noted(figure, *rest):
        offered.append(figure.id)
        return offers(figure, *rest)

    def quantize_noted(image, *arguments, **options):
        encoded.append(image)
        return quantize(image, *arguments, **options)

    def order_noted(drawings, *rest):
        ordered.extend(drawing.stem for drawing in drawings)
        return draw_each(drawings, *rest)

    monkeypatch.setattr(PaperFigure, "offers", offers_noted)
    monkeypatch.setattr(Image.Image, "quantize", quantize_noted)
    monkeypatch.setattr(draw, "draw_each", order_noted)

    first = make.make_paper(plan, root)
    # The dearest picture is the first, since it would keep one rank busy at the end.
    assert ordered[0] == "figS3-design-cost-maps"
    assert len(ordered) == 6
    assert sorted(offered) == ["fig10", "figS3"]
    assert len(encoded) == 6
    # Each picture has a PNG and a PDF.
    assert len(first.drawn) == 2 * 6
    cpu = read_record(root)["cpu"]
    assert min(cpu["steps"]["design"], cpu["figures"], cpu["report"]) > 0

    offered.clear()
    encoded.clear()
    assert make.make_paper(plan, root).drawn == ()
    assert offered == []
    assert encoded == []

    next((root / "figures").glob("fig10-*.png")).unlink()
    assert len(make.make_paper(plan, root).drawn) == 2
    assert offered == ["fig10"]
    assert encoded == []

    (root / "report.html").unlink()
    make.make_paper(plan, root)
    assert len(encoded) == 6
    assert (root / "report.html").read_text(encoding="utf-8").count("data-of") == 6


def test_parts_of_all_steps_are_shared_the_longest_first(tmp_path, monkeypatch):
    """The parts of all steps with parts are jobs of one pool, the dearest first."""
    jobs: list[tuple[float, str, int]] = []

    def note(pool, new_jobs, *rest, **options):
        jobs.extend(new_jobs)
        return {}

    monkeypatch.setattr(steps.TaskPool, "run", note)
    plan = paper_plan(FULL)
    in_parts = [step for step in plan.steps if step.parts]

    make.make_paper(replace(plan, steps=in_parts, figures=[], measure=lambda root, unusable: []), tmp_path)

    assert len(jobs) == 7
    assert {name for _, name, _ in jobs} == {step.name for step in in_parts}
    assert [job[1:] for job in jobs[:2]] == [("nnm-hertz", 1), ("nnm-bilinear", 1)]
    costs = [cost for cost, *_ in jobs]
    assert costs == sorted(costs, reverse=True)
