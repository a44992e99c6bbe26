"""The same prediction on any number of ranks."""

from __future__ import annotations

from pathlib import Path
from tempfile import mkdtemp

from mpi4py import MPI

import numpy as np
import pytest

from tests.verify.test_prediction import small
from vipetsc.parallel import on_root
from vipetsc.studies.prediction import predict

KEPT = "predicted/bands", "predicted/dissipated", "predicted/z", "simulated/bands"


@pytest.mark.parallel([2])
def test_ranks_predict_the_same():
    comm = MPI.COMM_WORLD
    case = small(lattice={"cells": 60}, contacts={"sites": [30], "clearance": [2e-3]},
                 predict={"amplitudes": [20.0, 60.0], "points": 16})  # fmt: skip
    shared, alone = (Path(on_root(comm, mkdtemp)) for _ in range(2))
    together = predict(case, shared, comm)
    single = on_root(comm, lambda: predict(case, alone, MPI.COMM_SELF))
    for name in KEPT:
        np.testing.assert_array_equal(together[name].values, single[name].values)
