"""An elastic law that the manual's chapter *extend* adds is the same in every room that asks for a contact's force.

The chapter's blocks are applied to a copy of the package, whose kernels are compiled anew. In the copy, hardening stops
F = k x (1 + b x^2) are compared with formulas written out here.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import vipetsc
from tests.conftest import clean_environment

# All of them wait for a copy of the package, whose kernels are compiled with the changed law.
pytestmark = [pytest.mark.parallel(1), pytest.mark.slow]
PACKAGE = Path(vipetsc.__file__).parent
SCRIPT = Path(__file__).with_name("another_law.py")


def apply_chapter(package: Path) -> int:
    """Make the changes of the chapter's ``diff`` blocks in the files of ``package``; returns how many there are."""
    text = (package / "manual/extend.md").read_text(encoding="utf-8")
    section = text[text.index("**Another elastic force**") : text.index("A force that depends on more")]
    path = None
    count = 0
    for name, block in re.findall(r"[Ii]n `vipetsc/([\w/]+\.py)`|```diff\n(.*?)```", section, flags=re.DOTALL):
        if name:
            path = package / name
            continue

        # Lines of a block begin with a blank, a minus or a plus.
        lines = block.splitlines(keepends=True)
        before = "".join(line[1:] for line in lines if line[0] in " -")
        after = "".join(line[1:] for line in lines if line[0] in " +")
        source = path.read_text(encoding="utf-8")
        assert source.count(before) == 1, f"{path.name} does not have once:\n{before}"
        path.write_text(source.replace(before, after), encoding="utf-8")
        count += 1
    return count


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> dict:
    """What the script finds in a copy of the package with the chapter's law."""
    folder = tmp_path_factory.mktemp("another-law")
    shutil.copytree(PACKAGE, folder / "vipetsc", ignore=shutil.ignore_patterns("__pycache__"))
    assert apply_chapter(folder / "vipetsc") == 10

    # Kernels are small here: what optimisation costs is more than it brings.
    environment = clean_environment() | {"PYTHONPATH": str(folder), "NUMBA_OPT": "1"}
    ended = subprocess.run(
        [sys.executable, str(SCRIPT)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return json.loads((folder / "found.json").read_text())


def test_the_law_on_arrays_and_its_compiled_twin_are_the_formula(found):
    assert found["twins"] == pytest.approx(0, abs=1e-12)
    assert found["duration"] == pytest.approx(0, abs=1e-7)


def test_both_engines_follow_the_same_trajectory(found):
    assert found["episodes"][0] == found["episodes"][1] > 4
    assert found["engines"] < 1e-6
    assert max(found["ledgers"]) < 1e-7
    # The run differs from that with a linear stop of the same stiffness.
    assert found["hardens"] > 1e-3


# Harmonics that the condensed method leaves out are 1e-4 of the motion.
@pytest.mark.parametrize(("method", "error"), [("shooting", 1e-8), ("condensed", 1e-5)])
def test_normal_modes_have_the_period_of_the_energy_integral(found, method, error):
    assert found["reached"][method] > 0.5
    assert found["periods"][method] < error


def test_a_steady_state_is_a_periodic_orbit(found):
    assert found["steady_hardens"] > 0.01
    assert found["steady"] < 1e-3
