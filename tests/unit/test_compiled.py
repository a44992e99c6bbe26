"""Compiled kernels are kept until their sources change; importing the package changes nothing outside."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numba
import numpy as np
import pytest

import vipetsc
from vipetsc import compiled, kernel, kernel_cache, lowering, process
from vipetsc.dynamics.ts.right_hand_side import compile_callback
from vipetsc.process import cache_folder

ROOT = Path(vipetsc.__file__).parent
CONSTANTS = """
from pathlib import Path
SCALE = 2.0
SHIFT = float(Path(__file__).with_suffix(".csv").read_text())
"""
INNER = """
from vipetsc.compiled import njit
from vipetsc.constants import SCALE
@njit('f8(f8)', error_model="numpy")
def scaled(x):
    return SCALE * x
"""
OUTER = """
from vipetsc.compiled import cfunc, njit
from vipetsc.constants import SHIFT
from vipetsc.inner import scaled
@njit
def twice(x):
    return scaled(scaled(x))
@cfunc("f8(f8)")
def callback(x):
    return scaled(x) + SHIFT
"""
ASK = """
import json, os, sys, numba
environment, folder = dict(os.environ), numba.config.CACHE_DIR
from vipetsc.outer import callback, scaled, twice
values = [twice(3.0), callback.ctypes(3.0)]
hits = [sum(scaled.stats.cache_hits.values()), sum(twice.entry.stats.cache_hits.values()), callback.cache_hits]
print(json.dumps([values, hits, environment == dict(os.environ) and folder == numba.config.CACHE_DIR]))
"""

# Loading numba takes most of the time of a process that runs ASK, hence one process loads it and forks for each run.
SERVER = f"""
import os, sys, numba
sys.dont_write_bytecode = True  # files change within the second by which Python tells versions of them apart
numba.njit(lambda x: x)(1.0)
for folder in sys.stdin:
    if os.fork():
        os.wait()
        continue
    os.chdir(folder.strip())
    sys.path.insert(0, folder.strip())
    exec({ASK!r})
    sys.stdout.flush()
    os._exit(0)
"""


@pytest.fixture
def ask(package, tmp_path):
    """Return a function that imports the package in a fork of a Python process that has loaded numba alone.

    It returns values of the kernels, their cache hits, and whether the import changed nothing outside.
    """
    with subprocess.Popen(
        [sys.executable, "-c", SERVER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment_of(tmp_path),
    ) as server:

        def put(parent: Path = tmp_path) -> list:
            server.stdin.write(f"{parent}\n")
            server.stdin.flush()
            return json.loads(server.stdout.readline())

        yield put
        server.stdin.close()


@pytest.fixture
def package(tmp_path):
    """Return the folder of a package with kernels in two files."""
    folder = tmp_path / "vipetsc"
    folder.mkdir()
    (folder / "__init__.py").write_text("")

    # A constant, and a table from which one is read: both are frozen into compiled code.
    (folder / "constants.py").write_text(CONSTANTS)
    (folder / "constants.csv").write_text("1.0")
    (folder / "inner.py").write_text(INNER)
    (folder / "outer.py").write_text(OUTER)
    (folder / "plain.py").write_text("import numpy\n")
    shutil.copy(compiled.__file__, folder)
    shutil.copy(kernel.__file__, folder)
    shutil.copy(kernel_cache.__file__, folder)
    shutil.copy(lowering.__file__, folder)
    shutil.copy(process.__file__, folder)

    return folder


def environment_of(folder: Path) -> dict[str, str]:
    """Return the environment of a process that imports the package in ``folder``, with the user's cache there, too."""
    return {"PYTHONPATH": ".", "XDG_CACHE_HOME": str(folder / "of-user")}


@pytest.mark.slow
def test_kernels_are_found_again_until_their_sources_change(package, ask, tmp_path):
    """A kernel is loaded from the cache until its file, a file that it calls or a constant that it uses changes.

    The three hits are of the kernel in ``inner``, of the kernel in ``outer`` that calls it, and of the callback.
    """
    folder = package
    assert ask() == [[12.0, 7.0], [0, 0, 0], True]

    # A file without kernels does not matter.
    (folder / "plain.py").write_text("import scipy\n")
    assert ask() == [[12.0, 7.0], [1, 1, 1], True]

    # A change of a kernel that others call compiles all of them.
    (folder / "inner.py").write_text(INNER.replace("SCALE * x", "SCALE * x + 1.0"))
    assert ask() == [[15.0, 8.0], [0, 0, 0], True]

    # A change of a file whose kernels no other file calls compiles that file alone.
    (folder / "outer.py").write_text(OUTER.replace("+ SHIFT", "+ SHIFT + 0.0"))
    assert ask() == [[15.0, 8.0], [1, 0, 0], True]
    (folder / "constants.py").write_text(CONSTANTS.replace("2.0", "3.0"))
    assert ask() == [[31.0, 11.0], [0, 0, 0], True]
    (folder / "constants.csv").write_text("2.0")
    assert ask() == [[31.0, 12.0], [0, 0, 0], True]

    # Four versions of inner.py, and five of outer.py.
    assert len(list(tmp_path.glob("of-user/vipetsc/kernels-*"))) == 4 + 5

    # An equal package elsewhere, whose files have other times, finds the same kernels.
    shutil.copytree(folder, tmp_path / "elsewhere" / "vipetsc", copy_function=shutil.copyfile)
    assert ask(tmp_path / "elsewhere") == [[31.0, 12.0], [1, 1, 1], True]


MAKING = """
import sys
import numpy as np
from vipetsc.compiled import njit
@njit
def total(n):
    return np.arange(n).sum()
print(total(4), "numba.np.arrayobj" in sys.modules)
"""


@pytest.mark.slow
def test_a_kernel_is_loaded_without_the_modules_that_compile_it(package, tmp_path):
    """Numba's module for arrays is loaded where a kernel that makes one is compiled, but not where it is found."""
    (package / "making.py").write_text(MAKING)

    def ran() -> str:
        code = [sys.executable, "-c", "import vipetsc.making"]
        done = subprocess.run(code, cwd=tmp_path, env=environment_of(tmp_path), capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    assert [ran(), ran()] == ["6 True", "6 False"]


def test_environments_that_code_reads_are_stored():
    """Of the functions that are linked into a kernel, one that handles Python objects keeps its environment."""

    @numba.njit
    def show(values):
        print(values)

    @numba.njit
    def total(n):
        values = np.arange(n)
        show(values)
        return values.sum()

    assert total(4) == 6
    (code,) = total.overloads.values()
    stored = compiled._MachineCode(total.py_func).reduce(code)
    names = {environment.env_name for environment in stored[-1]}
    (shown,) = show.overloads.values()
    assert names == {code.environment.env_name, shown.environment.env_name}


def test_a_kernel_is_translated_only_where_python_calls_it():
    """A kernel that another kernel calls has no entry for Python until Python calls it."""
    double = kernel.Kernel(lambda x: 2.0 * x, numba.njit, {})
    quadruple = kernel.Kernel(lambda x: double(double(x)), numba.njit, {})
    assert quadruple(3.0) == 12.0

    # ``double`` is compiled into its caller: it has neither machine code of its own nor an entry for Python.
    (found,) = double.overloads.values()
    assert not found.library.codegen._engine.is_symbol_defined(found.fndesc.llvm_func_name)
    assert "entry" not in vars(double)

    # Python calls the same function, by names of its arguments too.
    assert double(x=3.0) == 6.0


def test_kernels_may_be_kept_in_a_chosen_folder(package, tmp_path):
    file = package / "outer.py"
    chosen = kernel_cache.kernel_cache(package, file, str(tmp_path / "chosen"))
    assert chosen == tmp_path / "chosen" / kernel_cache.kernel_cache(package, file).name


@pytest.fixture
def forgotten():
    """Clear the caches of functions that choose a folder for kernels, before and after a test with other folders."""
    functions = (kernel_cache.kernel_cache, kernel_cache.can_keep, kernel_cache.obstacle, kernel_cache.remove_oldest)
    for function in functions:
        function.cache_clear()
    yield
    for function in functions:
        function.cache_clear()


@pytest.mark.usefixtures("forgotten")
def test_kernels_are_in_the_users_cache_or_else_in_the_package(package, tmp_path, monkeypatch):
    """Kernels are in the user's cache, as modes of lattices are, or in the package if that cache cannot be written."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "of-user"))
    kernels = kernel_cache.kernel_cache(package, package / "outer.py")
    assert kernels.parent == cache_folder() == tmp_path / "of-user" / "vipetsc"

    monkeypatch.setenv("XDG_CACHE_HOME", "/proc")
    kernel_cache.kernel_cache.cache_clear()
    assert kernel_cache.kernel_cache(package, package / "outer.py") == package / "__pycache__" / kernels.name


@pytest.mark.usefixtures("forgotten")
def test_kernels_that_were_used_longest_ago_make_room(tmp_path, monkeypatch):
    """Beyond the largest size the folders unused for the longest time are removed."""
    monkeypatch.setattr(kernel_cache, "LARGEST", 250)
    for age in range(4):
        folder = tmp_path / f"kernels-{age}"
        folder.mkdir()
        (folder / "code").write_bytes(bytes(100))
        when = time.time() - 2 * kernel_cache.DAY * (age + 1)
        os.utime(folder, (when, when))

    # One of the folders is used again.
    kernel_cache.note_use(tmp_path / "kernels-2")
    kernel_cache.remove_oldest(tmp_path)
    assert {folder.name for folder in tmp_path.iterdir()} == {"kernels-0", "kernels-2"}


def test_tables_of_numbers_come_with_the_package():
    """All tables and examples of the package are among the files that its installation copies."""
    project = tomllib.loads((ROOT.parent / "pyproject.toml").read_text())
    declared = project["tool"]["setuptools"]["package-data"]
    shipped = {path for package in ("vipetsc", "vipetsc.modes.shooting") for pattern in declared[package]
               for path in ROOT.joinpath(*package.split(".")[1:]).glob(pattern)}  # fmt: skip
    assert set(ROOT.rglob("*.csv")) <= shipped
    assert {path for path in (ROOT / "examples").glob("*.*") if path.is_file()} <= shipped


def test_importing_the_package_changes_no_environment():
    code = """
import os
import sys
before = dict(os.environ)
import vipetsc
assert before == dict(os.environ)
assert not {"numba", "petsc4py", "mpi4py"} & sys.modules.keys()
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT.parent)


def test_every_kernel_is_kept_so():
    """No module but ``compiled`` uses numba's own decorators, whose cache does not follow called kernels."""
    for path in ROOT.rglob("*.py"):
        if path.name == "compiled.py":
            continue
        # Numba's own decorators would keep kernels by their files alone.
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"from numba import .*jit|numba\.(n?jit|cfunc)\b", text), path


@pytest.mark.slow
def test_the_callback_of_petsc_is_found_again():
    compile_callback()
    code = "from vipetsc.dynamics.ts.right_hand_side import compile_callback; print(compile_callback().cache_hits)"
    assert int(subprocess.check_output([sys.executable, "-c", code], cwd=ROOT.parent)) == 1


def test_a_cache_that_cannot_be_written_is_named_once(caplog, monkeypatch):
    folder = Path("/proc/no-folder")
    kernel_cache.can_keep.cache_clear()
    for _ in range(2):
        assert not kernel_cache.can_keep(folder)
    (record,) = caplog.records
    assert f"compiling kernels at every start; the cache {folder} cannot be written" in record.getMessage()

    # Rank 1 is silent, since rank 0 says it for all.
    kernel_cache.can_keep.cache_clear()
    monkeypatch.setenv("OMPI_COMM_WORLD_RANK", "1")
    assert not kernel_cache.can_keep(folder)
    assert len(caplog.records) == 1
    kernel_cache.can_keep.cache_clear()


@pytest.mark.slow
@pytest.mark.usefixtures("package")
def test_kernels_work_without_a_cache(tmp_path):
    environment = environment_of(tmp_path) | {"NUMBA_CACHE_DIR": "/proc/no-folder"}
    done = subprocess.run([sys.executable, "-c", ASK], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)[0] == [12.0, 7.0]
    assert done.stderr.count("cannot be written") == 1
    assert not list(tmp_path.rglob("kernels-*"))


@pytest.mark.slow
def test_that_kernels_are_compiled_is_said_once(package, tmp_path):
    """The first process reports the compiling in one line, on rank 0 alone; the next finds the kernels, silently."""

    def say(**environment: str) -> list[str]:
        environment = environment_of(tmp_path) | environment
        done = subprocess.run(
            [sys.executable, "-c", ASK], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stderr.splitlines()

    assert say(OMPI_COMM_WORLD_RANK="1", NUMBA_CACHE_DIR=str(tmp_path / "other")) == []
    assert say(OMPI_COMM_WORLD_RANK="0") == ["vipetsc: compiling kernels (once, about 20 s)"]
    assert say() == []


@pytest.mark.slow
def test_compiling_is_timed(package, tmp_path):
    """The clock runs where a first call compiles, and stands still where it finds the kernel."""
    code = """
from vipetsc.outer import twice
from vipetsc.process import compiling
before = compiling.seconds
twice(3.0)
print(compiling.seconds > before)
"""

    def ran() -> str:
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, env=environment_of(tmp_path), capture_output=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.decode().strip()

    assert [ran(), ran()] == ["True", "False"]


def test_options_of_compilations_are_compared():
    """Functions are compiled again for other options, and found again for equal ones."""
    numpy, equal, python = (kernel._Flags() for _ in range(3))
    numpy.error_model = "numpy"
    equal.error_model = "numpy"
    python.error_model = "python"
    assert numpy == equal
    assert hash(numpy) == hash(equal)
    assert numpy != python
    assert numpy != kernel._Flags()
