"""The same curves of steady states, bit for bit, on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.conftest import assert_same_bits, datasets
from tests.verify.test_nfrc import case
from vipetsc.modes.branches.follow import follow_all
from vipetsc.parallel import on_root


@pytest.mark.parallel([2, 3])
def test_curves_are_the_same_on_any_number_of_ranks(folder):
    comm, of = (
        MPI.COMM_WORLD,
        case(harmonics=3, restitutions=[1.0, 0.7], range=[0.999, 1.0005], first_step=1e-3, points=3),
    )
    on_root(comm, lambda: [(folder / name).mkdir() for name in ("shared", "alone")] and None)
    curves = follow_all(of, folder / "shared", comm)
    assert len(curves) == (2 if comm.rank == 0 else 0)
    on_root(comm, lambda: follow_all(of, folder / "alone", MPI.COMM_SELF) and None)
    for name, *_ in of.curves():
        paths = [folder / part / f"branch-{name}.h5" for part in ("shared", "alone")]
        on_root(comm, lambda paths=paths: assert_same_bits(*map(datasets, paths)))
