"""What the bench runs under mpirun: ``bench_worker.py flight|large JSON``; rank 0 prints what it measured as JSON."""

from __future__ import annotations

import json
import resource
import sys
import time

import petsc4py

petsc4py.init(["bench", "-no_signal_handler"])

from mpi4py import MPI

import numba
import numpy as np
from bench_ours import Flight
from bench_precision import lattice_case

from vipetsc.case import Case
from vipetsc.dynamics import simulate

COMM = MPI.COMM_WORLD


@numba.njit
def triad(a: np.ndarray, b: np.ndarray, c: np.ndarray, s: float) -> None:
    """STREAM's a = b + s c."""
    for i in range(a.size):
        a[i] = b[i] + s * c[i]


def bandwidth(size: int = 8_000_000, turns: int = 12) -> float:
    """GB/s of a triad on all ranks at once, the best of ``turns``, 24 bytes an element as STREAM counts."""
    a, b, c = np.zeros(size), np.ones(size), np.ones(size)
    triad(a, b, c, 0.5)
    best = np.inf
    for _ in range(turns):
        COMM.Barrier()
        begin = time.perf_counter()
        triad(a, b, c, 0.5)
        COMM.Barrier()
        best = min(best, time.perf_counter() - begin)
    return COMM.size * 24 * size / COMM.allreduce(best, MPI.MAX) / 1e9


def peak() -> float:
    """The largest resident size of any rank so far in GiB."""
    return COMM.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, MPI.MAX) / 2**20


def flight(engine: str, cells: int, intervals: int) -> dict:
    """Milliseconds a sample interval of a lattice of ``cells``, once a short burst has reached its full strength."""
    case = lattice_case([f"lattice.cells={cells}", f"time.engine={engine}", "drive.cycles=3", "output.window=[1, 9]"])
    moving = Flight(case, COMM)
    model = moving.model
    first = round(model.drive.duration / 3 / model.sample_interval)
    for k in range(1, first + 1):
        moving.advance(k)
    COMM.Barrier()
    wall, cpu = time.perf_counter(), time.process_time()
    for k in range(first + 1, first + intervals + 1):
        moving.advance(k)
    COMM.Barrier()
    wall = (time.perf_counter() - wall) / intervals
    cpu = COMM.allreduce(time.process_time() - cpu) / intervals
    memory = peak()
    gigabytes = bandwidth()
    state = 2 * 8 * model.chain.cell.dofs * cells
    return {
        "wall_ms": 1e3 * wall,
        "cpu_ms": 1e3 * cpu,
        "peak_gib_a_rank": memory,
        "triad_gb_per_second": gigabytes,
        # No method can do with less than reading and writing the state once an interval.
        "share_of_bandwidth_limit": 2 * state / (1e9 * gigabytes) / wall,
    }


def large(folder: str) -> dict:
    """The whole program on a million cells: runs/large.toml, files included."""
    result = simulate(Case.load("runs/large.toml", ["output.window=[1, 2000]"]), folder, force=True)
    found = {"steps": result.statistics["steps"], "wall": result.statistics["wall_seconds"], "peak_gib_a_rank": peak()}
    return found | {"triad_gb_per_second": bandwidth()}


if __name__ == "__main__":
    measured = {"flight": flight, "large": large}[sys.argv[1]](**json.loads(sys.argv[2]))
    if COMM.rank == 0:
        print(json.dumps({"ranks": COMM.size} | measured))
