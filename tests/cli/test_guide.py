"""The guide does what it says: the blocks of the README and of the chapters that continue it are run as they stand."""

from __future__ import annotations

import argparse
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from mpi4py import MPI

import h5py
import numpy as np
import pytest
from PIL import Image

import vipetsc as package
from tests.conftest import clean_environment
from vipetsc.case import Case, Sweep
from vipetsc.case.nnm import NnmCase
from vipetsc.case.verb_cases import load_every
from vipetsc.cli.arguments import CASE, SET
from vipetsc.cli.main import main
from vipetsc.cli.verb import DONE, PlainVerb
from vipetsc.cli.verbs.verb_list import VERBS
from vipetsc.modes.system import System
from vipetsc.parallel import StopRequest, on_root

ROOT = Path(package.__file__).parents[1]
MANUAL = ROOT / "vipetsc/manual"
CHAPTERS = ("own-lattice", "files", "measures", "modal", "engines")
# The pages are one session in this order: later pages use files of earlier ones. The blocks of other pages are read by
# the tests below; tests/cli/test_python.py runs those of Python.
GUIDE = [ROOT / "README.md", *(MANUAL / f"{name}.md" for name in CHAPTERS)]
CASE_NAME = re.compile(r"# (\S+\.toml)(, added)?\n")
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", flags=re.M | re.S)


def session() -> list[list[str]]:
    """Return all blocks in order as steps for ``tests/session.py``."""
    steps = []
    for page, language, text in blocks():
        named = CASE_NAME.match(text)
        if language == "toml" and named:
            steps.append(["file", text, named[1]])
        elif language == "python":
            steps.append(["python", text, f"{page.stem}.py"])
        elif language == "sh":
            for line in text.replace("\\\n", " ").splitlines():
                # A call of scripts/test would run this test again.
                if line.startswith("python -m vipetsc "):
                    steps.append(["vipetsc", line.removeprefix("python -m vipetsc ")])
                elif not line.startswith("scripts/test "):
                    steps.append(["shell", line])
        else:
            # An excerpt of a case file without the name of a file is not typed.
            assert language == "toml", language
    return steps


def blocks() -> Iterator[tuple[Path, str, str]]:
    """Yield page, language and text of the guide's blocks that name a language."""
    for page in GUIDE:
        for language, text in filter(all, BLOCK.findall(page.read_text(encoding="utf-8"))):
            yield page, language, text


@pytest.mark.mpirun
def test_the_guide_does_what_it_says(tmp_path):
    """The session ends with 0 in a fresh clone, and leaves the results, numbers and picture that the guide shows."""
    type_session(tmp_path)
    assert_results_are_there(tmp_path)
    assert_numbers_are_those_of_the_guide(tmp_path)
    assert_the_picture_is_that_of_the_readme(tmp_path)


def type_session(folder: Path) -> None:
    """Run the whole session in a fresh clone, without variables of MPI, and assert that it ends with 0."""
    shutil.copytree(ROOT / "scripts", folder / "scripts")
    shutil.copytree(ROOT / "runs" / "examples", folder / "runs" / "examples")

    # A test under mpirun has variables that a terminal does not have.
    outside = {name: value for name, value in clean_environment().items() if not name.startswith(("OMPI_", "PRTE_"))}
    environment = outside | {"PYTHONPATH": str(ROOT), "VIPETSC_PYTHON": sys.executable}
    (folder / "steps.json").write_text(json.dumps(session()), encoding="utf-8")
    command = [sys.executable, "-m", "tests.session", "steps.json"]
    ended = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False
    )

    assert ended.returncode == 0, ended.stdout[-2000:] + ended.stderr[-4000:]


def assert_results_are_there(desk: Path) -> None:
    """Assert that the session has left the results that the guide names, and that none is empty."""
    for name in (
        "four-band/figures/dispersion.png",
        "loud/figures/dispersion.pdf",
        "loud/curves/run-time.csv",
        "my-lattice-bands/bands.png",
        "my-lattice/figures/dispersion.png",
        "my-lattice-12N/run.h5",
        "my-branch/branch-out-of-phase.csv",
    ):
        assert (desk / "runs" / name).stat().st_size > 1000, name


def assert_numbers_are_those_of_the_guide(desk: Path) -> None:
    """Assert that the guide's numbers of its lattice, its run and its sweep are those of the files."""
    case = Case.load(desk / "my-lattice.toml")
    assert case.warnings() == []
    assert case.drive.frequency == pytest.approx(936, abs=0.5)
    assert case.lattice.unit_cell().dofs == 3
    assert len(Sweep.load(desk / "my-lattice.toml").members()) == 7
    assert System.from_case(NnmCase.load(desk / "my-lattice.toml")).branch_name(1) == "out-of-phase"

    with h5py.File(desk / "runs/my-lattice/run.h5") as file:
        assert len(file["impacts/onset"]) == 80
        assert file["energy/dissipated"][-1] / file["energy/work"][-1] == pytest.approx(0.37, abs=0.005)

    with h5py.File(desk / "runs/my-sweep/ensemble.h5") as file:
        ibtet = file["ibtet"][...]
        quiet = file["contact_episodes"][...] == 0
        assert 1 < quiet.sum() < 7
        # Members without contact are scaled from one linear run: its transfer does not depend on the amplitude.
        assert ibtet[quiet] == pytest.approx(ibtet[0], rel=1e-12)
        assert ibtet.max() > 10 * ibtet[0]
    assert (desk / "runs/my-sweep/figures/ibtet-over-drive.amplitude.png").exists()


def assert_the_picture_is_that_of_the_readme(desk: Path) -> None:
    """Assert that the session's picture of the built-in run is that of the README, apart from versions of fonts."""

    def seen(path: Path) -> np.ndarray:
        """Return the brightness of a picture, 0 to 255, on a coarse grid, on which fonts make no difference."""
        return np.asarray(Image.open(path).convert("L").resize((140, 64)), float)

    drawn = desk / "runs/four-band/figures/dispersion.png"
    shown = MANUAL / "pictures/four-band.png"
    assert Image.open(drawn).size == Image.open(shown).size
    # A picture of the same run with another layout differed by 8 of 255.
    assert np.abs(seen(drawn) - seen(shown)).mean() < 1


def commands() -> dict[str, list[str]]:
    """Return the words of every call of the program in README and manual, by page and number."""
    found = {}
    for page in [ROOT / "README.md", *sorted(MANUAL.rglob("*.md"))]:
        # A command may continue on the next line.
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        for number, line in enumerate(re.findall(r"python -m vipetsc *([^`\n]*)", text)):
            # The parser does not see options of PETSc and redirections.
            words = line.partition(" -- ")[0].partition(">")[0]
            found[f"{page.relative_to(ROOT)}-{number}"] = shlex.split(words, comments=True)
    return found


def test_every_command_of_the_manual_is_understood(monkeypatch):
    """The program's own parser takes every command of the manual, and the case file that the command names exists."""
    calls = []

    def note(options, petsc, comm) -> int:
        calls.append(options)
        return 0

    # What the commands do is tested elsewhere.
    monkeypatch.setattr("vipetsc.cli.main._call", note)
    for place, words in commands().items():
        assert main(words) == 0, place

        # The names that are left out are placeholders, or files that the session writes.
        case = getattr(calls[-1], "case", None)
        if case and case.endswith(".toml") and case not in ("CASE", "my-lattice.toml", "my-beam.toml", "case.toml"):
            assert (ROOT / case).exists(), place


def test_what_extend_shows_of_verbs_works(monkeypatch):
    """The verb whose code the chapter *extend* shows prints the mass of the lattice."""
    text = (MANUAL / "extend.md").read_text(encoding="utf-8")
    blocks = [block for language, block in BLOCK.findall(text) if language == "python"]
    (verb,) = (block for block in blocks if block.startswith("def weigh("))

    # The code uses names that the chapter imports, and names of the file to which a reader adds it.
    printed: list[str] = []
    names = {"Case": Case, "MPI": MPI, "StopRequest": StopRequest, "argparse": argparse,
             "echo": lambda comm, text: printed.append(text), "on_root": on_root,
             "CASE": CASE, "DONE": DONE, "PlainVerb": PlainVerb, "SET": SET}  # fmt: skip
    exec(verb, names)
    monkeypatch.setitem(VERBS, "weigh", names["VERB"])
    assert main(["weigh", "--set", "lattice.cells=100", "--quiet"]) == DONE
    # 100 cells of the four-band lattice have 15 g each.
    assert printed == ["1.5 kg"]


def test_the_chapter_on_verbs_lists_those_that_are_there():
    """The chapter *verbs* has a command of every verb, and lists the verbs with PETSc's options and with results."""
    text = (MANUAL / "verbs.md").read_text(encoding="utf-8")

    def listed(pattern: str) -> set[str]:
        """Return the names in the part of the text that the pattern's group matches."""
        return set(re.findall(r"`(\w+)`", re.search(pattern, text, flags=re.S)[1]))

    assert set(re.findall(r"^(?:mpirun -n 2 )?python -m vipetsc (\w+)", text, flags=re.M)) == VERBS.keys()
    taking = {verb.name for verb in VERBS.values() if verb.takes_petsc_options}
    assert listed(r"become part of the\s+case \((.*?)\)") == taking
    leaving = {verb.name for verb in VERBS.values() if verb.results}
    assert listed(r"interrupted commands\n\n(.*?)\s+look at the output folder first") == leaving


def test_files_that_the_manual_names_are_there_and_have_the_names_before_them():
    """Every path of the source tree exists; a name of the code with its module or file in brackets occurs in there."""
    found = 0
    for page in [ROOT / "README.md", *MANUAL.rglob("*.md")]:
        text = page.read_text(encoding="utf-8")
        for name, place in re.findall(r"`([A-Z_a-z]\w+)`\s*\(`(vipetsc[./][\w./]*\w)`", text):
            path = ROOT / place
            if not place.endswith(".py"):
                path = (ROOT / place.replace(".", "/")).with_suffix(".py")
            if not path.exists():
                path = path.with_suffix("") / "__init__.py"
            assert re.search(rf"\b{name}\b", path.read_text(encoding="utf-8")), (page.name, name, place)
            found += 1
        for path in re.findall(r"`((?:vipetsc|scripts|tests|runs/gallery)/[\w/.-]*[\w/])`", text):
            assert (ROOT / path).exists(), f"{page.name}: {path}"
    assert found > 5


def sections() -> dict[str, str]:
    """Return every excerpt of a case file in the manual that the session does not write, by page and number.

    Excerpts in *extend* are left out, because they need modules: tests/cli/test_plugins.py uses them.
    """
    excerpts = {}
    for page in sorted(MANUAL.glob("*.md")):
        if page.stem == "extend":
            continue
        for number, (language, text) in enumerate(BLOCK.findall(page.read_text(encoding="utf-8"))):
            if language == "toml" and not (page in GUIDE and CASE_NAME.match(text)):
                excerpts[f"{page.stem}-{number}"] = text
    return excerpts


def test_every_excerpt_of_a_case_file_is_valid(tmp_path):
    """Every excerpt is a valid case file for each verb that reads one of its sections."""
    # An excerpt of the chapter *identify* names this record.
    time = np.arange(0.0, 0.05, 1e-4)
    columns = np.column_stack([time, np.sin(500 * time)])
    np.savetxt(tmp_path / "hammer.csv", columns, delimiter=",", header="t,a3", comments="")
    for place, text in sections().items():
        (tmp_path / "case.toml").write_text(text, encoding="utf-8")
        assert load_every(tmp_path / "case.toml"), place
