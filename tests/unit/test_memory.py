"""Runs that need more memory than is available are refused before anything is allocated or written."""

import resource
import tracemalloc
from types import SimpleNamespace
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.case import Case, CaseError
from vipetsc.cli.verbs.run_verb import run_rows
from vipetsc.dynamics import memory, simulate
from vipetsc.dynamics.cost import estimate
from vipetsc.dynamics.lattice_record import create_record
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.memory import memory_available, memory_needed
from vipetsc.dynamics.plan import RunPlan
from vipetsc.io.store import RunFolder

HUGE = {"lattice": {"cells": 50_000_000}, "contacts": {"sites": [6], "clearance": 1e-4}}


def bytes_needed(case: Case, engine: str, ranks: int = 1) -> float:
    """Return the bytes that a rank needs in total."""
    return sum(memory_needed(case.model(), case.output, engine, ranks).values())


def needs_of_many_sites(ranks: int = 1, end: float = 0.01) -> dict[str, float]:
    """Return bytes by key that the propagator needs on a rank for a million cells with about 100,000 sites."""
    case = small_case(
        lattice={"cells": 1_000_000},
        contacts={"sites": {"first": 5, "spacing": 10, "count": 99_999}, "clearance": 1e-4},
        time={"end": end, "engine": "propagator", "sample_interval": 2e-4},
        output={"window": [1, 9]},
    )
    return memory_needed(case.model(), case.output, "propagator", ranks)


@pytest.mark.slow
def test_memory_grows_with_cells_and_sites_of_a_rank_but_not_with_samples_times_sites():
    """A million cells need 192 MB of states and each site 2.4 to 3.5 kB, as was fitted to one measured run."""
    one = needs_of_many_sites()
    two = needs_of_many_sites(ranks=2)
    assert one["lattice.cells"] == 2 * two["lattice.cells"] == pytest.approx(192e6)
    assert 2.4e8 < one["contacts.sites"] < 3.5e8
    # A part of the sites' memory is needed on every rank.
    assert two["contacts.sites"] < 0.7 * one["contacts.sites"]
    # 50,000 more samples of all 100,000 sites would take 40 GB.
    assert sum(needs_of_many_sites(end=10.0).values()) < sum(one.values()) + 0.2e9


@pytest.mark.parametrize(
    ("key", "sections"),
    [
        ("lattice.cells: 24 cells", {"time": {"end": 2e-4, "sample_interval": 1e-4}}),
        ("time.sample_interval: 24 cells", {"time": {"end": 100.0}, "output": {"window": [1, 2]}}),
        ("contacts.sites: 24 cells", {"contacts": {"sites": list(range(1, 25))}, "time": {"end": 2e-4}}),
    ],
)
def test_what_takes_most_is_named_with_a_remedy(folder, monkeypatch, key, sections):
    """The error names the key that takes most memory, and how to reduce it."""
    monkeypatch.setattr(memory, "memory_available", lambda: 2**10)
    with pytest.raises(CaseError, match=f"{key}.* need .* per rank, but only .*; fewer .* reduce it"):
        simulate(small_case(**sections), folder / "run")


@pytest.mark.parametrize(("engine", "least"), [("ts", 90e9), ("propagator", 10e9)])
def test_a_lattice_of_fifty_million_cells_needs_many_gigabytes(engine, least):
    case = small_case(**HUGE, time={"end": 0.08, "engine": engine})
    assert least < bytes_needed(case, engine) < 2 * least


def test_a_run_too_large_is_refused_with_what_it_needs(folder):
    with pytest.raises(CaseError, match=r"50000000 cells, 1 sites and 251 samples need \d+ GB of memory per rank"):
        simulate(small_case(**HUGE), folder / "run")
    assert not (folder / "run").exists()


def test_a_state_beyond_petscs_indices_is_refused_with_the_build_that_counts_it(folder, monkeypatch):
    """A state of more than 2^31 - 1 numbers is refused with a hint at PETSc with 64-bit indices."""
    case = small_case(lattice={"cells": 300_000_000}, contacts={"sites": [6], "clearance": 1e-4})
    message = r"lattice.cells = 300000000: results in a state of 2400000002 numbers, .*2147483647 .*64-bit-indices"
    monkeypatch.setattr(PETSc, "IntType", np.int32)
    with pytest.raises(CaseError, match=message):
        simulate(case, folder / "run")
    with pytest.raises(CaseError, match=message):
        run_rows(case, 1)

    # With wider indices the run is refused for its memory, as any other.
    monkeypatch.setattr(PETSc, "IntType", np.int64)
    with pytest.raises(CaseError, match="300000000 cells, 1 sites and 251 samples need"):
        simulate(case, folder / "run")


def test_ranks_and_windows_divide_what_is_needed():
    def needed_on(ranks: int, **output: Any) -> float:
        return bytes_needed(small_case(**HUGE, output=output), "ts", ranks)

    assert needed_on(4) < needed_on(1)
    assert needed_on(1, window=[1, 100]) < needed_on(1)
    assert needed_on(1, every=10**6) < needed_on(1)


def test_the_limit_of_the_process_counts(monkeypatch):
    """The available memory is at most the limit of the process less its present size."""
    assert 2**26 < memory_available() < 2**50
    used = int(np.fromfile("/proc/self/statm", sep=" ")[0]) * resource.getpagesize()
    limit = used + 2**20
    monkeypatch.setattr(memory.resource, "getrlimit", lambda _: (limit, limit))
    # This process may have grown since then.
    assert abs(memory_available() - 2**20) < 2**24


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_a_billion_equal_linear_cells_cost_an_estimate_and_a_rank_next_to_nothing(ends):
    """No cell is looked at one by one, neither by the estimate of the whole run nor in a rank's part of it."""
    case = small_case(lattice={"cells": 1_000_000_000, "ends": ends}, contacts={"sites": [300]}, output={"fields": []})
    model = case.model()
    tracemalloc.start()
    estimate(RunPlan.of(case), 1000)
    create_record(model, Layout(model, SimpleNamespace(rank=0, size=1000)))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1e7


def test_checkpoints_add_little_to_what_a_long_lattice_records(folder):
    """Where a chunk is one sample, a state as large as a sample follows every fourth one, not each."""
    sizes: list[int] = []

    class Folder(RunFolder):
        def save_state(self, state):
            sizes.append(sum(array.nbytes for array in state.values()))
            super().save_state(state)

    case = small_case(lattice={"cells": 60}, contacts={"sites": []}, time={"end": 4e-3, "sample_interval": 1e-4})
    output = Folder(folder / "run", MPI.COMM_SELF)
    output.chunk_length = 1
    result = simulate(case, output)
    assert result.complete
    recorded = 2 * 8 * 60 * 4 * result.statistics["samples"]
    assert 0.1 * recorded < sum(sizes) < 0.5 * recorded
