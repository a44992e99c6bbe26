"""Damped rigs of 100 cells: what a state of their frequency response costs, and which stops count in it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.rigs import TWO_MASSES
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes import stability
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


def test_stops_that_are_not_touched_do_not_count(monkeypatch):
    """Hill's determinant with five stops is that of the stops that the motion meets, those next to the wall."""
    states = SteadyStates(rig([2, 4, 50, 70, 90], harmonics=9), 1.0, 0.2)
    xi = first_state(states).xi
    series = states.balance.series(xi[:-1] * states.clearance, 1.2)
    assert 0 < len(series.acting) < 5
    exponents = np.array([1e-3, 0.02 + 0.3j, 0.1 + 0.5j])
    few = stability.Hill(states.compliance, 1.2, 9, odd=False, finite=True).determinants(series, exponents)
    monkeypatch.setattr(type(series), "acting", property(lambda self: np.arange(5)))
    every = stability.Hill(states.compliance, 1.2, 9, odd=False, finite=True).determinants(series, exponents)
    np.testing.assert_allclose(few, every, rtol=1e-9)
    assert np.abs(every - 1).max() > 1e-3
