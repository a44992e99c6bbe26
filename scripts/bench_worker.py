"""Measurements of the bench under mpirun: ``bench_worker.py TASK JSON``; rank 0 prints a line of JSON.

The tasks are ``intervals``, ``build`` and ``large``, each with the arguments of its function as JSON.
"""

from __future__ import annotations

import itertools
import json
import os
import resource
import sys
import tempfile
import time
from pathlib import Path

import petsc4py

# PETSc's signal handlers are left out: a failure is then an exception of Python, whose last lines the bench reports.
petsc4py.init(["bench", "-no_signal_handler"])

from mpi4py import MPI
from petsc4py import PETSc

import numba
import numpy as np
from bench_ours import EngineRun
from bench_precision import lattice_case

from vipetsc.case import Case
from vipetsc.dynamics import simulate

COMM = MPI.COMM_WORLD
# The phases of a run, as its audit events name them. "read" is the time before the first of them.
PHASES = ("claim", "set-up", "step", "checkpoint", "flush", "assemble", "conclude", "clean", "swap")

# Events of PETSc's log: the first is PETSc's own, the others are registered by this package.
EVENTS = ("TSStep", "Propagator", "ContactSearch", "Landing", "Recorder")


@numba.njit
def triad(a: np.ndarray, b: np.ndarray, c: np.ndarray, s: float) -> None:
    """STREAM's a = b + s c."""
    for i in range(a.size):
        a[i] = b[i] + s * c[i]


def bandwidth(size: int = 8_000_000, turns: int = 12) -> float:
    """Return bandwidth in GB/s of STREAM's triad on all ranks at once: best of ``turns``, 24 bytes an element."""
    # By default three arrays of 64 MB each, which exceed the caches of a processor: the memory itself is measured.
    a = np.zeros(size)
    b = np.ones(size)
    c = np.ones(size)
    # The first call compiles, and has the operating system provide the memory.
    triad(a, b, c, 0.5)
    # The best turn counts, as in STREAM, since other processes can only take from the bandwidth.
    best = np.inf
    for _ in range(turns):
        COMM.Barrier()
        begin = time.perf_counter()
        triad(a, b, c, 0.5)
        COMM.Barrier()
        best = min(best, time.perf_counter() - begin)
    return COMM.size * 24 * size / COMM.allreduce(best, MPI.MAX) / 1e9


def peak() -> float:
    """Return the largest resident size of any rank so far in GiB."""
    return COMM.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, MPI.MAX) / 2**20


def time_intervals(engine: str, cells: int, intervals: int) -> dict:
    """Measure an ``engine`` on a lattice of ``cells`` over so many sample ``intervals``, in the midst of a short burst.

    Returns milliseconds a sample interval, also those of ``EVENTS``, memory and bandwidth.
    """
    # A burst of three cycles ends soon; the window of nine cells keeps what is recorded small at every length.
    case = lattice_case([f"lattice.cells={cells}", f"time.engine={engine}", "drive.cycles=3", "output.window=[1, 9]"])
    run = EngineRun(case, COMM)
    model = run.model
    # The time is measured from a third of the burst on: in a lattice at rest ts takes its longest steps.
    first = round(model.drive.duration / 3 / model.sample_interval)
    run.advance(0, first)
    COMM.Barrier()
    begin = time.perf_counter()
    begin_cpu = time.process_time()
    run.advance(first, first + intervals)
    COMM.Barrier()
    wall = (time.perf_counter() - begin) / intervals
    cpu = COMM.allreduce(time.process_time() - begin_cpu) / intervals

    # The peak is read before the triad, whose arrays may be larger than all else.
    memory = peak()
    by_event = spent(run, first + intervals, min(intervals, 50))
    gigabytes = bandwidth()
    state_bytes = 2 * 8 * model.chain.cell.dofs * cells
    return {
        "wall_ms": 1e3 * wall,
        "cpu_ms": 1e3 * cpu,
        "peak_gib_a_rank": memory,
        "triad_gb_per_second": gigabytes,
        # Every method reads and writes the state at least once an interval.
        "fraction_of_bandwidth_limit": 2 * state_bytes / (1e9 * gigabytes) / wall,
    } | by_event


def spent(run: EngineRun, done: int, intervals: int) -> dict[str, float]:
    """Return the time of each of ``EVENTS`` on this rank in ms a sample interval, over ``intervals``.

    ``run`` has reached the sample ``done``.
    """
    # The log begins after the steps that were timed, which it would slow down.
    PETSc.Log.begin()

    def logged() -> np.ndarray:
        return np.array([1e3 * PETSc.Log.Event(name).getPerfInfo()["time"] for name in EVENTS])

    # PETSc counts from the start of the log.
    before = logged()
    run.advance(done, done + intervals)
    milliseconds = (logged() - before) / intervals
    return {f"{name}_ms": float(value) for name, value in zip(EVENTS, milliseconds, strict=True)}


def build(cells: int, sites: int) -> dict:
    """Run a lattice from its tables to its folder, with three samples and all velocities.

    Returns wall seconds by phase, and the sizes of file and memory.
    """
    marks: list[tuple[str, float]] = []

    def mark(event: str, _: object) -> None:
        phase = event.removeprefix("vipetsc.")
        if event.startswith("vipetsc.") and phase in PHASES:
            marks.append((phase, time.perf_counter()))

    sys.addaudithook(mark)
    with tempfile.TemporaryDirectory(dir=os.environ.get("BENCH_FOLDER")) as own:
        folder = Path(COMM.bcast(own))
        # The run of a short lattice compiles the kernels first, which is not measured.
        simulate(_spread(1000, 10), folder / "compiles", COMM)
        marks[:] = [("read", time.perf_counter())]
        simulate(_spread(cells, sites), folder / "run", COMM)
        marks.append(("end", time.perf_counter()))
        size = (folder / "run" / "run.h5").stat().st_size
        COMM.Barrier()

    seconds: dict[str, float] = {}
    for (phase, begin), (_, end) in itertools.pairwise(marks):
        seconds[phase] = seconds.get(phase, 0.0) + end - begin
    return {
        "cells": cells,
        "sites": sites,
        "seconds": seconds,
        "set_up_s": seconds["read"] + seconds["set-up"],
        "write_s": sum(seconds.get(phase, 0.0) for phase in ("flush", "assemble", "conclude")),
        "file_gb": size / 1e9,
        "peak_gib_a_rank": peak(),
    }


def _spread(cells: int, sites: int) -> Case:
    """Return a case with evenly spread ``sites``, which no wave reaches in its three samples."""
    # Sites are away from both ends, because the first end is driven.
    places = np.linspace(cells // 10, cells - cells // 10, sites).round().astype(int).tolist()
    table = {
        "name": "build",
        "lattice": {"preset": "four-band", "cells": cells},
        "contacts": {"sites": places, "clearance": 2e-3},
        "time": {"sample_interval": 2e-4, "end": 4e-4, "engine": "propagator"},
        "output": {"fields": ["velocity"], "figures": False},
    }
    return Case.from_table(table)


def large(folder: str) -> dict:
    """Run the whole program on a million cells, runs/examples/large.toml, with its files; returns its measures."""
    result = simulate(Case.load("runs/examples/large.toml", ["output.window=[1, 2000]"]), folder, force=True)
    memory = peak()
    return {
        "steps": result.statistics["steps"],
        "wall": result.statistics["wall_seconds"],
        "peak_gib_a_rank": memory,
        "triad_gb_per_second": bandwidth(),
    }


if __name__ == "__main__":
    task = {"intervals": time_intervals, "build": build, "large": large}[sys.argv[1]]
    measured = task(**json.loads(sys.argv[2]))
    if COMM.rank == 0:
        print(json.dumps({"ranks": COMM.size} | measured))
