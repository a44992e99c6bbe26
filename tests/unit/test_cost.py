"""The estimated cost of a run on several ranks."""

from __future__ import annotations

import pytest

from vipetsc.case import Case
from vipetsc.dynamics.cost import estimate


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_ranks_are_advised_against_where_messages_cost_what_they_save(engine):
    """Of the built-in lattice one rank is as fast as two, as was measured; of one ten times as long it is not."""
    short = Case.load(overrides=[f"time.engine={engine}"])
    long = short.varied(overrides=["lattice.cells=3000"])

    assert estimate(short, 2).one_rank_suffices
    assert not estimate(short, 1).one_rank_suffices
    assert not estimate(long, 2).one_rank_suffices
    assert "one rank would be as fast" in estimate(short, 2).faster
    assert estimate(short, 2).seconds == pytest.approx(estimate(short, 1).seconds, rel=0.1)
    assert "one rank" not in estimate(short, 1).faster

    assert "one rank" not in estimate(long, 2).faster
    assert estimate(long, 2).seconds < 0.75 * estimate(long, 2).alone
    assert estimate(long, 2).alone == estimate(long, 1).seconds
