"""The report of ``doctor`` on machines on which the program cannot work, and on ones with untested versions."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import tomllib
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import clean_environment
from vipetsc.cli import installation
from vipetsc.cli.installation import (
    BLAS_LIBRARY,
    MPI_LIBRARY,
    PACKAGES,
    Package,
    check_blas,
    check_mpi,
    check_package,
    check_scalars,
    loaded_libraries,
)
from vipetsc.cli.verbs.doctor_verb import doctor_table
from vipetsc.studies import first_calls

ROOT = Path(__file__).parents[2]
NAMED = {package.name: package for package in PACKAGES}


@pytest.fixture
def version_of(monkeypatch):
    """Let a package have another version: ``version_of("scipy", "1.9.3")``; None takes it away."""

    def put(name: str, version: str | None) -> None:
        module = NAMED[name].module or name
        if version is None:
            # With None in its place Python refuses to import the module.
            monkeypatch.setitem(sys.modules, module, None)
        else:
            monkeypatch.setattr(importlib.import_module(module), "__version__", version)

    return put


def test_versions_that_are_too_old_are_faults_and_untried_ones_notes(version_of):
    """A fault names the oldest version and the command that brings it; a version after the latest tested has a note."""
    for name, version, remedy in (
        ("petsc4py", "3.17.4", "scripts/recipes/pip"),
        ("scipy", "1.9.3", "pip install 'scipy>=1.10'"),
        ("tomli-w", "0.4.0", "pip install 'tomli-w>=1.0'"),
    ):
        version_of(name, version)
        check = check_package(NAMED[name])
        assert check.value == version
        assert f"version {NAMED[name].oldest} or later" in check.fault
        assert remedy in check.fault

    version_of("petsc4py", "3.27.0")
    check = check_package(NAMED["petsc4py"])
    assert not check.fault
    assert "newer than 3.26" in check.note
    # A patch or a candidate of the latest tested version, and the oldest version, bring no note.
    for version in ("3.26.9", "3.18.5", "3.26.0rc1"):
        version_of("petsc4py", version)
        assert check_package(NAMED["petsc4py"]).text == version


def test_doctor_ends_with_2_where_the_program_cannot_work(in_process, version_of):
    """One package is too old and one is missing: both are named in the last line, and the exit code is 2."""
    version_of("xarray", "2024.9.0")
    version_of("tqdm", None)
    ended = in_process("doctor")
    assert ended.returncode == 2
    assert "2024.9.0; FAULT: too old" in ended.stdout
    assert "FAULT: missing" in ended.stdout
    assert ended.stdout.endswith(": tqdm, xarray on rank 0\n")


@pytest.mark.parametrize(
    ("package", "command"),
    [
        ("cma", ("optimise", ROOT / "vipetsc/examples/optimise-clearances.toml", "--out", "out")),
        ("pymoo", ("optimise", ROOT / "vipetsc/examples/optimise-gate.toml", "--out", "out")),
        ("jinja2", ("paper", "--quick", "--out", "out")),
        ("shtab", ("completion", "bash")),
    ],
)
def test_a_package_that_one_verb_needs_is_no_fault(in_process, version_of, tmp_path, package, command):
    """Without it that verb ends with one sentence, before it writes anything; ``doctor`` has a note."""
    version_of(package, None)
    assert check_package(NAMED[package]).note and not check_package(NAMED[package]).fault

    ended = in_process(*command, cwd=tmp_path)
    assert ended.returncode == 2
    assert f"pip install '{package}>=" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert not any(tmp_path.iterdir())


def test_a_package_that_was_built_for_another_numpy(tmp_path, monkeypatch):
    """A package whose import raises anything is a fault with the reason: pandas raises a ValueError for its numpy."""
    (tmp_path / "built_for_another_numpy.py").write_text('raise ValueError("numpy.dtype size changed")')
    monkeypatch.syspath_prepend(tmp_path)
    check = check_package(Package("frames", "1.0", "2.0", module="built_for_another_numpy"))
    assert check.fault == "does not load (numpy.dtype size changed): pip install 'frames>=1.0'"


def test_libraries_of_which_there_must_be_one_kind():
    """Scalars that are no real doubles, two MPIs, and a launcher of another MPI are faults; a slow BLAS has a note."""
    for scalar in (np.complex128, np.float32):
        check = check_scalars(scalar)
        assert check.value == np.dtype(scalar).name
        assert "--with-scalar-type=real" in check.fault and "--with-precision=double" in check.fault

    # petsc4py and mpi4py of different builds crash at a common call.
    ours = loaded_libraries(MPI_LIBRARY)
    other = "/opt/mpich/lib/libmpi.so.12"
    assert len(ours) == 1
    assert not check_mpi(ours, 2, {"OMPI_COMM_WORLD_SIZE": "2"}).fault
    two = check_mpi([*ours, other], 1, {})
    assert "different MPIs" in two.fault
    assert ours[0] in two.value and other in two.value
    # Each of the processes would write the same files.
    for launcher in ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE"):
        assert "started 4 processes, but mpi4py sees 1" in check_mpi([], 1, {launcher: "4"}).fault

    slow = check_blas(["/usr/lib/x86_64-linux-gnu/blas/libblas.so.3.11.0"])
    assert "libopenblas0-serial" in slow.note and not slow.fault
    for library in (
        "/usr/lib/x86_64-linux-gnu/openblas-serial/libopenblas-r0.3.21.so",
        "/opt/numpy.libs/libscipy_openblas64_-8fb3d286.so",
    ):
        assert BLAS_LIBRARY.fullmatch(library)
        assert check_blas([library]) == ("BLAS", library, "", "")
    # This machine has a BLAS library of its own, or the one within numpy.
    assert loaded_libraries(BLAS_LIBRARY) or check_blas([]).value == "within numpy"


@pytest.mark.parametrize(("missing", "named"), [("slepc4py", "python3-slepc4py"), ("mpirun", "mpirun")])
def test_what_the_program_can_do_without_is_no_fault(monkeypatch, missing, named):
    """Without SLEPc or mpirun the installation is healthy, and the report names what is missing."""
    monkeypatch.setitem(sys.modules, "slepc4py", None)
    monkeypatch.setattr(installation.shutil, "which", lambda name: None)
    text, healthy = doctor_table(MPI.COMM_SELF)
    assert healthy
    assert named in text


def test_the_oldest_versions_are_those_of_the_package():
    """The oldest versions that the doctor takes are the bounds of pyproject.toml, which lists them for pip."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    for verb in ("", "optimise", "paper", "completion"):
        lines = extras[verb] if verb else project["dependencies"]
        wanted = {line.split(",")[0] for line in lines}
        assert {f"{package.name}>={package.oldest}" for package in PACKAGES if package.verb == verb} == wanted


def test_a_library_that_does_not_load_is_named():
    """A library that is needed before ``doctor`` can be called, here pydantic, is named without a traceback."""
    code = (
        # The code runs in a process of its own, because this one has imported every library.
        "import sys; sys.argv = ['vipetsc']; sys.modules['pydantic'] = None;"
        " from vipetsc.__main__ import main; sys.exit(main(['doctor']))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert "pydantic" in ended.stderr and "chapter install" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_doctor_compiles_kernels_where_it_is_asked_to(in_process, monkeypatch):
    """With --compile the kernels are called; without it nothing is compiled."""
    # The compilation takes minutes: a function that notes its calls replaces it.
    calls = []
    monkeypatch.setattr(first_calls, "compile_kernels", calls.append)
    assert "kernels" not in in_process("doctor").stdout
    assert calls == []

    ended = in_process("doctor", "--compile")
    assert ended.returncode == 0
    assert ended.stdout.splitlines()[-1].startswith("kernels of runs, modes and measures: compiled")
    assert len(calls) == 1


# Commands in one new process, which then prints the kernels that Python called, each with the types of its arguments.
CALLED = """
import json, sys
from vipetsc.__main__ import main

commands = json.loads(sys.argv[1])
# PETSc takes a name that begins with a dash for an option.
sys.argv = ["vipetsc"]
for command in commands:
    assert main(command) == 0

called = set()
for name, module in list(sys.modules.items()):
    if name.startswith("vipetsc."):
        for item in vars(module).values():
            if hasattr(item, "py_func") and hasattr(item, "signatures"):
                called |= {f"{item.py_func.__qualname__}{types}" for types in item.signatures}
print(json.dumps(sorted(called)))
"""


def kernels_called_by(*commands: list[str]) -> set[str]:
    words = [sys.executable, "-c", CALLED, json.dumps(commands)]
    ended = subprocess.run(words, capture_output=True, text=True, check=False, env=clean_environment())
    assert ended.returncode == 0, ended.stderr
    return set(json.loads(ended.stdout.splitlines()[-1]))


@pytest.mark.slow
def test_after_that_a_run_compiles_nothing(tmp_path):
    """``doctor --compile`` calls every kernel that runs by both engines, and their measures, call.

    The two are compared by what they call: what other tests have compiled is kept, and would hide a kernel.
    """
    small = ("lattice.cells=40", "contacts.sites=[6]", "time.end=0.02", "output.figures=false")
    runs = []
    for engine in ("ts", "propagator"):
        changes = [word for change in (*small, f"time.engine={engine}") for word in ("--set", change)]
        runs.append(["run", *changes, "--out", str(tmp_path / engine)])

    # First, so that the runs find all kernels: a kernel that is compiled lists also those that it calls itself.
    compiled = kernels_called_by(["doctor", "--compile"])
    called = kernels_called_by(*runs)
    assert len(called) >= 5
    assert called - compiled == set()
