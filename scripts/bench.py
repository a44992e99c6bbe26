"""Work and precision against SciPy's DOP853 with a numba right-hand side, interleaved, in CPU time.

The lattice is the built-in four-band one without contacts (the event logic is off on both sides), velocities
sampled every 2e-4 s, one core. Each setting is run in turn, several rounds; medians of the ratios count.
Writes ``runs/bench/latest.json``. With ``--large``: a million cells on one and on two ranks.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import petsc4py

petsc4py.init(["bench", "-no_signal_handler"])

from mpi4py import MPI

import numba
import numpy as np
from scipy.integrate import DOP853

from vipetsc.case import Case, Model
from vipetsc.dynamics.impacts import ImpactTracker
from vipetsc.dynamics.integrator import Integrator
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.operator import LatticeOperator
from vipetsc.store import provenance, write_text


def linear_case(rtol: float) -> Case:
    """The built-in lattice without contacts."""
    return Case.builtin(["contacts.sites=0", f"time.rtol={rtol}"])


def ours(rtol: float) -> tuple[np.ndarray, float, float]:
    """Velocities (time, cell dof) by TSRK, CPU seconds, and microseconds of one right-hand side."""
    model = linear_case(rtol).model()
    layout = Layout.of(model, MPI.COMM_SELF)
    operator = LatticeOperator(model, layout)
    integrator = Integrator(model, layout, operator, ImpactTracker(operator, model.contact))
    n, d = layout.owned, layout.dofs
    sampled = np.zeros((model.samples, n, d))
    begin = time.process_time()
    for k in range(model.samples):
        t = k * model.sample_interval
        if integrator.time < model.drive.duration < t:
            integrator.advance(model.drive.duration)
        integrator.advance(t)
        sampled[k] = integrator.state.array_r[d * n : 2 * d * n].reshape(d, n).T
    seconds = time.process_time() - begin
    slope = integrator.state.duplicate()
    begin = time.process_time()
    for _ in range(20_000):
        integrator.ts.computeRHSFunction(0.05, integrator.state, slope)
    return sampled.reshape(model.samples, -1), seconds, (time.process_time() - begin) / 20_000 * 1e6


def numba_right_hand_side(model: Model) -> Callable[[float, np.ndarray], np.ndarray]:
    """The same lattice for SciPy: banded rows, cell by cell, compiled."""
    stiffness = model.chain.stiffness_matrix().tocsr()
    first, columns, values = stiffness.indptr, stiffness.indices, stiffness.data
    inverse_mass = 1 / model.chain.masses()
    n = inverse_mass.size
    amplitude, frequency, cycles = model.drive.window_amplitude, model.drive.frequency, model.drive.cycles
    end = model.drive.duration

    @numba.njit(fastmath=False)
    def right_hand_side(t: float, y: np.ndarray) -> np.ndarray:
        f = np.empty_like(y)
        f[:n] = y[n:]
        for i in range(n):
            total = 0.0
            for k in range(first[i], first[i + 1]):
                total -= values[k] * y[columns[k]]
            f[n + i] = total * inverse_mass[i]
        if 0.0 < t < end:
            phase = frequency * t
            f[n] += amplitude * (1.0 - np.cos(phase / cycles)) * np.sin(phase) * inverse_mass[0]
        return f

    right_hand_side(0.0, np.zeros(2 * n))
    return right_hand_side


def scipys(rtol: float) -> tuple[np.ndarray, float]:
    """Velocities by DOP853 with its dense output, and CPU seconds."""
    model = linear_case(rtol).model()
    right_hand_side = numba_right_hand_side(model)
    n = model.chain.masses().size
    atol = np.repeat([rtol * model.scale, rtol * model.scale * model.drive.frequency], n)
    times = np.arange(model.samples) * model.sample_interval
    sampled = np.zeros((model.samples, n))
    begin = time.process_time()
    solver = DOP853(right_hand_side, 0.0, np.zeros(2 * n), times[-1], rtol=max(rtol, 1e-13), atol=atol)
    k = 1
    while solver.status == "running":
        solver.step()
        if k < len(times) and times[k] <= solver.t:
            output = solver.dense_output()
            while k < len(times) and times[k] <= solver.t:
                sampled[k] = output(times[k])[n:]
                k += 1
    return sampled, time.process_time() - begin


def error(sampled: np.ndarray, exact: np.ndarray) -> float:
    """Relative l2 error of all samples."""
    return float(np.linalg.norm(sampled - exact) / np.linalg.norm(exact))


def at_equal_error(rows: list[dict], wanted: float) -> float:
    """CPU seconds at the error ``wanted``, interpolated between the settings in logarithms."""
    errors, seconds = (np.log([row[key] for row in rows]) for key in ("error", "seconds"))
    order = np.argsort(errors)
    return float(np.exp(np.interp(np.log(wanted), errors[order], seconds[order])))


def work_precision(rounds: int) -> dict:
    """Both solvers at several tolerances, interleaved."""
    exact, _, _ = ours(1e-13)
    rows: dict[str, dict[float, dict]] = {"vipetsc 8vr": {}, "scipy DOP853 + numba": {}}
    tolerances = (1e-7, 1e-8, 1e-9, 1e-10, 1e-11)
    slopes = []
    for _ in range(rounds):
        for rtol in tolerances:
            velocity, seconds, slope = ours(rtol)
            slopes.append(slope)
            row = rows["vipetsc 8vr"].setdefault(rtol, {"rtol": rtol, "error": error(velocity, exact), "all": []})
            row["all"].append(seconds)
            velocity, seconds = scipys(rtol)
            row = rows["scipy DOP853 + numba"].setdefault(
                rtol, {"rtol": rtol, "error": error(velocity, exact), "all": []}
            )
            row["all"].append(seconds)
    table = {name: list(by.values()) for name, by in rows.items()}
    for by in table.values():
        for row in by:
            row["seconds"] = statistics.median(row["all"])
    ratios = {}
    for wanted in (1e-6, 1e-7, 1e-8):
        ours_seconds, theirs = (at_equal_error(by, wanted) for by in table.values())
        ratios[f"vipetsc / scipy at {wanted:g}"] = ours_seconds / theirs
    return {"rows": table, "ratios": ratios, "right_hand_side_us_at_1200_dof": statistics.median(slopes)}


LARGE = """
import json, resource, sys, time
import petsc4py
petsc4py.init(["large", "-no_signal_handler"])
from mpi4py import MPI
from vipetsc.case import Case
from vipetsc.dynamics import simulate
case = Case.load("runs/large.toml", [f"output.window=[1, 2000]"])
begin = time.perf_counter()
result = simulate(case, sys.argv[1], force=True)
peak = MPI.COMM_WORLD.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, MPI.MAX)
if MPI.COMM_WORLD.rank == 0:
    print(json.dumps({"ranks": MPI.COMM_WORLD.size, "steps": result.statistics["steps"],
                      "wall": result.statistics["wall_seconds"], "peak_gib_a_rank": peak / 2**20}))
"""


TRIAD = """
import json, time
import numpy as np
from mpi4py import MPI
comm = MPI.COMM_WORLD
a, b, c = (np.ones(8_000_000) for _ in range(3))
np.add(a, b, out=c)
comm.Barrier()
begin = time.perf_counter()
for _ in range(60):
    np.add(a, b, out=c)
comm.Barrier()
seconds = time.perf_counter() - begin
if comm.rank == 0:
    print(json.dumps({"gb_per_second": comm.size * 60 * 3 * a.nbytes / seconds / 1e9}))
"""


def on_ranks(ranks: int, code: str, *arguments: str) -> dict:
    """What ``code`` prints last, as JSON, when run on ``ranks``."""
    # This process has its own MPI: the mpirun it starts must not inherit that.
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_COMM", "PMIX", "OMPI_UNIVERSE"))}
    command = ["mpirun", "-n", str(ranks), sys.executable, "-c", code, *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return json.loads(ended.stdout.strip().splitlines()[-1])


def large(folder: Path, rounds: int) -> dict:
    """A million cells on one and on two ranks, in turn, beside what the memory itself gains from two."""
    runs: dict[int, list[dict]] = {1: [], 2: []}
    for _ in range(rounds):
        for ranks, found in runs.items():
            memory = on_ranks(ranks, TRIAD)
            found.append(on_ranks(ranks, LARGE, str(folder / f"large-{ranks}")) | memory)
    pairs = list(zip(runs[1], runs[2], strict=True))
    return {
        "runs": runs[1] + runs[2],
        "speedup_on_two_ranks": statistics.median(one["wall"] / two["wall"] for one, two in pairs),
        "memory_speedup_on_two_ranks": statistics.median(
            two["gb_per_second"] / one["gb_per_second"] for one, two in pairs
        ),
    }


def main() -> None:
    """Measure, print, and store."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3, help="interleaved repetitions")
    parser.add_argument("--large", action="store_true", help="also a million cells on one and two ranks (minutes)")
    options = parser.parse_args()
    folder = Path("runs/bench")
    folder.mkdir(parents=True, exist_ok=True)
    found = work_precision(options.rounds)
    for name, rows in found["rows"].items():
        for row in rows:
            print(f"{name:<22} rtol {row['rtol']:<8g} error {row['error']:.2e}  {row['seconds']:.3f} s CPU")
    for name, ratio in found["ratios"].items():
        print(f"{name}: {ratio:.3f}")
    print(f"right-hand side at 1200 DoF: {found['right_hand_side_us_at_1200_dof']:.2f} us")
    if options.large:
        found["large"] = large(folder, 1)
        for run in found["large"]["runs"]:
            print(f"1e6 cells, {run['ranks']} rank(s): {run['steps']} steps, {run['wall']:.1f} s, "
                  f"{run['peak_gib_a_rank']:.2f} GiB a rank")  # fmt: skip
        gain, memory = (found["large"][f"{name}speedup_on_two_ranks"] for name in ("", "memory_"))
        print(f"two ranks are {gain:.2f} times faster; bare memory traffic (c = a + b): {memory:.2f} times")
    found["provenance"] = provenance(MPI.COMM_WORLD)
    write_text(folder / "latest.json", json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
