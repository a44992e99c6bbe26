"""The command line as a user types it: exit codes, refusals, faults, kill and resume."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import pytest

from tests.conftest import modified

SMALL = """
[lattice]
preset = "four-band"
cells = 24
[contacts]
sites = [6, 12, 13]
clearance = 2e-4
[drive]
amplitude = 24.33
cycles = 6
[time]
end = 0.06
"""
QUICK = ("--set", "output.figures=false")


@pytest.fixture
def case(tmp_path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


@pytest.mark.usefixtures("plain_pictures")
def test_run_leaves_a_traceable_run_and_its_pictures(in_process, with_figures, case, tmp_path):
    """A run leaves its files, a summary that says what was computed by what, and pictures."""
    ended = in_process("run", case, "--out", tmp_path / "out")
    assert ended.returncode == 0, ended.stderr
    assert "complete: 301 samples" in ended.stdout

    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["complete"]
    assert summary["ranks"] == 1
    assert summary["case"]["contacts"]["sites"] == [6, 12, 13]
    assert summary["statistics"]["ledger_error"] < 1e-8
    assert summary["petsc_version"]

    files = {p.name for p in (tmp_path / "out").iterdir()}
    assert files == {"run.h5", "summary.json", "case.toml", "analysis.h5", "run.xdmf", "figures", "end-state"}

    pictures = {p.name for p in (tmp_path / "out" / "figures").glob("*.png")}
    wanted = {"modal_energies", "spacetime", "dispersion", "ledger", "impacts", "phase", "unit_cell"}
    assert {f"{name}.png" for name in wanted} <= pictures

    # The rest concerns files only, and two pictures are enough for it.
    with_figures("modal_energies", "ledger")
    assert_the_same_command_finishes_what_is_missing(in_process, case, tmp_path / "out")


def assert_the_same_command_finishes_what_is_missing(in_process, case, out):
    """Remove or damage files: the same command writes those again and no others, and refuses a run that is cut off."""
    before = modified(out)
    # In the first round no file is missing, and the command writes nothing.
    for missing in ((), ("analysis.h5",), ("figures/ledger.png", "summary.json", "run.xdmf")):
        for name in missing:
            (out / name).unlink()
            if name == "analysis.h5":
                # A kill may leave an incomplete file.
                (out / name).write_text("cut")

        ended = in_process("run", case, "--out", out)
        assert ended.returncode == 0, ended.stderr
        assert "complete: 301 samples" in ended.stdout
        assert modified(out).keys() == before.keys()
        assert missing or modified(out) == before
        assert modified(out)[out / "run.h5"] == before[out / "run.h5"]

    assert {"status", "complete", "statistics", "case"} <= json.loads((out / "summary.json").read_text()).keys()

    (out / "run.h5").write_bytes((out / "run.h5").read_bytes()[:1000])
    cut = in_process("run", case, "--out", out)
    assert cut.returncode == 2
    assert str(out / "run.h5") in cut.stderr
    assert "--force repeats the run" in cut.stderr


def test_no_verb_is_the_builtin_case(in_process, tmp_path):
    """Without a verb the built-in case is run; another case is refused until --force replaces the run."""
    ended = in_process("--set", "time.end=0.01", *QUICK, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "runs" / "four-band" / "run.h5").exists()

    other = in_process("--set", "time.end=0.02", *QUICK, cwd=tmp_path)
    assert other.returncode == 2
    assert "time.end" in other.stderr and "--extend" in other.stderr

    forced = in_process("--set", "time.end=0.02", *QUICK, "--force", cwd=tmp_path)
    assert forced.returncode == 0, forced.stderr
    assert "end = 0.02" in (tmp_path / "runs" / "four-band" / "case.toml").read_text()
    assert {p.name for p in (tmp_path / "runs" / "four-band").iterdir()} == {
        "run.h5",
        "summary.json",
        "case.toml",
        "analysis.h5",
        "run.xdmf",
        "end-state",
    }


def test_bands_with_modes_of_the_finite_lattice(in_process, tmp_path):
    """Bands come as JSON with the gaps between them, as a picture, and with the modes next to a frequency."""
    out = tmp_path / "bands"
    ended = in_process("bands", "--json", "--set", "lattice.reading=printed", "--out", out)
    assert ended.returncode == 0, ended.stderr
    # Nothing but JSON is printed.
    table = json.loads(ended.stdout)
    edges = [(round(b["low"], 2), round(b["high"], 2)) for b in table["bands"]]
    assert edges == [(0.0, 836.47), (947.07, 1414.21), (2331.09, 3162.28), (3271.55, 3669.65)]
    assert len(table["gaps"]) == 3
    assert (out / "bands.png").exists()

    near = ("--modes", "2", "--near", "2034")
    printed = in_process("bands", "--set", "lattice.cells=40", "--out", out, *near)
    assert printed.returncode == 0, printed.stderr
    rows = [line.split() for line in printed.stdout.splitlines() if line.endswith("edge")]
    # Two modes in a gap have the same frequency, and are localised at the ends of the lattice.
    assert [row[:3] for row in rows] == [["1", "2034.825055", "gap"], ["2", "2034.825055", "gap"]]
    with h5py.File(out / "modes.h5") as file:
        assert file["shape"].shape == (2, 40, 4)


def test_petsc_options_reach_the_integrator(vipetsc, case, tmp_path):
    """Options after -- choose the integrator's method and PETSc's log."""
    ended = vipetsc(0, "run", case, "--out", tmp_path / "out", *QUICK, "--", "-ts_rk_type", "5dp", "-log_view")
    assert ended.returncode == 0, ended.stderr
    assert "TSFunctionEval" in ended.stdout
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["statistics"]["method"] == "5dp"
