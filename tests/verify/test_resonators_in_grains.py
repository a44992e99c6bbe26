"""Chains of grains with a resonator on a spring inside each: springs within cells, contacts alone between them.

Such chains are granular metamaterials with masses in masses; see K. Vorotnikov et al., arXiv:1709.08629 (2017), and for
pressed chains L. Liu et al., arXiv:1603.06033 (2016).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp

from tests.conftest import simulated
from vipetsc.case import Case

pytestmark = pytest.mark.parallel(1)

GRAIN = 1e-3  # kg
RESONATOR = 5e-4  # kg
SPRING = 1.2e5  # N/m: a resonator alone has a period of six contacts' durations
HERTZ = 1e9  # N/m^1.5
STRUCK = 0.1  # m/s
INSIDE = {"start": 1, "end": 2, "stiffness": SPRING}


def grains(
    engine: str = "ts",
    cells: int = 6,
    cell: dict[str, Any] | None = None,
    contacts: dict[str, Any] | None = None,
    **sections: dict[str, Any],
) -> Case:
    """The case of a row of grains of which the first is struck, by default with resonators and touching contacts."""
    joined = {"law": "hertz", "stiffness": HERTZ, "next_cell": True, "pair": [1, 1], "side": "minus", "clearance": 0.0}
    table: dict[str, Any] = {
        "lattice": {
            "cells": cells,
            "ends": "free",
            "cell": {"masses": [GRAIN, RESONATOR], "springs": [INSIDE]} | (cell or {}),
        },
        "contacts": joined | {"sites": list(range(1, cells))} | (contacts or {}),
        "initial": {"kind": "velocity", "cell": 1, "velocity": STRUCK},
        "time": {"end": 8e-4, "sample_interval": 4e-6, "rtol": 1e-11, "engine": engine},
    }
    return Case.from_table(table | {name: table.get(name, {}) | values for name, values in sections.items()})


def run_of(case: Case) -> xr.Dataset:
    """The run of a case by the engine that it names; asserts that energies balance and that the momentum stays."""
    run, result = simulated(case)
    # An engine that refuses a case is replaced by the other one, which would be compared with itself.
    assert result.statistics["engine"] == case.time.engine
    stored = run["energy/kinetic"] + run["energy/spring"] + run["energy/contact"] + run["energy/dissipated"]
    assert np.abs(run["energy/work"] - stored).max() < 1e-8 * run["energy/work"].max()

    momentum = (run["velocity"].values * case.model().chain.cell.masses).sum(axis=(1, 2))
    assert momentum == pytest.approx(momentum[0], rel=1e-9)
    return run


def integrated(case: Case, times: np.ndarray, clearance: float) -> np.ndarray:
    """Displacements and velocities (time, 2, cell, dof) of ``case`` by SciPy, from equations that are written here."""
    cells = case.lattice.cells

    def rate(_: float, state: np.ndarray) -> np.ndarray:
        u, v = state.reshape(2, cells, 2)
        inside = SPRING * (u[:, 1] - u[:, 0])
        push = HERTZ * np.maximum(u[:-1, 0] - u[1:, 0] - clearance, 0) ** 1.5
        force = np.stack([inside, -inside], axis=1)
        force[:-1, 0] -= push
        force[1:, 0] += push
        return np.concatenate([v, force / [GRAIN, RESONATOR]]).ravel()

    start = np.zeros((2, cells, 2))
    start[1, 0, 0] = STRUCK
    # Steps are much shorter than a contact, so that none is passed over.
    longest = times[1] / 4
    span = (0, times[-1])
    solution = solve_ivp(rate, span, start.ravel(), "DOP853", times, rtol=1e-12, atol=1e-18, max_step=longest)
    return solution.y.T.reshape(-1, 2, cells, 2)


def difference(run: xr.Dataset, expected: np.ndarray) -> float:
    """The largest relative error of displacements and of velocities against ``expected`` (time, 2, cell, dof)."""
    worst = 0.0
    for number, name in enumerate(("displacement", "velocity")):
        error = np.abs(run[name].values - expected[:, number]).max()
        worst = max(worst, float(error / np.abs(expected[:, number]).max()))
    return worst


# The propagator needs more than two cells, since its step couples more.
@pytest.mark.parametrize(("engine", "cells"), [("ts", 2), ("ts", 6), ("propagator", 6)])
@pytest.mark.parametrize("clearance", [0.0, 2e-6])
def test_a_struck_chain_is_that_of_an_independent_solver(engine, clearance, cells):
    """A struck chain moves as by SciPy, with grains that touch at rest and with grains at a distance.

    The engines treat the two differently: contacts that touch at rest are kept, the others are impacts.
    """
    case = grains(engine, cells, contacts={"clearance": clearance})
    run = run_of(case)
    expected = integrated(case, run["time"].values, clearance)
    assert difference(run, expected) < 1e-7
    # The wave has gone through the chain, and has left something in the resonators.
    assert np.abs(expected[-1, 1]).min() > 1e-5 * STRUCK


FINE = {"end": 2e-4, "sample_interval": 4e-7}


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_on_stiff_springs_resonators_are_part_of_their_grains(engine):
    """On stiff springs grains and resonators move as grains of both masses, up to errors of one over the stiffness."""
    first = {"cell": 1, "velocity": STRUCK}
    both = first | {"kind": "velocity", "more": [first | {"mass": 2}]}
    plain = grains(engine, cell={"masses": [GRAIN + RESONATOR], "springs": []}, time=FINE)
    expected = run_of(plain)["displacement"].values[:, :, 0]
    errors = []
    for stiffness in (1e8, 1e9):
        stiff = {"springs": [INSIDE | {"stiffness": stiffness}]}
        case = grains(engine, cell=stiff, initial=both, time=FINE)
        u = run_of(case)["displacement"].values
        errors.append(np.abs(u[:, :, 0] - expected).max() / np.abs(expected).max())
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(10, rel=0.5)


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_light_resonators_do_not_matter(engine):
    """Resonators with a millionth of the grains' mass change the motion by less than 1e-5."""
    plain = grains(engine, cell={"masses": [GRAIN], "springs": []}, time=FINE)
    expected = run_of(plain)["displacement"].values[:, :, 0]
    light = grains(engine, cell={"masses": [GRAIN, 1e-6 * GRAIN], "springs": [INSIDE | {"stiffness": 1e4}]}, time=FINE)
    u = run_of(light)["displacement"].values[:, :, 0]
    assert np.abs(u - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("branch", [0, 1])
@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_a_pressed_ring_has_the_dispersion_of_masses_in_masses(tmp_path, engine, branch):
    """Waves of a pressed ring have 4 k sin^2(kappa/2) = m omega^2 with m = m1 + m2 w^2/(w^2 - omega^2), w^2 = k2/m2.

    The stiffness k is the slope of Hertz's law at rest. Each wavenumber has one frequency below that of the resonators
    and one above.
    """
    n = 12
    depth = 1e-5
    # The amplitude is so small that the contacts are linear to 1e-6.
    amplitude = 1e-11
    kappa = 2 * np.pi * 2 / n
    k = 1.5 * HERTZ * depth**0.5
    pull = 4 * k * np.sin(kappa / 2) ** 2
    bloch = np.array([[pull + SPRING, -SPRING], [-SPRING, SPRING]]) / np.array([[GRAIN], [RESONATOR]])
    squares, shapes = np.linalg.eig(bloch)
    at = np.argsort(squares)[branch]
    omega = np.sqrt(squares[at])
    assert pull == pytest.approx(omega**2 * (GRAIN + RESONATOR * SPRING / (SPRING - RESONATOR * omega**2)), rel=1e-9)

    wave = np.cos(kappa * (np.arange(n) + 0.5))[:, None] * shapes[:, at]
    state = xr.Dataset(
        {"displacement": (("cell", "dof"), amplitude * wave), "velocity": (("cell", "dof"), 0 * wave)},
        coords={"cell": np.arange(1, n + 1), "dof": [1, 2]},
    )
    state.to_netcdf(tmp_path / "state.nc", format="NETCDF4", engine="h5netcdf")
    table = grains(cells=n).model_dump(by_alias=True, exclude_none=True)
    table["lattice"]["ends"] = "periodic"
    table["contacts"] |= {"sites": list(range(1, n + 1)), "clearance": [0.0] * n, "precompression": depth}
    table["drive"] = {"amplitude": 0.0, "frequency": float(omega)}
    table["initial"] = {"kind": "file", "path": str(tmp_path / "state.nc")}
    table["time"] = {"end": 5 * 2 * np.pi / omega, "samples": 201, "rtol": 1e-10, "engine": engine}
    run, result = simulated(Case.from_table(table))
    assert result.statistics["engine"] == engine

    expected = amplitude * np.cos(omega * run["time"].values)[:, None, None] * wave
    assert np.abs(run["displacement"].values - expected).max() < 1e-5 * np.abs(expected).max()
