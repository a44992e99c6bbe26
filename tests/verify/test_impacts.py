"""Impacts against formulas: bouncing masses, rows of masses, beads, stops that touch at rest, the table of impacts."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from scipy.optimize import brentq

import vipetsc
from tests.conftest import run_of, simulated
from vipetsc.case import Case, CaseError, Sweep
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory

EXAMPLES = Path(vipetsc.__file__).parent / "examples"
ENGINES = ["ts", "propagator"]
GRAVITY = 2.0  # m/s^2
RAMP = 0.1  # s


def merged(table: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return ``table`` with the sections of ``changes``, key by key; None removes a key."""
    sections = table | {name: table.get(name, {}) | values for name, values in changes.items()}
    return {name: {k: v for k, v in part.items() if v is not None} for name, part in sections.items()}


def ball(restitution: float, engine: str = "ts", **changes: dict[str, Any]) -> Case:
    """A free mass of 1 kg, 1 m above the ground, on which a constant force acts; its ramp takes 0.1 s."""
    table = {
        "lattice": {"cells": 1, "ends": "free", "cell": {"masses": [1.0], "springs": [], "contact": [1, 1]}},
        "contacts": {"law": "rigid", "restitution": restitution, "sites": [1], "pair": [0, 1]}
        | {"side": "minus", "clearance": 1.0},
        "drive": {"waveform": "step", "ramp": RAMP, "amplitude": -GRAVITY},
        "time": {"end": 4.0, "sample_interval": 0.05, "engine": engine},
        "output": {"forces": True, "points": [{"name": "ball", "cell": 1}]},
    }
    return Case.from_table(merged(table, changes))


def oscillator(restitution: float, frequency: float, **changes: dict[str, Any]) -> Case:
    """x'' + x = sin(frequency t), with a ramp, and a stop at x = 0."""
    spring = {"start": 1, "end": 1, "stiffness": 0.5, "next_cell": True}
    table = {
        "lattice": {"cells": 1, "cell": {"masses": [1.0], "springs": [spring]}},
        "contacts": {"law": "rigid", "restitution": restitution, "sites": [1], "pair": [0, 1]}
        | {"side": "plus", "clearance": 0.0},
        "drive": {"waveform": "harmonic", "amplitude": 1.0, "frequency": frequency},
        "time": {"end": 400.0, "sample_interval": 0.1, "engine": "ts"},
        "output": {"forces": True, "fields": []},
    }
    return Case.from_table(merged(table, changes))


def row(count: int, restitution: float, engine: str = "ts", **changes: dict[str, Any]) -> Case:
    """``count`` free masses of 1 kg that only meet one another; the first one moves at 1 m/s towards the others."""
    table = {
        "lattice": {"cells": count, "ends": "free", "cell": {"masses": [1.0], "springs": [], "contact": [1, 1]}},
        "contacts": {"law": "rigid", "restitution": restitution, "sites": [*range(1, count)], "pair": [1, 1]}
        | {"next_cell": True, "side": "minus", "clearance": 0.01},
        "initial": {"kind": "velocity", "cell": 1, "velocity": 1.0},
        "time": {"end": 0.5, "sample_interval": 0.01, "engine": engine},
        "output": {"forces": True},
    }
    return Case.from_table(merged(table, changes))


CELL = {
    "masses": [4e-3, 2e-3],
    "springs": [{"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True}, {"start": 1, "end": 2, "stiffness": 5e3}],
}


def joined(engine: str, sites: list[int], restitution: float, ends: str = "fixed", **changes: dict[str, Any]) -> Case:
    """24 cells whose first masses meet that of the next cell at ``sites``, under a strong burst."""
    table = {
        "lattice": {"cells": 24, "ends": ends, "cell": CELL, "damping": {"mass": 1.0}},
        "contacts": {"law": "rigid", "restitution": restitution, "sites": sites, "pair": [1, 1]}
        | {"next_cell": True, "side": "minus", "clearance": 1e-4},
        "drive": {"amplitude": 20.0, "frequency": 1000.0, "cycles": 6, "cell": 4},
        "time": {"engine": engine, "end": 0.05},
        "output": {"forces": True},
    }
    return Case.from_table(merged(table, changes))


def impacts(case: Case) -> tuple[dict[str, np.ndarray], Any]:
    """The log of a run, by name, and its dataset; the energies must balance to 1e-11 of the work."""
    result = simulate(case)
    assert result.complete, result.sentence
    data = result.dataset
    energy = {name: data[f"energy/{name}"].values for name in ("work", "dissipated", "kinetic", "spring", "contact")}
    residual = energy["work"] - energy["dissipated"] - energy["kinetic"] - energy["spring"] - energy["contact"]
    assert np.abs(residual).max() <= 1e-11 * energy["work"].max()
    names = ("site", "side", "onset", "separation", "approach_velocity", "impulse", "force", "loss", "indentation")
    return {name: data[f"impacts/{name}"].values for name in names}, data


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("restitution", [0.0, 0.5, 0.7])
def test_a_ball_bounces_in_a_geometric_series_and_rests(restitution, engine):
    """Speeds fall by r, the series ends 2 r v/(g (1 - r)) after the first impact; then the ball rests."""
    log, data = impacts(ball(restitution, engine, time={"end": 8.0}))
    speed = -log["approach_velocity"]
    count = len(speed)
    np.testing.assert_allclose(speed, speed[0] * restitution ** np.arange(count), rtol=1e-5)
    np.testing.assert_allclose(np.diff(log["onset"]), 2 * restitution * speed[:-1] / GRAVITY, rtol=1e-5)

    # All but the last one are over at once, and lose (1 - r^2) of their energy by the impulse (1 + r) v.
    np.testing.assert_array_equal(log["separation"][:-1], log["onset"][:-1])
    np.testing.assert_allclose(log["impulse"][:-1], (1 + restitution) * speed[:-1], rtol=1e-12)
    np.testing.assert_allclose(log["loss"][:-1], (1 - restitution**2) / 2 * speed[:-1] ** 2, rtol=1e-9, atol=1e-15)
    assert not log["indentation"].any()
    assert not log["force"][:-1].any()

    # The last one sticks where the next flight would be shorter than 1e-6 of the shortest period, here twice the ramp.
    end = log["onset"][0] + 2 * restitution * speed[0] / (GRAVITY * (1 - restitution))
    assert log["onset"][-1] == pytest.approx(end, abs=3e-6)
    assert np.isnan(log["separation"][-1])
    assert log["force"][-1] == pytest.approx(GRAVITY, rel=1e-12)
    assert log["impulse"][-1] == pytest.approx(speed[-1] + GRAVITY * (8.0 - log["onset"][-1]), rel=1e-9)
    forces = data["sites/force"].values[:, 0]
    assert forces[-1] == pytest.approx(-GRAVITY, rel=1e-12)
    assert data["displacement"].values[-1].item() == pytest.approx(-1.0, abs=1e-9)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_ball_without_loss_bounces_for_ever(engine):
    """With r = 1 all impacts have one speed v, are 2 v/g apart, and have the impulse 2 v."""
    log, _ = impacts(ball(1.0, engine, time={"end": 60.0}))
    speed = -log["approach_velocity"]
    assert len(speed) > 25
    np.testing.assert_allclose(speed, speed[0], rtol=1e-11)
    np.testing.assert_allclose(np.diff(log["onset"]), 2 * speed[0] / GRAVITY, rtol=1e-10)
    np.testing.assert_allclose(log["impulse"], 2 * speed[0], rtol=1e-11)
    assert not log["loss"].any()


@pytest.mark.parametrize("damping", ["exact", "paper"])
@pytest.mark.parametrize(("law", "least", "factor"), [("bilinear", 1e4, 100.0), ("hertz", 1e5, 1000.0)])
def test_stiff_stops_come_to_the_rigid_answer_with_the_duration_of_their_contact(law, least, factor, damping):
    """With r = 1 for any factor, else with the exact one: the difference goes with the first power of the duration."""
    restitution = {"exact": 0.8, "paper": 1.0}[damping]

    def run(**contacts: Any) -> Any:
        """Return the dataset of an oscillator with a clearance up to its fourth impact."""
        time = {"end": 20.0, "sample_interval": 0.01}
        changes = {"contacts": {"clearance": 0.05} | contacts, "output": {"fields": None}, "time": time}
        return run_of(oscillator(restitution, 2.4, **changes))

    rigid = run()
    differences = []
    durations = []
    for stiffness in (least, factor * least, factor**2 * least):
        stiff = run(law=law, stiffness=stiffness, damping=damping)
        assert stiff.sizes["episode"] == rigid.sizes["episode"] > 3
        differences.append(np.abs(stiff["displacement"].values - rigid["displacement"].values).max())
        durations.append(np.mean(stiff["impacts/separation"].values - stiff["impacts/onset"].values))
    powers = np.diff(np.log(differences)) / np.diff(np.log(durations))
    np.testing.assert_allclose(powers[-1], 1.0, atol=0.02)
    np.testing.assert_allclose(powers[0], 1.0, atol=0.06)
    assert differences[-1] < 2 * durations[-1]


def test_impacts_without_loss_leave_the_energy_of_a_run_as_it_is():
    """The energy of 16 masses drifts by rounding alone, as much with 19,000 impacts as without any."""
    spring = {"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True}
    errors = []
    for clearance, least in ((1e-3, 15_000), (1e3, 0)):
        case = Case.from_table({
            "lattice": {"cells": 16, "ends": "fixed", "cell": {"masses": [1.0], "springs": [spring]}},
            "contacts": {"law": "rigid", "restitution": 1.0, "sites": [3, 8, 11], "pair": [0, 1]}
            | {"clearance": clearance, "side": "both"},
            "drive": {"amplitude": 0.0},
            "initial": {"kind": "velocity", "cell": 1, "velocity": 1.0},
            "time": {"engine": "propagator", "end": 100.0, "sample_interval": 2e-3, "rtol": 1e-12},
            "output": {"stride": 1000},
        })  # fmt: skip
        statistics = simulate(case).statistics
        assert statistics["engine"] == "propagator"
        assert statistics["episodes"] >= least
        errors.append(statistics["ledger_error"])

    assert errors[0] < 1e-11
    assert abs(errors[0] - errors[1]) < 1e-12


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("clearance", [0.01, 0.0])
def test_equal_masses_exchange_their_velocities(clearance, engine):
    """The blow goes through the row: each mass hands its velocity on exactly, one after the other or at one instant."""
    log, data = impacts(row(6, 1.0, engine, contacts={"clearance": clearance}))
    np.testing.assert_array_equal(data["velocity"].values[-1].ravel(), [0, 0, 0, 0, 0, 1])
    np.testing.assert_array_equal(log["site"], [1, 2, 3, 4, 5])
    np.testing.assert_array_equal(log["impulse"], 1.0)
    np.testing.assert_allclose(log["onset"], clearance * np.arange(1, 6), rtol=1e-9)


@pytest.mark.parametrize("engine", ENGINES)
def test_masses_that_stick_go_on_together(engine):
    """Without restitution the first mass takes all others along: momentum is kept, losses are those of two bodies."""
    log, data = impacts(row(5, 0.0, engine))
    np.testing.assert_allclose(data["velocity"].values[-1].ravel(), 0.2, rtol=1e-12)
    # A long row needs thousands of blows at an instant before all of it moves alike.
    _, long = impacts(row(40, 0.0, engine, contacts={"clearance": 1e-5}, time={"end": 0.012, "sample_interval": 1e-3}))
    np.testing.assert_allclose(long["velocity"].values[-1].ravel(), 1 / 40, rtol=1e-9)
    # n masses at v = 1/n meet one at rest.
    n = np.arange(1, 5)
    np.testing.assert_allclose(-log["approach_velocity"], 1 / n, rtol=1e-9)
    np.testing.assert_allclose(log["loss"].sum(), 0.4, rtol=1e-9)


def squeezed(engine: str, restitution: list[float], stops: dict[str, Any]) -> Case:
    """Nine free masses on springs; a mass away from the drive has stops without clearance on either side.

    With these numbers the propagator found impacts without end before the wave arrives.
    """
    spring = {"start": 1, "end": 1, "stiffness": 71659.84644628169, "next_cell": True}
    table = {
        "lattice": {"cells": 9, "ends": "free", "cell": {"masses": [0.10012481406840146], "springs": [spring]}},
        "contacts": {"law": "rigid", "clearance": 0.0, "sites": stops["sites"]}
        | {"each": {"restitution": restitution} | {key: stops[key] for key in ("pair", "next_cell", "side")}},
        "drive": {"amplitude": 203.24667862356733, "frequency": 550.0, "cycles": 4, "cell": 5},
        "time": {"end": 0.06, "samples": 121, "engine": engine},
    }
    return Case.from_table(table)


BESIDE = {"sites": [1, 2], "pair": [[1, 1], [0, 1]], "next_cell": [True, False], "side": ["minus", "plus"]}
THREE = {
    "sites": [1, 2, 2],
    "pair": [[1, 1], [0, 1], [1, 1]],
    "next_cell": [True, False, True],
    "side": ["minus", "plus", "minus"],
}


@pytest.mark.parametrize(
    ("stops", "restitution"),
    [(BESIDE, [0.7, 0.7]), (BESIDE, [1.0, 0.0]), (BESIDE, [0.3, 0.9]), (THREE, [0.7, 0.3, 0.5])],
)
def test_masses_between_stops_without_clearance_wait_for_their_wave(stops, restitution):
    """The front of a wave, far below what is resolved, makes no endless impacts; both engines have one motion."""
    motions = []
    for engine in ENGINES:
        log, data = impacts(squeezed(engine, restitution, stops))
        u = data["displacement"].values[:, :, 0]
        scale = np.abs(u).max()
        for cell, joined_cells, side in zip(stops["sites"], stops["next_cell"], stops["side"], strict=True):
            w = u[:, cell] - u[:, cell - 1] if joined_cells else u[:, cell - 1]
            sign = 1 if side == "plus" else -1
            assert (sign * w).max() <= 1e-9 * scale
        assert len(log["site"]) < 200
        motions.append(u / scale)
    np.testing.assert_allclose(*motions, rtol=0, atol=1e-9)


def ring(engine: str) -> Case:
    """A ring of five cells with two stops without clearance in the driven one."""
    springs = [
        {"start": 3, "end": 1, "stiffness": 5.9e4, "next_cell": True, "damping": 2.0},
        {"start": 1, "end": 2, "stiffness": 2.9e4},
        {"start": 2, "end": 3, "stiffness": 5.3e4},
    ]
    each = {"pair": [[0, 2], [3, 1]], "side": ["minus", "minus"], "restitution": [1.0, 0.7]}
    return Case.from_table({
        "lattice": {"cells": 5, "ends": "periodic", "cell": {"masses": [0.13, 0.47, 0.11], "springs": springs}},
        "contacts": {"law": "rigid", "clearance": 0.0, "sites": [4, 4], "each": each},
        "drive": {"amplitude": 280.0, "frequency": 550.0, "cycles": 4, "cell": 4},
        "time": {"end": 0.02, "engine": engine},
    })  # fmt: skip


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("create", [ring, lambda engine: squeezed(engine, [1.0, 0.7], BESIDE)])
def test_a_site_that_touches_at_rest_is_logged_where_it_is_pushed(create, engine):
    """At a stop without clearance it sticks before the front of a wave arrives, which may pull."""
    impulse = simulate(create(engine)).dataset["impacts/impulse"].values
    assert impulse.size > 5
    assert impulse.min() > 1e-9 * impulse.max()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("clearance", [1e-12, 1e-15])
def test_a_clearance_may_be_as_small_as_the_rounding_of_the_motion(clearance, engine):
    table = {
        "lattice": {"cells": 40},
        "contacts": {"law": "rigid", "clearance": clearance, "restitution": 0.7},
        "drive": {"amplitude": 60.0},
        "time": {"end": 0.03, "engine": engine},
    }
    result = simulate(Case.from_table(table))
    assert result.complete, result.sentence
    assert result.statistics["landings"] < 1.2 * result.statistics["switches"]


PUSH = {"waveform": "step", "ramp": RAMP, "amplitude": 3.0, "cell": 1}
LOOP = {
    "lattice": {"cells": 1, "cell": {"masses": [1.0, 2.0, 3.0], "springs": [], "contact": [1, 2]}},
    "contacts": {"sites": [1, 1, 1], "pair": None, "next_cell": False, "each": {"pair": [[1, 2], [2, 3], [1, 3]]}},
}


@pytest.mark.parametrize(
    ("engine", "count", "changes", "reactions"),
    [
        ("ts", 6, {}, None),
        ("propagator", 30, {}, None),
        # The third stop bears nothing: the other two hold all three masses.
        ("ts", 3, LOOP, [2.5, 1.5, 0.0]),
        ("propagator", 3, LOOP, [2.5, 1.5, 0.0]),
    ],
)
def test_a_row_that_is_pushed_moves_as_one(engine, count, changes, reactions):
    """A force on the first of masses that touch: each stop bears what accelerates the masses behind it."""
    time = {"end": 0.3, "sample_interval": 0.02}
    touching = {"contacts": {"clearance": 0.0} | changes.get("contacts", {}), "drive": PUSH, "time": time}
    data = run_of(row(count, 0.0, engine, **(changes | touching)).varied(without=["initial"]))
    v = data["velocity"].values.reshape(len(data["time"]), -1)
    total = 6.0 if reactions else count
    np.testing.assert_allclose(v[-1], 3.0 * (0.3 - RAMP / 2) / total, rtol=1e-9)
    if reactions is None:
        reactions = 3.0 * (1 - np.arange(1, count) / count)
    np.testing.assert_allclose(np.abs(data["sites/force"].values[-1]), reactions, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("count", "restitution"), [(6, 0.5), (5, 0.9), (12, 0.0)])
def test_a_ring_of_masses_that_touch_goes_on_as_one(count, restitution, engine):
    """Nothing can part in a closed ring without gaps: after one blow all masses have its momentum in equal parts."""
    ring = {"lattice": {"ends": "periodic"}, "contacts": {"clearance": 0.0, "sites": [*range(1, count + 1)]}}
    _, data = impacts(row(count, restitution, engine, **ring))
    np.testing.assert_allclose(data["velocity"].values[1:].ravel(), 1 / count, rtol=1e-9)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_mass_that_is_held_to_its_stop_has_no_error_of_energy(engine):
    """Where no work is done the balance has nothing to miss."""
    result = simulate(ball(0.5, engine, contacts={"clearance": 0.0}))
    assert result.statistics["ledger_error"] < 1e-10
    assert not [warning for warning in result.warnings if "energy" in warning]


@pytest.mark.parametrize(("restitution", "frequency"), [(0.8, 2.4), (0.6, 2.6)])
def test_the_impact_oscillator_has_the_orbit_and_multipliers_of_its_formula(restitution, frequency):
    """One impact a period: V by Dux's formula; V comes to it as r and the trace of the jump times free motion say."""
    log, _ = impacts(oscillator(restitution, frequency))
    speed = log["approach_velocity"]
    period = 2 * np.pi / frequency
    r = restitution
    cot = 1 / np.tan(np.pi / frequency)
    exact = 1 / abs(1 - frequency**2) / np.hypot((1 - r) / (2 * frequency), (1 + r) * cot / 2)
    np.testing.assert_allclose(np.diff(log["onset"])[-5:], period, rtol=1e-9)
    assert speed[-1] == pytest.approx(exact, rel=1e-9)

    # The force at an impact is x'' there, from the formula of the orbit: V' before and after it differ by the velocity
    # alone. Saltation S = [[-r, 0], [s, -r]], s = (1 + r) x''/V, times the rotation of free motion by one period.
    saltation = np.array([[-r, 0.0], [(1 + r) * _acceleration(r, frequency, exact) / exact, -r]])
    free = np.array([[np.cos(period), np.sin(period)], [-np.sin(period), np.cos(period)]])
    of_period = saltation @ free
    # Deviations d_k obey d_(k+2) = trace d_(k+1) - det d_k; those that are small and above rounding count.
    d = speed - exact
    near = np.flatnonzero((np.abs(d[:-2]) < 1e-6 * exact) & (np.abs(d[:-2]) > 1e-8 * exact))
    assert len(near) > 5
    fit, *_ = np.linalg.lstsq(np.column_stack([d[near + 1], -d[near]]), d[near + 2], rcond=None)
    assert np.linalg.det(of_period) == pytest.approx(r**2, rel=1e-12)
    np.testing.assert_allclose(fit, [np.trace(of_period), r**2], atol=2e-5)


def _acceleration(r: float, frequency: float, speed: float) -> float:
    """x'' at the impacts of the orbit of period 2 pi/frequency: the force there, as x = 0."""
    # x = P sin(omega t + phi) + a cos t + b sin t in a flight from t = 0, x = 0, x' = -r V to x = 0, x' = V.
    period = 2 * np.pi / frequency
    c = np.cos(period)
    s = np.sin(period)
    forced = 1 / (1 - frequency**2)
    # Unknowns a, b, p = forced sin(phi), q = forced frequency cos(phi): the forced part has equal values at both ends.
    matrix = [[1, 0, 1, 0], [0, 1, 0, 1], [c, s, 1, 0], [-s, c, 0, 1]]
    _, _, p, q = np.linalg.solve(matrix, [0, -r * speed, 0, speed])
    assert np.hypot(p, q / frequency) == pytest.approx(abs(forced), rel=1e-9)
    return float(p / forced)


def test_a_stuck_mass_leaves_where_its_reaction_turns_to_pull():
    """At the stop x = 0 the reaction is the force, sin(omega t) with its ramp: separations are where the sine falls."""
    log, data = impacts(oscillator(0.0, 1.5, time={"end": 60.0, "sample_interval": 0.02}))
    assert len(log["onset"]) > 10
    phase = (1.5 * log["separation"][:-1] / np.pi) % 2
    np.testing.assert_allclose(phase, 1.0, atol=1e-7)
    t = data["time"].values
    forces = data["sites/force"].values[:, 0]
    # The force on the host, the ground; a site that just opened or closes has none.
    stuck = np.zeros(len(t), bool)
    for onset, separation in zip(log["onset"][1:-1], log["separation"][1:-1], strict=True):
        stuck |= (t > onset + 1e-6) & (t < separation - 1e-6)
    later = stuck & (t > 45.0)  # beyond the ramp
    assert np.count_nonzero(later) > 10
    np.testing.assert_allclose(forces[later], np.sin(1.5 * t[later]), atol=1e-9)


def test_the_exponent_of_the_impact_oscillator_is_that_of_its_multipliers():
    """Both multipliers of the stable orbit have the magnitude r: lambda = log(r)/period."""
    result = simulate(oscillator(0.8, 2.4, output={"lyapunov": True}))
    assert result.statistics["lyapunov"] == pytest.approx(np.log(0.8) * 2.4 / (2 * np.pi), rel=0.1)


def test_a_sweep_has_rigid_stops_beside_others():
    """Each law takes its own of the keys that all members have."""
    table = row(2, 1.0).varied_table()
    table["contacts"] |= {"damping": "exact", "exponent": 1.2}
    table["contacts"]["each"] = {"stiffness": [1e9]}
    table["sweep"] = {"contacts": {"law": ["rigid", "bilinear", "power"]}}
    sweep = Sweep.from_table(table)
    laws = [member.case.contacts for member in sweep.members()]
    assert [law.law for law in laws] == ["rigid", "bilinear", "power"]
    assert [law.each and law.each.stiffness for law in laws] == [None, [1e9], [1e9]]
    assert [law.exponent for law in laws] == [None, None, 1.2]


def test_a_sweep_leaves_out_the_parameters_of_a_registered_law():
    """A shipped law takes none of them, a rigid stop no stiffness either."""
    table = tomllib.loads((EXAMPLES / "own-law.toml").read_text())
    table["plugins"]["modules"] = [str(EXAMPLES / "own_law.py")]
    table["sweep"] = {"contacts": {"law": ["rubber-stop", "bilinear", "rigid"]}}
    members = list(Sweep.from_table(table).members())
    assert not [problem for member in members for problem in member.problems]
    contacts = [member.case.contacts for member in members]
    assert [law.parameters for law in contacts] == [{"b": 1e7}, None, None]
    assert [law.stiffness for law in contacts] == [2e5, 2e5, None]


def test_a_motion_beyond_the_stop_is_refused():
    """A rigid stop that a mass has passed at t = 0 cannot push it back."""
    nothing = {"waveform": None, "amplitude": 0.0, "frequency": None}
    case = oscillator(0.5, 1.5, initial={"kind": "mode", "number": 1, "amplitude": 0.5}, drive=nothing)
    with pytest.raises(CaseError, match="beyond its rigid stop"):
        simulate(case)


def effective_restitution(r: float) -> float:
    """The restitution e of x'' = -k x^n (1 + c x'/v0) with c = 3 (1 - r)/2, by separation of x and v = x'.

    From v dv/(1 + c v/v0) = -k x^n dx, the integral of the left side from v0 to -e v0 is zero.
    """
    c = 1.5 * (1 - r)

    def imbalance(e: float) -> float:
        return 1 - np.log1p(c) / c + e + np.log1p(-c * e) / c

    return brentq(imbalance, 1e-9, min(1, 1 / c) - 1e-12)


def test_many_conservative_hertzian_contacts_keep_the_energy():
    """The energy error after some 400 onsets and separations of soft lossless stops, which adds up, is below 1e-8."""
    springs = [{"start": 1, "end": 2, "stiffness": 1e4}, {"start": 2, "end": 1, "stiffness": 1e4, "next_cell": True}]
    contacts = {"law": "hertz", "stiffness": 3.5e6, "restitution": 1.0, "side": "plus", "clearance": 5.2e-5}
    case = Case.from_table({
        "lattice": {"cells": 2, "cell": {"masses": [1e-3, 2e-3], "contact": [1, 2], "springs": springs}},
        "contacts": contacts | {"sites": [1, 2]},
        "drive": {"amplitude": 30.0, "cycles": 4, "frequency": 2500.0},
        "time": {"end": 0.1, "sample_interval": 1e-4, "engine": "ts"},
    })  # fmt: skip

    _, result = simulated(case)

    assert result.statistics["switches"] > 400
    # The error would be 3.2e-8 if the first step of each contact were taken in time and not in its square root.
    assert result.statistics["ledger_error"] < 1e-8


MASSES = [1e-3, 2e-3]  # kg
STIFFNESS = 1e4  # N/m, of both springs of a cell
CHAIN_CELLS = 20
SITE = 10
DRIVE = {"amplitude": 10.0, "cycles": 2, "frequency": 2e3}
HERTZ = {"law": "hertz", "stiffness": 1e6}


def sprung_case(engine: str = "ts", **contacts: object) -> Case:
    """The case of a two-mass chain under a burst, with one site that has one stop without clearance."""
    springs = [
        {"start": 1, "end": 2, "stiffness": STIFFNESS},
        {"start": 2, "end": 1, "stiffness": STIFFNESS, "next_cell": True},
    ]
    return Case.from_table({
        "lattice": {"cell": {"masses": MASSES, "contact": [1, 2], "springs": springs}, "cells": CHAIN_CELLS},
        "contacts": HERTZ | {"clearance": 0.0, "side": "plus", "sites": [SITE]} | contacts,
        "drive": DRIVE,
        "time": {"end": 0.02, "sample_interval": 2e-4, "engine": engine},
    })  # fmt: skip


def run_complete(case: Case) -> xr.Dataset:
    """The run of a case; asserts that it is complete, by the engine that the case names, and that its ledger closes."""
    memory = RunMemory(MPI.COMM_SELF)
    result = simulate(case, memory)
    assert result.complete, result.sentence
    # An engine that refuses a case is replaced by the other one, which would be compared with itself.
    assert result.statistics["engine"] == case.time.engine

    run = memory.dataset
    stored = run["energy/kinetic"] + run["energy/spring"] + run["energy/contact"] + run["energy/dissipated"]
    # A contact that begins or ends at a wrong time would show in the balance.
    assert np.abs(run["energy/work"] - stored).max() < 1e-8 * run["energy/work"].max()
    return run


def test_the_front_of_a_wave_is_no_impact_on_a_stop_with_loss():
    """Both engines log one impact, from rest: the front of a strike 6 and 16 cells away, 1e-26 m/s or less, is none."""
    runs = []
    for engine in ("ts", "propagator"):
        case = sprung_case(engine, restitution=0.6, approach_floor=1e-3, stiffness=1e7, sites=[3, 13])
        struck = {"kind": "velocity", "cell": 19, "velocity": 0.3}
        end = {"end": 4e-3, "sample_interval": 1e-4}
        runs.append(run_complete(case.varied(drive={"amplitude": 0.0}, initial=struck, time=end)))
    for run in runs:
        assert run["impacts/site"].values.tolist() == [2]
        assert run["impacts/approach_velocity"].values.tolist() == [0.0]
    first, second = runs
    assert first["impacts/onset"].values == pytest.approx(second["impacts/onset"].values, rel=1e-6)
    assert first["impacts/indentation"].values == pytest.approx(second["impacts/indentation"].values, rel=1e-6)


@pytest.mark.parametrize(("law", "bound"), [("bilinear", 1e-9), ("hertz", 1e-8)])
@pytest.mark.parametrize("precompression", [1e-7])
def test_steps_end_where_pressed_contacts_open_and_close(law, bound, precompression):
    """The energy error of a ring of beads that part and meet a hundred times is small, as steps end at each change.

    Changes within steps would leave errors of 1e-8 to 5e-7.
    """
    springs = [{"start": 1, "end": 2, "stiffness": 1e2}, {"start": 2, "end": 1, "stiffness": 1e2, "next_cell": True}]
    each = {"pair": [[1, 2]] * 2 + [[2, 1]] * 2, "next_cell": [False] * 2 + [True] * 2}
    stiffness = {"hertz": 1e9, "bilinear": 1e6}[law]
    contacts = {"law": law, "stiffness": stiffness, "clearance": 0.0, "side": "minus", "sites": [1, 2, 1, 2]}
    if precompression:
        contacts["precompression"] = precompression
    case = Case.from_table({
        "lattice": {"cells": 2, "ends": "periodic", "cell": {"masses": MASSES, "springs": springs}},
        "contacts": contacts | {"each": each},
        "drive": {"amplitude": 1.0, "cycles": 1, "frequency": 2e4},
        "time": {"end": 5e-3, "sample_interval": 1e-5, "engine": "ts"},
    })  # fmt: skip

    _, result = simulated(case)

    assert result.statistics["landings"] > 80
    assert result.statistics["ledger_error"] < bound


@pytest.mark.parametrize("side", ["plus", "minus"])
def test_a_mass_that_leaves_a_bilinear_stop_and_comes_back_has_the_exact_motion(side):
    """A mass pressed to a bilinear stop by a load P = k d bounces as in closed form.

    On the stop, u > -d, its motion is u'' = -omega^2 u; away from the stop it is u'' = P/m.
    """
    mass = 0.02
    omega = 3e4
    depth = 4e-6
    speed = 0.13
    sign = 1 if side == "plus" else -1
    stop = {"law": "bilinear", "stiffness": mass * omega**2, "side": side, "clearance": 0.0, "precompression": depth}
    # The mass needs neighbours to be a lattice; they pull at it with 1e-13 of the load.
    weak = {"start": 1, "end": 1, "stiffness": 1e-6, "next_cell": True}
    case = Case.from_table({
        "lattice": {"cell": {"masses": [mass], "springs": [weak]}, "cells": 4, "ends": "free"},
        "contacts": stop | {"sites": [2], "pair": [0, 1]},
        "initial": {"kind": "velocity", "cell": 2, "velocity": -sign * speed},
        "drive": {"amplitude": 0.0, "frequency": omega},
        "time": {"end": 3e-3, "sample_interval": 1e-4, "engine": "propagator", "rtol": 1e-10},
    })  # fmt: skip

    dataset, result = simulated(case)
    assert result.statistics["engine"] == "propagator"

    # On the stop u = A sin(phase), and the mass leaves where the sine is -d/A. It comes back as fast as it left.
    amplitude = speed / omega
    leaving = np.arcsin(depth / amplitude)
    rebound = np.sqrt(speed**2 - (depth * omega) ** 2)
    flight = 2 * rebound / (omega**2 * depth)
    period = flight + (np.pi + 2 * leaving) / omega

    times = dataset["time"].values
    begin = times < leaving / omega
    t = np.where(begin, 0.0, times - leaving / omega) % period
    in_the_air = -depth - rebound * t + 0.5 * omega**2 * depth * t**2
    on_the_stop = amplitude * np.sin(omega * (t - flight) - leaving)
    expected = np.where(begin, -amplitude * np.sin(omega * times), np.where(t < flight, in_the_air, on_the_stop))
    assert times[-1] > 10 * period
    found = sign * dataset["displacement"].values[:, 1, 0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * amplitude)


M = 1e-3  # kg
A = 1e9  # N/m^1.5


def beads(path, u, v, end, samples, frequency=1e4, lattice=None, rtol=1e-10, engine="ts", **contacts):
    """The run of beads with Hertz contacts from displacements ``u`` (cell,) in m and velocities ``v`` (cell,) in m/s.

    ``contacts`` updates the table [contacts]; the energy balance of the run is asserted.
    """
    n = max(np.size(u), np.size(v))
    u = np.broadcast_to(u, n)[:, None]
    v = np.broadcast_to(v, n)[:, None]
    state = xr.Dataset(
        {"displacement": (("cell", "dof"), u), "velocity": (("cell", "dof"), v)},
        coords={"cell": np.arange(1, n + 1), "dof": [1]},
    )
    state.to_netcdf(path / "state.nc", format="NETCDF4", engine="h5netcdf")

    lattice = {"cell": {"masses": [M]}, "cells": n, "ends": "free"} | (lattice or {})
    # On a ring the last bead touches the first.
    joints = n if lattice["ends"] == "periodic" else n - 1
    joined = {"law": "hertz", "stiffness": A, "next_cell": True, "side": "minus", "clearance": 0.0}
    table = {
        "lattice": lattice,
        "contacts": joined | {"sites": list(range(1, joints + 1))} | contacts,
        "time": {"end": end, "samples": samples, "rtol": rtol, "engine": engine},
        "drive": {"amplitude": 0.0, "frequency": frequency},
        "initial": {"kind": "file", "path": str(path / "state.nc")},
    }
    run, result = simulated(Case.from_table(table))
    assert result.statistics["engine"] == engine

    spent = run["energy/kinetic"] + run["energy/spring"] + run["energy/contact"] + run["energy/dissipated"]
    # The energy of pressed contacts at rest is subtracted, which leaves its rounding error.
    rounding = 1e-14 * n * A * contacts.get("precompression", 0.0) ** 2.5
    assert np.abs(run["energy/work"] - spent).max() < 1e-8 * run["energy/work"].max() + rounding
    return run


@pytest.mark.parametrize(("ends", "turns"), [("periodic", 2), ("free", 1)])
def test_a_pressed_chain_has_the_dispersion_of_its_linearised_contacts(tmp_path, ends, turns):
    """A small wave has omega = 2 sqrt(k/m) sin(kappa/2) with k = (3/2) A d^(1/2) (Nesterenko 2001, sec. 1.2)."""
    n = 12
    depth = 1e-5
    # The amplitude is so small that the contacts are linear to 1e-6.
    amplitude = 1e-11
    kappa = np.pi * 2 * turns / n
    k = 1.5 * A * depth**0.5
    omega = 2 * np.sqrt(k / M) * np.sin(kappa / 2)
    shape = np.cos(kappa * (np.arange(n) + 0.5))

    run = beads(
        tmp_path,
        u=amplitude * shape,
        v=0.0,
        end=5 * 2 * np.pi / omega,
        samples=101,
        frequency=omega,
        lattice={"ends": ends},
        precompression=depth,
    )

    expected = amplitude * np.cos(omega * run["time"].values)[:, None] * shape
    assert np.abs(run["displacement"].values[:, :, 0] - expected).max() < 1e-5 * amplitude

    # Every contact is closed from t = 0 on.
    force = run["impacts/force"].values
    assert len(force) == n - (ends == "free")
    assert force == pytest.approx(A * depth**1.5, rel=1e-5)


def peak_time(time: np.ndarray, values: np.ndarray) -> float:
    """The time in s of the largest value, the vertex of a parabola through the largest sample and its neighbours."""
    largest = int(values.argmax())
    before, peak, after = values[largest - 1 : largest + 2]
    shift = (before - after) / (2 * (before - 2 * peak + after))
    return time[largest] + shift * (time[1] - time[0])


def test_a_struck_chain_sends_a_solitary_wave(tmp_path):
    """The solitary wave is 1.2 % faster than Nesterenko's long wave, and five beads move in it.

    Nesterenko's speed V = 0.6802 a (2E/(a rho^(3/2) (1 - nu^2)))^(1/3) F^(1/6) is the variable ``theory``, in beads per
    second. SciPy's DOP853 on 40 beads, in units of A = m = 1, gives V = 0.90552 F^(1/6), and speeds of 0.0087, 0.326,
    1, 0.326, 0.0087 of the largest.
    """
    n = 40
    run = beads(tmp_path, u=0.0, v=np.append(0.1, np.zeros(n - 1)), end=3.0e-3, samples=4001)

    # Between beads 15 and 30 the wave is steady.
    force = run["impacts/force"].values[np.argsort(run["impacts/site"].values)]
    assert np.ptp(force[15:30]) < 1e-3 * force[20]

    time = run["time"].values
    v = run["velocity"].values[:, :, 0]
    wave = 15 / (peak_time(time, v[:, 30]) - peak_time(time, v[:, 15]))
    theory = np.sqrt(0.8) * A ** (1 / 3) * force[20] ** (1 / 6) / np.sqrt(M)
    assert wave / theory == pytest.approx(1.0124, abs=5e-4)
    centred = v[int(v[:, 20].argmax())]
    assert (centred > 0.005 * centred.max()).sum() == 5


@pytest.mark.parametrize("engine", ["ts", "propagator"])
@pytest.mark.parametrize(("end", "interval"), [(1.7e-3, 0.9e-3)])
def test_an_impact_between_the_last_whole_interval_and_the_end_is_seen(engine, end, interval):
    """Two beads meet after 1 ms: the run lasts to its end, with its last sample there, and has the impact."""
    case = Case.from_table(
        {
            "lattice": {"cells": 2, "ends": "free", "cell": {"masses": [2.05e-3]}},
            "contacts": {
                "law": "hertz",
                "stiffness": 7.4e9,
                "restitution": 0.9,
                "damping": "exact",
                "sites": [1],
                "next_cell": True,
                "side": "minus",
                "clearance": 1e-3,
            },
            "initial": {"kind": "velocity", "cell": 1, "velocity": 1.0},
            "time": {"end": end, "sample_interval": interval, "engine": engine},
        }
    )
    run = simulated(case)[0]
    assert run["time"].values[-1] == pytest.approx(end, rel=1e-12)
    assert np.diff(run["time"].values) == pytest.approx(run["time"].values[1], rel=1e-9)
    assert run["velocity"].values[-1, :, 0] == pytest.approx([0.05, 0.95], abs=2e-3)


# A mass between soft springs, which meets a stop at its largest speed.
MASS = 2e-3
SPEED = 0.3


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    ("law", "restitution", "damping"),
    [
        ("hertz", 1.0, "exact"),
        ("hertz", 0.6, "exact"),
        ("bilinear", 0.8, "exact"),
        ("hertz", 0.7, "paper"),
        ("bilinear", 0.3, "paper"),
    ],
)
def test_the_impulse_and_the_loss_of_an_impact_are_those_of_its_restitution(engine, law, restitution, damping):
    """A mass that comes with v and leaves with -e v has got m (1 + e) v, less what its springs gave it meanwhile."""
    springs = [{"start": 1, "end": 1, "stiffness": 1.0, "next_cell": True}]
    contacts = {"law": law, "stiffness": {"hertz": 1e9, "bilinear": 1e6}[law], "restitution": restitution}
    contacts |= {"damping": damping, "sites": [1], "pair": [0, 1], "side": "plus", "clearance": 0.0}
    case = Case(
        lattice={"cells": 1, "cell": {"masses": [MASS], "springs": springs}},
        contacts=contacts,
        initial={"kind": "velocity", "cell": 1, "velocity": SPEED},
        time={"end": 2e-3, "sample_interval": 5e-5, "engine": engine},
    )
    result = simulate(case)
    (impact,) = vipetsc.impacts(result).itertuples()
    pd.testing.assert_frame_equal(vipetsc.impacts(result), vipetsc.impacts(result.dataset))
    e = restitution if damping == "exact" else effective_restitution(restitution)
    assert impact.impulse == pytest.approx(MASS * (1 + e) * SPEED, rel=1e-5)
    assert impact.loss == pytest.approx(MASS * SPEED**2 * (1 - e**2) / 2, rel=1e-5, abs=1e-12)
    # The paper's factor is derived for r near 1: its effective restitution differs from r by the order (1 - r)^2.
    assert abs(e - restitution) < (1 - restitution) ** 2 or e == restitution
    assert (impact.cell, impact.side) == (1, 1)


@pytest.mark.parametrize("law", ["hertz", "bilinear", "rigid"])
@pytest.mark.parametrize("clearance", [0.01, 0.03])
def test_an_onset_at_the_border_of_two_steps_is_an_impact(law, clearance):
    """The log has the full approach velocity of a mass that comes to its stop where a step of the engine ends."""
    stiffness = {"law": law}
    if law != "rigid":
        stiffness["stiffness"] = 1e6
    run = simulate(row(8, 0.5, "propagator", contacts={"clearance": clearance, "sites": [1]} | stiffness))
    # The mass moves at 1 m/s.
    steps = clearance / run.statistics["interval"]
    assert steps == pytest.approx(round(steps), rel=1e-12)
    log = vipetsc.impacts(run)
    np.testing.assert_allclose(log["onset"], clearance, rtol=1e-12)
    np.testing.assert_allclose(log["approach_velocity"], -1.0, rtol=1e-12)


def test_a_table_of_impacts_has_what_each_moved_between_bands(in_process, tmp_path):
    """Each impact has its cluster; one alone in it has the cluster's transfers, which ``export`` writes with units."""
    case = Case(lattice={"cells": 30}, contacts={"sites": [6, 7]}, drive={"amplitude": 60.0, "cycles": 4})
    simulate(case, tmp_path / "run")
    assert in_process("analyse", tmp_path / "run").returncode == 0
    table = vipetsc.impacts(tmp_path / "run")

    with vipetsc.open(tmp_path / "run" / "analysis.h5") as analysis:
        names = analysis["bands/part"].values.tolist()
        assert "band 2" in names
        alone = table.groupby("cluster").filter(lambda rows: len(rows) == 1)
        assert len(alone) > 0
        for part in names:
            moved = analysis["bands/transfer"].sel({"bands/part": part}).values
            assert alone[f"transfer to {part}"].tolist() == moved[alone["cluster"] - 1].tolist()
    crowded = table.index.difference(alone.index)
    assert len(crowded) > 1
    assert table.loc[crowded, "transfer to band 2"].isna().all()

    assert in_process("export", tmp_path / "run").returncode == 0
    written = pd.read_csv(tmp_path / "run/curves/run-impacts.csv", float_precision="round_trip")
    assert written["impulse (N s)"].tolist() == table["impulse"].tolist()
    assert written["transfer to band 2 (J)"].dropna().tolist() == table["transfer to band 2"].dropna().tolist()
    assert written["cell"].tolist() == table["cell"].tolist()
