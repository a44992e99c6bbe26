"""Walls that move as their velocity or acceleration was measured, through springs with dashpots, in both engines."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from vipetsc.case import Case
from vipetsc.case.section import CaseError
from vipetsc.lattice.drive import joined

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
