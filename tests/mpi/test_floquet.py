"""Breathers by shooting on all ranks together: orbits and Floquet multipliers do not depend on the number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from tests.breathers import breather_case
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all

COMM = MPI.COMM_WORLD


@pytest.mark.parallel([2, 3])
def test_the_same_branch_on_any_number_of_ranks(folder):
    """Periods, energies, states and the moduli of multipliers agree with those of one rank to 1e-10 and 1e-8."""
    branches = follow_all(breather_case(multipliers=2), folder, COMM)

    assert len(branches) == (COMM.rank == 0)
    if COMM.rank == 0:
        together = read_branch(folder / "branch-breather-1600.h5")
        (alone,) = follow_all(breather_case(multipliers=2), folder, MPI.COMM_SELF)
        # Ranks add in another order than one rank does: orbits differ by rounding errors, which the motion magnifies.
        assert len(together.points) == len(alone.points) == 3
        for a, b in zip(together.points, alone.points, strict=True):
            assert a.period == pytest.approx(b.period, rel=1e-10)
            assert a.energy == pytest.approx(b.energy, rel=1e-10)
            np.testing.assert_allclose(a.x, b.x, atol=1e-10 * np.abs(b.x).max())
            np.testing.assert_allclose(np.abs(a.multipliers[:, 0]), np.abs(b.multipliers[:, 0]), rtol=1e-8)
