"""Open ends, which reflect nothing at any frequency, compared with endless and with long damped lattices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.verify.test_rig import rounded_cell
from vipetsc.case.absorbing import reflected_at, sections_of
from vipetsc.case.nfrc import NfrcCase
from vipetsc.lattice import (
    Chain,
    ModalCompliance,
    OpenCompliance,
    Spring,
    UnitCell,
    WaveCompliance,
    pass_bands,
    waves_at,
)
from vipetsc.lattice.sites import Pair, sites_at
from vipetsc.modes.response.condensation import compliance_of
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

pytestmark = pytest.mark.parallel(1)

CELL = UnitCell((1.0, 0.3), (Spring(0, 0, 1.0, offset=1), Spring(0, 1, 0.5)), host=0, resonator=1)
SPRINGS = [{"start": 1, "end": 1, "stiffness": 1.0, "next_cell": True}, {"start": 1, "end": 2, "stiffness": 0.5}]


def absorbing(end: str = "both", **nfrc: Any) -> dict[str, Any]:
    """The case of a two-mass lattice with an absorbing ``end`` or both, one contact site and a force next to it."""
    lattice = {"cells": 12, "cell": {"masses": [1.0, 0.3], "springs": SPRINGS, "contact": [1, 2]}}
    ends = {"end": end, "cells": 3, "strength": 2.0}
    options = {"source": "force", "over": "amplitude", "range": [2.0, 2.5], "fixed": [0.7], "harmonics": 9}
    return {
        "name": "open",
        "lattice": lattice | {"absorbing": ends},
        "contacts": {"law": "bilinear", "stiffness": 3.0, "restitution": 1.0, "sites": [6], "clearance": 0.3},
        "drive": {"waveform": "harmonic", "amplitude": 0.3, "frequency": 0.7, "cell": 5, "mass": 1},
        "time": {"end": 10.0},
        "nfrc": options | {"open_ends": True} | nfrc,
    }


SMOOTH = absorbing()
SMOOTH["lattice"]["cell"] = SMOOTH["lattice"]["cell"] | {"springs": [SPRINGS[0] | {"cubic": 1.0}, SPRINGS[1]]}


@pytest.mark.parametrize("ends", ["fixed", "free"])
def test_with_both_ends_open_the_lattice_is_endless(ends):
    """With both ends open the compliance is that of Bloch waves, in bands, gaps, at rest and for growing motions."""
    chain = Chain(CELL, 9, ends, sites=sites_at([2, 6], CELL.pair))
    here = OpenCompliance(chain, ((0, 0),), open_ends=("left", "right"))
    endless = WaveCompliance(chain, ((0, 0),), infinite=True)
    omega = np.array([0.31, 0.9, 1.2, 1.6, 2.2, 3.5, 1.1 - 0.01j, -0.7 - 0.02j, -0.7])
    np.testing.assert_allclose(here.response(omega), endless.response(omega), rtol=1e-6)
    # A constant force on one mass moves an endless lattice without bound. The opposite forces of a contact do not.
    np.testing.assert_allclose(here.at(0.0), endless.at(0.0), atol=1e-4)
    forces = [0.3, -2.0, 1.5]
    np.testing.assert_allclose(here.field(0.9, forces, range(9)), endless.field(0.9, forces, range(9)), rtol=1e-6)


@pytest.mark.parametrize("end", ["left", "right"])
def test_nothing_comes_back_over_whole_bands(end):
    """An open end reflects less than 1e-7 of the energy of waves in all bands, up to 1e-3 of a band from its edges."""
    chain = Chain(CELL, 12, "fixed", sites=sites_at([5], CELL.pair))
    driven = 0 if end == "right" else 11
    lattice = OpenCompliance(chain, ((driven, 0),), open_ends=(end,))
    worst = made_for_one = 0.0
    absorbers = sections_of(NfrcCase.from_table(absorbing()).lattice.absorbing, CELL, "fixed", 60, 0.4)
    for band in pass_bands(CELL):
        for place in (1e-3, 1e-2, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 0.999):
            omega = band.low + place * (band.high - band.low)
            u = lattice.field(omega, [0.0, 1.0], [4, 5])[:, 0]
            ((_, kappa, speed),) = waves_at(CELL, omega)
            towards = np.exp(-1j * kappa * np.sign(speed)) ** (1 if end == "right" else -1)
            forth, back = np.linalg.solve([[1.0, 1.0], [towards, 1 / towards]], u)
            worst = max(worst, abs(back / forth) ** 2)
            made_for_one = max(made_for_one, reflected_at(omega, absorbers))
    assert worst < 1e-7
    # Dashpots over 60 cells, chosen for one frequency, reflect more than a tenth near the edges of the bands.
    assert made_for_one > 0.1


def test_dashpots_cells_that_differ_and_contacts_to_ground_stay_what_they_are():
    """An open end keeps dashpots, rounded cells and contacts with the ground: the compliance is a long lattice's.

    The long lattice has 240 cells and a strong loss, so that nothing comes back from its far end.
    """
    pairs = (Pair(-1, 1), Pair(0, 0, offset=1))
    short = Chain(rounded_cell((0.05, 0.2)), 5, "fixed", sites=sites_at([1, 3], pairs))
    long = Chain(rounded_cell((0.05, 0.2)), 240, "fixed", sites=sites_at([1, 3], pairs))
    here = OpenCompliance(short, ((0, 0),), open_ends=("right",))
    omega = np.array([0.6, 1.1 - 0.1j, 1.5, 2.5])
    np.testing.assert_allclose(here.response(omega), ModalCompliance(long, ((0, 0),)).response(omega), rtol=1e-6)


def test_states_are_those_of_the_endless_lattice():
    """A steady state has the harmonics and stability of the endless lattice's, as the ends' dashpots are left out."""
    case = NfrcCase.from_table(absorbing())
    assert isinstance(compliance_of(case), OpenCompliance)
    assert not compliance_of(case).chain.is_damped
    table = absorbing(infinite=True, open_ends=False)
    del table["lattice"]["absorbing"]
    measured = []
    for one in (case, NfrcCase.from_table(table)):
        states = SteadyStates(one, 1.0, 0.7)
        measured.append(states.measured(first_state(states).xi))
    here, endless = measured
    assert here.episodes > 0
    np.testing.assert_allclose(here.harmonics, endless.harmonics, atol=1e-7)
    assert here.unstable == endless.unstable
