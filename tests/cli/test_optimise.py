"""The verb optimise as a user types it: files, the best case, a front, pictures from the file alone."""

from __future__ import annotations

import numpy as np
import pytest
import tomli_w

from tests.conftest import TWO, datasets, search_table

FIGURES = {"convergence", "compared_designs", "compared_curves"}


pytestmark = pytest.mark.usefixtures("plain_pictures")


@pytest.fixture
def case(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(tomli_w.dumps(search_table(16, [4, 9])))
    return path


def names(folder):
    """Return the paths of all files in a folder that are not hidden."""
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and p.name[0] != "."}


def test_two_objectives_leave_a_front_with_its_ends_and_its_knee(in_process, case, tmp_path):
    """Along the Pareto front one objective improves while the other worsens; its ends are the best designs of each."""
    out = tmp_path / "out"
    done = in_process("optimise", case, "--out", out, "--set", TWO, "--set", "optimise.population=6")
    assert done.returncode == 0, done.stderr
    assert {"best.toml", "best-1.toml", "best-2.toml", *(f"figures/{n}.png" for n in FIGURES)} < names(out)

    data = datasets(out / "optimum.h5")
    # The transmitted energy is maximised at 5 N and minimised at the case's amplitude: both fall along the front.
    passed, stopped = data["value"][data["front"]].T
    assert len(passed) > 1
    assert np.all(np.diff(passed) < 0)
    assert np.all(np.diff(stopped) < 0)
    assert data["comparison/number"][[1, 3]].tolist() == data["front"][[0, -1]].tolist()

    drawn = in_process("plot", out, "--fig", "convergence", "--format", "pdf")
    assert drawn.stdout.split() == [str(out / "figures" / "convergence.pdf")]
    wrong = in_process("plot", out / "optimum.h5", "--fig", "ledger")
    assert wrong.returncode == 2
    assert "compared_curves" in wrong.stderr
