"""The same curves of steady states, bit for bit, on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.conftest import assert_same_bits, datasets
from tests.steady_states import nfrc_case
from vipetsc.modes.branches.follow import follow_all


@pytest.mark.parallel([2, 3])
def test_curves_are_the_same_on_any_number_of_ranks(folder):
    """Two restitutions are two curves: ranks work on different ones, and one of three has none."""
    comm = MPI.COMM_WORLD
    case = nfrc_case(harmonics=3, restitutions=[1.0, 0.7], range=[0.999, 1.0005], first_step=1e-3, points=3)
    together = folder / "together"
    alone = folder / "alone"
    if comm.rank == 0:
        together.mkdir()
        alone.mkdir()
    comm.Barrier()

    curves = follow_all(case, together, comm)

    # Rank 0 collects the curves of all.
    assert len(curves) == (2 if comm.rank == 0 else 0)
    if comm.rank == 0:
        follow_all(case, alone, MPI.COMM_SELF)
        for name, *_ in case.curves():
            assert_same_bits(datasets(together / f"branch-{name}.h5"), datasets(alone / f"branch-{name}.h5"))
