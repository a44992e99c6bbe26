"""Frequency responses of rigs against dense solutions, closed forms, runs and integration in time."""

from __future__ import annotations

import copy
import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vipetsc
from tests.conftest import run_of
from tests.rigs import OUTPUT, TWO_MASSES, followed, rate_of
from tests.steady_states import motion_at, nfrc_case
from vipetsc.case import Case
from vipetsc.case.nfrc import NfrcCase
from vipetsc.cli.case_rows import lattice_rows
from vipetsc.cli.main import main
from vipetsc.figures.registry import draw
from vipetsc.io.export import write_curves
from vipetsc.io.read import open_results
from vipetsc.lattice import Chain, ModalCompliance, Spring, UnitCell, WaveCompliance
from vipetsc.lattice.damped import damped_bloch
from vipetsc.lattice.modes import linear_modes
from vipetsc.lattice.sites import Pair, sites_at
from vipetsc.modes.problem import FlowError
from vipetsc.modes.response.over_key import KeyedCase
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state


@pytest.fixture(scope="module")
def two_masses(tmp_path_factory):
    """The steady states of the rig of two masses, and the points of its curve."""
    # The range contains the first resonance, with two folds and a pair of multipliers that leaves the unit circle.
    first = TWO_MASSES | {"nfrc": TWO_MASSES["nfrc"] | {"range": [1.0, 1.5]}}
    return followed(NfrcCase.from_table(first), tmp_path_factory.mktemp("rig") / "two")


def rounded_cell(grounding: tuple[float, ...] = ()) -> UnitCell:
    """A cell of two masses with dashpots parallel to its springs, and ``grounding`` dashpots (N s/m) to the ground."""
    springs = (Spring(0, 0, 1.0, offset=1, damping=0.1), Spring(0, 1, 0.5, damping=0.02))
    return UnitCell((1.0, 0.3), springs, host=0, resonator=1, grounding=grounding)


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
@pytest.mark.parametrize("grounding", [(), (0.05, 0.2)])
def test_the_sum_over_poles_is_the_inverse_of_the_dynamic_stiffness(ends, grounding):
    """The compliance as a sum over poles is the inverse of K + i omega C - omega^2 M, also with rigid motions."""
    pairs = (Pair(0, 1), Pair(0, 0, offset=1))
    chain = Chain(rounded_cell(grounding), 5, ends, sites=sites_at([1, 3], pairs))
    compliance = ModalCompliance(chain, ((0, 0),))
    loads = compliance.loads
    for omega in (0.3, 1.1 - 0.2j, -0.7, 4.0):
        dynamic = chain.stiffness_matrix().toarray() + 1j * omega * chain.damping_rows(0, 5).toarray()
        u = np.linalg.solve(dynamic - omega**2 * np.diag(chain.masses()), loads)
        np.testing.assert_allclose(compliance.response(omega)[0], loads[:, :2].T @ u, rtol=1e-9, atol=1e-12)
        field = compliance.field(omega, [0.5, -2.0, 3.0], range(5))
        np.testing.assert_allclose(field.ravel(), u @ [-0.5, 2.0, 3.0], rtol=1e-9, atol=1e-12)


def test_without_dashpots_it_is_that_of_bloch_waves():
    """Without dashpots the compliance by poles is that by Bloch waves, and real."""
    cell = UnitCell((1.0, 0.3), (Spring(0, 0, 1.0, offset=1), Spring(0, 1, 0.5)), host=0, resonator=1)
    chain = Chain(cell, 9, "free", sites=sites_at([2, 6], cell.pair))
    omega = np.array([0.0, 0.31, 1.27, 2.9])
    modal = ModalCompliance(chain, ((0, 0),)).response(omega)
    waves = WaveCompliance(chain, points=((0, 0),)).response(omega)
    # The last column, of a force on one mass, is left out at rest: that force moves a free lattice without bound.
    np.testing.assert_allclose(modal[:, :, :2], waves[:, :, :2], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(modal[1:], waves[1:], rtol=1e-8, atol=1e-10)
    assert np.isrealobj(modal)


def test_a_force_that_touches_nothing_has_the_linear_response(two_masses):
    """Below contact a wall moved by U gives the first harmonic (K + i omega C - omega^2 M)^-1 k U."""
    states, points = two_masses
    quiet = [point for point in points if not point.measured.episodes]
    assert quiet
    chain = states.case.model().chain
    for point in quiet[::10]:
        omega, amplitude = states.drive(point.xi[-1])
        dynamic = chain.stiffness_matrix().toarray() + 1j * omega * chain.damping_rows(0, 2).toarray()
        u = np.linalg.solve(dynamic - omega**2 * np.eye(2), [amplitude * 1.5, 0.0])
        np.testing.assert_allclose(point.measured.harmonics[0, 1], u[0], rtol=1e-8)


def test_a_lossy_run_settles_into_the_response():
    """A run from rest with restitution 0.6 settles to the amplitudes of the response at its frequency."""
    table = TWO_MASSES | {"contacts": TWO_MASSES["contacts"] | {"restitution": 0.6}}
    frequency = 1.25
    period = 2 * np.pi / frequency
    run = run_of(
        Case.from_table(
            {
                **{key: table[key] for key in ("name", "lattice", "contacts")},
                "drive": table["drive"] | {"amplitude": 0.2, "frequency": frequency},
                "time": {"end": 90 * period, "sample_interval": period / 64, "rtol": 1e-10},
                "output": OUTPUT,
            }
        )
    )
    w = run["displacement"].values[-64:, 0, 0]
    settled = np.fft.rfft(w) / 32

    options = {"source": "force", "over": "amplitude", "range": [0.2, 0.3], "fixed": [frequency], "harmonics": 61}
    states = SteadyStates(NfrcCase.from_table(table | {"nfrc": options, "output": OUTPUT}), 0.6, frequency)
    measured = states.measured(first_state(states).xi)
    assert measured.episodes == 1
    assert measured.unstable == 0
    np.testing.assert_allclose(np.abs(measured.harmonics[0, 1:4]), np.abs(settled[1:4]), rtol=2e-4)

    # The records of named masses and of the lossy contact in the last period have the same peaks, up to the errors of
    # 64 samples in a period.
    for quantity, error in (("displacement", 2e-3), ("velocity", 4e-3), ("acceleration", 4e-2)):
        recorded = np.abs(run[f"points/{quantity}"].values[-64:]).max(axis=0)
        np.testing.assert_allclose(measured.outputs[f"peak_{quantity}"], recorded, rtol=error)
    assert measured.outputs["largest_force"] == pytest.approx(run["impacts/force"].values[-1], rel=5e-3)
    speeds = np.sqrt(np.mean(run["points/velocity"].values[-64:] ** 2, axis=0))
    assert measured.outputs["transmission"] == pytest.approx(speeds[1] / speeds[0], rel=1e-3)


def test_a_drive_that_moves_no_contact_has_no_unit_of_amplitude_and_a_motion_at_rest():
    """A force on masses that nothing joins to the contacts moves none: over the frequency these stay at rest."""
    spring = {"stiffness": 1.5, "next_cell": True}
    cell = {"masses": [1.0] * 3, "springs": [spring | {"start": mass, "end": mass} for mass in (1, 2, 3)]}
    table = {
        "lattice": {"cells": 2, "cell": cell | {"contact": [1, 2]}, "damping": {"mass": 0.06}},
        "contacts": {"law": "bilinear", "stiffness": 20.0, "restitution": 1.0, "sites": [1], "clearance": 0.8},
        "drive": {"waveform": "harmonic", "amplitude": 0.1, "frequency": 1.0, "cell": 1, "mass": 3},
        "time": {"end": 10.0},
    }
    nfrc = {"source": "force", "harmonics": 11}
    over_amplitude = NfrcCase.from_table(table | {"nfrc": nfrc | {"over": "amplitude", "range": [0.1, 1.0]}})
    with pytest.raises(FlowError, match="the drive moves no contact"):
        SteadyStates(over_amplitude, 1.0, 1.0)

    nfrc |= {"over": "frequency", "range": [0.5, 2.0], "fixed": [0.2]}
    states = SteadyStates(NfrcCase.from_table(table | {"nfrc": nfrc}), 1.0, 0.2)
    measured = states.measured(first_state(states).xi)
    assert measured.largest.tolist() == [0.0]
    assert measured.truncation == 0.0


POINTS = {"points": [{"name": "near", "cell": 1}, {"name": "far", "cell": 3}], "transmission": [["near", "far"]]}
OVER = {"source": "force", "over": "frequency", "range": [0.4, 2.6], "fixed": [0.2], "points": 45}
WALL = {"waveform": "harmonic", "amplitude": 0.1, "frequency": 1.0, "end": "left"}
FORCE = {"waveform": "harmonic", "amplitude": 0.1, "frequency": 1.0, "cell": 2, "mass": 1}


def table(**changes):
    """The rig of two masses, made three, without contacts, and with ``changes`` of its sections."""
    case = copy.deepcopy(TWO_MASSES)
    case["lattice"]["cells"] = 3
    del case["lattice"]["cell"]["contact"]
    return case | {"contacts": {"sites": []}, "output": POINTS, "nfrc": OVER} | changes


def curve_of(case: dict, folder):
    """The file of the only curve of a case, computed by the verb."""
    folder.mkdir(exist_ok=True)
    path = folder / "case.toml"
    path.write_text(NfrcCase.from_table(case).to_toml())
    assert main(["nfrc", str(path), "--out", str(folder / "out"), "--quiet"]) == 0
    (file,) = (folder / "out").glob("branch-*.h5")
    return open_results(file)


@pytest.mark.parametrize("damping", [0.06, 0.0])
@pytest.mark.parametrize("drive, ends", [(WALL, "fixed"), (FORCE, "fixed"), (FORCE, "free"), (FORCE, "periodic")])
def test_the_linear_response_is_the_dense_solution(drive, ends, damping, tmp_path):
    """Compares displacement, velocity, acceleration, phase and transmission of two masses on the whole grid."""
    case = table(drive=drive, nfrc=OVER | {"infinite": False})
    case["lattice"] |= {"ends": ends, "damping": {"mass": damping}}
    if not damping:
        del case["lattice"]["damping"]
    with curve_of(case, tmp_path) as curve:
        chain = NfrcCase.from_table(case).model().chain
        load = np.zeros(3)
        # The spring of the wall pulls with 1.5 N/m.
        load[0 if drive is WALL else 1] = 0.2 * (1.5 if drive is WALL else 1.0)
        omega = np.linspace(0.4, 2.6, 45)
        stiffness = chain.stiffness_matrix().toarray()
        loss = chain.damping_rows(0, 3).toarray()
        u = np.array([np.linalg.solve(stiffness + 1j * w * loss - w**2 * np.eye(3), load) for w in omega])[:, [0, 2]]

        np.testing.assert_allclose(curve["frequency"], omega)
        for power, quantity in enumerate(("displacement", "velocity", "acceleration")):
            size = np.abs(u) * omega[:, None] ** power
            np.testing.assert_allclose(curve[f"first_{quantity}"], size, rtol=1e-9)
            np.testing.assert_allclose(curve[f"peak_{quantity}"], size, rtol=1e-9)
        turned = np.exp(-1j * np.radians(curve["lag"].values))
        np.testing.assert_allclose(turned, u / np.abs(u), atol=1e-8)
        np.testing.assert_allclose(curve["transmission"][:, 0], np.abs(u[:, 1] / u[:, 0]), rtol=1e-9)
    assert (tmp_path / "out" / "figures" / f"outputs-{curve.attrs['name']}.png").exists()


@pytest.mark.parametrize("ends", ["free", "periodic"])
def test_balanced_forces_strain_a_free_lattice_and_do_not_move_it(ends, tmp_path):
    """Two opposite forces at a low frequency: displacements as at rest, which rounding over omega^2 would exceed."""
    force = {"cell": 2, "mass": 1, "amplitude": 0.1}
    drive = (
        FORCE
        | force
        | {"frequency": 1e-4, "more": [FORCE | {"cell": 14, "mass": 1, "amplitude": -0.1, "frequency": 1e-4}]}
    )
    case = table(drive=drive, nfrc=OVER | {"infinite": False, "range": [1e-9, 1e-6], "points": 3})
    case["lattice"] |= {"cells": 20, "ends": ends}
    case["output"] = {"points": [{"name": f"n{cell}", "cell": cell} for cell in range(1, 21)]}
    del case["lattice"]["damping"]
    inner = {"start": 1, "end": 2, "stiffness": 1e3, "damping": 1e-3}
    case["lattice"]["cell"] = {"masses": [1.0, 0.01], "springs": [*case["lattice"]["cell"]["springs"], inner]}
    stiffness = NfrcCase.from_table(case).model().chain.stiffness_matrix().toarray()
    load = np.zeros(40)
    load[[2, 26]] = 0.2, -0.2
    at_rest = np.linalg.lstsq(stiffness, load, rcond=1e-10)[0][::2]
    with curve_of(case, tmp_path) as curve:
        u = curve["location_harmonics"].values[:, :, 1]
    np.testing.assert_allclose(u - u[:, :1], np.tile(at_rest - at_rest[0], (3, 1)), rtol=1e-5, atol=1e-6)


def test_a_frequency_at_an_undamped_resonance_is_named(tmp_path):
    """Three masses between free ends have a mode at sqrt(3 k/m); the grid's other frequencies are not named."""
    case = table(drive=FORCE, nfrc=OVER | {"infinite": False, "range": [np.sqrt(4.5), 3.0], "points": 3})
    case["lattice"] |= {"ends": "free"}
    case["lattice"] |= {"damping": {"mass": 1e-3}}
    with curve_of(case, tmp_path / "damped") as curve:
        assert json.loads(curve.attrs["warnings"]) == []
    del case["lattice"]["damping"]
    with curve_of(case, tmp_path / "undamped") as curve:
        (warning,) = json.loads(curve.attrs["warnings"])
    assert "2.1213" in warning and "2.56" not in warning


# A mass of 1 kg on two springs of 0.75 N/m, with a dashpot of 0.06 N s/m to the ground and a stop of 20 N/m at 0.4 m.
# The left wall shakes.
CELL = TWO_MASSES["lattice"]["cell"] | {"springs": [{"start": 1, "end": 1, "stiffness": 0.75, "next_cell": True}]}
ONE_MASS: dict[str, Any] = TWO_MASSES | {
    "lattice": TWO_MASSES["lattice"] | {"cells": 1, "cell": CELL},
    "contacts": TWO_MASSES["contacts"] | {"clearance": 0.4},
    "nfrc": TWO_MASSES["nfrc"] | {"range": [0.9, 2.3], "harmonics": 31},
}


@pytest.mark.parametrize("ends", ["free", "fixed", "periodic"])
@pytest.mark.parametrize(
    "cell",
    [
        {"masses": [1.0]},
        # The stop is that of the first mass, which takes a second one along by a spring.
        {"masses": [1.0, 0.1], "springs": [{"start": 1, "end": 2, "stiffness": 10.0}]},
        # A second mass that nothing holds stays where it is.
        {"masses": [1.0, 0.1]},
    ],
)
def test_nothing_has_to_connect_a_single_cell(cell, ends):
    """A mass flies at 1 m/s onto an elastic stop 1 m away and comes back; alone, at the speed at which it came."""
    table = {
        "lattice": {"cells": 1, "ends": ends, "cell": cell},
        "contacts": {"stiffness": 1e6, "sites": [1], "pair": [0, 1], "side": "minus", "clearance": 1.0},
        "initial": {"kind": "velocity", "cell": 1, "velocity": -1.0},
        "time": {"end": 2.0, "sample_interval": 0.01},
    }
    case = Case.from_table(table)
    run = run_of(case)
    stored = run["energy/kinetic"] + run["energy/spring"] + run["energy/contact"]
    assert stored.values == pytest.approx(0.5, rel=1e-9)
    if "springs" not in cell:
        # The contact of 1 kg on 1e6 N/m^1.5 lasts 3.2181 (m^2/(k^2 v))^(1/5) = 0.01281 s.
        assert run["displacement"].values[-1, 0, 0] == pytest.approx(-0.012811, abs=1e-5)
        assert run["velocity"].values[-1, 0, 0] == pytest.approx(1.0, rel=1e-9)
    rows = dict(lattice_rows(case))
    assert rows["clearance"] == "1000 mm on side -"
    assert rows["lattice"].startswith("1 cell, ")
    without = Case.from_table(table | {"contacts": {"sites": []}})
    assert dict(lattice_rows(without))["contact"] == "none"
    assert not [text for text in case.warnings() if "wavelength" in text]


def test_its_only_mode():
    """The only mode of one mass has the frequency sqrt(1.5) rad/s."""
    modes = linear_modes(Case.from_table(ONE_MASS).model().chain)
    assert modes.frequency == pytest.approx([np.sqrt(1.5)])
    assert np.abs(modes.vectors) == pytest.approx(np.ones((1, 1)))


def test_dashpots_alone_resist_a_motion_of_equal_masses_together():
    """A common motion of all masses, kappa = 0, has no stiffness: of its two rates, 0 and -0.06 1/s, 0 is given."""
    cell = Case.from_table(ONE_MASS).model().chain.cell
    assert damped_bloch(cell, 0.0).rate == pytest.approx([0.0], abs=1e-12)
    # A long wave is overdamped: s^2 + 0.06 s + omega^2 = 0 has two real rates, of which the slower one is given.
    rate = damped_bloch(cell, 0.01).rate[0]
    squared = 4 * 0.75 * np.sin(0.005) ** 2
    assert rate == pytest.approx(-0.03 + np.sqrt(0.03**2 - squared), rel=1e-9)


# The number of samples in a period. Transforms by the trapezoidal rule are exact for all harmonics that matter.
SAMPLES = 1024


@pytest.fixture(scope="module")
def curve(tmp_path_factory) -> Path:
    """The folder of a short curve of two masses whose motion is output."""
    folder = tmp_path_factory.mktemp("outputs") / "rig"
    nfrc = TWO_MASSES["nfrc"] | {"range": [1.2, 1.3], "harmonics": 9, "points": 6}
    followed(NfrcCase.from_table(TWO_MASSES | {"nfrc": nfrc, "output": OUTPUT}), folder)
    return folder


def test_outputs_are_those_of_the_motion_by_time_integration():
    """Peaks, first harmonics, phases and forces at stop and walls are those of a period that SciPy integrates."""
    frequency = 1.25
    # With 121 harmonics the truncation is below the tolerances. The tolerance of accelerations, whose harmonics fall
    # most slowly, is larger.
    options = {"source": "force", "over": "amplitude", "range": [0.2, 0.3], "fixed": [frequency], "harmonics": 121}
    states = SteadyStates(NfrcCase.from_table(TWO_MASSES | {"nfrc": options, "output": OUTPUT}), 1.0, frequency)
    state = first_state(states)
    measured = states.measured(state.xi)
    assert measured.episodes == 1
    outputs = measured.outputs

    period = 2 * np.pi / frequency
    times = period / SAMPLES * np.arange(SAMPLES)
    u, v = motion_at(states, state.xi, np.arange(2))
    rate = rate_of(states, frequency, 0.2)
    begin = np.concatenate([u.ravel(), v.ravel()])
    y = solve_ivp(rate, (0, period), begin, "DOP853", t_eval=times, rtol=1e-10, atol=1e-12, max_step=period / 100).y
    # The accelerations follow from the equations; differences of sampled velocities would be too inexact.
    acceleration = np.array([rate(t, column)[2:] for t, column in zip(times, y.T, strict=True)]).T

    for name, history in (("displacement", y[:2]), ("velocity", y[2:]), ("acceleration", acceleration)):
        error = 1e-2 if name == "acceleration" else 1e-4
        np.testing.assert_allclose(outputs[f"peak_{name}"], np.abs(history).max(axis=1), rtol=error)
        first = np.fft.rfft(history)[:, 1] / (SAMPLES / 2)
        np.testing.assert_allclose(outputs[f"first_{name}"], np.abs(first), rtol=1e-4)
    lag = -np.degrees(np.angle(np.fft.rfft(y[:2])[:, 1])) % 360
    np.testing.assert_allclose(outputs["lag"], lag, atol=0.01)

    # The rig's stop has 20 N/m beyond 0.8 m.
    force = 20.0 * np.maximum(y[0] - 0.8, 0)
    assert outputs["largest_force"] == pytest.approx(force.max(), rel=1e-4)
    assert outputs["first_force"] == pytest.approx(np.abs(np.fft.rfft(force)[1]) / (SAMPLES / 2), rel=1e-3)
    walls = 1.5 * np.array([y[0] - 0.2 * np.cos(frequency * times), y[1]])
    np.testing.assert_allclose(outputs["largest_wall_force"], np.abs(walls).max(axis=1), rtol=1e-4)
    lag = -np.degrees(np.angle(np.fft.rfft(walls)[:, 1])) % 360
    np.testing.assert_allclose(outputs["wall_force_lag"], lag, atol=0.01)


def test_walls_hold_the_masses_that_are_tied_to_them():
    """A wall's force is that of the spring tied to it, from a second mass at the left and a first one at the right."""
    springs = [
        {"start": 1, "end": 2, "stiffness": 1.5, "next_cell": True, "damping": 0.05},
        {"start": 1, "end": 2, "stiffness": 0.7},
    ]
    table = TWO_MASSES | {
        "lattice": {"cells": 3, "cell": {"masses": [1.0, 0.4], "springs": springs, "contact": [1, 2]}},
        "contacts": {"law": "bilinear", "stiffness": 20.0, "restitution": 1.0, "sites": [1], "clearance": 50.0},
        "drive": {"waveform": "harmonic", "amplitude": 0.1, "frequency": 0.9, "cell": 2, "mass": 1},
        "nfrc": TWO_MASSES["nfrc"] | {"range": [0.9, 1.0], "harmonics": 3},
        "output": {"points": [{"name": "inner", "cell": 2, "mass": 2}], "forces": True},
    }
    states = SteadyStates(NfrcCase.from_table(table), 1.0, 0.2)
    outputs = states.measured(first_state(states).xi).outputs

    # Nothing touches, so that the state is the solution of linear equations.
    chain = states.case.model().chain
    dynamic = chain.stiffness_matrix().toarray() + 0.9j * chain.damping_rows(0, 3).toarray()
    u = np.linalg.solve(dynamic - 0.81 * np.diag(chain.masses()), 0.2 * np.eye(6)[2])
    assert outputs["first_displacement"] == pytest.approx(abs(u[3]), rel=1e-9)
    # The force at the wall is that of its spring and dashpot at 0.9 rad/s.
    expected = abs(1.5 + 0.9j * 0.05) * np.abs([u[1], u[4]])
    np.testing.assert_allclose(outputs["first_wall_force"], expected, rtol=1e-9)


def test_a_wave_moves_named_masses_of_an_infinite_lattice_as_its_shape_says():
    """Below contact named masses of an infinite lattice move as the Bloch wave does."""
    case = nfrc_case(harmonics=3, range=[0.9, 0.95])
    names = [("host", 10, 1), ("resonator", 10, 2), ("later", 14, 2)]
    points = [{"name": name, "cell": cell, "mass": mass} for name, cell, mass in names]
    cell = case.model().chain.cell
    points[0]["mass"], points[1]["mass"] = cell.host + 1, cell.resonator + 1
    points[2]["mass"] = cell.resonator + 1
    table = {key: getattr(case, key).model_dump(by_alias=True, exclude_none=True) for key in ("lattice", "contacts")}
    nfrc = case.nfrc.model_dump(exclude_none=True)
    states = SteadyStates(NfrcCase.from_table(table | {"nfrc": nfrc, "output": {"points": points}}), 1.0, 1023.27)

    measured = states.measured(first_state(states).xi)
    outputs = measured.outputs
    u = (outputs["location_harmonics"] + 1j * outputs["location_harmonics_imaginary"])[:, 1]
    assert u[1] - u[0] == pytest.approx(measured.harmonics[0, 1], rel=1e-9)
    assert outputs["first_displacement"][2] == pytest.approx(outputs["first_displacement"][1], rel=1e-9)
    wave = states.linear_motion(1023.27).wave
    assert u[2] / u[1] == pytest.approx(wave.factor**4, rel=1e-9)
    assert outputs["peak_velocity"] == pytest.approx(1023.27 * outputs["first_displacement"], rel=1e-4)


def test_files_name_the_masses(curve):
    """The table, ``vipetsc.open``, the export and the picture have the outputs under the case's names of points."""
    (path,) = curve.glob("branch-*.h5")
    with vipetsc.open(path) as data:
        assert set(data["location"].values) == {"near", "far"}
        peak = data["peak_velocity"].sel(location="far").values
        assert data["largest_force"].attrs["units"] == "N"
        share = data["share"].sel(way="lost").values
    rows = list(csv.DictReader(path.with_suffix(".csv").open()))
    assert [float(row["peak_velocity/far"]) for row in rows] == peak.tolist()
    assert {"transmission/near-far", "largest_force", "wall_force_lag/left"} <= rows[0].keys()

    (table,) = (table for table in write_curves(path) if table.stem.endswith("-point"))
    columns = list(csv.DictReader(table.open()))
    assert [float(row["peak_velocity/far (m/s)"]) for row in columns] == peak.tolist()
    assert [float(row["share/lost"]) for row in columns] == share.tolist()

    assert {picture.stem.partition("-")[0] for picture in draw("branches", [curve])} == {"branch", "outputs"}


def touching(table: dict[str, Any] = ONE_MASS, contacts: dict[str, Any] | None = None, **nfrc: Any) -> NfrcCase:
    """The case of a rig with a stop that touches at rest; ``contacts`` and ``nfrc`` update these tables."""
    options = {
        "source": "force",
        "over": "frequency",
        "range": [1.9, 2.0],
        "fixed": [0.2],
        "harmonics": 15,
        "largest_step": 0.3,
    } | nfrc
    stops = table["contacts"] | {"clearance": 0.0} | (contacts or {})
    return NfrcCase.from_table(table | {"contacts": stops, "nfrc": options})


def test_its_resonance_is_that_of_a_bilinear_oscillator(tmp_path):
    """The resonance is that of a bilinear oscillator, 2 w1 w2/(w1 + w2) with w1 = sqrt(1.5), w2 = sqrt(21.5) rad/s."""
    _, points = followed(touching(range=[1.92, 1.96]), tmp_path / "one")
    soft, stiff = np.sqrt([1.5, 21.5])
    resonance = 2 * soft * stiff / (soft + stiff)
    highest = max(points, key=lambda point: point.measured.largest[0])
    # The peak of a response with a dashpot of 0.06 1/s is a little lower.
    assert highest.measured.frequency == pytest.approx(resonance, rel=3e-3)
    assert highest.measured.episodes == 1
    assert highest.measured.closed[0] == pytest.approx(soft / (soft + stiff), rel=0.02)


def test_it_is_proportional_to_the_drive(tmp_path):
    """Forces of a bilinear stop that touches at rest scale with the motion: states are proportional to the drive."""
    _, points = followed(touching(over="amplitude", range=[0.1, 5.0], fixed=[1.5], largest_step=1.0), tmp_path / "two")
    first, last = (point.measured for point in (points[0], points[-1]))
    np.testing.assert_allclose(last.harmonics, 50 * first.harmonics, atol=1e-8)
    assert first.unstable == last.unstable


def test_a_lattice_without_damping_has_a_state_between_its_resonances():
    """A first state of an undamped lattice between its resonances is found, and contains no dashpots."""
    cell = {
        "masses": [0.004, 0.002],
        "springs": [
            {"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True},
            {"start": 1, "end": 2, "stiffness": 5e3},
        ],
    }
    stops = {"law": "hertz", "stiffness": 1e7, "sites": [12, 14], "clearance": 0.0, "side": "plus", "restitution": 1.0}
    drive = {"amplitude": 3.0, "frequency": 1000.0, "cycles": 3, "cell": 4}
    options = {"source": "force", "infinite": False, "range": [0.44, 1.0], "harmonics": 5}
    case = NfrcCase.from_table(
        {"lattice": {"cells": 24, "cell": cell}, "contacts": stops, "drive": drive, "nfrc": options}
    )
    states = SteadyStates(case, 1.0, 1000.0)
    point = first_state(states)
    assert np.abs(states.residual(point.xi, states.shift_near(point.xi))).max() < 1e-10
    # Without dissipation all motions are in phase with the drive or in antiphase.
    assert np.abs(states.measured(point.xi).harmonics.imag).max() < 1e-9 * states.clearance


# Duffing's oscillator u'' + 0.1 u' + u + u^3 = 0.1 cos(Om t). Half of the stiffness is on either side of the mass.
HARDENING = {"start": 1, "end": 1, "stiffness": 0.5, "cubic": 0.5, "next_cell": True}
DUFFING: dict[str, Any] = {
    "name": "duffing",
    "lattice": {
        "cells": 1,
        "cell": {"masses": [1.0], "springs": [HARDENING], "contact": [1, 1]},
        "damping": {"mass": 0.1},
    },
    "contacts": {"sites": []},
    "drive": {"waveform": "harmonic", "amplitude": 0.1, "frequency": 1.0, "cell": 1, "mass": 1},
    "time": {"end": 10.0},
    "nfrc": {"source": "force", "over": "frequency", "range": [0.7, 1.7], "fixed": [0.1], "harmonics": 9},
}
STOP = {"law": "bilinear", "stiffness": 5.0, "restitution": 1.0, "sites": [1], "clearance": 0.3, "side": "plus"}
STOP["pair"] = [0, 1]


def chain_of(count: int, spring: dict[str, Any], **nfrc: Any) -> dict[str, Any]:
    """The table of a chain of ``count`` masses between walls, with dashpots, driven at its first mass."""
    springs = [{"start": 1, "end": 1, "stiffness": 1.0, "next_cell": True} | spring]
    lattice = {"cells": count, "cell": {"masses": [1.0], "springs": springs, "contact": [1, 1]}}
    options = DUFFING["nfrc"] | nfrc
    return DUFFING | {"lattice": lattice | {"damping": {"mass": 0.1}}, "nfrc": options}


@pytest.fixture(scope="module")
def duffing(tmp_path_factory):
    """The folder, the steady states and the points of the curve of Duffing's oscillator."""
    folder = tmp_path_factory.mktemp("smooth") / "duffing"
    return folder, *followed(NfrcCase.from_table(DUFFING), folder)


def test_its_first_harmonic_is_that_of_duffings_oscillator(duffing):
    """With one harmonic the response is exactly that of textbooks, a^2 ((1 - Om^2 + 3 a^2/4)^2 + (0.1 Om)^2) = F^2."""
    _, states, points = duffing
    case = states.case.model_copy(update={"nfrc": states.options.model_copy(update={"harmonics": 1})})
    one = SteadyStates(case, 1.0, 0.1)
    # States along the whole curve, on both sides of the folds, are guesses for the state with one harmonic.
    for point in points[::8]:
        # The mass moves as the first spring's end, so that its harmonics are those of the elongation.
        guess = point.measured.outputs["spring_harmonics"] + 1j * point.measured.outputs["spring_harmonics_imaginary"]
        p = states.drive(point.xi[-1])[0] / one.parameter.scale
        xi = one.at(np.append(one.balance.pack(guess[:, :2]) / one.clearance, p), p)
        omega = one.drive(xi[-1])[0]
        a = np.abs(one.balance.unpack(xi[:-1] * one.clearance)[0, 1])
        left = a**2 * ((1 - omega**2 + 0.75 * a**2) ** 2 + (0.1 * omega) ** 2)
        assert left == pytest.approx(0.01, rel=1e-9)


def test_its_folds_are_those_of_the_response_with_one_harmonic(duffing):
    """The folds are at the largest frequency left of the backbone and the least one right of it, to 1 %.

    Both follow from the response with one harmonic. The third harmonic moves the folds by less than 1 %.
    """
    _, states, points = duffing
    a = np.linspace(1e-3, 1.5, 20001)
    # Every amplitude a below the peak has two frequencies, left and right of the backbone.
    with np.errstate(invalid="ignore"):
        middle = 1 + 0.75 * a**2 - 0.005
        width = np.sqrt(middle**2 - (1 + 0.75 * a**2) ** 2 + (0.1 / a) ** 2)
        left = np.sqrt(middle - width)
        right = np.sqrt(middle + width)
    found = sorted(states.drive(point.xi[-1])[0] for point in points if point.kind == "fold")
    np.testing.assert_allclose(found, [np.nanmin(right), np.nanmax(left)], rtol=1e-2)


def test_walls_feel_the_whole_force_of_their_springs():
    """The force on a wall is that of its spring at each instant, cubic part included."""
    options = {"over": "amplitude", "range": [0.3, 0.4], "fixed": [0.8], "harmonics": 21}
    output = OUTPUT | {"transmission": None}
    table = chain_of(2, {"cubic": 2.0, "quadratic": 0.5}, **options)
    case = NfrcCase.from_table(table | {"output": {key: value for key, value in output.items() if value is not None}})
    states = SteadyStates(case, 1.0, 0.8)
    xi = first_state(states).xi
    outputs = states.measured(xi).outputs
    phases = np.linspace(0, 2 * np.pi, 2001)
    (left,), (right,) = motion_at(states, xi, np.arange(2), phases)[0]
    # The elongation of the right wall's spring is the last mass's displacement, reversed.
    z = np.stack([left, -right])
    force = z + 0.5 * z**2 + 2.0 * z**3
    np.testing.assert_allclose(outputs["largest_wall_force"], np.abs(force).max(axis=1), rtol=1e-4)


SPRING = 3.0
DASHPOT = 0.1
HELD_STOP = 20.0
DEPTH = 0.1


def held(
    contacts: dict[str, Any] | None = None, lattice: dict[str, Any] | None = None, frequency: float = 1.0, **nfrc: Any
) -> NfrcCase:
    """Two masses of 1 kg joined by a spring, without walls; the first is pressed against a stop of the ground.

    ``contacts``, ``lattice`` and ``nfrc`` update the tables of these names; ``frequency`` in rad/s is the drive's.
    """
    spring = {"start": 1, "end": 1, "stiffness": SPRING, "next_cell": True}
    table: dict[str, Any] = {
        "lattice": {"cells": 2, "ends": "free", "damping": {"mass": DASHPOT}},
        "contacts": {"law": "hertz", "stiffness": HELD_STOP, "restitution": 1.0, "sites": [1], "pair": [0, 1]},
        "drive": {"waveform": "harmonic", "amplitude": 1.0, "frequency": frequency, "cell": 2},
        "time": {"end": 10.0, "sample_interval": 0.1},
        "output": {"points": [{"name": "near", "cell": 1}, {"name": "far", "cell": 2}], "forces": True},
        "nfrc": {"source": "force", "over": "frequency", "range": [0.8, 3.0], "fixed": [0.2], "harmonics": 23},
    }
    table["lattice"] |= {"cell": {"masses": [1.0], "springs": [spring], "contact": [1, 1]}} | (lattice or {})
    table["contacts"] |= {"side": "minus", "clearance": 0.0, "precompression": DEPTH} | (contacts or {})
    table["nfrc"] |= nfrc
    return NfrcCase.from_table(table)


@pytest.mark.parametrize(("over", "values"), [("stiffness", [12.0, 30.0, 19.0]), ("precompression", [0.06, 0.2, 0.1])])
def test_along_a_curve_over_its_law_a_contact_that_holds_the_lattice_has_the_spring_of_each_value(over, values):
    """Under a weak force the pressed contact is a spring of the slope that its own law has at each value of a key."""
    omega = 1.7
    case = held(frequency=omega, over=f"contacts.{over}", range=[min(values), max(values)], fixed=[1e-4])
    keyed = KeyedCase(case, restitution=1.0, amplitude=1e-4)
    for value in values:
        states = keyed.at(value)
        law = {"stiffness": HELD_STOP, "precompression": DEPTH} | {over: value}
        slope = 1.5 * law["stiffness"] * law["precompression"] ** 0.5
        stiffness = np.array([[SPRING + slope, -SPRING], [-SPRING, SPRING]])
        u = np.linalg.solve(stiffness + (1j * omega * DASHPOT - omega**2) * np.eye(2), [0.0, 1e-4])

        outputs = states.measured(first_state(states).xi).outputs
        np.testing.assert_allclose(outputs["first_displacement"], np.abs(u), rtol=1e-5)


def test_bodies_that_dashpots_oppose_differently_move_each_for_itself():
    """The compliance between two unconnected masses, of which a dashpot brakes one, is the sum of their compliances.

    Both modes have frequency 0, and so has any combination. The dashpot couples all modes but those of one mass each.
    """
    cell = UnitCell((1.0, 2.0), (), 0, 1, grounding=(0.3, 0.0))
    chain = Chain(cell, 1, "free", sites=sites_at([0], cell.pair))
    omega = 0.7
    found = ModalCompliance(chain).at(omega)[0, 0, 0]
    assert found == pytest.approx(1 / (0.3j * omega - omega**2) - 1 / (2 * omega**2), rel=1e-12)
