"""Compiled code is kept between runs until a source of the package changes, where files can be written."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

import vipetsc
from vipetsc import compiled

ROOT = Path(vipetsc.__file__).parent
CONSTANTS = "SCALE = 2.0\n"
INNER = """
from vipetsc.compiled import kernel
from vipetsc.lattice.constants import SCALE
@kernel
def scaled(x):
    return SCALE * x
"""
OUTER = """
from vipetsc.compiled import cfunc, kernel
from vipetsc.lattice.inner import scaled
@kernel
def twice(x):
    return scaled(scaled(x))
@cfunc("f8(f8)")
def callback(x):
    return scaled(x) + 1.0
"""
ASK = """
from vipetsc.contact.outer import callback, twice
print(twice(3.0), callback.ctypes(3.0), sum(twice.stats.cache_hits.values()), callback.cache_hits)
"""


@pytest.fixture
def small(tmp_path) -> SimpleNamespace:
    """Return a package with kernels in two files: its ``folder``, and ``ask``, which calls them in a new process.

    That gives two values and the numbers of kernels and callbacks that were found in the cache.
    """
    folder = tmp_path / "vipetsc"
    (folder / "lattice").mkdir(parents=True)
    # Python prefers a package with this file, anywhere on its path, to a folder without it.
    (folder / "__init__.py").write_text("")
    for room in compiled.ROOMS:
        (folder / room).mkdir(exist_ok=True)
    (folder / "lattice" / "constants.py").write_text(CONSTANTS)
    (folder / "lattice" / "inner.py").write_text(INNER)
    (folder / "contact" / "outer.py").write_text(OUTER)
    for name in ("compiled.py", "process.py"):
        (folder / name).write_bytes((ROOT / name).read_bytes())

    def ask(**variables: str) -> list[float]:
        process = start(**variables)
        text, errors = process.communicate()
        assert process.returncode == 0, errors
        ask.errors = errors
        return [float(word) for word in text.split()]

    def start(**variables: str) -> subprocess.Popen:
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
        # Without .pyc files, which tell sources that change within a second apart by their size alone.
        environment |= {"PYTHONDONTWRITEBYTECODE": "1"} | variables
        code = [sys.executable, "-c", ASK]
        pipe = subprocess.PIPE
        return subprocess.Popen(code, env=environment, cwd=tmp_path, stdout=pipe, stderr=pipe, text=True)

    return SimpleNamespace(folder=folder, ask=ask, start=start, cache=tmp_path / "cache")


def stored(cache: Path) -> set[Path]:
    """Return the files of compiled code in a ``cache``."""
    return {*cache.rglob("*.nb[ci]")}


def test_code_is_found_again_until_any_source_changes(small):
    """A constant of another file, and a kernel that is called, are compiled into a kernel; old code is removed."""
    assert small.ask() == [12.0, 7.0, 0, 0]
    count = len(stored(small.cache))
    (small.folder / "modes" / "above.py").write_text("")
    assert small.ask() == [12.0, 7.0, 1, 1]

    (small.folder / "lattice" / "constants.py").write_text("SCALE = 3.0 \n")
    assert small.ask() == [27.0, 10.0, 0, 0]
    (small.folder / "lattice" / "inner.py").write_text(INNER.replace("SCALE * x", "SCALE * x + 1.0"))
    assert small.ask() == [31.0, 11.0, 0, 0]
    assert small.ask() == [31.0, 11.0, 1, 1]
    assert len(stored(small.cache)) == count


def test_without_a_writable_cache_code_is_compiled_at_every_start(small):
    """The package is then read-only, and so is the home; one line says so."""
    for room in ("contact", "lattice"):
        (small.folder / room / "__pycache__").write_text("a file, so that no folder can be made here")
    nowhere = {"NUMBA_CACHE_DIR": "", "HOME": "/proc", "XDG_CACHE_HOME": "/proc"}
    for _ in range(2):
        assert small.ask(**nowhere) == [12.0, 7.0, 0, 0]
        assert small.ask.errors.count("NUMBA_CACHE_DIR") == 1


def test_tables_of_numbers_come_with_the_package():
    """All tables and examples of the package are among the files that its installation copies."""
    project = tomllib.loads((ROOT.parent / "pyproject.toml").read_text())
    declared = project["tool"]["setuptools"]["package-data"]
    shipped = {path for package in ("vipetsc", "vipetsc.modes") for pattern in declared[package]
               for path in ROOT.joinpath(*package.split(".")[1:]).glob(pattern)}  # fmt: skip
    assert set(ROOT.rglob("*.csv")) <= shipped
    assert {path for path in (ROOT / "examples").glob("*.*") if path.is_file()} <= shipped


def test_every_kernel_is_kept_so():
    """Kernels lie in rooms whose sources are looked at, and no module but ``compiled`` uses numba's own decorators."""
    for path in ROOT.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if path.name != "compiled.py":
            assert not re.search(r"from numba import .*jit|numba\.(n?jit|cfunc)\b", text), path
        if "from vipetsc.compiled import" in text:
            assert path.relative_to(ROOT).parts[0] in compiled.ROOMS, path
