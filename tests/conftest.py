"""Fixtures, small cases and helpers that tests share; this process has the signals and threads of the program's own."""

from __future__ import annotations

import gc
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

# Small matrices gain nothing from threads, and threads take the cores of other ranks and workers.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import petsc4py

# The command line handles signals itself: PETSc's own handler would print its trace and abort.
petsc4py.init(["pytest", "-no_signal_handler"])

from mpi4py import MPI

import h5py
import hypothesis
import numpy as np
import pytest
import xarray as xr

from tests.coarse import coarse_pictures
from vipetsc.case import Case, Sweep
from vipetsc.cli.main import main
from vipetsc.dynamics import simulate
from vipetsc.dynamics.observers import Observer
from vipetsc.dynamics.result import Result
from vipetsc.io.read import RUN_NEEDS
from vipetsc.io.records import RecordFile
from vipetsc.io.store import RunMemory
from vipetsc.parallel import StopRequest, wait_for_all
from vipetsc.sources import source_key

# A search for garbage goes through what earlier tests have left. With this threshold the searches take half the time
# that they take with the program's own, and a worker has 70 MB more.
gc.set_threshold(500_000)

ROOT = Path(__file__).parents[1]
# Test functions that scripts/test --quick leaves out, by name alone, since tests may move; ``scripts/test --durations``
# writes this table.
SLOW = {*(ROOT / "tests/slow_tests.txt").read_text(encoding="utf-8").split()}
NUMBER_OF_RANKS = re.compile(r"parallel\[(\d+)\]")

# Hypothesis tries the constants of the project's modules as examples. It would count all that Debian installs outside
# of the virtual environment as the project's: to read it takes seconds, and most constants would be numpy's, scipy's.
with suppress(ImportError):
    from hypothesis.internal.scrutineer import SITE_PACKAGES_DIRS

    SITE_PACKAGES_DIRS.add(Path(np.__file__).resolve().parents[1])

# A first call may have to load kernels, or compile them.
hypothesis.settings.register_profile("vipetsc", deadline=None)
hypothesis.settings.load_profile("vipetsc")


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark a test that is slow; a test that the table does not know is quick."""
    if getattr(item, "originalname", "") in SLOW:
        item.add_marker(pytest.mark.slow)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skip tests that need another number of ranks than there are, and name the command that runs them.

    Without this, mpi-pytest would call mpiexec for such tests, and Open MPI refuses that in a process with MPI.
    """
    if MPI.get_vendor()[0] != "Open MPI":
        return

    for item in items:
        # Mpi-pytest has marked every test with its number of ranks.
        found = [NUMBER_OF_RANKS.fullmatch(mark.name) for mark in item.iter_markers()]
        (ranks,) = (int(match[1]) for match in found if match)
        if ranks == MPI.COMM_WORLD.size:
            continue

        launcher = f"mpirun -n {ranks} " if ranks > 1 else ""
        file = item.path.relative_to(config.rootpath)
        command = f"{launcher}python -m pytest -m 'parallel[{ranks}]' {file}"
        item.add_marker(pytest.mark.skip(reason=f"another number of ranks: {command}"))


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Leave modules and tests, half a million objects that live to the end, out of every search for garbage."""
    gc.freeze()


@pytest.fixture(autouse=True)
def ranks_end_together():
    """End each test on all ranks together: MPI keeps a core busy for a rank that waits in a call of the next test."""
    yield

    if MPI.COMM_WORLD.size > 1:
        wait_for_all(MPI.COMM_WORLD)


@pytest.fixture
def folder():
    """A temporary folder that all ranks share."""
    comm = MPI.COMM_WORLD
    path = None
    if comm.rank == 0:
        path = tempfile.mkdtemp(prefix="vipetsc-")
    path = comm.bcast(path)

    yield Path(path)

    # A rank that is slower may still read what rank 0 would remove.
    wait_for_all(comm)
    if comm.rank == 0:
        shutil.rmtree(path, ignore_errors=True)


# Three sites that differ in their laws, damping and stops; the second one has stops on both sides.
DIFFERING = {
    "law": ["hertz", "bilinear", "power"],
    "stiffness": [5e6, 2e4, 1e6],
    "restitution": [0.6, 0.8, 1.0],
    "damping": ["flores", "exact", "paper"],
    "side": ["plus", "both", "minus"],
    "clearance_minus": [1e-5, 4e-5, 3e-5],
}


def with_sections(table: dict[str, Any], sections: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The ``table`` of a case with its sections updated by ``sections``; a copy, which a test may change."""
    table = deepcopy(table)
    return table | {name: table.get(name, {}) | values for name, values in sections.items()}


def small_case(**sections) -> Case:
    """A four-band lattice of 24 cells in which contacts begin early; ``sections`` update its table."""
    table = {
        "name": "small",
        "lattice": {"preset": "four-band", "cells": 24},
        "contacts": {"sites": [6, 12, 13], "clearance": 2e-4},
        "drive": {"amplitude": 24.33, "cycles": 6},
        "time": {"engine": "ts", "end": 0.05},
    }
    return Case.from_table(with_sections(table, sections))


def simulated(case: Case, observers: Sequence[type[Observer]] = ()) -> tuple[xr.Dataset, Result]:
    """The dataset and the result of a run in memory on one rank; a run that does not complete fails the test."""
    memory = RunMemory(MPI.COMM_SELF)
    result = simulate(case, memory, observers=observers)

    assert result.complete, result.sentence
    assert memory.dataset is not None
    return memory.dataset, result


def with_every_variable(run: xr.Dataset) -> xr.Dataset:
    """Return a ``run`` that was put together for a test with what it lacks of the variables of every run: no episodes.

    The energies that it lacks are 0.
    """
    lacking = {"episode": ("episode", np.zeros(0))}
    for name in RUN_NEEDS:
        if name not in run and name not in run.attrs:
            length = {"energy": ("time", run.sizes["time"]), "sites": ("site", run.sizes["site"])}
            dimension, size = length.get(name.partition("/")[0], ("episode", 0))
            lacking[name] = (dimension, np.zeros(size))
    return run.assign(lacking)


def run_of(case: Case) -> xr.Dataset:
    """The dataset of a run in memory on one rank; a run that does not complete fails the test."""
    return simulated(case)[0]


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
    return with_sections(table, sections)


# Two objectives that contradict each other: the transmitted energy at two amplitudes, of which one is minimised.
TWO = "optimise.objective=[{measure='transmitted', amplitudes=[5.0]}, {measure='transmitted', goal='minimise'}]"


def datasets(path: Path) -> dict[str, np.ndarray]:
    """Every dataset of an HDF5 file, by its path within the file."""
    found = {}

    def collect(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            found[name] = item[...]

    with h5py.File(path) as file:
        file.visititems(collect)
    return found


def assert_same_bits(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> None:
    """Assert that the datasets of two files have the same types, shapes and bits; NaN equals NaN."""
    assert first.keys() == second.keys()
    for name, values in first.items():
        assert values.dtype == second[name].dtype, name
        assert values.shape == second[name].shape, name
        if values.dtype == object:  # texts, whose bytes are addresses
            assert values.tolist() == second[name].tolist(), name
        else:
            assert values.tobytes() == second[name].tobytes(), name


def put_members(folder: Path, plan: Sweep, outcome: Callable[[int, Case], dict[str, Any] | str], file: int = 0) -> None:
    """Write a finished sweep whose members were not simulated.

    ``outcome`` returns, for a member's number and case, what is recorded of it, or a sentence that says why it failed.
    """
    # Few tests need these modules, and their import takes a noticeable part of a second.
    from vipetsc.studies.ensemble import Results
    from vipetsc.studies.sweep import conclude

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "case.toml").write_text(plan.to_toml())
    records = RecordFile(folder / f"members-{file}.jsonl")
    for number, name in enumerate(plan.ids()):
        row = outcome(number, plan.case(number))
        if isinstance(row, str):
            row = {"reason": row}
        about = {"kind": "member", "key": name, "source": source_key()}
        about |= {"warnings": [], "cpu_seconds": 0.1, "rtol": 1e-10}
        records.append(about | row)
    records.close()

    conclude(Results(plan, folder))


def record_of_linear(run: Any, name: str) -> dict[str, Any]:
    """Return the record of a linear ``run`` of that ``name``, as a sweep writes it."""
    key = " ".join([name, *map(str, run.measures)])
    return {"kind": "linear", "key": key, "source": source_key()} | run.record(name)


def modified(folder: Path) -> dict[Path, int]:
    """The time in ns at which each file below ``folder`` was last written."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


class StopAt(StopRequest):
    """A request to stop that is granted after it has been looked at ``looks`` times."""

    def __init__(self, looks: int) -> None:
        self.left = looks

    @property
    def requested(self) -> bool:
        self.left -= 1
        return self.left < 0


class InParts(Observer):
    """An observer of blocks of ten samples: a run can stop after each block."""

    name = "in-parts"
    longest = 10


# Environment variables by which Open MPI's mpirun says which rank a process is; since Open MPI 5 its layers PMIx and
# PRRTE set them. A process without mpirun sets some of them itself when it loads MPI, and its children inherit them.
NAMES_OF_RANKS = re.compile(r"(OMPI|PMIX|PRTE)_(?!MCA_|ALLOW_RUN_AS_ROOT)|OMPI_MCA_(ess|orte|pmix)")


def set_words(*changes: str) -> list[str]:
    """Return the words of the command line that change keys of a case: ``--set section.key=value`` for each."""
    words = []
    for change in changes:
        words += ["--set", change]
    return words


def clean_environment() -> dict[str, str]:
    """The environment without the variables of this process's own MPI: a child may then be an mpirun.

    All ranks are on one machine, and networks are switched off: with them Open MPI 5 would print lines about interfaces
    among those of the program, and Open MPI 4 would try some networks and take four times as long to start.
    """
    kept = {name: value for name, value in os.environ.items() if not NAMES_OF_RANKS.match(name)}
    as_root = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    one_machine = {"OMPI_MCA_btl": "^tcp,ofi,openib,uct", "OMPI_MCA_pml": "ob1"}
    return one_machine | kept | as_root


@pytest.fixture
def vipetsc():
    """Call the program as a user types it: ``vipetsc(ranks, "run", ...)`` returns the ended process."""

    def call(
        ranks: int, *arguments: object, timeout: float = 300, module: str = "vipetsc", **options
    ) -> subprocess.CompletedProcess:
        launcher = []
        if ranks:
            launcher = ["mpirun", "--oversubscribe", "-n", str(ranks)]
        command = [*launcher, sys.executable, "-m", module, *map(str, arguments)]
        options = {"capture_output": True, "text": True, "env": clean_environment()} | options
        return subprocess.run(command, timeout=timeout, check=False, **options)

    return call


@pytest.fixture
def in_process(capsys, monkeypatch):
    """Call the program in this process, on one rank, for tests that do not concern how a process begins and ends.

    ``in_process("run", ..., cwd=None)`` returns what a call of the fixture ``vipetsc`` returns.
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
def plain_pictures(monkeypatch):
    """Draw coarse pictures without their layout, the slowest step: for tests of files, not of what is seen."""
    coarse_pictures(monkeypatch.setattr)


@pytest.fixture
def with_figures(monkeypatch):
    """A function that leaves only the figures of the given names in the registry, where fewer are enough for a test."""

    # Most tests draw nothing, and need no matplotlib.
    from vipetsc.figures import registry

    def leave(*names: str) -> None:
        monkeypatch.setattr(registry, "FIGURES", {name: registry.FIGURES[name] for name in names})

    return leave


@pytest.fixture
def petsc_options():
    """Set PETSc options for one test."""
    from petsc4py import PETSc

    options = PETSc.Options()
    given = set()

    def put(**values: object) -> None:
        for name, value in values.items():
            options[name] = value
            given.add(name)

    yield put

    # The database of options belongs to the process: options that stay in it would act on the next test.
    for name in given:
        options.delValue(name)
