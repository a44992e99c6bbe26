"""Work and precision of vipetsc's engines and of their peers, interleaved, in CPU time at equal error.

The lattice is the four-band one of 300 cells with its five sites, A = 30 N, conservative; all solvers return the
velocities every 2e-4 s, on one core. Further parts measure whole programs compared with an earlier version, members of
a sweep, the CPU time of the paper (from the folder that ``paper`` left), scaling over cells and ranks, and set-up and
files of large lattices. Writes ``latest.json`` and pictures. The full bench takes
about half an hour, ``--quick`` five minutes; ``--large`` adds the whole program on a million cells (minutes).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

# Every solver has one core. Set before numpy is imported, since BLAS starts its threads then.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import petsc4py

# PETSc's signal handlers are left out: they end the process by MPI_Abort, and would leave running peers behind.
petsc4py.init(["bench", "-no_signal_handler"])

from mpi4py import MPI

from bench_members import member_seconds, paper_budget
from bench_ours import own_solvers, right_hand_side_us
from bench_peers import parameters, peers
from bench_precision import lattice_case, work_precision
from bench_programs import BASELINE, PROGRAMS, programs
from bench_report import draw, markdown
from bench_scaling import builds, large, scaling, whole_runs

from vipetsc.case import Case
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import provenance

PARTS = ("precision", "whole", "programs", "members", "scaling", "builds")
# The packages that a machine must have for the peers, by the beginning of a peer's name.
NEEDED = {
    "odeint": "g++ and libboost-dev",
    "ARKODE": "g++ and libsundials-dev",
    "TSRK": "mpicxx, pkg-config and petsc-dev",
    "diffrax": "the environment that scripts/bench sets up (packages diffrax and jax)",
}
FULL = {
    # A decade apart: errors fall by about a decade from one to the next, and the ratios are interpolated between
    # them.
    "tolerances": [float(f"1e-{k}") for k in range(5, 14)],
    # The median of five leaves out two rounds that another process disturbed.
    "rounds": 5,
    "cells": [300, 3000, 30_000, 100_000, 300_000, 10**6],
    "sizes": [(10**6, 1000), (10**6, 10**5), (10**7, 10**4)],
}
QUICK = {
    # These tolerances span the errors from 1e-5 to 1e-9 at which solvers are compared.
    "tolerances": [1e-7, 1e-9, 1e-11, 1e-13],
    "rounds": 1,
    "cells": [300, 30_000, 100_000],
    "sizes": [(10**6, 10**5)],
}


def options_from(arguments: list[str]) -> argparse.Namespace:
    """Return the options of the command line; those not given have the values of ``QUICK`` or ``FULL``."""
    parser = argparse.ArgumentParser(
        "scripts/bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="four tolerances, one round, up to 100,000 cells")
    parser.add_argument("--only", choices=PARTS, action="append", help="measure only this part (may be repeated)")
    parser.add_argument("--large", action="store_true", help="also the whole program on a million cells")
    parser.add_argument("--rounds", type=int, help="interleaved repetitions")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change the compared case")
    parser.add_argument("--out", type=Path, default=Path("runs/bench"), help="where results go")
    parser.add_argument("--paper", type=Path, default=Path("runs/paper"), help="folder that `paper` left")
    parser.add_argument("--baseline", default=BASELINE, metavar="COMMIT", help="the earlier version of programs")
    parser.add_argument("--table", action="store_true", help="print the tables of the last results, no more")

    options = parser.parse_args(arguments)
    if options.rounds is not None and options.rounds < 1:
        parser.error(f"--rounds {options.rounds}: must be at least 1")
    for key, value in (QUICK if options.quick else FULL).items():
        # A value from the command line has precedence.
        if getattr(options, key, None) is None:
            setattr(options, key, value)
    return options


def measure(case: Case, options: argparse.Namespace) -> dict:
    """Measure all parts asked for; returns the content of ``latest.json``."""
    parts = options.only or PARTS
    cells = case.lattice.cells
    found: dict = {
        "mode": "quick" if options.quick else "full",
        "rounds": options.rounds,
        "parts": list(parts),
        "rows": [],
        "ratios": {},
        "cells": cells,
        "degrees_of_freedom": cells * case.lattice.unit_cell().dofs,
        "case": case.model_dump(by_alias=True, mode="json"),
    }

    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        if "precision" in parts:
            # Peers are built for each bench, by the compiler and for the processor that it reports.
            solvers = own_solvers() | peers(Path(folder))
            for name, needed in NEEDED.items():
                if not any(solver.startswith(name) for solver in solvers):
                    print(f"bench: goes on without {name}, which needs {needed}", file=sys.stderr)
            found |= work_precision(solvers, case, options.tolerances, options.rounds)
        if "whole" in parts:
            found["whole"] = whole_runs(Path(folder), options.rounds)
            found["right_hand_side_us"] = right_hand_side_us(case)
        if "programs" in parts:
            found["programs"] = measured_programs(options)
        if "members" in parts:
            # Three rounds are enough, because each has four sweeps.
            found["members"] = member_seconds(Path(folder), min(options.rounds, 3))
            found["paper"] = paper_budget(options.paper)
        if "scaling" in parts:
            found["scaling"] = scaling(options.cells, min(options.rounds, 3))
        if "builds" in parts:
            found["builds"] = builds(options.sizes)
        if options.large:
            found["large"] = large(Path(folder), 1)

    found["minutes"] = (time.perf_counter() - begin) / 60
    found["provenance"] = provenance(MPI.COMM_WORLD)
    return found


def measured_programs(options: argparse.Namespace) -> list[dict]:
    """Return the rows of whole programs; none, with a message, where the earlier version is not in the repository."""
    names = [name for name, program in PROGRAMS.items() if not (options.quick and program.compiles)]
    try:
        return programs(options.out.absolute(), options.rounds, options.baseline, names)
    except RuntimeError as error:
        print(f"bench: goes on without programs: {error}", file=sys.stderr)
        return []


def print_rows(found: dict) -> None:
    """Print rows and ratios for people."""
    for row in found["rows"]:
        result = row.get("failure") or f"error {row['error']:.2e}  {row['seconds']:.3f} s CPU"
        print(f"{row['solver']:<20} rtol {row['rtol']:<8.2g} {result}")
    for name, ratio in found["ratios"].items():
        if name.endswith("at 1e-08"):
            low, high = found["spread"][name]
            print(f"{name}: {ratio:.2f} ({low:.2f} to {high:.2f})")
    for run in found.get("large", {}).get("runs", []):
        speed = f"{run['steps']} steps, {run['wall']:.1f} s"
        memory = f"{run['peak_gib_a_rank']:.2f} GiB a rank, triad {run['triad_gb_per_second']:.1f} GB/s"
        print(f"runs/examples/large.toml, {run['ranks']} rank(s): {speed}, {memory}")
    print(f"measured in {found['minutes']:.1f} min\n")


def main(arguments: list[str]) -> int:
    """Measure, store, draw and print; returns the exit code."""
    options = options_from(arguments)
    latest = options.out / "latest.json"
    if options.table:
        if not latest.exists():
            print(f"bench: {latest} does not exist; run scripts/bench first", file=sys.stderr)
            return 2
        found = json.loads(latest.read_text(encoding="utf-8"))
        print(markdown(found), end="")
        return 0

    # A case that the peers cannot solve is refused before anything is measured.
    try:
        case = lattice_case(options.set)
        parameters(case.model())
    except ValueError as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2

    found = measure(case, options)
    options.out.mkdir(parents=True, exist_ok=True)
    write_text(latest, json.dumps(found, indent=2) + "\n")
    print_rows(found)
    print(markdown(found))
    for path in draw(found, options.out):
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
