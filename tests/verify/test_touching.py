"""Contacts that touch at rest, compared with an independent integration and with motions in closed form."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import xarray as xr

from tests.conftest import simulated
from vipetsc.case import Case
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory

MASSES = [1e-3, 2e-3]  # kg
STIFFNESS = 1e4  # N/m, of both springs of a cell
CELLS = 20
SITE = 10
DRIVE = {"amplitude": 10.0, "cycles": 2, "frequency": 2e3}
HERTZ = {"law": "hertz", "stiffness": 1e6}


def sprung_case(engine: str = "ts", **contacts: object) -> Case:
    """The case of a two-mass chain under a burst, with one site that has one stop without clearance."""
    springs = [
        {"start": 1, "end": 2, "stiffness": STIFFNESS},
        {"start": 2, "end": 1, "stiffness": STIFFNESS, "next_cell": True},
    ]
    return Case.from_table({
        "lattice": {"cell": {"masses": MASSES, "contact": [1, 2], "springs": springs}, "cells": CELLS},
        "contacts": HERTZ | {"clearance": 0.0, "side": "plus", "sites": [SITE]} | contacts,
        "drive": DRIVE,
        "time": {"end": 0.02, "sample_interval": 2e-4, "engine": engine},
    })  # fmt: skip


def run_complete(case: Case) -> xr.Dataset:
    """The run of a case; asserts that it is complete, by the engine that the case names, and that its ledger closes."""
    memory = RunMemory(MPI.COMM_SELF)
    result = simulate(case, memory)
    assert result.complete, result.sentence
    # An engine that refuses a case is replaced by the other one, which would be compared with itself.
    assert result.statistics["engine"] == case.time.engine

    run = memory.dataset
    stored = run["energy/kinetic"] + run["energy/spring"] + run["energy/contact"] + run["energy/dissipated"]
    # A contact that begins or ends at a wrong time would show in the balance.
    assert np.abs(run["energy/work"] - stored).max() < 1e-8 * run["energy/work"].max()
    return run


def test_the_front_of_a_wave_is_no_impact_on_a_stop_with_loss():
    """Both engines log one impact, from rest: the front of a strike 6 and 16 cells away, 1e-26 m/s or less, is none.

    The site near the strike is pressed later, the other one never.
    """
    runs = []
    for engine in ("ts", "propagator"):
        case = sprung_case(engine, restitution=0.6, approach_floor=1e-3, stiffness=1e7, sites=[3, 13])
        struck = {"kind": "velocity", "cell": 19, "velocity": 0.3}
        end = {"end": 4e-3, "sample_interval": 1e-4}
        runs.append(run_complete(case.varied(drive={"amplitude": 0.0}, initial=struck, time=end)))
    for run in runs:
        assert run["impacts/site"].values.tolist() == [2]
        assert run["impacts/approach_velocity"].values.tolist() == [0.0]
    first, second = runs
    assert first["impacts/onset"].values == pytest.approx(second["impacts/onset"].values, rel=1e-6)
    assert first["impacts/indentation"].values == pytest.approx(second["impacts/indentation"].values, rel=1e-6)


def test_a_touching_site_that_nothing_presses_is_not_said_to_be_unreached():
    # The drive is so weak that the contact's force is below all tolerances.
    case = sprung_case().varied(time={"end": 1e-3, "sample_interval": 2e-4}, drive={"amplitude": 1e-30})
    memory = RunMemory(MPI.COMM_SELF)
    result = simulate(case, memory)
    assert "no contact: nothing pressed the site that touches its stop at rest" in result.warnings


@pytest.mark.parametrize(("law", "bound"), [("bilinear", 1e-9), ("hertz", 1e-8)])
@pytest.mark.parametrize("precompression", [1e-7])
def test_steps_end_where_pressed_contacts_open_and_close(law, bound, precompression):
    """The energy error of a ring of beads that part and meet a hundred times is small, as steps end at each change.

    Changes within steps would leave errors of 1e-8 to 5e-7.
    """
    springs = [{"start": 1, "end": 2, "stiffness": 1e2}, {"start": 2, "end": 1, "stiffness": 1e2, "next_cell": True}]
    each = {"pair": [[1, 2]] * 2 + [[2, 1]] * 2, "next_cell": [False] * 2 + [True] * 2}
    stiffness = {"hertz": 1e9, "bilinear": 1e6}[law]
    contacts = {"law": law, "stiffness": stiffness, "clearance": 0.0, "side": "minus", "sites": [1, 2, 1, 2]}
    if precompression:
        contacts["precompression"] = precompression
    case = Case.from_table({
        "lattice": {"cells": 2, "ends": "periodic", "cell": {"masses": MASSES, "springs": springs}},
        "contacts": contacts | {"each": each},
        "drive": {"amplitude": 1.0, "cycles": 1, "frequency": 2e4},
        "time": {"end": 5e-3, "sample_interval": 1e-5, "engine": "ts"},
    })  # fmt: skip

    _, result = simulated(case)

    assert result.statistics["landings"] > 80
    assert result.statistics["ledger_error"] < bound


@pytest.mark.parametrize("side", ["plus", "minus"])
def test_a_mass_that_leaves_a_bilinear_stop_and_comes_back_has_the_exact_motion(side):
    """A mass pressed to a bilinear stop by a load P = k d bounces as in closed form.

    On the stop, u > -d, its motion is u'' = -omega^2 u; away from the stop it is u'' = P/m.
    """
    mass = 0.02
    omega = 3e4
    depth = 4e-6
    speed = 0.13
    sign = 1 if side == "plus" else -1
    stop = {"law": "bilinear", "stiffness": mass * omega**2, "side": side, "clearance": 0.0, "precompression": depth}
    # The mass needs neighbours to be a lattice; they pull at it with 1e-13 of the load.
    weak = {"start": 1, "end": 1, "stiffness": 1e-6, "next_cell": True}
    case = Case.from_table({
        "lattice": {"cell": {"masses": [mass], "springs": [weak]}, "cells": 4, "ends": "free"},
        "contacts": stop | {"sites": [2], "pair": [0, 1]},
        "initial": {"kind": "velocity", "cell": 2, "velocity": -sign * speed},
        "drive": {"amplitude": 0.0, "frequency": omega},
        "time": {"end": 3e-3, "sample_interval": 1e-4, "engine": "propagator", "rtol": 1e-10},
    })  # fmt: skip

    dataset, result = simulated(case)
    assert result.statistics["engine"] == "propagator"

    # On the stop u = A sin(phase), and the mass leaves where the sine is -d/A. It comes back as fast as it left.
    amplitude = speed / omega
    leaving = np.arcsin(depth / amplitude)
    rebound = np.sqrt(speed**2 - (depth * omega) ** 2)
    flight = 2 * rebound / (omega**2 * depth)
    period = flight + (np.pi + 2 * leaving) / omega

    times = dataset["time"].values
    begin = times < leaving / omega
    t = np.where(begin, 0.0, times - leaving / omega) % period
    in_the_air = -depth - rebound * t + 0.5 * omega**2 * depth * t**2
    on_the_stop = amplitude * np.sin(omega * (t - flight) - leaving)
    expected = np.where(begin, -amplitude * np.sin(omega * times), np.where(t < flight, in_the_air, on_the_stop))
    assert times[-1] > 10 * period
    found = sign * dataset["displacement"].values[:, 1, 0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * amplitude)
