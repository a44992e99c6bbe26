"""The same scattering law, bit for bit, on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.conftest import assert_same_bits, datasets
from tests.verify.test_law import COARSE, case
from vipetsc.parallel import on_root
from vipetsc.studies.one_site import make_law


@pytest.mark.parallel([2])
def test_law_is_the_same_on_any_number_of_ranks(folder):
    comm, of = MPI.COMM_WORLD, case(law=COARSE | {"samples": 2})
    make_law(of, folder / "shared", comm)
    on_root(comm, lambda: make_law(of, folder / "alone", MPI.COMM_SELF) and None)
    on_root(comm, lambda: assert_same_bits(*(datasets(folder / name / "law.h5") for name in ("alone", "shared"))))
