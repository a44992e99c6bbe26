"""Waveforms, several drives, moved ends: against the transfer function, one another, another integrator."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp

from vipetsc.case import Case, CaseError
from vipetsc.case.waveforms import waveform_of
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory

ENGINES = "ts", "propagator"
BURST = {"amplitude": 3.0, "cycles": 3, "frequency": 900.0, "mass": 2, "cell": 4}


def case_of(*drives: dict[str, Any], engine: str = "propagator", **sections: Any) -> Case:
    """A diatomic lattice of 16 cells without contacts, under so many ``drives``."""
    table = {
        "lattice": {"preset": "diatomic", "cells": 16, **sections.pop("lattice", {})},
        "contacts": {"sites": []},
        "drive": drives[0] | ({"more": list(drives[1:])} if drives[1:] else {}),
        "time": {"end": 0.03, "engine": engine, "sample_interval": 1e-4, "rtol": 1e-11},
    }
    return Case.from_table(table | sections)


def run_of(*drives: dict[str, Any], **told: Any) -> xr.Dataset:
    memory = RunMemory(MPI.COMM_SELF)
    result = simulate(case_of(*drives, **told), memory)
    assert result.complete, result.sentence
    assert memory.dataset is not None
    return memory.dataset


def largest_ledger(run: xr.Dataset) -> float:
    energy = {name: run[f"energy/{name}"].values for name in ("kinetic", "spring", "contact", "work", "dissipated")}
    left = energy["work"] - energy["dissipated"] - energy["kinetic"] - energy["spring"] - energy["contact"]
    return float(np.abs(left).max() / np.abs(energy["work"]).max())


def by_transfer_function(case: Case) -> np.ndarray:
    """Displacements (time, cell, dof) by (K - w^2 M)^-1 on a line below the real axis, the discrete transform of F."""
    model = case.model()
    chain, drive, count, length = model.chain, model.drive, 30_000, 3 * model.end
    time, decay = np.arange(count) * length / count, 25 / length
    omega = 2 * np.pi * np.fft.rfftfreq(count, length / count) - 1j * decay
    force = np.fft.rfft(drive.force(time) * np.exp(-decay * time))
    root = 1 / np.sqrt(chain.masses())
    squared, modes = np.linalg.eigh(chain.stiffness_matrix().toarray() * root[:, None] * root)
    push = modes[model.drive_cell * chain.cell.dofs + model.drive_mass]
    push = push * root[model.drive_cell * chain.cell.dofs + model.drive_mass]
    answers = np.fft.irfft(force[:, None] * push / (squared - omega[:, None] ** 2), count, axis=0)
    sampled = np.arange(model.samples) * model.sample_interval
    rows = np.rint(sampled * count / length).astype(int)
    np.testing.assert_allclose(time[rows], sampled, atol=1e-12)
    fields = (answers[rows] * np.exp(decay * time[rows])[:, None]) @ (modes * root[:, None]).T
    return fields.reshape(len(rows), chain.cells, -1)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_chirp_meets_the_transfer_function(engine):
    chirp = {"waveform": "chirp", "amplitude": 5.0, "frequency": 700.0, "bandwidth": 900.0, "duration": 0.02}
    time = {"end": 0.03, "engine": engine, "sample_interval": 1.2e-4, "rtol": 1e-11}
    case = case_of(chirp | {"cell": 4, "mass": 2}, time=time)
    memory = RunMemory(MPI.COMM_SELF)
    assert simulate(case, memory).complete
    u, expected = memory.dataset["displacement"].values, by_transfer_function(case)
    assert np.abs(u - expected).max() < 1e-8 * np.abs(expected).max()
    assert largest_ledger(memory.dataset) < 1e-9


@pytest.mark.parametrize("engine", ENGINES)
def test_a_burst_from_a_file_is_the_burst_to_the_splines_error(engine, tmp_path):
    burst = waveform_of(case_of(BURST).drive)
    expected = run_of(BURST, engine=engine)["displacement"].values
    errors = []
    for count in (160, 320):
        time = np.linspace(0, burst.duration, count + 1)
        np.savetxt(tmp_path / f"{count}.csv", np.column_stack([time, burst.force(time)]), "%.17g", ",", header="t, F")
        told = BURST | {"amplitude": 1.0, "waveform": "samples", "samples": {"file": str(tmp_path / f"{count}.csv")}}
        told.pop("cycles")
        run = run_of(told, engine=engine)
        errors.append(np.abs(run["displacement"].values - expected).max() / np.abs(expected).max())
        assert largest_ledger(run) < 1e-9
    assert 3.7 < np.log2(errors[0] / errors[1]) < 4.2
    assert errors[1] < 2e-8


def test_samples_travel_with_the_case(tmp_path):
    time = np.linspace(0, 0.01, 30)
    rows = np.column_stack([time, np.sin(800 * time) * 1e-60 ** (time == 0)])
    with h5py.File(tmp_path / "lab.h5", "w") as file:
        file["drive"] = rows
    samples = {"file": str(tmp_path / "lab.h5"), "dataset": "drive"}
    case = case_of({"waveform": "samples", "samples": samples})
    (tmp_path / "lab.h5").unlink()
    again = Case.from_toml(case.to_toml())
    assert again == case
    assert again.model() == case.model()
    assert again.drive.samples.value == rows[:, 1].tolist()
    assert len(case.drive.samples.sha256) == 64
    other = case_of({"waveform": "samples", "samples": {"time": time.tolist(), "value": (2 * rows[:, 1]).tolist()}})
    assert other.model() != case.model()
    with pytest.raises(CaseError, match=r"drive\.samples\.file.*lab\.h5"):
        case_of({"waveform": "samples", "samples": samples})


@pytest.mark.parametrize(("engine", "error"), [("ts", 1e-9), ("propagator", 2e-14)])
def test_drives_superpose(engine, error):
    second = {"waveform": "impulse", "amplitude": 1e-3, "duration": 7e-4, "cell": 11}
    third = {"waveform": "step", "amplitude": 2e-6, "ramp": 3e-3, "end": "right"}
    together = run_of(BURST, second, third, engine=engine)
    alone = [run_of(drive, engine=engine)["displacement"].values for drive in (BURST, second, third)]
    sum_of = np.sum(alone, axis=0)
    assert np.abs(together["displacement"].values - sum_of).max() < error * np.abs(sum_of).max()
    assert largest_ledger(together) < 1e-9


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    "drive",
    [
        {"waveform": "harmonic", "frequency": 500.0, "ramp": 4e-3, "cell": 3},
        {"waveform": "harmonic", "frequency": 500.0, "ramp": 4e-3, "duration": 0.0123, "end": "left"},
        {"waveform": "impulse", "duration": 1e-5, "cell": 16, "mass": 2},
        {"waveform": "step", "ramp": 1.3e-3, "duration": 0.011},
        {"samples": {"time": [0.0, 2e-3, 3e-3, 7e-3], "value": [0.0, 1.0, -1.0, 0.5]}, "end": "right"},
        {"samples": {"time": [1e-3, 2e-3, 3e-3, 7e-3], "value": [1.0, 1.0, -1.0, 0.5]}},
    ],
)  # fmt: skip
def test_every_waveform_has_its_ledger(engine, drive):
    run = run_of({"waveform": "samples", "amplitude": 0.01} | drive, engine=engine)
    assert np.abs(run["energy/work"].values).max() > 0
    assert largest_ledger(run) < 1e-9


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("end", ["left", "right"])
def test_a_moved_end_against_another_integrator(engine, end):
    """The wall as a body whose motion is given: its spring's force and the power that it takes, by DOP853."""
    told = {
        "waveform": "chirp",
        "amplitude": 2e-5,
        "frequency": 600.0,
        "bandwidth": 700.0,
        "duration": 0.02,
        "end": end,
    }
    case = case_of(told, engine=engine, lattice={"cells": 3})
    chain, wave = case.model().chain, case.model().drive
    k, masses, n = chain.stiffness_matrix().toarray(), chain.masses(), 3 * chain.cell.dofs
    at, spring = (0 if end == "left" else n - chain.cell.dofs), chain.cell.springs[0].stiffness

    def rate(t, y):
        u, h = y[:n], 1e-7
        wall, speed = float(wave.force(t)), float(wave.force(t + h) - wave.force(t - h)) / (2 * h)
        acceleration = -k @ u
        acceleration[at] += spring * wall
        return [*y[n:-1], *(acceleration / masses), spring * (wall - u[at]) * speed]

    run = run_of(told, engine=engine, lattice={"cells": 3})
    time = run["time"].values
    cuts = [0.0, *wave.breaks, time[-1]]
    y, rows = np.zeros(2 * n + 1), []
    for a, b in pairwise(cuts):
        inside = time[(time >= a) & (time < b)]
        solved = solve_ivp(rate, (a, b), y, "DOP853", np.append(inside, b), rtol=1e-11, atol=1e-16)
        rows.append(solved.y[:, : len(inside)])
        y = solved.y[:, -1]
    whole = np.concatenate([*rows, y[:, None]], axis=1)
    u = run["displacement"].values.reshape(len(time), -1)
    assert np.abs(u - whole[:n].T).max() < 1e-8 * np.abs(whole[:n]).max()
    assert np.abs(run["energy/work"].values - whole[-1]).max() < 1e-7 * np.abs(whole[-1]).max()
    assert largest_ledger(run) < 1e-9


def test_a_moved_end_stays_where_its_samples_end():
    samples = {"time": [0.0, 1e-3, 2e-3], "value": [0.0, 0.5, 1.0]}
    wave = waveform_of(case_of({"waveform": "samples", "samples": samples, "end": "left", "amplitude": 1e-5}).drive)
    assert wave.duration == np.inf
    np.testing.assert_allclose(wave.force([0.0, 1e-3, 2e-3, 1.0]), [0.0, 5e-6, 1e-5, 1e-5], rtol=1e-14)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"waveform": "chirp", "frequency": 5.0}, r"drive\.bandwidth: missing.*"),
        ({**BURST, "ramp": 1.0}, r"drive\.ramp: belongs to another waveform than 'burst'"),
        ({**BURST, "end": "left"}, r"drive\.cell = 4: leave it out"),
        ({"waveform": "step", "ramp": 1.0, "duration": 1.0}, r"drive\.ramp = 1\.0: at most half"),
        ({"waveform": "samples", "samples": {"time": [0.0, 1.0], "value": [1.0]}}, r"as many values \(1\)"),
        ({"waveform": "samples", "samples": {"time": [0.0, 1.0], "value": [1.0, 1.0]}, "end": "left"}, "must be 0"),
        ({**BURST, "more": [{"cell": 99, "frequency": 9.0}]}, r"drive\.more\[1\]\.cell = 99: outside"),
        ({**BURST, "more": [{"amplitud": 9.0}]}, r"drive\.more\[1\]\.amplitud.*did you mean"),
    ],
)
def test_bad_drives_are_named(told, message):
    with pytest.raises(CaseError, match=message):
        case_of(told)


def test_ends_that_are_no_walls_do_not_move():
    with pytest.raises(CaseError, match=r'drive\.end.*lattice\.ends = "free"'):
        case_of({"waveform": "step", "ramp": 1.0, "end": "left"}, lattice={"ends": "free"})


def test_a_verb_of_one_burst_says_so():
    from vipetsc.case.law import LawCase

    with pytest.raises(CaseError, match=r"drive\.waveform.*one burst"):
        LawCase.from_table({"drive": {"waveform": "step", "ramp": 1.0}, "law": {}})
