"""Libraries that commands load: those whose import takes long are loaded only by the verbs that need them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from vipetsc.__main__ import LOOKING
from vipetsc.cli.verbs.verb_list import VERBS

pytestmark = pytest.mark.parallel(1)

# The import of each of these takes a tenth of a second or more.
HEAVY = {
    "h5py",
    "matplotlib",
    "mpi4py.MPI",
    "numba",
    "pandas",
    "petsc4py.PETSc",
    "scipy.interpolate",
    "scipy.optimize",
    "xarray",
}
CASE = Path("runs/examples/three-mass.toml")
# It begins with a mode, whose frequency comes from counts of eigenvalues.
BOUNCE = CASE.with_name("bounce.toml")

# One process calls several commands, and reports the loaded modules after each of them.
REPORT = """
import json, sys
from tests.coarse import coarse_pictures
from vipetsc.__main__ import main

# PETSc takes a name that begins with a dash for an option.
commands = json.loads(sys.argv[1])
sys.argv[0] = "vipetsc"
for command in commands:
    if command[0] == "plot":
        # The look of a picture does not matter here.
        coarse_pictures(setattr)
    try:
        code = main(command)
    except SystemExit as end:
        code = end.code
    print("ended:", code, *sys.modules)
"""


def loaded_by(*commands: tuple[object, ...]) -> list[set[str]]:
    """The libraries of ``HEAVY`` that one process has loaded after each of its commands, which must end with 0."""
    words = json.dumps([list(map(str, command)) for command in commands])
    ended = subprocess.run([sys.executable, "-c", REPORT, words], capture_output=True, text=True, check=True)
    lines = [line.split() for line in ended.stdout.splitlines() if line.startswith("ended: ")]
    assert [line[1] for line in lines] == ["0"] * len(commands), ended.stderr
    return [HEAVY & {*line[2:]} for line in lines]


def test_verbs_that_compute_nothing_load_none_of_them_and_checks_and_bands_no_kernels(tmp_path, monkeypatch):
    """Help, schema, manual and examples load none of the libraries, ``validate`` at most scipy.optimize.

    None of them starts MPI or PETSc. A search refines the bands. ``validate`` estimates the cost of a run from its
    steps, without the engines' kernels, which ``bands`` does not load either.
    """
    # Matplotlib reads this variable at its import. A backend that it does not know has no effect.
    monkeypatch.setenv("MPLBACKEND", "foo")
    nothing = [("--help",), ("sweep", "--help"), ("schema",), ("manual", "contacts"), ("examples",)]
    loaded = loaded_by(*nothing, ("validate", CASE), ("validate", BOUNCE), ("bands", CASE, "--out", tmp_path))
    assert loaded[:5] == [set()] * 5
    assert loaded[5] | loaded[6] <= {"scipy.optimize"}
    # The module that draws bands also draws runs, and must not load kernels.
    assert "numba" not in loaded[7]
    assert (tmp_path / "bands.png").exists()


def test_what_one_process_answers_are_verbs_and_a_flag():
    assert set(LOOKING) == {"--version", *VERBS} & set(LOOKING)


def test_a_run_without_pictures_loads_no_pictures_and_its_pictures_load_no_kernels(tmp_path):
    """A run without pictures does not load matplotlib, and ``plot`` does not load numba."""
    small = ("--set", "time.end=0.01", "--set", "output.figures=false")
    (loaded,) = loaded_by(("run", CASE, "--out", tmp_path / "run", *small))
    assert "matplotlib" not in loaded
    (loaded,) = loaded_by(("plot", tmp_path / "run"))
    assert "numba" not in loaded


def test_figures_load_neither_kernels_nor_mpi():
    """The registry of figures loads matplotlib, but neither numba nor MPI nor PETSc."""
    program = "import sys, vipetsc.figures.registry; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert "matplotlib" in loaded
    assert not {"numba", "mpi4py", "petsc4py"} & {*loaded}
