"""The compiled contact law against its formulas, the search of a step for changes, and landings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vipetsc
from vipetsc.contact import changes, search
from vipetsc.contact.law import (
    CLIPPED,
    CLOSED,
    FREE,
    contact_force,
    create_contacts,
    elastic_energy,
    elastic_force,
    elastic_force_and_slope,
    elastic_records,
)
from vipetsc.contact.tracker import TRACKED, ImpactTracker, impact_time
from vipetsc.lattice import Contact

KC, D, R = 3e5, 2e-4, 0.7
LAWS = pytest.mark.parametrize("law", ["hertz", "bilinear"])


@LAWS
@pytest.mark.parametrize("side", [1, -1])
def test_the_force_is_that_of_the_plain_law(law, side):
    contact = Contact(law, KC, R)
    contacts = create_contacts(contact, [D, 2 * D])
    contacts["mode"][1], contacts["approach"][1] = side * CLOSED, side * 0.4
    for x, rate in [(1e-5, 0.3), (4e-4, -0.2)]:
        w = side * (2 * D + x)
        force, power = contact_force(contacts, 1, w, side * rate)
        assert force == pytest.approx(contact.force(w, 2 * D, side * rate, side * 0.4))
        assert power == pytest.approx((force - contact.force(w, 2 * D)) * side * rate)
        assert power > 0
        assert contact_force(contacts, 0, w, rate) == (0.0, 0.0)
    contacts[1]["mode"] = side * CLIPPED
    assert contact_force(contacts, 1, w, rate)[0] == 0.0


@LAWS
def test_energy_force_and_gradient_belong_together(law):
    record, x = elastic_records([Contact(law, KC)])[0], 3e-5
    h = 1e-4 * x
    assert elastic_force(record, x) == pytest.approx(KC * x ** Contact(law, KC).onset_exponent)
    assert elastic_force(record, -x) == -elastic_force(record, x)
    slope = (elastic_energy(record, x + h) - elastic_energy(record, x - h)) / (2 * h)
    assert slope == pytest.approx(elastic_force(record, x), rel=1e-6)
    slope = (elastic_force(record, x + h) - elastic_force(record, x - h)) / (2 * h)
    assert elastic_force_and_slope(record, x) == pytest.approx((elastic_force(record, x), slope), rel=1e-6)
    assert elastic_force_and_slope(record, -x)[1] == elastic_force_and_slope(record, x)[1]
    assert elastic_energy(record, -x) == 0.0


def test_another_exponent_goes_between_the_two():
    record, x = elastic_records([Contact("power", KC, exponent=1.25)])[0], 3e-5
    assert elastic_force(record, -x) == pytest.approx(-KC * x**1.25)
    assert elastic_force_and_slope(record, x)[1] == pytest.approx(1.25 * KC * x**0.25)
    assert elastic_energy(record, x) == pytest.approx(KC * x**2.25 / 2.25)


def motions(w, h):
    """w, w', w'' of a polynomial at both ends of [0, h], for one site after a resting one."""
    first, second = w.deriv(), w.deriv(2)
    return [np.array([[0.0, 0.0, 0.0], [w(t), first(t), second(t)]]) for t in (0.0, h)]


@pytest.mark.parametrize("side", [1, -1])
def test_an_onset_and_a_separation_in_one_step_are_found_in_turn(side):
    h, middle, width = 1e-3, 0.6e-3, 1e-4
    # Above the clearance between middle - width and middle + width.
    w = side * (np.poly1d([D]) - 40.0 * np.poly1d([1, -2 * middle, middle**2 - width**2]))
    start, end = motions(w, h)
    contacts = create_contacts(Contact("hertz", KC, R), [D, D])
    change = changes.first_change(contacts, start, end, h, np.empty((2, 6)))
    assert change.position * h == pytest.approx(middle - width)
    assert (change.site, change.function) == (1, 0 if side == 1 else 1)
    assert changes.switching(contacts, 1, change.function, end[1]).mode == side * CLOSED

    begin = middle - width
    start = motions(np.poly1d(w.c)(np.poly1d([1, begin])), h)[0]  # at the onset
    contacts["mode"][1], contacts["approach"][1] = side * CLOSED, side * 8e-3
    change = changes.first_change(contacts, start, end, h - begin, np.empty((2, 6)))
    assert begin + change.position * (h - begin) == pytest.approx(middle + width)
    assert (change.site, change.function) == (1, 0)
    separation = changes.switching(contacts, 1, 0, end[1])
    assert (separation.mode, np.sign(separation.value)) == (FREE, 1)
    assert separation.rate == pytest.approx(-side * w.deriv()(h))

    extremes = changes.extremes(contacts, 1, start, motions(w, middle + width)[1], 2 * width)
    assert extremes.indentation == pytest.approx(40.0 * width**2)
    s = np.linspace(begin, middle + width, 20001)
    push = [side * contact_force(contacts, 1, w(t), w.deriv()(t))[0] for t in s]
    assert extremes.force == pytest.approx(max(push), rel=1e-6)


@pytest.mark.parametrize("order", [1, -1])
def test_the_earliest_of_several_sites_changes_first(order):
    h, clearances = 1e-3, np.array([D, 3 * D, 5 * D])[::order]
    rate = 6 * D / h
    start, end = np.array([[0.0, rate, 0.0]] * 3), np.array([[6 * D, rate, 0.0]] * 3)
    contacts = create_contacts(Contact("hertz", KC, R), clearances)
    change = changes.first_change(contacts, start, end, h, np.empty((2, 6)))
    assert change.site == (0 if order == 1 else 2)
    assert change.position == pytest.approx(1 / 6)


def test_either_side_has_its_own_clearance():
    contacts, h = create_contacts(Contact("hertz", KC), [2 * D]), 1e-3
    contacts["clearance_minus"], rate = D, -1.5 * D / h
    start, end = (np.array([[w, rate, 0.0]]) for w in (0.0, -1.5 * D))
    change = changes.first_change(contacts, start, end, h, np.empty((2, 6)))
    assert change == (pytest.approx(2 / 3), 0, 1)


def test_the_extremes_of_a_contact_that_turns_within_a_step_are_those_of_its_turn():
    """w - D = c s (1 - s)^2 turns at s = 1/3, where it is 4 c/27."""
    contacts, h, c = create_contacts(Contact("hertz", KC), [D]), 1e-3, D
    contacts["mode"], contacts["approach"] = CLOSED, c / h
    start, end = np.array([[D, c / h, -4 * c / h**2]]), np.array([[D, 0.0, 2 * c / h**2]])
    reached = changes.extremes(contacts, 0, start, end, h)
    assert reached.indentation == pytest.approx(4 * c / 27, rel=1e-12)
    assert reached.force == pytest.approx(KC * (4 * c / 27) ** 1.5, rel=1e-8)


def test_clipping_begins_where_g_falls_through_zero():
    h, approach = 1e-3, 0.01
    w = np.poly1d([D + 1e-4]) - np.poly1d([20.0, 0.02, 0.0])  # ever faster out
    start, end = motions(w, h)
    for adhesion in ("allow", "clip"):
        contacts = create_contacts(Contact("hertz", KC, R, adhesion), [D, D])
        contacts["mode"][1], contacts["approach"][1] = CLOSED, approach
        change = changes.first_change(contacts, start, end, h, np.empty((2, 6)))
        assert (change.position > 1) == (adhesion == "allow")
    damping = contacts["damping"][1]
    begin = change.position * h
    assert 1 + damping * w.deriv()(begin) / approach == pytest.approx(0, abs=1e-9)
    clipping = changes.switching(contacts, 1, change.function, end[1])
    assert clipping.mode == CLIPPED
    contacts[1]["mode"] = CLIPPED
    back = changes.switching(contacts, 1, 1, end[1])
    assert (back.mode, back.value, back.rate) == (CLOSED, -clipping.value, -clipping.rate)


def test_a_landing_on_a_root_converges_and_one_on_a_near_miss_is_searched_again():
    attempt = search.Landing(0.4, 1.0, np.inf, 0)
    for _ in range(8):
        value, rate = np.exp(attempt.length) - 2, np.exp(attempt.length)
        attempt, outcome = search.correct(attempt, value, rate, 1e-10, 1e-10)
        if outcome != search.RETRY:
            break
    assert outcome == search.LANDED
    assert attempt.length == pytest.approx(np.log(2), abs=1e-10)

    attempt, outcome = search.Landing(0.5, 1.0, np.inf, 0), search.RETRY
    outcomes = []
    while outcome not in (search.MISSED, search.LANDED):
        value, rate = -1e-6 - (attempt.length - 0.5) ** 2, -2 * (attempt.length - 0.5)
        attempt, outcome = search.correct(attempt, value, rate, 1e-10, 1e-10)
        outcomes.append(outcome)
        if outcome == search.SEARCH:
            attempt = search.shorten(attempt, 0.9)
    assert outcomes[0] == search.SEARCH
    assert outcomes[-1] == search.MISSED
    assert len(outcomes) == search.MOST_ATTEMPTS


def test_a_landing_within_the_tolerance_goes_on_while_it_gains():
    """With a goal below the tolerance, the last attempt that still halves the distance is followed by another."""
    start = search.Landing(0.5, 1.0, np.inf, 0)
    attempt, outcome = search.correct(start, 1e-11, 1.0, 1e-10, 1e-14)
    assert outcome == search.RETRY
    assert attempt.length == 0.5 - 1e-11
    assert search.correct(attempt, 0.9e-11, 1.0, 1e-10, 1e-14)[1] == search.LANDED
    assert search.correct(attempt, 0.9e-14, 1.0, 1e-10, 1e-14)[1] == search.LANDED


def test_the_tracker_follows_an_impact_from_onset_to_separation():
    contact = Contact("hertz", KC, R, approach_floor=0.05)
    tracker = ImpactTracker(create_contacts(contact, [D, D], 0.003), (4, 9))
    site = tracker.contacts[1]
    tracker.start[1] = -D, 0.01, 0.0  # touches on the side -1, moving away: a graze
    assert tracker.switch(0.1, np.array([0.0, 0.25])) == 0
    assert tracker.counts["grazes"].tolist() == [0, 1]
    tracker.start[1] = -D, -0.01, 0.0
    assert tracker.switch(0.2, np.array([0.0, 0.25])) == 1
    assert (site["mode"], site["approach"]) == (-CLOSED, -0.05)
    assert tracker.counts[1].tolist() == (1, 1, 0, 0)
    assert tracker.contact_time() == impact_time(tracker.contacts[0], 0.05)

    tracker.end[1] = -1.5 * D, 0.0, 0.0
    tracker.accept_step(1e-3)
    assert tracker.start[1, 0] == -1.5 * D
    tracker.end[1] = -D, 0.2, 0.0  # g = 1 + .45 (-.2/.05) < 0: the contact pulls
    tracker.accept_step(1e-3)
    (episode,) = tracker.take_episodes(np.array([0.0, 0.5]), unfinished=True)
    assert episode[["site", "side", "onset", "approach_velocity"]].item() == (9, -1, 0.2, -0.01)
    assert episode["loss"] == 0.25
    assert np.isnan(episode["separation"])
    assert episode["indentation"] == pytest.approx(0.5 * D, rel=0.05)
    assert episode["force"] > KC * (0.5 * D) ** 1.5
    assert tracker.counts["pulled"].tolist() == [0, 1]

    resumed = ImpactTracker(create_contacts(contact, [D, D], 0.003), (4, 9))
    table = np.zeros(10, TRACKED)
    table[[4, 9]] = tracker.checkpoint()
    resumed.restore(table)
    for each in (tracker, resumed):
        each.start[1] = -D, 0.2, 0.0
        assert each.switch(0.3, np.array([0.0, 0.75])) == 1
        (closed,) = each.take_episodes(np.zeros(2))
        assert closed[["separation", "loss", "indentation"]].item() == (0.3, 0.5, episode["indentation"])
        assert each.take_episodes(np.zeros(2), unfinished=True).size == 0
        assert each.contacts["mode"].tolist() == [FREE, FREE]
        assert each.counts.tolist() == tracker.counts.tolist()
    assert tracker.contact_time() == np.inf
    for motion in ((-D, -0.01, 0.0), (-1.5 * D, 0.0, 0.0), (-D, 0.2, 0.0)):  # once more: it pulls again
        tracker.end[1] = motion
        tracker.accept_step(1e-3)
        tracker.switch(0.4, np.zeros(2))
    assert tracker.counts["pulled"].tolist() == [0, 2]


@LAWS
def test_the_contact_time_is_that_of_a_simulated_impact(law):
    contacts, mass, speed = create_contacts(Contact(law, KC), [D], 0.003), 0.003, 0.3
    contacts["mode"][0], contacts["approach"][0] = CLOSED, speed

    def rate(t, z):
        return z[1]

    rate.terminal = True
    to_rest = solve_ivp(
        lambda t, z: [z[1], -contact_force(contacts, 0, D + z[0], z[1])[0] / mass],
        (0, 1), [0.0, speed], rtol=1e-10, atol=1e-13, events=rate,
    )  # fmt: skip
    assert 2 * to_rest.t[-1] == pytest.approx(impact_time(contacts[0], speed), rel=1e-6)


def test_the_log_takes_any_number_of_episodes():
    tracker = ImpactTracker(create_contacts(Contact("hertz", KC), [D, D], 0.003), (7, 3))
    for k in range(9):
        for rate in (0.1, -0.1):
            tracker.start[:] = D, rate, 0.0
            assert tracker.switch(k + (rate < 0) / 2, np.zeros(2)) == 2
    log = tracker.take_episodes(np.zeros(2))
    assert log["site"].tolist() == [7, 3] * 9
    assert log["onset"].tolist() == [k // 2 for k in range(18)]
    assert (log["separation"] - log["onset"] == 0.5).all()


def test_a_site_found_beyond_its_clearance_is_in_contact_even_if_it_recedes():
    tracker = ImpactTracker(create_contacts(Contact("hertz", KC), [D], 0.003), (0,))
    tracker.start[0] = 1.01 * D, -0.1, 0.0
    assert tracker.switch(0.0, np.zeros(1)) == 1
    assert tracker.contacts["mode"].tolist() == [CLOSED]
    assert tracker.counts["grazes"].sum() == 0


@LAWS
@pytest.mark.parametrize(
    ("asked", "effective"), [(0.0, 0.4877413), (0.3, 0.5812880), (0.5, 0.6629622), (0.7, 0.7679998), (0.9, 0.9090157)]
)
def test_the_effective_restitution_is_that_of_a_simulated_impact(law, asked, effective):
    """The paper's damping returns more than is asked, the exact one what is asked."""
    for contact in (Contact(law, KC, asked), Contact(law, KC, asked or 0.1, factor="exact")):
        contacts, mass, speed = create_contacts(contact, [D]), 0.003, 0.3
        contacts["mode"][0], contacts["approach"][0] = CLOSED, speed

        def rate(t, z, contacts=contacts, mass=mass):
            return [z[1], -contact_force(contacts, 0, D + z[0], z[1])[0] / mass]

        def apart(t, z):
            return z[0] if t > 1e-6 else 1.0

        apart.terminal, apart.direction = True, -1
        ended = solve_ivp(rate, (0, 1), [0.0, speed], rtol=1e-11, atol=1e-14, events=apart, first_step=2e-6)
        assert -ended.y[1, -1] / speed == pytest.approx(contact.effective_restitution, rel=1e-6)
        assert contact.effective_restitution == pytest.approx(
            asked or 0.1 if contact.factor == "exact" else effective, rel=1e-6
        )


def test_the_exact_damping_meets_every_restitution():
    asked = np.linspace(0.05, 1, 200)
    assert [Contact("hertz", KC, r, factor="exact").effective_restitution for r in asked] == pytest.approx(
        asked, abs=1e-7
    )


def test_the_manual_tells_what_impacts_return():
    lines = (Path(vipetsc.__file__).parent / "manual/case-file.md").read_text(encoding="utf-8").splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("| restitution"))
    asked, told = ([float(cell) for cell in line.split("|")[2:-1]] for line in (lines[first], lines[first + 2]))
    assert [round(Contact("hertz", KC, r).effective_restitution, 3) for r in asked] == told
