"""Stops that do not yield, against formulas: bouncing masses, rows of equal masses, the impact oscillator."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.conftest import run_of, small_case
from vipetsc.case import Case, CaseError, Sweep
from vipetsc.dynamics import simulate

pytestmark = pytest.mark.parallel(1)

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


def pairs(engine: str, restitution: float) -> Case:
    """The small lattice of the tests, with rigid stops on both sides of borders of ranks."""
    contacts = {"law": "rigid", "restitution": restitution, "sites": [6, 12, 13, 18], "clearance": 2e-4}
    return small_case(contacts=contacts, time={"engine": engine}, output={"forces": True})


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


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"contacts": {"stiffness": 1e5}}, "contacts.stiffness"),
        ({"contacts": {"modulus": 1e8, "radius": 0.01, "poisson": 0.3}}, "contacts.modulus"),
        ({"contacts": {"damping": "exact"}}, "contacts.damping"),
        ({"contacts": {"adhesion": "clip"}}, "contacts.adhesion"),
        ({"contacts": {"approach_floor": 0.1}}, "contacts.approach_floor"),
        ({"contacts": {"clearance": 0.0, "precompression": 1e-3}}, "contacts.precompression"),
    ],
)
def test_keys_of_stops_that_yield_are_refused(changes, key):
    """A rigid stop has a restitution and nothing else."""
    with pytest.raises(CaseError) as error:
        ball(0.5, **changes)
    assert key in [problem.key for problem in error.value.problems]
    assert "rigid" in str(error.value)


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


def test_a_motion_beyond_the_stop_is_refused():
    """A rigid stop that a mass has passed at t = 0 cannot push it back."""
    nothing = {"waveform": None, "amplitude": 0.0, "frequency": None}
    case = oscillator(0.5, 1.5, initial={"kind": "mode", "number": 1, "amplitude": 0.5}, drive=nothing)
    with pytest.raises(CaseError, match="beyond its rigid stop"):
        simulate(case)
