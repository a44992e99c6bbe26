"""The verb optimise as a user types it: files, a kill, a request to stop, refusals, pictures again from the file."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest
import tomli_w

from tests.conftest import (
    TWO,
    alone_and_on_two_ranks,
    assert_same_bits,
    clean_environment,
    datasets,
    modified,
    search_table,
)
from vipetsc.io.records import read_records

FIGURES = {"convergence", "compared_designs", "compared_curves"}


pytestmark = pytest.mark.usefixtures("plain_pictures")


@pytest.fixture
def case(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(tomli_w.dumps(search_table(16, [4, 9])))
    return path


def names(folder):
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and p.name[0] != "."}


def test_a_search_leaves_its_files_and_goes_on_after_a_kill(in_process, case, tmp_path):
    out, again = tmp_path / "out", tmp_path / "again"
    done = in_process("optimise", case, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "14 designs, 14 runs; 0 designs failed" in done.stdout and "maximise upper_share_at_end" in done.stdout
    files = {"case.toml", "best.toml", "optimum.h5", "optimum-runs.jsonl"}
    assert names(out) == files | {f"figures/{name}.png" for name in FIGURES}
    # A kill leaves the records of the runs, the last one cut off.
    again.mkdir()
    records = (out / "optimum-runs.jsonl").read_bytes()
    (again / "case.toml").write_bytes((out / "case.toml").read_bytes())
    (again / "optimum-runs-0.jsonl").write_bytes(records[: len(records) // 2])
    assert in_process("optimise", case, "--out", again, "--resume").returncode == 0
    assert_same_bits(datasets(out / "optimum.h5"), datasets(again / "optimum.h5"))
    assert {"optimum-runs.jsonl"} == {path.name for path in again.glob("optimum-runs*")}
    first, second = (
        [r for r, _ in read_records(folder / "optimum-runs.jsonl", pytest.fail)] for folder in (out, again)
    )
    assert {r["key"]: r["values"] for r in first} == {r["key"]: r["values"] for r in second}
    assert (out / "best.toml").read_text() == (again / "best.toml").read_text()
    # Complete: nothing is made again; another search is refused, and replaced by force.
    written = modified(out)
    assert in_process("optimise", case, "--out", out).stdout.splitlines()[:5] == done.stdout.splitlines()[:5]
    assert modified(out) == written
    changed = in_process("optimise", case, "--out", out, "--set", "optimise.seed=2")
    assert changed.returncode == 2 and "optimise.seed" in changed.stderr
    run = in_process("run", out / "best.toml", "--out", tmp_path / "run", "--set", "output.figures=false")
    assert run.returncode == 0, run.stderr
    for verb in ("run", "sweep"):
        assert in_process(verb, case, "--out", out, "--force").returncode == 2
    assert modified(out) == written


def test_two_objectives_leave_a_front_with_its_ends_and_its_knee(in_process, case, tmp_path):
    out = tmp_path / "out"
    done = in_process("optimise", case, "--out", out, "--set", TWO, "--set", "optimise.population=6")
    assert done.returncode == 0, done.stderr
    assert {"best.toml", "best-1.toml", "best-2.toml", *(f"figures/{n}.png" for n in FIGURES)} < names(out)
    data = datasets(out / "optimum.h5")
    passed, stopped = data["value"][data["front"]].T
    assert len(passed) > 1 and (passed[1:] < passed[:-1]).all() and (stopped[1:] < stopped[:-1]).all()
    assert data["comparison/number"][[1, 3]].tolist() == data["front"][[0, -1]].tolist()
    drawn = in_process("plot", out, "--fig", "convergence", "--format", "pdf")
    assert drawn.stdout.split() == [str(out / "figures" / "convergence.pdf")]
    wrong = in_process("plot", out / "optimum.h5", "--fig", "ledger")
    assert wrong.returncode == 2 and "compared_curves" in wrong.stderr


def test_a_request_to_stop_ends_with_75_and_the_same_command_goes_on(vipetsc, in_process, case, tmp_path):
    out, whole = tmp_path / "out", tmp_path / "whole"
    longer = ("--set", "optimise.budget=60", "--set", "output.figures=false")
    command = [sys.executable, "-m", "vipetsc", "optimise", str(case), "--out", str(out), *longer]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=clean_environment())
    while process.poll() is None and not (out / "optimum-runs-0.jsonl").exists():
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    _, told = process.communicate(timeout=120)
    assert process.returncode == 75 and "the same command goes on" in told, told
    assert not (out / "optimum.h5").exists() and (out / "optimum-runs-0.jsonl").exists()
    for folder in (out, whole):
        assert in_process("optimise", case, "--out", folder, *longer).returncode == 0
    assert_same_bits(datasets(out / "optimum.h5"), datasets(whole / "optimum.h5"))


@alone_and_on_two_ranks
def test_bad_cases_write_nothing(on_ranks, case, tmp_path, ranks):
    """Everything wrong is said at once, once."""
    wrong = (
        "--set",
        "optimise.variables.clearance=[-1.0, 1.0]",
        "--set",
        "optimise.objective=[{measure='band_share'}]",
    )
    done = on_ranks(ranks, "optimise", case, "--out", tmp_path / "out", *wrong)
    assert done.returncode == 2, done.stdout
    for message in ("2 problems", "optimise.variables.clearance[1] = -1.0", "optimise.objective[1].band: missing"):
        assert done.stderr.count(message) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["clearances", "amplitudes", "band", "gate"])
def test_the_cases_in_runs_are_valid(in_process, name):
    done = in_process("validate", f"runs/optimise-{name}.toml")
    assert done.returncode == 0 and "designs of" in done.stdout, done.stderr
