"""What a command loads before it answers: libraries that take long are loaded by the verbs that need them alone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.parallel(1)

# Each takes a tenth of a second or more.
HEAVY = {"matplotlib", "numba", "pandas", "scipy.interpolate", "scipy.optimize", "xarray"}
CASE = Path("runs/examples/three-mass.toml")

REPORT = f"""
import sys
from vipetsc.__main__ import main

try:
    main(sys.argv[1:])
finally:
    print("loaded:", *sorted({HEAVY!r} & sys.modules.keys()))
"""


def loaded_by(*arguments: object) -> set[str]:
    """The heavy libraries that a command has loaded at its end."""
    words = [sys.executable, "-c", REPORT, *map(str, arguments)]
    ended = subprocess.run(words, capture_output=True, text=True, check=True)
    return set(ended.stdout.splitlines()[-1].split()[1:])


@pytest.mark.parametrize("arguments", [("--help",), ("sweep", "--help"), ("schema",), ("manual", "contacts")])
def test_a_verb_that_computes_nothing_loads_none_of_them(arguments):
    assert not loaded_by(*arguments)


def test_bands_are_refined_by_a_search_alone():
    assert loaded_by("bands") <= {"scipy.optimize"}


def test_a_check_loads_no_tables_no_pictures_and_no_kernels():
    """The cost of a run follows from the length of its steps, which is chosen without its engine."""
    assert loaded_by("validate", CASE) <= {"scipy.optimize"}


def test_a_run_without_pictures_loads_no_pictures_and_its_pictures_load_no_kernels(tmp_path):
    small = ("--set", "time.end=0.01", "--set", "output.figures=false")
    assert "matplotlib" not in loaded_by("run", CASE, "--out", tmp_path / "run", *small)
    assert "numba" not in loaded_by("plot", tmp_path / "run")


def test_the_second_process_loads_neither_kernels_nor_mpi():
    """A copy of the program next to a run, that draws its pictures."""
    program = "import sys, vipetsc.figures.draw_requests, vipetsc.figures.registry; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert "matplotlib" in loaded
    assert not {"numba", "mpi4py", "petsc4py"} & {*loaded}
