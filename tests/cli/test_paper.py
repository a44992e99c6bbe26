"""The paper by one command: on one rank and on two, a second time, in part, and its report in a browser."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.cli.browser import NEEDED, SCREENS, browsing
from tests.cli.tiny_paper import DRAWN, drawing, tiny_plan
from tests.conftest import clean_environment, modified
from vipetsc.figures.sweep_members import Files
from vipetsc.paper.claims.criteria import CLAIMS
from vipetsc.paper.make import make_paper
from vipetsc.paper.paper_figures import PAPER_FIGURES
from vipetsc.paper.plan import DONE, paper_plan

ROOT = Path(__file__).parents[2]


def command(folder: Path) -> list[str]:
    """Return the words of the command that makes the tiny paper in a folder on two ranks."""
    return ["mpirun", "--oversubscribe", "-n", "2", sys.executable, "-m", "tests.cli.tiny_paper", str(folder)]


def make(folder: Path) -> dict:
    """Make the tiny paper on two ranks; return the record that it prints."""
    ended = subprocess.run(
        command(folder), cwd=ROOT, env=environment(), capture_output=True, text=True, timeout=300, check=False
    )
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout.splitlines()[-1])


def environment() -> dict[str, str]:
    """Return an environment in which Python finds the tests' own modules."""
    return clean_environment() | {"PYTHONPATH": str(ROOT)}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Make the tiny paper on two ranks, once for all tests that read it."""
    folder = tmp_path_factory.mktemp("paper") / "out"
    done = make(folder)
    assert done["complete"]
    assert {"interband", "scattering-amplitudes"} <= set(done["made"])
    return folder


@pytest.mark.mpirun
def test_one_rank_makes_the_same_claims_as_two(made, tmp_path):
    """One rank computes the steps that two claims need, and its table of claims has the same bytes as on two ranks."""
    done = make_paper(drawing(tiny_plan()), tmp_path / "out", only=["C8", "C11"])
    assert set(done.new_steps) == {"scattering", "interband", "interband-scatter"}

    claims = (made / "claims.json").read_bytes()
    assert (tmp_path / "out" / "claims.json").read_bytes() == claims
    assert {row["verdict"] for row in json.loads(claims)} == {"holds"}


@pytest.mark.mpirun
def test_a_second_call_does_nothing_and_a_lost_picture_is_drawn_again(made):
    """A second call computes, draws and writes nothing; a picture that lacks one of its files is drawn again."""
    before = modified(made)
    second_call = make_paper(drawing(tiny_plan()), made)
    assert second_call.new_steps == ()
    assert second_call.drawn == ()
    assert second_call.complete is True
    assert modified(made) == before

    # A picture consists of two files, which are drawn together.
    (made / "figures" / "fig10-reduced-model-printed.pdf").unlink()
    assert len(make_paper(drawing(tiny_plan()), made).drawn) == 2


@pytest.mark.mpirun
def test_every_figure_of_the_paper_is_offered(made):
    """The tiny paper's results suffice for pictures of all figures; those that it draws exist in every format."""
    plan = tiny_plan()
    folders = plan.folders(made)
    assert set(folders) == {step.name for step in plan.steps}

    with Files() as files:
        stems = [picture.stem for figure in PAPER_FIGURES for picture in figure.offers(folders, files)]
        ours = [picture.stem for figure in drawing(plan).figures for picture in figure.offers(folders, files)]
    assert len(stems) == len(set(stems))
    assert {stem.partition("-")[0] for stem in stems} == {figure.id for figure in PAPER_FIGURES}
    assert {stem.partition("-")[0] for stem in ours} == {*DRAWN}

    drawn = {path.name for path in (made / "figures").iterdir()}
    assert drawn == {f"{stem}.{kind}" for stem in ours for kind in ("png", "pdf")}


@pytest.mark.mpirun
def test_a_changed_case_is_stale(made):
    """A finished step is stale as soon as its case has one change more."""
    (step,) = (step for step in tiny_plan().steps if step.name == "design")
    assert step.state(made) == DONE
    assert replace(step, changes=(*step.changes, "design.lambda.count=4")).state(made) == "stale"


# Steps whose cases are the same on both grids.
SAME = (
    "scattering-amplitudes",
    "interband-amplitudes",
    "interband-one-site",
    "nnm-hertz-calibrated",
    "nnm-bilinear-calibrated",
)


def test_every_claim_and_figure_leads_to_steps():
    """On both grids every claim and figure names its steps; the cases of the grids differ, except those of ``SAME``."""
    for grid in ("full", "quick"):
        plan = paper_plan(grid)
        assert {claim for step in plan.steps for claim in plan.claims_of(step)} == set(CLAIMS)

        for figure in plan.figures:
            part = plan.only([figure.id])
            assert {step.name for step in part.steps} >= set(figure.steps)

        assert [step.name for step in plan.only(["C10"]).steps] == ["design"]
        assert {step.name for step in plan.only(["figs8"]).steps} > {"interband", "nnm-hertz-calibrated"}
        assert plan.only([]) == plan

    full = paper_plan("full")
    quick = paper_plan("quick")
    for full_step, quick_step in zip(full.steps, quick.steps, strict=True):
        if (full_step.checks or full_step.name) not in SAME:
            assert full_step.text != quick_step.text, full_step.name


def test_list_says_what_is_left(in_process, tmp_path):
    """``paper --list`` names missing steps with their minutes and claims, and missing figures, and writes nothing."""
    listed = in_process("paper", "--list", "--out", tmp_path / "none")
    assert listed.returncode == 0, listed.stderr
    assert re.search(r"^scattering +missing +\d+ min +.*C7 C8", listed.stdout, re.M)
    assert all(re.search(rf"^{figure.id} .*missing", listed.stdout, re.M) for figure in PAPER_FIGURES)
    assert not (tmp_path / "none").exists()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Open one browser for all sizes of its window."""
    with browsing(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.mark.mpirun
@NEEDED
@SCREENS
def test_the_report_fits_a_phone_and_a_desk(made, browser, width, height):
    """The report is no wider than the window, contains its pictures, and has no dead link and no error."""
    found = browser.measure(browser.open(made / "report.html", width, height))
    assert found["window"] == width
    assert found["page"] <= width
    assert found["wide"] == []
    assert found["images"] == len(list((made / "figures").glob("*.png")))
    assert found["broken"] == []
    assert found["linked"] == []
    assert found["dead"] == []
    assert found["errors"] == []


@pytest.mark.mpirun
def test_the_report_says_what_it_must(made):
    """The report names readings, verdicts, reservations and versions, and takes less than 5 MB."""
    page = (made / "report.html").read_text(encoding="utf-8")
    assert "quick: coarse grid" in page
    for words in ("calibrated", "printed", "holds", "minus sign", "Hermitian", "ledger", "petsc", "Two engines"):
        assert words in page

    assert len(page) < 5e6
