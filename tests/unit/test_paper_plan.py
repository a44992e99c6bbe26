"""The paper's plan comes with the package; what is made from results is stale by content alone."""

from __future__ import annotations

import os
import tomllib
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import pytest
from PIL import Image

import vipetsc
from tests.conftest import assert_same_bits, datasets
from tests.faults.inject import Injector
from vipetsc.case import Case, case_id
from vipetsc.io.folder import SEARCH, FolderError, claimed
from vipetsc.io.netcdf import open_netcdf
from vipetsc.paper import draw, make, steps
from vipetsc.paper.build_record import read_record
from vipetsc.paper.cell_search import search_design
from vipetsc.paper.paper_figures import TRANSFER, PaperFigure
from vipetsc.paper.plan import BEGUN, DONE, FULL, MISSING, RELATION, STALE, Plan, fingerprint, paper_plan
from vipetsc.parallel import StoppedError, StopRequest

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
    with step.claimed(root, MPI.COMM_SELF, StopRequest(), False) as claimed_step:
        claimed_step.make(*step.parts)
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
    draw._drop_stale(plan, root, plan.inputs(root))
    assert not old.exists() and other.exists()
    old.touch()  # drawn from the inputs of now
    record = draw._drop_stale(plan, root, plan.inputs(root))
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
    with pytest.raises(FolderError, match=r"--only fig99 C99: figures are fig01"):
        paper_plan(FULL).only(["fig99", "C99", "C1"])
    assert paper_plan(FULL).only(["c1"]).figures


def test_a_search_is_done_when_its_file_has_its_case(searched):
    plan, root = searched
    with open_netcdf(root / "design" / "design.h5", "search") as search:
        assert tomllib.loads(search.attrs["case"]) == tomllib.loads(plan.steps[0].text)
    assert plan.steps[0].results(root) == [root / "design" / "design.h5"]


@pytest.mark.slow
@pytest.mark.usefixtures("plain_pictures")
def test_a_step_that_fails_is_told_and_what_was_cut_is_made_again(searched, tmp_path):
    plan, root = searched[0], tmp_path / "paper"
    plan = replace(plan, steps=(replace(plan.steps[0], name="other"), *plan.steps), measure=lambda root: [])
    plan = replace(plan, figures=[figure for figure in plan.figures if figure.id == "fig10"])
    injector = Injector()
    injector.arm("member", 1, "exception")
    result = make.make_paper(plan, root)
    assert (
        result.notes == ["failed: other: InjectedError: a fault at member"]
        and result.new_steps == ("design",)
        and not result.complete
    )
    whole = make.make_paper(plan, root)
    assert whole.new_steps == ("other",) and whole.complete and not whole.drawn
    assert (
        set(read_record(root)["cpu"]["steps"]) == {"other", "design"}
        and "CPU time" in (root / "report.html").read_text()
    )
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
    assert again.new_steps == ("design",) and again.complete and picture in again.drawn
    assert_same_bits(datasets(root / "design" / "design.h5"), found)
    assert (root / "claims.json").read_bytes() == claims and picture.read_bytes()[-8:-4] == b"IEND"
    (root / "plan.json").write_text("")
    with pytest.raises(FolderError, match=r"plan\.json cannot be read; remove it if the folder holds"):
        make.make_paper(plan, root)


@pytest.mark.slow
def test_a_sample_has_members_of_different_curves_at_all_amplitudes_and_is_the_same_again():
    steps = {step.name: step for step in paper_plan(FULL).steps}
    assert {step.checks for step in steps.values() if step.checks} == {
        "interband",
        "scattering",
        "scattering-neighbours",
    }

    def curve(case: Case) -> str:
        return str((case.lattice.reading, case.contacts.law, case.contacts.sites, case.drive.cycles))

    for name in ("interband", "scattering-neighbours"):
        sweep, step = steps[name].case, steps[f"{name}-ts"]
        members, sample = ([member.case for member in case.members()] for case in (sweep, step.case))
        assert len(sample) == len(set(map(curve, sample))) == step.sample
        amplitudes = sorted({case.drive.amplitude for case in members})
        places = sorted(amplitudes.index(case.drive.amplitude) for case in sample)
        assert [place * step.sample // len(amplitudes) for place in places] == list(range(step.sample))
        assert {case.time.engine for case in sample} == {"ts"}
        tables = (case.model_dump(by_alias=True, exclude_none=True) | {"name": name} for case in sample)
        assert {case_id(Case.from_table(t, ["time.engine=auto"])) for t in tables} <= set(map(case_id, members))
        assert step.text == replace(step).text


@pytest.mark.slow
@pytest.mark.usefixtures("plain_pictures")
def test_what_is_up_to_date_is_neither_offered_nor_encoded_again(searched, tmp_path, monkeypatch):
    plan, root = replace(searched[0], measure=lambda root: []), tmp_path / "paper"
    offered: list[str] = []
    encoded: list[int] = []
    ordered: list[str] = []
    offers, quantize, draw_each = PaperFigure.offers, Image.Image.quantize, draw.draw_each

    def drawn(drawings, *rest):
        ordered.extend(stem for stem, _ in drawings)
        return draw_each(drawings, *rest)

    monkeypatch.setattr(PaperFigure, "offers", lambda figure, *rest: offered.append(figure.id) or offers(figure, *rest))
    monkeypatch.setattr(
        Image.Image, "quantize", lambda image, *a, **k: encoded.append(image) or quantize(image, *a, **k)
    )
    monkeypatch.setattr(draw, "draw_each", drawn)
    made = make.make_paper(plan, root)
    assert ordered[0] == "figS3-design-cost-maps" and len(ordered) == 6  # the dearest first
    assert sorted(offered) == ["fig10", "figS3"] and len(encoded) == 6 and len(made.drawn) == 18
    cpu = read_record(root)["cpu"]
    assert min(cpu["steps"]["design"], cpu["figures"], cpu["report"]) > 0
    offered.clear()
    encoded.clear()
    assert make.make_paper(plan, root).drawn == () and offered == [] and encoded == []
    next((root / "figures").glob("fig10-*.png")).unlink()
    assert len(make.make_paper(plan, root).drawn) == 3 and offered == ["fig10"] and encoded == []
    (root / "report.html").unlink()
    make.make_paper(plan, root)
    assert len(encoded) == 6 and (root / "report.html").read_text(encoding="utf-8").count("data-of") == 6


def test_parts_of_all_steps_are_shared_the_longest_first(tmp_path, monkeypatch):
    shared: list[tuple[float, str, int]] = []
    monkeypatch.setattr(steps.TaskPool, "run", lambda pool, jobs, *rest, **options: shared.extend(jobs) or {})
    plan = paper_plan(FULL)
    parted = [step.name for step in plan.steps if step.parts]
    plan = replace(plan, steps=[step for step in plan.steps if step.parts], figures=[], measure=lambda root: [])
    make.make_paper(plan, tmp_path)
    assert [job[1:] for job in shared[:2]] == [("nnm-hertz", 1), ("nnm-bilinear", 1)]
    assert {name for _, name, _ in shared} == set(parted) and len(shared) == 7
    assert [cost for cost, *_ in shared] == sorted((cost for cost, *_ in shared), reverse=True)
