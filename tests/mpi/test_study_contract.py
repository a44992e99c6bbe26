"""Every study has the same bits on any number of ranks, and after a stop of one of them."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.conftest import StopAt
from tests.faults.scenarios import difference
from tests.studies import STUDIES, compute
from vipetsc.parallel import StoppedError, StopRequest, on_root

COMM = MPI.COMM_WORLD


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Return a function that gives, on all ranks, the folder of a study that rank 0 computes alone, once."""
    done = {}

    def call(name):
        if name not in done:
            done[name] = on_root(COMM, lambda: tmp_path_factory.mktemp(name) / "alone")
            on_root(COMM, lambda: compute(name, done[name]))
        return done[name]

    return call


def assert_as_alone(found, wanted):
    """Assert on all ranks that a folder has the files of another one, to the bit."""
    assert on_root(COMM, lambda: difference(wanted, found)) == ""


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("name", STUDIES)
def test_ranks_leave_what_one_leaves(folder, alone, name):
    compute(name, folder / "together", COMM)
    assert_as_alone(folder / "together", alone(name))


@pytest.mark.parallel([2])
@pytest.mark.parametrize("name", [name for name in STUDIES if name != "design"])
def test_one_rank_that_is_asked_to_stop_stops_all(folder, alone, name):
    """The last rank grants a request at its first look; on all ranks the next call goes on to the bits of one rank."""
    out = folder / "together"
    stop = StopAt(0) if COMM.rank == COMM.size - 1 else StopRequest()
    with pytest.raises(StoppedError):
        compute(name, out, COMM, stop=stop)
    on_root(COMM, lambda: None)

    compute(name, out, COMM)
    assert_as_alone(out, alone(name))
