"""Imports between the parts of the package point down, in no circle, and serial parts load neither PETSc nor MPI."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import vipetsc

ROOT = Path(vipetsc.__file__).parent
# Parts from the top down: a part may import itself and parts after it.
FLOORS = (
    "__main__",
    "cli",
    "paper",
    "studies",
    "figures",
    "identification",
    "modes",
    "dynamics",
    "contact",
    "case",
    "spectra",
    "io",
    "lattice",
    "parallel",
    "compiled",
    "records",
    "plugins",
    "register",
    "progress",
    "sources",
    "process",
    "endings",
    "wording",
    "__init__",
)
SERIAL = ("lattice", "spectra", "figures")
FORBIDDEN = {"petsc4py", "slepc4py", "mpi4py"}


def module_of(path: Path) -> str:
    """Return the name of a file's module below the package; a folder's ``__init__`` has the folder's name."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    if parts[-1] == "__init__" and len(parts) > 1:
        parts = parts[:-1]
    return ".".join(parts)


# Modules of examples stand for a user's modules: cases name them, and the package does not import them.
SOURCES = [path for path in sorted(ROOT.rglob("*.py")) if ROOT / "examples" not in path.parents]
MODULES = {module_of(path): path for path in SOURCES}


# Five tests use the same files, and parsing all of them takes a second.
@cache
def imported(path: Path) -> list[str]:
    """Return every name that a file imports, also inside functions and for type checkers."""
    return [*_imported(path)]


def _imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            for alias in node.names:
                # The imported name may be a module or a name in a module.
                inner = f"{node.module}.{alias.name}"
                is_module = inner.removeprefix("vipetsc.") in MODULES
                yield inner if is_module else node.module


def arrows(module: str) -> set[str]:
    """Return the modules of the package that ``module`` imports."""
    found = set()
    for name in imported(MODULES[module]):
        if name == "vipetsc":
            found.add("__init__")
        elif name.startswith("vipetsc."):
            found.add(name.removeprefix("vipetsc."))
    return {name for name in found if name in MODULES and name != module}


def part(module: str) -> str:
    """Return the part of the package, a name in FLOORS, that a module belongs to."""
    return module.split(".")[0]


def run_python(code: str) -> str:
    """Return the output of a new Python process that runs ``code``."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT.parent)
    return done.stdout.strip()


def test_every_part_has_its_floor():
    """The parts of the package are those in FLOORS."""
    assert {part(module) for module in MODULES} == set(FLOORS)


def test_imports_point_down():
    upward = set()
    for module in MODULES:
        for other in arrows(module):
            if FLOORS.index(part(other)) < FLOORS.index(part(module)):
                upward.add(f"{module} -> {other}")
    assert upward == set()


def test_modules_import_in_no_circle():
    try:
        order = tuple(TopologicalSorter({module: arrows(module) for module in MODULES}).static_order())
    except CycleError as error:
        pytest.fail(f"circle: {' <- '.join(error.args[1])}")
    assert len(order) == len(MODULES)


def room(module: str) -> str:
    """Return the folder of a module within its part, such as dynamics.ts, or the module if there is no such folder.

    Whole parts need not be tested: imports between them point down.
    """
    parts = module.split(".")
    if ROOT.joinpath(*parts[:2]).is_dir():
        return ".".join(parts[:2])
    return module


def test_folders_import_in_no_circle():
    """Folders import each other in no circle: a module outside lies above all modules of a folder or below all."""
    rooms: dict[str, set[str]] = {}
    for module in MODULES:
        rooms.setdefault(room(module), set()).update(map(room, arrows(module)))
    assert {"dynamics.ts", "dynamics.propagator"} <= rooms.keys()

    try:
        TopologicalSorter({name: others - {name} for name, others in rooms.items()}).prepare()
    except CycleError as error:
        pytest.fail(f"circle of folders: {' <- '.join(error.args[1])}")


def test_importing_them_loads_neither_petsc_nor_mpi():
    """Importing all modules of the serial parts loads no PETSc, SLEPc or MPI."""
    modules = [f"vipetsc.{module}" for module in MODULES if part(module) in SERIAL]
    assert len(modules) > 15
    code = f"import sys, importlib\nfor m in {modules!r}: importlib.import_module(m)\n"
    code += f"print(*sorted({FORBIDDEN!r} & sys.modules.keys()))"
    assert run_python(code) == ""
