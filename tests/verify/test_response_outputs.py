"""Motion of named masses and forces along frequency responses, against time integration; files and pictures of them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vipetsc
from tests.rigs import OUTPUT, TWO_MASSES, followed, rate_of
from tests.steady_states import motion_at, nfrc_case
from vipetsc.case.nfrc import NfrcCase
from vipetsc.figures.registry import draw
from vipetsc.io.export import write_curves
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

pytestmark = pytest.mark.parallel(1)

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
    """Below contact named masses of an infinite lattice move as the Bloch wave does.

    At the site resonator and host differ by the wave's amplitude; masses of other cells differ by its phase.
    """
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
