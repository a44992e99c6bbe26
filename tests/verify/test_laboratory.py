"""A laboratory's lattice that case-file keys describe: both engines agree, and energies use the actual masses."""

import numpy as np
import pytest

from tests.conftest import DIFFERING, simulated, small_case
from vipetsc import spectra
from vipetsc.case import Case
from vipetsc.case.schema import AnalysisTable
from vipetsc.lattice.sites import Pair
from vipetsc.studies.velocity_record import VelocityRecord


def laboratory(**time) -> Case:
    """A case of 24 damped cells that all differ, and of three contact sites with laws and stops of their own."""
    # Each site loses energy, so that the restitutions of all three can be scattered up and down.
    each = DIFFERING | {"restitution": [0.6, 0.8, 0.9]}

    return small_case(
        lattice={
            "damping": {"loss": {"2": 0.01}},
            "profiles": {
                "masses[3]": {"cells": [5], "factor": 1.5},
                "springs[4].damping": {"cells": [4], "value": 0.3},
            },
        },
        contacts={"exponent": 1.25, "sites": [4, 5, 9], "clearance": [3e-5, 2e-5, 1e-5], "each": each},
        disorder={
            "seed": 2,
            "restitution": {"relative": 0.02},
            "cells": {"masses[1]": {"relative": 0.02}, "springs[1].stiffness": {"relative": 0.02}},
        },
        time={"end": 0.05, "rtol": 1e-11} | time,
    )


@pytest.fixture(scope="module")
def runs():
    """The dataset and the result of the laboratory's run, by engine."""
    return {engine: simulated(laboratory(engine=engine)) for engine in ("ts", "propagator")}


def test_kinetic_energies_are_of_the_masses_there_are(runs):
    """Kinetic energies over cells, and over wavenumbers, sum to the ledger's if each cell has its own masses.

    With the masses of the undisturbed cell the sum is wrong.
    """
    run, _ = runs["propagator"]
    ledger = run["energy/kinetic"].values
    record = VelocityRecord(run, Case.of(run), AnalysisTable())

    energy = spectra.kinetic_energy(record.weighted, record.masses)
    expected = (0.5 * run["lattice/masses"].values * run["velocity"].values ** 2).sum(axis=2)
    np.testing.assert_allclose(energy, expected, rtol=1e-13)
    assert np.abs(energy.sum(axis=1) - ledger).max() < 1e-12 * ledger.max()

    # 24 cells have 13 wavenumbers from 0 to pi.
    wavenumber, content = spectra.wavenumber_content(record.weighted, record.masses)
    assert np.abs(content.sum(axis=1) - ledger).max() < 1e-12 * ledger.max()
    assert len(wavenumber) == 13

    unweighted = spectra.kinetic_energy(record.velocity, record.masses).sum(axis=1)
    assert np.abs(unweighted - ledger).max() > 1e-3 * ledger.max()


def test_a_site_is_of_the_masses_of_its_cell():
    """A contact's reduced mass is 1/(1/m1 + 1/m2) with the masses of its own cell, or the mass against the ground."""
    chain = laboratory().model().chain
    masses = chain.variation.masses[chain.sites.cells]
    assert chain.reduced_masses() == pytest.approx(1 / (1 / masses[:, 1] + 1 / masses[:, 2]))

    # The reduced mass of a contact with the ground is the mass itself.
    joined = small_case(contacts={"sites": [4, 24], "pair": [0, 3], "clearance": 1e-4, "side": "plus"}).model().chain
    assert joined.sites[0].pair == Pair(-1, 2)
    assert joined.reduced_masses() == [joined.cell.masses[2]] * 2
