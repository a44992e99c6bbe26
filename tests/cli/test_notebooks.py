"""The notebooks of the manual: each is sound, and its cells run one after another."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest

import vipetsc as package

FOLDER = Path(package.__file__).parent / "manual/notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
pytestmark = pytest.mark.parallel(1)


def cells(path: Path, kind: str) -> list[str]:
    """Return the texts of a notebook's cells of one kind."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == kind]


def test_the_four_are_there():
    """The manual has a notebook of each kind, and its chapter names all of them."""
    assert {path.stem for path in NOTEBOOKS} == {"own-lattice", "sweep-heat-map", "breather", "measured-data"}
    chapter = (FOLDER.parent / "notebooks.md").read_text(encoding="utf-8")
    for path in NOTEBOOKS:
        assert f"(notebooks/{path.name})" in chapter


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_what_it_printed(path):
    """A notebook is of format 4, begins with its title, and holds no outputs, which differ from machine to machine."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert cells(path, "markdown")[0].startswith("# ")
    identities = [cell["id"] for cell in notebook["cells"]]
    # Cells that were copied have the same identity, of which Jupyter warns.
    assert len({*identities}) == len(identities)
    for cell in notebook["cells"]:
        assert cell.get("outputs", []) == []
        assert cell.get("execution_count") is None


def test_the_manual_shows_what_each_cell_draws():
    """Every cell that makes a figure has its picture in the manual, whose page of the notebook shows it."""
    drawing = set()
    for path in NOTEBOOKS:
        for number, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
            if cell["cell_type"] == "code" and "plt.subplots(" in "".join(cell["source"]):
                drawing.add(f"notebook-{path.stem}-{number}")

    assert drawing == {path.stem for path in (FOLDER.parent / "pictures").glob("notebook-*.png")}
    # One each: a notebook whose code draws in another manner would not be found above.
    assert len(drawing) == len(NOTEBOOKS)


def execute(path: Path) -> dict[str, Any]:
    """Execute the cells in one namespace, which is returned; a value at the end of a cell is shown as in a notebook."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, text in enumerate(cells(path, "code")):
        lines = text.rstrip().splitlines()
        exec(compile("\n".join(lines), f"{path.name}, cell {number}", "exec"), names)
        if lines[-1].isidentifier():
            assert names[lines[-1]]._repr_html_().startswith("<")
    return names


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_its_cells_run(path, monkeypatch, tmp_path, capsys):
    """All cells run without a kernel, and what the text says of the numbers is so."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(mpl.rcParams, "backend", "agg")
    try:
        names = execute(path)
    finally:
        # Figures of a notebook stay open, and would be those of the next test.
        plt.close("all")

    printed = capsys.readouterr().out
    if path.stem == "own-lattice":
        assert "returns to the site" in printed
        # What the text says of the number, not its digits, which belong to other tests.
        assert 0.2 < names["dissipated"] < 0.5
    elif path.stem == "sweep-heat-map":
        assert names["fraction"].shape == (5, 6)
        assert names["fraction"].max() > 0.1
        assert names["run"].sizes["episode"] > 0
    elif path.stem == "breather":
        assert float(abs(names["u"][-1] - names["u"][0]).max() / abs(names["u"][0]).max()) < 1e-3
    else:
        assert "in s? In ms, their spectrum would be largest at 10" in printed
        assert printed.splitlines()[-2] == "[]"
        assert names["result"].statistics["episodes"] > 0
