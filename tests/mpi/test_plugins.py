"""Modules of users on several ranks: the same bits; what one rank cannot import, and mistakes in measures, end all."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.cli.test_plugins import CASE as CASE_OF_ALL_PARTS
from tests.manual_modules import write_modules
from tests.mpi.test_partition import runs_alike
from vipetsc.case import Case, Sweep
from vipetsc.cli.main import main
from vipetsc.register import PartError
from vipetsc.studies.ensemble import FAILED
from vipetsc.studies.sweep import run_sweep

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


@pytest.mark.parallel([2])
def test_two_ranks_have_the_bits_of_one(folder):
    """The law of a module, compiled on each of two ranks, gives the same bits as on one rank."""
    if MPI.COMM_WORLD.rank == 0:
        write_modules(folder)
        (folder / "case.toml").write_text(CASE_OF_ALL_PARTS)
    MPI.COMM_WORLD.Barrier()
    runs_alike(folder, Case.load(folder / "case.toml"))


MEASURE = """
import numpy as np

from vipetsc import register


@register.measure("mine-{number}", unit="1", text="a number")
def mine(record):
    return {returned}
"""
SWEEP = {
    "lattice": {"preset": "four-band", "cells": 12},
    "contacts": {"sites": [4]},
    "drive": {"cycles": 2},
    "time": {"end": 0.01, "engine": "propagator"},
    "sweep": {"measures": ["motion"], "drive": {"amplitude": [1.0, 2.0, 3.0, 4.0]}},
}


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize(
    ("number", "returned", "telling"),
    [
        (0, "record.run['energy/work'] + None", "TypeError"),
        (1, "record.run.nothing", "AttributeError"),
        (2, "record.run['no such variable']", "KeyError"),
        (3, "undefined", "NameError"),
        (4, "1j", "returns 1j"),
        (5, "[1.0, 2.0]", "returns"),
        (6, "np.array('a')", "returns"),
    ],
)
def test_a_measure_with_a_mistake_ends_a_sweep_at_once(folder, ranks, number, returned, telling):
    """A mistake in a function would fail every member: the first ends the sweep and names the part and its file."""
    comm = MPI.COMM_WORLD
    if comm.rank == 0:
        (folder / "part.py").write_text(MEASURE.format(number=number, returned=returned))
    comm.Barrier()
    table = SWEEP | {"plugins": {"modules": [str(folder / "part.py")]}}
    table["sweep"] = SWEEP["sweep"] | {"ranks": min(ranks, comm.size)}

    with pytest.raises(PartError, match=f"'mine-{number}' of .*part.py .*{telling}"):
        run_sweep(Sweep.from_table(table), folder / "out", comm)

    comm.Barrier()
    records = [path.read_text() for path in (folder / "out").glob("members*.jsonl")]
    assert not any('"failed"' in text for text in records)


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize("ranks", [1, 2])
def test_a_measure_that_fails_for_some_runs_fails_these_members(folder, ranks, capfd):
    """A function that fails for the numbers of one run fails this member alone, also in a team of ranks.

    Rank 0 names it before any rank calls it, since another one may never come back from it.
    """
    comm = MPI.COMM_WORLD
    if comm.rank == 0:
        returned = "[][0] if record.run.sizes['episode'] else 1.0"
        (folder / "part.py").write_text(MEASURE.format(number=9 + ranks, returned=returned))
    comm.Barrier()
    table = SWEEP | {"plugins": {"modules": [str(folder / "part.py")]}}
    table["sweep"] = SWEEP["sweep"] | {"ranks": min(ranks, comm.size), "drive": {"amplitude": [1.0, 1e3, 2.0]}}

    result = run_sweep(Sweep.from_table(table), folder / "out", comm)

    assert result.count(FAILED) == 1
    named = f"ranks call the measure 'mine-{9 + ranks}' of {folder / 'part.py'}"
    assert (named in capfd.readouterr().err) == (comm.size > 1 and comm.rank == 0)
    assert "IndexError" in result.failures[0]["reason"]
