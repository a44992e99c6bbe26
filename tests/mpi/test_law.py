"""A scattering law has the same bits on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.conftest import assert_same_bits, datasets
from tests.one_site import COARSE, law_case
from vipetsc.studies.one_site import make_law


@pytest.mark.parallel([2])
def test_law_is_the_same_on_any_number_of_ranks(folder):
    """Two ranks write the same datasets as one."""
    comm = MPI.COMM_WORLD
    # Each point is the mean of two runs, and must not depend on which rank computed them.
    case = law_case(law=COARSE | {"samples": 2})

    make_law(case, folder / "together", comm)

    if comm.rank == 0:
        make_law(case, folder / "alone", MPI.COMM_SELF)
        assert_same_bits(datasets(folder / "alone" / "law.h5"), datasets(folder / "together" / "law.h5"))
