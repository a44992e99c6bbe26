"""Waveforms, several drives and moved ends, compared with the transfer function, superposition and SciPy."""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr

from tests.conftest import run_of
from vipetsc.case import Case, CaseError
from vipetsc.case.waveforms import waveform_of
from vipetsc.lattice.drive import sampled

ENGINES = ("ts", "propagator")
BURST = {"amplitude": 3.0, "cycles": 3, "frequency": 900.0, "mass": 2, "cell": 4}


def case_of(*drives: dict[str, Any], engine: str = "propagator", **sections: Any) -> Case:
    """A diatomic lattice of 16 cells without contacts, under one or more ``drives``."""
    first, *more = drives
    drive = dict(first)
    if more:
        drive["more"] = more
    table = {
        "lattice": {"preset": "diatomic", "cells": 16, **sections.pop("lattice", {})},
        "contacts": {"sites": []},
        "drive": drive,
        "time": {"end": 0.03, "engine": engine, "sample_interval": 1e-4, "rtol": 1e-11},
    }
    return Case.from_table(table | sections)


def ledger_error(run: xr.Dataset) -> float:
    """The largest error of work = stored + dissipated energy over the samples, divided by the largest work."""
    work = run["energy/work"].values
    spent = sum(run[f"energy/{name}"].values for name in ("kinetic", "spring", "contact", "dissipated"))
    return float(np.abs(work - spent).max() / np.abs(work).max())


def relative_error(values: np.ndarray, expected: np.ndarray) -> float:
    """The largest deviation from ``expected``, divided by the largest expected value."""
    return float(np.abs(values - expected).max() / np.abs(expected).max())


@pytest.mark.parametrize("engine", ENGINES)
def test_a_burst_from_a_file_is_the_burst_to_the_splines_error(engine, tmp_path):
    """A cubic spline through samples has an error of fourth order: twice as many samples divide it by 16."""
    burst = waveform_of(case_of(BURST).drive)
    expected = run_of(case_of(BURST, engine=engine))["displacement"].values

    errors = []
    for count in (160, 320):
        path = tmp_path / f"{count}.csv"
        time = np.linspace(0, burst.duration, count + 1)
        np.savetxt(path, np.column_stack([time, burst.force(time)]), "%.17g", ",", header="t, F")
        sampled = BURST | {
            "amplitude": 1.0,
            "waveform": "samples",
            "samples": {"file": str(path), "interpolation": "spline"},
        }
        del sampled["cycles"]

        run = run_of(case_of(sampled, engine=engine))
        assert ledger_error(run) < 1e-9
        errors.append(relative_error(run["displacement"].values, expected))

    assert 3.7 < np.log2(errors[0] / errors[1]) < 4.2
    assert errors[1] < 2e-8


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("interpolation", "momentum"), [("monotone", 1e-4), ("linear", 1e-4), ("spline", None)])
def test_a_short_blow_between_long_samples_has_its_momentum(engine, interpolation, momentum):
    """A triangle of 1 N and 0.2 ms strikes a mass of 1 kg on 1e4 N/m; a spline through it is large, and says so."""
    samples = {"time": [0.0, 0.1, 0.1001, 0.1002, 0.2], "value": [0.0, 0.0, 1.0, 0.0, 0.0]}
    if interpolation != "monotone":
        samples["interpolation"] = interpolation
    spring = {"start": 1, "end": 1, "stiffness": 5000.0, "next_cell": True}
    case = Case.from_table(
        {
            "lattice": {"cells": 1, "cell": {"masses": [1.0], "springs": [spring]}},
            "contacts": {"sites": []},
            "drive": {"waveform": "samples", "amplitude": 1.0, "samples": samples},
            "time": {"end": 0.4, "samples": 2001, "engine": engine},
        }
    )
    run = run_of(case)
    assert ledger_error(run) < 1e-8
    if momentum is None:
        assert case.model().drive.peak > 1e4
        assert f"at most {case.model().drive.peak:.6g} N" in case.drive.describe()
        return

    assert case.model().drive.peak == pytest.approx(1.0, rel=1e-2)
    assert np.abs(run["velocity"].values).max() == pytest.approx(momentum, rel=1e-4)


@pytest.mark.parametrize("interpolation", ["monotone", "linear"])
def test_between_samples_a_force_stays_between_their_values(interpolation):
    """Times of all spacings, values that jump: nothing lies beyond the two neighbouring samples."""
    random = np.random.default_rng(5)
    times = np.cumsum(10 ** random.uniform(-6, 0, 60))
    values = random.choice([-1.0, 0.0, 1.0, 5.0], 60)
    wave = sampled(2.0, times, values, 1.0, interpolation)
    for i in range(59):
        between = wave.force(np.linspace(times[i], times[i + 1], 50)[:-1])
        assert between.min() >= 2 * values[i : i + 2].min() - 1e-9
        assert between.max() <= 2 * values[i : i + 2].max() + 1e-9
        assert between[0] == pytest.approx(2 * values[i])


def test_samples_travel_with_the_case(tmp_path):
    """A case holds the samples themselves, to the last bit, and their file's checksum; the file may be removed."""
    path = tmp_path / "lab.h5"
    time = np.linspace(0, 0.01, 30)
    # Few decimals would hold neither these numbers nor the first one, which is tiny and not zero.
    force = np.where(time == 0, 1e-20, np.sin(800 * time))
    with h5py.File(path, "w") as file:
        file["drive"] = np.column_stack([time, force])
    drive = {"waveform": "samples", "samples": {"file": str(path), "dataset": "drive"}}
    case = case_of(drive)
    path.unlink()

    again = Case.from_toml(case.to_toml())
    assert again == case
    assert again.model() == case.model()
    assert again.drive.samples.value == force.tolist()
    assert len(case.drive.samples.sha256) == 64

    other = case_of({"waveform": "samples", "samples": {"time": time.tolist(), "value": (2 * force).tolist()}})
    assert other.model() != case.model()
    with pytest.raises(CaseError, match=r"drive\.samples\.file.*lab\.h5"):
        case_of(drive)
