"""The paper in one command: on one rank and two, through a kill, a second time, in part, in a browser."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from tests.cli.tiny_paper import DRAWN, drawing, tiny_plan
from tests.conftest import clean_environment
from vipetsc.figures.study import Files
from vipetsc.paper.claims.criteria import CLAIMS
from vipetsc.paper.figures import PAPER_FIGURES
from vipetsc.paper.make import make_paper
from vipetsc.paper.plan import DONE, paper_plan

ROOT = Path(__file__).parents[2]


def command(folder: Path) -> list[str]:
    return ["mpirun", "--oversubscribe", "-n", "2", sys.executable, "-m", "tests.cli.tiny_paper", str(folder)]


def make(folder: Path) -> dict:
    """What the tiny paper says it did on two ranks."""
    ended = subprocess.run(
        command(folder), cwd=ROOT, env=environment(), capture_output=True, text=True, timeout=300, check=False
    )
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout.splitlines()[-1])


def environment() -> dict[str, str]:
    return clean_environment() | {"PYTHONPATH": str(ROOT)}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """The tiny paper made on two ranks."""
    folder = tmp_path_factory.mktemp("paper") / "out"
    done = make(folder)
    assert done["complete"]
    assert {"interband", "scattering-amplitudes"} <= set(done["made"])
    return folder


@pytest.mark.mpirun
def test_one_rank_makes_the_same_claims_as_two(made, tmp_path):
    done = make_paper(drawing(tiny_plan()), tmp_path / "out", only=["C8", "C11"])
    assert set(done.made) == {"scattering", "interband", "interband-scatter"}
    claims = (made / "claims.json").read_bytes()
    assert (tmp_path / "out" / "claims.json").read_bytes() == claims
    assert {row["verdict"] for row in json.loads(claims)} == {"holds"}


@pytest.mark.mpirun
def test_a_second_call_does_nothing_and_a_lost_picture_is_drawn_again(made):
    before = {path: path.stat().st_mtime_ns for path in made.rglob("*") if path.is_file()}
    assert make(made) == {"made": [], "drawn": 0, "complete": True}
    assert {path: path.stat().st_mtime_ns for path in made.rglob("*") if path.is_file()} == before
    (made / "figures" / "fig10-reduced-model-printed.pdf").unlink()
    assert len(make_paper(drawing(tiny_plan()), made).drawn) == 2


@pytest.mark.mpirun
def test_every_figure_of_the_paper_is_offered(made):
    plan = tiny_plan()
    folders = plan.folders(made)
    assert set(folders) == {step.name for step in plan.steps}
    with Files() as files:
        stems = [picture.stem for figure in PAPER_FIGURES for picture in figure.offers(folders, files)]
    assert len(stems) == len(set(stems))
    assert {stem.partition("-")[0] for stem in stems} == {figure.id for figure in PAPER_FIGURES}
    drawn = {path.name for path in (made / "figures").iterdir()}
    ours = [stem for stem in stems if stem.partition("-")[0] in DRAWN]
    assert drawn == {f"{stem}.{kind}" for stem in ours for kind in ("png", "pdf")}


@pytest.mark.mpirun
def test_a_changed_case_is_stale(made):
    plan = tiny_plan()
    step = next(step for step in plan.steps if step.name == "design")
    assert step.state(made) == DONE
    assert replace(step, changes=(*step.changes, "design.lambda.count=4")).state(made) == "stale"


def test_every_claim_and_figure_leads_to_steps():
    for grid in ("full", "quick"):
        plan = paper_plan(grid)
        assert {claim for step in plan.steps for claim in plan.claims_of(step)} == set(CLAIMS)
        for figure in plan.figures:
            part = plan.only([figure.id])
            assert {step.name for step in part.steps} >= set(figure.steps)
        assert [step.name for step in plan.only(["C10"]).steps] == ["design"]
        assert {step.name for step in plan.only(["figs8"]).steps} > {"interband", "nnm-hertz-calibrated"}
        assert plan.only([]) == plan
    full, quick = paper_plan("full"), paper_plan("quick")
    assert all(
        a.text != b.text for a, b in zip(full.steps, quick.steps, strict=True) if (a.checks or a.name) not in SAME
    )


SAME = (
    "scattering-amplitudes",
    "interband-amplitudes",
    "interband-one-site",
    "nnm-hertz-calibrated",
    "nnm-bilinear-calibrated",
)


def test_list_says_what_is_left(in_process, tmp_path):
    listed = in_process("paper", "--list", "--out", tmp_path / "none")
    assert listed.returncode == 0, listed.stderr
    assert re.search(r"^scattering +missing +\d+ min +.*C7 C8", listed.stdout, re.M)
    assert all(re.search(rf"^{figure.id} .*missing", listed.stdout, re.M) for figure in PAPER_FIGURES)
    assert not (tmp_path / "none").exists()


@pytest.mark.mpirun
def test_bad_ids_and_foreign_folders_are_refused(vipetsc, in_process, tmp_path):
    wrong = vipetsc(2, "paper", "--only", "fig99", "C7", "--out", tmp_path / "out")
    assert wrong.returncode == 2
    assert wrong.stderr.count("--only fig99: figures are fig01, fig02") == 1
    assert "claims are C1 to C18" in wrong.stderr
    assert not (tmp_path / "out").exists()
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "letter.txt").write_text("mine")
    foreign = in_process("paper", "--only", "fig10", "--out", tmp_path / "foreign")
    assert foreign.returncode == 2
    assert "not a paper's of this kind" in foreign.stderr


def test_quick_and_full_do_not_mix(in_process, tmp_path):
    (tmp_path / "plan.json").write_text('{"grid": "full"}')
    mixed = in_process("paper", "--quick", "--only", "fig10", "--out", tmp_path)
    assert mixed.returncode == 2
    assert "holds the paper on the full grid; choose another --out for the quick one" in mixed.stderr


class Browser:
    """Headless Chromium behind its driver, spoken to as the W3C protocol has it."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.home, self.base = folder, f"http://127.0.0.1:{port}"
        log = (folder / "driver.log").open("w")
        self.driver = subprocess.Popen(
            ["chromedriver", f"--port={port}"], stdout=log, stderr=log, start_new_session=True
        )
        self.sessions: list[str] = []

    def call(self, path: str, body: dict | None = None, method: str | None = None, patience: float = 30) -> object:
        """The ``value`` of the driver's answer; waits until the driver listens."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.base + path, data, {"Content-Type": "application/json"}, method=method)
        deadline = time.monotonic() + patience
        while True:
            try:
                with urllib.request.urlopen(request, timeout=60) as answer:
                    return json.load(answer)["value"]
            except urllib.error.HTTPError:
                raise
            except OSError:
                if time.monotonic() > deadline or self.driver.poll() is not None:
                    raise
                time.sleep(0.1)

    def open(self, page: Path, width: int, height: int) -> str:
        """A new session that shows ``page`` in a window of that size; returns its path."""
        switches = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
                    "--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage",
                    f"--user-data-dir={self.home}/{width}"]  # fmt: skip
        metrics = {"deviceMetrics": {"width": width, "height": height, "pixelRatio": 1.0, "mobile": width < 600}}
        wanted = {
            "browserName": "chrome",
            "goog:chromeOptions": {"args": switches, "mobileEmulation": metrics},
            "goog:loggingPrefs": {"browser": "ALL"},
        }
        answer = self.call("/session", {"capabilities": {"alwaysMatch": wanted}})
        session = f"/session/{answer['sessionId']}"
        self.sessions.append(session)
        self.call(f"{session}/url", {"url": page.as_uri()})
        return session

    def processes(self) -> list[int]:
        """Every process of the driver's session, and every browser with a profile in the folder."""
        numbers = []
        for path in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                zombie, session = (path / "stat").read_text().rpartition(")")[2].split()[0:4:3]
                started_here = os.fsencode(self.home) in (path / "cmdline").read_bytes()
                if zombie != "Z" and (int(session) == self.driver.pid or started_here):
                    numbers.append(int(path.name))
        return numbers

    def close(self) -> None:
        """Quit the browsers and their driver; what does not go by itself within seconds is killed."""
        for session in self.sessions:
            with suppress(OSError):
                self.call(session, method="DELETE", patience=0)
        self.driver.terminate()
        deadline = time.monotonic() + 5
        while self.processes() and time.monotonic() < deadline:
            time.sleep(0.05)
        for number in self.processes():
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
        self.driver.wait()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    opened = Browser(tmp_path_factory.mktemp("browser"))
    yield opened
    opened.close()
    deadline = time.monotonic() + 5
    while opened.processes() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert opened.processes() == []


MEASURE = """
const root = document.documentElement, images = [...document.images];
return {
  page: root.scrollWidth, window: window.innerWidth, images: images.length,
  broken: images.filter(i => !i.complete || i.naturalWidth === 0).map(i => i.alt),
  wide: [...document.querySelectorAll('body *')].filter(e => e.getBoundingClientRect().right > window.innerWidth + 1
      && !e.closest('.wide')).map(e => e.tagName + '.' + e.className),
  linked: [...document.querySelectorAll('[src], link[href]')]
      .map(e => e.src || e.href).filter(u => !u.startsWith('data:')),
  dead: [...document.querySelectorAll('a[href^="#"]')].map(a => a.getAttribute('href'))
      .filter(h => !document.querySelector(h)),
};
"""


@pytest.mark.mpirun
@pytest.mark.skipif(shutil.which("chromedriver") is None, reason="no chromedriver; scripts/test installs it")
@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 900)])
def test_the_report_fits_a_phone_and_a_desk(made, browser, tmp_path, width, height):
    session = browser.open(made / "report.html", width, height)
    found = browser.call(f"{session}/execute/sync", {"script": MEASURE, "args": []})
    errors = [line for line in browser.call(f"{session}/se/log", {"type": "browser"}) if line["level"] == "SEVERE"]
    picture = base64.b64decode(browser.call(f"{session}/screenshot"))
    assert picture[:4] == b"\x89PNG"
    assert found["window"] == width
    assert found["page"] <= width
    assert found["wide"] == []
    assert found["images"] == len(list((made / "figures").glob("*.png")))
    assert found["broken"] == []
    assert found["linked"] == []
    assert found["dead"] == []
    assert errors == []


@pytest.mark.mpirun
def test_the_report_says_what_it_must(made):
    page = (made / "report.html").read_text(encoding="utf-8")
    assert "quick: coarse grid" in page
    for words in ("calibrated", "printed", "holds", "minus sign", "Hermitian", "ledger", "petsc", "Two engines"):
        assert words in page
    assert len(page) < 20e6
