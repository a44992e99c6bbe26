"""Sweeps leave the same ensemble on any number of ranks, in teams or not, also after failures and stops."""

from __future__ import annotations

import time
import tomllib
from errno import ENOSPC

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import assert_same_bits, datasets
from tests.faults.inject import Injector
from vipetsc.case import Sweep
from vipetsc.io.records import RecordFile
from vipetsc.parallel import SharedCounter, StopRequest, on_root
from vipetsc.studies import linear_run
from vipetsc.studies.ensemble import FAILED
from vipetsc.studies.pool import TaskPool
from vipetsc.studies.recorded_runs import RecordedRuns
from vipetsc.studies.sweep import run_sweep

TABLE = """
name = "small"
[lattice]
preset = "four-band"
cells = 16
[contacts]
clearance = 2e-4
[drive]
cycles = 3
[time]
end = 0.04
rtol = 1e-8
sample_interval = 1e-4
[output]
stride = 2
[sweep.contacts]
sites = [[4], [4, 9]]
[sweep.drive]
amplitude = [0.1, 20.0, 40.0]
"""


@pytest.fixture(scope="module")
def injector():
    """The injector of faults at chosen phases; a process may have only one, because its hook cannot be removed."""
    return Injector()


def sweep(*changes: str) -> Sweep:
    """The sweep of ``TABLE``; ``changes`` are overrides of its case."""
    return Sweep.from_table(tomllib.loads(TABLE), list(changes))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The datasets of the ensemble that rank 0 computes alone; all ranks get them."""
    folder = tmp_path_factory.mktemp("whole")

    def swept() -> dict[str, np.ndarray]:
        run_sweep(sweep(), folder, MPI.COMM_SELF)
        return datasets(folder / "ensemble.h5")

    return on_root(MPI.COMM_WORLD, swept)


@pytest.mark.parallel([1, 2])
def test_samples_differ_and_neither_ranks_nor_order_change_a_bit(folder):
    """A sample depends on its seed alone: not on the number of ranks, nor on the order of the seeds."""
    comm = MPI.COMM_WORLD
    table = tomllib.loads(TABLE) | {"contacts": {"sites": [4, 9], "clearance": 2e-4}}
    table |= {"disorder": {"clearance": {"relative": 0.05}}, "sweep": {"disorder": {"seed": {"count": 3}}}}
    table["drive"] = table["drive"] | {"amplitude": 20.0}

    run_sweep(Sweep.from_table(table), folder / "all", comm)
    run_sweep(Sweep.from_table(table, ["sweep.disorder.seed=[2, 0, 1]"]), folder / "turned", comm)
    comm.Barrier()

    if comm.rank == 0:
        run_sweep(Sweep.from_table(table), folder / "alone", MPI.COMM_SELF)
        together = datasets(folder / "all" / "ensemble.h5")
        assert_same_bits(together, datasets(folder / "alone" / "ensemble.h5"))
        assert together["statistics/samples"] == 3

        turned = datasets(folder / "turned" / "ensemble.h5")["ibtet"]
        assert turned.tolist() == together["ibtet"][[2, 0, 1]].tolist()
        assert len({*turned}) == 3

        # Only clearances are scattered, and the lattice is the same: one linear run serves all samples.
        assert (folder / "all" / "members.jsonl").read_bytes().count(b'"envelope"') == 1
    comm.Barrier()


@pytest.mark.parallel([2])
@pytest.mark.parametrize(
    ("team", "phase", "kind"),
    [(2, "analyse", "exception"), (2, "append", "full-disk"), (1, "append", "full-disk"), (1, "step", "memory")],
)
def test_a_member_that_fails_is_an_outcome_and_a_full_disk_an_end(folder, injector, whole, team, phase, kind):
    """An error within a member is recorded and the sweep goes on; a full disk ends the sweep.

    In both cases the same command then completes the sweep with the bits of an undisturbed one.
    """
    comm = MPI.COMM_WORLD
    plan = sweep(f"sweep.ranks={team}")
    # Rank 0 of a team measures and writes for the team. Without teams the fault meets rank 1.
    failing = 0 if team == 2 else 1
    if comm.rank == failing:
        # The fault comes at the third record of rank 0, whose first one is that of the linear run, and at the first
        # record of rank 1, which gets few members where rank 0 is faster.
        time_of_fault = {"append": 1 if comm.rank else 3, "step": 1, "analyse": 2}
        injector.arm(phase, time_of_fault[phase], kind)

    if kind == "full-disk":
        with pytest.raises(OSError, match="No space left"):
            run_sweep(plan, folder / "out", comm)
    else:
        result = run_sweep(plan, folder / "out", comm)
        (reason,) = {row["reason"] for row in result.failures}
        expected = {"exception": "a fault at analyse", "memory": "MemoryError: Unable to allocate"}
        assert expected[kind] in reason
        assert not result.complete
        assert not result.resumable
        # Without teams a rank fails in its linear run, and may take all members before the other rank takes one.
        assert 1 <= result.count(2) < 6 + (team == 1)

    injector.disarm()
    comm.Barrier()
    assert run_sweep(plan, folder / "out", comm).complete
    assert_same_bits(datasets(folder / "out" / "ensemble.h5"), whole)
    comm.Barrier()


@pytest.mark.parallel([2])
def test_a_linear_run_that_fails_on_one_rank_of_a_team_fails_on_all(folder, monkeypatch):
    """Where memory is short on the first rank alone, all members have the reason, and no rank waits for another.

    The first rank alone has the motion of the linear run, of which it takes the envelope.
    """
    comm = MPI.COMM_WORLD

    def fail(*arguments):
        raise MemoryError("Unable to allocate 1.00 TiB")

    with monkeypatch.context() as patch:
        if comm.rank == 0:
            patch.setattr(linear_run, "envelope_squares", fail)
        result = run_sweep(sweep("sweep.ranks=2"), folder / "out", comm)

    assert result.count(FAILED) == 6
    assert {row["reason"] for row in result.failures} == {"MemoryError: Unable to allocate 1.00 TiB"}

    comm.Barrier()
    assert run_sweep(sweep("sweep.ranks=2"), folder / "out", comm).complete
    comm.Barrier()


@pytest.mark.parallel([2])
@pytest.mark.parametrize("study", ["sweep", "runs"])
def test_records_that_one_rank_cannot_close_end_all_ranks(folder, monkeypatch, study):
    """A network file system may say only on closing that the disk is full; then every rank raises."""
    comm = MPI.COMM_WORLD

    def fail(self):
        raise OSError(ENOSPC, "No space left on device")

    if comm.rank == 1:
        monkeypatch.setattr(RecordFile, "close", fail)
    with pytest.raises(OSError, match="No space left"):
        if study == "sweep":
            run_sweep(sweep(), folder / "out", comm)
        else:
            RecordedRuns("some-runs", folder, comm, StopRequest()).make([1.0, 2.0], lambda key: {"value": key})


@pytest.mark.parallel([1, 2, 3])
def test_every_number_is_drawn_once():
    """Ranks that draw from a shared counter together get every number once."""
    comm = MPI.COMM_WORLD
    counter = SharedCounter(comm)
    drawn = []
    # Ranks draw at their own speed, and any of them may get a number.
    while (number := counter.draw()) < 200:
        drawn.append(number)

    of_all_ranks = [number for numbers in comm.allgather(drawn) for number in numbers]
    assert sorted(of_all_ranks) == list(range(200))
    counter.free()


@pytest.mark.parallel([2])
def test_after_a_request_on_one_rank_no_rank_begins_another_job():
    """After a request to stop on one rank the pool gives no rank another job, nor the jobs of a later call."""
    comm = MPI.COMM_WORLD
    stop = StopRequest()
    pool = TaskPool(comm, MPI.COMM_SELF, stop)

    def work(job: int) -> None:
        # A job takes so long that the other rank sees the request before it has done its half.
        time.sleep(0.01)
        stop.requested = comm.rank == 1

    assert pool.run(list(range(100)), work) < 50
    assert pool.stopped
    assert pool.run([1, 2], work) == 0


@pytest.mark.parallel([1, 2, 3])
def test_blocks_of_jobs_hold_every_job_once():
    """The pool does every one of 1007 jobs once, and reports the 101 jobs whose number ends in 3, which fail."""
    comm = MPI.COMM_WORLD
    done = list[int]()
    failed = list[int]()

    def work(job: int) -> None:
        done.append(job)
        if job % 10 == 3:
            raise ValueError("three")

    pool = TaskPool(comm, MPI.COMM_SELF, StopRequest())
    completed = pool.run(range(1007), work, fail=lambda job, why: failed.append(job))

    assert sorted(job for jobs in comm.allgather(done) for job in jobs) == list(range(1007))
    assert sorted(job for jobs in comm.allgather(failed) for job in jobs) == list(range(3, 1007, 10))
    assert completed == 1007 - 101
    if comm.size == 1:
        # One rank does the jobs in their order.
        assert done == list(range(1007))
