"""The propagator's parts alone: stencil against the matrix exponential; collocation; grouping."""

import re
from math import factorial

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import trapezoid

from tests.conftest import small_case
from tests.unit.test_exact_lattices import exponential
from vipetsc.case import Case
from vipetsc.contact.law import CLOSED, create_contacts
from vipetsc.dynamics.drives import create_drives
from vipetsc.dynamics.engine import FillResult
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.clusters import (
    Groups,
    create_dof_tables,
    create_responses,
    expand_free_motion,
    group_dofs,
)
from vipetsc.dynamics.propagator.collocation import (
    accumulate_moments,
    collocate,
    error_ratio,
    evaluate_site_motion,
    node_responses,
    update_taylor,
)
from vipetsc.dynamics.propagator.engine import Propagator
from vipetsc.dynamics.propagator.nodes import EXIT, NODES, ONSET, PLAIN, collocation
from vipetsc.dynamics.propagator.series import StepSeries, evaluate, shift
from vipetsc.dynamics.propagator.stencil import HaloRegions, apply_propagator, create_stencil, exchange
from vipetsc.dynamics.propagator.substeps import (
    HISTORY,
    SUBSTEP_STATE,
    Cluster,
    Substep,
    Trial,
    create_tape,
    create_trial,
)
from vipetsc.dynamics.propagator.tangent import no_samples
from vipetsc.dynamics.vectors import LANES

ENDS = pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])


def parts(ends: str, interval: float, tolerance: float, sites=(5, 6, 12)):
    """Model, layout, series, halo of a chain of 24 cells on one rank."""
    model = small_case(lattice={"ends": ends}, contacts={"sites": list(sites)}).model()
    layout = Layout(model, MPI.COMM_SELF)
    return model, layout, StepSeries(model.chain, interval, tolerance), HaloRegions(layout)


def as_lists(groups) -> list[list[int]]:
    return [part.tolist() for part in np.split(groups.numbers, groups.first[1:-1])]


@ENDS
@pytest.mark.parametrize(("interval", "tolerance"), [(1e-4, 1e-14), (2e-4, 1e-6), (5e-4, 1e-10)])
def test_the_stencil_is_the_exponential_within_its_bound(ends, interval, tolerance):
    _, layout, series, halo = parts(ends, interval, tolerance)
    stencil = create_stencil(series, layout, halo)
    halo = halo.bind_columns([])
    rows, n = 2 * layout.dofs, layout.cells
    matrix = np.empty((rows * n, rows * n))
    for column in range(rows * n):
        state, out = np.zeros((rows, n)), np.empty((rows, n))
        state.ravel()[column] = 1.0
        exchange(halo, 0, state)
        apply_propagator(stencil, state, halo.columns, out)
        matrix[:, column] = out.ravel()
    half = rows * n // 2
    scale = np.where(np.arange(rows * n) < half, series.omega_max_h / interval, 1.0)  # a velocity counts as omega u
    error = np.abs(matrix - exponential(series.chain, interval)) * scale[:, None] / scale
    assert error.sum(axis=1).max() <= series.truncation + 2e-14
    assert series.truncation < tolerance
    if tolerance > 1e-12:  # the bound is one that is felt
        assert error.sum(axis=1).max() > 1e-3 * series.truncation


@pytest.mark.parametrize("name", ["diatomic", "three-mass", "four-band"])
@pytest.mark.parametrize("cells", [24, LANES + 12, 3 * LANES + 17])
def test_every_cell_is_the_same_sum_to_the_last_bit(name, cells):
    # Vectors of cells, the overlap of the last one with the one before, cells one by one at the borders.
    case = Case.load(f"runs/{name}.toml", [f"lattice.cells={cells}", "lattice.ends=periodic", "contacts.sites=[5]"])
    model = case.model()
    layout, series = Layout(model, MPI.COMM_SELF), StepSeries(model.chain, 2e-4, 1e-10)
    halo = HaloRegions(layout)
    stencil = create_stencil(series, layout, halo)
    halo = halo.bind_columns([])
    state = np.random.default_rng(3).normal(size=(2 * layout.dofs, cells))
    out, expected = np.full_like(state, np.nan), np.zeros_like(state)
    exchange(halo, 0, state)
    apply_propagator(stencil, state, halo.columns, out)
    for total, entry in zip(expected, series.interior(), strict=True):
        for row, column in np.argwhere(entry):
            total += entry[row, column] * np.roll(state[row], series.reach - column)
    assert out.tobytes() == expected.tobytes()


@pytest.mark.parametrize("interval", [1e-4, 3e-4])
def test_the_bound_keeps_below_every_tolerance(interval):
    chain = small_case().model().chain
    for tolerance in np.geomspace(1e-14, 1e-3, 34):
        assert StepSeries(chain, interval, tolerance).truncation < tolerance


def test_clusters_that_cannot_touch_are_left_alone():
    model, layout, series, halo = parts("fixed", 1e-4, 1e-14, sites=(4, 12, 20))
    groups = group_dofs(model, series.reach)
    assert as_lists(groups) == [[-1], [0], [1], [2]]
    tables = create_dof_tables(groups, model, layout, series, halo)
    halo = halo.bind_columns([])
    taylor = np.zeros((4, 2 * series.terms))
    state = np.zeros((2 * layout.dofs, layout.cells))
    resonator, clearance = model.chain.cell.resonator, model.chain.clearances[1]
    for reached, expected in ((0.9 * clearance, []), (1.001 * clearance, [2]), (np.nan, [2])):
        state[resonator, 11] = reached
        exchange(halo, 0, state)
        assert [c for c in range(4) if expand_free_motion(tables, c, halo.columns, taylor)] == expected


def test_a_rank_far_from_contacts_and_drives_has_empty_tables():
    model, layout, series, halo = parts("fixed", 1e-4, 1e-14, sites=(4, 12, 20))
    nothing = Groups(np.zeros(0, np.int64), np.zeros(1, np.int64))
    tables = create_dof_tables(nothing, model, layout, series, halo)
    assert tables.rows.shape[0] == tables.clearance.size == tables.sites.size == 0
    assert create_responses(nothing, tables, model, series).size == 0


def test_contacts_that_cannot_be_followed_end_the_run():
    model = small_case(contacts={"sites": [1, 6], "law": "bilinear", "stiffness": 1e45}).model()
    layout = Layout(model, MPI.COMM_SELF)
    engine = Propagator(model, layout)
    assert engine.fill(no_samples(model, layout, 4)) == FillResult(0)
    assert (engine.steps, engine.time) == (3, 3 * model.sample_interval)
    stalled = engine.fill(no_samples(model, layout, model.samples)).stalled
    assert re.match(r"the contacts of sites 1 at 0.0\d+ s", stalled)
    # The state is the last one before.
    assert engine.time == engine.steps * model.sample_interval
    assert 0 < float(stalled.split()[-2]) - engine.time < model.sample_interval
    engine.destroy()


def test_dofs_within_reach_are_grouped_across_a_periodic_end():
    def sites(ends, reach):
        model = small_case(lattice={"ends": ends}, contacts={"sites": [2, 12, 14, 23]}).model()
        return as_lists(group_dofs(model, reach))

    assert sites("fixed", 1) == [[0, -1], [1], [2], [3]]
    assert sites("fixed", 2) == [[0, -1], [1, 2], [3]]
    assert sites("periodic", 1) == [[0, -1], [1], [2], [3]]
    assert sites("periodic", 2) == [[0, 3, -1], [1, 2]]


def test_dofs_whose_next_cells_are_within_reach_are_grouped():
    def sites(ends, reach):
        contacts = {"sites": [2, 12, 14, 22], "pair": [1, 1], "next_cell": True}
        return as_lists(group_dofs(small_case(lattice={"ends": ends}, contacts=contacts).model(), reach))

    assert sites("fixed", 1) == [[0, -1], [1, 2], [3]]
    assert sites("periodic", 1) == [[0, -1], [1, 2], [3]]
    assert sites("periodic", 2) == [[0, 3, -1], [1, 2]]


def test_a_shifted_series_is_the_same_function():
    taylor = np.random.default_rng(2).normal(size=(3, 12))
    moved = np.empty_like(taylor)
    shift(taylor, 0.37, moved)
    for series, other in zip(taylor, moved, strict=True):
        np.testing.assert_allclose(evaluate(series, 0.8), evaluate(other, 0.43), rtol=1e-12)


def test_nodes_have_the_order_of_gauss_and_follow_roots():
    table = collocation(4)
    position, weight = table.position, table.weight
    assert weight[PLAIN] @ position[PLAIN] ** 15 == pytest.approx(1 / 16, rel=1e-14)
    assert abs(weight[PLAIN] @ position[PLAIN] ** 16 - 1 / 17) > 1e-12
    assert weight[ONSET] @ position[ONSET] ** 1.5 == pytest.approx(1 / 2.5, rel=1e-14)
    assert weight[EXIT] @ (1 - position[EXIT]) ** 1.5 == pytest.approx(1 / 2.5, rel=1e-14)
    assert abs(weight[PLAIN] @ position[PLAIN] ** 1.5 - 1 / 2.5) > 1e-8
    # The last two coefficients of a polynomial of lower degree vanish; those of Legendre's own are found.
    x = position[PLAIN]
    assert np.abs(table.tail @ x ** (NODES - 3)).max() < 1e-14
    legendre = np.polynomial.legendre.legval(2 * x - 1, np.eye(NODES)[NODES - 1])
    np.testing.assert_allclose(table.tail @ legendre, [0, 1], atol=1e-13)


def oscillator(damping: float = 0.0) -> tuple[Cluster, float]:
    """A mass on the stop x >= 0 (clearance 1, bilinear): x = v sin(rate t)/rate; and the rate."""
    mass, h, speed, rate = 0.02, 1e-4, 0.5, 3e4
    contact = small_case(contacts={"law": "bilinear"}).model().contact
    contacts = create_contacts(contact, [1.0])
    contacts["mode"], contacts["approach"] = CLOSED, speed
    contacts["elastic"]["stiffness"] = mass * rate**2
    contacts["damping"], contacts["floor"] = damping, 0.0
    drives = create_drives((), [])
    response = np.full((1, 1, 1), h**2 / mass)
    cluster = Cluster(
        contacts, drives, response, collocation(2), h, 1.0, 1e-10, 1e-12, 1.0,
        taylor=np.array([[1.0, speed * h]]), site_motion=np.zeros((1, 3)), moments=np.zeros((1, 2)),
        energy=np.zeros(1), history=np.zeros(1, HISTORY), state=np.zeros(1, SUBSTEP_STATE), trial=create_trial(1, 1),
        tape=create_tape(0, 0),
    )  # fmt: skip
    return cluster, rate


def one_substep(cluster: Cluster, substep: Substep) -> Trial:
    trial = cluster.trial
    assert collocate(cluster, trial, substep)
    update_taylor(cluster, trial, substep)
    accumulate_moments(cluster, trial, substep)
    return trial


@pytest.mark.parametrize("kind", [PLAIN, ONSET, EXIT])
def test_a_linear_contact_is_an_oscillator(kind):
    cluster, rate = oscillator()
    mass, speed, h, begin = 0.02, 0.5, cluster.interval, 0.25
    cluster.state["position"] = begin
    trial = one_substep(cluster, Substep(kind, 0.3))
    phase = rate * 0.3 * h
    assert trial.taylor[0, 0] - 1 == pytest.approx(speed / rate * np.sin(phase), rel=1e-9)
    assert trial.taylor[0, 1] / h == pytest.approx(speed * np.cos(phase), rel=1e-10)
    # The moments are those of the force about the end of the step; the first one is the momentum it took.
    assert cluster.moments[0, 0] == pytest.approx(mass * speed * (np.cos(phase) - 1), rel=1e-9)
    t = np.linspace(0, 0.3 * h, 20001)
    force = -mass * rate * speed * np.sin(rate * t)
    assert cluster.moments[0, 1] == pytest.approx(trapezoid(force * (1 - begin - t / h), t), rel=1e-7)
    assert cluster.energy[0] == 0.0


def test_damping_takes_the_energy_that_is_booked():
    cluster, rate = oscillator(damping=0.3)
    mass, speed = 0.02, 0.5
    trial = one_substep(cluster, Substep(PLAIN, 0.3))
    x, v = trial.taylor[0, 0] - 1, trial.taylor[0, 1] / cluster.interval
    lost = 0.5 * mass * (speed**2 - v**2 - (rate * x) ** 2)
    assert cluster.energy[0] == pytest.approx(lost, rel=1e-9)
    assert lost > 1e-2 * mass * speed**2


def test_the_error_estimate_falls_as_the_order_says():
    ratios = []
    for length in (0.8, 0.4):
        cluster, _ = oscillator()
        ratios.append(error_ratio(cluster, one_substep(cluster, Substep(PLAIN, length)), length))
    # The last two coefficients fall as h^6 and h^7, times the length.
    assert 6 < np.log2(ratios[0] / ratios[1]) < 8.5
    # What is allowed goes with the approach velocity, 0.5 m/s till now.
    cluster.contacts["approach"] = 1.0
    assert error_ratio(cluster, cluster.trial, 0.4) == pytest.approx(ratios[1] * 5.1e-11 / 1.01e-10)


def test_a_sites_acceleration_is_that_of_the_free_motion_and_of_the_force():
    cluster, rate = oscillator()
    h, taylor = cluster.interval, np.array([[1.0 + 2e-6, 3.0, 20.0]])
    evaluate_site_motion(cluster._replace(taylor=taylor), taylor * [1.0, h, h * h], cluster.site_motion)
    assert cluster.site_motion[0] == pytest.approx([1.0 + 2e-6, 3.0, 40.0 - rate**2 * 2e-6], rel=1e-9)


def test_responses_are_added_up_over_all_terms():
    """A constant force F on an oscillator: m omega^2 w = F (1 - cos omega t), m omega w' = F sin omega t."""
    cluster, turn, terms, mass = oscillator()[0], 1.2, 8, 0.02
    signs = (-(turn**2)) ** np.arange(terms) / [factorial(2 * m + 1) for m in range(terms)]
    response, nodes = cluster.response * signs, collocation(2 * terms)
    cluster = cluster._replace(response=response, taylor=np.zeros((1, 2 * terms)), nodes=nodes, omega_max_h=turn)
    to_w, to_v = np.zeros((2, NODES, NODES))
    assert node_responses(cluster, Substep(PLAIN, 0.9), 0, 0, to_w, to_v)
    phase, h = turn * 0.9 * nodes.position[PLAIN], cluster.interval
    np.testing.assert_allclose(to_w.sum(axis=0), (1 - np.cos(phase)) * h**2 / (mass * turn**2), rtol=1e-11)
    np.testing.assert_allclose(to_v.sum(axis=0), np.sin(phase) * h / (mass * turn), rtol=1e-11)


def test_ten_thousand_sites_are_set_up_and_gone_on_with():
    many = {"sites": {"first": 5, "spacing": 10, "count": 10_000}}
    model = small_case(lattice={"cells": 100_100}, contacts=many, time={"sample_interval": 1e-4}).model()
    assert Propagator.refusal(model) is None
    layout = Layout(model, MPI.COMM_SELF)
    engine, other = Propagator(model, layout), Propagator(model, layout)
    assert engine.fill(no_samples(model, layout, 2)) == FillResult(0)
    state = engine.checkpoint()
    other.restore([state])
    again = other.checkpoint()
    assert len(state["sites"]) == len(state["losses"]) == 10_000
    for name, table in state.items():
        assert repr(table.tolist()) == repr(again[name].tolist()), name  # NaN equals NaN
    engine.destroy()
    other.destroy()
