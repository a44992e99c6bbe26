"""Small cases and shared folders; signals and threads as the front door sets them."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import petsc4py

petsc4py.init(["pytest", "-no_signal_handler"])

from mpi4py import MPI

import h5py
import hypothesis
import numpy as np
import pytest

from vipetsc import __version__
from vipetsc.case import Case, Sweep
from vipetsc.cli.main import main
from vipetsc.io.records import RecordFile
from vipetsc.parallel import StopRequest

# A first call may have to load kernels, or compile them.
hypothesis.settings.register_profile("vipetsc", deadline=None)
hypothesis.settings.load_profile("vipetsc")


@pytest.fixture
def folder():
    """A temporary folder that all ranks share."""
    comm = MPI.COMM_WORLD
    path = comm.bcast(tempfile.mkdtemp(prefix="vipetsc-") if comm.rank == 0 else None)
    yield Path(path)
    comm.Barrier()
    if comm.rank == 0:
        shutil.rmtree(path, ignore_errors=True)


# What sites have that differ in their laws and stops: three, one on both sides.
DIFFERING = {
    "law": ["hertz", "bilinear", "power"],
    "stiffness": [5e6, 2e4, 1e6],
    "restitution": [0.6, 0.8, 1.0],
    "damping": ["flores", "exact", "paper"],
    "side": ["plus", "both", "minus"],
    "clearance_minus": [1e-5, 4e-5, 3e-5],
}


def small_case(**sections) -> Case:
    """A four-band lattice of 24 cells in which contacts begin early; sections update the table."""
    table = {
        "name": "small",
        "lattice": {"preset": "four-band", "cells": 24},
        "contacts": {"sites": [6, 12, 13], "clearance": 2e-4},
        "drive": {"amplitude": 24.33, "cycles": 6},
        "time": {"end": 0.05},
    }
    for name, values in sections.items():
        table[name] = table.get(name, {}) | values
    return Case.from_table(table)


def search_table(cells: int, sites: list[int], **sections: dict[str, Any]) -> dict[str, Any]:
    """The table of a search for clearances of a four-band lattice under a short burst; ``sections`` update it."""
    table: dict[str, Any] = {
        "name": "small",
        "lattice": {"preset": "four-band", "cells": cells},
        "contacts": {"sites": sites, "clearance": 2e-4},
        "drive": {"cycles": 3},
        "time": {"end": 0.03, "rtol": 1e-7},
        "optimise": {"budget": 14, "curve": [20.0], "variables": {"clearance": [1e-5, 1e-3]}},
    }
    for name, values in sections.items():
        table[name] = table[name] | values
    return table


# A second objective that the first one contradicts.
TWO = "optimise.objective=[{measure='transmitted', amplitudes=[5.0]}, {measure='transmitted', goal='minimise'}]"


def datasets(path: Path) -> dict[str, np.ndarray]:
    """Every dataset of an HDF5 file by its path."""
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[...]}) if isinstance(item, h5py.Dataset) else None)
    return found


def assert_same_bits(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> None:
    """Two files' datasets agree in every bit; NaN equals NaN."""
    assert first.keys() == second.keys()
    for name, values in first.items():
        assert values.shape == second[name].shape, name
        texts = values.dtype == object  # whose bytes are addresses
        assert values.tolist() == second[name].tolist() if texts else values.tobytes() == second[name].tobytes(), name


def put_members(folder: Path, plan: Sweep, told: Callable[[int, Case], dict[str, Any] | str], file: int = 0) -> None:
    """A finished sweep whose members were not simulated: what is ``told`` of each, or why it failed, as its record."""
    from vipetsc.studies.ensemble import Results
    from vipetsc.studies.sweep import conclude

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "case.toml").write_text(plan.to_toml())
    records = RecordFile(folder / f"members-{file}.jsonl")
    for number, name in enumerate(plan.ids()):
        row = told(number, plan.case(number))
        about = {"id": name, "vipetsc_version": __version__, "status": "complete", "reason": "complete"}
        about |= {"warnings": [], "cpu_seconds": 0.1, "rtol": 1e-10}
        records.append(about | ({"status": "failed", "reason": row} if isinstance(row, str) else row))
    records.close()
    conclude(Results(plan, folder))


def modified(folder: Path) -> dict[Path, int]:
    """When each file in a folder was written."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


# One rank shares the cores with other tests; mpirun has them to itself.
alone_and_on_two_ranks = pytest.mark.parametrize("ranks", [0, pytest.param(2, marks=pytest.mark.mpirun)])


def on_two(*values: object) -> list:
    """Parameters that ``scripts/test`` takes on one rank and two: more ranks would say the same again."""
    return [
        pytest.param(*value if isinstance(value, tuple) else (value,), marks=pytest.mark.on_two) for value in values
    ]


class StopAt(StopRequest):
    """A request that comes at the n-th look."""

    def __init__(self, looks: int) -> None:
        self.left = looks

    @property
    def requested(self) -> bool:
        self.left -= 1
        return self.left < 0


# By these names Open MPI's mpirun, whose layers have been PMIx and PRRTE since 5, says which rank a process is.
OF_A_RANK = re.compile(r"(OMPI|PMIX|PRTE)_(?!MCA_|ALLOW_RUN_AS_ROOT)")


def clean_environment() -> dict[str, str]:
    """The environment without what this process's own MPI put into it: a child may then be an mpirun.

    Ranks of tests are on one machine; without its layer for TCP, Open MPI 5 writes no lines about network interfaces
    among those that the program prints.
    """
    kept = {name: value for name, value in os.environ.items() if not OF_A_RANK.match(name)}
    as_root = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    return {"OMPI_MCA_btl": "^tcp"} | kept | as_root


@pytest.fixture
def vipetsc():
    """Call the program as a user types it: ``vipetsc(ranks, "run", ...)`` returns the ended process."""

    def call(
        ranks: int, *arguments: object, timeout: float = 300, module: str = "vipetsc", **options
    ) -> subprocess.CompletedProcess:
        launcher = ["mpirun", "--oversubscribe", "-n", str(ranks)] if ranks else []
        command = [*launcher, sys.executable, "-m", module, *map(str, arguments)]
        options = {"capture_output": True, "text": True, "env": clean_environment()} | options
        return subprocess.run(command, timeout=timeout, check=False, **options)

    return call


@pytest.fixture
def in_process(capsys, monkeypatch):
    """Call the program on one rank in this process, where how a process begins and ends is not what is tested.

    ``in_process("run", ..., cwd=None)`` returns what the fixture ``vipetsc`` returns.
    """

    def call(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess:
        words = list(map(str, arguments))
        capsys.readouterr()
        with monkeypatch.context() as context:
            if cwd:
                context.chdir(cwd)
            try:
                code = main(words)
            except SystemExit as end:
                code = end.code
        return subprocess.CompletedProcess(words, code, *capsys.readouterr())

    return call


@pytest.fixture
def on_ranks(vipetsc, in_process):
    """Call the program on so many ranks of mpirun, or with 0 in this process: ``on_ranks(ranks, "run", ...)``."""
    return lambda ranks, *arguments: vipetsc(ranks, *arguments) if ranks else in_process(*arguments)


@pytest.fixture
def plain_pictures(monkeypatch):
    """Coarse pictures that are not laid out, which costs most: for tests of files, not of what is seen."""
    from vipetsc.figures import style

    monkeypatch.setattr(style, "SCREEN", 80)
    monkeypatch.setattr(style, "_lay_out", lambda figure: figure.set_layout_engine("none"))


@pytest.fixture
def petsc_options():
    """Set PETSc options for one test."""
    from petsc4py import PETSc

    options, given = PETSc.Options(), set()

    def put(**values: object) -> None:
        for name, value in values.items():
            options[name] = value
            given.add(name)

    yield put
    for name in given:
        options.delValue(name)
