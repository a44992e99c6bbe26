"""Runs that fail end in the same way on any number of ranks: samples, log, sentence and counts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from tests.mpi.alike import as_alone
from vipetsc.case import Case
from vipetsc.dynamics.observers import Observer

STALLING = 1e45  # N/m


class Spoiler(Observer):
    """An observer that makes one number of cell 36 of the state NaN after the first block of samples."""

    name = "test-spoiler"
    # A block has so many samples. Checkpoints are written as often: engines may go back to the last one.
    longest = 61
    cell = 35

    def observe(self, block):
        layout = self.setup.layout
        if block.first == 0 and layout.start <= self.cell < layout.stop:
            block.state.array[self.cell - layout.start] = np.nan


def struck_case(
    stiffness: list[float],
    sites: Sequence[int] = (5, 20, 35),
    struck: Sequence[int] = (5, 20, 35),
    name: str = "propagator",
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
        "time": {"end": 0.02, "engine": name, "rtol": 1e-8, "sample_interval": interval},
    }
    return Case.from_table(table)


# All sites close in the step in which one of them stalls: the others are followed to its end.
AT_ONCE = struck_case([1e6, 1e6, STALLING])
# Other contacts have ended before a site stalls, and would go on after it. With samples 0.8 ms apart, several steps,
# the stall lies between two samples; with checkpoints some contacts were logged at one.
LATE = struck_case([1e6, 1e6, STALLING], struck=[5, 20, 31])
BETWEEN = struck_case([1e6, 1e6, STALLING], struck=[5, 20, 31], interval=8e-4, damping={"mass": 10.0})
# Sites in cells 40 and 30 of a ring stall at one time. Rank 0 feels the first one, but not the other.
RING = struck_case([STALLING, STALLING], sites=[40, 30], struck=[40, 30], ends="periodic")
# Contacts of ranks whose cells are still finite are followed up to the sample at which one is not.
FINITE = struck_case([1e6, 1e6, 1e6], sites=[5, 12, 20])
BY_TS = struck_case([1e6, 1e6, 1e6], sites=[5, 12, 20], name="ts")
# The forces of this stop do not reach another rank within a step of ts.
DRIVEN = Case.from_table({
    "lattice": {"preset": "diatomic", "cells": 40},
    "contacts": {"law": "bilinear", "stiffness": 1e30, "sites": [5], "clearance": 1e-5},
    "drive": {"amplitude": 20.0},
    "time": {"end": 0.02, "engine": "ts", "rtol": 1e-8},
})  # fmt: skip
FAILING = {
    "at once": (AT_ONCE, (), None, "stalled: the contacts of sites 3", 3),
    "late": (LATE, (), 5, "stalled: the contacts of sites 3 at 0.0029", 19),
    "between samples": (BETWEEN, (), 2, "stalled: the contacts of sites 3 at 0.0029", 19),
    "on a ring": (RING, (), None, "stalled: the contacts of sites 2 at", 0),
    "not finite": (FINITE, (Spoiler,), Spoiler.longest, "the state is not finite", 5),
    "not finite, by ts": (BY_TS, (Spoiler,), Spoiler.longest, "the state is not finite", 5),
    "by ts": (DRIVEN, (), None, "stalled: the step fell to", 0),
}


def assert_ends_as_alone(name: str) -> None:
    """Assert that a run fails for its reason after at least some contacts, on all ranks as on one."""
    case, observers, states_every, reason, episodes = FAILING[name]
    result = as_alone(case, observers, states_every)
    assert not result.complete
    assert not result.resumable
    assert result.sentence.startswith(reason)
    assert result.statistics["episodes"] >= episodes


@pytest.mark.parallel([2])
@pytest.mark.parametrize("name", FAILING)
def test_a_run_that_fails_ends_as_on_one_rank(name):
    assert_ends_as_alone(name)


@pytest.mark.parallel([3])
def test_a_run_that_fails_on_one_of_three_ranks_ends_as_on_one():
    assert_ends_as_alone("between samples")
