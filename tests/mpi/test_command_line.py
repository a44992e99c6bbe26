"""The command line on two ranks: what is printed once, what all ranks return, and what is left after a failure."""

from __future__ import annotations

import json

from mpi4py import MPI

import h5py
import numpy as np
import pytest
import tomli_w

from tests.cli.test_nnm import FOLDED
from tests.conftest import search_table, set_words
from vipetsc.cli.main import main

# For each verb: wrong changes of its case, and sentences that the message must contain.
REFUSED = {
    "design": (
        ["design.eta.last=1.5", "design.lambda.coutn=3", "design.wavenumbers=2"],
        ["3 problems", "design.eta.last = 1.5", "did you mean design.lambda.count", "design.wavenumbers = 2"],
    ),
    "optimise": (
        ["optimise.variables.clearance=[-1.0, 1.0]", "optimise.objective=[{measure='band_share'}]"],
        ["2 problems", "optimise.variables.clearance[1] = -1.0", "optimise.objective[1].band: missing"],
    ),
}


def refused(capfd: pytest.CaptureFixture[str], *words: object) -> str:
    """Call the program with ``words``, assert that every rank returns 2, and return the messages of all ranks."""
    comm = MPI.COMM_WORLD
    comm.Barrier()
    capfd.readouterr()
    code = main(list(map(str, words)))

    # All ranks compare the same values, because a rank that fails alone would leave the other one waiting.
    assert comm.allgather(code) == [2] * comm.size
    return "".join(comm.allgather(capfd.readouterr().err))


@pytest.mark.parallel([2])
@pytest.mark.parametrize("verb", REFUSED)
def test_bad_cases_write_nothing(folder, capfd, verb):
    """All problems of a case are reported together, each once, and no folder is created."""
    changes, sentences = REFUSED[verb]
    if MPI.COMM_WORLD.rank == 0:
        table = {"design": {"wavenumbers": 21}}
        if verb == "optimise":
            table = search_table(16, [4, 9])
        (folder / "case.toml").write_text(tomli_w.dumps(table))

    printed = refused(capfd, verb, folder / "case.toml", "--out", folder / "out", *set_words(*changes))

    for sentence in sentences:
        assert printed.count(sentence) == 1, sentence
    assert not (folder / "out").exists()


@pytest.mark.parallel([2])
def test_a_file_that_is_no_branch_is_refused(folder, capfd):
    """An HDF5 file of another kind under a branch's name is named once, without a traceback."""
    if MPI.COMM_WORLD.rank == 0:
        with h5py.File(folder / "branch-x.h5", "w") as file:
            file["energy"] = [1.0]

    printed = refused(capfd, "plot", folder)

    assert printed.count("is not a branch") == 1
    assert "Traceback" not in printed


@pytest.mark.parallel([2])
def test_doctor_finds_no_problem_here(capfd):
    """``doctor`` finds no problem with this installation on either rank."""
    comm = MPI.COMM_WORLD
    assert comm.allgather(main(["doctor"])) == [0, 0]
    assert ("no problems" in capfd.readouterr().out) == (comm.rank == 0)


@pytest.mark.parallel([2])
def test_a_branch_that_fails_names_the_key_to_change_and_keeps_its_points(folder, capfd):
    """With a smallest step that cannot pass a fold the exit code is 1, and the points are in the file."""
    comm = MPI.COMM_WORLD
    if comm.rank == 0:
        (folder / "case.toml").write_text(FOLDED)
    comm.Barrier()
    words = ["nnm", str(folder / "case.toml"), "--out", str(folder / "out")]
    code = main([*words, *set_words("nnm.smallest_step=1e-3", "output.figures=false")])
    printed = comm.allgather(capfd.readouterr().out)
    rows = comm.bcast((folder / "out/branch-out-of-phase.csv").read_text().splitlines())

    assert comm.allgather(code) == [1, 1]
    assert "nnm.smallest_step" in printed[0]
    assert len(rows) > 5


@pytest.mark.parallel([2])
def test_an_unstable_run_ends_with_its_place_and_last_good_sample(folder, capfd):
    """A run that grows without bound ends with 1; its status names the place, and good samples are kept."""
    comm = MPI.COMM_WORLD
    # Explicit Euler steps of constant length add energy to an oscillation.
    euler = {"ts_rk_type": "1fe", "ts_adapt_type": "none", "ts_dt": "1e-5"}
    changes = set_words("lattice.cells=40", "contacts.sites=[10]", "time.end=0.5", "output.figures=false")
    code = main(["run", "--out", str(folder / "out"), *changes], euler)
    assert comm.allgather(code) == [1, 1]
    comm.Barrier()
    status = comm.bcast(json.loads((folder / "out/summary.json").read_text())["status"])
    for text in ("diverges", "site 1 in cell 10", "last good sample"):
        assert text in status

    with h5py.File(folder / "out/run.h5") as file:
        velocity = file["velocity"][...]
    assert 1 < len(velocity) < 2500
    assert np.abs(velocity).max() < 1e3
