"""The command line as a user types it: exit codes, refusals, faults, kill and resume."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

from mpi4py import MPI

import h5py
import pytest

from tests.conftest import alone_and_on_two_ranks, assert_same_bits, clean_environment, datasets, modified
from vipetsc.cli.verbs.doctor_verb import doctor_table

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
@alone_and_on_two_ranks
def test_run_leaves_a_traceable_run_and_its_pictures(on_ranks, in_process, with_figures, case, tmp_path, ranks):
    """A run leaves its files, a summary that says what was computed by what, and pictures."""
    ended = on_ranks(ranks, "run", case, "--out", tmp_path / "out")
    assert ended.returncode == 0, ended.stderr
    assert "complete: 301 samples" in ended.stdout

    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["complete"]
    assert summary["ranks"] == (ranks or 1)
    assert summary["case"]["contacts"]["sites"] == [6, 12, 13]
    assert summary["statistics"]["ledger_error"] < 1e-8
    assert summary["petsc_version"]

    files = {p.name for p in (tmp_path / "out").iterdir()}
    assert files == {"run.h5", "summary.json", "case.toml", "analysis.h5", "run.xdmf", "figures", "end-state"}

    pictures = {p.name for p in (tmp_path / "out" / "figures").glob("*.png")}
    wanted = {"modal_energies", "spacetime", "dispersion", "ledger", "impacts", "phase", "unit_cell"}
    assert {f"{name}.png" for name in wanted} <= pictures

    # What one rank finds in a folder is sent to the others.
    if ranks:
        drawn = on_ranks(ranks, "plot", tmp_path / "out", "--movie", "--format", "gif", "--width", "320")
        assert drawn.returncode == 0, drawn.stderr
        assert list((tmp_path / "out/figures").glob("movie-*.gif"))

    # The rest concerns files only, and two pictures are enough for it.
    if not ranks:
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


def test_bands_as_json_and_picture(in_process, tmp_path):
    """The bands of the printed reading come as JSON with the gaps between them, and as a picture."""
    ended = in_process("bands", "--json", "--set", "lattice.reading=printed", "--out", tmp_path / "bands")
    assert ended.returncode == 0, ended.stderr

    table = json.loads(ended.stdout)
    edges = [(round(b["low"], 2), round(b["high"], 2)) for b in table["bands"]]
    assert edges == [(0.0, 836.47), (947.07, 1414.21), (2331.09, 3162.28), (3271.55, 3669.65)]
    assert len(table["gaps"]) == 3
    assert (tmp_path / "bands" / "bands.png").exists()


def test_bands_with_modes_of_the_finite_lattice(in_process, tmp_path):
    """The requested number of modes next to a frequency is printed and written; impossible requests are refused."""
    bands = ("bands", "--set", "lattice.cells=40")
    out = tmp_path / "bands"

    printed = in_process(*bands, "--out", out, "--modes", "2", "--near", "2034")
    assert printed.returncode == 0, printed.stderr
    rows = [line.split() for line in printed.stdout.splitlines() if line.endswith("edge")]
    # Two modes in a gap have the same frequency, and are localised at the ends of the lattice.
    assert [row[:3] for row in rows] == [["1", "2034.825055", "gap"], ["2", "2034.825055", "gap"]]
    with h5py.File(out / "modes.h5") as file:
        assert file["shape"].shape == (2, 40, 4)

    as_json = in_process(*bands, "--out", out, "--modes", "3", "--near", "2034", "--json")
    # Nothing but JSON is printed.
    assert len(json.loads(as_json.stdout)["bands"]) == 4
    with h5py.File(out / "modes.h5") as file:
        assert file["shape"].shape == (3, 40, 4)

    # 40 cells of four masses have 160 modes.
    for wrong in (("--near", "2034"), ("--modes", "161"), ("--modes", "2", "--near", "-1")):
        refused = in_process(*bands, "--out", tmp_path / "none", *wrong)
        assert refused.returncode == 2
        assert wrong[-2] in refused.stderr
        assert not (tmp_path / "none" / "modes.h5").exists()


def test_doctor_without_slepc_names_the_package(monkeypatch):
    """Without SLEPc the installation is healthy and the package to install is named; with it, its version is shown."""
    monkeypatch.setitem(sys.modules, "slepc4py", None)
    text, healthy = doctor_table(MPI.COMM_SELF)
    assert healthy
    assert "python3-slepc4py" in text

    monkeypatch.undo()
    assert re.search(r"slepc +3\.", doctor_table(MPI.COMM_SELF)[0])


def test_petsc_options_reach_the_integrator(vipetsc, case, tmp_path):
    """Options after -- choose the integrator's method and PETSc's log."""
    ended = vipetsc(0, "run", case, "--out", tmp_path / "out", *QUICK, "--", "-ts_rk_type", "5dp", "-log_view")
    assert ended.returncode == 0, ended.stderr
    assert "TSFunctionEval" in ended.stdout
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["statistics"]["method"] == "5dp"


# A limit on the size of files stands for a full disk: a write beyond it fails.
FULL_DISK = """
import resource, sys
from mpi4py import MPI
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2)
from vipetsc.__main__ import main
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.mpirun
@pytest.mark.parametrize(("ranks", "limit"), [(1, 300_000), (2, 440_000)])
def test_a_disk_that_fills_ends_all_and_loses_nothing(in_process, case, tmp_path, ranks, limit):
    """A run that cannot be written ends all ranks with a sentence, keeps the earlier run, and can be resumed.

    ``limit`` in bytes bounds every file. On one rank the first part of the run exceeds it; on two ranks the parts fit,
    and run.h5 exceeds it.
    """
    out = tmp_path / "out"
    first = in_process("run", case, "--out", out, *QUICK)
    assert first.returncode == 0, first.stderr
    before = (out / "run.h5").read_bytes()
    whole = datasets(out / "run.h5")

    script = tmp_path / "full.py"
    script.write_text(FULL_DISK)
    command = ["mpirun", "--oversubscribe", "-n", str(ranks), sys.executable, str(script), str(limit)]
    command += ["run", str(case), "--out", str(out), "--force", *QUICK]
    full = subprocess.run(command, capture_output=True, text=True, timeout=300, env=clean_environment(), check=False)

    assert full.returncode == 1, full.stdout + full.stderr
    assert "Traceback" not in full.stderr
    assert "File too large" in full.stderr
    assert (tmp_path / "out.old" / "run.h5").read_bytes() == before

    # One rank resumes the run, on whatever number of ranks it began.
    resumed = in_process("run", case, "--out", out, "--resume", *QUICK)
    assert resumed.returncode == 0, resumed.stderr
    assert_same_bits(whole, datasets(out / "run.h5"))
    assert (out / "run.h5").read_bytes() != before
    assert not (tmp_path / "out.old").exists()
