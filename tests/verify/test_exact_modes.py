"""Normal modes with periods and losses in closed form: stops, pressed contacts, mirrored, stiff and damped systems."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipk

from tests.breathers import breather_chain
from tests.condensed_branches import condensed_branch
from tests.models import CLEARANCE, four_band_contact
from tests.unlike_lattices import TABLE as UNLIKE
from tests.unlike_lattices import unlike_case
from tests.zoo_by_scipy import lattice_by_scipy
from vipetsc.case import NnmCase
from vipetsc.case.nnm import NnmTable
from vipetsc.endings import Ending
from vipetsc.lattice import Chain, Contact, WaveCompliance
from vipetsc.lattice.sites import sites_at
from vipetsc.modes.balance.conservative import ConservativeMotions
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.branches.balance import condensed_system, state_of
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.files import read_branch, write_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.orbits import ShootingMethod
from vipetsc.modes.continuation.arclength import Continuation, locate
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.problem import FlowError
from vipetsc.modes.shooting import Shooting, linear_start, sample_orbit
from vipetsc.modes.stops import Stops
from vipetsc.modes.system import ContactPair, SmoothSpring, System

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
    """A branch whose first motion has too little energy goes on up, and one with too much goes on down."""
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


# A frequency in rad/s in the lowest gap. At higher ones no breather begins at a stop on one side, since the mean of its
# force moves the site away.
OMEGA = 640.0
SIDES = [(0.1, np.inf), (np.inf, 0.1), (0.1, 0.13)]


def mass_between_stops(plus: float, minus: float) -> System:
    """A mass on a spring, with linear stops of the ground at clearances in m on its two sides."""
    pair = ContactPair(None, 0, plus, Contact("bilinear", STOP), minus)
    return System.assemble([MASS], [(None, 0, SPRING)], [pair])


def time_on_one_side(energy: float, clearance: float) -> float:
    """The time in s from the middle to rest on the side of a stop at ``clearance``, in closed form.

    The motion is harmonic about the middle up to the stop, and about another equilibrium in contact.
    """
    # The frequencies of the mass on its spring alone, and on spring and stop.
    slow = np.sqrt(SPRING / MASS)
    fast = np.sqrt((SPRING + STOP) / MASS)
    amplitude = np.sqrt(2 * energy / SPRING)
    if amplitude <= clearance:
        return np.pi / 2 / slow
    # The equilibrium about which the motion in contact is harmonic.
    middle = STOP * clearance / (SPRING + STOP)
    # The kinetic energy at the stop.
    at_stop = energy - SPRING * clearance**2 / 2
    reach = np.sqrt((clearance - middle) ** 2 + 2 * at_stop / (SPRING + STOP))
    return float(np.arcsin(clearance / amplitude) / slow + np.arccos((clearance - middle) / reach) / fast)


@pytest.mark.parametrize(("plus", "minus"), SIDES)
def test_a_mass_with_stops_that_differ_has_its_period_in_closed_form(plus, minus):
    """Shooting over half a period gives the exact period of a stop on one side, and of stops at two distances."""
    system = mass_between_stops(plus, minus)
    problem = Shooting(Dop853Flow(system), MAPS["half"])
    # The branch begins at 0.8 of the energy at which the nearer stop is grazed.
    start = linear_start(problem, 0, 0.4 * SPRING * 0.1**2)
    points = [start, *Continuation(problem, start, NnmTable(points=60, largest_step=0.3, first_step=0.1))]

    assert points[-1].episodes == (1 if np.inf in (plus, minus) else 2)
    for point in points:
        half = time_on_one_side(point.energy, plus) + time_on_one_side(point.energy, minus)
        assert point.period == pytest.approx(2 * half, rel=1e-11)


@pytest.fixture(scope="module")
def unlike_branch(tmp_path_factory):
    """The shooting problem of a lattice whose cells and sites differ, and the branch of a mode."""
    case = unlike_case(points=60, largest_step=0.3, start_energy=2e-4)
    (branch,) = follow_all(case, tmp_path_factory.mktemp("unlike"), MPI.COMM_SELF)
    return Shooting(Dop853Flow(System.from_case(case)), MAPS["half"]), branch


def test_orbits_of_a_lattice_that_differs_everywhere_return_by_scipy(unlike_branch):
    """An orbit returns after its period when SciPy integrates independent equations of the lattice."""
    problem, branch = unlike_branch
    lattice = lattice_by_scipy(UNLIKE)
    # The orbits are one near the first contacts, and the last one.
    for number in (40, 60):
        point = branch.regular()[number]
        u, v = sample_orbit(problem, point, samples=40)
        # The comparison begins where all contacts are open.
        begin = int(np.flatnonzero(np.all(problem.system.gaps(u) < 0, axis=1))[0])
        motion, impacts = lattice.motion(np.array([point.period]), u[begin], v[begin], 0.0)

        # An orbit without impacts would return by the linear equations alone.
        assert impacts >= 3
        assert np.abs(motion[0, -1] - u[begin]).max() < 1e-8 * np.abs(u).max()
        assert np.abs(motion[1, -1] - v[begin]).max() < 1e-8 * np.abs(v).max()


@pytest.fixture(scope="module")
def one_sided():
    """The chain, the stops and the breather of a site with a stop on one side, by shooting."""
    chain = breather_chain()
    stops = [Stops(four_band_contact("hertz"), CLEARANCE, np.inf)]
    system = System.from_chain(chain, stops)
    motions = condensed_system(system, NnmTable(truncation=1e-6, tolerance=1e-11))
    u = np.concatenate(list(state_of(motions, motions.in_gap(OMEGA, np.array([1.0])), chain.cell.dofs).values()))
    # The map is that of half a period, since a motion with a stop on one side has no symmetry of quarters.
    frame = Shooting(Dop853Flow(system), MAPS["half"], 1e-12).relative_frame(u, 2 * np.pi / OMEGA)
    attempt = frame.solve(frame.xi, np.append(np.zeros(len(u)), 1.0), 1.0)
    assert attempt.converged
    return chain, stops, frame.measures(attempt)


def test_bloch_waves_and_all_modes_give_the_same_breather_on_one_side(one_sided):
    """The compliance by Bloch waves and the one by all modes give the same breather, which is that of shooting."""
    chain, stops, shot = one_sided
    control = NnmTable(truncation=1e-6, tolerance=1e-11)
    by_waves = ConservativeMotions(WaveCompliance(chain), SiteForces(stops), control)
    by_modes = condensed_system(System.from_chain(chain, stops), control)

    first, second = (problem.in_gap(OMEGA, np.array([1.0])) for problem in (by_waves, by_modes))

    assert first.x == pytest.approx(second.x, abs=1e-10 * np.abs(first.x).max())
    assert first.energy == pytest.approx(shot.energy, rel=1e-5)
    u = np.concatenate(list(state_of(by_modes, second, chain.cell.dofs).values()))
    # The phase of a state is free up to half a period.
    assert min(np.abs(u - shot.x).max(), np.abs(u + shot.x).max()) < 1e-4 * np.abs(u).max()


def test_a_breather_begins_at_the_site_that_is_asked_for():
    """A breather begins at the site asked for: twice as large at twice the clearance, negative on the other side."""
    cell = breather_chain().cell
    chain = Chain(cell, 18, "fixed", sites_at([4, 13], cell.pair, clearances=[CLEARANCE, 2 * CLEARANCE]))
    stops = [Stops.both(four_band_contact("bilinear"), clearance) for clearance in chain.sites.clearances]
    control = NnmTable(truncation=1e-7, tolerance=1e-11)
    problem = ConservativeMotions(WaveCompliance(chain), SiteForces(stops), control)

    near, far, opposite = (problem.in_gap(1600.0, np.array(signs)) for signs in ([1, 0], [0, 1], [0, -1]))

    fields = [state_of(problem, point, chain.cell.dofs) for point in (near, far)]
    assert tuple(max(field, key=lambda cell: np.abs(field[cell]).max()) for field in fields) == (4, 13)
    assert far.elongations[1] == pytest.approx(2 * near.elongations[0], rel=1e-6)
    # The energy is proportional to the square of the clearance.
    assert far.energy == pytest.approx(4 * near.energy, rel=1e-6)
    assert opposite.x == pytest.approx(-far.x, abs=1e-9 * np.abs(far.x).max())


WALL = 1000.0  # N/m, the spring of each of two masses of 1 kg to the ground
BETWEEN = 500.0  # N/m, the spring between the two masses
MIRRORED_STOP = 5000.0  # N/m
MIRRORED_GAP = 1e-3  # m
# The stiffness (N/m) that one mass moves against. In phase the spring between the masses is not strained; out of phase
# its middle stands still, so that each half of the spring has twice its stiffness.
HALF = {"in-phase": WALL, "out-of-phase": WALL + 2 * BETWEEN}
TABLE: dict[str, Any] = {
    "name": "mirror",
    "contacts": {"law": "bilinear", "stiffness": MIRRORED_STOP},
    "nnm": {
        "system": "own",
        "modes": [1, 2],
        "energy": [0.0, 6e-3],
        "points": 90,
        "locate": False,
        "own": {
            "masses": [1.0, 1.0],
            "springs": [
                {"start": 0, "end": 1, "stiffness": WALL},
                {"start": 1, "end": 2, "stiffness": BETWEEN},
                {"start": 0, "end": 2, "stiffness": WALL},
            ],
            "contacts": [
                {"host": 0, "resonator": 1, "clearance": MIRRORED_GAP},
                {"host": 0, "resonator": 2, "clearance": MIRRORED_GAP},
            ],
        },
    },
}


def own_case(sides: list[str], **nnm: Any) -> dict[str, Any]:
    """The case of two masses whose stops are on these ``sides``; ``nnm`` updates the table [nnm]."""
    contacts = TABLE["contacts"] | {"each": {"side": sides}}
    return TABLE | {"contacts": contacts, "nnm": TABLE["nnm"] | nnm}


def branches(table: dict[str, Any]) -> dict[str, Branch]:
    """The branches of the case in ``table`` by their names."""
    found = follow_all(NnmCase.from_table(table), None, MPI.COMM_SELF)
    return {branch.name: branch for branch in found}


def period_between_stops(energy: float, stiffness: float, sides: int) -> float:
    """Period in s of a mass of 1 kg on a spring, with a stop on one of its sides or on both, at an ``energy`` in J.

    The motion is harmonic about 0 outside the stop, and about the equilibrium of both springs at the stop.
    """
    omega = np.sqrt(stiffness)
    if 2 * energy < stiffness * MIRRORED_GAP**2:
        return float(2 * np.pi / omega)
    speed = np.sqrt(2 * energy - stiffness * MIRRORED_GAP**2)
    to_stop = np.arctan2(omega * MIRRORED_GAP, speed) / omega
    stiffer = np.sqrt(stiffness + MIRRORED_STOP)
    rest = MIRRORED_STOP * MIRRORED_GAP / (stiffness + MIRRORED_STOP)
    in_stop = np.arctan2(speed, stiffer * (MIRRORED_GAP - rest)) / stiffer
    return float(2 * sides * (to_stop + in_stop) + (2 - sides) * np.pi / omega)


def assert_halves(branch: Branch, sides: int, rtol: float) -> None:
    """Assert that every orbit has the period of one mass that moves with half of the energy."""
    for point in branch.regular():
        exact = period_between_stops(point.energy / 2, HALF[branch.name], sides)
        assert point.period == pytest.approx(exact, rel=rtol)


# The sides of the two stops, the modes in which each mass moves as if alone with a stop, and the sides of that stop.
MIRRORED_SIDES = [
    (["plus", "plus"], ["in-phase"], 1),
    (["plus", "minus"], ["out-of-phase"], 1),
    (["both", "both"], ["in-phase", "out-of-phase"], 2),
]


@pytest.mark.parametrize(("sides", "halved", "stops"), MIRRORED_SIDES)
def test_contacts_of_a_mirrored_lattice_begin_in_pairs(sides, halved, stops):
    """Branches of mirror-symmetric modes pass the grazing of two contacts and reach the end of their range."""
    found = branches(own_case(sides))
    assert list(found) == list(HALF)
    for name, branch in found.items():
        assert "energy range" in branch.ended.sentence, branch.ended.sentence
        episodes = [point.episodes for point in branch.regular()]
        assert episodes[0] == 0
        assert episodes[-1] >= 2
        if name in halved:
            assert_halves(branch, stops, rtol=1e-9)


def test_so_do_those_of_condensed_motions():
    """Contacts of a mirrored lattice begin in pairs in condensed motions too, with the exact period."""
    found = branches(own_case(["plus", "plus"], method="balance", truncation=1e-4, first_step=0.05, largest_step=0.2))
    for branch in found.values():
        assert "energy range" in branch.ended.sentence, branch.ended.sentence
        assert branch.regular()[-1].episodes == 2
    assert_halves(found["in-phase"], sides=1, rtol=1e-5)


@pytest.mark.parametrize("beyond", [0.0, 1e-7, 1e-4])
def test_contacts_that_are_no_images_begin_one_after_the_other(beyond):
    """Two contacts graze at two points if their clearances differ by little, and at one if they are equal."""
    table = own_case(["plus", "plus"], locate=True, locate_grazing=True)
    own = table["nnm"]["own"]
    first, second = own["contacts"]
    further = second | {"clearance": MIRRORED_GAP * (1 + beyond)}
    table["nnm"]["own"] = own | {"contacts": [first, further]}
    for branch in branches(table).values():
        grazing = [point.energy for point in branch.points if point.kind == "grazing"]
        assert len(grazing) == (2 if beyond else 1)
        assert max(point.episodes for point in branch.points) == 2
        # The second contact begins at an energy that is larger by about twice the difference.
        if beyond:
            assert 0.1 * beyond < grazing[1] / grazing[0] - 1 < 10 * beyond


# Two masses of 1 kg. The first one is on a spring of z + q z^2 + c z^3, and is joined to the second by a spring of
# 1 N/m and a contact of Hertz's law, which is pressed by DEPTH at rest. They move together 245 times more slowly than
# they vibrate against each other.
QUADRATIC = 0.3
CUBIC = 0.5


def test_two_masses_on_a_stiff_spring_have_the_period_of_one():
    """Two masses that a stiff spring joins move as one, whose period is a quadrature of the energy of the soft spring.

    The stiff spring of k N/m gives way by 1/(2 k) of the displacement.
    """
    link = 1e6
    smooth = [SmoothSpring.between(None, 0, quadratic=QUADRATIC, cubic=CUBIC)]
    system = System.assemble([1.0, 1.0], [(None, 0, 1.0), (0, 1, link)], [], smooth)
    problem = Shooting(Dop853Flow(system), MAPS["half"])
    point = linear_start(problem, 0, 0.05)
    turns = np.roots([CUBIC / 4, QUADRATIC / 3, 0.5, 0.0, -point.energy])
    low, high = sorted(turns[np.isreal(turns)].real)

    def slowness(phi: float) -> float:
        u = low + (high - low) * np.sin(phi) ** 2
        potential = u**2 / 2 + QUADRATIC * u**3 / 3 + CUBIC * u**4 / 4
        # Both masses have this speed.
        return float((high - low) * np.sin(2 * phi) / np.sqrt(point.energy - potential))

    assert point.period == pytest.approx(2 * quad(slowness, 0, np.pi / 2, epsrel=1e-10)[0], rel=3 / link)
    assert point.residual < problem.rounding(point.period)


def softening(method: str, energy: float = 1.0, masses: int = 1, stiffness: float = 1.0, **law: float) -> Branch[Any]:
    """The branch of the first mode of masses of 1 kg, each on a spring to the ground that softens."""
    ground = range(1, masses + 1)
    own = {
        "masses": [1.0] * masses,
        "springs": [{"start": 0, "end": mass, "stiffness": stiffness} for mass in ground],
        "smooth": [{"start": 0, "end": mass} | law for mass in ground],
    }
    own["springs"] += [{"start": mass, "end": mass + 1, "stiffness": 0.1} for mass in range(1, masses)]
    nnm = {"system": "own", "method": method, "modes": [1], "energy": [0.0, energy], "own": own, "harmonics": 255}
    if method == "damped":
        own["dashpots"] = [{"start": 0, "end": 1, "damping": 0.02}]
    (branch,) = follow_all(NnmCase.from_table({"nnm": nnm}), None, MPI.COMM_SELF)
    return branch


def quadratic_period(x: float) -> float:
    """The period of u'' + u - u^2 = 0 from rest at x: u is between the two smaller roots of the potential."""
    others = np.roots([1.0, x - 1.5, x * (x - 1.5)])
    low, middle, high = np.sort([x, *others.real])
    return 4 * np.sqrt(1.5 / (high - low)) * ellipk((middle - low) / (high - low))


def cubic_period(x: float) -> float:
    """The period of u'' + u - u^3 = 0 from rest at x."""
    return 4 * np.sqrt(2 / (2 - x**2)) * ellipk(x**2 / (2 - x**2))


@pytest.mark.parametrize("method", ["shooting", "balance"])
@pytest.mark.parametrize(
    ("law", "last", "period"), [("quadratic", 1 / 6, quadratic_period), ("cubic", 1 / 4, cubic_period)]
)
def test_a_branch_ends_at_the_saddle(method, law, last, period):
    """The energy of the saddle ends the branch, its points are orbits, and their periods are elliptic integrals."""
    branch = softening(method, **{law: -1.0})
    assert branch.complete
    assert "equilibrium" in branch.ended.sentence
    assert branch.points[-1].energy == pytest.approx(last, rel=1e-6)
    assert {p.kind for p in branch.points} == {"regular"}

    assert max(p.residual for p in branch.points) < 1e-8
    for point in branch.points:
        start = float(np.ravel(point.elongations if method == "balance" else point.x)[0])
        # Near the saddle the period depends on the last digits of the start.
        if abs(start - 1) > 1e-4:
            assert point.period == pytest.approx(period(start), rel=1e-9 + 1e-7 / abs(start - 1))


@pytest.mark.parametrize(("law", "last"), [("quadratic", 1 / 6), ("cubic", 1 / 4)])
def test_a_damped_branch_ends_at_the_saddle(law, last):
    """The energy that is added keeps the motion going up to the saddle, beyond which nothing is periodic."""
    branch = softening("damped", **{law: -1.0})
    assert "equilibrium" in branch.ended.sentence
    assert branch.points[-1].energy == pytest.approx(last, rel=1e-6)
    assert max(point.truncation for point in branch.points) < 1e-3


@pytest.mark.parametrize(
    ("change", "saddle"),
    [
        pytest.param({"cubic": -1.0, "masses": 2}, 0.5, id="two masses"),
        pytest.param({"cubic": -4.0, "stiffness": 4.0, "energy": 2.0}, 1.0, id="stiffer"),
        # k u - 3 u^2 + 2 u^3 has the equilibria 0, 1/2 and 1.
        pytest.param({"quadratic": -3.0, "cubic": 2.0}, 1 / 32, id="two wells"),
    ],
)
def test_other_saddles_end_branches(change, saddle):
    branch = softening("shooting", **change)
    assert "equilibrium" in branch.ended.sentence
    assert branch.points[-1].energy == pytest.approx(saddle, rel=1e-6)
    assert max(p.residual for p in branch.points) < 1e-8


GROUND = {"start": 0, "end": 1}
STIFFNESS = np.array([[2.0, -1.0], [-1.0, 2.0]])
DAMPING = np.array([[0.07, -0.05], [-0.05, 0.05]])
TWO_MASSES = {
    "masses": [1.0, 1.0],
    "springs": [
        GROUND | {"stiffness": 1.0},
        {"start": 1, "end": 2, "stiffness": 1.0},
        {"start": 0, "end": 2, "stiffness": 1.0},
    ],
    "smooth": [GROUND | {"cubic": 0.5}],
    "dashpots": [GROUND | {"damping": 0.02}, {"start": 1, "end": 2, "damping": 0.05}],
}


def case_of(system, **nnm) -> NnmCase:
    """Return the case of the damped modes of a ``system``."""
    options = {"system": "own", "own": system, "method": "damped", "energy": [0.0, 1.0]}
    return NnmCase.from_table({"name": "x", "nnm": options | nnm})


def test_a_duffing_oscillator_has_the_conservative_frequency():
    """Of u'' + c u' + u + u^3 = 0 the added damping cancels the dashpot: zeta = c/(2 Om), Om as without it."""
    c = 0.3
    system = {
        "masses": [1.0],
        "springs": [GROUND | {"stiffness": 1.0}],
        "smooth": [GROUND | {"cubic": 1.0}],
        "dashpots": [GROUND | {"damping": c}],
    }
    (branch,) = follow_all(case_of(system, modes=[1], energy=[0.0, 10.0]), None, MPI.COMM_SELF)
    assert branch.points[-1].energy > 10
    for point in branch.regular():
        omega = 2 * np.pi / point.period
        assert point.damping_ratio == pytest.approx(c / (2 * omega), rel=1e-10)
        # The conservative motion has its energy at every time: the mean is that of the motion without damping.
        square = np.sqrt(1 + 4 * point.energy) - 1
        period = 4 * ellipk(square / (2 * (1 + square))) / np.sqrt(1 + square)
        assert point.period == pytest.approx(period, rel=1e-8)


PAIR = {
    "masses": [1.0, 2.0],
    "springs": [{"start": 1, "end": 2, "stiffness": 1.0}],
    "smooth": [{"start": 1, "end": 2, "quadratic": 0.3, "cubic": 0.3}],
}
RING = {
    "masses": [1.0, 1.0, 1.2, 1.0],
    "springs": [{"start": i, "end": i % 4 + 1, "stiffness": 1.0} for i in (1, 2, 3, 4)],
    "contacts": [{"host": 1, "resonator": 2, "clearance": 0.3}],
}


@pytest.mark.parametrize(
    ("system", "mode", "contacts"),
    [(PAIR, 2, {}), (RING, 4, {"law": "hertz", "stiffness": 2.0, "side": "plus"})],
    ids=["two masses", "ring with a stop"],
)
def test_free_systems_have_damped_modes_with_a_mean(system, mode, contacts):
    """Where nothing holds the system and forces have a mean, damped modes without loss are the conservative motions."""
    nnm = {"system": "own", "own": system, "modes": [mode], "energy": [0.0, 0.5], "points_at": {"energy": [0.4]}}
    frequencies = []
    for method in ("balance", "damped"):
        case = NnmCase.from_table({"name": "x", "nnm": nnm | {"method": method}, "contacts": contacts})
        (branch,) = follow_all(case, None, MPI.COMM_SELF)
        (point,) = (p for p in branch.points if p.kind == "energy@0.4")
        frequencies.append(point.frequency)
    assert frequencies[1] == pytest.approx(frequencies[0], rel=1e-8)
    # The centre of mass stays where it is, in the mean as at every time.
    means = point.x[1:].reshape(len(system["masses"]), -1)[:, 0]
    assert abs(system["masses"] @ means) < 1e-10
    assert np.abs(means).max() > 1e-3


def test_small_motions_are_the_complex_modes():
    """Frequency and damping ratio are |lambda| and -Re lambda/|lambda| of the linear modes, up to zeta^2."""
    state = np.block([[np.zeros((2, 2)), np.eye(2)], [-STIFFNESS, -DAMPING]])
    values = np.linalg.eigvals(state)
    exact = sorted((abs(v), -v.real / abs(v)) for v in values if v.imag > 0)
    for branch, (frequency, ratio) in zip(
        follow_all(case_of(TWO_MASSES, modes=[1, 2], points=1, start_energy=1e-8), None, MPI.COMM_SELF),
        exact,
        strict=True,
    ):
        first = branch.points[0]
        assert 2 * np.pi * first.frequency == pytest.approx(frequency, rel=2e-4)
        assert first.damping_ratio == pytest.approx(ratio, rel=2e-3)


def test_a_file_has_the_motions_of_different_orders(tmp_path):
    """The harmonics of a branch adapt to the motion; a file returns each point with its own."""
    (branch,) = follow_all(case_of(TWO_MASSES, modes=[1], energy=[0.0, 10.0], truncation=1e-12), None, MPI.COMM_SELF)
    assert len(set(branch.column("order").tolist())) > 1
    write_branch(branch, tmp_path, {})
    read = read_branch(tmp_path / f"branch-{branch.name}.h5")
    for point, stored in zip(branch.points, read.points, strict=True):
        for name in ("x", "tangent", "zeta", "loss", "period", "order", "truncation", "elongations"):
            assert np.array_equal(getattr(point, name), getattr(stored, name)), name


def test_a_free_motion_decays_as_the_mode_says():
    """A motion that starts on the mode loses in each period what the mode of its present energy loses."""
    (branch,) = follow_all(case_of(TWO_MASSES, modes=[1]), None, MPI.COMM_SELF)
    energies = branch.column("energy")
    ratios = np.array([point.damping_ratio for point in branch.points])
    losses = branch.column("loss")
    periods = branch.column("period")
    # The nonlinearity moves the damping ratio by more than the rate's error.
    assert ratios.max() / ratios.min() > 1.15

    point = branch.points[-1]
    order = point.order
    count = order // 2 + 1
    parts = point.x[1:].reshape(2, 2 * count)
    omega = 2 * np.pi / point.period
    u = parts[:, :count].sum(axis=1)
    v = -omega * (parts[:, count:] * np.arange(1, order + 1, 2)).sum(axis=1)

    def rate(t, y):
        force = STIFFNESS @ y[:2] + DAMPING @ y[2:]
        force[0] += 0.5 * y[0] ** 3
        return np.concatenate([y[2:], -force])

    times = np.linspace(0, 12 * point.period, 4001)
    y = solve_ivp(rate, (0, times[-1]), np.concatenate([u, v]), t_eval=times, rtol=1e-10, atol=1e-12).y
    energy = 0.5 * (y[2:] ** 2).sum(axis=0) + 0.5 * np.einsum("it,ij,jt->t", y[:2], STIFFNESS, y[:2]) + y[0] ** 4 / 8
    mean = np.convolve(energy, np.ones(335) / 335, "valid")
    growing = np.argsort(energies)

    def slow(t, e):
        return -np.interp(e, energies[growing], (losses / periods)[growing])

    predicted = solve_ivp(slow, (0, times[len(mean) - 1]), [mean[0]], rtol=1e-8).y[0, -1]
    assert mean[-1] < 0.6 * mean[0]
    assert np.log(mean[-1] / mean[0]) == pytest.approx(np.log(predicted / mean[0]), rel=0.004)


RIGID = Contact("rigid", 0.0)
OWN = {
    "masses": [1.0],
    "springs": [{"start": 0, "end": 1, "stiffness": 4.0}],
    "contacts": [{"host": 0, "resonator": 1, "clearance": 1.0}],
}


def one_mass(**contacts: Any) -> dict[str, Any]:
    """A mass of 1 kg on a spring of 4 N/m, with stops 1 m away."""
    nnm = {"system": "own", "modes": [1], "energy": [0.0, 50.0], "own": OWN}
    return {"name": "stops", "contacts": {"law": "rigid"} | contacts, "nnm": nnm}


def followed(table: dict[str, Any], ending: Ending) -> list[Branch[Any]]:
    """Return the branches of a case, which must come to their ``ending`` and miss no special point."""
    branches = follow_all(NnmCase.from_table(table), None, MPI.COMM_SELF)
    for branch in branches:
        assert branch.ended.ending is ending, branch.ended.sentence
        assert not branch.findings, branch.findings
    return branches


@pytest.mark.parametrize("side", ["both", "plus", "minus"])
def test_one_mass_has_the_period_of_its_formula(side):
    """Beyond grazing, E = k D^2/2, a motion of amplitude A is a part of the harmonic one, cut off at the stops."""
    (branch,) = followed(one_mass(side=side), Ending.OUT_OF_ENERGIES)
    assert branch.points[-1].energy > 50.0
    for point in branch.points:
        amplitude = np.sqrt(2 * point.energy / 4.0)
        period = np.pi
        # The corner itself is found to rounding, of which the formula beyond it takes the root.
        is_struck = amplitude > 1 + 1e-12
        if is_struck:
            # From the centre to a stop in arcsin(D/A)/omega, omega = 2 rad/s; from the centre to rest in pi/(2 omega).
            to_stop = np.arcsin(1 / amplitude) / 2
            period = 4 * to_stop if side == "both" else 2 * to_stop + np.pi / 2
        assert point.period == pytest.approx(period, rel=1e-12, abs=0)
        assert point.episodes == is_struck
        assert point.multiplier == 1.0
    (grazing,) = [point for point in branch.points if point.kind != "regular"]
    assert grazing.kind == "grazing"
    assert grazing.energy == pytest.approx(2.0, rel=1e-9)


def test_the_cell_of_the_built_in_lattice_has_rigid_modes():
    """Both modes of the reduced model reach their stops, and their frequencies rise from there on."""
    table = {"name": "four-band", "contacts": {"law": "rigid"}, "nnm": {"points": 80}}
    branches = follow_all(NnmCase.from_table(table), None, MPI.COMM_SELF)
    assert len(branches) == 2
    for branch in branches:
        struck = [point for point in branch.regular() if point.episodes]
        assert len(struck) > 10, branch.ended.sentence
        frequencies = [point.frequency for point in struck]
        assert frequencies[-1] > frequencies[0] > branch.points[0].frequency


def test_a_branch_ends_where_its_rest_comes_to_the_stop_of_the_other_side():
    """With stops 1 m and 1.4 m away that is at E = k (1.4 m)^2/2, and one period is that of a stop on one side."""
    (branch,) = followed(one_mass(clearance_minus=1.4), Ending.STOP_AT_REST)
    assert branch.points[-1].energy == pytest.approx(2.0 * 1.4**2, rel=1e-8)
    assert branch.points[-1].period == pytest.approx(np.arcsin(1 / 1.4) + np.pi / 2, rel=1e-8)


def two_masses(*stops: ContactPair) -> System:
    """Two masses on three springs, with rigid ``stops``."""
    return System.assemble([1.0, 2.0], [(None, 0, 3.0), (0, 1, 2.0), (None, 1, 1.0)], stops)


def test_the_derivative_of_an_arc_passes_impacts():
    """Saltation at stops of either mass and between them, against central differences of the flow: 1e-7."""
    system = two_masses(ContactPair(None, 1, 0.15, RIGID, np.inf), ContactPair(0, 1, 0.4, RIGID, 0.2))
    flow = Dop853Flow(system)
    start = np.array([0.2, 0.1, 0.9, -0.5])
    duration = 7.0
    arc = flow.arc(start, duration, 3.0)
    assert {(int(contact), int(side)) for _, contact, side, _ in arc.events} == {(0, 1), (1, -1)}
    assert len(arc.events) == 10
    step = 1e-6
    for i in range(4):
        moved = step * np.eye(4)[i]
        after, before = (flow.states(start + sign * moved, duration, 1, 3.0)[-1] for sign in (1, -1))
        difference = (after - before) / (2 * step)
        np.testing.assert_allclose(arc.sensitivity[:, i], difference, rtol=0, atol=1e-7 * np.abs(arc.sensitivity).max())
    before, after = (system.energy(*np.split(state, 2)) for state in (start, arc.end))
    assert after == pytest.approx(before, rel=1e-13)


def flight(system: System, state: np.ndarray, duration: float) -> np.ndarray:
    """Return the state after ``duration`` seconds by scipy, which stops at each impact to turn the velocities."""
    n = system.dofs
    inverse = 1 / np.asarray(system.masses)

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[n:], -inverse * (system.stiffness @ y[:n])])

    stops = []
    for row, (plus, minus) in zip(system.contact_rows, system.clearances, strict=True):
        for side, gap in ((1, plus), (-1, minus)):
            if np.isfinite(gap):

                def beyond(_: float, y: np.ndarray, row: np.ndarray = side * row, gap: float = gap) -> float:
                    return row @ y[:n] - gap

                beyond.terminal = True
                beyond.direction = 1
                stops.append((beyond, row))

    t = 0.0
    while t < duration:
        # The polynomial on which events are found is exact enough in short steps alone.
        options = {
            "method": "DOP853",
            "max_step": 0.05,
            "rtol": 1e-13,
            "atol": 1e-14,
            "events": [beyond for beyond, _ in stops],
        }
        result = solve_ivp(rates, (t, duration), state, **options)
        t = result.t[-1]
        state = result.y[:, -1]
        if result.status == 1:
            (struck,) = [i for i, times in enumerate(result.t_events) if len(times)]
            row = stops[struck][1]
            state[n:] -= 2 * (row @ state[n:]) / (row @ (inverse * row)) * inverse * row
    return state


CHAIN = {
    "masses": [1.0, 2.0, 1.5],
    "springs": [{"start": i, "end": i + 1, "stiffness": k} for i, k in enumerate([3.0, 2.0, 1.0])],
    "contacts": [{"host": 0, "resonator": 1, "clearance": 1.0}],
}


@pytest.mark.parametrize(("side", "mode"), [("both", 1), ("both", 3), ("plus", 1), ("plus", 2)])
def test_orbits_close_by_an_independent_integration(side, mode):
    """Orbits of three masses come back to their starts; their multipliers are those of the whole period."""
    nnm = {"system": "own", "modes": [mode], "points": 105, "own": CHAIN}
    case = {"name": "chain", "contacts": {"law": "rigid", "side": side}, "nnm": nnm}
    (branch,) = followed(case, Ending.POINTS_USED)
    method = ShootingMethod(NnmCase.from_table(case))
    system = method.system
    # Beyond grazing the frequency rises from that of the linear mode.
    linear = system.linear_modes()[0][mode - 1] / (2 * np.pi)
    struck = [point for point in branch.regular() if point.episodes]
    assert len(struck) > 30
    assert min(point.frequency for point in struck) > linear
    (energy,) = [point.energy for point in branch.points if point.kind == "grazing" and point.episodes == 0]
    assert energy == pytest.approx(system.grazing_energy(mode - 1), rel=1e-7)

    # Not next to grazing, where scipy misses impacts that are over within a step, and errors grow 1e5 times.
    for point in struck[len(struck) // 2 :: len(struck) // 6]:
        start = method.shooting.arc(point.x, point.period).start
        end = flight(system, start, point.period)
        omega = 2 * np.pi / point.period
        units = np.repeat([1.0, omega], system.dofs)
        size = np.abs(start / units).max()
        np.testing.assert_allclose(end / units, start / units, rtol=0, atol=1e-8 * size)

        whole = method.shooting.flow.arc(start, point.period, point.period).sensitivity
        np.testing.assert_allclose(np.linalg.det(whole), 1.0, rtol=1e-6)
        # Each pair of multipliers has the sum 2 c; the pair of the shift in time has 2.
        assert np.trace(whole) == pytest.approx(2 + 2 * np.sum(point.half_traces).real, rel=1e-6, abs=1e-6)


TWINS = {
    "masses": [1.0, 1.0],
    "springs": [{"start": i, "end": j, "stiffness": k} for i, j, k in [(0, 1, 4.0), (1, 2, 1.0), (0, 2, 4.0)]],
    "contacts": [{"host": 0, "resonator": i, "clearance": 1.0} for i in (1, 2)],
}


def test_two_stops_that_are_touched_at_one_instant_make_one_corner():
    """Two equal masses in opposite phase have stops to the ground: each moves as one mass with omega^2 = 4 + 2."""
    nnm = {"system": "own", "modes": [2], "energy": [0.0, 50.0], "own": TWINS}
    (branch,) = followed({"name": "twins", "contacts": {"law": "rigid"}, "nnm": nnm}, Ending.OUT_OF_ENERGIES)
    struck = [point for point in branch.points if point.episodes]
    assert len(struck) > 30
    for point in struck:
        amplitude = np.sqrt(point.energy / 6.0)
        assert point.period == pytest.approx(4 * np.arcsin(1 / amplitude) / np.sqrt(6.0), rel=1e-10, abs=0)


@pytest.mark.parametrize(
    ("own", "side", "mode"), [(CHAIN, "both", 3), (CHAIN, "plus", 1), (CHAIN, "plus", 2), (TWINS, "both", 2)]
)
def test_a_branch_leaves_its_corner_by_tangent_and_bend(own, side, mode):
    """Orbits that strike at small speeds s lie at x + s t + s^2 b: first and second differences converge with s."""
    nnm = {"system": "own", "modes": [mode], "points": 105, "own": own}
    case = NnmCase.from_table({"name": "corner", "contacts": {"law": "rigid", "side": side}, "nnm": nnm})
    shooting = ShootingMethod(case).shooting
    (branch,) = follow_all(case, None, MPI.COMM_SELF)
    point = next(point for point in branch.points if point.kind == "grazing" and point.episodes == 0)
    touch = np.append(point.x, point.period)
    corner = shooting.turned_at_corner(point)
    frame = shooting.frame(corner.point, "relative")
    length = np.linalg.norm(frame.direction(corner.point))
    bend = frame.direction(replace(corner.point, tangent=corner.bend))

    errors = []
    along = []
    squares = []
    for step in (0.02, 0.01, 0.005):
        guess = frame.xi + step * frame.tangent + (step / length) ** 2 * bend
        orbit = frame.measures(frame.correct(guess, step), frame.tangent)
        arc = shooting.arc(orbit.x, orbit.period)
        time, contact = arc.events[0, :2]
        before = shooting.flow.arc(arc.start, time * (1 - 1e-9), orbit.period).end
        speed = abs(shooting.system.contact_rows[int(contact)] @ before[shooting.system.dofs :])
        moved = np.append(orbit.x, orbit.period) - touch
        errors.append(np.linalg.norm(moved / speed - corner.point.tangent))
        along.append(moved @ corner.bend / (corner.bend @ corner.bend))
        squares.append(speed**2)
    assert errors[-1] < 0.03 * np.linalg.norm(corner.point.tangent)
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 2.0, rtol=0.06)
    # The corner itself is known to the branch's smallest step, which differences of two orbits do not have.
    np.testing.assert_allclose(np.diff(along) / np.diff(squares), 1.0, rtol=0.02)


def test_a_stop_that_yields_makes_no_corner():
    """Beside a rigid stop a bilinear one is met first: the branch goes on smoothly there."""
    stops = [{"host": 0, "resonator": 1, "clearance": 1.0}, {"host": 0, "resonator": 2, "clearance": 1.4}]
    own = {"masses": [1.0, 2.0], "springs": [{"start": 0, "end": 1, "stiffness": 4.0}], "contacts": stops}
    own["springs"].append({"start": 1, "end": 2, "stiffness": 3.0})
    contacts = {"stiffness": 100.0, "each": {"law": ["rigid", "bilinear"]}}
    nnm = {"system": "own", "modes": [1], "energy": [0.0, 2.4], "points": 150, "own": own}
    (branch,) = followed({"name": "mixed", "contacts": contacts, "nnm": nnm}, Ending.OUT_OF_ENERGIES)
    grazing = [point for point in branch.points if point.kind == "grazing"]
    assert [point.episodes for point in grazing] == [0, 1]
    energy = System.assemble([1.0, 2.0], [(None, 0, 4.0), (0, 1, 3.0)], [ContactPair(None, 1, 1.4, RIGID)])
    assert grazing[0].energy == pytest.approx(energy.grazing_energy(0), rel=1e-7)


@pytest.mark.parametrize(
    ("stops", "start", "word"),
    [
        # Both stops of mass 1 are reached at t = 1.
        ((ContactPair(None, 0, 1.0, RIGID), ContactPair(0, 1, 1.0, RIGID)), [0.0, 0.0, 1.0, 2.0], "share"),
        ((ContactPair(None, 0, 1.0, RIGID),), [1.0, 5.0, 0.0, 0.0], "pressed"),
        ((ContactPair(None, 0, 1.0, RIGID),), [1.1, 0.0, 0.0, 0.0], "beyond"),
    ],
)
def test_motions_without_a_derivative_are_named(stops, start, word):
    """Stops of one mass struck together, a mass that rests on a stop, and one beyond it."""
    free = [(None, 0, 1e-20), (0, 1, 1e-20)]
    system = two_masses(*stops) if word == "pressed" else System.assemble([1.0, 1.0], free, stops)
    with pytest.raises(FlowError, match=word):
        Dop853Flow(system).arc(np.array(start), 2.0, 6.0)
