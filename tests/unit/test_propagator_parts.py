"""The propagator's parts alone: stencil against the matrix exponential; grouping; series; collocation; kinks; tape."""

import re
from math import factorial

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import trapezoid

from tests.conftest import small_case
from tests.unit.test_exact_lattices import exponential
from vipetsc.case import Case
from vipetsc.contact.law import CLOSED, PERMANENT, create_contacts
from vipetsc.dynamics.drives import create_drives
from vipetsc.dynamics.engine import FillResult
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.advance import DONE, advance_cluster, first_kink
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
from vipetsc.dynamics.propagator.series import StepSeries, copy, evaluate, first_onset, shift
from vipetsc.dynamics.propagator.stencil import HaloRegions, apply_propagator, create_stencil, exchange
from vipetsc.dynamics.propagator.substeps import (
    HISTORY,
    SUBSTEP_STATE,
    Cluster,
    Substep,
    Trial,
    create_tape,
    create_trial,
    write_on_tape,
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


def test_a_series_is_shifted_in_place_and_its_rows_are_copied_in_part():
    taylor = np.random.default_rng(4).normal(size=(3, 7))
    expected = np.empty_like(taylor)
    shift(taylor, -0.6, expected)
    in_place = taylor.copy()
    shift(in_place, -0.6, in_place)
    assert in_place.tobytes() == expected.tobytes()
    rows = np.zeros((2, 7))
    copy(taylor, rows)
    np.testing.assert_array_equal(rows, taylor[:2])
    # A workspace for more DoFs keeps what it had of the others.
    room = np.full((5, 7), 9.0)
    shift(taylor, -0.6, room)
    np.testing.assert_array_equal(room[:3], expected)
    assert (room[3:] == 9.0).all()


@pytest.mark.parametrize(
    ("series", "clearances", "length", "onset"),
    [
        ([0.0, 1.0], (0.4, 0.4), 1.0, 0.4),
        ([0.0, -1.0], (0.4, 0.4), 1.0, 0.4),
        ([0.0, -1.0], (0.4, 0.3), 1.0, 0.3),
        ([0.0, -1.0], (0.4, 0.3), 0.35, 0.3),
        ([0.0, -1.0], (0.4, np.inf), 1.0, 2.0),
        ([0.0, 1.0], (np.inf, 0.4), 1.0, 2.0),
        ([0.0, 1.0], (0.4, 0.4), 0.39, 2.0),
        ([0.0, 0.0, 1.0], (0.2, 0.2), 0.5, 0.2**0.5),
        ([0.0, 0.0, 1.0], (0.3, 0.3), 0.5, 2.0),
        # Both sides within the length: the first of the two.
        ([0.0, 2.0, -6.0], (0.1, 0.1), 1.0, (1 - 0.4**0.5) / 6),
        ([0.0, -2.0, 6.0], (0.1, 0.1), 1.0, (1 - 0.4**0.5) / 6),
        # Away from a clearance on which it begins, and back; towards it; a little beyond it.
        ([0.3, -1.0, 1.0], (0.3, 0.3), 1.2, 1.0),
        ([0.3, 1.0, 0.0], (0.3, 0.3), 1.2, 0.0),
        ([0.3 * (1 + 1e-12), 1.0, 0.0], (0.3, 0.3), 1.2, 0.0),
        # At rest on a clearance, then away to the other side; almost at rest just before it.
        ([0.3, 0.0, -1.0], (0.3, 0.3), 1.0, 0.6**0.5),
        ([0.3 - 1e-11, 1e-9, 1.0], (0.3, 0.3), 1.0, 0.0),
        # Away at first, and back faster and faster: w = 4 s^3 - s.
        ([0.0, -1.0, 0.0, 4.0], (0.3, 0.3), 1.0, np.roots([4.0, 0.0, -1.0, -0.3]).real.max()),
        # A short approach with much curvature; one that turns just short of the clearance, or just beyond.
        ([0.0, 0.0, 0.0, 40.0], (0.3, 0.3), 1.0, (0.3 / 40) ** (1 / 3)),
        ([0.0, 1.0, -1.0], (0.25 + 1e-7, 0.25 + 1e-7), 1.0, 2.0),
        ([0.0, 1.0, -1.0], (0.25 - 1e-7, 0.25 - 1e-7), 1.0, 0.5 - 1e-7**0.5),
    ],
)
def test_the_first_onset_is_met_to_rounding(series, clearances, length, onset):
    site = create_contacts(small_case().model().contact, [clearances])[0]
    assert first_onset(np.array(series), site, length) == pytest.approx(onset, rel=2e-10, abs=1e-14)


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


def pressed(gap: float, side: int = 1) -> Cluster:
    """The mass of ``oscillator`` on a stop without modes at ``gap`` on one side."""
    cluster, _ = oscillator()
    cluster.contacts["mode"] = side * PERMANENT
    cluster.contacts["clearance"] = cluster.contacts["clearance_minus"] = gap
    cluster.contacts["scale"] = 0.5
    # Accelerations need a second term, which is zero: the mass is free between its contacts.
    response = np.append(cluster.response, np.zeros((1, 1, 1)), axis=2)
    zeros = np.zeros((2, 1, 4))
    return cluster._replace(
        response=response, taylor=zeros[0], moments=zeros[1], nodes=collocation(4), trial=create_trial(1, 2)
    )


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("gap", [0.0, -0.3])
@pytest.mark.parametrize(
    ("motion", "kink"),
    [
        ([0.2, -1.0], 0.2),
        ([-0.2, 1.0], 0.2),
        ([-0.2, -1.0], 2.0),
        ([0.2, 1.0], 2.0),
        ([1.2, -1.0], 2.0),
        # On the kink at the beginning: the direction decides, and it may come back.
        ([0.0, 1.0, -2.0], 0.5),
        ([0.0, -1.0, 2.0], 0.5),
        ([0.0, 1.0, 0.0], 2.0),
        ([0.0, -1.0, 0.0], 2.0),
        ([2e-11, -1.0, 2.0], 0.5),
        ([-2e-11, 1.0, -2.0], 0.5),
        ([1e-10, -1.0, 2.0], 1e-10),
        ([-1e-10, 1.0, -2.0], 1e-10),
        # The substep ends on it; it opens and closes inside; it touches from either side.
        ([1.0, -1.0], 2.0),
        ([-1.0, 1.0], 2.0),
        ([1.0 - 2e-11, -1.0], 2.0),
        ([1.0 - 1e-10, -1.0], 1.0 - 1e-10),
        ([0.16, -1.0, 1.0], 0.2),
        ([-0.16, 1.0, -1.0], 0.2),
        ([0.26, -1.0, 1.0], 2.0),
    ],
)
def test_a_kink_is_found_where_a_pressed_contact_opens_or_closes(side, gap, motion, kink):
    """``motion`` is the depth as a polynomial in the position within the substep."""
    cluster = pressed(gap, side)
    length = 0.5
    seconds = length * cluster.interval
    for out, s in ((cluster.site_motion, 0.0), (cluster.trial.site_motion, 1.0)):
        depth = np.polynomial.Polynomial(motion)
        out[0] = side * (depth(s) + gap), side * depth.deriv()(s) / seconds, side * depth.deriv(2)(s) / seconds**2
    assert first_kink(cluster, cluster.trial, length) == pytest.approx(kink, rel=1e-9)
    # Other contacts have modes, which are searched for elsewhere.
    cluster.contacts["mode"] = side * CLOSED
    assert first_kink(cluster, cluster.trial, length) == 2.0


@pytest.mark.parametrize("side", [1, -1])
def test_substeps_end_where_a_pressed_contact_opens_and_closes(side):
    """A mass pressed on a bilinear stop by a load P = k p: w'' = -omega^2 w while w > -p, then w'' = P/m, and back."""
    speed, depth, mass, rate = 0.13, 4e-6, 0.02, 3e4
    cluster = pressed(-depth, side)
    h = cluster.interval
    cluster.contacts["preload"] = side * mass * rate**2 * depth
    cluster.taylor[0, 1] = -side * speed * h
    cluster.state["length"] = 1.0
    assert advance_cluster(cluster) == DONE

    # The phase at which it opens, the time in the air, and the rest of the step on the stop again.
    opening = np.arcsin(depth * rate / speed) / rate
    rebound = np.sqrt(speed**2 - (depth * rate) ** 2)
    flight = 2 * rebound / (rate**2 * depth)
    remaining = h - opening - flight
    assert remaining > 0
    w = -depth * np.cos(rate * remaining) + rebound / rate * np.sin(rate * remaining)
    v = rate * depth * np.sin(rate * remaining) + rebound * np.cos(rate * remaining)
    assert cluster.taylor[0, 0] == pytest.approx(side * w, abs=1e-10 * depth)
    assert cluster.taylor[0, 1] / h == pytest.approx(side * v, abs=1e-10 * speed)
    assert cluster.state["position"] == 1.0


def test_a_tape_knows_the_substep_in_which_a_contact_begins():
    """The onset, and the position at which the substep begins, were summed in another order."""
    cluster, _ = oscillator()
    h = cluster.interval
    cases = [(0.0, 3e-3, (3e-3 - 1e-9) * h, 0), (0.0, 3e-3, (3e-3 + 1e-9) * h, 0)]
    for begin, position in ((0.0, 3e-3), (0.7, 0.25), (40.0, 0.999)):
        time = begin + position * h
        # Two roundings of the time, or of the step, either way; and a substep of the shortest length after the onset.
        slip = 2.0 * max(np.spacing(time), np.spacing(h))
        cases += [(begin, position, time, 1), (begin, position, time - slip, 1), (begin, position, time + slip, 1)]
    tape = create_tape(1, len(cases), NODES)
    cluster = cluster._replace(tape=tape)
    for begin, position, onset, _ in cases:
        cluster.state["begin"], cluster.state["position"] = begin, position
        cluster.history["onset"] = onset
        write_on_tape(cluster, cluster.trial, Substep(PLAIN, 1e-3))
    assert tape.rows["onset"][0].tolist() == [expected for *_, expected in cases]


def test_a_tape_holds_the_closed_sites_of_a_substep_and_counts_rows_beyond_its_end():
    cluster, _ = oscillator()
    tape = create_tape(1, 2, NODES)
    # Two sites, of which the second one is closed.
    cluster = cluster._replace(
        contacts=cluster.contacts.repeat(2),
        site_motion=np.array([[9.0, 9.0, 9.0], [1.0, 2.0, 3.0]]),
        history=cluster.history.repeat(2),
        tape=tape,
    )
    cluster.state["begin"], cluster.state["position"] = 0.3, 0.25
    cluster.contacts["approach"] = 9.0, 0.75
    trial = create_trial(2, 1)._replace(closed=np.array([1]))
    trial.w[1], trial.v[1] = np.arange(NODES), -np.arange(NODES)
    for kind in (ONSET, EXIT, PLAIN):
        write_on_tape(cluster, trial, Substep(kind, 0.125))
    assert tape.used[0] == 3
    assert tape.rows["kind"].tolist() == [[ONSET, EXIT]]
    expected = {"begin": 0.3, "position": 0.25, "length": 0.125, "approach": 0.75, "rate": 2.0, "acceleration": 3.0}
    for name, value in (expected | {"site": 1, "mode": CLOSED}).items():
        assert (tape.rows[name] == value).all(), name
    np.testing.assert_array_equal(tape.motion[0, 1], [np.arange(NODES), -np.arange(NODES)])
    # Without rows nothing is written, and nothing counted.
    cluster = cluster._replace(tape=create_tape(1, 0))
    write_on_tape(cluster, trial, Substep(PLAIN, 0.125))
    assert cluster.tape.used[0] == 0


@pytest.mark.slow
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
