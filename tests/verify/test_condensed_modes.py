"""Condensed motions: tongues, bilinear stops, multipliers and losses, against shooting and integration."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from tests.breathers import BREATHER_FREQUENCY, breather_case, breather_chain
from tests.condensed_branches import condensed_branch, displacement
from tests.conftest import with_sections
from tests.models import CLEARANCE, four_band_contact, kerschen_system
from tests.rigs import TWO_MASSES
from tests.unlike_lattices import TABLE
from tests.zoo_by_scipy import lattice_by_scipy
from vipetsc.case import NnmCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.branches import balance
from vipetsc.modes.branches.balance import BalanceMethod, state_of
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.losses import with_orbits_loss
from vipetsc.modes.branches.orbits import ShootingMethod
from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.problem import unit
from vipetsc.modes.response.equations import SteadyFrame
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.shooting import Shooting, resonance, sample_orbit
from vipetsc.modes.stops import Stops
from vipetsc.modes.system import System


def test_the_tongues_of_the_in_phase_mode_are_followed():
    """Harmonic balance passes the tips of Kerschen's 3:1 and 5:1 tongues; shooting from it finds the same orbits."""
    system = kerschen_system()
    problem, points = condensed_branch(system, 0, 1.0, truncation=1e-7, points=130, largest_step=0.15)
    energy = np.array([point.energy for point in points])
    tips = 1 + np.nonzero((energy[1:-1] > energy[:-2]) & (energy[1:-1] > energy[2:]))[0]
    assert energy[tips] == pytest.approx([4679, 2100, 107310], rel=1e-2)
    assert max(point.order for point in points) < 100

    shooting = Shooting(Dop853Flow(system), MAPS["quarter"], 1e-12)
    resonances = []
    # The points are the tips, and one beyond each tip on the way back.
    for i in (*tips, *(tips + 4)):
        point = points[i]
        frame = shooting.relative_frame(displacement(problem, point), point.period)
        # Shooting looks for the orbit at the same length along the branch as the point.
        before = frame.chart.encode(displacement(problem, points[i - 1]), points[i - 1].period)
        row = frame.xi - before
        attempt = frame.solve(frame.xi, row / np.linalg.norm(row), row @ frame.xi / np.linalg.norm(row))
        assert attempt.converged

        orbit = frame.measures(attempt)
        assert orbit.frequency == pytest.approx(point.frequency, rel=1e-8)
        assert orbit.energy == pytest.approx(point.energy, rel=1e-6)
        resonances.append(resonance(shooting, orbit))
    assert resonances[:3] == [3, 3, 5]


# J: grazing of the out-of-phase mode, and the folds of the energy, by shooting.
GRAZING = 0.0293434562302
FOLDS = [0.0293435546934, 0.0223715911605]


def condensed_by_stop(mode: int, top: float, modulus: float = 1e8, **options: Any) -> Branch[Any]:
    nnm = {"modes": [mode], "energy": [0.0, top], "method": "balance", "points": 300} | options
    table = {
        "lattice": {"preset": "four-band", "reading": "printed"},
        "contacts": {"law": "bilinear", "modulus": modulus},
        "nnm": nnm,
    }
    (branch,) = follow_all(NnmCase.from_table(table), None, MPI.COMM_SELF)
    return branch


def test_a_branch_passes_the_first_touch_as_in_shooting():
    """Folds are those of shooting; between regular points the secant has the sign of the slopes at both."""
    top = 0.5
    branch = condensed_by_stop(2, top, truncation=1e-5)
    assert branch.complete
    assert branch.points[-1].energy > top

    folds = [p.energy for p in branch.points if p.kind == "fold-energy"]
    assert folds == pytest.approx(FOLDS, rel=1e-6)

    touched = [p for p in branch.points if p.energy > GRAZING or p.episodes]
    for left, right in itertools.pairwise(touched):
        # The branch turns back in energy at a fold, and the sign of its slope changes there.
        if "regular" == left.kind == right.kind:
            secant = (right.frequency - left.frequency) / (right.energy - left.energy)
            assert np.sign(left.slope) == np.sign(right.slope) == np.sign(secant)


STOPS = [Stops.both(four_band_contact(), CLEARANCE)]


def test_a_breather_and_its_multiplier_are_those_of_shooting():
    """A breather of 14 cells is an orbit of all masses by shooting, with the largest multiplier by Hill's determinant.

    Amplitude and energy are those of an earlier computation with 8 to 16 harmonics.
    """
    method = BalanceMethod(breather_case())
    point = method.assess(method.motions, method.start(method.motions, 0))
    assert abs(point.elongations[0]) / CLEARANCE == pytest.approx(1.286, abs=5e-4)
    assert point.energy == pytest.approx(0.0203, abs=5e-5)

    shooting = Shooting(Dop853Flow(System.from_chain(breather_chain(), STOPS)), MAPS["quarter"], tolerance=1e-12)
    u = np.concatenate(list(state_of(method.motions, point, 4).values()))
    frame = shooting.relative_frame(u, 2 * np.pi / BREATHER_FREQUENCY)
    keep_period = np.append(np.zeros(len(u)), 1.0)
    attempt = frame.solve(frame.xi, keep_period, 1.0)
    assert attempt.converged
    orbit = frame.measures(attempt)

    assert np.abs(orbit.x - u).max() < 1e-7 * np.abs(u).max()
    assert orbit.energy == pytest.approx(point.energy, rel=1e-7)
    # The breather is unstable; all multipliers of a stable one would have the modulus 1.
    assert orbit.multiplier > 1.3
    assert point.multiplier == pytest.approx(orbit.multiplier, rel=1e-6)


@pytest.mark.parametrize("sites", [[1], [1, -2]])
def test_sensitivities_of_all_masses_and_hills_determinant_agree(monkeypatch, sites):
    """Multipliers by sensitivities of all masses and by Hill's determinant agree, in a lattice of cubic springs."""
    springs = [
        {"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": 5e3, "cubic": 1e9},
    ]
    table = {
        "lattice": {"cells": 3, "cell": {"masses": [4e-3, 2e-3], "springs": springs}},
        "contacts": {"law": "hertz", "stiffness": 1e7, "sites": [1, 2], "clearance": 1e-4},
        "nnm": {"system": "condensed", "start_frequency": [6000.0], "start_sites": sites, "truncation": 1e-5},
    }
    method = BalanceMethod(NnmCase.from_table(table))
    point = method.start(method.motions, 0)
    assert method.motions.forces.pairs > balance.MOST_OF_HILL
    by_orbit = method.assess(method.motions, point).multiplier
    monkeypatch.setattr(balance, "MOST_OF_HILL", method.motions.forces.pairs)
    by_hill = method.assess(method.motions, point).multiplier

    assert (by_orbit > 1.5) == (len(sites) == 2)
    assert by_orbit == pytest.approx(by_hill, rel=1e-6)


def test_a_slow_motion_with_few_harmonics_has_the_multiplier_of_its_orbit():
    """Where harmonics end below the highest mode, which decides nothing by Hill's method, the orbit of all masses does.

    A chain of 25 masses moves in its lowest mode with 15 harmonics, at a sixteenth of the highest frequency.
    """
    masses = 25
    springs = [{"start": i, "end": i + 1, "stiffness": 1.0} for i in range(masses)]
    system = {"masses": [1.0] * masses, "springs": springs, "smooth": [{"start": 0, "end": 1, "cubic": 0.5}]}
    options = {"system": "own", "method": "balance", "start_energy": 1e-3, "own": system}
    method = BalanceMethod(NnmCase.from_table({"nnm": options}))
    point = method.start(method.motions, 0)
    assert point.order * 2 * np.pi / point.period < method.motions.compliance.highest
    assert method.assess(method.motions, point).multiplier == pytest.approx(1.0, abs=1e-6)


OF_MASS = 0.2
OF_STIFFNESS = 1e-7


LOSSY = with_sections(
    TABLE,
    {
        "lattice": {"damping": {"mass": OF_MASS, "stiffness": OF_STIFFNESS}},
        "contacts": {"each": TABLE["contacts"]["each"] | {"restitution": [0.998] * 3}},
        "nnm": {"forced": [2, 1]},
    },
)


def lossy_case(**nnm: Any) -> NnmCase:
    """The lattice whose cells all differ, with Rayleigh damping and slightly lossy contacts; ``nnm`` updates [nnm]."""
    return NnmCase.from_table(with_sections(LOSSY, {"nnm": nnm}))


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    """A branch with losses, followed by shooting, and the folder of its files."""
    folder = tmp_path_factory.mktemp("lossy")
    (branch,) = follow_all(lossy_case(points=60, largest_step=0.3, start_energy=2e-4), folder, MPI.COMM_SELF)
    return branch, folder


def test_a_linear_mode_has_its_damping_ratio(shot):
    """Before the first contact the loss over 4 pi times the energy is the damping ratio of Rayleigh damping."""
    branch, _ = shot
    first = branch.points[0]
    omega = 2 * np.pi * first.frequency
    assert first.episodes == 0
    assert first.damping_ratio == pytest.approx((OF_MASS / omega + OF_STIFFNESS * omega) / 2, rel=1e-11)
    # In contact the mode has another shape, and the contacts add to the loss.
    assert branch.regular()[-1].damping_ratio > 1.1 * first.damping_ratio


def test_free_decay_takes_the_loss(shot):
    """A free motion that SciPy integrates with dashpots and restitutions loses the branch's loss over one period."""
    branch, _ = shot
    shooting = ShootingMethod(lossy_case()).shooting
    point = branch.regular()[-1]
    u, v = sample_orbit(shooting, point, samples=40)
    # The comparison begins where all contacts are open.
    begin = int(np.flatnonzero(np.all(shooting.system.gaps(u) < 0, axis=1))[0])

    motion, impacts = lattice_by_scipy(LOSSY).motion(np.array([point.period]), u[begin], v[begin], 0.0)

    lost = point.energy - shooting.system.energy(motion[0, -1], motion[1, -1])
    assert impacts >= 3
    # The branch's loss is of first order: it holds where the loss is a small part of the energy.
    assert point.loss < 1e-2 * point.energy
    assert lost == pytest.approx(point.loss, rel=1e-2)


def test_harmonics_of_all_orders_count_in_the_loss():
    """At large indentation the loss in dashpots between masses, by harmonics of all orders, is that along an orbit."""
    lattice = TWO_MASSES["lattice"] | {"damping": {"stiffness": 0.01}}
    nnm = {"system": "chain", "method": "balance", "modes": [1], "forced": [2, 1], "truncation": 1e-5}
    nnm |= {"points": 60, "largest_step": 0.3, "first_step": 0.1, "tolerance": 1e-11, "start_energy": 0.9}
    nnm |= {"energy": [0.0, 5.0]}
    table = {"name": "rig", "lattice": lattice, "contacts": TWO_MASSES["contacts"]}
    case = NnmCase.from_table(table | {"nnm": nnm})
    method = BalanceMethod(case)
    motion = list(Continuation(method.motions, method.start(method.motions, 0), method.options))[-1]
    motion = method.assess(method.motions, motion)

    shooting = ShootingMethod(NnmCase.from_table(table | {"nnm": nnm | {"method": "shooting"}})).shooting
    u = np.concatenate(list(state_of(method.motions, motion, 1).values()))
    frame = shooting.frame_at("relative", u, motion.period)
    row = np.append(u / np.linalg.norm(u), 0.0)
    orbit = frame.measures(frame.solve(frame.xi, row, row @ frame.xi))
    orbit = with_orbits_loss(shooting, method.dissipation, orbit)

    assert motion.loss == pytest.approx(orbit.loss, rel=1e-4)
    assert motion.force == pytest.approx(orbit.force, rel=1e-4)


@pytest.mark.parametrize("name", ["half", "whole", "half-centre"])
def test_losses_are_those_of_the_orbit_whichever_part_of_it_is_shot(name):
    """An orbit that a map of another branch shoots, from rest or from the centre, has the same loss and force."""
    own = {
        "masses": [1.0, 1.5],
        "springs": [{"start": start, "end": end, "stiffness": 1.0} for start, end in ((0, 1), (1, 2), (0, 2))],
        "dashpots": [{"start": 0, "end": 1, "damping": 2e-3}, {"start": 1, "end": 2, "damping": 1e-3}],
        "contacts": [{"host": 1, "resonator": 2, "clearance": 0.5}],
    }
    contacts = {"law": "bilinear", "stiffness": 2.0, "restitution": 0.99}
    nnm = {"system": "own", "own": own, "forced": [1], "max_newton": 20}
    method = ShootingMethod(NnmCase.from_table({"name": "own", "contacts": contacts, "nnm": nnm}))
    quarter = method.shooting
    frame = quarter.relative_frame(np.array([-0.6, 0.5]), 2 * np.pi / 1.8)
    row = np.append(frame.xi[:-1], 0.0)
    point = frame.measures(frame.solve(frame.xi, row, row @ frame.xi))
    assert quarter.map.quarter
    assert point.residual < 1e-12
    assert point.episodes == 1

    other = Shooting(quarter.flow, MAPS[name])
    moved = point
    if other.map.start == "centre":
        # The orbit passes the centre a quarter of a period after its rest.
        moved = replace(point, x=quarter.arc(point.x, point.period).end[2:])
    expected = method.assess(quarter, point)
    found = method.assess(other, moved)

    assert found.loss == pytest.approx(expected.loss, rel=1e-9)
    assert found.force == pytest.approx(expected.force, rel=1e-9)


@pytest.mark.parametrize("damping", [0.005])
def test_the_force_holds_a_steady_state_in_quadrature(damping):
    """A steady state near the free motion that lags its force by a quarter of a period needs the branch's force."""
    lattice = TWO_MASSES["lattice"] | {"damping": {"mass": damping}}
    nnm = {"system": "chain", "method": "balance", "modes": [1], "forced": [2, 1], "truncation": 1e-5}
    nnm |= {"points": 14, "largest_step": 0.2, "first_step": 0.05, "tolerance": 1e-11, "harmonics": 63}
    case = NnmCase.from_table(
        {"name": "rig", "lattice": lattice, "contacts": TWO_MASSES["contacts"], "nnm": nnm | {"start_energy": 0.9}}
    )
    method = BalanceMethod(case)
    motion = list(Continuation(method.motions, method.start(method.motions, 0), method.options))[-1]
    motion = method.assess(method.motions, motion)
    assert motion.episodes

    drive = {"waveform": "harmonic", "amplitude": 0.1, "frequency": 2 * np.pi / motion.period, "cell": 2, "mass": 1}
    nfrc = {"source": "force", "over": "amplitude", "range": [1e-3, 1.0], "harmonics": 63}
    forced = NfrcCase.from_table(TWO_MASSES | {"lattice": lattice, "drive": drive, "nfrc": nfrc})
    states = SteadyStates(forced, 1.0, 2 * np.pi / motion.period)
    # The free motion, a quarter of a period later, is the guess, at its own frequency; its phase is kept, and the
    # amplitude of the force is sought.
    free = method.motions.balance(motion.order).unpack(motion.x)[:, : states.balance.order + 1]
    orders = np.arange(states.balance.order + 1)
    behind = np.zeros((len(free), len(orders)), complex)
    behind[:, : free.shape[1]] = free
    behind *= np.exp(-0.5j * np.pi * orders)
    row = np.append(unit(states.balance.pack(-1j * orders * behind)), 0.0)
    guess = np.append(states.balance.pack(behind) / states.clearance, 1.0)
    attempt = SteadyFrame(states, guess, row).solve(guess, row, float(row @ guess))
    assert attempt.converged
    xi = attempt.xi * np.sign(attempt.xi[-1])

    # The branch's force is of first order in the damping, so that its error is proportional to the damping.
    assert xi[-1] * states.parameter.scale == pytest.approx(motion.force, rel=damping)
