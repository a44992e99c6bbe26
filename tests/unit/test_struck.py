"""Masses that are struck: initial velocities in the section [initial], the numbers that follow, and refusals."""

from __future__ import annotations

import numpy as np
import pytest

from vipetsc.case import Case, CaseError

STIFFNESS = 7.4e9
MASS = 2.05e-3


def beads(initial: dict, **sections: dict) -> Case:
    """Return the case of five beads that touch without force, with the ``initial`` velocities of some of them."""
    table = {
        "lattice": {"cells": 5, "ends": "free", "cell": {"masses": [MASS]}},
        "contacts": {
            "stiffness": STIFFNESS,
            "sites": [1, 2, 3, 4],
            "next_cell": True,
            "side": "minus",
            "clearance": 0.0,
        },
        "initial": {"kind": "velocity"} | initial,
        "time": {"end": 1e-3, "sample_interval": 2e-6},
    }
    return Case.from_table(table | sections)


def test_a_struck_lattice_has_no_frequency_of_a_drive():
    """A struck lattice has no drive; the frequency of its motion is pi over the contact time of the fastest mass.

    The amplitude is the velocity of that mass over this frequency.
    """
    case = beads({"cell": 1, "velocity": 0.1, "more": [{"cell": 5, "velocity": -0.5}]})
    assert case.drive.frequency is None
    assert case.wave_frequency is None
    assert case.drive.amplitude == 0.0
    # The cell of the motion is that of the fastest mass.
    assert case.drive.cell == 5

    contact = case.model().chain.sites[0].law
    frequency = np.pi / contact.impact_time(0.5, MASS / 2)
    assert case.initial.frequency == pytest.approx(frequency)
    assert case.initial.amplitude == pytest.approx(0.5 / frequency)
    assert case.model().scale * case.model().drive.frequency == pytest.approx(0.5)
    assert Case.from_toml(case.to_toml()) == case
    assert case.initial.describe() == "0.1 m/s of mass 1 of cell 1, -0.5 m/s of mass 1 of cell 5"


def test_on_springs_the_frequency_is_that_of_the_mass_while_others_are_held():
    """A struck mass on springs has the frequency (k/m)^(1/2) with the sum k of its springs, other masses held.

    A host has two springs of 2e4 N/m, and one of 6e3 N/m to its resonator.
    """
    springs = [
        {"start": 1, "end": 1, "stiffness": 2.0e4, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": 6.0e3},
    ]
    lattice = {"cells": 20, "cell": {"masses": [0.01, 0.004], "springs": springs}}
    initial = {"kind": "velocity", "cell": 3, "velocity": 1.0}
    case = Case(lattice=lattice, initial=initial)
    assert case.initial.frequency == pytest.approx(np.sqrt(4.6e4 / 0.01))
    assert Case(lattice=lattice, initial=initial | {"mass": 2}).initial.frequency == pytest.approx(np.sqrt(6e3 / 0.004))

    # A drive has a frequency of its own.
    driven = Case(lattice=lattice, initial=initial, drive={"amplitude": 1.0, "frequency": 900.0})
    assert driven.drive.frequency == 900.0
    assert driven.initial.frequency is None


def test_a_lossy_site_is_not_at_rest_where_the_mass_of_the_next_cell_is_struck():
    """A contact between cells j and j + 1 is not at rest if cell j + 1 is struck; on a ring cell 1 follows the last."""
    lossy = {"stiffness": STIFFNESS, "next_cell": True, "side": "minus", "clearance": 0.0, "restitution": 0.9}
    assert beads({"cell": 4, "velocity": -1.0}, contacts=lossy | {"sites": [3]})
    with pytest.raises(CaseError, match="site 1 touches its stop at rest"):
        beads({"cell": 5, "velocity": -1.0}, contacts=lossy | {"sites": [3]})

    ring = {"cells": 5, "ends": "periodic", "cell": {"masses": [MASS]}}
    assert beads({"cell": 1, "velocity": -1.0}, lattice=ring, contacts=lossy | {"sites": [5]})
    with pytest.raises(CaseError, match="site 1 touches its stop at rest"):
        beads({"cell": 2, "velocity": -1.0}, lattice=ring, contacts=lossy | {"sites": [5]})
