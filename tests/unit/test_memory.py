"""A run that needs more memory than there is says so before anything is allocated or written."""

import resource

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.case import CaseError
from vipetsc.dynamics import memory, simulate
from vipetsc.dynamics.memory import memory_available, memory_needed

HUGE = {"lattice": {"cells": 50_000_000}, "contacts": {"sites": [6], "clearance": 1e-4}}


def test_a_run_too_large_is_refused_with_what_it_needs(folder):
    for engine, least in (("ts", 90), ("propagator", 20)):
        case = small_case(**HUGE, time={"end": 0.08, "engine": engine})
        assert 1e9 * least < memory_needed(case.model(), case.output, engine, 1) < 2e9 * least
    with pytest.raises(CaseError, match=r"50000000 cells, 1 sites and 401 samples need \d+ GB of memory on a rank"):
        simulate(small_case(**HUGE), folder / "run")
    assert not (folder / "run").exists()


def test_ranks_windows_and_writers_share_what_is_needed():
    def needed(ranks, **output):
        case = small_case(**HUGE, output=output)
        return memory_needed(case.model(), case.output, "ts", ranks)

    assert needed(4, writer="parallel") < needed(4, writer="gather") < needed(1)
    assert needed(1, window=[1, 100]) < needed(1)
    assert needed(1, every=10**6) < needed(1)


def test_the_limit_of_the_process_counts(monkeypatch):
    free = memory_available()
    assert 2**26 < free < 2**50
    taken = int(np.fromfile("/proc/self/statm", sep=" ")[0]) * resource.getpagesize()
    monkeypatch.setattr(memory.resource, "getrlimit", lambda _: (taken + 2**20, taken + 2**20))
    assert abs(memory_available() - 2**20) < 2**24
