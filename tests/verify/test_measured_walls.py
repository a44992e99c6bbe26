"""Walls that move as their velocity or acceleration was measured, through springs with dashpots, in both engines."""

from __future__ import annotations

import itertools

import h5py
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from vipetsc.case import Case
from vipetsc.case.section import CaseError
from vipetsc.dynamics import simulate
from vipetsc.lattice.drive import Drive, joined

SPAN = 0.4  # s


def displacement(t, derivative=0):
    """A motion in m that begins and ends at rest, (t (SPAN - t))^4 sin 60 t with a scale, and its derivatives."""
    h = 1e-3 * SPAN
    if derivative:
        # Differences of the sixth order.
        weights = [-1, 9, -45, 0, 45, -9, 1]
        shifted = [displacement(t + h * n, derivative - 1) for n in range(-3, 4)]
        return sum(w * s for w, s in zip(weights, shifted, strict=True)) / (60 * h)
    return 1e-3 * (4 * t * (SPAN - t) / SPAN**2) ** 4 * np.sin(60 * t)


@pytest.mark.parametrize("quantity, removed", [("velocity", [2e-3]), ("acceleration", [0.3, -2.0])])
def test_an_integrated_record_is_the_motion(quantity, removed):
    """Offset and drift that were added to the exact rates are found and removed; the motion is found to 1e-6."""
    derivative = len(removed)
    times = 0.1 + np.linspace(0, SPAN, 500)
    values = displacement(times - 0.1, derivative) + np.polynomial.polynomial.polyval(times - 0.1, removed)
    motion = joined(times, values, "spline", derivative)
    np.testing.assert_allclose(motion.removed, removed, rtol=1e-5)
    t = np.linspace(0, SPAN, 1999)
    np.testing.assert_allclose(motion.curve(0.1 + t), displacement(t), atol=1e-9)
    kept = joined(times, values, "spline", derivative, removes=False)
    assert abs(kept.last) > 1e-4 and not len(kept.removed) and motion.last == 0


@pytest.mark.parametrize("interpolation", ["linear", "monotone", "spline"])
def test_integrals_are_exact(interpolation):
    """The derivatives of the motion are the curve through uneven samples less what is removed."""
    random = np.random.default_rng(3)
    times = np.cumsum(random.uniform(0.01, 0.2, 9))
    values = random.standard_normal(9)
    given = joined(times, values, interpolation)
    t = np.linspace(times[0], times[-1], 200)[:-1]
    for derivative in (1, 2):
        motion = joined(times, values, interpolation, derivative)
        found = motion.curve.derivative(derivative)(t)
        removed = np.polynomial.polynomial.polyval(t - times[0], motion.removed)
        np.testing.assert_allclose(found, given.curve(t) - removed, atol=1e-12)
        assert abs(motion.curve(times[-1])) < 1e-13


TIMES = [0.0, 0.03, 0.05, 0.08, 0.12, 0.15]
VALUES = [4.0, -7.0, 6.0, 9.0, -8.0, 3.0]
CHAIN = {"masses": [0.1, 0.05], "springs": [{"start": 1, "end": 1, "stiffness": 900.0, "next_cell": True}]}
CHAIN["springs"].append({"start": 1, "end": 2, "stiffness": 400.0})
SAMPLES = {"time": TIMES, "value": VALUES, "interpolation": "linear"}
BETA = 2e-3  # s


def table(drive, engine="ts", **sections):
    """Four cells with stiffness-proportional damping between walls, of which the left one moves."""
    return {
        "lattice": {"cells": 4, "cell": CHAIN, "damping": {"stiffness": BETA}},
        "contacts": {"sites": []},
        "drive": {"amplitude": 2.0, "end": "left"} | drive,
        "time": {"end": 0.3, "engine": engine, "rtol": 1e-11, "samples": 601},
    } | sections


def wall(drive):
    """The displacement and the velocity of the wall in a ``drive``, as functions of time, and their kinks."""
    if drive["waveform"] == "samples":
        order = {"displacement": 0, "velocity": 1, "acceleration": 2}[drive["samples"]["quantity"]]
        motion = joined(TIMES, VALUES, "linear", order).curve
        slope = motion.derivative()
        inside = lambda f: lambda t: 2.0 * float(f(t)) * (t < TIMES[-1])  # noqa: E731
        return inside(motion), inside(slope), TIMES
    if drive["waveform"] == "chirp":

        def chirp(t):
            s = np.clip(min(t, 0.2 - t) / 0.05, 0.0, 1.0)
            return 2.0 * (10 * s**3 - 15 * s**4 + 6 * s**5) * np.sin(t * 30.0 + 100.0 * t**2)

        def slope(t):
            # Differences of the fourth order.
            h = 1e-4
            return (8 * (chirp(t + h) - chirp(t - h)) - chirp(t + 2 * h) + chirp(t - 2 * h)) / (12 * h)

        return chirp, slope, [0.05, 0.15, 0.2]
    omega, cycles = 50.0, 3
    end = 2 * np.pi * cycles / omega

    def burst(t):
        return 2.0 * (1 - np.cos(omega * t / cycles)) * np.sin(omega * t) * (t < end)

    def rate(t):
        slow = omega * t / cycles
        value = np.sin(slow) / cycles * np.sin(omega * t) + (1 - np.cos(slow)) * np.cos(omega * t)
        return 2.0 * omega * value * (t < end)

    return burst, rate, [end]


@pytest.mark.parametrize("engine", ["ts", "propagator"])
@pytest.mark.parametrize(
    "drive",
    [
        {"waveform": "samples", "samples": SAMPLES | {"quantity": "velocity"}},
        {"waveform": "samples", "samples": SAMPLES | {"quantity": "acceleration"}},
        {"waveform": "burst", "frequency": 50.0, "cycles": 3},
        {"waveform": "chirp", "frequency": 50.0, "bandwidth": 40.0, "duration": 0.2, "ramp": 0.05},
    ],
)
def test_a_damped_wall_agrees_with_dop853(engine, drive):
    """Compares displacements, the work of the wall and the losses of all dashpots with their own integrals."""
    run = simulate(Case.from_table(table(drive, engine))).dataset
    moved, rate, kinks = wall(drive)
    masses = np.tile([0.1, 0.05], 4)

    def equations(t, y):
        u, v = np.split(y[:16], 2)
        # Places of the first masses with both walls.
        x, dx = np.zeros((2, 6))
        x[0], x[1:5] = moved(t), u[::2]
        dx[0], dx[1:5] = rate(t), v[::2]
        pull, inner = np.diff(x), u[1::2] - u[::2]
        pull_rate, inner_rate = np.diff(dx), v[1::2] - v[::2]
        along = 900.0 * (pull + BETA * pull_rate)
        inside = 400.0 * (inner + BETA * inner_rate)
        force = np.zeros(8)
        force[::2] = np.diff(along) + inside
        force[1::2] = -inside
        work = -along[0] * rate(t)
        loss = BETA * (900.0 * np.sum(pull_rate**2) + 400.0 * np.sum(inner_rate**2))
        return np.concatenate([v, force / masses, [work, loss]])

    times = run["time"].values
    y = np.zeros(18)
    found = np.zeros((18, len(times)))
    bounds = np.unique([0.0, *kinks, times[-1]])
    for a, b in itertools.pairwise(bounds):
        inside = (times >= a) & (times <= b)
        # Up to just before a kink, at which the velocity may jump.
        part = solve_ivp(equations, (a, b * (1 - 1e-13)), y, "DOP853", rtol=1e-11, atol=1e-13, dense_output=True)
        found[:, inside] = part.sol(times[inside])
        y = part.y[:, -1]

    u = run["displacement"].values.reshape(len(times), -1)
    np.testing.assert_allclose(u, found[:8].T, atol=3e-7 * np.abs(u).max())
    for name, values in (("work", found[16]), ("dissipated_by_damping", found[17])):
        np.testing.assert_allclose(run[f"energy/{name}"], values, atol=2e-6 * found[16].max(), err_msg=name)


def test_the_responses_of_dashpots_are_integrals():
    """The change of modes by the velocity of a wall is that of quadrature."""
    wave = Case.from_table(table({"waveform": "burst", "frequency": 50.0, "cycles": 3})).model().drives[0].waveform
    frequency = np.array([0.0, 30.0, 77.0])
    found = Drive(wave, 0, 0, damping=3.0).response(frequency, 0.02, 0.3)
    for w, value in zip(frequency, found, strict=True):
        parts = [
            quad(lambda s, f=f, w=w: f(w * (0.3 - s)) * float(wave.rate(s)), 0.02, 0.3, limit=400)[0]
            for f in (np.cos, np.sin)
        ]
        assert value == pytest.approx(complex(*parts), abs=1e-8)


def test_tables_of_records_drive_a_wall(tmp_path):
    """Columns by name and number of text, at a rate, in milliseconds, and datasets of HDF5: the same samples."""
    times, values = np.array(TIMES), np.array(VALUES)
    text = tmp_path / "record.csv"
    rows = [f"{1e3 * t:.12g};{7.5};{v:.12g}" for t, v in zip(times, values, strict=True)]
    text.write_text("time (ms);other;a (m/s^2)\n" + "\n".join(rows) + "\n")
    with h5py.File(tmp_path / "record.h5", "w") as file:
        file["lab/clock"] = times
        file["lab/data"] = np.column_stack([0 * values, values])
    even = tmp_path / "even.txt"
    even.write_text("\n".join(map(str, VALUES)) + "\n")
    quantity = {"quantity": "acceleration"}

    def samples(**keys):
        drive = {"waveform": "samples", "samples": keys | quantity}
        return Case.from_table(table(drive)).drive.samples

    for keys in (
        {"file": str(text), "columns": ["time (ms)", "a (m/s^2)"], "time_factor": 1e-3},
        {"file": str(text), "columns": [1, 3], "time_factor": 1e-3},
        {"file": str(tmp_path / "record.h5"), "columns": ["lab/clock", "lab/data[2]"]},
    ):
        found = samples(**keys)
        np.testing.assert_allclose(found.time, times, rtol=1e-12)
        assert found.value == VALUES
    found = samples(file=str(even), rate=50.0)
    np.testing.assert_allclose(found.time, np.arange(6) / 50.0)
    case = Case.from_table(table({"waveform": "samples", "samples": {"file": str(text), "columns": [1, 3]} | quantity}))
    assert "offset" in case.drive.describe() and "drift" in case.drive.describe()
    assert case.drive.unit_of("amplitude", {"end": "left", "samples": quantity}) == "m/s^2"


@pytest.mark.parametrize(
    "drive, key",
    [
        ({"samples": SAMPLES | {"quantity": "velocity"}, "end": None}, r"samples\.quantity"),
        ({"samples": {"file": __file__, "columns": [1, 2]}}, r"samples\.file"),
        ({"samples": {"file": "even.txt", "columns": ["no"], "rate": 50.0}}, r"samples\.columns"),
        ({"samples": {"file": "even.txt", "columns": [1, 2, 3]}}, "columns"),
        ({"samples": {"file": "even.txt", "columns": [1]}}, r"samples\.file.*columns"),
    ],
)
def test_other_records_are_refused(drive, key, tmp_path, monkeypatch):
    """Names the key."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "even.txt").write_text("1\n2\n3\n")
    given = table({"waveform": "samples"} | drive)
    given["drive"] = {name: value for name, value in given["drive"].items() if value is not None}
    with pytest.raises(CaseError, match=key):
        Case.from_table(given)
