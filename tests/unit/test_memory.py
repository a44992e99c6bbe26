"""A run that needs more memory than there is says so before anything is allocated or written."""

import resource

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.case import CaseError
from vipetsc.cli.verbs.run_verb import run_rows
from vipetsc.dynamics import memory, simulate
from vipetsc.dynamics.memory import memory_available, memory_needed

HUGE = {"lattice": {"cells": 50_000_000}, "contacts": {"sites": [6], "clearance": 1e-4}}


def needed(case, engine, ranks=1):
    return sum(memory_needed(case.model(), case.output, engine, ranks).values())


@pytest.mark.slow
def test_memory_grows_with_cells_and_sites_of_a_rank_but_not_with_samples_times_sites():
    """As counted and fitted to one run: 192 MB of states of a million cells, 2.4 to 3.5 kB a site."""

    def parts(cells=1_000_000, sites=100_000, ranks=1, end=0.01):
        named = {"sites": {"first": 5, "spacing": cells // sites, "count": sites - 1}, "clearance": 1e-4}
        time = {"end": end, "engine": "propagator", "sample_interval": 2e-4}
        case = small_case(lattice={"cells": cells}, contacts=named, time=time, output={"window": [1, 9]})
        return memory_needed(case.model(), case.output, "propagator", ranks)

    one, two, long = parts(), parts(ranks=2), parts(end=10.0)
    assert one["lattice.cells"] == 2 * two["lattice.cells"] == pytest.approx(192e6)
    assert 2.4e8 < one["contacts.sites"] < 3.5e8
    assert two["contacts.sites"] < 0.7 * one["contacts.sites"]
    assert sum(long.values()) < sum(one.values()) + 0.2e9


def test_what_takes_most_is_named_with_a_remedy(folder, monkeypatch):
    monkeypatch.setattr(memory, "memory_available", lambda: 2**10)
    for key, case in (
        ("lattice.cells: 24 cells", small_case(time={"end": 2e-4, "sample_interval": 1e-4})),
        ("time.sample_interval: 24 cells", small_case(time={"end": 100.0}, output={"window": [1, 2]})),
        ("contacts.sites: 24 cells", small_case(contacts={"sites": list(range(1, 25))}, time={"end": 2e-4})),
    ):
        with pytest.raises(CaseError, match=f"{key}.* need .* on a rank, which has .*; fewer .* need less"):
            simulate(case, folder / "run")


def test_a_run_too_large_is_refused_with_what_it_needs(folder):
    for engine, least in (("ts", 90), ("propagator", 10)):
        case = small_case(**HUGE, time={"end": 0.08, "engine": engine})
        assert 1e9 * least < needed(case, engine) < 2e9 * least
    with pytest.raises(CaseError, match=r"50000000 cells, 1 sites and 251 samples need \d+ GB of memory on a rank"):
        simulate(small_case(**HUGE), folder / "run")
    assert not (folder / "run").exists()


def test_a_state_beyond_petscs_indices_is_refused_with_the_build_that_counts_it(folder, monkeypatch):
    case = small_case(lattice={"cells": 300_000_000}, contacts={"sites": [6], "clearance": 1e-4})
    said = r"lattice.cells = 300000000: makes a state of 2400000002 numbers, more than the 2147483647 .*64-bit-indices"
    monkeypatch.setattr(memory.PETSc, "IntType", np.int32)
    for refused in (lambda: simulate(case, folder / "run"), lambda: run_rows(case, 1)):
        with pytest.raises(CaseError, match=said):
            refused()
    monkeypatch.setattr(memory.PETSc, "IntType", np.int64)
    with pytest.raises(CaseError, match="300000000 cells, 1 sites and 251 samples need"):
        simulate(case, folder / "run")


def test_ranks_windows_and_writers_share_what_is_needed():
    def on(ranks, **output):
        case = small_case(**HUGE, output=output)
        return needed(case, "ts", ranks)

    assert on(4, writer="parallel") < on(4, writer="gather") < on(1)
    assert on(1, window=[1, 100]) < on(1)
    assert on(1, every=10**6) < on(1)


def test_the_limit_of_the_process_counts(monkeypatch):
    free = memory_available()
    assert 2**26 < free < 2**50
    taken = int(np.fromfile("/proc/self/statm", sep=" ")[0]) * resource.getpagesize()
    monkeypatch.setattr(memory.resource, "getrlimit", lambda _: (taken + 2**20, taken + 2**20))
    assert abs(memory_available() - 2**20) < 2**24
