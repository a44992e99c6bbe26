"""Sweeps as a user types them: members, failures, refusals, measures again from files."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.conftest import assert_same_bits, datasets, set_words
from vipetsc.io.netcdf import open_netcdf

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


def test_a_whole_member_is_run_again_by_its_name_or_number(in_process, case, tmp_path):
    """The run of a member, simulated or scaled, has the work and entropy that the sweep has recorded for it."""
    out = tmp_path / "out"
    changes = set_words("sweep.drive.amplitude=[0.3, 20.0]", "sweep.contacts.sites=[1]")
    assert in_process("sweep", case, "--out", out, *changes).returncode == 0
    with open_netcdf(out / "ensemble.h5", "ensemble") as ensemble:
        names = ensemble["member"].values.ravel()
        status = ensemble["status"].values.ravel()
        work = ensemble["work"].values.ravel()
        entropy = ensemble["entropy/masked"].values.ravel()
    # One member is scaled, and one is simulated.
    assert status.tolist() == [1, 0]

    # The sweep is named by its folder, and by a case file in a folder without the record of the linear run.
    file = tmp_path / "sweep.toml"
    file.write_bytes((out / "case.toml").read_bytes())
    for number, (sweep, name) in enumerate(((out, names[0]), (file, "1"))):
        run = tmp_path / f"run-{number}"
        ended = in_process("run", sweep, "--member", name, "--out", run, "--set", "output.figures=false")
        assert ended.returncode == 0, ended.stderr
        found = datasets(run / "run.h5")
        measured = datasets(run / "analysis.h5")
        # A simulated member has the same bits. A scaled one is now simulated with time steps of its own, whose errors
        # of rtol = 1e-8 each add up.
        rel = 1e-6 if status[number] else 0
        assert found["energy/work"][-1] == pytest.approx(work[number], rel=rel)
        assert measured["entropy/masked"] == pytest.approx(entropy[number], rel=rel)
        assert found["velocity"].shape == (301, 40, 2)


def test_a_failed_member_is_named_and_the_others_go_on(in_process, case, tmp_path):
    """Members with a site outside the lattice are named and NaN in the ensemble; others are computed; the code is 1."""
    out = tmp_path / "out"
    ended = in_process("sweep", case, "--out", out, "--set", "sweep.contacts.sites=[[20], [41], [30]]")
    assert ended.returncode == 1
    assert "contacts.sites = [41]: outside the lattice; cells are numbered from 1 to 40" in ended.stdout

    # There is one failed member for each of the six amplitudes.
    with h5py.File(out / "ensemble.h5") as file:
        work = file["work"][...]
        assert np.isnan(work[1]).all()
        assert np.isfinite(work[[0, 2]]).all()
        assert [row["place"][0] for row in json.loads(file.attrs["failed"])] == [1] * 6


def test_a_member_that_does_not_come_out_is_recorded(in_process, case, tmp_path):
    """A member that stalls has its place and the reason in the ensemble, and the other member is not affected."""
    out = tmp_path / "out"
    # A contact this stiff needs time steps below the rounding error of the time.
    stiff = set_words("contacts.stiffness=1e45", "time.engine=ts")
    two = set_words("sweep.drive.amplitude=[0.1, 20.0]", "sweep.contacts.sites=[1]")

    ended = in_process("sweep", case, "--out", out, *stiff, *two)

    assert ended.returncode == 1
    with h5py.File(out / "ensemble.h5") as file:
        assert file["status"][...].tolist() == [[1, 2]]
        (stalled,) = json.loads(file.attrs["failed"])
    assert stalled["place"] == [0, 1]
    assert "stalled" in stalled["reason"]


def test_full_fields_on_request(in_process, case, tmp_path):
    """With sweep.fields a member keeps its run and its analysis; a member that a kill interrupted is run again."""
    out = tmp_path / "out"
    one = set_words("sweep.fields=true", "sweep.drive.amplitude=[1.0]", "sweep.contacts.sites=[2]")
    ended = in_process("sweep", case, "--out", out, *one)
    assert ended.returncode == 0, ended.stderr
    (member,) = (path.parent for path in out.glob("*/run.h5"))
    assert {path.name for path in member.iterdir()} == {"run.h5", "analysis.h5"}

    # A kill before the first sample leaves such a folder.
    shutil.rmtree(member)
    (member / "parts").mkdir(parents=True)
    repaired = in_process("sweep", out / "case.toml", "--out", out)
    assert repaired.returncode == 0, repaired.stderr

    found = datasets(member / "run.h5")
    assert found["velocity"].shape == (301, 40, 2)
    measured = datasets(member / "analysis.h5")
    assert measured["partition/energy"].shape[0] == 12
    assert measured["entropy/local"].shape == (151, 20)
    assert measured["partition/kinetic"] == pytest.approx(measured["kinetic_energy"][::2].sum(axis=1), rel=1e-6)


def test_measures_again_from_files(in_process, case, tmp_path):
    """``analyse`` computes removed analyses and a removed ensemble from the kept runs, with the same bits."""
    out = tmp_path / "out"
    two = set_words("sweep.fields=true", "sweep.drive.amplitude=[0.1, 5.0]", "sweep.contacts.sites=[2]")
    assert in_process("sweep", case, "--out", out, *two).returncode == 0

    before = {path: datasets(path) for path in [*out.glob("*/analysis.h5"), out / "ensemble.h5"]}
    for path in before:
        path.unlink()

    ended = in_process("analyse", out)
    assert ended.returncode == 0, ended.stderr
    assert len(before) == 3
    for path, found in before.items():
        assert_same_bits(found, datasets(path))

    nothing = in_process("analyse", tmp_path)
    assert nothing.returncode == 2
    assert "contains no run.h5" in nothing.stderr
