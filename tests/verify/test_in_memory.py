"""Runs and sweeps without a folder have the numbers of those with one, and leave no files."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.conftest import small_case
from vipetsc.case import Sweep
from vipetsc.dynamics import simulate
from vipetsc.parallel import StopRequest
from vipetsc.studies.sweep import run_sweep

pytestmark = pytest.mark.parallel(1)


def small_sweep(**options) -> Sweep:
    """Return a sweep of two members that touch nothing, so that they are scaled from one short run."""
    table = {
        "lattice": {"preset": "four-band", "cells": 24},
        "contacts": {"sites": [6], "clearance": 2e-3},
        "drive": {"cycles": 3},
        "time": {"end": 0.01},
        "sweep": {"drive": {"amplitude": [1.0, 2.0]}, "measures": ["transfer"]} | options,
    }
    return Sweep.from_table(table)


def test_a_run_without_a_folder_is_the_run_with_one(tmp_path):
    """A run in memory has the bits of the run in a folder, and each result says where it is."""
    case = small_case(time={"end": 0.02, "engine": "propagator"})
    held = simulate(case)
    stored = simulate(case, tmp_path / "run")

    assert held.folder is None
    assert held.complete
    # The bits are equal: where results are kept must not change the integration.
    assert held.dataset["velocity"].values.tobytes() == stored.dataset["velocity"].values.tobytes()
    assert held.dataset["velocity"].dims == stored.dataset["velocity"].dims
    assert "complete: " in held._repr_html_()
    assert "in memory" in held._repr_html_()
    assert str(tmp_path / "run") in stored._repr_html_()


def test_a_sweep_without_a_folder_is_the_sweep_with_one(tmp_path, monkeypatch):
    """A sweep in memory has the ensemble of a sweep in a folder, and removes its temporary folder."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    plan = small_sweep()
    held = run_sweep(plan)
    # Temporary folders that stay would fill the disk in a long session.
    assert list(tmp_path.iterdir()) == []
    assert held.folder is None
    assert held.complete
    assert json.loads(held.dataset.attrs["failed"]) == []

    stored = run_sweep(plan, tmp_path / "sweep")
    xr.testing.assert_equal(
        # CPU times differ from call to call.
        held.dataset.drop_vars("cpu_seconds", errors="ignore"),
        stored.dataset.drop_vars("cpu_seconds", errors="ignore"),
    )
    assert np.isfinite(held.dataset["ibtet"]).all()
    assert "sweep of 2 members" in held._repr_html_()


def test_a_sweep_that_is_stopped_stays_where_it_is(tmp_path, monkeypatch):
    """A stopped sweep in memory keeps its temporary folder, with the complete members, and can go on from it."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    stop = StopRequest()
    stop.requested = True
    stopped = run_sweep(small_sweep(), stop=stop)
    assert stopped.resumable
    assert stopped.dataset is None
    assert stopped.folder is not None
    assert Path(stopped.folder).parent == tmp_path

    assert run_sweep(small_sweep(), stopped.folder).complete
