"""Contacts between cells or to the ground: chains of beads, an impact of two masses, a mass that bounces on a stop."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from tests.conftest import simulated
from vipetsc.case import Case

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
    """A small wave has omega = 2 sqrt(k/m) sin(kappa/2) with k = (3/2) A d^(1/2) (Nesterenko 2001, sec. 1.2).

    The contacts are pressed by d at rest; static loads hold the free ends.
    """
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
