"""Scaling over cells and ranks, with memory and bandwidth; set-up and files of large lattices; whole runs."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from mpi4py import MPI

from bench_ours import engines

from vipetsc.case import Case
from vipetsc.dynamics import simulate

WORKER = Path(__file__).with_name("bench_worker.py")
# A lattice that exceeds the machine's memory would swap for hours; any other is measured in some seconds.
PATIENCE = 300  # seconds that one measurement may take
MOST_TS_CELLS = 300_000  # beyond which `ts` takes minutes and shows nothing more


def on_ranks(ranks: int, task: str, **arguments: object) -> dict:
    """Run the worker's ``task`` with its ``arguments`` on so many ``ranks``; returns its measures.

    Raises RuntimeError if it fails or takes more than ``PATIENCE``.
    """
    # This process has initialised MPI: with its variables, mpirun would take itself for one of its ranks.
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_COMM", "PMIX", "OMPI_UNIVERSE"))}
    command = ["mpirun", "-n", str(ranks), sys.executable, str(WORKER), task, json.dumps(arguments)]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=PATIENCE)
    except subprocess.TimeoutExpired as error:
        raise RuntimeError(f"{task} on {ranks} ranks took more than {PATIENCE} s") from error
    if ended.returncode:
        raise RuntimeError(f"{task} on {ranks} ranks failed: {ended.stderr.strip()[-2000:]}")
    # The measures are on the last line, because libraries may print before it.
    return json.loads(ended.stdout.strip().splitlines()[-1])


def scaling(cells: Iterable[int], rounds: int) -> list[dict]:
    """Measure every engine at all lengths in ``cells``; returns rows for one rank and for two.

    A length that failed has one row, which says why. Numbers are medians over ``rounds``.
    """
    rows = []
    for engine in engines():
        for n in cells:
            # The time of ts is in proportion to the cells from 30,000 cells on.
            if engine == "ts" and n > MOST_TS_CELLS:
                continue
            try:
                # Length by length, so that one that the machine cannot hold does not cost the rows of the others.
                rows += _pair(engine, n, rounds)
            except RuntimeError as failure:
                rows.append({"engine": engine, "cells": n, "ranks": 0, "failure": str(failure)})
    return rows


def _pair(engine: str, cells: int, rounds: int) -> list[dict]:
    """Return the rows of one rank and of two at one length, as medians over ``rounds``, in which they take turns."""
    turns: dict[int, list[dict]] = {1: [], 2: []}
    # The same work at all lengths, a million cells times an interval, within bounds that can be timed and waited for.
    intervals = max(10, min(200, 1_000_000 // cells))
    for _ in range(rounds):
        for ranks, found in turns.items():
            found.append(on_ranks(ranks, "intervals", engine=engine, cells=cells, intervals=intervals))
    rows: list[dict] = []
    for ranks, found in turns.items():
        medians = {key: statistics.median(turn[key] for turn in found) for key in found[0] if key != "ranks"}
        rows.append({"engine": engine, "cells": cells, "ranks": ranks} | medians)

    # Gains are medians of ratios of one turn, since the speed of the machine changes from turn to turn.
    pairs = list(zip(turns[1], turns[2], strict=True))
    rows[-1]["speedup"] = statistics.median(one["wall_ms"] / two["wall_ms"] for one, two in pairs)
    slower = statistics.median(one["triad_gb_per_second"] / two["triad_gb_per_second"] for one, two in pairs)
    rows[-1]["memory_speedup"] = 1 / slower
    return rows


def builds(sizes: Iterable[tuple[int, int]]) -> list[dict]:
    """Measure set-up and files of runs of these ``sizes`` (cells, sites) on one rank and on two; a row for each."""
    rows = []
    for cells, sites in sizes:
        for ranks in (1, 2):
            try:
                rows.append(on_ranks(ranks, "build", cells=cells, sites=sites))
            except RuntimeError as failure:
                rows.append({"cells": cells, "sites": sites, "ranks": ranks, "failure": str(failure)})
    return rows


def whole_runs(folder: Path, rounds: int) -> dict[str, float]:
    """Return CPU seconds of the built-in case up to ``run.h5``, by engine: median of ``rounds`` after a warm-up."""
    seconds: dict[str, list[float]] = {name: [] for name in engines()}
    for turn in range(rounds + 1):
        for engine, found in seconds.items():
            overrides = [f"time.engine={engine}"]
            if turn == 0:
                # The warm-up loads the compiled kernels, for which a hundredth of a second of motion is enough.
                overrides.append("time.end=0.01")
            # All rounds use one folder, and must replace its results.
            result = simulate(Case.load(overrides=overrides), folder / f"whole-{engine}", MPI.COMM_SELF, force=True)
            if turn:
                found.append(result.statistics["cpu_seconds"])
    return {engine: statistics.median(found) for engine, found in seconds.items()}


def large(folder: Path, rounds: int) -> dict:
    """Run the whole program on a million cells, on one rank and on two in turn; returns the runs and their medians.

    ``speedup_on_two_ranks`` is the gain of two ranks, ``memory_speedup_on_two_ranks`` that of the memory's bandwidth.
    """
    runs: dict[int, list[dict]] = {1: [], 2: []}
    for _ in range(rounds):
        for ranks, found in runs.items():
            found.append(on_ranks(ranks, "large", folder=str(folder / f"large-{ranks}")))
    pairs = list(zip(runs[1], runs[2], strict=True))
    return {
        "runs": runs[1] + runs[2],
        "speedup_on_two_ranks": statistics.median(one["wall"] / two["wall"] for one, two in pairs),
        "memory_speedup_on_two_ranks": statistics.median(
            two["triad_gb_per_second"] / one["triad_gb_per_second"] for one, two in pairs
        ),
    }
