"""Pictures of damped lattices: the ledger tells what dashpots take, and no residual where there is none."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.dynamics import simulate
from vipetsc.figures import runs
from vipetsc.io.store import RunMemory


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_the_ledger_has_the_dashpots(engine):
    memory = RunMemory(MPI.COMM_SELF)
    damping = {"mass": 10.0, "stiffness": 1e-5}
    assert simulate(small_case(lattice={"damping": damping}, time={"engine": engine, "end": 0.02}), memory).complete
    upper, lower = runs.ledger(memory.dataset, None).axes
    drawn = {line.get_label(): np.asarray(line.get_ydata()) for line in upper.lines}
    assert drawn["dissipated in dashpots"][-1] > 0.01 * drawn["work of the drive"][-1]
    residual = np.asarray(lower.lines[0].get_ydata())
    if engine == "ts":
        assert residual.max() < 1e-8
    else:
        assert np.isnan(residual).all() and any("balance" in text.get_text() for text in lower.texts)
