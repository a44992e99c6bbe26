"""A lattice of one cell: a mass between two walls that meets a stop, in runs, bands, modes and frequency responses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.conftest import run_of
from tests.rigs import TWO_MASSES
from vipetsc.case import Case
from vipetsc.cli.case_rows import lattice_rows
from vipetsc.lattice.damped import damped_bloch
from vipetsc.lattice.modes import linear_modes

pytestmark = pytest.mark.parallel(1)

# A mass of 1 kg on two springs of 0.75 N/m, with a dashpot of 0.06 N s/m to the ground and a stop of 20 N/m at 0.4 m.
# The left wall shakes.
CELL = TWO_MASSES["lattice"]["cell"] | {"springs": [{"start": 1, "end": 1, "stiffness": 0.75, "next_cell": True}]}
ONE_MASS: dict[str, Any] = TWO_MASSES | {
    "lattice": TWO_MASSES["lattice"] | {"cells": 1, "cell": CELL},
    "contacts": TWO_MASSES["contacts"] | {"clearance": 0.4},
    "nfrc": TWO_MASSES["nfrc"] | {"range": [0.9, 2.3], "harmonics": 31},
}


@pytest.mark.parametrize("ends", ["free", "fixed", "periodic"])
@pytest.mark.parametrize(
    "cell",
    [
        {"masses": [1.0]},
        # The stop is that of the first mass, which takes a second one along by a spring.
        {"masses": [1.0, 0.1], "springs": [{"start": 1, "end": 2, "stiffness": 10.0}]},
        # A second mass that nothing holds stays where it is.
        {"masses": [1.0, 0.1]},
    ],
)
def test_nothing_has_to_connect_a_single_cell(cell, ends):
    """A mass flies at 1 m/s onto an elastic stop 1 m away and comes back; alone, at the speed at which it came."""
    table = {
        "lattice": {"cells": 1, "ends": ends, "cell": cell},
        "contacts": {"stiffness": 1e6, "sites": [1], "pair": [0, 1], "side": "minus", "clearance": 1.0},
        "initial": {"kind": "velocity", "cell": 1, "velocity": -1.0},
        "time": {"end": 2.0, "sample_interval": 0.01},
    }
    case = Case.from_table(table)
    run = run_of(case)
    stored = run["energy/kinetic"] + run["energy/spring"] + run["energy/contact"]
    assert stored.values == pytest.approx(0.5, rel=1e-9)
    if "springs" not in cell:
        # The contact of 1 kg on 1e6 N/m^1.5 lasts 3.2181 (m^2/(k^2 v))^(1/5) = 0.01281 s.
        assert run["displacement"].values[-1, 0, 0] == pytest.approx(-0.012811, abs=1e-5)
        assert run["velocity"].values[-1, 0, 0] == pytest.approx(1.0, rel=1e-9)
    rows = dict(lattice_rows(case))
    assert rows["clearance"] == "1000 mm on side -"
    assert rows["lattice"].startswith("1 cell, ")
    without = Case.from_table(table | {"contacts": {"sites": []}})
    assert dict(lattice_rows(without))["contact"] == "none"
    assert not [text for text in case.warnings() if "wavelength" in text]


def test_its_only_mode():
    """The only mode of one mass has the frequency sqrt(1.5) rad/s."""
    modes = linear_modes(Case.from_table(ONE_MASS).model().chain)
    assert modes.frequency == pytest.approx([np.sqrt(1.5)])
    assert np.abs(modes.vectors) == pytest.approx(np.ones((1, 1)))


def test_dashpots_alone_resist_a_motion_of_equal_masses_together():
    """A common motion of all masses, kappa = 0, has no stiffness: of its two rates, 0 and -0.06 1/s, 0 is given."""
    cell = Case.from_table(ONE_MASS).model().chain.cell
    assert damped_bloch(cell, 0.0).rate == pytest.approx([0.0], abs=1e-12)
    # A long wave is overdamped: s^2 + 0.06 s + omega^2 = 0 has two real rates, of which the slower one is given.
    rate = damped_bloch(cell, 0.01).rate[0]
    squared = 4 * 0.75 * np.sin(0.005) ** 2
    assert rate == pytest.approx(-0.03 + np.sqrt(0.03**2 - squared), rel=1e-9)
