"""An ensemble holds every member at the values of its keys, and the fits of its curves from the peak on."""

import json
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from tests.conftest import put_members, record_of_linear
from vipetsc.case import Case, Sweep
from vipetsc.io.netcdf import variable
from vipetsc.io.read import open_ensemble, select
from vipetsc.io.records import RecordFile
from vipetsc.lattice import four_band
from vipetsc.paper.engines import agreement, sampled
from vipetsc.sources import source_key
from vipetsc.studies.ensemble import FAILED, MISSING, SCALED, Results, _fits, fit_curve
from vipetsc.studies.linear_run import LinearRun, envelope_squares, first_site_cell
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
# The member of ``folder`` that failed.
FAILING = 5


def transfer_of(case: Case) -> float:
    """Return a number that differs between all members."""
    sites = len(case.contacts.sites)
    return case.drive.amplitude + 100 * sites + 1000 * case.drive.cycles + 1e5 * (case.contacts.law == "hertz")


def put_sweep(
    folder: Path, plan: Sweep, failing: Collection[int] = (), transfer: Callable[[Case], float] = transfer_of
) -> Path:
    """Write a finished sweep whose members have prescribed measures, without a simulation, and return its folder."""

    def outcome(number: int, case: Case) -> dict[str, Any] | str:
        if number in failing:
            return "ArithmeticError: overflow"
        statistics = {"episodes": number, "work": 2.0, "dissipated": 0.5, "ledger_error": 0.0, "engine": "ts"}
        return {"statistics": statistics, "measures": {"ibtet": transfer(case)}}

    put_members(folder, plan, outcome)
    return folder


@pytest.fixture
def folder(tmp_path):
    """Return the folder of a sweep of which one member failed."""
    return put_sweep(tmp_path / "all", Sweep.from_table(SWEEP), failing=[FAILING])


def test_warnings_that_differ_in_numbers_alone_are_one():
    """Warnings that differ in numbers alone are merged, with the number of members that have them."""
    warnings = ["deep: 0.0052 m", "deep: 5.3e-03 m", "lost 2 of 5", "deep: 0.0052 m", "lost 2 of 5", "alone"]
    assert summarise(warnings) == [
        "3 members, for instance: deep: 5.3e-03 m",
        "2 members: lost 2 of 5",
        "1 member: alone",
    ]


def test_a_sample_is_compared_member_by_member(folder, tmp_path):
    """Members of a sample are compared with the same members of the sweep; a difference beyond 1e-3 is no agreement.

    Neither is a member that failed in one of the two, of which nothing can be compared.
    """
    sample = sampled(Sweep.from_table(SWEEP), 6, 1)
    members = sample.members()
    assert len(members) == 6
    other = members[3].case

    # One member differs by more than the 1e-3 that pass as agreement, the others by less.
    def transfer(case: Case) -> float:
        return transfer_of(case) + (2e-3 if case == other else 5e-4)

    rows = agreement(folder, put_sweep(tmp_path / "sample", sample, failing=[1], transfer=transfer))

    assert [row["amplitude"] for row in rows] == sorted(member.case.drive.amplitude for member in members)
    failed = [row for row in rows if -1 in row["episodes"]]
    assert failed
    assert not any(row["agrees"] or row["differences"] for row in failed)
    compared = [row for row in rows if row not in failed]
    assert [row["amplitude"] for row in compared if not row["agrees"]] == [other.drive.amplitude]
    for row in compared:
        assert row["same"] == (row["episodes"][0] == row["episodes"][1])
        assert row["largest"] == pytest.approx(5e-4 if row["agrees"] else 2e-3)


def test_every_member_stands_at_the_values_of_its_keys(folder):
    """Every member has its place by the values of its keys, zipped ones too; a failed member has NaN and a status."""
    ensemble = open_ensemble(folder)
    assert ensemble["ibtet"].dims == ("law", "sites", "amplitude")
    assert dict(ensemble["cycles"].sizes) == {"sites": 3}

    sweep = Sweep.from_table(SWEEP)
    for number, (name, member) in enumerate(zip(sweep.ids(), sweep.members(), strict=True)):
        case = member.case
        stored = select(
            ensemble,
            law=case.contacts.law,
            sites=json.dumps(case.contacts.sites),
            cycles=case.drive.cycles,
            amplitude=case.drive.amplitude,
        )
        assert stored["member"].item() == name
        assert stored["number"].item() == number
        if number == FAILING:
            assert stored["status"].item() == FAILED
            assert np.isnan(stored["ibtet"].item())
        else:
            assert stored["status"].item() == 0
            assert stored["contact_episodes"].item() == number
            assert stored["ibtet"].item() == transfer_of(case)
            assert stored["dissipated_fraction"].item() == 0.25

    assert [(row["place"], row["reason"]) for row in json.loads(ensemble.attrs["failed"])] == [
        ([0, 1, 1], "ArithmeticError: overflow")
    ]
    assert json.loads(ensemble.attrs["rtol"]) == [1e-10]
    assert json.loads(ensemble.attrs["engine"]) == ["ts"]


def test_a_power_law_is_fitted_from_the_largest_value_on():
    """The fit of a curve begins at its largest value; amplitudes may be in any order."""
    amplitude = np.geomspace(1.0, 100.0, 12)
    law = 3.0 * amplitude**-0.8
    # A smaller peak comes before.
    curve = law.copy()
    curve[:4] = 0.1, 0.7, 0.2, 0.3
    order = np.random.default_rng(3).permutation(12)

    fit = fit_curve(amplitude[order], curve[order], normalise=False)

    assert (fit["peak_amplitude"], fit["peak"], fit["points"]) == (amplitude[4], law[4], 8)
    assert fit["exponent"] == pytest.approx(-0.8, abs=1e-12)
    assert fit["exponent_nonlinear"] == pytest.approx(-0.8)
    assert fit["factor"] == pytest.approx(3.0)
    assert fit["r2_log_log"] == pytest.approx(1.0)
    assert fit["is_power_law"] == 1

    # Three points are fitted but are no power law; two are not fitted.
    assert fit_curve(amplitude[:7], curve[:7], normalise=False)["is_power_law"] == 0
    assert np.isnan(fit_curve(amplitude[:6], curve[:6], normalise=False)["exponent"])


@pytest.mark.parametrize("unit", ["N", "m"])
def test_a_fit_has_the_unit_of_the_amplitude(unit):
    """A fit has the units of the amplitude, of a force or of a wall that moves by metres, and of the measure."""
    amplitude = np.geomspace(1.0, 100.0, 12)
    data = {
        "amplitude": variable("amplitude", amplitude, unit, "drive.amplitude"),
        "ibtet": variable("amplitude", 1 / amplitude, "1", "transfer"),
        "entropy/masked": variable("amplitude", 1 / amplitude, "bit", "entropy"),
    }
    fits = _fits(data, "amplitude")

    expected = {
        "fits/ibtet/peak_amplitude": unit,
        "fits/ibtet/factor": "1",
        "fits/entropy/masked/peak": "bit",
        "fits/entropy/masked/factor_nonlinear": "bit",
        "normalised_fits/entropy/masked/peak": "bit",
        "normalised_fits/entropy/masked/factor": "1",
    }
    assert {name: fits[name].attrs["units"] for name in expected} == expected
    assert unit in fits["fits/ibtet/factor"].attrs["long_name"]
    assert "normalised_fits/ibtet/factor" not in fits


@pytest.mark.parametrize("exponent", [-0.5, -0.2, -1.3])
def test_the_exponent_of_an_entropy_does_not_depend_on_the_range_of_amplitudes(exponent):
    """An entropy 2 A^b bit has the exponent b in two sweeps; that of the normalised values differs between them."""
    found = {}
    for highest in (100.0, 1000.0):
        amplitude = np.geomspace(10.0, highest, 12)
        data = {
            "amplitude": variable("amplitude", amplitude, "N", "drive.amplitude"),
            "entropy/joint": variable("amplitude", 2 * amplitude**exponent, "bit", "entropy"),
        }
        found[highest] = _fits(data, "amplitude")

    for fits in found.values():
        assert fits["fits/entropy/joint/exponent"].values == pytest.approx(exponent)
        assert fits["fits/entropy/joint/exponent_nonlinear"].values == pytest.approx(exponent)
        assert fits["fits/entropy/joint/factor"].values == pytest.approx(2.0)
    normalised = [fits["normalised_fits/entropy/joint/exponent"].item() for fits in found.values()]
    assert abs(normalised[0] - normalised[1]) > 0.1


def linear_wave(case: Case, peak: np.ndarray) -> xr.Dataset:
    """Return a run whose hosts have their largest velocities at the times ``peak`` (cell,), resonators 0.1 s later."""
    cell = four_band()
    time = np.linspace(0, 1, 201)
    velocity = np.zeros((201, 30, 4))
    displacement = np.zeros((201, 30, 4))
    # The largest velocity in size is negative.
    velocity[..., cell.host] = -np.exp(-(((time[:, None] - peak) / 0.05) ** 2))
    velocity[..., cell.resonator] = 5 * np.exp(-(((time[:, None] - peak - 0.1) / 0.05) ** 2))
    displacement[..., cell.resonator] = 3e-3
    displacement[..., cell.host] = -1e-3
    dims = ("time", "cell", "dof")
    data = {
        "time": time,
        "displacement": (dims, displacement),
        "velocity": (dims, velocity),
        "energy/work": ("time", time),
    }
    return xr.Dataset(data, attrs={"case": case.to_toml()})


def test_a_linear_wave_arrives_with_its_host_and_reaches_clearances_by_its_envelope():
    """A linear run yields the time of the largest |v| of the hosts in each cell, and the envelope of w.

    The envelope is the largest (w^2 + (w'/omega)^2)^(1/2); times the amplitude and over the clearance it says how near
    a member comes to its stops.
    """
    case = Case.load(overrides=["lattice.cells=30", "contacts.sites=[20, 7, 3]", "drive.cell=5"])
    peak = 0.2 + 0.02 * np.arange(30)
    data = linear_wave(case, peak)

    wave = LinearRun.of(data, statistics={"work": 0.0}, sites=(), names=())

    # The sampling interval is 5 ms, and the bound is half of it.
    assert wave.arrival == pytest.approx(peak, abs=0.0026)
    assert wave.statistics == {"work": 1.0}
    assert first_site_cell(case) == 7
    assert wave.arrival_at(7) == wave.arrival[6]
    assert wave.arrival_at(0) is None

    # The envelope of blocks is that of all samples; the case is read once for all blocks.
    samples = data.sizes["time"]
    blocks = np.sqrt(envelope_squares(data, [3, samples // 2, samples]))
    assert np.array_equal(blocks.max(axis=0), wave.envelope)
    assert np.array_equal(np.maximum(blocks[0], blocks[1]), np.sqrt(envelope_squares(data, [samples // 2])[0]))
    assert Case.of(data) is Case.of(data)
    first = data.isel(time=[0])
    assert np.array_equal(envelope_squares(data, [1]), envelope_squares(first, [1]))
    assert envelope_squares(first, [1]).any()

    # The displacement w of 4 mm is constant here, so that the envelope is largest where w' is.
    velocity = data["velocity"].values
    cell = four_band()
    rate = np.abs(velocity[..., cell.resonator] - velocity[..., cell.host]).max(axis=0)
    assert wave.envelope == pytest.approx(np.hypot(4e-3, rate / case.drive.frequency), rel=1e-12)
    expected = case.drive.amplitude * wave.envelope[[19, 6, 2]] / np.asarray(case.contacts.clearance)
    assert wave.reached(case) == pytest.approx(expected)


def test_the_latest_record_counts_but_no_failure_after_a_success(folder):
    """A later record of a member replaces an earlier one, except a failure after a success."""
    sweep = Sweep.from_table(SWEEP)
    put_members(folder, sweep, lambda number, case: "later", file=1)
    results = Results(sweep, folder)
    assert (results.status == FAILED).sum() == 1
    assert results.reasons == {FAILING: "later"}

    results.merge_files()
    assert [path.name for path in folder.glob("*.jsonl")] == ["members.jsonl"]
    assert (folder / "members.jsonl").read_bytes().count(b"\n") == len(sweep.ids())
    assert Results(sweep, folder).reasons == {FAILING: "later"}


def scaled_record(name: str, site: int, work: float, warnings: list[str]) -> dict[str, Any]:
    """Return the record of a member without contact that has the measures of the linear run ``wave`` at ``site``."""
    statistics = {"episodes": 0, "dissipated": 0.0, "engine": "ts", "work": work, "ledger_error": 0.0}
    return {
        "kind": "member",
        "key": name,
        "source": source_key(),
        "warnings": warnings,
        "statistics": statistics,
        "cpu_seconds": 0.0,
        "rtol": 1e-9,
        "linear": "wave",
        "site": site,
    }


def test_a_scaled_member_has_the_measures_of_its_linear_run_at_its_first_site(tmp_path):
    """A member without contact has the measures of the linear run from its first site on."""
    # Members with equal values are one.
    sweep = Sweep.from_table(SWEEP | {"sweep": {"drive": {"amplitude": [1.0, 2.0, 1.0]}}})
    one, two = sweep.ids()[:2]
    file = RecordFile(tmp_path / "members-0.jsonl")
    file.append(scaled_record(one, site=5, work=1.0, warnings=["seen"]))
    file.append(scaled_record(two, site=9, work=4.0, warnings=["seen", "alone"]))
    # Without the record of the linear run there are no measures.
    assert (Results(sweep, tmp_path).status == MISSING).all()

    measures = {9: {"ibtet": 0.1}, 5: {"ibtet": 0.2, "entropy/history": [1.0], "entropy/snapshot": [0.0]}}
    linear = LinearRun(envelope=np.zeros(40), arrival=np.zeros(40), statistics={}, measures=measures)
    file.append(record_of_linear(linear, "wave"))
    _, warnings = conclude(Results(sweep, tmp_path))

    # What only some members have is said.
    history = "1 of 3 members have no value (NaN) of entropy/history, entropy/snapshot"
    assert warnings == ["3 members: seen", "1 member: alone", history]
    ensemble = open_ensemble(tmp_path)
    assert ensemble["status"].values.tolist() == [SCALED] * 3
    assert ensemble["work"].values.tolist() == [1, 4, 1]
    assert ensemble["ibtet"].values.tolist() == [0.2, 0.1, 0.2]
    assert np.isnan(ensemble["entropy/history"].values[1]).all()
