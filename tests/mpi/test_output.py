"""Ranks that write a run together agree on attributes, know of each other's failures, and leave complete files."""

from __future__ import annotations

import json

from mpi4py import MPI

import h5py
import numpy as np
import pytest

from tests.conftest import assert_same_bits, datasets, small_case
from tests.mpi.alike import arrays
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunFolder, RunMemory

COMM = MPI.COMM_WORLD


@pytest.mark.parallel(2)
def test_all_ranks_agree_on_the_file_and_rank_0_has_the_run_in_memory(folder):
    """The attributes are those of all ranks' result; the dataset in memory is on rank 0, with the bits of the file."""
    case = small_case(time={"end": 0.02})
    result = simulate(case, folder / "run")
    outcome = [result.sentence, result.statistics, result.warnings]
    assert len(set(COMM.allgather(json.dumps(outcome)))) == 1
    memory = RunMemory(COMM)
    simulate(case, memory)
    if COMM.rank:
        assert memory.dataset is None
        return

    with h5py.File(folder / "run" / "run.h5") as file:
        assert json.loads(file.attrs["statistics"]) == result.statistics
        assert file.attrs["ranks"] == COMM.size
    # The state at the end is in memory, not in the file.
    held = arrays(memory)
    held.pop("end/displacement")
    held.pop("end/velocity")
    assert_same_bits(datasets(folder / "run" / "run.h5"), held)


@pytest.mark.parallel(2)
def test_only_checkpoints_that_all_ranks_wrote_count(folder):
    """A run resumes from the last checkpoint that every rank has written; later chunks are removed."""
    chunks = RunFolder(folder, COMM)
    parts = folder / "parts"
    if COMM.rank == 0:
        parts.mkdir(parents=True)
    COMM.Barrier()
    for number in range(4):
        chunks.append({"x": np.array(number)})
        chunks.save_state({"number": np.array(number)})
    COMM.Barrier()

    # Two checkpoints are kept, because a rank may be killed while it writes the last one.
    kept = sorted(path.name for path in parts.glob(f"state-*-{COMM.rank}-2.h5"))
    assert kept == [f"state-000002-{COMM.rank}-2.h5", f"state-000003-{COMM.rank}-2.h5"]
    COMM.Barrier()

    if COMM.rank == 1:
        (parts / "state-000003-1-2.h5").unlink()
    COMM.Barrier()
    again = RunFolder(folder, COMM)

    assert [state["number"] for state in again.last_state()] == [2, 2]
    assert again.count == 3
    # A resumed run on another number of ranks would not overwrite later chunks.
    assert not list(parts.glob("part-000003*"))


@pytest.mark.parallel(2)
def test_a_checkpoint_that_one_rank_cannot_read_is_refused_on_all(folder):
    """A checkpoint that is damaged on one rank raises an error on every rank."""
    output = RunFolder(folder / "run", COMM)
    output.begin(small_case().to_toml())
    output.append({"x": np.zeros(1)})
    output.save_state({"number": np.array(1)})

    # The file is cut off within its header.
    if COMM.rank == 1:
        (state,) = (folder / "run" / "parts").glob("state-*-1-2.h5")
        state.write_bytes(state.read_bytes()[:20])
    COMM.barrier()

    with pytest.raises((OSError, ValueError)):
        RunFolder(folder / "run", COMM).last_state()
