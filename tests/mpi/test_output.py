"""Ranks that write a run together agree on attributes, know of each other's failures, and leave complete files."""

from __future__ import annotations

import json
import sys

from mpi4py import MPI

import h5py
import numpy as np
import pytest

from tests.conftest import assert_same_bits, datasets, small_case
from vipetsc.dynamics import simulate
from vipetsc.dynamics.observers import RunawayError
from vipetsc.io import chunks
from vipetsc.io.store import RunFolder, RunMemory
from vipetsc.parallel import StoppedError, StopRequest, divided, on_every_rank, on_root

COMM = MPI.COMM_WORLD


@pytest.mark.parallel(2)
def test_all_ranks_agree_on_the_attributes_of_the_file(folder, monkeypatch):
    """All ranks have the same attributes, such as the duration of a run."""
    finish = RunFolder.finish
    outcome = []

    def watch(output, attributes, summary):
        outcome.append(dict(attributes))
        finish(output, attributes, summary)

    monkeypatch.setattr(RunFolder, "finish", watch)
    result = simulate(small_case(time={"end": 0.01}), folder / "run")
    outcome.append([result.sentence, result.statistics, result.warnings])
    assert len(set(COMM.allgather(json.dumps(outcome)))) == 1

    with h5py.File(folder / "run" / "run.h5") as file:
        assert json.loads(file.attrs["statistics"]) == result.statistics
        assert file.attrs["ranks"] == COMM.size


@pytest.mark.parallel(2)
def test_a_run_in_memory_is_gathered_on_rank_0(folder):
    """The dataset of a run in memory is on rank 0, with the bits of the file."""
    case = small_case(time={"end": 0.02})
    memory = RunMemory(COMM)
    simulate(case, memory)
    simulate(case, folder / "run")
    if COMM.rank:
        assert memory.dataset is None
        return

    run = datasets(folder / "run" / "run.h5")
    # The state at the end is in memory, not in the file.
    held = memory.dataset.drop_vars(["end/displacement", "end/velocity"])
    assert_same_bits(run, {str(name): item.values for name, item in held.variables.items()})


@pytest.mark.parallel(2)
def test_a_rank_that_cannot_write_stops_all_and_nothing_is_lost(folder, monkeypatch):
    """An error of the rank that writes is raised on all ranks; the earlier run and the parts of the new one remain."""
    path = folder / "run"
    simulate(small_case(time={"end": 0.01}), path)
    before = (path / "run.h5").read_bytes()

    case = small_case(time={"end": 0.02})

    # Rank 0 writes the file.
    def fails(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(chunks, "put_chunks", fails)
    with pytest.raises(OSError, match=r"run\.h5 could not be written"):
        simulate(case, path, force=True)

    COMM.Barrier()
    assert (path.with_name("run.old") / "run.h5").read_bytes() == before
    assert {p.name for p in path.iterdir()} == {"case.toml", "parts"}


@pytest.mark.parallel([2, 3])
def test_what_one_rank_raises_all_raise():
    """``on_every_rank`` returns each rank's value, or raises the error of one rank on all."""
    assert on_every_rank(COMM, lambda: COMM.rank) == COMM.rank

    def fails() -> None:
        if COMM.rank == COMM.size - 1:
            raise KeyError("only here")

    with pytest.raises(KeyError, match="only here"):
        on_every_rank(COMM, fails)


def _runs_away() -> None:
    raise RunawayError("it diverges", 3)


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("agree", [on_root, on_every_rank, lambda comm, work: divided(comm, [work] * comm.size)])
@pytest.mark.parametrize(("work", "text"), [(_runs_away, "it diverges"), (lambda: sys.exit(3), "exit")])
def test_what_cannot_be_sent_is_raised_on_all_with_its_text(agree, work, text):
    """An error with a constructor of its own, which no message can make again, and a call of sys.exit on one rank."""
    failing = 0
    if agree is on_every_rank:
        failing = COMM.size - 1

    def fails() -> None:
        if COMM.rank == failing:
            work()

    with pytest.raises(RuntimeError, match=text):
        agree(COMM, fails)
    assert COMM.allreduce(1) == COMM.size


@pytest.mark.parallel([2, 3])
def test_a_request_that_one_rank_got_stops_all():
    """All ranks agree on a request to stop that one rank has received."""
    stop = StopRequest()
    assert not stop.agreed(COMM)
    stop.requested = COMM.rank == COMM.size - 1
    assert stop.agreed(COMM)
    with pytest.raises(StoppedError):
        stop.check(COMM)


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
    case = small_case().to_toml()
    output = RunFolder(folder / "run", COMM)
    output.begin(case)
    output.append({"x": np.zeros(1)})
    output.save_state({"number": np.array(1)})

    # The file is cut off within its header.
    if COMM.rank == 1:
        (state,) = (folder / "run" / "parts").glob("state-*-1-2.h5")
        state.write_bytes(state.read_bytes()[:20])
    COMM.barrier()

    with pytest.raises((OSError, ValueError)):
        RunFolder(folder / "run", COMM).last_state()
