"""Solvers of this package: each engine that a case file can choose, run as by the program but without files."""

from __future__ import annotations

import time
from typing import get_args

from mpi4py import MPI

import numpy as np
from bench_peers import Solution, Solver

from vipetsc.case import Case
from vipetsc.case.schema import TimeTable
from vipetsc.dynamics.energies import EnergyMeter
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.observers import Guard, Ledger, Setup
from vipetsc.dynamics.plan import choose_engine
from vipetsc.dynamics.run import ENGINES, Clocks, Run
from vipetsc.endings import Ending
from vipetsc.io.store import RunMemory


def engines() -> tuple[str, ...]:
    """Return names of the engines that a case file's ``time.engine`` may choose."""
    return tuple(name for name in get_args(TimeTable.model_fields["engine"].annotation) if name != "auto")


class EngineRun:
    """A run of ``case`` on the ranks of ``comm`` by the engine that it asks for, in memory.

    Raises RuntimeError if that engine refuses the case: a run would go on with another one, whose time would be
    reported under the wrong name.
    """

    def __init__(self, case: Case, comm: MPI.Comm) -> None:
        self.case = case
        self.model = case.model()
        engine = choose_engine(case, self.model)
        if engine.refused:
            raise RuntimeError(engine.refused)
        self.output = RunMemory(comm)
        self.output.begin(case.to_toml())
        self.layout = Layout(self.model, comm)
        self.engine = ENGINES[engine.name](self.model, self.layout)
        meter = EnergyMeter(self.model, self.layout, self.engine.lattice)
        setup = Setup(case, self.model, self.layout, meter, self.engine, self.output)
        self._run = Run(setup, (Guard, Ledger))

    def advance(self, begin: int, end: int) -> None:
        """Go from the sample ``begin`` to the sample ``end`` and record none; ``ts`` ends a step at each sample."""
        if self.engine.name == "propagator":
            self.engine.fill(self._run.recorder.room(end + 1, 0))
            return
        for sample in range(begin + 1, end + 1):
            self.engine.advance(sample * self.model.sample_interval)

    def velocities(self) -> tuple[np.ndarray, float]:
        """Compute all velocities (sample, cell, dof) in m/s on one rank; returns them and the CPU seconds it took.

        ``ts`` goes from sample to sample. The propagator computes samples in blocks, in the run's own loop, with the
        energies. Raises RuntimeError if the run fails.
        """
        n = self.layout.owned
        d = self.layout.dofs
        begin = time.process_time()
        if self.engine.name == "ts":
            sampled = np.empty((self.model.samples, d, n))
            for k in range(self.model.samples):
                self.engine.advance(k * self.model.sample_interval)
                sampled[k] = self.engine.state.array_r[d * n : 2 * d * n].reshape(d, n)
            return sampled.swapaxes(1, 2), time.process_time() - begin

        ended = self._run.advance()
        seconds = time.process_time() - begin
        if ended.ending is not Ending.COMPLETE:
            raise RuntimeError(ended.sentence)
        self._run.finish(ended, Clocks(wall=0.0, cpu=0.0), {})
        assert self.output.dataset is not None
        return self.output.dataset.velocity.values, seconds


def solve(case: Case) -> Solution:
    """Solve ``case`` by its own engine on one rank."""
    # Only velocities are recorded, because the peers return nothing else: displacements would cost time.
    output = case.output.model_copy(update={"fields": ["velocity"]})
    run = EngineRun(case.model_copy(update={"output": output}), MPI.COMM_SELF)
    sampled, seconds = run.velocities()
    # PETSc's objects must be freed by all ranks together, not when Python collects them.
    run.engine.destroy()
    return Solution(sampled.reshape(run.model.samples, -1), seconds)


def _by_engine(case: Case, name: str) -> Case:
    """Return a copy of ``case`` that asks for the engine ``name``."""
    return case.model_copy(update={"time": case.time.model_copy(update={"engine": name})})


def own_solvers() -> dict[str, Solver]:
    """Return a solver for each engine, by name; it uses this engine whichever the case asks for."""

    def with_engine(name: str) -> Solver:
        return lambda case: solve(_by_engine(case, name))

    return {f"vipetsc {name}": with_engine(name) for name in engines()}


def right_hand_side_us(case: Case, evaluations: int = 20_000) -> float:
    """Return microseconds of CPU time of one right-hand side of the case through PETSc; mean of ``evaluations``.

    Evaluations take some microseconds each, so that 20,000 of them are far above the resolution of the clock.
    """
    run = EngineRun(_by_engine(case, "ts"), MPI.COMM_SELF)
    ts = run.engine.ts
    state = run.engine.state
    slope = state.duplicate()
    begin = time.process_time()
    for _ in range(evaluations):
        # A time within the drive, so that its force is computed too.
        ts.computeRHSFunction(0.05, state, slope)
    return (time.process_time() - begin) / evaluations * 1e6
