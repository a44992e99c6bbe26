"""A branch's table that is missing is written again from its HDF5 file, to the same bytes."""

from mpi4py import MPI

import pytest

from tests.steady_states import nfrc_case
from vipetsc.modes.branches.follow import follow_all

pytestmark = pytest.mark.parallel(1)


def test_a_table_that_was_removed_is_written_again(tmp_path):
    case = nfrc_case(harmonics=3, restitutions=[0.7], range=[0.5, 0.52])
    (curve,) = follow_all(case, tmp_path, MPI.COMM_SELF)
    assert curve.complete
    table = tmp_path / f"branch-{curve.name}.csv"
    before = table.read_text()

    table.unlink()
    follow_all(case, tmp_path, MPI.COMM_SELF, resume=True)
    assert table.read_text() == before
