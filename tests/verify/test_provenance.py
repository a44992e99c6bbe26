"""Every result file names its date, host and sources, which comparisons of results ignore."""

from __future__ import annotations

import json
import platform
import subprocess
from datetime import UTC, datetime
from pathlib import Path

from mpi4py import MPI

import vipetsc as package
from tests.conftest import assert_same_bits, datasets, small_case
from vipetsc.case import Sweep
from vipetsc.dynamics import simulate
from vipetsc.io import folder as io_folder
from vipetsc.io.netcdf import open_netcdf
from vipetsc.studies.reanalysis import measure_run
from vipetsc.studies.sweep import run_sweep

WANTED = {"vipetsc_version", "petsc_version", "revision", "command", "petsc_options", "date", "host"}
SHORT = {
    "lattice": {"preset": "four-band", "cells": 12},
    "contacts": {"sites": [4], "clearance": 2e-4},
    "drive": {"cycles": 3},
    "time": {"end": 0.02, "engine": "propagator"},
}


def attributes(path: Path) -> dict:
    """The global attributes of a result file."""
    with open_netcdf(path, "result") as data:
        return data.attrs


def test_every_output_says_when_where_and_from_what(tmp_path, monkeypatch, in_process):
    # Dates are written in whole seconds.
    before = datetime.now(UTC).replace(microsecond=0)
    simulate(small_case(**SHORT), tmp_path / "run")
    measure_run(tmp_path / "run")
    plan = Sweep.from_table(SHORT | {"sweep": {"drive": {"amplitude": [1.0, 30.0]}}})
    run_sweep(plan, tmp_path / "sweep", MPI.COMM_SELF)

    for name in ("run/run.h5", "run/analysis.h5", "sweep/ensemble.h5"):
        given = attributes(tmp_path / name)
        assert given.keys() >= WANTED, name
        assert before <= datetime.fromisoformat(given["date"]) <= datetime.now(UTC)
        assert given["host"] == platform.node()

    assert json.loads((tmp_path / "run/summary.json").read_text()).keys() >= WANTED

    in_process("bands", "--out", tmp_path / "bands")
    assert json.loads((tmp_path / "bands/bands.json").read_text()).keys() >= WANTED

    # Another date, host and revision leave the bits of the results.
    monkeypatch.setattr(io_folder, "revision", lambda: "other")
    monkeypatch.setattr(platform, "node", lambda: "elsewhere")
    simulate(small_case(**SHORT), tmp_path / "again")
    assert attributes(tmp_path / "again/run.h5")["host"] == "elsewhere"
    assert attributes(tmp_path / "again/run.h5")["revision"] == "other"
    assert_same_bits(datasets(tmp_path / "run/run.h5"), datasets(tmp_path / "again/run.h5"))


def test_the_revision_is_that_of_git(tmp_path, monkeypatch):
    (tmp_path / "pyproject.toml").touch()
    for words in ("init -q", "add .", "-c user.name=a -c user.email=a@b commit -qm one"):
        subprocess.run(["git", "-C", tmp_path, *words.split()], check=True)
    head = subprocess.run(["git", "-C", tmp_path, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
    monkeypatch.setattr(package, "__file__", str(tmp_path / "vipetsc/__init__.py"))

    assert io_folder.revision.__wrapped__() == head.stdout[:12]

    (tmp_path / "pyproject.toml").write_text("changed")
    assert io_folder.revision.__wrapped__() == head.stdout[:12] + "+"
