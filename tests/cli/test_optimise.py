"""The verb optimise as a user types it: files, a kill, a request to stop, refusals, pictures from the file alone."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import tomli_w

from tests.conftest import TWO, assert_same_bits, clean_environment, datasets, modified, search_table, set_words
from vipetsc.io.records import read_records

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


def recorded_values(folder):
    """Return the recorded values of each run of a search, by the run's key."""
    records = read_records(folder / "optimum-runs.jsonl", pytest.fail)
    return {record["key"]: record["values"] for record, _ in records}


@pytest.mark.slow
def test_a_search_leaves_its_files_and_goes_on_after_a_kill(in_process, case, tmp_path):
    """A search that is killed and resumed leaves the same files as an uninterrupted one."""
    out = tmp_path / "out"
    done = in_process("optimise", case, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "14 designs, 14 runs; 0 designs failed" in done.stdout
    assert "maximise upper_share_at_end" in done.stdout
    files = {"case.toml", "best.toml", "optimum.h5", "optimum-runs.jsonl"}
    assert names(out) == files | {f"figures/{name}.png" for name in FIGURES}

    # A kill leaves the records of some runs, of which the last one is incomplete.
    killed = tmp_path / "killed"
    killed.mkdir()
    records = (out / "optimum-runs.jsonl").read_bytes()
    (killed / "case.toml").write_bytes((out / "case.toml").read_bytes())
    (killed / "optimum-runs-0.jsonl").write_bytes(records[: len(records) // 2])
    assert in_process("optimise", case, "--out", killed, "--resume").returncode == 0

    assert_same_bits(datasets(out / "optimum.h5"), datasets(killed / "optimum.h5"))
    assert {path.name for path in killed.glob("optimum-runs*")} == {"optimum-runs.jsonl"}
    assert recorded_values(killed) == recorded_values(out)
    assert (killed / "best.toml").read_text() == (out / "best.toml").read_text()

    # The same command computes nothing. Another search is refused, and other verbs are refused even with --force.
    written = modified(out)
    assert in_process("optimise", case, "--out", out).stdout.splitlines()[:5] == done.stdout.splitlines()[:5]
    assert modified(out) == written
    changed = in_process("optimise", case, "--out", out, "--set", "optimise.seed=2")
    assert changed.returncode == 2
    assert "optimise.seed" in changed.stderr
    for verb in ("run", "sweep"):
        assert in_process(verb, case, "--out", out, "--force").returncode == 2
    assert modified(out) == written

    # The best design is a case that can be run.
    run = in_process("run", out / "best.toml", "--out", tmp_path / "run", "--set", "output.figures=false")
    assert run.returncode == 0, run.stderr
    assert modified(out) == written


@pytest.mark.slow
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


STOPPED_AT_THE_FOURTH_RUN = """
import os, signal, sys
from itertools import count
from vipetsc.__main__ import main

runs = count(1)

def request(event, _):
    if event == "vipetsc.member" and next(runs) == 4:
        os.kill(os.getpid(), signal.SIGTERM)

sys.addaudithook(request)
# PETSc takes a name that begins with a dash for an option.
sys.argv[0] = "vipetsc"
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_a_request_to_stop_ends_with_75_and_the_same_command_goes_on(in_process, case, tmp_path):
    """SIGTERM during the search ends it with exit code 75 and its records; the same command leaves the same bits."""
    out = tmp_path / "out"
    whole = tmp_path / "whole"
    words = ["optimise", str(case), "--out", str(out), "--set", "output.figures=false"]
    command = [sys.executable, "-c", STOPPED_AT_THE_FOURTH_RUN, *words]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300, env=clean_environment(), check=False)

    assert ended.returncode == 75, ended.stderr
    assert "the same command continues" in ended.stderr
    assert not (out / "optimum.h5").exists()
    recorded = (out / "optimum-runs-0.jsonl").read_text().splitlines()
    assert 3 <= len(recorded) < 14

    for folder in (out, whole):
        assert in_process(*words[:3], folder, *words[4:]).returncode == 0
    assert_same_bits(datasets(out / "optimum.h5"), datasets(whole / "optimum.h5"))


def test_bad_cases_write_nothing(in_process, case, tmp_path):
    """All problems of a case are reported together, each once; tests/mpi/test_refusals.py tests two ranks."""
    wrong = set_words("optimise.variables.clearance=[-1.0, 1.0]", "optimise.objective=[{measure='band_share'}]")

    done = in_process("optimise", case, "--out", tmp_path / "out", *wrong)
    assert done.returncode == 2, done.stdout
    for message in ("2 problems", "optimise.variables.clearance[1] = -1.0", "optimise.objective[1].band: missing"):
        assert done.stderr.count(message) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["clearances", "amplitudes", "band", "gate", "absorber"])
def test_the_cases_in_runs_are_valid(in_process, name):
    """``validate`` accepts each search in ``runs`` and prints the number of its designs."""
    done = in_process("validate", f"runs/examples/optimise-{name}.toml")

    assert done.returncode == 0, done.stderr
    assert "designs of" in done.stdout
