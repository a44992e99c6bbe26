"""Tasks of a laboratory as they are typed from the manual: pictures of points with records, pictures for a thesis."""

from __future__ import annotations

import re
import shlex
import shutil

import h5py
import numpy as np
import pytest

CASE = """
[lattice]
cells = 20

[drive]
cycles = 4

[time]
engine = "propagator"
end = 0.04

[output]
figures = false
points = [{ name = "near", cell = 5 }, { name = "tip", cell = 15 }]
"""


@pytest.fixture
def typed(in_process, tmp_path):
    """Call the program in a temporary folder: ``typed("plot a --fig points")`` returns how it ended."""

    def call(line: str):
        return in_process(*shlex.split(line), cwd=tmp_path)

    return call


def test_points_of_two_runs_with_a_record_in_the_units_of_a_thesis(typed, tmp_path):
    """Two runs share a page with a record; SVG has the words that were asked for, and no title."""
    (tmp_path / "x.toml").write_text(CASE, encoding="utf-8")
    for name, amplitude in (("a", 1.0), ("b", 2.0)):
        assert typed(f"run x.toml --out {name} --set drive.amplitude={amplitude}").returncode == 0
    assert typed("export a").returncode == 0
    (tmp_path / "x.mplstyle").write_text("svg.fonttype: none\naxes.linewidth: 2.5\n", encoding="utf-8")
    look = '--format svg --width 86mm --db --unit Hz --no-title --style x.mplstyle --label "Time (s)=t (s)"'
    ended = typed(f"plot b a --fig points --record a/curves/run-points.csv {look}")
    assert ended.returncode == 0, ended.stderr

    picture = (tmp_path / "b/figures/points-a.svg").read_text(encoding="utf-8")
    assert 'width="243' in picture  # 86 mm in pt
    words = re.findall(r">([^<>\n]+)</text>", picture)
    assert {"t (s)", "Frequency f (Hz)", "run-points.csv", "(a.i)", "(dB re 1 m/s)"} <= set(words)
    assert not any("rad/s" in word or "History" in word for word in words)
    assert "stroke-width: 2.5" in picture

    # The same record from HDF5, and a label of which no picture has the text.
    columns = np.loadtxt(tmp_path / "a/curves/run-points.csv", delimiter=",", skiprows=1)
    with h5py.File(tmp_path / "laser.h5", "w") as file:
        file["time"] = columns[:, 0]
        file["tip"] = columns[:, 1]
        file["raw/near"] = columns[:, 2]
    records = "--record laser.h5 --record laser.h5:raw/near=near"
    ended = typed(f"plot b --fig points {records} --label Tpi=Sensor --format svg")
    assert ended.returncode == 0, ended.stderr
    assert "--label Tpi" in ended.stderr
    assert (tmp_path / "b/figures/points.svg").exists()

    # A record of the second point alone is in the legend too.
    assert typed("plot b --fig points --record laser.h5:tip=tip --format svg --style x.mplstyle").returncode == 0
    assert ">laser.h5</text>" in (tmp_path / "b/figures/points.svg").read_text(encoding="utf-8")

    for name, line in (("key", "axes.linewidht: 2"), ("value", "axes.linewidth: wide"), ("latex", "text.usetex: true")):
        (tmp_path / f"{name}.mplstyle").write_text(f'# a style\naxes.edgecolor: "#112233"\n{line}\n')
    for wrong, telling in (
        ("--style key.mplstyle", "line 3: matplotlib has no setting axes.linewidht; did you mean axes.linewidth"),
        ("--style value.mplstyle", "line 3"),
        *([] if shutil.which("latex") else [("--style latex.mplstyle", "LaTeX")]),
        ("--fig points --record x.toml", "x.toml"),
        ("--fig points --record a/curves/run-points.csv:2=top", "points are near, tip"),
        ("--fig ledger", "one run"),
        ("--style none.mplstyle", "--style"),
        ("--movie --width 86mm", "pixels"),
        ("--width 86", "as in 86mm"),
    ):
        ended = typed(f"plot a b {wrong}")
        assert ended.returncode == 2, wrong
        assert telling in ended.stderr
    (tmp_path / "begun").mkdir()
    for folder, telling in (("elsewhere", "elsewhere: no such folder"), ("begun", "begun: contains no finished")):
        ended = typed(f"plot a {folder} --fig points")
        assert ended.returncode == 2 and telling in ended.stderr
