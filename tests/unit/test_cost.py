"""The estimated cost of a run on several ranks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vipetsc
from vipetsc.case import Case, Model
from vipetsc.dynamics.cost import MOVING_ON, expected_episodes
from vipetsc.dynamics.plan import choose_engine
from vipetsc.lattice.sites import sites_at

CYCLES = 10
EXAMPLES = Path(vipetsc.__file__).parent / "examples"


def chain_with_a_stop(contacts: dict[str, Any], drive: dict[str, Any], over: float) -> Model:
    """Return the model of a chain of equal masses that is driven at (k/m)^1/2, with the stops of ``contacts``.

    The displacement is ``over`` times the clearance. At this frequency 2 sin(kappa/2) = 1, hence the relative
    displacement of neighbours has the amplitude of the displacement.
    """
    spring = {"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True}
    table = {
        "lattice": {"cells": 200, "cell": {"masses": [0.01], "springs": [spring]}},
        "contacts": {"stiffness": 1e6, "sites": [40], "clearance": 1e-4} | contacts,
        "drive": {"amplitude": 1.0, "frequency": 1000.0} | drive,
        "time": {"end": 0.2},
    }
    model = Case.from_table(table).model()
    gaps = np.where(np.isfinite(model.chain.sites.gaps), model.scale / over, np.inf)
    sites = sites_at(model.chain.sites.cells, model.chain.sites.pairs, gaps=gaps)
    return replace(model, chain=replace(model.chain, sites=sites))


@pytest.mark.parametrize(
    ("contacts", "stops"),
    [
        ({"pair": [0, 1], "side": "both"}, 2),
        ({"pair": [0, 1], "side": "minus"}, 1),
        ({"pair": [1, 1], "next_cell": True, "side": "both"}, 2),
        ({"pair": [1, 1], "next_cell": True, "side": "plus"}, 1),
    ],
)
def test_contacts_are_expected_of_every_pair_at_every_stop(contacts, stops):
    """A burst whose largest displacement is twice the clearance touches each stop once in half of its cycles."""
    burst = {"cycles": CYCLES}
    assert expected_episodes(chain_with_a_stop(contacts, burst, over=2.0)) == pytest.approx(stops * CYCLES / 2)
    assert expected_episodes(chain_with_a_stop(contacts, burst, over=0.99)) == 0.0


@pytest.mark.parametrize(
    ("example", "came"), [("four-band", 181), ("stops", 95), ("three-mass", 100), ("damped", 393), ("disorder", 210)]
)
def test_the_contacts_of_shipped_bursts_are_foretold_within_a_factor_of_two(example, came):
    """``came`` are the contacts of the runs; with disorder they depend on its seed."""
    model = Case.load(EXAMPLES / f"{example}.toml").model()
    assert 0.5 < MOVING_ON * expected_episodes(model) / came < 2.0


def test_a_sine_that_does_not_end_is_beyond_a_clearance_all_the_time():
    """The wave of a harmonic drive touches both stops in each of omega t/(2 pi) cycles if it exceeds the clearance."""
    sine = {"waveform": "harmonic"}
    stop = {"pair": [0, 1], "side": "both"}
    assert expected_episodes(chain_with_a_stop(stop, sine, over=1.01)) == pytest.approx(2 * 0.2 * 1000.0 / (2 * np.pi))
    assert expected_episodes(chain_with_a_stop(stop, sine, over=0.99)) == 0.0


@pytest.mark.parametrize(
    ("lattice", "time", "engine"),
    [
        ({"strip": {"mass": 0.01, "stiffness": 1e4, "rows": 40}}, {}, "ts"),
        ({"strip": {"mass": 0.01, "stiffness": 1e4, "rows": 40}}, {"end": 10.0}, "propagator"),
        ({"strip": {"mass": 0.01, "stiffness": 1e4, "rows": 40}}, {"engine": "propagator"}, "propagator"),
        ({"strip": {"mass": 0.01, "stiffness": 1e4, "rows": 4}}, {}, "propagator"),
        ({"preset": "four-band"}, {}, "propagator"),
        ({"preset": "four-band", "cells": 10_000}, {}, "propagator"),
    ],
)
def test_a_case_that_names_no_engine_has_the_one_that_costs_less(lattice, time, engine):
    """Set-up of the propagator grows with the square of a strip's width, which a long run repays and a short does not.

    A short run of a narrow lattice keeps the propagator: what there is to save is not noticed.
    """
    case = Case.from_table(
        {
            "lattice": {"cells": 40} | lattice,
            "contacts": {"stiffness": 1e6, "sites": []},
            "drive": {"amplitude": 1.0, "cycles": 3, "frequency": 500.0},
            "time": {"end": 0.02, "sample_interval": 1e-4} | time,
        }
    )
    assert choose_engine(case, case.model()).name == engine
