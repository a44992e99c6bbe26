"""The command line on two ranks: what is printed once, what all ranks return, and what is left after a failure."""

from __future__ import annotations

import json
import resource
import sys
from pathlib import Path

from mpi4py import MPI

import h5py
import numpy as np
import pytest
import tomli_w

from tests.conftest import assert_same_bits, datasets, search_table, set_words, small_case
from vipetsc.cli.main import main
from vipetsc.parallel import on_root

COMM = MPI.COMM_WORLD
QUICK = ("--set", "output.figures=false")


@pytest.fixture
def call(capfd):
    """Call the program on all ranks: returns its code, which all must return, and what all printed, by stream."""

    def call_with(*words, petsc=None):
        COMM.Barrier()
        capfd.readouterr()
        code = main(list(map(str, words)), petsc)
        # All ranks compare the same values, because a rank that fails alone would leave the other one waiting.
        assert COMM.allgather(code) == [code] * COMM.size
        printed = COMM.allgather(capfd.readouterr())
        return code, "".join(out for out, _ in printed), "".join(err for _, err in printed)

    return call_with


def put(path: Path, text: str) -> Path:
    """Write a file on rank 0; returns its path on all ranks, once it is there."""
    on_root(COMM, lambda: path.write_text(text))
    return path


# For each verb: a valid case, wrong changes, and sentences that the message must contain.
REFUSED = {
    "design": (
        {"design": {"wavenumbers": 21}},
        ["design.eta.last=1.5", "design.lambda.coutn=3", "design.wavenumbers=2"],
        ["3 problems", "design.eta.last = 1.5", "did you mean design.lambda.count", "design.wavenumbers = 2"],
    ),
    "optimise": (
        search_table(16, [4, 9]),
        ["optimise.variables.clearance=[-1.0, 1.0]", "optimise.objective=[{measure='band_share'}]"],
        ["2 problems", "optimise.variables.clearance[1] = -1.0", "optimise.objective[1].band: missing"],
    ),
}


@pytest.mark.parallel([2])
@pytest.mark.parametrize("verb", REFUSED)
def test_bad_cases_write_nothing(folder, call, verb):
    """All problems of a case are reported together, each once, and no folder is created."""
    table, changes, sentences = REFUSED[verb]
    case = put(folder / "case.toml", tomli_w.dumps(table))
    code, _, errors = call(verb, case, "--out", folder / "out", *set_words(*changes))
    assert code == 2
    for sentence in sentences:
        assert errors.count(sentence) == 1, sentence
    assert not (folder / "out").exists()


MODULE = """
from mpi4py import MPI

from vipetsc import register

if MPI.COMM_WORLD.rank == {rank}:
    raise OSError("this rank cannot read its table")


@register.dissipation_factor("factor-{rank}")
def damping(restitution):
    return 0.5 * (1 - restitution)
"""
CASE_OF_MODULE = """
[plugins]
modules = ["part.py"]
[contacts]
damping = "factor-{rank}"
[sweep.drive]
amplitude = [1.0, 2.0]
"""


@pytest.mark.parallel([2])
@pytest.mark.parametrize(("verb", "failing"), [("run", 0), ("sweep", 1)])
def test_a_module_that_fails_on_one_rank_ends_all(folder, failing, verb, call):
    """All ranks return 2, one message names another rank than 0, and no folder is left."""
    put(folder / "part.py", MODULE.format(rank=failing))
    case = put(folder / "case.toml", CASE_OF_MODULE.format(rank=failing))
    code, _, errors = call(verb, case, "--out", folder / "out", "--quiet")
    assert code == 2
    assert errors.count("vipetsc:") == 1
    assert "cannot be imported: OSError: this rank cannot read its table" in errors
    assert ("on rank 1: cannot" in errors) == (failing == 1)
    assert not (folder / "out").exists()


@pytest.mark.parallel([2])
def test_a_run_is_drawn_and_filmed_together(folder, call, plain_pictures, with_figures):
    """Both ranks leave one run, one summary and its pictures; what one finds in a folder is sent to the other."""
    with_figures("ledger", "spacetime")
    case = put(folder / "case.toml", small_case(time={"end": 0.03}).to_toml())
    code, printed, errors = call("run", case, "--out", folder / "out")
    assert code == 0, errors
    assert printed.count("complete: ") == 1
    summary = json.loads((folder / "out/summary.json").read_text())
    assert summary["ranks"] == COMM.size
    assert {"ledger.png", "spacetime.png"} <= {path.name for path in (folder / "out/figures").iterdir()}

    short = ("--format", "gif", "--width", 320, "--rate", 2, "--to", 0.01)
    code, _, errors = call("plot", folder / "out", "--movie", *short)
    assert code == 0, errors
    assert list((folder / "out/figures").glob("movie-*.gif"))


@pytest.mark.parallel([2])
def test_all_ranks_end_with_the_code_of_an_answer_that_is_lost(call, monkeypatch):
    """Rank 0 cannot write the answer, and says so; both return 1."""
    with open("/dev/full", "w") as full, monkeypatch.context() as context:
        context.setattr(sys, "stdout", full)
        code, _, errors = call("manual")
    assert code == 1
    assert errors.count("vipetsc: stdout: No space left on device") == 1


@pytest.mark.parallel([1, 2])
def test_a_disk_that_fills_ends_all_and_loses_nothing(folder, call):
    """A run that cannot be written ends on all ranks, keeps the earlier run, and is resumed to the same bits.

    A limit on the size of files stands for a full disk. On one rank the first part of the run exceeds it; on two ranks
    the parts fit, and run.h5 exceeds it.
    """
    case = put(folder / "case.toml", small_case(time={"end": 0.06}).to_toml())
    out = folder / "out"
    assert call("run", case, "--out", out, *QUICK)[0] == 0
    before = (out / "run.h5").read_bytes()
    whole = datasets(out / "run.h5")

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ({1: 300_000, 2: 440_000}[COMM.size], limits[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            main(["run", str(case), "--out", str(out), "--force", *QUICK])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (folder / "out.old/run.h5").read_bytes() == before
    COMM.Barrier()

    assert call("run", case, "--out", out, "--resume", *QUICK)[0] == 0
    assert_same_bits(whole, datasets(out / "run.h5"))
    assert not (folder / "out.old").exists()


@pytest.mark.parallel([2])
def test_an_unstable_run_ends_with_its_place_and_last_good_sample(folder, call):
    """A run that grows without bound ends with 1; its status names the place, and good samples are kept."""
    # Explicit Euler steps of constant length add energy to an oscillation.
    euler = {"ts_rk_type": "1fe", "ts_adapt_type": "none", "ts_dt": "1e-5"}
    changes = set_words("lattice.cells=40", "contacts.sites=[10]", "time.end=0.5", "output.figures=false")
    assert call("run", "--out", folder / "out", *changes, petsc=euler)[0] == 1
    status = json.loads((folder / "out/summary.json").read_text())["status"]
    for text in ("diverges", "site 1 in cell 10", "last good sample"):
        assert text in status

    with h5py.File(folder / "out/run.h5") as file:
        velocity = file["velocity"][...]
    assert 1 < len(velocity) < 2500
    assert np.abs(velocity).max() < 1e3
