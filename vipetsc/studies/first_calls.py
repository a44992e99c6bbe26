"""First calls of compiled kernels: small runs, branches and a fit, which compile and store those of most studies."""

import tempfile
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.case import Case, NnmCase
from vipetsc.case.identify import IdentifyCase
from vipetsc.dynamics.run import simulate
from vipetsc.modes.branches.follow import follow_all
from vipetsc.parallel import on_every_rank
from vipetsc.studies.analysis import analyse
from vipetsc.studies.identification import run_identification

# Both sites are touched, so that all that contacts call is called.
RUN: dict[str, Any] = {
    "lattice": {"cells": 40},
    "contacts": {"sites": [6, 12], "clearance": 1e-4},
    "time": {"end": 0.08},
}
# A mode of the cell; a breather of a lattice, shot without dense matrices. The two flows that a branch may be compared
# with would add a third to all of this: their kernels are compiled where a case asks for them.
CELL: dict[str, Any] = {
    "lattice": {"preset": "four-band", "reading": "printed"},
    "contacts": {"law": "bilinear", "modulus": 1e8},
    "nnm": {"modes": [2], "energy": [0.0, 1e9], "chart": "auto", "points": 2},
}
BREATHER: dict[str, Any] = {
    "lattice": {"preset": "four-band", "cells": 20},
    "contacts": {"sites": [7]},
    "nnm": {"system": "condensed", "start_frequency": [1600.0], "tolerance": 1e-12, "first_step": 1e-2, "points": 2},
}
# One clearance in the first contacts of the record that comes with the examples.
RECORD = Path(__file__).parents[1] / "examples" / "identify.csv"
IDENTIFIED: dict[str, Any] = {
    "lattice": {"cells": 12},
    "contacts": {"sites": [3], "clearance": 1e-3},
    "drive": {"cycles": 6},
    "identify": {
        "steps": 1,
        "profile": 0,
        "records": [
            {
                "file": str(RECORD),
                "time": "time (s)",
                "end": 0.008,
                "sensors": [{"quantity": "velocity", "column": "near (m/s)", "cell": 4, "mass": 1}],
            }
        ],
        "unknowns": [{"quantity": "clearance", "bounds": [3e-4, 5e-3]}],
    },
}


def compile_kernels(comm: MPI.Comm) -> None:
    """Compile the kernels of runs, branches and fits that are not kept yet.

    The calls are divided over the ranks: the propagator's steps take as long as all others. All ranks must call it.
    """
    parts: list[list[Callable[[], object]]] = [
        [partial(run, "propagator"), partial(follow, BREATHER)],
        [partial(follow, CELL), partial(run, "ts"), identify, find_fonts],
    ]

    def call_own() -> None:
        for part in parts[comm.rank :: comm.size]:
            for call in part:
                call()

    on_every_rank(comm, call_own)


def run(engine: str) -> None:
    """Simulate a run by one of the engines, and measure it."""
    case = Case.from_table(RUN | {"time": RUN["time"] | {"engine": engine}})
    recorded = simulate(case, comm=MPI.COMM_SELF).dataset
    assert recorded is not None
    analyse(recorded)


def follow(table: dict[str, Any]) -> None:
    """Follow the branches of a case ``table`` for two points, whether they converge or not."""
    # The branch itself is of no use: its kernels are what is left.
    with tempfile.TemporaryDirectory() as folder:
        follow_all(NnmCase.from_table(table), Path(folder), MPI.COMM_SELF)


def identify() -> None:
    """Take one step of a fit to a record."""
    with tempfile.TemporaryDirectory() as folder:
        run_identification(IdentifyCase.from_table(IDENTIFIED), Path(folder), MPI.COMM_SELF)


def find_fonts() -> None:
    """Have Matplotlib list the machine's fonts, which it does, and stores, when the module is first loaded."""
    import_module("matplotlib.font_manager")
