"""Curves of steady states have the same bits on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.conftest import assert_same_bits, datasets
from tests.steady_states import nfrc_case
from vipetsc.modes.branches.follow import follow_all

CELLS = {"family": {"contacts": {"sites": [[10], [11]]}}}


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("kind", ["restitutions", "family"])
def test_curves_are_the_same_on_any_number_of_ranks(kind, folder):
    """Two restitutions, or two members of a family, are two curves on different ranks; a third rank has none."""
    comm = MPI.COMM_WORLD
    options = {"harmonics": 3, "range": [0.999, 1.0005], "first_step": 1e-3, "points": 3}
    case = nfrc_case(**options, restitutions=[1.0, 0.7]) if kind == "restitutions" else nfrc_case(**options, **CELLS)
    together = folder / "together"
    alone = folder / "alone"
    if comm.rank == 0:
        together.mkdir()
        alone.mkdir()
    comm.Barrier()

    curves = follow_all(case, together, comm)

    # Rank 0 collects the curves of all ranks.
    assert len(curves) == (2 if comm.rank == 0 else 0)
    if comm.rank == 0:
        follow_all(case, alone, MPI.COMM_SELF)
        for curve in case.every_curve():
            name = f"branch-{curve.name}.h5"
            assert_same_bits(datasets(together / name), datasets(alone / name))
