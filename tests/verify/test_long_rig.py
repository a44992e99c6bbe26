"""Damped rigs of 100 cells, whose frequency response takes a tenth of a second of CPU time for each state."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from tests.rigs import TWO_MASSES, followed
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.balance import hill, order_matrices
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

pytestmark = pytest.mark.parallel(1)


def rig(sites: list[int], **nfrc: Any) -> NfrcCase:
    """The case of 100 masses between walls, of which the left one shakes, with stops on one side at ``sites``."""
    options = {"range": [1.2, 1.6], "fixed": [0.2], "harmonics": 41} | nfrc
    return NfrcCase.from_table(
        TWO_MASSES
        | {
            "lattice": TWO_MASSES["lattice"] | {"cells": 100},
            "contacts": TWO_MASSES["contacts"] | {"sites": sites, "clearance": 0.05},
            "nfrc": TWO_MASSES["nfrc"] | options,
        }
    )


def test_two_hundred_states_would_take_less_than_twenty_seconds(tmp_path):
    """Twenty states with their stability take less than 2 s of CPU time, a tenth of the bound for two hundred."""
    case = rig([3], points=20)
    first_state(SteadyStates(rig([3], harmonics=3), 1.0, 0.2))  # kernels are compiled or read
    begin = time.process_time()
    _, points = followed(case, tmp_path / "long")
    assert time.process_time() - begin < 2.0
    assert len(points) >= 20
    assert all(point.measured.episodes for point in points)


def test_stops_that_are_not_touched_do_not_count(monkeypatch):
    """Hill's determinant with five stops is that of the stops that the motion meets, those next to the wall."""
    states = SteadyStates(rig([2, 4, 50, 70, 90], harmonics=9), 1.0, 0.2)
    xi = first_state(states).xi
    series = states.balance.series(xi[:-1] * states.clearance, 1.2)
    assert 0 < len(series.acting) < 5
    exponents = np.array([1e-3, 0.02 + 0.3j, 0.1 + 0.5j])
    few = hill.Hill(states.compliance, 1.2, 9, odd=False, finite=True).determinants(series, exponents)
    for module in (hill, order_matrices):
        monkeypatch.setattr(module, "FEW_PAIRS", 5)
    every = hill.Hill(states.compliance, 1.2, 9, odd=False, finite=True).determinants(series, exponents)
    np.testing.assert_allclose(few, every, rtol=1e-9)
    assert np.abs(every - 1).max() > 1e-3
