"""Bad input on two ranks: each problem is printed once, all ranks return 2, and nothing is written."""

from __future__ import annotations

from mpi4py import MPI

import h5py
import pytest
import tomli_w

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
