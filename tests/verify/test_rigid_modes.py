"""Nonlinear normal modes with rigid stops: formulas, jumps of the derivative, an independent integration."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from vipetsc.case import CaseError, NnmCase
from vipetsc.endings import Ending
from vipetsc.lattice import Contact
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.orbits import ShootingMethod
from vipetsc.modes.flow import Dop853Flow
from vipetsc.modes.problem import FlowError
from vipetsc.modes.system import ContactPair, System

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


def test_the_cell_of_the_built_in_lattice_has_rigid_modes():
    """Both modes of the reduced model reach their stops, and their frequencies rise from there on."""
    table = {"name": "four-band", "contacts": {"law": "rigid"}, "nnm": {"points": 80}}
    for branch in follow_all(NnmCase.from_table(table), None, MPI.COMM_SELF):
        struck = [point for point in branch.regular() if point.episodes]
        assert len(struck) > 10, branch.ended.sentence
        frequencies = [point.frequency for point in struck]
        assert frequencies[-1] > frequencies[0] > branch.points[0].frequency


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"contacts": {"restitution": 0.9}}, "contacts.restitution"),
        ({"nnm": {"method": "balance"}}, "nnm.method"),
        ({"nnm": {"method": "damped"}}, "nnm.method"),
        ({"nnm": {"chart": "auto"}}, "nnm.chart"),
        ({"contacts": {"each": {"law": ["rigid"], "restitution": [0.5]}}}, "contacts.each.restitution"),
    ],
)
def test_what_has_no_modes_with_rigid_stops_is_refused(changes, key):
    """Impacts that take energy, harmonics of impulses, and arcs that begin at an impact."""
    table = one_mass()
    for section, values in changes.items():
        table[section] = table[section] | values
    with pytest.raises(CaseError) as error:
        NnmCase.from_table(table)
    assert [problem.key for problem in error.value.problems] == [key]


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
