"""Imports point down the house, in no circle, and the lower floors know neither PETSc nor MPI."""

import ast
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import vipetsc

ROOT = Path(vipetsc.__file__).parent
# From the top floor down: a part may import itself and what stands after it.
FLOORS = (
    "__main__",
    "cli",
    "paper",
    "studies",
    "figures",
    "modes",
    "dynamics",
    "contact",
    "spectra",
    "case",
    "io",
    "lattice",
    "parallel",
    "compiled",
    "__init__",
)
SERIAL = ("lattice", "spectra", "figures")
FORBIDDEN = {"petsc4py", "slepc4py", "mpi4py"}


def module_of(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


MODULES = {module_of(path): path for path in sorted(ROOT.rglob("*.py"))}


def imported(path):
    """Every name that a file imports: inside functions and for type checkers too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner.removeprefix("vipetsc.") in MODULES else node.module


def arrows(module):
    """The modules of the package that ``module`` imports."""
    found = set()
    for name in imported(MODULES[module]):
        if name == "vipetsc":
            found.add("__init__")
        elif name.startswith("vipetsc."):
            found.add(name.removeprefix("vipetsc."))
    return {name for name in found if name in MODULES and name != module}


def floor(module):
    return FLOORS.index(module.split(".")[0])


def test_every_part_has_its_floor():
    assert {module.split(".")[0] for module in MODULES} == set(FLOORS)


@pytest.mark.slow
def test_imports_point_down():
    upward = {f"{m} -> {other}" for m in MODULES for other in arrows(m) if floor(other) < floor(m)}
    assert upward == set()


@pytest.mark.slow
def test_no_circle():
    try:
        order = tuple(TopologicalSorter({m: arrows(m) for m in MODULES}).static_order())
    except CycleError as error:
        pytest.fail(f"circle: {' <- '.join(error.args[1])}")
    assert len(order) == len(MODULES)


def room(module):
    """A folder within a part, such as dynamics.ts, with all its modules; other modules stand for themselves.

    Parts as wholes have no circle: arrows between them point down.
    """
    parts = module.split(".")
    inner = ROOT.joinpath(*parts[:2]).is_dir()
    return ".".join(parts[:2]) if inner else module


def test_no_circle_between_folders():
    """A folder is imported as a whole: two modules of it may not lie above and below a third one outside."""
    rooms = {}
    for module in MODULES:
        rooms.setdefault(room(module), set()).update(room(other) for other in arrows(module))
    assert {"dynamics.ts", "dynamics.propagator"} <= rooms.keys()
    try:
        TopologicalSorter({name: others - {name} for name, others in rooms.items()}).prepare()
    except CycleError as error:
        pytest.fail(f"circle of folders: {' <- '.join(error.args[1])}")


@pytest.mark.parametrize("part", SERIAL)
def test_sources_name_neither_petsc_nor_mpi(part):
    for module, path in MODULES.items():
        if module.split(".")[0] == part:
            assert not FORBIDDEN & {name.split(".")[0] for name in imported(path)}, path


@pytest.mark.slow
def test_importing_them_loads_neither_petsc_nor_mpi():
    modules = [f"vipetsc.{module}" for module in MODULES if module.split(".")[0] in SERIAL]
    assert len(modules) > 15
    code = f"import sys, importlib\nfor m in {modules!r}: importlib.import_module(m)\n"
    code += "print(*sorted({'petsc4py', 'slepc4py', 'mpi4py'} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT.parent)
    assert done.stdout.strip() == ""


def test_figures_wait_with_matplotlib():
    code = "import sys, vipetsc.figures; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT.parent)
    assert done.stdout.strip() == "False"


@pytest.mark.slow
def test_no_function_hides_a_module():
    """What a package hands out has no name of one of its modules: importing the module would replace it."""
    code = f"""
import importlib, inspect, petsc4py
petsc4py.init([])
modules = [f"vipetsc.{{m}}" for m in {sorted(m for m in MODULES if not m.startswith("__"))!r}]
for module in modules:
    importlib.import_module(module)
for module in modules:
    parent, _, name = module.rpartition(".")
    found = vars(importlib.import_module(parent))[name]
    assert inspect.ismodule(found), (module, found)
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT.parent)
