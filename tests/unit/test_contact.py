"""The compiled contact law against its formulas, the search for changes within a step, landings, and the tracker."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.models import force_of
from vipetsc.contact import changes, search
from vipetsc.contact.law import (
    CLOSED,
    FREE,
    UNSWITCHED,
    contact_force,
    create_contacts,
    elastic_energy,
    elastic_force,
    elastic_force_and_slope,
    elastic_records,
    impact_time,
)
from vipetsc.contact.tracker import TRACKED, ImpactTracker
from vipetsc.dynamics.lattice_record import empty_record
from vipetsc.dynamics.ts.right_hand_side import CONTEXT, find_change
from vipetsc.lattice import Contact, contact
from vipetsc.records import Record

STIFFNESS = 3e5
CLEARANCE = 2e-4
RESTITUTION = 0.7
HERTZ = Contact("hertz", STIFFNESS, RESTITUTION)
MASS = 0.003
# Every shipped law whose stops yield: a new one is tested by being among them.
LAWS = pytest.mark.parametrize("law", [law for law in contact.LAWS if law != contact.RIGID])
# Length in s of a step in which changes are searched for.
STEP = 1e-3


def contact_of(law: str, restitution: float = 1.0, **options: str) -> Contact:
    """Return a contact of a ``law``, whose own parameter is 1.25 if it has one."""
    parameters = {
        field.name: 1.25
        for field in fields(Contact)
        if "parameter" in field.metadata and field.metadata["parameter"].law == law
    }
    return Contact(law, STIFFNESS, restitution, **parameters, **options)


def closed_sites(contact: Contact, count: int, approach: float, mass: float = 1.0) -> np.ndarray:
    """Return ``count`` sites; the last one is closed on the side of its ``approach`` velocity in m/s."""
    contacts = create_contacts(contact, [CLEARANCE] * count, mass)
    contacts["mode"][-1] = CLOSED if approach > 0 else -CLOSED
    contacts["approach"][-1] = approach
    return contacts


def first_change(contacts: np.ndarray, start: np.ndarray, end: np.ndarray, seconds: float) -> changes.ModeChange:
    """Return the first change of sites as an integrator finds it: by the address of a lattice, here of sites alone."""
    context = np.zeros(1, CONTEXT)
    lattice = Record(empty_record()._replace(contacts=contacts))
    context["lattice"] = lattice.address
    place = np.full(2, -7)
    position = find_change(context.ctypes.data, start, end, seconds, place)
    return changes.ModeChange(position, *place)


@LAWS
@pytest.mark.parametrize("adhesion", ["allow", "clip"])
@pytest.mark.parametrize("side", [1, -1])
def test_the_force_is_that_of_the_law_in_numpy(law, side, adhesion):
    """The compiled force on either side is that of ``Contact``; the power lost is (F - F_elastic) w' > 0.

    At the last rate g < 0: the force pulls, or is zero where it must not.
    """
    contact = replace(contact_of(law, RESTITUTION), adhesion=adhesion)
    contacts = create_contacts(contact, [CLEARANCE, 2 * CLEARANCE])
    contacts["mode"][1] = side * CLOSED
    contacts["approach"][1] = side * 0.4
    for indentation, rate in [(1e-5, 0.3), (4e-4, -0.2), (4e-4, -2.0)]:
        w = side * (2 * CLEARANCE + indentation)
        force, power = contact_force(contacts, 1, w, side * rate)
        elastic = force_of(contact, w, 2 * CLEARANCE)
        assert force == pytest.approx(force_of(contact, w, 2 * CLEARANCE, side * rate, side * 0.4))
        assert power == pytest.approx((force - elastic) * side * rate)
        assert power > 0
        # The other site is free.
        assert contact_force(contacts, 0, w, rate) == (0.0, 0.0)
    assert side * force <= 0.0
    assert (force == 0.0) == (adhesion == "clip")


@LAWS
def test_energy_force_and_gradient_belong_together(law):
    """The force is k x^n and the derivative of the energy, and the slope is the derivative of the force."""
    contact = contact_of(law)
    record = elastic_records([contact])[0]
    x = 3e-5
    # Central differences with this step have errors of 1e-9.
    h = 1e-4 * x

    force = elastic_force(record, x)
    assert force == pytest.approx(STIFFNESS * x**contact.onset_exponent)
    by_energy = (elastic_energy(record, x + h) - elastic_energy(record, x - h)) / (2 * h)
    assert by_energy == pytest.approx(force, rel=1e-6)
    slope = (elastic_force(record, x + h) - elastic_force(record, x - h)) / (2 * h)
    assert elastic_force_and_slope(record, x) == pytest.approx((force, slope), rel=1e-6)

    # The force is continued as an odd function, which searches need; the energy is zero without contact.
    assert elastic_force(record, -x) == -force
    assert elastic_force_and_slope(record, -x)[1] == elastic_force_and_slope(record, x)[1]
    assert elastic_energy(record, -x) == 0.0


def motion_at(w: np.poly1d, t: float) -> np.ndarray:
    """Return the motion (site, 3) at time ``t`` of two sites: the first one rests, the second one moves as ``w``."""
    return np.array([[0.0, 0.0, 0.0], [w(t), w.deriv()(t), w.deriv(2)(t)]])


# A parabola that exceeds the clearance from MIDDLE - HALF_WIDTH to MIDDLE + HALF_WIDTH s, by CURVATURE * HALF_WIDTH^2.
MIDDLE = 0.6e-3
HALF_WIDTH = 1e-4
CURVATURE = 40.0


def excursion(side: int) -> np.poly1d:
    parabola = np.poly1d([1, -2 * MIDDLE, MIDDLE**2 - HALF_WIDTH**2])
    return side * (np.poly1d([CLEARANCE]) - CURVATURE * parabola)


@pytest.mark.parametrize("side", [1, -1])
def test_an_onset_and_a_separation_in_one_step_are_found_in_turn(side):
    """A parabola beyond the clearance for 0.2 ms of a step has its onset first and, from there on, its separation."""
    w = excursion(side)
    onset = MIDDLE - HALF_WIDTH
    separation = MIDDLE + HALF_WIDTH
    end = motion_at(w, STEP)

    contacts = create_contacts(HERTZ, [CLEARANCE, CLEARANCE])
    change = first_change(contacts, motion_at(w, 0.0), end, STEP)
    assert change.position * STEP == pytest.approx(onset)
    assert change.site == 1
    # Function 0 is that of the side +, 1 that of the side -.
    assert change.function == (0 if side == 1 else 1)
    assert changes.switching(contacts, 1, change.function, end[1]).mode == side * CLOSED

    contacts = closed_sites(HERTZ, 2, side * 8e-3)
    change = first_change(contacts, motion_at(w, onset), end, STEP - onset)
    assert onset + change.position * (STEP - onset) == pytest.approx(separation)
    assert (change.site, change.function) == (1, 0)
    switching = changes.switching(contacts, 1, 0, end[1])
    assert switching.mode == FREE
    assert switching.value > 0
    assert switching.rate == pytest.approx(-side * w.deriv()(STEP))


@pytest.mark.parametrize("side", [1, -1])
def test_the_extremes_of_an_excursion_are_its_height_and_its_largest_force(side):
    """The largest indentation is the height of the parabola, the largest force the maximum of 5001 samples."""
    w = excursion(side)
    onset = MIDDLE - HALF_WIDTH
    contacts = closed_sites(HERTZ, 2, side * 8e-3)

    extremes = changes.extremes(contacts, 1, motion_at(w, onset), motion_at(w, MIDDLE + HALF_WIDTH), 2 * HALF_WIDTH)

    assert extremes.indentation == pytest.approx(CURVATURE * HALF_WIDTH**2)
    times = np.linspace(onset, MIDDLE + HALF_WIDTH, 5001)
    forces = [side * contact_force(contacts, 1, w(t), w.deriv()(t))[0] for t in times]
    assert extremes.force == pytest.approx(max(forces), rel=1e-6)


def test_either_side_has_its_own_clearance():
    """A motion to -1.5 D in a step meets a clearance D on the side - at 2/3 of the step."""
    contacts = create_contacts(Contact("hertz", STIFFNESS), [2 * CLEARANCE])
    contacts["clearance_minus"] = CLEARANCE
    rate = -1.5 * CLEARANCE / STEP
    start = np.array([[0.0, rate, 0.0]])
    end = np.array([[-1.5 * CLEARANCE, rate, 0.0]])
    change = first_change(contacts, start, end, STEP)
    assert (change.site, change.function) == (0, 1)
    assert change.position == pytest.approx(2 / 3)


def landing_at(length: float) -> search.Landing:
    return search.Landing(length=length, longest=1.0, residual=np.inf, attempts=0)


def test_a_landing_on_a_root_converges():
    """Newton's method on exp(s) - 2 lands on log 2."""
    attempt = landing_at(0.4)
    # Newton's method on exp(s) - 2 from 0.4 takes five steps.
    for _ in range(8):
        value = np.exp(attempt.length) - 2
        rate = np.exp(attempt.length)
        attempt, outcome = search.correct(attempt, value, rate, 1e-10, 1e-10)
        if outcome != search.RETRY:
            break
    assert outcome == search.LANDED
    assert attempt.length == pytest.approx(np.log(2), abs=1e-10)


def test_a_landing_on_a_near_miss_is_searched_again_until_it_is_missed():
    """A landing on a maximum at -1e-6 asks for new searches until its attempts are used up, and then is missed."""
    attempt = landing_at(0.5)
    outcome = search.RETRY
    outcomes = []
    while outcome not in (search.MISSED, search.LANDED):
        # A parabola that stays below zero by 1e-6.
        value = -1e-6 - (attempt.length - 0.5) ** 2
        rate = -2 * (attempt.length - 0.5)
        attempt, outcome = search.correct(attempt, value, rate, 1e-10, 1e-10)
        outcomes.append(outcome)
        if outcome == search.SEARCH:
            attempt = search.shorten(attempt, 0.9)
    assert outcomes[0] == search.SEARCH
    assert outcomes[-1] == search.MISSED
    assert len(outcomes) == search.MOST_ATTEMPTS


def test_a_landing_within_the_tolerance_goes_on_while_it_gains():
    """Below the tolerance another attempt follows while the distance halves, until it is below the goal."""
    tolerance = 1e-10
    goal = 1e-14
    attempt, outcome = search.correct(landing_at(0.5), 1e-11, 1.0, tolerance, goal)
    assert outcome == search.RETRY
    assert attempt.length == 0.5 - 1e-11
    assert search.correct(attempt, 0.9e-11, 1.0, tolerance, goal)[1] == search.LANDED
    assert search.correct(attempt, 0.9e-14, 1.0, tolerance, goal)[1] == search.LANDED


def create_tracker() -> ImpactTracker:
    """Return a tracker of the free sites 4 and 9, with a floor of the approach velocity of 0.05 m/s."""
    contact = Contact("hertz", STIFFNESS, RESTITUTION, approach_floor=0.05)
    return ImpactTracker(create_contacts(contact, [CLEARANCE, CLEARANCE], MASS), (4, 9))


def pull(tracker: ImpactTracker, start: float) -> None:
    """Move the second site of a tracker from ``start`` m back to its clearance, so fast that the contact pulls."""
    tracker.after[1] = start, 0.0, 0.0
    tracker.accept_step(STEP)
    # g = 1 + 0.45 (-0.2/0.05) < 0.
    tracker.after[1] = -CLEARANCE, 0.2, 0.0
    tracker.accept_step(STEP)


def test_a_site_that_touches_and_recedes_grazes():
    """A site at its clearance that moves inwards has no onset and is counted as grazing."""
    tracker = create_tracker()
    tracker.before[1] = -CLEARANCE, 0.01, 0.0
    assert tracker.switch(0.1, np.array([0.0, 0.25])) == 0
    assert tracker.counts["grazes"].tolist() == [0, 1]


def test_the_tracker_follows_an_impact_from_onset_to_separation():
    """An impact is one episode with onset, extremes, loss and separation, also for a tracker resumed within it."""
    tracker = create_tracker()
    tracker.before[1] = -CLEARANCE, -0.01, 0.0
    assert tracker.switch(0.2, np.array([0.0, 0.25])) == 1
    site = tracker.contacts[1]
    assert (site["mode"], site["approach"]) == (-CLOSED, -0.05)
    # The site has one onset, which is slower than the floor.
    assert tracker.counts[1].tolist() == (0, 1, 0, 0)
    assert tracker.contact_time() == impact_time(tracker.contacts[0], 0.05)

    pull(tracker, -1.5 * CLEARANCE)
    (episode,) = tracker.take_episodes(np.array([0.0, 0.5]), unfinished=True)
    assert episode[["site", "side", "onset", "approach_velocity"]].item() == (9, -1, 0.2, -0.01)
    assert episode["loss"] == 0.25
    assert np.isnan(episode["separation"])
    # The interpolant of the second step goes somewhat deeper than the start of that step.
    assert episode["indentation"] == pytest.approx(0.5 * CLEARANCE, rel=0.05)
    assert episode["force"] > STIFFNESS * (0.5 * CLEARANCE) ** 1.5
    assert tracker.counts["pulled"].tolist() == [0, 1]

    resumed = create_tracker()
    table = np.zeros(10, TRACKED)
    table[[4, 9]] = tracker.checkpoint()
    resumed.restore(table)
    for each in (tracker, resumed):
        each.before[1] = -CLEARANCE, 0.2, 0.0
        assert each.switch(0.3, np.array([0.0, 0.75])) == 1
        (closed,) = each.take_episodes(np.zeros(2))
        assert closed[["separation", "loss", "indentation"]].item() == (0.3, 0.5, episode["indentation"])
        assert each.take_episodes(np.zeros(2), unfinished=True).size == 0
        assert each.contacts["mode"].tolist() == [FREE, FREE]
        assert each.counts.tolist() == tracker.counts.tolist()
    assert tracker.contact_time() == np.inf


@pytest.mark.parametrize("way", ["switch", "begin", "restore", "unswitched"])
def test_a_contact_is_followed_from_the_beginning_or_after_steps_without_any(way):
    tracker = create_tracker()
    if way == "unswitched":
        tracker.contacts["mode"][1] = -UNSWITCHED
        tracker = ImpactTracker(tracker.contacts, (4, 9))
    else:
        tracker.accept_step(STEP)
    closed = tracker
    if way == "restore":
        closed = create_tracker()
    if way == "begin":
        motion = np.zeros((10, 2))
        motion[9] = -1.01 * CLEARANCE, -0.1
        tracker.close_at_start(motion)
    elif way != "unswitched":
        closed.before[1] = -CLEARANCE, -0.1, 0.0
        assert closed.switch(0.1, np.zeros(2)) == 1
    if way == "restore":
        table = np.zeros(10, TRACKED)
        table[[4, 9]] = closed.checkpoint()
        tracker.restore(table)

    tracker.before[1] = -CLEARANCE, -0.1, 0.0
    tracker.after[1] = -1.5 * CLEARANCE, 0.0, 0.0
    tracker.accept_step(STEP)
    (episode,) = tracker.take_episodes(np.zeros(2), unfinished=True)
    assert episode["indentation"] >= 0.5 * CLEARANCE


@LAWS
def test_the_contact_time_is_that_of_an_integrated_impact(law):
    """The contact time of a mass is twice the time of an integrated impact up to the turn."""
    speed = 0.3
    contacts = closed_sites(contact_of(law), 1, speed, MASS)

    def rates(t: float, z: np.ndarray) -> list[float]:
        return [z[1], -contact_force(contacts, 0, CLEARANCE + z[0], z[1])[0] / MASS]

    def comes_to_rest(t: float, z: np.ndarray) -> float:
        return z[1]

    comes_to_rest.terminal = True
    impact = solve_ivp(rates, (0, 1), [0.0, speed], rtol=1e-10, atol=1e-13, events=comes_to_rest)
    # A conservative impact takes as long after the turn as before it.
    assert 2 * impact.t[-1] == pytest.approx(impact_time(contacts[0], speed), rel=1e-6)


def test_a_site_found_beyond_its_clearance_is_in_contact_even_if_it_recedes():
    """A site beyond its clearance is closed, whatever the sign of w', and does not count as grazing."""
    tracker = ImpactTracker(create_contacts(Contact("hertz", STIFFNESS), [CLEARANCE], MASS), (0,))
    tracker.before[0] = 1.01 * CLEARANCE, -0.1, 0.0
    assert tracker.switch(0.0, np.zeros(1)) == 1
    assert tracker.contacts["mode"].tolist() == [CLOSED]
    assert tracker.counts["grazes"].sum() == 0
