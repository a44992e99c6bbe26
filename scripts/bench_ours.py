"""Ours: every engine the case files know, through the parts that a run is made of, without its files."""

from __future__ import annotations

import time
from typing import get_args

from mpi4py import MPI

import numpy as np
from bench_peers import Solution, Solver

from vipetsc.case import Case
from vipetsc.case.schema import TimeTable
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.run import select_engine


def engines() -> tuple[str, ...]:
    """Names of the engines that a case file's ``time.engine`` may choose."""
    return tuple(name for name in get_args(TimeTable.model_fields["engine"].annotation) if name != "auto")


class Flight:
    """A case in motion on the ranks of ``comm``, from sample to sample, by the engine that it asks for.

    Raises RuntimeError if that engine refuses the case: another one's time would stand under its name.
    """

    def __init__(self, case: Case, comm: MPI.Comm) -> None:
        self.model = case.model()
        self.layout = Layout(self.model, comm)
        kind, refused = select_engine(case, self.model)
        if refused:
            raise RuntimeError(refused)
        self.engine = kind(self.model, self.layout)

    def advance(self, sample: int) -> None:
        """Go to a sample; samples must be taken in turn."""
        self.engine.advance(sample * self.model.sample_interval)

    @property
    def velocity(self) -> np.ndarray:
        """Owned velocities (cell, dof) in m/s."""
        n, d = self.layout.owned, self.layout.dofs
        return self.engine.state.array_r[d * n : 2 * d * n].reshape(d, n).T


def solve(case: Case) -> Solution:
    """The case by its own engine on one rank."""
    flight = Flight(case, MPI.COMM_SELF)
    model = flight.model
    sampled = np.empty((model.samples, model.chain.cells, model.chain.cell.dofs))
    begin = time.process_time()
    for k in range(model.samples):
        flight.advance(k)
        sampled[k] = flight.velocity
    seconds = time.process_time() - begin
    flight.engine.destroy()
    return Solution(sampled.reshape(model.samples, -1), seconds)


def own_solvers() -> dict[str, Solver]:
    """One solver an engine, by name; each uses its engine whatever the case says."""

    def with_engine(name: str) -> Solver:
        return lambda case: solve(case.model_copy(update={"time": case.time.model_copy(update={"engine": name})}))

    return {f"vipetsc {name}": with_engine(name) for name in engines()}


def right_hand_side_us(case: Case, evaluations: int = 20_000) -> float:
    """Microseconds of CPU that one right-hand side of the case costs through PETSc."""
    flight = Flight(case.model_copy(update={"time": case.time.model_copy(update={"engine": "ts"})}), MPI.COMM_SELF)
    ts, state = flight.engine.ts, flight.engine.state
    slope = state.duplicate()
    begin = time.process_time()
    for _ in range(evaluations):
        ts.computeRHSFunction(0.05, state, slope)
    return (time.process_time() - begin) / evaluations * 1e6
