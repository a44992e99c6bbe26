"""Runs whose sites all have laws of their own: the common law of the table, which no site uses, is not computed."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.conftest import small_case
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory


@pytest.mark.parametrize("engine", ["ts", "propagator"])
@pytest.mark.parametrize("damping", ["exact", "flores"])
def test_a_law_that_no_site_has_may_have_no_limit(engine, damping):
    """A run is complete although the common law, which no site has, would have an infinite damping factor."""
    # The damping factors of both names grow without bound as the restitution tends to 0.
    contacts = {"restitution": 0.0, "damping": damping, "each": {"restitution": [0.5, 0.6, 0.7]}}
    case = small_case(contacts=contacts, time={"end": 0.04, "engine": engine})
    memory = RunMemory(MPI.COMM_SELF)
    result = simulate(case, memory)
    assert result.complete
    assert len(memory.dataset["impacts/site"]) > 0


def test_no_warning_of_hertz_where_all_sites_have_another_law():
    sites = {"sites": [6, 12], "clearance": 1e-6, "radius": 1e-9, "stiffness": 2e4}
    time = {"end": 0.02, "engine": "ts"}
    results = []
    for laws in (["bilinear", "bilinear"], ["bilinear", "hertz"]):
        case = small_case(contacts=sites | {"each": {"law": laws}}, time=time)
        results.append(simulate(case, RunMemory(MPI.COMM_SELF)))
    warned = [any("Hertz" in warning for warning in result.warnings) for result in results]
    assert warned == [False, True]
