"""A laboratory's lattice that case-file keys describe: both engines agree, and energies use the actual masses."""

import numpy as np
import pytest

from tests.conftest import DIFFERING, simulated, small_case
from vipetsc import spectra
from vipetsc.case import Case, CaseError
from vipetsc.case.schema import AnalysisTable
from vipetsc.cli.case_rows import describe_ends
from vipetsc.lattice.chain import Pair
from vipetsc.studies.velocity_record import VelocityRecord

TWO_DRIVES = {"more": [{"amplitude": 1.0, "frequency": 1500.0, "cycles": 6, "cell": 2}]}


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


@pytest.mark.slow
def test_engines_agree(runs):
    """Both engines give the same motion, impacts and losses of the laboratory's lattice."""
    by_ts, result = runs["ts"]
    by_propagator, _ = runs["propagator"]

    u = by_ts["displacement"].values
    assert np.abs(u - by_propagator["displacement"].values).max() < 1e-8 * np.abs(u).max()
    assert len(by_ts["impacts/site"]) == len(by_propagator["impacts/site"]) > 10
    assert set(by_ts["impacts/site"].values) == {1, 2, 3}
    np.testing.assert_allclose(by_ts["impacts/onset"], by_propagator["impacts/onset"], atol=1e-9)
    assert result.statistics["ledger_error"] < 1e-9

    damped = by_ts["energy/dissipated_by_damping"].values[-1]
    assert damped > 0
    assert damped == pytest.approx(by_propagator["energy/dissipated_by_damping"].values[-1], rel=1e-7)


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
    masses = chain.variation.masses[list(chain.sites)]
    assert chain.reduced_masses() == pytest.approx(1 / (1 / masses[:, 1] + 1 / masses[:, 2]))

    # The reduced mass of a contact with the ground is the mass itself.
    joined = small_case(contacts={"sites": [4, 24], "pair": [0, 3], "clearance": 1e-4, "side": "plus"}).model().chain
    assert joined.pairs[0] == Pair(-1, 2)
    assert joined.reduced_masses() == [joined.cell.masses[2]] * 2


@pytest.mark.slow
def test_an_absorbing_end_is_that_of_all_drives():
    """An absorbing end is chosen, and its reflection stated, for the waves of all drives, none of which acts in it."""
    ends = {"cells": 90, "absorbing": {"cells": 10, "strength": 400.0}}
    with pytest.raises(CaseError, match=r"lattice\.absorbing\.end.*cell 85, which is in the absorbing end"):
        small_case(lattice=ends, drive={"more": [{"frequency": 1500.0, "cell": 85}]})

    description = describe_ends(small_case(lattice=ends, drive=TWO_DRIVES))
    assert "at 1500 rad/s" in description
    assert description.count("reflects") == 2

    in_a_gap = describe_ends(small_case(lattice=ends, drive={"frequency": 650.0, "cycles": 200}))
    assert "no wave reaches it at 650 rad/s" in in_a_gap

    # The end chosen for two bursts differs from that for the first alone.
    one = small_case(lattice={"cells": 90, "absorbing": {}})
    second = {"amplitude": 30.0, "frequency": 1300.0, "cycles": 15, "cell": 2}
    both = small_case(lattice={"cells": 90, "absorbing": {}}, drive={"more": [second]})
    assert one.lattice.absorbing != both.lattice.absorbing
