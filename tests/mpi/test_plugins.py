"""A module that only one rank cannot import ends all ranks, before anything is written."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from vipetsc.cli.main import main

MODULE = """
from mpi4py import MPI

from vipetsc import register

if MPI.COMM_WORLD.rank == {rank}:
    raise OSError("this rank cannot read its table")


@register.dissipation_factor("factor-{rank}")
def damping(restitution):
    return 0.5 * (1 - restitution)
"""
CASE = """
[plugins]
modules = ["part.py"]

[lattice]
preset = "four-band"
cells = 12

[contacts]
damping = "factor-{rank}"
sites = [4]

[sweep.drive]
amplitude = [1.0, 2.0]
"""


@pytest.mark.parallel([2])
@pytest.mark.parametrize("verb", ["run", "sweep"])
@pytest.mark.parametrize("failing", [0, 1])
def test_a_module_that_fails_on_one_rank_ends_all(folder, failing, verb, capfd):
    """All ranks return 2, rank 0 prints one message, which names another rank than 0, and no folder is left."""
    comm = MPI.COMM_WORLD
    if comm.rank == 0:
        (folder / "part.py").write_text(MODULE.format(rank=failing))
        (folder / "case.toml").write_text(CASE.format(rank=failing))
    comm.Barrier()

    code = main([verb, str(folder / "case.toml"), "--out", str(folder / "out"), "--quiet"])
    # All ranks compare the same values, because a rank that fails alone would leave the other one waiting.
    codes = comm.allgather(code)
    messages = comm.allgather(capfd.readouterr().err)
    is_left = comm.bcast((folder / "out").exists())

    assert codes == [2, 2]
    assert messages[1] == ""
    assert messages[0].count("vipetsc:") == 1
    assert "cannot be imported: OSError: this rank cannot read its table" in messages[0]
    assert ("on rank 1: cannot" in messages[0]) == (failing == 1)
    assert not is_left
