"""Runs and sweeps without a folder on several ranks: rank 0 has the data, all ranks have the same result."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.case import CaseError, Sweep
from vipetsc.dynamics import simulate
from vipetsc.studies.sweep import run_sweep

COMM = MPI.COMM_WORLD
TABLE = {
    "lattice": {"preset": "four-band", "cells": 24},
    "contacts": {"sites": [6], "clearance": 2e-3},
    "drive": {"cycles": 3},
    "time": {"end": 0.01},
}


@pytest.mark.parallel(2)
def test_rank_0_has_the_run():
    """A run in memory is gathered on rank 0, with the bits of a run on one rank."""
    case = small_case(time={"end": 0.02})
    result = simulate(case)
    assert result.complete
    assert (result.dataset is None) == (COMM.rank > 0)
    if COMM.rank == 0:
        alone = simulate(case, comm=MPI.COMM_SELF)
        assert result.dataset["velocity"].values.tobytes() == alone.dataset["velocity"].values.tobytes()


@pytest.mark.parallel(2)
def test_rank_0_has_the_ensemble():
    """Rank 0 has the ensemble of a sweep without a folder; the temporary folder is removed."""
    result = run_sweep(Sweep(**TABLE, sweep={"drive": {"amplitude": [1.0, 2.0, 3.0]}, "measures": ["transfer"]}))
    assert result.complete
    assert result.folder is None
    assert (result.dataset is None) == (COMM.rank > 0)
    if COMM.rank == 0:
        assert np.isfinite(result.dataset["ibtet"]).all()


@pytest.mark.parallel(2)
def test_all_ranks_refuse_fields_without_a_folder():
    """A sweep with fields but without a folder is refused on every rank."""
    with pytest.raises(CaseError, match="give a folder"):
        run_sweep(Sweep(**TABLE, sweep={"drive": {"amplitude": [1.0]}, "fields": True}))
