"""Ranks that work, fail and stop together: agreements, jobs that are divided, and jobs that are drawn."""

from __future__ import annotations

import sys
import time

from mpi4py import MPI

import pytest

from vipetsc.dynamics.observers import RunawayError
from vipetsc.parallel import SharedCounter, StoppedError, StopRequest, divided, on_every_rank, on_root, smallest
from vipetsc.studies.pool import TaskPool

COMM = MPI.COMM_WORLD
LAST = COMM.size - 1


@pytest.mark.parallel([2, 3])
def test_what_one_rank_raises_all_raise():
    """``on_every_rank`` returns each rank's value, or raises the error of one rank on all."""
    assert on_every_rank(COMM, lambda: COMM.rank) == COMM.rank

    def fails() -> None:
        if COMM.rank == LAST:
            raise KeyError("only here")

    with pytest.raises(KeyError, match="only here"):
        on_every_rank(COMM, fails)


def _runs_away() -> None:
    raise RunawayError("it diverges", 3)


@pytest.mark.parallel([2])
@pytest.mark.parametrize("agree", [on_root, on_every_rank, lambda comm, work: divided(comm, [work] * comm.size)])
@pytest.mark.parametrize(("work", "text"), [(_runs_away, "it diverges"), (lambda: sys.exit(3), "exit")])
def test_what_cannot_be_sent_is_raised_on_all_with_its_text(agree, work, text):
    """An error with a constructor of its own, which no message can make again, and a call of sys.exit on one rank."""
    failing = 0
    if agree is on_every_rank:
        failing = LAST

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
    stop.requested = COMM.rank == LAST
    assert stop.agreed(COMM)
    with pytest.raises(StoppedError):
        stop.check(COMM)


@pytest.mark.parallel([1, 2, 3])
def test_the_smallest_numbers_of_all_ranks_are_known_to_all():
    """``smallest`` reduces each number by itself: a rank may have one, another rank the other."""
    assert smallest(COMM, 2.0 + COMM.rank, -float(COMM.rank == LAST), 0.5) == [2.0, -1.0, 0.5]


@pytest.mark.parallel([1, 2, 3])
def test_jobs_are_divided_and_their_first_failure_is_that_of_all():
    """``divided`` computes job k on rank k mod size, gives all ranks all values, and raises one error on all ranks."""
    computed: list[int] = []

    def job(number: int) -> int:
        computed.append(number)
        if number in (2, 4):
            raise ArithmeticError(f"job {number}")
        return number**2

    jobs = [lambda number=number: job(number) for number in range(2)]
    assert divided(COMM, jobs) == [0, 1]
    # Every rank has all values, and has computed only its own.
    assert computed == [number for number in range(2) if number % COMM.size == COMM.rank]
    # All ranks raise the failure with the smallest number, not the earliest one.
    with pytest.raises(ArithmeticError, match="job 2"):
        divided(COMM, [lambda number=number: job(number) for number in range(5)])
    COMM.Barrier()


@pytest.mark.parallel([1, 2, 3])
def test_every_number_is_drawn_once():
    """Ranks that draw from a shared counter together get every number once."""
    counter = SharedCounter(COMM)
    drawn = []
    # Ranks draw at their own speed, and any of them may get a number.
    while (number := counter.draw()) < 200:
        drawn.append(number)

    of_all_ranks = [number for numbers in COMM.allgather(drawn) for number in numbers]
    assert sorted(of_all_ranks) == list(range(200))
    counter.free()


@pytest.mark.parallel([2])
def test_after_a_request_on_one_rank_no_rank_begins_another_job():
    """After a request to stop on one rank the pool gives no rank another job, nor the jobs of a later call."""
    stop = StopRequest()
    pool = TaskPool(COMM, MPI.COMM_SELF, stop)

    def work(job: int) -> None:
        # A job takes so long that the other rank sees the request before it has done its half.
        time.sleep(0.01)
        stop.requested = COMM.rank == 1

    assert pool.run(list(range(100)), work) < 50
    assert pool.stopped
    assert pool.run([1, 2], work) == 0


@pytest.mark.parallel([1, 2, 3])
def test_blocks_of_jobs_hold_every_job_once():
    """The pool does every one of 1007 jobs once, and reports the 101 jobs whose number ends in 3, which fail."""
    done: list[int] = []
    failed: list[int] = []

    def work(job: int) -> None:
        done.append(job)
        if job % 10 == 3:
            raise ValueError("three")

    pool = TaskPool(COMM, MPI.COMM_SELF, StopRequest())
    completed = pool.run(range(1007), work, fail=lambda job, why: failed.append(job))

    assert sorted(job for jobs in COMM.allgather(done) for job in jobs) == list(range(1007))
    assert sorted(job for jobs in COMM.allgather(failed) for job in jobs) == list(range(3, 1007, 10))
    assert completed == 1007 - 101
    if COMM.size == 1:
        # One rank does the jobs in their order.
        assert done == list(range(1007))
