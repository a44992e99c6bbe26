"""The guide in the README does what it says: its blocks are run as they stand."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import h5py
import pytest

import vipetsc as package
from tests.conftest import clean_environment
from vipetsc.case import Case, Sweep
from vipetsc.case.nnm import NnmCase
from vipetsc.modes.system import System

ROOT = Path(package.__file__).parents[1]
HEADING = "## Your own lattice in ten minutes"


def guide() -> str:
    """The README's first lattice and the manual's chapter that goes on with it."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert readme.count(HEADING) == 1
    first = re.split(r"^## ", readme.split(HEADING)[1], flags=re.M)[0]
    return first + (ROOT / "vipetsc/manual/own-lattice.md").read_text(encoding="utf-8")


def blocks() -> list[tuple[str, str]]:
    """Language and text of every code block of the guide, in order."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", guide(), flags=re.M | re.S)


@pytest.fixture(scope="module")
def desk(tmp_path_factory) -> Path:
    """A folder in which every block was executed, in order; each ended well."""
    folder = tmp_path_factory.mktemp("guide")
    for language, text in blocks():
        if language == "toml":
            name = re.match(r"# (\S+\.toml)(, added)?\n", text)
            with (folder / name[1]).open("a" if name[2] else "w", encoding="utf-8") as file:
                file.write(text)
        elif language == "sh":
            for line in text.splitlines():
                if not line.startswith(". "):  # the environment is this interpreter's
                    call(line, folder)
        else:
            assert language == "python"
            run([sys.executable, "-c", text], folder)
    return folder


def call(line: str, folder: Path) -> None:
    words = [sys.executable if word == "python" else word for word in shlex.split(line, comments=True)]
    run([*words[:1], "--oversubscribe", *words[1:]] if words[0] == "mpirun" else words, folder)


def run(command: list[str], folder: Path) -> None:
    environment = clean_environment() | {"PYTHONPATH": str(ROOT)}
    ended = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert ended.returncode == 0, f"{' '.join(command)}\n{ended.stdout}\n{ended.stderr}"


@pytest.mark.mpirun
def test_the_guide_has_bands_a_run_a_sweep_a_branch_and_python(desk):
    commands = " ".join(text for language, text in blocks() if language == "sh")
    assert {v for v in ("bands", "validate", "run", "sweep", "nnm") if f"vipetsc {v} " in commands} >= {"bands", "nnm"}
    assert (desk / "my-lattice.toml").exists()
    for name in (
        "my-lattice-bands/bands.png",
        "my-lattice/figures/dispersion.png",
        "my-branch/branch-out-of-phase.csv",
    ):
        assert (desk / "runs" / name).stat().st_size > 1000, name


@pytest.mark.mpirun
def test_what_the_guide_says_of_its_lattice_is_so(desk):
    case = Case.load(desk / "my-lattice.toml")
    assert case.drive.frequency == pytest.approx(936, abs=0.5)
    assert case.lattice.unit_cell().dofs == 3
    assert len(Sweep.load(desk / "my-lattice.toml").members()) == 7
    assert System.from_case(NnmCase.load(desk / "my-lattice.toml")).branch_name(1) == "out-of-phase"
    with h5py.File(desk / "runs/my-lattice/run.h5") as file:
        assert len(file["impacts/onset"]) == 71
        assert file["energy/dissipated"][-1] / file["energy/work"][-1] == pytest.approx(1 / 3, abs=0.03)
    with h5py.File(desk / "runs/my-sweep/ensemble.h5") as file:
        ibtet, episodes = file["ibtet"][...], file["contact_episodes"][...]
        quiet = episodes == 0
        assert 1 < quiet.sum() < 7
        assert ibtet[quiet] == pytest.approx(ibtet[0], rel=1e-12)
        assert ibtet.max() > 10 * ibtet[0]
    assert (desk / "runs/my-sweep/figures/ibtet-calibrated.png").exists()
