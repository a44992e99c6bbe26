"""Details of verbs: pictures that are switched off, columns of tables, files that another program has open."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import clean_environment, modified
from tests.faults.scenarios import DESIGN, RUN
from vipetsc.case import NnmCase
from vipetsc.case.design import DesignCase
from vipetsc.cli.verbs.bands_verb import damping_report, damping_table
from vipetsc.cli.verbs.plot_verb import pictures_of
from vipetsc.lattice import UnitCell
from vipetsc.lattice.cell import Spring


@pytest.mark.parametrize("kind", [NnmCase, DesignCase])
def test_pictures_are_no_part_of_a_case_that_simulates_nothing(kind):
    """output.figures switches pictures of branches and design searches off, and is not recorded in their cases."""
    table = {"nnm": {"modes": [1]}, "design": {"wavenumbers": 11}}
    drawn = kind.from_table(table)
    undrawn = kind.from_table(table, ["output.figures=false"])
    assert drawn.wants_pictures
    assert not undrawn.wants_pictures
    assert drawn.to_toml() == undrawn.to_toml()


@pytest.mark.usefixtures("plain_pictures")
def test_searches_need_not_be_drawn(in_process, with_figures, tmp_path):
    """With output.figures=false there are no pictures; the same command without it draws them."""
    with_figures("deflections")
    case = tmp_path / "case.toml"
    case.write_text(DESIGN)
    out = tmp_path / "out"
    words = ["design", case, "--out", out]
    ended = in_process(*words, "--set", "output.figures=false")
    assert ended.returncode == 0, ended.stderr
    assert not (out / "figures").exists()

    assert in_process(*words).returncode == 0
    assert any((out / "figures").glob("*.png"))


def test_waves_that_do_not_decay_are_null_in_json():
    """The decay length is null at frequency 0, and finite at 1000 rad/s.

    At frequency 0 a lattice without springs to the ground moves as a whole, its dashpots do no work, and the decay
    length is infinite, which JSON cannot express.
    """
    springs = (Spring(0, 0, 1e4, offset=1, damping=0.1), Spring(0, 1, 5e3, damping=0.1))
    cell = UnitCell(masses=(1e-3, 1e-3), springs=springs, host=0, resonator=1)
    moving = damping_table(cell, 1000.0)
    resting = damping_table(cell, 0.0)

    assert 0 < moving["decay_length"]["cells"] < 1e6
    assert resting["decay_length"]["cells"] is None
    json.dumps(resting, allow_nan=False)
    assert "at 0 rad/s waves do not decay" in damping_report(resting)


@pytest.mark.parametrize("path", [".", "design.h5"])
def test_the_folder_in_which_one_is_has_its_name_on_pages(tmp_path, monkeypatch, path):
    """The current folder, given as "." or by a file in it, is resolved: pictures are titled with the folder's name."""
    (tmp_path / "design.h5").touch()
    monkeypatch.chdir(tmp_path)
    pictures, folders = pictures_of([Path(path)])
    assert pictures.kind.source == "design"
    assert folders == [tmp_path]


def test_a_run_that_another_program_writes_is_one(in_process, tmp_path):
    """A run.h5 that another program has open for writing is refused as such, not as a file that is no run."""
    case = tmp_path / "case.toml"
    case.write_text(RUN)
    out = tmp_path / "out"
    assert in_process("run", case, "--out", out, "--set", "output.figures=false").returncode == 0
    before = modified(out)

    script = f"import h5py; file = h5py.File({str(out / 'run.h5')!r}, 'a'); print('open', flush=True); input()"
    command = [sys.executable, "-c", script]
    with subprocess.Popen(
        command, env=clean_environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "open\n"
        refused = {verb: in_process(verb, out) for verb in ("plot", "analyse", "export")}
        # The refused verbs have written no file.
        assert modified(out).keys() == before.keys()
        other.communicate("\n", timeout=300)

    for verb, ended in refused.items():
        assert ended.returncode == 1, verb
        assert "run.h5 cannot be opened as a run: another program has it open for writing" in ended.stderr, verb
        assert "is not a run" not in ended.stderr, verb
    assert json.loads((out / "summary.json").read_text())["complete"]
