"""Runs on all ranks beside the same run on one: every number that is known of them must have the same bits."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from tests.conftest import assert_same_bits
from vipetsc.case import Case
from vipetsc.dynamics import simulate
from vipetsc.dynamics.observers import Observer
from vipetsc.dynamics.result import Result
from vipetsc.io.store import RunMemory
from vipetsc.parallel import on_root

COMM = MPI.COMM_WORLD


def as_alone(case: Case, observers: Sequence[type[Observer]] = (), states_every: int | None = None) -> Result:
    """Simulate ``case`` on all ranks and on rank 0 alone, and assert that both end alike, to the bit."""
    memory = RunMemory(COMM, states_every)
    together = simulate(case, memory, observers=observers)

    def compare() -> None:
        memory_alone = RunMemory(MPI.COMM_SELF, states_every)
        alone = simulate(case, memory_alone, observers=observers)

        assert together.sentence == alone.sentence
        assert together.warnings == alone.warnings
        assert counts(together) == counts(alone)
        assert_same_bits(arrays(memory), arrays(memory_alone))

    on_root(COMM, compare)
    return together


def counts(result: Result) -> dict[str, object]:
    """Return the statistics of a run without its times."""
    return {name: value for name, value in result.statistics.items() if not name.endswith("_seconds")}


def arrays(memory: RunMemory) -> dict[str, np.ndarray]:
    """Return every array of the run in ``memory``, by its name."""
    assert memory.dataset is not None
    return {str(name): variable.values for name, variable in memory.dataset.variables.items()}
