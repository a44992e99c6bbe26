"""Systems whose branches are followed: the paper's two masses, chains, systems of given masses; forces and energy."""

from __future__ import annotations

import numpy as np
import pytest

from tests.models import four_band_contact, reduced_model
from vipetsc.case import CaseError
from vipetsc.case.nnm import NnmCase
from vipetsc.lattice import Chain, Contact, Spring, UnitCell
from vipetsc.lattice.sites import Pair, sites_at
from vipetsc.modes.stops import Stops
from vipetsc.modes.system import ContactPair, SmoothSpring, System

LINEAR_STOP = four_band_contact("bilinear")


def test_reduced_model_of_the_paper():
    """The reduced model is host and resonator of the four-band cell; the host's other neighbours are at rest."""
    system = reduced_model()
    assert system.masses == pytest.approx([0.0025, 0.0025])
    assert system.stiffness == pytest.approx(np.array([[2.2e4, -2e3], [-2e3, 2e3]]))


def test_forces_are_the_energy_gradient():
    """Forces are the derivatives of the energy, with contacts to ground and between masses and smooth springs."""
    law = Contact("hertz", 3e6)
    contacts = (ContactPair(None, 0, 0.1, law), ContactPair(0, 2, 0.05, law))
    smooth = (SmoothSpring.between(1, 2, cubic=3.0, quadratic=-1.0), SmoothSpring.between(None, 1, cubic=2.0))
    springs = [(None, 0, 5.0), (0, 1, 7.0), (1, 2, 11.0)]
    system = System.assemble([1.0, 2.0, 3.0], springs, contacts, smooth)
    # Both contacts are closed, one on each side.
    u = np.array([0.3, -0.2, 0.5])
    at_rest = np.zeros(3)
    step = 1e-6

    gradient = []
    for direction in np.eye(3):
        forward = system.energy(u + step * direction, at_rest)
        backward = system.energy(u - step * direction, at_rest)
        gradient.append((forward - backward) / (2 * step))

    assert system.forces(u) == pytest.approx(gradient, rel=1e-7)
    # The quadratic spring has no mirrored motion.
    assert not system.odd


def test_gaps_are_those_to_the_stop_on_the_side_of_the_motion():
    """A contact with two clearances is beyond the nearer stop on one side, and within the other on the other side."""
    two_sided = ContactPair(None, 0, clearance=0.1, law=LINEAR_STOP, clearance_minus=0.13)
    one_sided = ContactPair(None, 0, clearance=0.1, law=LINEAR_STOP, clearance_minus=np.inf)
    system = System.assemble([1.0], [(None, 0, 1.0)], (two_sided, one_sided))

    assert system.gaps(np.array([[0.12], [-0.12]])) == pytest.approx(np.array([[0.02, 0.02], [-0.01, -np.inf]]))
    assert not system.odd
    assert system.grazing_energy(0) == pytest.approx(0.5 * 0.1**2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"masses": [1.0, -1.0]}, "masses"),
        ({"contacts": (ContactPair(0, 1, -1.0, LINEAR_STOP),)}, "clearance"),
        ({"contacts": (ContactPair(0, 2, 1.0, LINEAR_STOP),)}, "not a pair"),
        ({"contacts": (ContactPair(0, 1, 1.0, Contact("hertz", 1.0, 0.7)),)}, "restitution"),
    ],
)
def test_unsound_systems_are_refused(change, message):
    """A mass or clearance below zero, a pair that is not there and a contact that dissipates raise ValueError."""
    parts = {"masses": [1.0, 1.0], "springs": [(None, 0, 1.0), (0, 1, 1.0)]}
    with pytest.raises(ValueError, match=message):
        System.assemble(**(parts | change))


def test_a_system_of_ones_own_has_its_springs_and_its_contact():
    """Masses, springs, smooth springs and contacts of [nnm.own] become a system; 0 is the ground."""
    own = {
        "masses": [1.0, 2.0],
        "springs": [{"start": 0, "end": 1, "stiffness": 3.0}, {"start": 1, "end": 2, "stiffness": 5.0}],
        "smooth": [{"start": 0, "end": 2, "cubic": 7.0}],
        "contacts": [{"host": 0, "resonator": 2, "clearance": 0.1}],
    }
    nnm = {"system": "own", "own": own}
    with pytest.raises(CaseError, match=r"contacts\.stiffness: missing"):
        NnmCase.from_table({"nnm": nnm})

    system = System.from_case(NnmCase.from_table({"contacts": {"stiffness": 2.0}, "nnm": nnm}))

    assert system.contacts[0].law.stiffness == 2.0
    assert system.contacts[0].host is None
    assert system.contacts[0].resonator == 1
    assert system.stiffness == pytest.approx(np.array([[8.0, -5.0], [-5.0, 5.0]]))
    assert system.springs == (SmoothSpring.between(None, 1, cubic=7.0),)


def test_a_chain_has_the_modes_and_sites_of_its_cells():
    """The system of three four-band cells has 12 modes and a contact in each of the cells 1 and 3, its sites."""
    table = {"lattice": {"cells": 3}, "contacts": {"sites": [1, 3]}}

    system = System.from_case(NnmCase.from_table(table | {"nnm": {"system": "chain", "modes": [12]}}))

    assert system.dofs == 12
    assert system.branch_name(11) == "mode-12"
    # Four masses a cell; cells count from 0 here.
    assert [pair.host // 4 for pair in system.contacts] == [0, 2]
    with pytest.raises(CaseError, match="12 modes"):
        NnmCase.from_table(table | {"nnm": {"system": "chain", "modes": [13]}})


def test_a_contact_that_symmetry_keeps_at_rest_is_never_touched():
    """Where all cells of a ring move alike no contact between cells moves, but for rounding."""
    springs = (Spring(0, 0, 1e4, offset=1), Spring(0, 1, 5e3))
    cell = UnitCell((4e-3, 2e-3), springs, host=0, resonator=1)
    chain = Chain(cell, 12, "periodic", sites=sites_at([5, 7], Pair(0, 0, offset=1)))
    system = System.from_chain(chain, [Stops.both(Contact("hertz", 1e7), 1e-4)] * 2)

    # The modes of cells that move alike: the ring as a whole, and resonators against hosts, the lowest of their band.
    energies = [system.grazing_energy(mode) for mode in range(system.dofs)]
    assert [mode for mode, energy in enumerate(energies) if energy == np.inf] == [0, 12]
    assert max(energy for energy in energies if energy < np.inf) < 1.0


@pytest.mark.parametrize(("ends", "springs", "held"), [("fixed", 4, 1.0), ("free", 2, 0.0), ("periodic", 3, 0.0)])
def test_a_chain_keeps_its_nonlinear_springs(ends, springs, held):
    """A lattice that moves as a whole by 1 m strains the springs to its walls alone, one by 1 m, one by -1 m."""
    quadratic = 2.0
    cubic = 3.0
    nonlinear = Spring(1, 0, 5.0, offset=1, quadratic=quadratic, cubic=cubic)
    cell = UnitCell((1.0, 2.0), (Spring(0, 1, 7.0), nonlinear), host=0, resonator=1)

    system = System.from_chain(Chain(cell, 3, ends), [])

    assert len(system.springs) == springs
    u = np.ones(system.dofs)
    energy = system.energy(u, 0 * u) - 0.5 * u @ system.stiffness @ u
    forces = system.forces(u) - system.stiffness @ u
    # The energy is e^3 quadratic/3 + e^4 cubic/4, whose first term cancels in the sum over e = 1 and e = -1.
    assert energy == pytest.approx(held * 2 * cubic / 4)
    assert forces[[0, -1]] == pytest.approx([held * (cubic + quadratic), held * (cubic - quadratic)])
