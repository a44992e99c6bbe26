"""Runs that begin in motion: modes, packets, breathers and states from files move as theory says, in both engines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import CubicSpline

from tests.conftest import simulated, with_sections
from vipetsc.case import Case, CaseError
from vipetsc.dynamics import simulate
from vipetsc.io.netcdf import variable, write_netcdf
from vipetsc.io.store import RunMemory
from vipetsc.lattice import bloch
from vipetsc.lattice.modes import linear_modes, mode_frequency
from vipetsc.spectra.modal_energies import ModalParts

ENGINES = ("ts", "propagator")


def moving(initial: dict, **sections) -> Case:
    """A four-band lattice without a drive; ``initial`` is its table [initial]."""
    table = {
        "name": "moving",
        "lattice": {"preset": "four-band", "cells": 40},
        "contacts": {"sites": 0},
        "initial": initial,
    }
    return Case.from_table(with_sections(table, sections))


def run(case: Case) -> xr.Dataset:
    """The result of a run in memory; asserts that its energy balance closes."""
    data, result = simulated(case)
    assert result.statistics["ledger_error"] < 1e-8
    return data


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_mode_stays_a_mode(engine, ends):
    """A lattice that begins in one mode moves as u(t) = u(0) cos(omega t), and all energy stays in that mode."""
    end = 0.02
    case = moving(
        {"kind": "mode", "number": 50, "energy": 2e-3},
        lattice={"ends": ends},
        time={"engine": engine, "end": end, "rtol": 1e-13},
    )
    chain = case.model().chain
    omega = mode_frequency(chain, 50)
    # Without a drive the mode's frequency is the one that sets tolerances.
    assert case.initial.frequency == omega

    data = run(case)

    work = data["energy/work"].values
    assert work == pytest.approx(2e-3, rel=1e-12)
    assert np.ptp(work) == 0.0

    modes = linear_modes(chain)
    energy = 0.5 * np.abs(modes.amplitudes(data["displacement"].values, data["velocity"].values)) ** 2
    # On a ring waves in both directions have the same frequency.
    own = np.abs(modes.frequency - omega) < 1e-6 * omega
    assert own.sum() == (2 if ends == "periodic" else 1)
    assert energy[:, own].sum(axis=1) == pytest.approx(2e-3, rel=1e-12)

    u = data["displacement"].values
    wave = u[:1] * np.cos(omega * data["time"].values)[:, None, None]
    # The phase may err by 1e-12 in each radian of the run.
    assert np.abs(u - wave).max() < 1e-12 * np.abs(u).max() * omega * end
    assert np.abs(u).max() == pytest.approx(case.initial.amplitude, rel=1e-12)


@pytest.mark.parametrize("direction", [-1])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_packet_travels_with_the_group_velocity_on_its_band(engine, direction):
    """All energy of a packet is in its band, and the centre of energy moves with the packet's mean group velocity."""
    kappa = 2 * np.pi / 5
    width = 8
    initial = {
        "kind": "packet",
        "band": 2,
        "wavenumber": "2pi/5",
        "cell": 120,
        "width": width,
        "direction": direction,
        "amplitude": 1e-4,
    }
    case = moving(initial, lattice={"cells": 240}, time={"engine": engine, "end": 0.1})
    assert case.drive.cell == 120

    data = run(case)
    model = case.model()
    v = data["velocity"].values
    parts = ModalParts.of(model.chain)
    by_part = parts.energies(data["displacement"].values, v, [0, len(v) - 1]).sum(axis=1)
    assert by_part[parts.parts.names.index("band 2")] == pytest.approx(data["energy/work"][0].item(), rel=1e-9)

    # Each wave is weighted by its energy, the square of its frequency times its amplitude in the Gaussian.
    k = kappa + np.linspace(-0.7, 0.7, 2001)
    point = bloch(model.chain.cell, k)
    weight = (point.frequency[:, 1] * np.exp(-0.5 * ((k - kappa) * width) ** 2)) ** 2
    speed = np.average(point.group_velocity[:, 1], weights=weight)
    energy = (v**2 @ np.asarray(model.chain.cell.masses)).astype(float)
    middle = (energy * data["cell"].values).sum(axis=1) / energy.sum(axis=1)
    measured = np.polyfit(data["time"].values, middle, 1)[0]
    assert measured == pytest.approx(direction * speed, rel=2e-3)


def write_state(path: Path, u: np.ndarray, v: np.ndarray) -> None:
    """Write rows 11 to 30 of displacements ``u`` in m and velocities ``v`` in m/s, both (cell, dof), to a file."""
    data = {
        "cell": variable("cell", np.arange(11, 31), "1", "cell"),
        "dof": variable("dof", np.arange(1, 5), "1", "mass"),
        "displacement": variable(("cell", "dof"), u[10:30], "m", "displacement"),
        "velocity": variable(("cell", "dof"), v[10:30], "m/s", "velocity"),
    }
    write_netcdf(path, xr.Dataset(data))


def test_a_file_that_changes_is_noticed(tmp_path):
    """A run begins with the state in a file, in the cells that the file names, and refuses a file that has changed."""
    path = tmp_path / "state.h5"
    u, v = np.random.default_rng(0).standard_normal((2, 40, 4)) * 1e-4
    write_state(path, u, v)
    case = moving({"kind": "file", "path": str(path)}, drive={"amplitude": 0.0, "frequency": 900.0}, time={"end": 0.01})
    data = run(case)

    assert np.array_equal(data["displacement"][0].values[10:30], u[10:30])
    assert not data["velocity"][0].values[[*range(10), *range(30, 40)]].any()
    # The slope of the first three recorded displacements is the file's velocity, as far as three samples determine it.
    spline = CubicSpline(data["time"].values[:3], data["displacement"].values[:3])
    assert spline(0.0, 1)[10:30] == pytest.approx(v[10:30], abs=0.2)

    write_state(path, u, 2 * v)
    with pytest.raises(CaseError, match="has changed since"):
        simulate(case, RunMemory())
    # A case can be read from results after its file has changed or has been removed.
    assert Case.from_toml(case.to_toml()) == case

    path.unlink()
    assert Case.from_toml(case.to_toml()) == case
    with pytest.raises(CaseError, match=r"initial\.path"):
        simulate(case, RunMemory())
