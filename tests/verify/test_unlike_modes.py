"""Normal modes of lattices whose cells differ, and whose contacts differ from site to site or on their two sides."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from tests.breathers import breather_chain
from tests.models import CLEARANCE, four_band_contact
from tests.unlike_lattices import independent_lattice, unlike_case
from vipetsc.case.nnm import NnmTable
from vipetsc.lattice import Chain, Contact, WaveCompliance
from vipetsc.lattice.sites import sites_at
from vipetsc.modes.balance.conservative import ConservativeMotions
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.branches.balance import condensed_system, state_of
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.shooting import Shooting, linear_start, sample_orbit
from vipetsc.modes.stops import Stops
from vipetsc.modes.system import ContactPair, System

MASS = 2.0
SPRING = 3.0
STOP = 40.0
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
    lattice = independent_lattice()
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
    """A breather begins at the site asked for: twice as large at twice the clearance, negative on the other side.

    The stops are linear, so that motions are proportional to the clearance.
    """
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
