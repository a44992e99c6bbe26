"""Normal modes with contacts that are pressed at rest: exact periods, a chain of grains, and orbits by SciPy."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from tests.condensed_branches import condensed_branch
from tests.models import TWO_MASS_CELL
from vipetsc.case import Case, CaseError, NnmCase
from vipetsc.case.nnm import NnmTable
from vipetsc.lattice import Contact
from vipetsc.lattice.elements import contacts, joined_stiffness
from vipetsc.modes.branches.balance import BalanceMethod, state_of
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.orbits import ShootingMethod
from vipetsc.modes.continuation.arclength import Continuation, locate
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.shooting import Shooting, linear_start
from vipetsc.modes.system import ContactPair, System
from vipetsc.studies.linear_modes import pressed_contacts

pytestmark = pytest.mark.parallel(1)

MASS = 2.0
SPRING = 3.0
STOP = 40.0
# The depth in m to which the contact is pressed: it opens where the mass has moved back by as much.
DEPTH = 0.1
EXPONENTS = {"bilinear": 1.0, "hertz": 1.5}


def potential(u: float, law: str) -> float:
    """Energy in J at ``u`` in m of the spring, of a contact pressed by ``DEPTH`` at u = 0, and of its static load."""
    n = EXPONENTS[law]
    stored = (max(u + DEPTH, 0.0) ** (n + 1) - DEPTH ** (n + 1)) / (n + 1)
    return SPRING * u**2 / 2 + STOP * (stored - DEPTH**n * u)


def exact_period(energy: float, law: str) -> float:
    """The period in s at an ``energy`` in J: twice the integral of du/sqrt(2 (E - V(u))/m) between turning points."""
    reach = np.sqrt(2 * energy / SPRING) + 2 * STOP * DEPTH**2  # beyond both ends
    low, high = (brentq(lambda u: potential(u, law) - energy, 0.0, end, xtol=1e-16) for end in (-reach, reach))

    def time(begin: float, stop: float) -> float:
        # At a turning point the speed is a square root of the distance. With u = begin + (stop - begin) sin^2 phi the
        # integrand is smooth there.
        def slowness(phi: float) -> float:
            u = begin + (stop - begin) * np.sin(phi) ** 2
            # Rounding may leave a negative kinetic energy at the ends.
            speed = np.sqrt(2 * max(energy - potential(u, law), 1e-300) / MASS)
            return float((stop - begin) * np.sin(2 * phi) / speed)

        return quad(slowness, 0, np.pi / 2, epsabs=0, epsrel=1e-9, limit=200)[0]

    # The integral has two pieces, since the force is not smooth where the contact opens.
    if low < -DEPTH:
        return 2 * (time(low, -DEPTH) + time(-DEPTH, high))
    return 2 * time(low, high)


def pressed_mass(law: str, side: int = 1) -> System:
    """A mass on a spring, pressed against a stop of the ground on one ``side``."""
    plus, minus = (-DEPTH, np.inf) if side > 0 else (np.inf, -DEPTH)
    return System.assemble([MASS], [(None, 0, SPRING)], [ContactPair(None, 0, plus, Contact(law, STOP), minus)])


@pytest.mark.parametrize("law", ["hertz", "bilinear"])
def test_a_pressed_mass_has_its_exact_period(law):
    """A mass pressed to a stop on either side has its exact period, from small motions to beyond the opening."""
    slope = EXPONENTS[law] * STOP * DEPTH ** (EXPONENTS[law] - 1)
    opening = potential(-DEPTH, law)
    for side in (1, -1):
        system = pressed_mass(law, side)
        # For small motions the contact is a spring of its slope at the depth.
        assert system.linear_modes()[0] == pytest.approx(np.sqrt((SPRING + slope) / MASS))
        problem = Shooting(Dop853Flow(system), MAPS["half"])
        # The branch begins far below the energy at which the contact opens, and passes that energy.
        start = linear_start(problem, 0, opening / 100)
        steps = Continuation(problem, start, NnmTable(points=26, largest_step=0.3, first_step=0.1))

        last = steps.point
        opened = []
        for point in steps:
            opened += [p for p in locate(problem, last, steps.passed, "auto", True) if p.kind == "grazing"]
            assert point.period == pytest.approx(exact_period(point.energy, law), rel=1e-8)
            assert point.episodes == (point.energy > opening)
            last = point
        # The branch ends well beyond, where the contact is open for most of the period.
        assert last.energy > 30 * opening
        # The branch grazes once, at the potential energy at which the contact opens.
        assert [p.energy for p in opened] == pytest.approx([opening], rel=1e-10)


@pytest.mark.parametrize("direction", ["up", "down"])
def test_a_branch_that_begins_beside_its_range_of_energies_comes_into_it(direction):
    """A branch whose first motion has too little energy goes on up, and one with too much goes on down.

    A Hertz contact softens as it opens: a motion that has the lowest energy by its linear mode has less.
    """
    own = {
        "masses": [MASS],
        "springs": [{"start": 0, "end": 1, "stiffness": SPRING}],
        "contacts": [{"host": 0, "resonator": 1, "clearance": 0.0}],
    }
    contacts = {"law": "hertz", "stiffness": STOP, "side": "minus", "precompression": DEPTH}
    low = 2e-3
    high = 4e-3
    nnm = {"system": "own", "own": own, "modes": [1], "energy": [low, high], "direction": direction}
    if direction == "down":
        nnm |= {"start_energy": 1.5 * high}
    (branch,) = follow_all(NnmCase.from_table({"contacts": contacts, "nnm": nnm}), None, MPI.COMM_SELF)

    energies = [point.energy for point in branch.regular()]
    assert branch.ended.sentence == f"left the energy range {low:g} to {high:g} J"
    if direction == "up":
        assert energies[0] < low
        assert energies[-1] > high
    else:
        assert energies[0] > high
        assert energies[-1] < low


def test_a_bilinear_contact_is_linear_until_it_opens():
    """Special points are looked for from the beginning of a branch with Hertz contacts, not on a linear one."""
    for law in ("hertz", "bilinear"):
        problem = Shooting(Dop853Flow(pressed_mass(law)), MAPS["half"])
        point = linear_start(problem, 0, potential(-DEPTH, law) / 100)
        assert bool(list(problem.special_kinds(point, point))) == (law == "hertz")


@pytest.mark.parametrize("law", ["hertz", "bilinear"])
def test_harmonic_balance_of_a_pressed_mass_has_its_exact_period(law):
    """Harmonic balance, with mean and even harmonics, has the exact period and opens the contact at its energy."""
    opening = potential(-DEPTH, law)
    _, points = condensed_branch(pressed_mass(law), 0, opening / 4, truncation=1e-6, points=14, largest_step=0.2)
    assert points[-1].energy > opening
    for point in points:
        assert point.period == pytest.approx(exact_period(point.energy, law), rel=1e-7)
        assert point.episodes == (point.energy > opening)
        assert (point.closed < 1) == (point.energy > opening)


BEADS = 3
BEAD = 0.01
GRAIN = 1e6
PRESSED = 1e-4


@pytest.mark.parametrize("resonators", [False, True])
def test_free_grains_condensed_onto_their_contacts_return(resonators):
    """No force moves a chain that nothing holds as a whole: its static compliance is that of its other modes."""
    cell = {"masses": [BEAD], "springs": []}
    if resonators:
        cell = {"masses": [BEAD, BEAD / 2], "springs": [{"start": 1, "end": 2, "stiffness": 5e3}]}
    contacts = {"law": "hertz", "stiffness": GRAIN, "sites": [1, 2], "clearance": 0.0, "precompression": PRESSED}
    table = {
        "lattice": {"cells": BEADS, "ends": "free", "cell": cell},
        "contacts": contacts | {"pair": [1, 1], "next_cell": True, "side": "minus"},
        "nnm": {"system": "chain", "method": "balance", "modes": [2], "truncation": 1e-6},
    }
    case = NnmCase.from_table(table)
    system = System.from_case(case)
    motions = BalanceMethod(case).motions
    omega, shapes = system.linear_modes()
    # A third of the energy at which a contact opens: the mean elongation is a hundredth of the amplitude.
    amplitude = np.sqrt(2 * system.grazing_energy(1) / 3) / omega[1]
    point = motions.from_mode(system.contact_rows @ shapes[:, 1] * amplitude, float(omega[1]))
    mean, first = np.abs(motions.balance(point.order).unpack(point.x)[:, :2]).max(axis=0)
    assert mean > 1e-2 * first

    u = np.concatenate(list(state_of(motions, point, len(cell["masses"])).values()))
    assert abs(system.masses @ u) < 1e-12 * np.abs(system.masses * u).sum()
    end = Dop853Flow(system).arc(np.append(u, 0 * u), point.period, point.period).end
    assert np.abs(end[: len(u)] - u).max() < 1e-5 * np.abs(u).max()


def test_a_ring_of_grains_is_shot_though_its_elongations_add_up_to_zero():
    """The highest mode of a ring of grains has omega = 2 sqrt(k/m) with k = (3/2) A d^(1/2), neighbours in antiphase.

    The elongations of a ring's contacts add up to zero, so that they are no independent coordinates.
    """
    stiffness = 10.0
    depth = 0.01
    table = {
        "lattice": {"cell": {"masses": [1.0]}, "cells": 4, "ends": "periodic"},
        "contacts": {
            "law": "hertz",
            "stiffness": stiffness,
            "next_cell": True,
            "side": "minus",
            "clearance": 0.0,
            "precompression": depth,
            "sites": [1, 2, 3, 4],
        },
        "nnm": {"system": "chain", "modes": [4], "points": 3, "locate": False},
    }
    method = ShootingMethod(NnmCase.from_table(table))
    start = method.start(method.shooting, 3)
    points = [start, *Continuation(method.shooting, start, method.options)]

    omega = 2 * np.sqrt(1.5 * stiffness * np.sqrt(depth))
    for point in points:
        assert point.residual < 1e-11
        assert point.frequency == pytest.approx(omega / (2 * np.pi), rel=1e-3)
        assert point.x == pytest.approx(point.x[0] * np.array([1, -1, 1, -1]), rel=1e-6)
    assert len(points) == 4


SITES: dict[str, Any] = {
    "name": "sites",
    "lattice": {"cells": 14, "cell": TWO_MASS_CELL},
    "contacts": {
        "law": "hertz",
        "stiffness": 1e7,
        "sites": [7, 9],
        "clearance": 0.0,
        "side": "plus",
        "precompression": 2e-4,
    },
    "nnm": {"system": "chain", "modes": [28], "tolerance": 1e-12},
}


def test_the_state_at_rest_is_that_of_a_run():
    """At rest the stiffness of pressed contacts is that of a run, and forces and energy are zero."""
    nnm = System.from_case(NnmCase.from_table(SITES))
    time = {"end": 0.01, "sample_interval": 1e-4}
    drive = {"amplitude": 1.0, "frequency": 1000.0, "cycles": 3, "cell": 4}
    model = Case.from_table(
        {key: SITES[key] for key in ("lattice", "contacts")} | {"time": time, "drive": drive}
    ).model()

    rest = nnm.stiffness_at_rest - nnm.stiffness
    pressed = pressed_contacts(model)
    assert min(pressed) > 0
    rest -= joined_stiffness(contacts(model.chain), pressed, nnm.dofs, slice(None)).toarray()
    # The bits are equal: both stiffnesses come from the same law at the same depth.
    assert np.abs(rest).max() == 0
    assert np.all(nnm.forces(np.zeros(nnm.dofs)) == 0)
    assert nnm.energy(np.zeros(nnm.dofs), np.zeros(nnm.dofs)) == 0


def test_a_stop_that_touches_among_pressed_ones_is_refused():
    """A contact that just touches at rest is refused, as no motion about it is linear; others are accepted."""

    def with_clearances(clearances: list[float]) -> dict[str, Any]:
        each = {"precompression": [1e-4, 0.0]}
        return SITES | {"contacts": SITES["contacts"] | {"clearance": clearances, "each": each, "precompression": None}}

    assert NnmCase.from_table(with_clearances([0.0, 1e-4])).gaps() == ((-1e-4, np.inf), (1e-4, np.inf))
    with pytest.raises(CaseError, match="no motion about it is linear"):
        NnmCase.from_table(with_clearances([0.0, 0.0]))
