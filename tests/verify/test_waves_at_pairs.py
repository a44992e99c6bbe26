"""An incident wave in an infinite lattice whose contacts join other masses than the cell's pair.

Contacts are with the ground, with the next cell, and two in one cell. Results are compared with energy balances, mirror
images, direct solutions of long lattices, and a run that ends before waves come back from the ends.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.sparse import diags
from scipy.sparse.linalg import spsolve

from tests.conftest import run_of
from tests.models import TWO_MASS_CELL
from tests.steady_states import first_harmonic
from vipetsc.case import Case
from vipetsc.case.nfrc import NfrcCase
from vipetsc.lattice import Chain, Spring, UnitCell, WaveCompliance
from vipetsc.lattice.sites import Pair, sites_at
from vipetsc.modes.response.state import Measures
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

# A row of masses on which resonators sit, with springs between neighbouring resonators as well.
SPRINGS = (Spring(0, 0, 1e4, offset=1), Spring(0, 1, 5e3), Spring(1, 1, 1e3, offset=1))
CELL = UnitCell((4e-3, 2e-3), SPRINGS, host=0, resonator=1)
PAIRS = (Pair(-1, 1), Pair(1, 0, offset=1), Pair(0, 1), Pair(-1, 0))
SITES = (500, 501, 503, 503)


def rows_of(chain: Chain) -> np.ndarray:
    """Rows (pair, mass) that give relative displacements from displacements of masses, in a chain that is no ring."""
    d = chain.cell.dofs
    rows = np.zeros((len(chain.sites), chain.cells * d))
    for row, (cell, pair, *_) in zip(rows, chain.sites, strict=True):
        row[(cell + pair.offset) * d + pair.resonator] = 1
        if pair.host >= 0:
            row[cell * d + pair.host] = -1
    return rows


@pytest.mark.parametrize("omega", [400.0 - 40j, 1000.0 - 40j, 3000.0 - 90j])
def test_compliances_are_those_of_a_long_damped_lattice(omega):
    """Compliances of an infinite lattice are those of a long one, at complex frequencies.

    Waves of these frequencies decay before they reach an end of the long lattice.
    """
    chain = Chain(CELL, 1000, "free", sites_at(SITES, PAIRS))
    dynamic = chain.stiffness_matrix().tocsc() - omega**2 * diags(chain.masses(), format="csc")
    rows = rows_of(chain)
    expected = rows @ spsolve(dynamic.astype(complex), rows.T.astype(complex))
    found = WaveCompliance(chain, infinite=True).at(omega)[0]
    assert np.abs(found - expected).max() < 1e-10 * np.abs(expected).max()


GROUND = {"pair": [0, 2], "sites": [12, 14]}
NEIGHBOURS = {"pair": [1, 1], "next_cell": True, "sites": [12, 14]}
# In one cell a resonator meets that of the next cell; in another cell a resonator meets its host and the ground.
SEVERAL = {
    "sites": [10, 12, 12],
    "clearance": [1e-4, 3e-5, 1e-4],
    "each": {"pair": [[2, 2], [1, 2], [0, 2]], "next_cell": [True, False, False]},
}
# In the mirror image of 24 cells, cell n becomes 25 - n, and the contact of cells n and n + 1 belongs to cell 24 - n.
MIRRORED = {
    "ground": (GROUND, GROUND | {"sites": [13, 11]}),
    "neighbours": (NEIGHBOURS, NEIGHBOURS | {"sites": [12, 10]}),
    "several": (SEVERAL, SEVERAL | {"sites": [14, 13, 13]}),
}


def wave_case(contacts: dict[str, Any], **nfrc: Any) -> NfrcCase:
    """The case of lossy sites under a wave of 1000 rad/s and 2.5 clearances; ``nfrc`` updates the table [nfrc]."""
    common = {"law": "bilinear", "stiffness": 1e4, "clearance": 1e-4, "restitution": 0.5}
    steps = {"harmonics": 15, "first_step": 0.2, "largest_step": 1.0, "range": [2.5, 9.0]}
    return NfrcCase.from_table(
        {
            "name": "x",
            "lattice": {"cells": 24, "cell": TWO_MASS_CELL},
            "contacts": common | contacts,
            "drive": {"frequency": 1000.0, "cycles": 3, "amplitude": 1.0, "cell": 4},
            "nfrc": steps | nfrc,
        }
    )


def measures_of(case: NfrcCase, restitution: float) -> Measures:
    """The measures of the state at the beginning of the range."""
    states = SteadyStates(case, restitution, case.nfrc.fixed[0])
    return states.measured(first_state(states).xi)


@pytest.mark.parametrize("name", MIRRORED)
def test_energy_and_mirror_images(name):
    """A state in contact satisfies T + R + U + L = 1, and a wave from the other side moves mirrored sites alike."""
    forward, backward = (
        measures_of(wave_case(contacts, direction=direction), 0.5)
        for direction, contacts in zip(("forward", "backward"), MIRRORED[name], strict=True)
    )
    assert forward.episodes >= 4
    assert (forward.closed > 0).all()
    assert forward.fractions.sum() == pytest.approx(1.0, abs=1e-9)
    assert forward.fractions.min() > 1e-4

    assert backward.fractions == pytest.approx(forward.fractions, rel=1e-7)
    assert backward.largest == pytest.approx(forward.largest, rel=1e-7)
    assert backward.unstable == forward.unstable


def test_a_steady_state_under_a_wave_is_where_a_long_run_ends():
    """A run under the wave of a distant force settles to the steady state of contacts with ground and next cell."""
    omega = 1000.0
    period = 2 * np.pi / omega
    contacts = {
        "law": "bilinear",
        "stiffness": 1e4,
        "clearance": 1e-4,
        "restitution": 0.3,
        "sites": [320, 322],
        "each": {"pair": [[0, 2], [1, 1]], "next_cell": [False, True]},
    }
    # Waves travel 8 cells in a period and come back from the ends after the run has ended.
    lattice = {"cells": 640, "cell": TWO_MASS_CELL}
    drive = {"waveform": "harmonic", "frequency": omega, "cell": 300}
    table = {"name": "x", "lattice": lattice, "contacts": contacts, "drive": drive}
    options = {"harmonics": 31, "largest_step": 1.0, "first_step": 0.2}

    amplitude = 2.5
    case = NfrcCase.from_table(table | {"nfrc": options | {"range": [amplitude, 9.0]}})
    measures = measures_of(case, 0.3)
    assert measures.unstable == 0
    assert measures.episodes == 4

    # Without contacts the run's force would move the first site by 2.5 clearances.
    forced = NfrcCase.from_table(table | {"nfrc": options | {"source": "force", "infinite": True, "range": [0.1, 1.0]}})
    relative = SteadyStates(forced, 0.3, omega).linear_motion(omega).harmonics[0, 1]
    force = amplitude * 1e-4 / abs(relative)
    samples = 64
    run = Case.from_table(
        table
        | {
            "drive": drive | {"amplitude": force, "ramp": 20 * period},
            "time": {"engine": "propagator", "end": 60 * period, "sample_interval": period / samples},
            "output": {"window": [320, 323]},
        }
    )
    u = run_of(run)["displacement"].values[-1 - 4 * samples : -1]
    motions = (u[:, 0, 1], u[:, 3, 0] - u[:, 2, 0])
    found = [first_harmonic(motion, samples) for motion in motions]
    assert found == pytest.approx(np.abs(measures.harmonics[:, 1]).tolist(), rel=1e-4)
