"""Losses along normal modes: the damping of linear modes, free decay by SciPy, and forced states in quadrature."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.rigs import TWO_MASSES
from tests.unlike_lattices import TABLE, independent_lattice
from vipetsc.case import NnmCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.branches.balance import BalanceMethod, state_of
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.losses import with_orbits_loss
from vipetsc.modes.branches.orbits import ShootingMethod
from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.flow import MAPS
from vipetsc.modes.point import Point
from vipetsc.modes.problem import unit
from vipetsc.modes.response.equations import SteadyFrame
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.shooting import Shooting, sample_orbit

OF_MASS = 0.2
OF_STIFFNESS = 1e-7
RESTITUTION = 0.998


def lossy_case(**nnm: Any) -> NnmCase:
    """The lattice whose cells all differ, with Rayleigh damping and slightly lossy contacts; ``nnm`` updates [nnm]."""
    each = TABLE["contacts"]["each"] | {"restitution": [RESTITUTION] * 3}
    changes = {
        "lattice": TABLE["lattice"] | {"damping": {"mass": OF_MASS, "stiffness": OF_STIFFNESS}},
        "contacts": TABLE["contacts"] | {"each": each},
        "nnm": TABLE["nnm"] | {"forced": [2, 1]} | nnm,
    }
    return NnmCase.from_table(TABLE | changes)


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
    lattice = independent_lattice()
    # The branch's motion is conservative; the independent lattice gets the dashpots and restitutions.
    damped = replace(
        lattice,
        damping=OF_MASS * np.diag(lattice.masses) + OF_STIFFNESS * lattice.stiffness,
        stops=tuple(replace(stop, restitution=RESTITUTION) for stop in lattice.stops),
    )
    point = branch.regular()[-1]
    u, v = sample_orbit(shooting, point, samples=40)
    # The comparison begins where all contacts are open.
    begin = int(np.flatnonzero(np.all(shooting.system.gaps(u) < 0, axis=1))[0])

    motion, impacts = damped.motion(np.array([point.period]), u[begin], v[begin], 0.0)

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


def loss_by_scipy(method: ShootingMethod, point: Point) -> float:
    """The loss in J of an orbit by its integral over all episodes that begin within a period, for the reduced model."""
    system = method.system
    rows = system.contact_rows
    law = method.dissipation.laws[0]
    clearance = system.contacts[0].stops.plus
    n = system.dofs

    def rates(_: float, state: np.ndarray) -> np.ndarray:
        u, v, _actions = np.split(state, [n, 2 * n])
        w = rows @ u
        force = np.sign(w) * law.elastic_force(np.maximum(np.abs(w) - clearance, 0.0))
        acceleration = (-system.stiffness @ u - rows.T @ force) / system.masses
        return np.concatenate([v, acceleration, np.abs(force) * (rows @ v) ** 2])

    def changes(row: np.ndarray, direction: int) -> Callable[[float, np.ndarray], float]:
        def above(_: float, state: np.ndarray) -> float:
            return abs(float(row @ state[:n])) - clearance

        vars(above)["direction"] = direction
        return above

    start = np.append(method.shooting.arc(point.x, point.period).start, np.zeros(len(rows)))
    # Episodes that begin near the period's end are followed to theirs.
    whole = (0.0, 1.5 * point.period)
    events = [changes(row, direction) for row in rows for direction in (1, -1)]
    tolerances = {"rtol": 1e-11, "atol": 1e-15 * np.abs(start).max(), "max_step": point.period / 4000}
    solution = solve_ivp(rates, whole, start, "DOP853", events=events, dense_output=True, **tolerances)

    loss = 0.0
    for j, row in enumerate(rows):
        begins, ends = solution.t_events[2 * j : 2 * j + 2]
        for begin in begins[begins < point.period]:
            end = ends[ends > begin][0]
            approach = abs(float(row @ solution.sol(begin)[n : 2 * n]))
            action = solution.sol(end)[2 * n + j] - solution.sol(begin)[2 * n + j]
            loss += law.damping * float(action) / approach
    return loss


# Points of the paper's in-phase branch with the bilinear law. Contacts of the first have just begun; the second has
# episodes of very different lengths.
BARELY = ([0.0006330335292987458, 0.002410564972379855], 0.006734917800219066)
UNLIKE = ([-2.1834937624515054, -2.190807429909221], 0.003143918091158219)


@pytest.mark.parametrize(("x", "period", "episodes"), [(*BARELY, 4), (*UNLIKE, 2)])
def test_the_loss_of_an_orbit_is_its_integral(x, period, episodes):
    """Losses of the paper's model are the integral that SciPy finds, also where a contact all but grazes."""
    contacts = {"law": "bilinear", "modulus": 1e8, "restitution": 0.9}
    lattice = {"preset": "four-band", "reading": "printed"}
    method = ShootingMethod(NnmCase.from_table({"lattice": lattice, "contacts": contacts, "nnm": {"modes": [1]}}))
    frame = method.shooting.relative_frame(np.array(x), period)
    row = np.append(frame.xi[:-1], 0.0)
    point = method.assess(method.shooting, frame.measures(frame.solve(frame.xi, row, row @ frame.xi)))

    assert point.residual < 1e-11
    assert point.episodes == episodes
    assert point.loss == pytest.approx(loss_by_scipy(method, point), rel=2e-4)
