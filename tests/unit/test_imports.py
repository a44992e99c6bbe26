"""Imports point down, never up, and the lower floors know neither PETSc nor MPI."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import vipetsc

ROOT = Path(vipetsc.__file__).parent
SERIAL = ("lattice", "spectra", "figures", "case", "records", "ensembles", "files", "studies")
FORBIDDEN = {"petsc4py", "mpi4py"}

# What each part of the package may import of the rest, besides itself.
MAY_IMPORT = {
    "lattice": set(),
    "spectra": {"lattice"},
    "case": {"lattice"},
    "records": {"case", "lattice"},
    "ensembles": {"case"},
    "files": set(),
    "figures": {"lattice", "spectra", "case", "records", "ensembles", "files"},
    "dynamics": {"lattice", "case", "records", "files", "store", "parallel"},
    "modes": {"lattice", "case", "store", "parallel", "files"},
    "studies": {
        "lattice",
        "spectra",
        "case",
        "records",
        "ensembles",
        "files",
        "dynamics",
        "modes",
        "figures",
        "store",
        "parallel",
    },
}


def sources(part):
    return sorted((ROOT / part).rglob("*.py")) or [p for p in [ROOT / f"{part}.py"] if p.exists()]


def imported(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("part", SERIAL[:-1])
def test_sources_name_neither_petsc_nor_mpi(part):
    assert sources(part)
    for path in sources(part):
        assert not FORBIDDEN & {name.split(".")[0] for name in imported(path)}, path


@pytest.mark.parametrize("part", MAY_IMPORT)
def test_imports_point_down(part):
    known = {p.stem for p in ROOT.iterdir() if p.is_dir() or p.suffix == ".py"}
    for path in sources(part):
        own = {n.split(".")[1] for n in imported(path) if n.startswith("vipetsc.")} & known
        assert own <= MAY_IMPORT[part] | {part}, path


def test_importing_them_loads_neither_petsc_nor_mpi():
    modules = [
        ".".join(p.relative_to(ROOT.parent).with_suffix("").parts) for part in SERIAL[:-1] for p in sources(part)
    ]
    assert len(modules) > 15
    code = f"import sys, importlib\nfor m in {modules!r}: importlib.import_module(m)\n"
    code += "print(*sorted({'petsc4py', 'mpi4py'} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT.parent)
    assert done.stdout.strip() == ""


def test_figures_wait_with_matplotlib():
    code = "import sys, vipetsc.figures; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT.parent)
    assert done.stdout.strip() == "False"
