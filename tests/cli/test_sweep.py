"""Sweeps as a user types them: members, resuming after a kill, failures, refusals, pictures again from files."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.conftest import assert_same_bits, datasets

SWEEP = """
[lattice]
preset = "diatomic"
cells = 40
[drive]
cycles = 5
[time]
samples = 301
rtol = 1e-8
[output]
figures = false
[sweep]
measures = ["entropy"]
[sweep.contacts]
sites = [1, 2]
[sweep.drive]
amplitude = { log = [0.1, 20.0], count = 6 }
"""


@pytest.fixture
def case(tmp_path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SWEEP)
    return path


@pytest.mark.mpirun
def test_a_sweep_leaves_members_an_index_and_an_ensemble(vipetsc, in_process, case, tmp_path):
    out = tmp_path / "out"
    ended = vipetsc(2, "sweep", case, "--out", out)
    assert ended.returncode == 0, ended.stderr
    index = json.loads((out / "index.json").read_text())
    assert len(index["members"]) == 12
    assert {row["status"] for row in index["members"]} == {"complete", "scaled"}
    with h5py.File(out / "ensemble.h5") as file:
        amplitude = file["amplitude"][...]
        status, episodes, work = (file[n][...] for n in ("status", "contact_episodes", "work"))
        entropy = file["entropy/energy_weighted"][...]
        assert [d.label or d[0].name for d in file["work"].dims] == ["/sites", "/amplitude"]
    assert status.shape == (2, 6)
    assert np.array_equal(status == 1, episodes == 0)
    assert (status[:, 0] == 1).all()
    assert (status[:, -1] == 0).all()
    # Contact-free runs are one linear run: work goes with the square of the amplitude, entropy does not change.
    quiet = status[0] == 1
    assert work[0, quiet] / amplitude[quiet] ** 2 == pytest.approx(work[0, 0] / amplitude[0] ** 2, rel=1e-14)
    assert np.ptp(entropy[0, quiet]) == 0
    for row in index["members"]:
        files = {p.name for p in (out / row["id"]).iterdir()}
        assert files == {"case.toml", "run.h5", "analysis.h5", "summary.json"}
    again = in_process("sweep", case, "--out", out)
    assert re.search(r"made now +0 in", again.stdout)
    changed = in_process("sweep", case, "--out", out, "--set", "drive.cycles=6")
    assert changed.returncode == 2
    assert "holds another sweep: drive.cycles = 5 there, 6 here; --force replaces it" in changed.stderr


def test_a_scaled_member_is_what_its_simulation_would_be(in_process, case, tmp_path):
    in_process(
        "sweep",
        case,
        "--out",
        tmp_path / "out",
        "--set",
        "sweep.drive.amplitude=[0.3]",
        "--set",
        "sweep.contacts.sites=[1]",
    )
    (member,) = json.loads((tmp_path / "out" / "index.json").read_text())["members"]
    assert member["status"] == "scaled"
    folder = tmp_path / "out" / member["id"]
    ended = in_process("run", folder / "case.toml", "--out", tmp_path / "run")
    assert ended.returncode == 0, ended.stderr
    scaled, run = datasets(folder / "run.h5"), datasets(tmp_path / "run" / "run.h5")
    for name in ("energy/kinetic", "energy/spring", "energy/work"):
        assert scaled[name] == pytest.approx(run[name], rel=1e-6, abs=1e-9 * run["energy/work"].max())
    assert not scaled["impacts/onset"].size
    assert np.array_equal(scaled["time"], run["time"])


@pytest.mark.mpirun
def test_a_failed_member_is_named_and_the_others_go_on(vipetsc, case, tmp_path):
    out = tmp_path / "out"
    ended = vipetsc(2, "sweep", case, "--out", out, "--set", "sweep.contacts.sites=[[20], [41], [30]]")
    assert ended.returncode == 1
    assert "contacts.sites = [41]: outside the lattice; cells count from 1 to 40" in ended.stdout
    rows = json.loads((out / "index.json").read_text())["members"]
    assert [row["place"][0] for row in rows if row["status"] == "failed"] == [1] * 6
    with h5py.File(out / "ensemble.h5") as file:
        work = file["work"][...]
        assert np.isnan(work[1]).all()
        assert np.isfinite(work[[0, 2]]).all()
        assert len(json.loads(file.attrs["failed"])) == 6


def test_a_member_that_does_not_come_out_is_recorded(in_process, case, tmp_path):
    # A contact this stiff needs steps below the rounding of the time: the run stalls, the quiet one does not.
    out = tmp_path / "out"
    ended = in_process(
        "sweep",
        case,
        "--out",
        out,
        "--set",
        "contacts.stiffness=1e30",
        "--set",
        "time.engine=ts",
        "--set",
        "sweep.drive.amplitude=[0.1, 20.0]",
        "--set",
        "sweep.contacts.sites=[1]",
    )
    assert ended.returncode == 1
    quiet, loud = json.loads((out / "index.json").read_text())["members"]
    assert quiet["status"] == "scaled"
    assert loud["status"] == "failed"
    assert "t = " in loud["reason"]


@pytest.mark.parametrize("value", ["sweep.drive.amplitud=[1.0]", "sweep.feilds=true", "sweep.drive.amplitude=[0.0]"])
def test_bad_sweeps_write_nothing(in_process, case, tmp_path, value):
    ended = in_process("sweep", case, "--out", tmp_path / "out", "--set", value)
    assert ended.returncode == 2, ended.stdout
    assert not (tmp_path / "out").exists()


@pytest.mark.mpirun
def test_full_fields_on_request(vipetsc, in_process, case, tmp_path):
    out = tmp_path / "out"
    ended = vipetsc(
        2,
        "sweep",
        case,
        "--out",
        out,
        "--set",
        "sweep.fields=true",
        "--set",
        "sweep.drive.amplitude=[1.0]",
        "--set",
        "sweep.contacts.sites=[2]",
    )
    assert ended.returncode == 0, ended.stderr
    (member,) = json.loads((out / "index.json").read_text())["members"]
    # As a kill leaves it that comes before the run has begun.
    shutil.rmtree(out / member["id"])
    (out / member["id"] / "parts").mkdir(parents=True)
    again = in_process("sweep", out / "case.toml", "--out", out)
    assert again.returncode == 0, again.stderr
    found = datasets(out / member["id"] / "run.h5")
    assert found["velocity"].shape == (301, 40, 2)
    measured = datasets(out / member["id"] / "analysis.h5")
    assert measured["partition/energy"].shape[0] == 12
    assert measured["entropy/local"].shape == (301, 40)
    assert measured["partition/kinetic"] == pytest.approx(measured["kinetic_energy"].sum(axis=1), rel=1e-12)


@pytest.mark.mpirun
def test_measures_again_from_files(vipetsc, in_process, case, tmp_path):
    out = tmp_path / "out"
    keys = (
        "--set",
        "sweep.fields=true",
        "--set",
        "sweep.drive.amplitude=[0.1, 5.0]",
        "--set",
        "sweep.contacts.sites=[2]",
    )
    assert in_process("sweep", case, "--out", out, *keys).returncode == 0
    before = {p: datasets(p) for p in [*out.glob("*/analysis.h5"), out / "ensemble.h5"]}
    for path in before:
        path.unlink()
    ended = vipetsc(2, "analyse", out)
    assert ended.returncode == 0, ended.stderr
    assert len(before) == 3
    for path, found in before.items():
        assert_same_bits(found, datasets(path))
    nothing = in_process("analyse", tmp_path)
    assert nothing.returncode == 2
    assert "holds no run.h5" in nothing.stderr


def test_validate_counts_the_members(in_process, case):
    ended = in_process("validate", case, "--set", "sweep.contacts.sites=[[20], [41]]")
    assert ended.returncode == 0, ended.stderr
    assert "12 members (2 x 6), 6 of them impossible" in ended.stdout
