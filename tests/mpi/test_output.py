"""Ranks that write a run together agree on attributes, know of each other's failures, and leave complete files."""

from __future__ import annotations

import json
import sys
from types import SimpleNamespace

from mpi4py import MPI

import h5py
import numpy as np
import pytest

from tests.conftest import assert_same_bits, datasets, in_parallel, needs_parallel_hdf5, small_case
from vipetsc.case import CaseError
from vipetsc.dynamics import recorded_sizes, simulate
from vipetsc.dynamics.observers import RunawayError
from vipetsc.io import chunks
from vipetsc.io.store import RunFolder, RunMemory
from vipetsc.parallel import StoppedError, StopRequest, divided, on_every_rank, on_root, sort_over_ranks

COMM = MPI.COMM_WORLD


@pytest.mark.parallel(2)
@pytest.mark.parametrize("writer", ["gather", in_parallel])
def test_all_ranks_agree_on_the_attributes_of_the_file(folder, monkeypatch, writer):
    """All ranks write the same attributes, such as the duration of a run: HDF5 could not close the file otherwise."""
    finish = RunFolder.finish
    outcome = []

    def watch(output, attributes, summary):
        outcome.append(dict(attributes))
        finish(output, attributes, summary)

    monkeypatch.setattr(RunFolder, "finish", watch)
    result = simulate(small_case(output={"writer": writer}, time={"end": 0.01}), folder / "run")
    outcome.append([result.sentence, result.statistics, result.warnings])
    assert len(set(COMM.allgather(json.dumps(outcome)))) == 1

    with h5py.File(folder / "run" / "run.h5") as file:
        assert json.loads(file.attrs["statistics"]) == result.statistics
        assert file.attrs["ranks"] == COMM.size


@needs_parallel_hdf5
@pytest.mark.parallel(2)
def test_a_run_in_memory_is_gathered_on_rank_0(folder):
    """The dataset of a run in memory is on rank 0, with the bits of the file that ranks write together."""
    case = small_case(output={"writer": "parallel"}, time={"end": 0.02})
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


@needs_parallel_hdf5
@pytest.mark.parallel([2, 3])
def test_ranks_that_write_together_write_what_one_gathers(folder, monkeypatch):
    """A file that ranks write together has the bits of a gathered one.

    Each rank has several sites, which are not sorted; there are several chunks, fields of a window, and contacts that
    are closed at the end.
    """
    monkeypatch.setattr(recorded_sizes, "CHUNK_SAMPLES", 20)
    sites = {"sites": [13, 5, 6, 18, 12, 2], "clearance": [2e-4, 1e-4, 3e-5, 1e-4, 5e-5, 2e-4]}
    # The propagator's runs take a fraction of the time of the other engine's.
    time = {"end": 0.04, "engine": "propagator"}
    for writer in ("gather", "parallel"):
        output = {"writer": writer, "window": [2, 20], "every": 2, "stride": 3}
        simulate(small_case(contacts=sites, output=output, time=time), folder / writer)

    gathered = datasets(folder / "gather" / "run.h5")
    together = datasets(folder / "parallel" / "run.h5")
    assert len(gathered["impacts/onset"]) > 20
    assert (gathered["energy/dissipated_by_site"][-1] > 0).sum() > 2
    assert_same_bits(gathered, together)


@pytest.mark.parallel([2, 3])
def test_rows_are_sorted_over_ranks_and_none_has_all():
    """Rows are sorted by onset, then by site, and each rank gets about the same number of them.

    Ranks begin with different numbers of rows, a third rank with none.
    """
    random = np.random.default_rng(3)
    table = np.zeros(900, [("onset", float), ("site", np.int64)])
    table["onset"] = random.integers(300, size=900) / 7
    table["site"] = random.permutation(900)
    begin, end = ((0, 700), (700, 900), (900, 900))[COMM.rank]

    rows, first, total = sort_over_ranks(COMM, table[begin:end], ("onset", "site"))

    expected = np.sort(table, order=("onset", "site"))
    assert total == len(expected)
    assert 0 < len(rows) < 1.1 * total / COMM.size + 10
    np.testing.assert_array_equal(rows, expected[first : first + len(rows)])


@pytest.mark.parallel(2)
@pytest.mark.parametrize("writer", ["gather", in_parallel])
def test_a_rank_that_cannot_write_stops_all_and_nothing_is_lost(folder, monkeypatch, writer):
    """An error of the rank that writes is raised on all ranks; the earlier run and the parts of the new one remain."""
    path = folder / "run"
    simulate(small_case(time={"end": 0.01}), path)
    before = (path / "run.h5").read_bytes()

    # Rank 0 writes a gathered file.
    failing = COMM.size - 1 if writer == "parallel" else 0
    case = small_case(output={"writer": writer}, time={"end": 0.02})

    def fails(*arguments):
        if COMM.rank == failing:
            raise OSError(28, "No space left on device")
        put_chunks(*arguments)

    put_chunks = chunks.put_chunks
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
    kept = sorted(path.name for path in parts.glob(f"state-*-{COMM.rank}-2.npy"))
    assert kept == [f"state-000002-{COMM.rank}-2.npy", f"state-000003-{COMM.rank}-2.npy"]
    COMM.Barrier()

    if COMM.rank == 1:
        (parts / "state-000003-1-2.npy").unlink()
    COMM.Barrier()
    again = RunFolder(folder, COMM)

    assert [state["number"] for state in again.last_state()] == [2, 2]
    assert again.count == 3
    # A resumed run on another number of ranks would not overwrite later chunks.
    assert not list(parts.glob("part-000003-*"))


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
        (state,) = (folder / "run" / "parts").glob("state-*-1-2.npy")
        state.write_bytes(state.read_bytes()[:20])
    COMM.barrier()

    with pytest.raises((OSError, ValueError)):
        RunFolder(folder / "run", COMM).last_state()


@pytest.mark.parallel(2)
def test_without_hdf5_for_mpi_all_ranks_refuse_to_write_together(folder, monkeypatch):
    """Without MPI in h5py a parallel writer is refused on all ranks; a writer that is left open gathers."""
    monkeypatch.setattr(h5py, "get_config", lambda: SimpleNamespace(mpi=False))
    case = small_case(output={"writer": "parallel"}, time={"end": 0.01})
    with pytest.raises(CaseError, match=r"output\.writer = 'parallel': needs an h5py with MPI support"):
        simulate(case, folder / "run")
    COMM.Barrier()
    assert not (folder / "run").exists()

    # Where the case leaves the choice, a run above the limit is gathered too.
    monkeypatch.setattr(recorded_sizes, "GATHER_LIMIT", 1000)
    assert simulate(small_case(time={"end": 0.01}), folder / "run").complete
