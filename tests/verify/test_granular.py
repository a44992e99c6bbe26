"""Contacts between cells or to the ground: chains of beads, an impact of two masses, a mass that bounces on a stop."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp

from tests.conftest import simulated
from vipetsc.case import Case
from vipetsc.lattice import Contact

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


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_a_struck_chain_is_that_of_an_independent_solver(tmp_path, engine):
    """A struck chain of beads moves as by SciPy from the equations of Hertz contacts, to 1e-8 m/s."""
    n = 8
    v = np.append(0.1, np.zeros(n - 1))
    run = beads(tmp_path, u=np.zeros(n), v=v, end=4e-4, samples=11, rtol=1e-11, engine=engine)

    def rate(_, y):
        push = A * np.maximum(y[: n - 1] - y[1:n], 0) ** 1.5
        return np.concatenate([y[n:], (np.append(0, push) - np.append(push, 0)) / M])

    times = run["time"].values
    start = np.append(np.zeros(n), v)
    y = solve_ivp(rate, (0, times[-1]), start, "DOP853", times, rtol=1e-12, atol=1e-18).y
    assert np.abs(run["velocity"].values[:, :, 0] - y[n:].T).max() < 1e-8


def peak_time(time: np.ndarray, values: np.ndarray) -> float:
    """The time in s of the largest value, the vertex of a parabola through the largest sample and its neighbours."""
    largest = int(values.argmax())
    before, peak, after = values[largest - 1 : largest + 2]
    shift = (before - after) / (2 * (before - 2 * peak + after))
    return time[largest] + shift * (time[1] - time[0])


@pytest.mark.slow
def test_a_struck_chain_sends_a_solitary_wave(tmp_path):
    """The solitary wave is 1.2 % faster than Nesterenko's long wave, at any force, and five beads move in it.

    Nesterenko's speed V = 0.6802 a (2E/(a rho^(3/2) (1 - nu^2)))^(1/3) F^(1/6) is the variable ``theory``, in beads per
    second. SciPy's DOP853 on 40 beads, in units of A = m = 1, gives V = 0.90552 F^(1/6), and speeds of 0.0087, 0.326,
    1, 0.326, 0.0087 of the largest.
    """
    n = 40
    ratios = []
    for speed in (0.1, 0.4):
        # The speed of the wave is proportional to the fifth root of the striking speed.
        end = 3.0e-3 * (0.1 / speed) ** 0.2
        run = beads(tmp_path, u=0.0, v=np.append(speed, np.zeros(n - 1)), end=end, samples=4001)

        # Between beads 15 and 30 the wave is steady.
        force = run["impacts/force"].values[np.argsort(run["impacts/site"].values)]
        assert np.ptp(force[15:30]) < 1e-3 * force[20]

        time = run["time"].values
        v = run["velocity"].values[:, :, 0]
        wave = 15 / (peak_time(time, v[:, 30]) - peak_time(time, v[:, 15]))
        theory = np.sqrt(0.8) * A ** (1 / 3) * force[20] ** (1 / 6) / np.sqrt(M)
        ratios.append(wave / theory)

        centred = v[int(v[:, 20].argmax())]
        assert (centred > 0.005 * centred.max()).sum() == 5

    assert ratios == pytest.approx([1.0124] * 2, abs=5e-4)
    # The force to the power 1/6 is exact.
    assert ratios[0] == pytest.approx(ratios[1], rel=1e-4)


@pytest.mark.parametrize("factor", ["paper", "lankarani-nikravesh", "flores", "exact"])
def test_two_masses_part_as_the_law_predicts(tmp_path, factor):
    """Momentum and the law's effective restitution e give speeds v (1 -+ e)/2 after an impact and its loss."""
    e = Contact("hertz", A, 0.5, factor=factor).effective_restitution
    v = 0.2

    run = beads(
        tmp_path, u=0.0, v=np.array([v, 0.0]), end=1e-3, samples=11, restitution=0.5, damping=factor, clearance=1e-5
    )

    assert run["velocity"].values[-1, :, 0] == pytest.approx(v * np.array([1 - e, 1 + e]) / 2, rel=1e-7)
    # The loss is half the reduced mass M/2 times the difference of the squared relative speeds.
    assert run["impacts/loss"].values == pytest.approx(M / 4 * v**2 * (1 - e**2), rel=1e-6)


# A mass on a spring K to its neighbour, and a stop of stiffness KC to ground at D.
K = 1e3
KC = 4e4
D = 1e-4
STOPS = {"law": "bilinear", "stiffness": KC, "pair": [0, 1], "next_cell": False, "side": "plus", "sites": [1, 2]}
HELD = {
    "cell": {"masses": [M], "springs": [{"start": 1, "end": 1, "stiffness": K, "next_cell": True}]},
    "ends": "fixed",
}


@pytest.mark.parametrize("engine", ["ts", "propagator"])
@pytest.mark.parametrize(("end", "interval"), [(1.7e-3, 0.9e-3), (1.2e-3, 0.7e-3), (1.5e-3, 4e-4)])
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


def test_a_mass_bounces_on_a_stop_as_in_closed_form(tmp_path):
    """Two masses that move in phase, each on a spring K with a stop, have 100 impacts at the onsets in closed form."""
    start = -5 * D
    free = np.sqrt(K / M)
    stopped = np.sqrt((K + KC) / M)

    # The motion is a cosine about 0 until the mass meets the stop, then harmonic about the equilibrium in contact.
    angle = np.pi - np.arccos(D / abs(start))
    beyond_equilibrium = D * K / (K + KC)
    speed = free * np.sqrt(start**2 - D**2)
    in_contact = 2 * np.arctan2(speed / stopped, beyond_equilibrium) / stopped
    period = 2 * angle / free + in_contact
    onsets = angle / free + period * np.arange(100)

    run = beads(
        tmp_path,
        u=np.full(2, start),
        v=0.0,
        end=onsets[-1] + 0.5 * period,
        samples=301,
        frequency=free,
        lattice=HELD,
        rtol=1e-12,
        clearance=D,
        **STOPS,
    )

    found = run["impacts/onset"].values[run["impacts/site"].values == 1]
    assert len(found) == 100
    assert np.abs(found - onsets).max() < 1e-9 * onsets[-1]
    assert run["impacts/approach_velocity"].values == pytest.approx(speed, rel=1e-9)


def test_with_a_loss_its_speeds_fall_geometrically(tmp_path):
    """With a lossy stop at the spring's rest position, every impact takes the same time and scales the speed alike.

    Spring, stop and damping force are all proportional to the speed of approach.
    """
    contact = Contact("bilinear", KC, 0.95, factor="exact")

    def rate(_, y):
        push = KC * y[0] * (1 + contact.damping * y[1])
        return [y[1], -(K * y[0] + push) / M]

    def separation(_, y):
        return y[0]

    separation.terminal = True
    separation.direction = -1
    impact = solve_ivp(rate, (0, 1), [0.0, 1.0], "DOP853", events=separation, rtol=1e-12, atol=1e-16)
    ratio = -impact.y[1, -1]
    free = np.sqrt(K / M)
    period = np.pi / free + impact.t[-1]

    run = beads(
        tmp_path,
        u=np.full(2, -5 * D),
        v=0.0,
        end=40.4 * period,
        samples=201,
        frequency=free,
        lattice=HELD,
        rtol=1e-11,
        restitution=0.95,
        damping="exact",
        **STOPS,
    )

    first_site = run["impacts/site"].values == 1
    onsets = run["impacts/onset"].values[first_site]
    speeds = run["impacts/approach_velocity"].values[first_site]
    assert len(speeds) == 40
    assert speeds[1:] / speeds[:-1] == pytest.approx(np.full(39, ratio), rel=1e-8)
    assert np.diff(onsets) == pytest.approx(np.full(39, period), rel=1e-8)
