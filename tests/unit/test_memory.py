"""Runs that need more memory than is available are refused before anything is allocated or written."""

import tracemalloc
from types import SimpleNamespace

import pytest

from tests.conftest import small_case
from vipetsc.case import CaseError
from vipetsc.dynamics import memory, simulate
from vipetsc.dynamics.lattice_record import create_record
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.memory import memory_needed
from vipetsc.dynamics.plan import RunPlan, estimate

HUGE = {"lattice": {"cells": 50_000_000}, "contacts": {"sites": [6], "clearance": 1e-4}}


def needs_of_many_sites(ranks: int = 1, end: float = 0.01) -> dict[str, float]:
    """Return bytes by key that the propagator needs on a rank for a million cells with about 100,000 sites."""
    case = small_case(
        lattice={"cells": 1_000_000},
        contacts={"sites": {"first": 5, "spacing": 10, "count": 99_999}, "clearance": 1e-4},
        time={"end": end, "engine": "propagator", "sample_interval": 2e-4},
        output={"window": [1, 9]},
    )
    return memory_needed(case.model(), case.output, "propagator", ranks)


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


def test_a_run_too_large_is_refused_with_what_it_needs(folder):
    with pytest.raises(CaseError, match=r"50000000 cells, 1 sites and 251 samples need \d+ GB of memory per rank"):
        simulate(small_case(**HUGE), folder / "run")
    assert not (folder / "run").exists()


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
