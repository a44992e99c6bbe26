"""The parts of the modes by themselves: systems, charts, stability, regions, cases, files, picture."""

from __future__ import annotations

import csv
import io
import itertools
import tomllib
from dataclasses import fields, replace

from mpi4py import MPI

import h5py
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import DOP853

from vipetsc.case import CaseError
from vipetsc.case.nnm import Guards, NnmCase, NnmTable
from vipetsc.lattice import Chain, Contact, Spring, UnitCell, contact_stiffness, diatomic, four_band
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.branch_checks import BranchMonitor, is_jump, sampled, suspects
from vipetsc.modes.branches.files import LAYOUTS, read_branch, write_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.regions import assign_regions, fit_slope, regions
from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.continuation.guards import half_trace_change
from vipetsc.modes.continuation.segment import Segment
from vipetsc.modes.continuation.special import locate
from vipetsc.modes.continuation.switching import switch
from vipetsc.modes.point import Point
from vipetsc.modes.problem import unit
from vipetsc.modes.shooting import dop853
from vipetsc.modes.shooting.charts import Chart, Grazing, Logarithmic, Relative
from vipetsc.modes.shooting.dop853 import Dop853Flow
from vipetsc.modes.shooting.landing import CROSSING, EXTREMUM, NONE, first_rise
from vipetsc.modes.shooting.maps import MAPS
from vipetsc.modes.shooting.orbit import repetitions, sample_orbit
from vipetsc.modes.shooting.reference import Newmark
from vipetsc.modes.shooting.shooting import Shooting
from vipetsc.modes.shooting.stability import half_traces, multipliers
from vipetsc.modes.shooting.start import linear_start
from vipetsc.modes.system import ContactPair, SmoothSpring, System
from vipetsc.parallel import StopRequest

D = 10**-2.75
LAW = Contact("bilinear", contact_stiffness(1e8, 0.005, 0.3))


def reduced() -> System:
    return System.reduced(four_band(), D, LAW)


def test_reduced_model_of_the_paper():
    system = reduced()
    assert system.masses == pytest.approx([0.0025, 0.0025])
    assert system.stiffness == pytest.approx(np.array([[2.2e4, -2e3], [-2e3, 2e3]]))


def test_reduced_model_of_another_cell():
    system = System.reduced(diatomic(), D, LAW)
    assert system.stiffness == pytest.approx(np.array([[2 * 9e4 + 9e4, -9e4], [-9e4, 9e4]]))


def test_forces_are_the_energy_gradient():
    law = Contact("hertz", 3e6)
    pairs = (ContactPair(None, 0, 0.1, law), ContactPair(0, 2, 0.05, law))
    smooth = (SmoothSpring.between(1, 2, cubic=3.0, quadratic=-1.0), SmoothSpring.between(None, 1, cubic=2.0))
    system = System.assemble([1.0, 2.0, 3.0], [(None, 0, 5.0), (0, 1, 7.0), (1, 2, 11.0)], pairs, smooth)
    u, step, zero = np.array([0.3, -0.2, 0.5]), 1e-6, np.zeros(3)
    gradient = [(system.energy(u + step * e, zero) - system.energy(u - step * e, zero)) / (2 * step) for e in np.eye(3)]
    assert system.forces(u) == pytest.approx(gradient, rel=1e-7)
    assert not system.odd


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"masses": [1.0, -1.0]}, "masses"),
        ({"contacts": (ContactPair(0, 1, -1.0, LAW),)}, "clearance"),
        ({"contacts": (ContactPair(0, 2, 1.0, LAW),)}, "not a pair"),
        ({"contacts": (ContactPair(0, 1, 1.0, Contact("hertz", 1.0, 0.7)),)}, "restitution"),
    ],
)
def test_unsound_systems_are_refused(change, message):
    parts = {"masses": [1.0, 1.0], "springs": [(None, 0, 1.0), (0, 1, 1.0)]} | change
    with pytest.raises(ValueError, match=message):
        System.assemble(**parts)


def test_quarter_map_needs_an_odd_system():
    system = System.assemble([1.0], [(None, 0, 1.0)], smooth=[SmoothSpring.between(None, 0, quadratic=0.1)])
    with pytest.raises(ValueError, match="half"):
        Shooting(Dop853Flow(system), MAPS["quarter"])


def test_half_map_of_an_asymmetric_system():
    """x'' + x + a x^2 = 0: the second-order frequency 1 - 5/12 a^2 A^2 (Nayfeh and Mook 1979)."""
    a, energy = 0.1, 1e-3
    system = System.assemble([1.0], [(None, 0, 1.0)], smooth=[SmoothSpring.between(None, 0, quadratic=a)])
    problem = Shooting(Dop853Flow(system), MAPS["half"])
    point = linear_start(problem, 0, energy)
    assert 2 * np.pi * point.frequency == pytest.approx(1 - 5 / 12 * a**2 * 2 * point.energy, abs=2e-9)
    assert point.multiplier == 1


@given(
    x=st.tuples(*[st.floats(0.2, 5).flatmap(lambda v: st.sampled_from([v, -v]))] * 2),
    period=st.floats(1e-4, 10),
    kind=st.sampled_from([Relative, Logarithmic, Grazing]),
)
@settings(max_examples=60)
def test_charts_encode_decode_and_differentiate(x, period, kind):
    x = D * np.array(x)
    if abs(abs(x[1] - x[0]) / D - 1) < 1e-3:
        return  # the grazing chart is singular at grazing itself
    chart: Chart = kind(reduced(), x, period)
    xi = chart.encode(x, period)
    again, same = chart.decode(xi)
    assert again == pytest.approx(x, rel=1e-11, abs=1e-11 * D)
    assert same == pytest.approx(period, rel=1e-13)
    step = 1e-6
    for i, column in enumerate(chart.derivative(xi).T):
        move = np.zeros(3)
        move[i] = step
        forward, backward = (np.append(*chart.decode(xi + s * move)) for s in (1, -1))
        difference = (forward - backward) / (2 * step)
        assert column == pytest.approx(difference, rel=1e-5, abs=1e-5 * np.abs(column).max())


@pytest.mark.parametrize(("gap", "scale"), [(0.1, 1.0), (-2.0, 2.0), (6.0, 5.0)])
def test_the_relative_chart_weighs_gaps_by_the_larger_of_gap_and_clearance(gap, scale):
    x = D * np.array([5.0 - gap, 5.0]) if gap > 0 else D * np.array([5.0, 5.0 + gap])
    xi = Relative(reduced(), x, 0.01).encode(x, 0.01)
    assert xi == pytest.approx([x[0] / (5 * D), gap / scale, 1.0], rel=1e-12)


@pytest.mark.slow
@given(
    c=st.tuples(*[st.floats(-1, 1)] * 6),
    size=st.tuples(*[st.floats(-3, 0)] * 6),
    start=st.sampled_from(["below", "landed", "extremum"]),
)
@example((0.0, 0.0, 0.5, -1.0, 0.0, 1.0), (0.0, 0.0, -3.0, -2.25, 0.0, -1.0), "below")
@settings(max_examples=400)
def test_the_first_change_of_a_gap_is_found(c, size, start):
    """Against dense sampling: nothing above the interpolant's error is missed, or comes before what is found."""
    c = np.array(c) * 10.0 ** np.array(size)
    c[0] = -abs(c[0])
    if start == "landed":
        c[0], c[1] = 0.0, -abs(c[1])
    if start == "extremum":
        c[1] = 0.0
    margin = 0.01 * (abs(c[5]) + 0.3 * abs(c[4]))
    share, outcome = first_rise(tuple(c))
    s = np.linspace(0, 1, 4001)[1:]
    gap = np.polynomial.Polynomial(c)(s)
    clear = np.nonzero(gap > 1.01 * margin + 1e-12)[0]
    if clear.size:
        assert outcome != NONE
        assert share <= s[clear[0]]
    if outcome == NONE:
        assert gap.max() <= 1e-12 + 1.01 * margin
    else:
        before = gap[s < share - 1e-9]
        assert before.max(initial=-1.0) <= 1e-12 + margin
        assert abs(np.polynomial.Polynomial(c)(share)) <= (1e-12 if outcome == CROSSING else margin + 1e-12)


def test_a_hump_beside_a_dip_in_one_quarter_of_a_step_is_found():
    """A contact that has just opened closes again and opens, all within the first fifth of a step."""
    c = np.array([0.0, -4.6e-4, 5.0e-2, -0.31, 2.2e-4, 1.4e-3])
    share, outcome = first_rise(tuple(c))
    assert outcome == CROSSING
    assert 0 < share < 0.02


def test_an_arc_that_ends_where_a_contact_just_closes_ends():
    """The rest of the time, 1e-8 of it, is all rounding: a search that lands on its beginning again has no end."""
    law = Contact("hertz", contact_stiffness(1e8, 0.005, 0.3))
    flow = Dop853Flow(System.reduced(four_band("printed"), 10**-2.75, law))
    start = np.array([7.732456897616884, 7.742513284851792, 0.0, 0.0])
    arc = flow.arc(start, 0.0003398398033092859, 0.003147455285852897)
    assert arc.episodes == 2
    assert arc.events[:, 3].tolist() == [-1, 1]
    assert np.abs(flow.system.gaps(arc.end[:2])) < 1e-14


def test_a_hump_within_the_interpolants_error_comes_before_the_root_behind_it():
    """Slope (x - .05)(x - .15), so that .05 is a largest value and the gap rises again within the same quarter."""
    rise = np.polynomial.Polynomial.fromroots([0.05, 0.15]).integ().coef
    c = np.append(rise, [0.0, 1e-3])
    c[0] = 1e-6 - np.polynomial.Polynomial(c)(0.05)
    share, outcome = first_rise(tuple(c))
    assert outcome == EXTREMUM
    assert share == pytest.approx(0.05, abs=1e-3)


def test_the_second_hump_of_a_gap_is_found():
    """Slope -(x - .1)(x - .45)(x - .9): the first largest value is 2e-3 below zero, the second 2.3e-3 above."""
    slope = -np.polynomial.Polynomial.fromroots([0.1, 0.45, 0.9])
    c = np.append(slope.integ().coef, 0.0)
    c[0] = -2e-3 - slope.integ()(0.1)
    share, outcome = first_rise(tuple(c))
    assert outcome == CROSSING
    assert 0.45 < share < 0.9
    assert np.polynomial.Polynomial(c)(share) == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize(("margins", "expected"), [(0.5, EXTREMUM), (-0.5, EXTREMUM), (-2, NONE), (2, CROSSING)])
def test_a_gap_that_nearly_closes_is_left_to_the_flow(margins, expected):
    """Largest value at .4, within the interpolant's error of zero or beyond it."""
    c = np.array([0.0, 0.8, -1.0, 0.0, 0.0, -0.02])
    turn = np.polynomial.Polynomial(c).deriv().roots()
    top = turn[(turn.imag == 0) & (turn.real > 0) & (turn.real < 1)].real[0]
    c[0] = margins * 0.01 * 0.02 - np.polynomial.Polynomial(c)(top)
    share, outcome = first_rise(tuple(c))
    assert outcome == expected
    if outcome == EXTREMUM:
        assert share == pytest.approx(top, abs=1e-8)


@pytest.mark.parametrize("cubic", [1e8, 1e12])
def test_a_step_that_overflows_is_taken_again_shorter(cubic):
    """The longest step is a radian of the linear system, of which the spring makes thousands."""
    system = System(np.ones(2), np.array([[2.0, -1.0], [-1.0, 2.0]]), (), (SmoothSpring.between(None, 0, cubic=cubic),))
    arc = Dop853Flow(system).arc(np.array([1.0, 1.0, 0.0, 0.0]), 2e-3, 8e-3)
    energies = [system.energy(z[:2], z[2:]) for z in (arc.start, arc.end)]
    assert energies[1] == pytest.approx(energies[0], rel=1e-9)
    assert np.linalg.det(arc.sensitivity) == pytest.approx(1.0, rel=1e-6)  # the flow keeps volumes


@pytest.mark.parametrize("rounding", [1e-17, 0.0, -1e-17])
def test_a_step_that_starts_on_a_near_miss_leaves_it(rounding):
    assert first_rise((-1e-4, rounding, -1.0, 0.0, 0.5, 0.3)) == (1.0, NONE)


def test_the_tableau_is_the_one_of_dop853():
    for name in ("A", "B", "E3", "E5"):
        ours, reference = getattr(dop853, name), getattr(DOP853, name)
        assert np.array_equal(ours, reference[tuple(slice(n) for n in ours.shape)]), name


@pytest.mark.parametrize("name", ["quarter", "half", "whole"])
def test_multipliers_are_those_of_the_monodromy_matrix(name):
    """At a linear orbit the multipliers are exp(+-i omega_1 T_2), whatever the map."""
    system = reduced()
    problem = Shooting(Dop853Flow(system), MAPS[name])
    point = linear_start(problem, 1, 1e-3)
    traces = half_traces(system, problem.map, problem.arc(point.x, point.period))
    omega = system.linear_modes()[0]
    expected = np.cos(2 * np.pi * omega[0] / omega[1])
    mu = multipliers(traces, problem.map.quarter)
    assert mu.real == pytest.approx(expected, abs=1e-9)
    assert np.abs(mu) == pytest.approx(1, abs=1e-9)


def test_regions_and_power_law_of_a_made_up_branch():
    energy = np.geomspace(1e-3, 1e6, 400)
    touched = energy > 1e-2
    slope = np.where(touched, 1e3 / energy + 1e4 * (energy / 1e-2) ** -6.0, 0.0)
    closed = np.where(touched, 1 - 0.5 / (1 + np.log10(np.maximum(energy / 1e-2, 1)) ** 2), 0.0)
    region = assign_regions(energy, slope, touched.astype(int), closed)
    assert np.all(np.diff(region) >= 0)
    assert set(region) == {1, 2, 3, 4}
    assert np.all((region == 1) == ~touched)
    assert closed[region == 4].min() >= 0.95 > closed[region == 3].max()
    law = fit_slope(energy, slope, region)["IV"]
    assert law["exponent"] == pytest.approx(-1, abs=1e-3)
    assert law["adjusted_r2"] > 0.9999
    assert law["points"] == np.sum(region == 4)


def test_region_three_begins_where_the_exponent_settles():
    """Of E^-1 + c E^-6, with the share a of the second: exponent -1 - 5 a, growth 25 a (1 - a) = 1/2 at a = 0.0204."""
    energy = np.geomspace(1e-3, 1e6, 4000)
    touched = energy > 1e-2
    slope = np.where(touched, 1e3 / energy + 1e4 * (energy / 1e-2) ** -6.0, 0.0)
    region = assign_regions(energy, slope, touched.astype(int), np.zeros(4000))
    share = 1e4 * (energy / 1e-2) ** -6.0 / np.where(touched, slope, 1.0)
    begin = np.nonzero(region == 3)[0][0]
    assert share[begin] == pytest.approx((1 - np.sqrt(0.92)) / 2, rel=0.05)
    laws = fit_slope(energy, slope, region)
    assert set(laws) == {"II", "III"}
    assert laws["II"]["exponent"] < -1.2
    assert laws["III"]["exponent"] == pytest.approx(-1, abs=1e-3)
    assert laws["II"]["points"] == begin - np.argmax(slope)


def test_the_law_of_region_two_is_that_of_its_falling_part():
    """Behind the last point where the branch goes backwards, and behind the peak."""
    energy = np.geomspace(1, 100, 60)
    slope = np.concatenate([np.full(5, 9.0), [-1.0], energy[6:20] ** 3, energy[20:] ** -2.5 * energy[20] ** 5.5])
    laws = fit_slope(energy, slope, np.full(60, 2))
    assert laws["II"]["exponent"] == pytest.approx(-2.5, abs=1e-12)
    assert laws["II"]["points"] == 40
    assert fit_slope(energy[:3], slope[:3], np.full(3, 3)) == {}
    assert fit_slope(energy, np.full(60, np.nan), np.full(60, 3)) == {}


def test_a_steep_fall_from_the_peak_is_grazing_even_where_it_is_steady():
    """E^-1 + c E^-3: the exponent -1 - 2 a stays at -3 first; from a(1 - a) = 1/8 on it has settled above -2."""
    energy = np.geomspace(1e-3, 1e6, 4000)
    touched = energy > 1e-2
    slope = np.where(touched, 1 / energy + 1e8 * (energy / 1e-2) ** -3.0, 0.0)
    region = assign_regions(energy, slope, touched.astype(int), np.zeros(4000))
    share = 1e8 * (energy / 1e-2) ** -3.0 / np.where(touched, slope, 1.0)
    assert share[region == 3].max() == pytest.approx((1 - np.sqrt(0.5)) / 2, rel=0.02)


def test_regions_without_contacts():
    energy = np.geomspace(1e-3, 1e3, 50)
    none, never = np.zeros(50, int), np.zeros(50)
    assert set(assign_regions(energy, np.zeros(50), none, never)) == {1}  # linear
    assert set(assign_regions(energy, 1 / energy, none, never)) == {0}  # smooth springs


def test_portrait_is_the_orbit_itself():
    """The mirrored quarter agrees with a flow over the whole period."""
    problem = Shooting(Dop853Flow(reduced()), MAPS["quarter"])
    start = linear_start(problem, 1, 0.02)
    points = list(Continuation(problem, start, NnmTable(points=150, energy=[0.0, 0.5])))
    point = points[-1]
    displacement, velocity = sample_orbit(problem, point, 40)
    for place in (13, 33):  # in the second and in the last quarter
        arc = problem.flow.arc(np.append(point.x, [0, 0]), place / 40 * point.period, point.period)
        assert displacement[place] == pytest.approx(arc.end[:2], rel=1e-8)
        assert velocity[place] == pytest.approx(arc.end[2:], rel=1e-8)


def test_case_reports_everything_at_once():
    table = {
        "contacts": {"law": "bilinaer"},
        "nnm": {"modes": [0], "larget_step": 1.0, "guards": {"turn": -1.0}},
        "nmn": {},
    }
    with pytest.raises(CaseError) as caught:
        NnmCase.from_table(table)
    text = str(caught.value)
    for part in ("contacts.law", "bilinear", "nnm.modes", "largest_step", "guards.turn", "did you mean nnm"):
        assert part in text


def test_case_round_trip_and_systems():
    case = NnmCase.from_table({"name": "a", "lattice": {"reading": "printed"}, "contacts": {"law": "bilinear"}})
    assert NnmCase.from_table(tomllib.loads(case.to_toml())) == case
    written = tomllib.loads(case.to_toml())["contacts"]
    assert (written["modulus"], written["radius"], written["poisson"], written["clearance"]) == (1e8, 0.005, 0.3, [D])
    system = System.from_case(case)
    assert system.contacts[0].clearance == pytest.approx(D)
    assert [system.branch_name(mode) for mode in (0, 1)] == ["in-phase", "out-of-phase"]
    with pytest.raises(CaseError, match="2 modes"):
        NnmCase.from_table({"nnm": {"modes": [3]}})
    with pytest.raises(CaseError, match=r"nnm.own"):
        NnmCase.from_table({"nnm": {"system": "own"}})
    with pytest.raises(CaseError, match="lowest energy above 0"):
        NnmCase.from_table({"nnm": {"direction": "down"}})


def test_systems_of_every_kind_of_case():
    masses, springs = [1.0, 2.0], [{"start": 0, "end": 1, "stiffness": 3.0}, {"start": 1, "end": 2, "stiffness": 5.0}]
    own = {"masses": masses, "springs": springs, "smooth": [{"start": 0, "end": 2, "cubic": 7.0}]}
    own["contacts"] = [{"host": 0, "resonator": 2, "clearance": 0.1}]
    with pytest.raises(CaseError, match=r"contacts\.stiffness: missing"):
        NnmCase.from_table({"nnm": {"system": "own", "own": own}})
    system = System.from_case(
        NnmCase.from_table({"contacts": {"stiffness": 2.0}, "nnm": {"system": "own", "own": own}})
    )
    assert system.contacts[0].law.stiffness == 2.0
    assert system.stiffness == pytest.approx(np.array([[8.0, -5.0], [-5.0, 5.0]]))
    assert (system.contacts[0].host, system.contacts[0].resonator) == (None, 1)
    assert system.springs == (SmoothSpring.between(None, 1, cubic=7.0),)
    chain = {"lattice": {"cells": 3}, "contacts": {"sites": [1, 3]}, "nnm": {"system": "chain", "modes": [12]}}
    system = System.from_case(NnmCase.from_table(chain))
    assert system.dofs == 12
    assert system.branch_name(11) == "mode-12"
    assert [p.host // 4 for p in system.contacts] == [0, 2]
    with pytest.raises(CaseError, match="12 modes"):
        NnmCase.from_table(chain | {"nnm": {"system": "chain", "modes": [13]}})


@pytest.mark.parametrize("key", ["springs", "smooth", "contacts"])
def test_pairs_that_are_not_in_the_system_are_named(key):
    own = {"masses": [1.0], "springs": [{"start": 0, "end": 1, "stiffness": 1.0}], "smooth": [], "contacts": []}
    ends = {"host": 1, "resonator": 2} if key == "contacts" else {"start": 1, "end": 2}
    rest = {"springs": {"stiffness": 1.0}, "smooth": {"cubic": 1.0}, "contacts": {"clearance": 1.0}}
    own[key] = [*own[key], ends | rest[key]]
    with pytest.raises(CaseError, match=rf"nnm.own.{key}.*not a pair of the 1 masses"):
        NnmCase.from_table({"nnm": {"system": "own", "own": own}})


def test_a_cell_of_ones_own_needs_clearances_and_a_stiffness():
    springs = [{"start": 1, "end": 2, "stiffness": 1.0}, {"start": 2, "end": 1, "stiffness": 1.0, "next_cell": True}]
    cell = {"masses": [1.0, 1.0], "springs": springs, "contact": [1, 2]}
    with pytest.raises(CaseError, match=r"contacts\.clearance"):
        NnmCase.from_table({"lattice": {"cell": cell}, "contacts": {"stiffness": 1.0}})
    with pytest.raises(CaseError, match=r"contacts\.stiffness: missing; give it or also modulus, radius, poisson"):
        NnmCase.from_table({"lattice": {"cell": cell}, "contacts": {"clearance": 0.1}})


def test_a_restitution_is_warned_of():
    told = [NnmCase.from_table({"contacts": {"restitution": r}}).warnings() for r in (0.7, 1.0)]
    assert told == [["contacts.restitution = 0.7 counts as 1: normal modes lose nothing"], []]


@pytest.mark.parametrize("nnm", [{}, {"system": "chain"}, {"system": "condensed", "start_frequency": [1600.0]}])
@pytest.mark.parametrize(
    ("table", "key"),
    [
        ({"contacts": {"law": "power"}}, r"contacts\.exponent: missing"),
        ({"contacts": {"exponent": 3.0}}, r"contacts\.exponent = 3.0: is for law"),
        ({"contacts": {"side": "plus"}}, r"contacts\.side"),
        ({"contacts": {"clearance_minus": 2e-3}}, r"contacts\.clearance_minus"),
        ({"contacts": {"each": {"law": ["bilinear"]}}}, r"contacts\.each"),
        ({"contacts": {"next_cell": True}}, r"contacts\.next_cell"),
        ({"lattice": {"damping": {"mass": 1.0}}}, "without dashpots"),
        ({"lattice": {"absorbing": {"cells": 2, "strength": 1.0}}}, r"lattice\.absorbing"),
        ({"disorder": {"seed": 1, "cells": {"masses": {"relative": 0.01}}}}, "disorder"),
    ],
)
def test_what_branches_do_not_know_is_refused(nnm, table, key):
    contacts = {"sites": [2], "clearance": 1e-3} | table.get("contacts", {})
    lattice = {"preset": "four-band", "cells": 8} | table.get("lattice", {})
    with pytest.raises(CaseError, match=key):
        NnmCase.from_table(table | {"contacts": contacts, "lattice": lattice, "nnm": nnm})


@pytest.fixture(scope="module")
def short_branch() -> Branch:
    problem = Shooting(Dop853Flow(reduced()), MAPS["quarter"])
    start = linear_start(problem, 1, 0.02)
    growing = Continuation(problem, start, NnmTable(points=400, energy=[0.0, 1e4]))
    points = [growing.point, *growing]
    assert growing.finished
    orbits = sampled(problem, points[-1:])
    return Branch(
        name="out-of-phase",
        case="name = 'x'",
        dofs=2,
        points=points,
        next_step=0.1,
        complete=True,
        ending="done",
        findings=["a", "b"],
        extra=orbits,
    )


def csv_of(branch: Branch) -> str:
    return str(LAYOUTS[branch.kind].table(branch))


def test_steps_have_the_arclength_that_they_say(short_branch):
    """t . (xi - xi0) = s in the chart of the point before, whose unknowns are of order one."""
    for a, b in itertools.pairwise(short_branch.points):
        chart = Relative(reduced(), a.x, a.period)
        xi = chart.encode(a.x, a.period)
        w, size = a.x[1] - a.x[0], np.abs(a.x).max()
        assert xi == pytest.approx([a.x[0] / size, w / min(max(abs(w), D), size), 1.0], rel=1e-12)
        tangent = np.linalg.solve(chart.derivative(xi), a.tangent)
        chord = chart.encode(b.x, b.period) - xi
        assert tangent @ chord / np.linalg.norm(tangent) == pytest.approx(b.step, rel=1e-6)
        assert b.index == a.index + 1


@pytest.mark.parametrize(
    ("bound", "sentence"),
    [
        ({"energy": [0.0, 0.0294]}, "left the energy range 0 to 0.0294 J"),
        ({"frequency": [0.0, 474.5]}, "left the frequency range 0 to 474.5 Hz"),
        ({"points": 3}, "3 points reached: raise nnm.points and resume to go on"),
    ],
)
def test_a_branch_ends_at_its_bounds_and_says_so(bound, sentence):
    problem = Shooting(Dop853Flow(reduced()), MAPS["quarter"])
    growing = Continuation(problem, linear_start(problem, 1, 0.02), NnmTable(**bound))
    points = list(growing)
    assert (growing.ending, growing.finished) == (sentence, "points" not in bound)
    ((name, limit),) = bound.items()
    outside = [i for i, p in enumerate(points, 1) if name != "points" and getattr(p, name) > limit[1]]
    assert outside == ([] if name == "points" else [len(points)])


def test_guards_are_what_the_points_obey(short_branch):
    """No step strains a guard beyond its bound; some are held back by the half-trace, and the first by none."""
    guards = Guards()
    turns, changes = [], []
    for a, b in itertools.pairwise(short_branch.points):
        changes.append(half_trace_change(a, b))
        assert abs(a.episodes - b.episodes) <= guards.contacts
        chart = Relative(reduced(), a.x, a.period)
        before, after = (np.linalg.solve(chart.derivative(chart.encode(a.x, a.period)), p.tangent) for p in (a, b))
        turns.append(np.arccos(np.clip(unit(before) @ unit(after), -1, 1)))
    assert 0.3 * guards.half_trace < max(changes) <= guards.half_trace
    assert 0.3 * guards.turn < max(turns) <= guards.turn


@pytest.mark.parametrize("sign", [1, -1])
def test_energy_folds_are_where_the_energy_turns(short_branch, sign):
    """On the way up and on the way down again; the energy is stationary along the branch there."""
    problem = Shooting(Dop853Flow(reduced()), MAPS["quarter"])
    points = [replace(p, tangent=sign * p.tangent, energy_tangent=sign * p.energy_tangent) for p in short_branch.points]
    points = points[::sign]
    turning = [
        (a, b) for a, b in itertools.pairwise(points) if a.energy_tangent * b.energy_tangent < 0 and a.episodes > 0
    ]
    assert len(turning) == 2
    for a, b in turning:
        (fold,) = (p for p in locate(problem, a, b) if p.kind == "fold-energy")
        assert abs(fold.energy_tangent) <= 1e-9 * abs(a.energy_tangent)
        assert fold.half_traces[0] == pytest.approx(1, abs=1e-6)
    kinds = {p.kind for a, b in itertools.pairwise(points[-20:]) for p in locate(problem, a, b)}
    assert "fold-energy" not in kinds


def test_branch_file_round_trip(short_branch, tmp_path):
    write_branch(short_branch, tmp_path, {"ranks": 1})
    again = read_branch(tmp_path / "branch-out-of-phase.h5")
    for read, written in zip(again.points, short_branch.points, strict=True):
        for name in {f.name for f in fields(written)} - {"next_step"}:  # it stands with the branch
            assert np.array_equal(getattr(read, name), getattr(written, name), equal_nan=name != "kind"), name
    assert again.next_step == short_branch.next_step
    assert csv_of(again) == csv_of(short_branch)
    assert (again.ending, again.complete, again.findings) == ("done", True, ["a", "b"])
    rows = list(csv.DictReader(io.StringIO((tmp_path / "branch-out-of-phase.csv").read_text())))
    assert [float(r["energy"]) for r in rows] == [p.energy for p in short_branch.points]
    told = [(float(r["slope"]), int(r["contacts"]), r["kind"]) for r in rows[1:]]
    assert told == [(p.slope, p.episodes, p.kind) for p in short_branch.points[1:]]
    assert [int(r["region"]) for r in rows] == regions(short_branch).tolist()
    assert list(rows[0])[-6:] == ["half_trace", "multiplier_max", "slope", "contacts", "region", "kind"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["branch-out-of-phase.csv", "branch-out-of-phase.h5"]


def test_files_from_before_kinds_were_named_are_read(short_branch, tmp_path):
    write_branch(short_branch, tmp_path, {})
    path = tmp_path / "branch-out-of-phase.h5"
    with h5py.File(path, "a") as file:
        del file.attrs["branch_kind"]
    again = read_branch(path)
    assert again.kind == short_branch.kind
    assert [p.energy for p in again.points] == [p.energy for p in short_branch.points]


@pytest.mark.parametrize(("ends", "springs", "held"), [("fixed", 4, 1.0), ("free", 2, 0.0), ("periodic", 3, 0.0)])
def test_a_chain_keeps_its_nonlinear_springs(ends, springs, held):
    """Moved as a whole by 1 m, a lattice stretches the springs to its walls alone, one by 1 m, one by -1 m."""
    spring = Spring(1, 0, 5.0, next_cell=True, quadratic=2.0, cubic=3.0)
    cell = UnitCell((1.0, 2.0), (Spring(0, 1, 7.0), spring), host=0, resonator=1)
    system = System.from_chain(Chain(cell, 3, ends), LAW)
    assert len(system.springs) == springs
    u = np.ones(system.dofs)
    linear = 0.5 * u @ system.stiffness @ u
    assert system.energy(u, 0 * u) - linear == pytest.approx(held * 2 * 3.0 / 4)
    assert system.forces(u)[[0, -1]] - (system.stiffness @ u)[[0, -1]] == pytest.approx([held * 5.0, held * 1.0])


def test_xarray_opens_the_branch(short_branch, tmp_path):
    xarray = pytest.importorskip("xarray")
    write_branch(short_branch, tmp_path, {})
    with xarray.open_dataset(tmp_path / "branch-out-of-phase.h5", engine="h5netcdf") as data:
        assert data.frequency.attrs["units"] == "Hz"
        assert data.initial.dims == ("point", "dof")
        assert float(data.energy[0]) == short_branch.points[0].energy
    last = short_branch.points[-1]
    with xarray.open_dataset(tmp_path / "branch-out-of-phase.h5", engine="h5netcdf", group="orbits") as orbits:
        assert np.array_equal(orbits.displacement[0, 0], last.x)
        assert np.all(orbits.velocity[0, 0] == 0)
        assert (float(orbits.energy[0]), int(orbits.number[0])) == (last.energy, last.index)


@pytest.mark.slow
def test_picture_from_the_file(short_branch, tmp_path):
    from vipetsc.figures.registry import draw

    write_branch(short_branch, tmp_path, {})
    (path,) = draw("branches", [tmp_path])
    assert path == tmp_path / "figures" / "branch-out-of-phase.png"
    assert path.stat().st_size > 20000


def in_phase_hertz(**control) -> tuple[Shooting, list[Point]]:
    """The in-phase Hertz branch in the chart auto, up to just behind the tip of its 3:1 tongue."""
    system = System.reduced(four_band(), D, Contact("hertz", contact_stiffness(1e8, 0.005, 0.3)))
    problem = Shooting(Dop853Flow(system), MAPS["quarter"])
    start = linear_start(problem, 0, system.grazing_energy(0) / 100)
    growing = Continuation(problem, start, NnmTable(**{"points": 150, "chart": "auto", "energy": [0, 6e9]} | control))
    return problem, [growing.point, *growing]


@pytest.mark.parametrize("guarded", [True, False])
def test_the_in_phase_hertz_branch_crosses_the_out_of_phase_one_and_goes_on(guarded):
    """The tip of its 3:1 tongue lies on the out-of-phase branch: a turn that the grazing chart hides leads onto it.

    The true branch comes back from the tip, with c = 1 passed there, and no orbit repeats itself.
    """
    problem, points = in_phase_hertz(**({} if guarded else {"guards": Guards(turn_relative=0), "points": 200}))
    assert max(problem.turn(a, b) for a, b in itertools.pairwise(points)) > 0.2
    monitor = BranchMonitor(problem, Guards())
    said = [s for s in map(monitor.check, points) if s]
    assert [i for i, why in suspects(problem, points) if "turns by" in why] == ([] if guarded else [123])
    if guarded:
        assert not said
        assert points[-1].energy < points[124].energy < 0.031
    else:
        assert said[0] == "left its branch: the orbit of point 200 is another one passed 3 times"
        assert is_jump(problem, points[123], points[124], NnmTable(chart="auto"))


def test_a_branch_that_stands_still_says_so():
    monitor = BranchMonitor(Shooting(Dop853Flow(reduced()), MAPS["quarter"]), Guards(standstill=20))
    problem = Shooting(Newmark(reduced()), MAPS["quarter"])
    start = linear_start(problem, 1, 0.0293434)
    growing = Continuation(problem, start, NnmTable(points=100, chart="auto"))
    said = next(s for s in map(monitor.check, growing) if s)
    assert said.startswith("does not advance: 20 points up to ")
    assert "E = 0.0293434562 J" in said


def on_branch(problem: Shooting, x: list[float], period: float, step: float) -> Point:
    """A point of a branch from rounded values, with falling period along its tangent."""
    frame = problem.relative_frame(np.array(x), period)
    row = np.linalg.svd(frame.jacobian(frame.xi))[2][-1]
    attempt = frame.solve(frame.xi, row, row @ frame.xi)
    assert attempt.converged
    return replace(frame.measures(attempt, -row * np.sign(row[-1])), step=step)


# Three points of the in-phase Hertz branch, x in m, period in s and step each; 1.0e6 J and 1.7e7 J.
PAIRS = {
    "symmetry-breaking": [
        ([-9.151145747905344, -9.226299568925315], 0.003148020146748403, 0.0986),
        ([-9.869904521950374, -9.949778169710124], 0.0031478468939554415, 0.1),
        ([-10.564752182727462, -10.650004848960046], 0.0031476911959756027, 0.0969),
    ],
    "fold-energy": [
        ([-41.58157519928831, -41.827813151364275], 0.003145313850191308, 0.0109),
        ([-41.592476734313195, -41.841905100306086], 0.003145304127065715, 0.013),
        ([-41.58941483494171, -41.843776559314165], 0.0031452884555063713, 0.0198),
    ],
}


@pytest.mark.parametrize("kind", PAIRS)
def test_two_special_points_within_a_step_are_found(kind):
    """A test that turns just behind zero has one sign at both ends of the step."""
    system = System.reduced(four_band(), D, Contact("hertz", contact_stiffness(1e8, 0.005, 0.3)))
    problem = Shooting(Dop853Flow(system), MAPS["quarter"])
    before, left, right = (on_branch(problem, *values) for values in PAIRS[kind])
    pair = [p for p in locate(problem, left, right, before=before) if p.kind == kind]
    assert len(pair) == 2
    assert 0 < pair[0].step < pair[1].step < right.step
    assert not [p for p in locate(problem, left, right) if p.kind == kind]
    for point in pair:
        off = point.half_traces[0] + 1 if kind == "symmetry-breaking" else point.energy_tangent / point.energy
        assert abs(off) <= 1e-8


def test_a_root_that_newton_misses_is_sought_in_half_of_the_step(short_branch, monkeypatch):
    problem = Shooting(Dop853Flow(reduced()), MAPS["quarter"])
    steps = itertools.pairwise(short_branch.points)
    a, b = next((a, b) for a, b in steps if a.energy_tangent * b.energy_tangent < 0 and a.episodes > 0)
    (fold,) = (p for p in locate(problem, a, b) if p.kind == "fold-energy")
    at, missed = Segment.at, []

    def fails_once_off_the_middle(self, arclength):
        if self.length > 0.9 * b.step and arclength != 0.5 * self.length:
            raise ArithmeticError("no luck")
        return at(self, arclength)

    monkeypatch.setattr(Segment, "at", fails_once_off_the_middle)
    (again,) = (p for p in locate(problem, a, b, missed=missed) if p.kind == "fold-energy")
    assert again.energy == pytest.approx(fold.energy, rel=1e-12)
    assert again.step == pytest.approx(fold.step, rel=1e-3)
    assert not missed
    monkeypatch.setattr(Segment, "at", lambda *_: (_ for _ in ()).throw(ArithmeticError("never")))
    assert not locate(problem, a, b, missed=missed)
    assert missed[0].startswith(f"a fold-energy after point {a.index} (E = {a.energy:.9g} J) is not located")


def test_a_period_doubled_orbit_is_off_its_parent(short_branch):
    """Near grazing the first attempt ends on the linear mode passed twice; the switch goes on with a smaller one."""
    problem = Shooting(Dop853Flow(reduced()), MAPS["quarter"])
    steps = itertools.pairwise(short_branch.points)
    near = (p for a, b in steps if a.energy < 0.02935 and b.episodes for p in locate(problem, a, b))
    point = next(p for p in near if p.kind == "period-doubling")
    fresh, first = switch(problem, point)
    assert repetitions(fresh, first) == 1
    assert first.energy == pytest.approx(point.energy, rel=1e-3)
    assert first.period == pytest.approx(2 * point.period, rel=1e-3)
    doubled = replace(first, x=point.x, period=2 * point.period)
    assert repetitions(fresh, doubled) == 2


def follow(folder, name: str, listener=None, stop=None, resume=False, **nnm) -> Branch:
    folder = folder / name
    folder.mkdir(exist_ok=True)
    lattice, contacts = {"preset": "four-band", "reading": "printed"}, {"law": "bilinear", "modulus": 1e8}
    table = {"name": "x", "lattice": lattice, "contacts": contacts, "nnm": {"modes": [2], "chart": "auto"} | nnm}
    case = NnmCase.from_table(table)
    return follow_all(case, folder, MPI.COMM_SELF, resume=resume, listener=listener, stop=stop)[0]


def test_orbits_have_the_energies_that_are_asked_for(tmp_path):
    """Between its two folds, .0264 and .02934 J, the branch passes an energy three times."""
    branch = follow(tmp_path, "a", energy=[0.0, 0.05], orbits_at=[0.028, 0.0316, 9.0], locate=False)
    asked = [(e, t) for e, t in zip(*(branch.extra[f"orbits/{n}"].values for n in ("energy", "period")), strict=True)]
    asked = asked[-4:]
    assert [e for e, _ in asked] == pytest.approx([0.028] * 3 + [0.0316], rel=1e-12)
    assert len({t for _, t in asked}) == 4
    assert branch.findings == ["the branch has no orbit of 9 J"]


@pytest.mark.slow
def test_both_halves_of_a_branch_are_stopped_saved_and_resumed_to_the_same_bits(tmp_path, monkeypatch):
    monkeypatch.setattr("vipetsc.modes.branches.follow.SAVE_EVERY", 0.0)
    nnm = {"direction": "both", "start_energy": 0.029, "energy": [0.01, 0.05], "switch": ["period-doubling"]}
    nnm |= {"switch_points": 3}
    stop, saved = StopRequest(), set()

    def listener(branch, point):
        saved.update(path.name for path in (tmp_path / "parts").iterdir())
        stop.requested = (branch.name, point.index) in {("out-of-phase-down", 5), ("out-of-phase", 7)}

    first = follow(tmp_path, "parts", listener, stop, **nnm)
    assert first.ending.startswith("stopped on request")
    assert not (tmp_path / "parts" / "branch-out-of-phase.h5").exists()
    second = follow(tmp_path, "parts", listener, stop, True, **nnm)
    assert second.ending == "stopped on request after point 7; resume goes on"
    last = follow(tmp_path, "parts", resume=True, **nnm)
    whole = follow(tmp_path, "whole", **nnm)
    assert csv_of(last) == csv_of(whole)
    assert last.complete
    names = {path.name for path in (tmp_path / "whole").iterdir()}
    assert names == {path.name for path in (tmp_path / "parts").iterdir()}
    assert {"branch-out-of-phase-down.h5", "branch-out-of-phase.h5"} <= saved
    for name in names:
        if name.endswith("csv"):
            assert (tmp_path / "parts" / name).read_text() == (tmp_path / "whole" / name).read_text()
    crossing = next(name for name in names if "doubling" in name and name.endswith("h5"))
    (tmp_path / "parts" / crossing).unlink()
    follow(tmp_path, "parts", resume=True, **nnm)
    assert (tmp_path / "parts" / crossing).exists()
