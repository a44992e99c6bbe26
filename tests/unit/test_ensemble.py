"""An ensemble holds every member at the values of its keys, and the fits of its curves from the peak on."""

import json

from mpi4py import MPI

import h5py
import numpy as np
import pytest
import xarray as xr

import vipetsc
from vipetsc.case import Case, Sweep, case_id
from vipetsc.io.netcdf import write_netcdf
from vipetsc.io.read import curves, open_ensemble, select
from vipetsc.lattice import four_band
from vipetsc.parallel import StopRequest
from vipetsc.studies.engines import agreement, sampled
from vipetsc.studies.ensemble import MISSING, fit_curve
from vipetsc.studies.members import (
    MemberStore,
    arrival_at,
    leading_cell,
    linear_folder,
    linear_wave,
    reached,
    read_wave,
)
from vipetsc.studies.sweep import conclude

SWEEP = {
    "name": "small",
    "lattice": {"preset": "four-band", "cells": 40},
    "sweep": {
        "measures": ["transfer"],
        "zip": [["contacts.sites", "drive.cycles"]],
        "contacts": {"law": ["hertz", "bilinear"], "sites": [[9], [9, 20], [9]]},
        "drive": {"cycles": [4, 4, 6], "amplitude": [8.0, 2.0, 4.0, 16.0]},
    },
}


def measure(case):
    """A number that tells the members apart."""
    sites = len(case.contacts.sites)
    return case.drive.amplitude + 100 * sites + 1000 * case.drive.cycles + 1e5 * (case.contacts.law == "hertz")


def put_sweep(folder, plan, failing, changed=lambda case: 0.0):
    """A finished sweep whose members were not simulated, but have what an ensemble is made of."""
    store, members = MemberStore(folder, plan.options, MPI.COMM_SELF, StopRequest()), plan.members()
    for number, member in enumerate(members):
        path = folder / member.id
        path.mkdir(parents=True)
        (path / "case.toml").write_text(member.case.to_toml())
        statistics = {"episodes": number, "work": 2.0, "dissipated": 0.5, "ledger_error": 0.0}
        summary = {"complete": True, "status": "complete", "statistics": statistics}
        (path / "summary.json").write_text(json.dumps(summary | {"measures": ["transfer"], "fields": False}))
        h5py.File(path / "run.h5", "w").close()
        with h5py.File(path / "analysis.h5", "w") as file:
            file["ibtet"] = measure(member.case) + changed(member.case)
    outcomes, _ = conclude(plan, members, store, failing)
    assert all(outcome.status != MISSING for outcome in outcomes)
    return folder


@pytest.fixture
def folder(tmp_path):
    """A sweep of which one member failed."""
    plan = Sweep.from_table(SWEEP)
    return put_sweep(tmp_path / "all", plan, {plan.members()[5].id: "ArithmeticError: overflow"})


def test_a_sample_is_compared_member_by_member(folder, tmp_path):
    sample = sampled(Sweep.from_table(SWEEP), 0.5, 1)
    assert len(sample.members()) == 12
    louder = sample.members()[3].case

    def changed(case):
        return 2e-3 if case == louder else 5e-4

    rows = agreement(folder, put_sweep(tmp_path / "sample", sample, {}, changed))
    assert [row["amplitude"] for row in rows] == sorted(member.case.drive.amplitude for member in sample.members())
    assert [row["amplitude"] for row in rows if not row["agrees"]] == [louder.drive.amplitude]
    for row in rows:
        assert row["same"] == (row["episodes"][0] == row["episodes"][1])
        expected = changed(louder) if not row["agrees"] else 5e-4
        assert row["largest"] == pytest.approx(expected) or not row["differences"].get("ibtet")  # that one has failed


def test_every_member_stands_at_the_values_of_its_keys(folder):
    ensemble = open_ensemble(folder)
    assert ensemble["ibtet"].dims == ("law", "sites", "amplitude")
    assert dict(ensemble["cycles"].sizes) == {"sites": 3}
    for member in Sweep.from_table(SWEEP).members():
        case, number = member.case, int(np.ravel_multi_index(member.index, ensemble["ibtet"].shape))
        keys = {"law": case.contacts.law, "sites": json.dumps(case.contacts.sites), "cycles": case.drive.cycles}
        one = select(ensemble, **keys, amplitude=case.drive.amplitude)
        assert str(one["member"].item()) == member.id == case_id(case)
        assert one["contact_episodes"].item() == number or number == 5
        if number == 5:
            assert one["status"].item() == 2 and np.isnan(one["ibtet"].item())
        else:
            assert one["status"].item() == 0 and one["ibtet"].item() == measure(case)
            assert one["dissipated_fraction"].item() == 0.25
    assert json.loads(ensemble.attrs["failed"]) == ["(0, 1, 1): ArithmeticError: overflow"]
    for curve, path in curves(ensemble):
        case = Case.load(path / "case.toml")
        assert (case.contacts.law, case.drive.cycles) == (curve["law"].item(), curve["cycles"].item())


def test_a_law_is_fitted_from_the_largest_value_on():
    amplitude = np.geomspace(1.0, 100.0, 12)
    law = 3.0 * amplitude**-0.8
    curve = np.where(np.arange(12) < 4, [0.1, 0.7, 0.2, 0.3, *[0.0] * 8], law)  # a smaller peak comes before
    order = np.random.default_rng(3).permutation(12)
    fit = fit_curve(amplitude[order], curve[order], normalise=False)
    assert (fit["peak_amplitude"], fit["peak"], fit["points"]) == (amplitude[4], law[4], 8)
    assert fit["exponent"] == pytest.approx(-0.8, abs=1e-12) and fit["factor"] == pytest.approx(3.0)
    assert fit["r2_log_log"] == pytest.approx(1.0) and fit["exponent_nonlinear"] == pytest.approx(-0.8)
    assert fit["is_power_law"] == 1 and fit_curve(amplitude[:7], curve[:7], normalise=False)["is_power_law"] == 0
    assert np.isnan(fit_curve(amplitude[:6], curve[:6], normalise=False)["exponent"])  # two points behind the peak


def test_a_linear_wave_arrives_with_its_host():
    case = Case.load(overrides=["lattice.cells=30", "contacts.sites=[20, 7, 3]", "drive.cell=5"])
    cell, time = four_band(), np.linspace(0, 1, 201)
    velocity, displacement = np.zeros((201, 30, 4)), np.zeros((201, 30, 4))
    peak = 0.2 + 0.02 * np.arange(30)
    velocity[..., cell.host] = -np.exp(-(((time[:, None] - peak) / 0.05) ** 2))  # the largest in size is negative
    velocity[..., cell.resonator] = 5 * np.exp(-(((time[:, None] - peak - 0.1) / 0.05) ** 2))
    displacement[..., cell.resonator], displacement[..., cell.host] = 3e-3, -1e-3
    dims = "time", "cell", "dof"
    data = {"time": time, "displacement": (dims, displacement), "velocity": (dims, velocity)}
    wave = linear_wave(xr.Dataset(data, attrs={"case": case.to_toml()}))
    assert wave["arrival"].values == pytest.approx(peak, abs=0.0026)
    assert leading_cell(case) == 7 and arrival_at(wave, case) == wave["arrival"][6]
    rate = np.abs(velocity[..., cell.resonator] - velocity[..., cell.host]).max(axis=0)
    assert wave["envelope"].values == pytest.approx(np.hypot(4e-3, rate / case.drive.frequency), rel=1e-12)
    expected = case.drive.amplitude * wave["envelope"].values[[19, 6, 2]] / np.asarray(case.contacts.clearance)
    assert reached(wave, case) == pytest.approx(expected)


def test_a_linear_wave_of_another_version_is_made_again(tmp_path, monkeypatch):
    case = Case.load()
    assert read_wave(tmp_path, case) is None
    folder = linear_folder(tmp_path, case)
    folder.mkdir(parents=True)
    values = {"cell": [1, 2], "envelope": ("cell", [1.0, 2.0]), "arrival": ("cell", [0.1, 0.2])}
    write_netcdf(folder / "wave.h5", xr.Dataset(values, attrs={"vipetsc_version": vipetsc.__version__}))
    assert read_wave(tmp_path, case, current=True)["arrival"].values.tolist() == [0.1, 0.2]
    monkeypatch.setattr(vipetsc, "__version__", "0.0.0")
    assert read_wave(tmp_path, case) is not None and read_wave(tmp_path, case, current=True) is None
