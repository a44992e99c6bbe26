"""The chapter on Python: its blocks run, its names exist; the package's public names in help and in editors."""

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
RECIPES = (ROOT / "vipetsc/manual/recipes.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", CHAPTER + RECIPES, flags=re.M | re.S)
FRONT = {"Case", "CaseError", "Sweep", "analyse", "follow", "impacts", "open", "plot", "simulate", "sweep"}
pytestmark = pytest.mark.parallel(1)


def my_lattice() -> str:
    """Return the case file that the README has a reader save."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return re.search(r"```toml\n(# my-lattice.toml\n.*?)```", text, flags=re.S)[1]


@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_every_block_runs(block, tmp_path, monkeypatch, plain_pictures):
    """Each block runs alone, in a folder that holds the README's case."""
    (tmp_path / "my-lattice.toml").write_text(my_lattice(), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "python.md", "exec"), {"__name__": "__main__"})


def test_every_name_is_there():
    """The chapter's public names are in the package, and those of its table in the modules of their rows."""
    for name in re.findall(r"`(\w+)`", CHAPTER.partition("\n## ")[0]):
        assert name == "vipetsc" or hasattr(package, name), name

    table = re.findall(r"^\| .* \| (.*) \|$", CHAPTER, flags=re.M)[1:]
    assert len(table) > 3
    for row in table:
        modules = [import_module(name) for name in re.findall(r"\(`(vipetsc[\w.]*)`\)", row)]
        for name in re.findall(r"`(\w+)`", row):
            assert any(hasattr(module, name) for module in [*modules, package]), (row, name)


def test_completion_and_help_show_the_front_door():
    """Completion and help show the public names of the package, although they are imported only when they are used."""
    assert {*dir(package)} >= FRONT
    assert {*package.__all__} >= FRONT

    # Since Python 3.13 a long signature has one argument a line.
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
    # Another test runs this example.
    assert "result = simulate(case, progress=True)" in package.__doc__


def test_the_example_of_help_runs(capsys):
    """The example in the package's docstring runs as it stands, with its progress on stderr."""
    lines = package.__doc__.partition("    from vipetsc import")[2]
    example = "from vipetsc import" + re.sub(r"\n    ", "\n", lines).partition("\nAll keys")[0]
    exec(example, {})
    printed, reported = capsys.readouterr()
    assert "complete:" in printed
    assert re.search(r"^100 %  \S+ of \S+ s in \d+\.\d s$", reported, flags=re.M), reported


def test_the_front_door_opens_without_petsc_and_mpi():
    """To import the package and to list its names loads neither PETSc nor MPI nor another large library."""
    code = (
        "import sys, vipetsc; dir(vipetsc);"
        " print(*sorted({'petsc4py', 'mpi4py', 'numba', 'tqdm', 'pydantic', 'numpy'} & sys.modules.keys()))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert ended.stdout.strip() == ""


def test_stubs_say_what_the_module_does():
    """The stub file for type checkers has the names of the package, from the same modules; py.typed exists."""
    stub = (ROOT / "vipetsc/__init__.pyi").read_text(encoding="utf-8")
    found = {alias: (module, name) for module, name, alias in re.findall(r"from (\S+) import (\w+) as (\w+)", stub)}
    assert found == package.MODULES
    listed = re.search(r"^__all__ = (\[.*?\])$", stub, flags=re.M | re.S)[1]
    assert re.findall(r'"(\w+)"', listed) == package.__all__
    assert (ROOT / "vipetsc/py.typed").exists()


def test_pictures_are_figures(tmp_path):
    """A result, a run in memory and a folder of either kind are drawn by one function, which refuses with reasons."""
    case = package.Case(
        lattice={"cells": 12}, contacts={"sites": [6], "clearance": 2e-4}, drive={"cycles": 2}, time={"end": 0.02}
    )
    held = package.simulate(case)
    kept = package.simulate(case, tmp_path / "run")
    drawn = [held.plot("ledger"), kept.plot("ledger"), package.plot(tmp_path / "run", "ledger")]
    lines = [figure.axes[0].lines[0].get_ydata() for figure in drawn]
    assert len(lines[0]) > 10
    assert all((line == lines[0]).all() for line in lines[1:])
    assert package.plot(held.dataset, "spacetime").axes

    plan = package.Sweep(
        **{name: dict(table) for name, table in case.varied_table(without=[]).items() if name in ("lattice", "time")},
        contacts={"sites": [6], "clearance": 2e-4},
        drive={"cycles": 2},
        sweep={"drive": {"amplitude": [1.0, 40.0]}, "measures": ["motion"]},
    )
    package.sweep(plan, tmp_path / "sweep")
    page = package.plot(tmp_path / "sweep", "largest_force")
    assert page.axes[0].lines
    for results, name, word in (
        (held, "ledgr", "did you mean 'ledger'"),
        (held, "poincare", "points"),
        (tmp_path / "sweep", "spacetime", "no figure"),
        (tmp_path, "ledger", "no results"),
    ):
        with pytest.raises(ValueError, match=word):
            package.plot(results, name)
