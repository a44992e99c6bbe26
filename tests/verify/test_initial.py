"""Runs that begin in motion: modes, packets and states from files do what theory says, on both engines."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import CubicSpline

from tests.conftest import StopAt, assert_same_bits, datasets
from vipetsc.case import Case, CaseError, NnmCase
from vipetsc.dynamics import simulate
from vipetsc.io.netcdf import variable, write_netcdf
from vipetsc.io.store import RunMemory
from vipetsc.lattice import bloch
from vipetsc.lattice.modes import linear_modes, mode_frequency
from vipetsc.modes.branches.follow import follow_all
from vipetsc.spectra.modal_energies import ModalParts

ENGINES = ("ts", "propagator")


def moving(initial: dict, **sections) -> Case:
    """A four-band lattice that nothing drives."""
    table = {"lattice": {"preset": "four-band", "cells": 40}, "contacts": {"sites": 0}, "initial": initial}
    for name, values in sections.items():
        table[name] = table.get(name, {}) | values
    return Case.from_table({"name": "moving"} | table)


def run(case: Case) -> xr.Dataset:
    memory = RunMemory()
    result = simulate(case, memory)
    assert result.complete
    assert result.statistics["ledger_error"] < 1e-8
    return memory.dataset


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_mode_stays_a_mode(engine, ends):
    case = moving({"kind": "mode", "number": 50, "energy": 2e-3}, lattice={"ends": ends},
                  time={"engine": engine, "end": 0.02, "rtol": 1e-13})  # fmt: skip
    chain = case.model().chain
    omega = mode_frequency(chain, 50)
    assert case.drive.frequency == omega
    data = run(case)
    work = data["energy/work"].values
    assert work == pytest.approx(2e-3, rel=1e-12)
    assert np.ptp(work) == 0.0
    modes = linear_modes(chain)
    energy = 0.5 * np.abs(modes.amplitudes(data["displacement"].values, data["velocity"].values)) ** 2
    own = np.abs(modes.frequency - omega) < 1e-6 * omega  # on a ring, both ways
    assert own.sum() == (2 if ends == "periodic" else 1)
    assert energy[:, own].sum(axis=1) == pytest.approx(2e-3, rel=1e-12)
    u = data["displacement"].values
    wave = u[:1] * np.cos(omega * data["time"].values)[:, None, None]
    assert np.abs(u - wave).max() < 1e-12 * np.abs(u).max() * omega * 0.02
    assert np.abs(u).max() == pytest.approx(case.initial.amplitude, rel=1e-12)


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_packet_travels_with_the_group_velocity_on_its_band(engine, way):
    initial = {"kind": "packet", "band": 2, "wavenumber": "2pi/5", "cell": 120, "width": 8, "direction": way}
    case = moving(initial | {"amplitude": 1e-4}, lattice={"cells": 240}, time={"engine": engine, "end": 0.1})
    assert case.drive.cell == 120
    data = run(case)
    model, v = case.model(), data["velocity"].values
    parts = ModalParts.of(model.chain)
    by_part = parts.energies(data["displacement"].values, v, [0, len(v) - 1]).sum(axis=1)
    assert by_part[parts.parts.names.index("band 2")] == pytest.approx(data["energy/work"][0].item(), rel=1e-9)
    # The energy's middle moves with the mean of the group velocity over the packet's waves.
    k = 2 * np.pi / 5 + np.linspace(-0.7, 0.7, 2001)
    point = bloch(model.chain.cell, k)
    weight = (point.frequency[:, 1] * np.exp(-0.5 * ((k - 2 * np.pi / 5) * 8) ** 2)) ** 2
    speed = np.average(point.group_velocity[:, 1], weights=weight)
    energy = (v**2 @ np.asarray(model.chain.cell.masses)).astype(float)
    middle = (energy * data["cell"].values).sum(axis=1) / energy.sum(axis=1)
    assert np.polyfit(data["time"].values, middle, 1)[0] == pytest.approx(way * speed, rel=2e-3)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_run_goes_on_from_a_sample_of_another_in_the_middle_of_a_contact(engine, tmp_path):
    """Without loss the state is all there is to know."""
    contacts = {"sites": [20, 22], "clearance": 1e-3, "stiffness": 1e4, "law": "bilinear", "restitution": 1.0}
    packet = {"kind": "packet", "band": 2, "wavenumber": "pi/2", "cell": 12, "width": 3, "amplitude": 1e-3}
    first = moving(packet, contacts=contacts, time={"engine": engine, "end": 0.06, "rtol": 1e-12})
    simulate(first, tmp_path / "first")
    with xr.open_dataset(tmp_path / "first" / "run.h5", engine="h5netcdf") as file:
        time, u = file["time"].values, file["displacement"].values
    impacts = datasets(tmp_path / "first" / "run.h5")
    inside = (time[:, None] > impacts["impacts/onset"]) & (time[:, None] < impacts["impacts/separation"])
    at = int(np.flatnonzero(inside.any(axis=1))[2])
    initial = {"kind": "file", "path": str(tmp_path / "first" / "run.h5"), "time": float(time[at])}
    second = moving(initial, contacts=contacts, time={"engine": engine, "end": 0.02, "rtol": 1e-12})
    assert second.drive.frequency == first.drive.frequency
    data = run(second)
    later = data["displacement"].values
    assert data["impacts/onset"][0] == 0.0
    assert np.abs(later - u[at : at + len(later)]).max() < 3e-8 * np.abs(u).max()


@pytest.mark.parametrize("engine", ENGINES)
def test_a_contact_that_begins_closed_takes_the_approach_of_an_impact_without_loss(engine):
    """One mode with w beyond the clearance: mu (w'_minus^2 - w'^2)/2 is the energy in the contact."""
    contacts = {"sites": [20], "clearance": 1e-4, "stiffness": 2e5, "law": "hertz", "restitution": 0.6}
    case = moving({"kind": "mode", "number": 70, "amplitude": 5e-4}, contacts=contacts,
                  time={"engine": engine, "end": 0.01})  # fmt: skip
    data, cell = run(case), case.model().chain.cell
    u = data["displacement"][0, 19].values
    depth = abs(u[cell.resonator] - u[cell.host]) - 1e-4
    assert depth > 0
    stored = 2e5 * depth**2.5 / 2.5
    assert data["energy/contact"][0] == pytest.approx(stored, rel=1e-9)
    side = np.sign(u[cell.resonator] - u[cell.host])
    speed = side * np.sqrt(2 * stored / cell.reduced_mass)
    assert data["impacts/approach_velocity"][0] == pytest.approx(speed, rel=1e-12)
    assert data["impacts/side"][0] == side
    assert data["impacts/loss"][0] > 0


def test_the_engines_agree_from_closed_contacts_on():
    initial = {"kind": "packet", "band": 2, "wavenumber": "pi/2", "cell": 20, "width": 3, "amplitude": 2e-3}
    contacts = {"sites": [19, 20, 21, 30], "clearance": 1e-3, "restitution": 0.7, "stiffness": 1e6}
    for extra in ({}, {"adhesion": "clip", "restitution": 0.2}):
        runs = [run(moving(initial, contacts=contacts | extra, time={"engine": e, "end": 0.004})) for e in ENGINES]
        assert (runs[0]["impacts/onset"] == 0).sum() >= 2
        first, second = (data["displacement"].values for data in runs)
        assert np.abs(first - second).max() < 1e-7 * np.abs(first).max()


@pytest.mark.parametrize("engine", ENGINES)
def test_a_stopped_run_goes_on_to_the_same_bits(engine, tmp_path):
    initial = {"kind": "packet", "band": 2, "wavenumber": "pi/2", "cell": 20, "width": 3, "amplitude": 2e-3}
    case = moving(initial, contacts={"sites": [19, 21], "clearance": 1e-3, "stiffness": 1e6, "restitution": 0.7},
                  time={"engine": engine, "end": 0.06})  # fmt: skip
    simulate(case, tmp_path / "whole")
    stopped = simulate(case, tmp_path / "parts", stop=StopAt(0 if engine == "propagator" else 300))
    assert stopped.resumable
    assert simulate(case, tmp_path / "parts").complete
    assert_same_bits(*(datasets(tmp_path / name / "run.h5") for name in ("whole", "parts")))


def put_state(path, chain, u, v) -> None:
    cells, dofs = np.arange(11, 31), np.arange(1, 5)
    data = {"cell": variable("cell", cells, "1", "cell"), "dof": variable("dof", dofs, "1", "mass"),
            "displacement": variable(("cell", "dof"), u[10:30], "m", "displacement"),
            "velocity": variable(("cell", "dof"), v[10:30], "m/s", "velocity")}  # fmt: skip
    write_netcdf(path, xr.Dataset(data))


def test_a_file_that_changes_is_noticed(tmp_path):
    u, v = np.random.default_rng(0).standard_normal((2, 40, 4)) * 1e-4
    put_state(tmp_path / "state.h5", None, u, v)
    initial = {"kind": "file", "path": str(tmp_path / "state.h5")}
    case = moving(initial, drive={"amplitude": 0.0, "frequency": 900.0}, time={"end": 0.01})
    data = run(case)
    assert np.array_equal(data["displacement"][0].values[10:30], u[10:30])
    assert not data["velocity"][0].values[[*range(10), *range(30, 40)]].any()
    spline = CubicSpline(data["time"].values[:3], data["displacement"].values[:3])
    assert spline(0.0, 1)[10:30] == pytest.approx(v[10:30], abs=0.2)
    put_state(tmp_path / "state.h5", None, u, 2 * v)
    with pytest.raises(CaseError, match="has changed since"):
        simulate(case, RunMemory())
    assert Case.from_toml(case.to_toml()) == case  # results are read where the file is another, or gone
    (tmp_path / "state.h5").unlink()
    assert Case.from_toml(case.to_toml()) == case
    with pytest.raises(CaseError, match=r"initial\.path"):
        simulate(case, RunMemory())


@pytest.mark.slow
def test_a_breather_comes_back_after_its_period_on_both_engines(tmp_path):
    """From the file of a condensed branch, whose harmonics left out are 1e-8 of the motion."""
    lattice = {"preset": "four-band", "reading": "calibrated", "cells": 14}
    contacts = {"law": "hertz", "sites": [6], "clearance": 10**-2.75, "restitution": 1.0}
    nnm = {"system": "condensed", "start_frequency": [1600.0], "truncation": 1e-8, "tolerance": 1e-12, "points": 1}
    case = NnmCase.from_table({"name": "b", "lattice": lattice, "contacts": contacts, "nnm": nnm})
    follow_all(case, tmp_path, MPI.COMM_SELF)
    period = 2 * np.pi / 1600
    initial = {"kind": "file", "path": str(tmp_path / "branch-breather-1600.h5"), "orbit": 1}
    for engine in ENGINES:
        time = {"engine": engine, "end": period, "sample_interval": period / 16, "rtol": 1e-13}
        data = run(moving(initial, lattice=lattice, contacts=contacts, time=time))
        u, w = data["displacement"].values, np.abs(np.diff(data["displacement"].values[:, 5, 1:3])).max()
        assert w == pytest.approx(1.286 * 10**-2.75, rel=1e-3)
        assert len(data["impacts/onset"]) == 3  # closed at the start, the other side, and closed again
        assert np.abs(u[-1] - u[0]).max() < 1e-7 * np.abs(u[0]).max()
        assert np.abs(u[8] + u[0]).max() < 1e-7 * np.abs(u[0]).max()
