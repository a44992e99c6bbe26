"""The notebooks of the manual: each has a valid format, and its cells run one after another."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
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
    """The manual has four notebooks, and its chapter *notebooks* has a link to each."""
    assert {path.stem for path in NOTEBOOKS} == {"own-lattice", "sweep-heat-map", "breather", "measured-data"}
    chapter = (FOLDER.parent / "notebooks.md").read_text(encoding="utf-8")
    for path in NOTEBOOKS:
        assert f"(notebooks/{path.name})" in chapter


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_what_it_printed(path):
    """A notebook has format 4.5, begins with its title, and holds no outputs, which would differ between machines."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert cells(path, "markdown")[0].startswith("# ")
    identities = [cell["id"] for cell in notebook["cells"]]
    # A copied cell has the identity of its original, and Jupyter warns of that.
    assert len({*identities}) == len(identities)
    for cell in notebook["cells"]:
        assert cell.get("outputs", []) == []
        assert cell.get("execution_count") is None


def test_the_manual_shows_what_each_cell_draws():
    """The manual has a picture of every cell that makes a figure."""
    drawing = set()
    for path in NOTEBOOKS:
        for number, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
            if cell["cell_type"] == "code" and "plt.subplots(" in "".join(cell["source"]):
                drawing.add(f"notebook-{path.stem}-{number}")

    assert drawing == {path.stem for path in (FOLDER.parent / "pictures").glob("notebook-*.png")}
    # Each notebook draws one figure: a cell that draws without ``plt.subplots`` would not be found above.
    assert len(drawing) == len(NOTEBOOKS)


def execute(path: Path) -> dict[str, Any]:
    """Execute the cells in one namespace, which is returned; a name at the end of a cell must have an HTML form."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, text in enumerate(cells(path, "code")):
        lines = text.rstrip().splitlines()
        exec(compile("\n".join(lines), f"{path.name}, cell {number}", "exec"), names)
        if lines[-1].isidentifier():
            assert names[lines[-1]]._repr_html_().startswith("<")
    return names


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_its_cells_run(path, monkeypatch, tmp_path, capsys):
    """All cells run without a kernel, and their numbers are those that the notebook's text describes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(mpl.rcParams, "backend", "agg")
    try:
        names = execute(path)
    finally:
        # Figures of a notebook stay open, and would belong to the next test.
        plt.close("all")

    printed = capsys.readouterr().out
    if path.stem == "own-lattice":
        assert "returns to the site" in printed
        # The text describes the size of the fraction; other tests assert its digits.
        assert 0.2 < names["dissipated"] < 0.5
        # The energies that it prints are those of the last sample, in which no contact is closed: they sum to all.
        ends = {name: values.values[-1] for name, values in names["run"].items() if name.startswith("energy/")}
        assert ends["energy/contact"] == 0
        left = ends["energy/kinetic"] + ends["energy/spring"]
        assert float(names["energy"][:, -1].sum()) == pytest.approx(left, rel=1e-6)
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


EXECUTE = """
import sys, nbclient, nbformat
notebook = nbformat.read(sys.argv[1], as_version=4)
nbclient.NotebookClient(notebook, timeout=240).execute()
nbformat.write(notebook, "executed.ipynb")
"""


def test_a_kernel_executes_one(tmp_path):
    """The shortest notebook ends in a kernel of its own, with the display of its case."""
    for name in ("ipykernel", "nbclient", "nbformat"):
        if find_spec(name) is None:
            pytest.skip(f"{name} is not installed")

    # In a process of its own: a client loads ipykernel, and progress would take this process for a notebook.
    subprocess.run([sys.executable, "-c", EXECUTE, FOLDER / "own-lattice.ipynb"], cwd=tmp_path, check=True, timeout=300)
    cells = json.loads((tmp_path / "executed.ipynb").read_text(encoding="utf-8"))["cells"]
    kinds = {kind for cell in cells for out in cell.get("outputs", []) for kind in out.get("data", {})}
    assert "text/html" in kinds
