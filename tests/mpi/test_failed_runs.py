"""Runs of the propagator that fail end in the same way on any number of ranks: samples, log, sentence and counts."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import assert_same_bits
from tests.mpi.test_partition import Spoiler
from vipetsc.case import Case
from vipetsc.dynamics import simulate
from vipetsc.dynamics.observers import Observer
from vipetsc.dynamics.result import Result
from vipetsc.io.store import RunMemory
from vipetsc.parallel import on_root

STALLING = 1e45  # N/m


def ends_as_alone(case: Case, states_every: int | None = None, observers: Sequence[type[Observer]] = ()) -> Result:
    """Simulate ``case``, which fails, on all ranks and on rank 0 alone, and assert that both end in the same way."""
    memory = RunMemory(MPI.COMM_WORLD, states_every)
    together = simulate(case, memory, observers=observers)
    assert not together.complete

    def compare() -> None:
        memory_alone = RunMemory(MPI.COMM_SELF, states_every)
        alone = simulate(case, memory_alone, observers=observers)

        assert together.sentence == alone.sentence
        assert together.warnings == alone.warnings
        assert counts(together) == counts(alone)
        assert_same_bits(arrays(memory), arrays(memory_alone))

    on_root(MPI.COMM_WORLD, compare)
    return together


def counts(result: Result) -> dict[str, object]:
    """The statistics of a run without its times."""
    return {name: value for name, value in result.statistics.items() if not name.endswith("_seconds")}


def arrays(memory: RunMemory) -> dict[str, np.ndarray]:
    """Every array of the run in ``memory``, by its name."""
    assert memory.dataset is not None
    return {str(name): variable.values for name, variable in memory.dataset.variables.items()}


def struck_case(
    stiffness: list[float],
    sites: Sequence[int] = (5, 20, 35),
    struck: Sequence[int] = (5, 20, 35),
    interval: float = 2e-4,
    **lattice: object,
) -> Case:
    """A free diatomic lattice of 40 cells with these sites, whose cells ``struck`` move first; ``lattice`` updates it.

    The ``stiffness`` (site,) of the contacts is in N/m, the ``interval`` of samples in s.
    """
    first, *others = ({"cell": cell, "velocity": 1.0} for cell in struck)
    each = {"stiffness": stiffness}
    table = {
        "lattice": {"preset": "diatomic", "cells": 40, "ends": "free", **lattice},
        "contacts": {"law": "bilinear", "sites": list(sites), "clearance": 1e-5, "each": each},
        "initial": {"kind": "velocity", **first, "more": others},
        "time": {"end": 0.02, "engine": "propagator", "rtol": 1e-8, "sample_interval": interval},
    }
    return Case.from_table(table)


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("stiffness", [[STALLING, 1e6, 1e6], [1e6, 1e6, STALLING]])
def test_contacts_of_the_step_that_stalls_are_logged(stiffness):
    """All sites close in the step in which one of them stalls: the others are followed to its end."""
    result = ends_as_alone(struck_case(stiffness))
    assert "stalled" in result.sentence
    assert result.statistics["episodes"] == 3


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize(
    ("states_every", "interval", "damping"), [(None, 2e-4, None), (5, 2e-4, None), (2, 8e-4, {"mass": 10.0})]
)
def test_contacts_after_the_stall_are_not_logged(states_every, interval, damping):
    """Other contacts have ended before a site stalls, and would go on after it; some were logged at a checkpoint.

    With samples 0.8 ms apart, several steps, the stall lies between two samples.
    """
    case = struck_case([1e6, 1e6, STALLING], struck=[5, 20, 31], interval=interval, damping=damping)
    result = ends_as_alone(case, states_every)
    assert "stalled: the contacts of sites 3 at 0.0029" in result.sentence
    assert result.statistics["episodes"] == 19


@pytest.mark.parallel([2, 3])
def test_of_sites_that_stall_at_once_the_first_is_named():
    """Sites in cells 40 and 30 of a ring stall at one time. Rank 0 feels the first one, but not the other."""
    result = ends_as_alone(struck_case([STALLING, STALLING], sites=[40, 30], struck=[40, 30], ends="periodic"))
    assert "stalled: the contacts of sites 2 at" in result.sentence


@pytest.mark.parallel([2, 3])
def test_a_state_that_is_not_finite_ends_the_log():
    """Contacts of ranks whose cells are still finite are followed up to the sample at which one is not."""
    result = ends_as_alone(struck_case([1e6, 1e6, 1e6], sites=[5, 12, 20]), Spoiler.longest, [Spoiler])
    assert result.sentence.startswith("the state is not finite")
    assert result.statistics["episodes"] > 5
