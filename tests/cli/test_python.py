"""The chapter on Python: its blocks run, its names are there; the front door as help and editors see it."""

from __future__ import annotations

import pydoc
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import vipetsc as package

ROOT = Path(package.__file__).parents[1]
CHAPTER = (ROOT / "vipetsc/manual/python.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", CHAPTER, flags=re.M | re.S)
FRONT = {"Case", "CaseError", "Sweep", "analyse", "open", "simulate", "sweep"}
pytestmark = pytest.mark.parallel(1)


def my_lattice() -> str:
    """Return the case file that the README has a reader save."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return re.search(r"```toml\n(# my-lattice.toml\n.*?)```", text, flags=re.S)[1]


@pytest.mark.slow
@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_every_block_runs(block, tmp_path, monkeypatch, plain_pictures):
    """Each block runs alone, in a folder that holds the README's case."""
    (tmp_path / "my-lattice.toml").write_text(my_lattice(), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "python.md", "exec"), {"__name__": "__main__"})


def test_every_name_is_there():
    """The names of the front door and those of the table are where the chapter says."""
    for name in re.findall(r"`(\w+)`", CHAPTER.partition("\n## ")[0]):
        assert name == "vipetsc" or hasattr(package, name), name

    table = re.findall(r"^\| .* \| (.*) \|$", CHAPTER, flags=re.M)[1:]
    assert len(table) > 3
    for row in table:
        modules = [import_module(name) for name in re.findall(r"\(`(vipetsc[\w.]*)`\)", row)]
        for name in re.findall(r"`(\w+)`", row):
            assert any(hasattr(module, name) for module in [*modules, package]), (row, name)


def test_completion_and_help_show_the_front_door():
    """Names that are loaded late are completed, and help shows each of them with its own text."""
    assert {*dir(package)} >= FRONT
    assert {*package.__all__} >= FRONT

    # From Python 3.13 on the arguments of a long signature stand in lines of their own.
    shown = re.sub(r"\(\n +", "(", pydoc.render_doc(package, renderer=pydoc.plaintext))
    for text in (
        "class Case(",
        "class Sweep(",
        "simulate(case:",
        "sweep = run_sweep(",
        "open = open_results(",
        "analyse(",
    ):
        assert text in shown, text
    # The example of the docstring runs.
    assert "result = simulate(case, progress=True)" in package.__doc__


@pytest.mark.slow
def test_the_example_of_help_runs():
    """The example in the package's docstring runs as it stands, and speaks on stderr of its progress."""
    lines = package.__doc__.partition("    from vipetsc import")[2]
    example = "from vipetsc import" + re.sub(r"\n    ", "\n", lines).partition("\nAll keys")[0]
    command = [sys.executable, "-c", example]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, cwd=ROOT)
    assert ended.returncode == 0, ended.stderr
    assert "complete:" in ended.stdout
    assert re.search(r"^100 %  \S+ of \S+ s in \d+\.\d s$", ended.stderr, flags=re.M), ended.stderr


def test_the_front_door_opens_without_petsc_and_mpi():
    """Importing the package and asking for its names starts nothing, and builds no case."""
    code = (
        "import sys, vipetsc; dir(vipetsc);"
        " print(*sorted({'petsc4py', 'mpi4py', 'numba', 'tqdm', 'pydantic', 'numpy'} & sys.modules.keys()))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert ended.stdout.strip() == ""


def test_stubs_say_what_the_module_does():
    """What type checkers read has the same names, from the same modules; the package says that it is typed."""
    stub = (ROOT / "vipetsc/__init__.pyi").read_text(encoding="utf-8")
    found = {alias: (module, name) for module, name, alias in re.findall(r"from (\S+) import (\w+) as (\w+)", stub)}
    assert found == package.MODULES
    assert re.search(r"^__all__ = (.*)$", stub, flags=re.M)[1] == repr(package.__all__).replace("'", '"')
    assert (ROOT / "vipetsc/py.typed").exists()
