"""An ensemble holds every member at the values of its keys, and the fits of its curves from the peak on."""

import json

import numpy as np
import pytest
import xarray as xr

import vipetsc
from tests.conftest import put_members
from vipetsc.case import Case, Sweep
from vipetsc.io.read import curves, open_ensemble, select
from vipetsc.io.records import RecordFile
from vipetsc.lattice import four_band
from vipetsc.studies.engines import agreement, sampled
from vipetsc.studies.ensemble import FAILED, MISSING, SCALED, Results, fit_curve
from vipetsc.studies.linear_run import LinearRun, leading_cell, linear_name, read_linear
from vipetsc.studies.sweep import conclude, summarise

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


def test_warnings_that_differ_in_numbers_are_one():
    told = ["deep: 0.0052 m", "deep: 5.3e-03 m", "lost 2 of 5", "deep: 0.0052 m", "lost 2 of 5", "alone"]
    assert summarise(told) == ["3 members, for instance: deep: 5.3e-03 m", "2 members: lost 2 of 5", "1 member: alone"]


def put_sweep(folder, plan, failing=(), changed=lambda case: 0.0):
    """A finished sweep whose members were not simulated, but have what an ensemble is made of."""

    def told(number, case):
        statistics = {"episodes": number, "work": 2.0, "dissipated": 0.5, "ledger_error": 0.0, "engine": "ts"}
        row = {"statistics": statistics, "measures": {"ibtet": measure(case) + changed(case)}}
        return "ArithmeticError: overflow" if number in failing else row

    put_members(folder, plan, told)
    return folder


@pytest.fixture
def folder(tmp_path):
    """A sweep of which one member failed."""
    return put_sweep(tmp_path / "all", Sweep.from_table(SWEEP), failing=[5])


def test_a_sample_is_compared_member_by_member(folder, tmp_path):
    sample = sampled(Sweep.from_table(SWEEP), 6, 1)
    assert len(sample.members()) == 6
    louder = sample.members()[3].case

    def changed(case):
        return 2e-3 if case == louder else 5e-4

    rows = agreement(folder, put_sweep(tmp_path / "sample", sample, changed=changed))
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
    sweep = Sweep.from_table(SWEEP)
    for number, (name, member) in enumerate(zip(sweep.ids(), sweep.members(), strict=True)):
        case = member.case
        keys = {"law": case.contacts.law, "sites": json.dumps(case.contacts.sites), "cycles": case.drive.cycles}
        one = select(ensemble, **keys, amplitude=case.drive.amplitude)
        assert one["member"].item() == name and one["number"].item() == number
        assert one["contact_episodes"].item() == number or number == 5
        if number == 5:
            assert one["status"].item() == 2 and np.isnan(one["ibtet"].item())
        else:
            assert one["status"].item() == 0 and one["ibtet"].item() == measure(case)
            assert one["dissipated_fraction"].item() == 0.25
    assert json.loads(ensemble.attrs["failed"]) == ["(0, 1, 1): ArithmeticError: overflow"]
    assert (json.loads(ensemble.attrs["rtol"]), json.loads(ensemble.attrs["engine"])) == ([1e-10], ["ts"])
    for curve, first in curves(ensemble):
        case = sweep.case(first)
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
    data["energy/work"] = "time", time
    wave = LinearRun.of(xr.Dataset(data, attrs={"case": case.to_toml()}), {"work": 0.0}, (), ())
    assert wave.arrival == pytest.approx(peak, abs=0.0026) and wave.statistics == {"work": 1.0}
    assert leading_cell(case) == 7 and wave.arrival_at(7) == wave.arrival[6] and wave.arrival_at(0) is None
    rate = np.abs(velocity[..., cell.resonator] - velocity[..., cell.host]).max(axis=0)
    assert wave.envelope == pytest.approx(np.hypot(4e-3, rate / case.drive.frequency), rel=1e-12)
    expected = case.drive.amplitude * wave.envelope[[19, 6, 2]] / np.asarray(case.contacts.clearance)
    assert wave.reached(case) == pytest.approx(expected)


def test_records_of_another_version_are_made_again(folder, monkeypatch):
    sweep, case = Sweep.from_table(SWEEP), Case.load()
    run = LinearRun(np.array([1.0, 2.0]), np.array([0.1, 0.2]), {"work": 3.0}, {7: {"ibtet": 0.1}})
    file = RecordFile(folder / "members-1.jsonl")
    file.append(run.record(linear_name(case)))
    assert read_linear(folder, sweep.case(0)) is None
    again = read_linear(folder, case)
    assert again.record("") == run.record("") and again.arrival_at(2) == 0.2
    assert not (Results(sweep, folder).status == MISSING).any()
    monkeypatch.setattr(vipetsc, "__version__", "0.0.0")
    older = Results(sweep, folder)
    assert (older.status == MISSING).all() and not older.linear


def test_the_latest_record_counts_but_no_failure_after_a_success(folder):
    sweep = Sweep.from_table(SWEEP)
    put_members(folder, sweep, lambda number, case: "later", file=1)
    results = Results(sweep, folder)
    assert (results.status == FAILED).sum() == 1 and results.reasons == {5: "later"}
    results.merge_files()
    assert [path.name for path in folder.glob("*.jsonl")] == ["members.jsonl"]
    text = (folder / "members.jsonl").read_bytes()
    assert text.count(b"\n") == len(sweep.ids()) and Results(sweep, folder).reasons == {5: "later"}


def test_a_scaled_member_has_the_measures_of_its_linear_run(tmp_path):
    """Of its first site; equal members are one; without the linear run's record it is missing."""
    table = SWEEP | {"sweep": {"drive": {"amplitude": [1.0, 2.0, 1.0]}}}
    sweep = Sweep.from_table(table)
    run = LinearRun(np.zeros(40), np.zeros(40), {}, {9: {"ibtet": 0.1}, 5: {"ibtet": 0.2, "entropy/history": [1.0]}})
    run.measures[5]["entropy/snapshot"] = [0.0]
    file, statistics = RecordFile(tmp_path / "members-0.jsonl"), {"episodes": 0, "dissipated": 0.0, "engine": "ts"}
    for name, site, work in zip(sweep.ids()[:2], (5, 9), (1.0, 4.0), strict=True):
        about = {"id": name, "vipetsc_version": vipetsc.__version__, "status": "scaled"}
        about["warnings"] = ["seen"] if site == 5 else ["seen", "alone"]
        known = {"statistics": statistics | {"work": work, "ledger_error": 0.0}, "cpu_seconds": 0.0, "rtol": 1e-9}
        file.append(about | known | {"linear": "wave", "site": site})
    assert (Results(sweep, tmp_path).status == MISSING).all()
    file.append(run.record("wave"))
    _, warnings = conclude(Results(sweep, tmp_path))
    ensemble = open_ensemble(tmp_path)
    assert warnings == ["3 members: seen", "1 member: alone"]
    assert ensemble["status"].values.tolist() == [SCALED] * 3
    assert ensemble["work"].values.tolist() == [1, 4, 1] and ensemble["ibtet"].values.tolist() == [0.2, 0.1, 0.2]
    assert np.isnan(ensemble["entropy/history"].values[1]).all()
