"""A prediction has the same bits on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from tests.one_site import prediction_case
from vipetsc.studies.prediction import predict


@pytest.mark.parallel([2])
def test_ranks_predict_the_same(folder):
    """Predicted and simulated energies, and z, of two ranks equal those of one rank."""
    comm = MPI.COMM_WORLD
    case = prediction_case(
        lattice={"cells": 60},
        contacts={"sites": [30], "clearance": [2e-3]},
        predict={"amplitudes": [20.0, 60.0], "points": 16},
    )
    paths = [folder / "together", folder / "alone"]
    if comm.rank == 0:
        for path in paths:
            path.mkdir()
    comm.Barrier()

    together = predict(case, paths[0], comm)

    if comm.rank == 0:
        alone = predict(case, paths[1], MPI.COMM_SELF)
        for name in ("predicted/bands", "predicted/dissipated", "predicted/z", "simulated/bands"):
            np.testing.assert_array_equal(together[name].values, alone[name].values)
