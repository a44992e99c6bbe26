"""Members of a sweep are scaled where nothing touches, and simulated where something may."""

import json
import os
import shutil

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import assert_same_bits, datasets
from vipetsc.case import Case, Sweep
from vipetsc.io.read import open_ensemble
from vipetsc.parallel import StopRequest
from vipetsc.studies.ensemble import COMPLETE, SCALED
from vipetsc.studies.linear_run import linear_case, linear_name
from vipetsc.studies.reanalysis import reanalyse_folders
from vipetsc.studies.sweep import run_sweep
from vipetsc.studies.sweep_runs import SweepRuns

TABLE = {
    "name": "margin",
    "lattice": {"preset": "four-band", "cells": 24},
    "contacts": {"sites": [8, 13], "clearance": [2e-4, 3e-4]},
    "drive": {"cycles": 4, "cell": 3},
    "time": {"end": 0.08, "rtol": 1e-9},
}


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Amplitudes at which the linear wave reaches .6, .85, 1.02, 1.1, 1.25 and 3 times the nearest clearance."""
    folder = tmp_path_factory.mktemp("members")
    case = Case.from_table(TABLE | {"drive": TABLE["drive"] | {"amplitude": 1.0}})
    plan = Sweep.from_table(TABLE | {"sweep": {"drive": {"amplitude": [1.0]}}})
    runs = SweepRuns(plan, folder, MPI.COMM_SELF, StopRequest())
    runs.make_linear(linear_case(case), ())
    one = runs.linear[linear_name(case)].reached(case).max()
    shares = np.array([0.6, 0.85, 1.02, 1.1, 1.25, 3.0])
    table = TABLE | {"sweep": {"drive": {"amplitude": (shares / one).tolist()}}}
    result = run_sweep(Sweep.from_table(table), folder / "sweep")
    assert result.complete
    return shares, open_ensemble(folder / "sweep"), folder / "sweep"


def test_a_member_is_simulated_unless_its_wave_stays_well_inside_the_clearance(sweep):
    shares, ensemble, _ = sweep
    assert ensemble["status"].values.tolist() == [SCALED if share < 0.9 else COMPLETE for share in shares]
    # The wave that reaches a clearance touches it: scaling such a member would lose its contacts.
    touching = shares > 1.05
    assert (ensemble["contact_episodes"].values[touching] > 0).all()
    assert (ensemble["contact_episodes"].values[shares < 1] == 0).all()
    assert (ensemble["dissipated_fraction"].values[touching] > 0).all()


def test_energies_of_scaled_members_go_with_the_square_of_the_amplitude(sweep):
    _, ensemble, _ = sweep
    amplitude, work = ensemble["amplitude"].values[:2], ensemble["work"].values[:2]
    assert work[0] > 0 and work[1] / work[0] == pytest.approx((amplitude[1] / amplitude[0]) ** 2, rel=1e-13)
    for name in ("ibtet", "bands/share", "entropy/history", "entropy/masked"):
        np.testing.assert_array_equal(*ensemble[name].values[:2], name)
    assert not ensemble["dissipated_fraction"].values[:2].any()


def test_what_is_kept_does_not_change_what_is_measured(sweep, tmp_path):
    _, ensemble, _ = sweep
    amplitudes = ensemble["amplitude"].values[2:5].tolist()  # those that a coarse linear wave might take for quiet
    table = TABLE | {"sweep": {"drive": {"amplitude": amplitudes}}, "output": {"stride": 10, "every": 2}}
    assert run_sweep(Sweep.from_table(table), tmp_path / "thin").complete
    thin = open_ensemble(tmp_path / "thin")
    for name in ("status", "contact_episodes", "ibtet", "entropy/energy_weighted", "entropy/masked", "bands/share"):
        np.testing.assert_array_equal(thin[name].values, ensemble[name].values[2:5], name)


def test_records_that_were_damaged_are_named_and_made_again(sweep, tmp_path):
    _, _, folder = sweep
    out = shutil.copytree(folder, tmp_path / "out")
    before, plan = datasets(out / "ensemble.h5"), Sweep.load(out / "case.toml")
    lines = (out / "members.jsonl").read_bytes().splitlines(keepends=True)
    assert len(lines) == 7 and b'"linear"' in lines[0][:10]  # the linear run, then the members
    for number, made in ((0, 2), (2, 1), (6, 1)):  # without the linear run, those that are scaled from it are made too
        damaged = [line.replace(b"2", b"3", 1) if i == number else line for i, line in enumerate(lines)]
        (out / "members.jsonl").write_bytes(b"".join(damaged))
        again = run_sweep(plan, out)
        assert again.complete and again.newly_made == made
        said = f"{out}/members.jsonl, line {number + 1}: cut off or damaged; what it told is made again"
        assert [told for told in again.warnings if "meets the right end" not in told] == [said]
        assert_same_bits(before, datasets(out / "ensemble.h5"))
        assert (out / "members.jsonl").read_bytes().count(b"\n") == 7
    for name in ("ensemble.h5", "index.json"):
        os.truncate(out / name, 20)
        again = run_sweep(plan, out)
        assert again.complete and again.newly_made == 0
        assert_same_bits(before, datasets(out / "ensemble.h5"))
        assert json.loads((out / "index.json").read_text())["members"]["missing"] == 0


@pytest.mark.slow
def test_a_member_whose_fields_are_thinned_is_measured_from_all(tmp_path):
    """Its run keeps what it was asked to, its analysis is that of everything; damaged files are made again."""
    table = TABLE | {"sweep": {"fields": True, "drive": {"amplitude": [60.0]}}}
    thin = {"fields": ["velocity"], "window": [5, 9], "every": 4, "stride": 3}
    for name, output in (("all", {}), ("thin", thin)):
        assert run_sweep(Sweep.from_table(table | {"output": output}), tmp_path / name).complete
    (whole, kept) = (next((tmp_path / name).glob("*/run.h5")).parent for name in ("all", "thin"))
    assert {path.name for path in kept.iterdir()} == {"run.h5", "analysis.h5"}
    assert_same_bits(datasets(whole / "analysis.h5"), datasets(kept / "analysis.h5"))
    everything, found = datasets(whole / "run.h5"), datasets(kept / "run.h5")
    assert "displacement" not in found and found["cell"].tolist() == [5, 9]
    np.testing.assert_array_equal(found["velocity"], everything["velocity"][::3, [4, 8]])
    np.testing.assert_array_equal(found["field_time"], everything["time"][::3])
    np.testing.assert_array_equal(found["energy/work"], everything["energy/work"])
    written = (kept / "analysis.h5").read_bytes()
    assert [path.name for path in reanalyse_folders([tmp_path / "thin"], MPI.COMM_SELF)] == ["ensemble.h5"]
    assert (kept / "analysis.h5").read_bytes() == written
    os.truncate(kept / "run.h5", 300)
    again = run_sweep(Sweep.from_table(table | {"output": thin}), tmp_path / "thin")
    assert again.newly_made == 1 and "run.h5 cannot be read" in again.warnings[0]
    assert_same_bits(found, datasets(kept / "run.h5"))


def test_a_linear_run_that_was_not_foreseen_is_made_where_it_is_needed(sweep, tmp_path, monkeypatch):
    _, ensemble, _ = sweep
    monkeypatch.setattr("vipetsc.studies.sweep.MOST_SURVEYED", 1)
    table = TABLE | {"sweep": {"contacts": {"sites": [[8, 13], [13, 15]]}, "drive": {"amplitude": [0.1, 0.2]}}}
    result = run_sweep(Sweep.from_table(table), tmp_path / "out")
    assert result.complete and (result.status == SCALED).all()
    found = open_ensemble(tmp_path / "out")["entropy/masked"].values
    assert (found[:, 0] == found[:, 1]).all() and found[0, 0] != found[1, 0]
    assert found[0, 0] == ensemble["entropy/masked"].values[0]


def test_modal_energies_of_members_are_what_work_and_losses_leave(sweep):
    shares, ensemble, _ = sweep
    energy, work = ensemble["bands/modal_energy"], ensemble["work"].values
    assert energy.attrs["parts"] == ensemble["bands/share"].attrs["parts"] and energy.sizes["part"] == 8
    left = work * (1 - ensemble["dissipated_fraction"].values)
    apart = shares < 1.2  # at the largest amplitude a site may be in contact at the end
    assert energy.values.sum(axis=1)[apart] == pytest.approx(left[apart], rel=1e-6)
    upper = energy.values[:, [4, 6]].sum(axis=1) / work
    assert ensemble["upper_share_at_end"].values == pytest.approx(upper, rel=1e-12)
