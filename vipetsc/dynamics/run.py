"""A case in, a result out."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import Case, Model
from vipetsc.dynamics.engine import StalledError, choose
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.ledger import Ledger
from vipetsc.dynamics.operator import LatticeOperator
from vipetsc.dynamics.propagator.engine import Propagator
from vipetsc.dynamics.recorder import Recorder
from vipetsc.dynamics.ts.integrator import Integrator
from vipetsc.io.folder import provenance
from vipetsc.io.store import RunFolder
from vipetsc.parallel import Progress, StopRequest, on_root

# In the order in which engine = "auto" tries them.
ENGINES = (Propagator, Integrator)


@dataclass(frozen=True)
class Result:
    """How a run ended.

    ``complete``: the whole case was simulated; ``resumable``: it was stopped and can go on from its last
    checkpoint; neither: it failed, and ``run.h5`` holds the samples up to the last good one. ``sentence`` says
    it in words, ``statistics`` in numbers.
    """

    complete: bool
    resumable: bool
    sentence: str
    statistics: dict[str, Any]
    folder: Path | None


def simulate(
    case: Case,
    folder: str | Path | RunFolder,
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    force: bool = False,
    resume: bool = False,
    native: bool = True,
    stop: StopRequest | None = None,
    progress: bool = False,
) -> Result:
    """Simulate ``case`` on all ranks of ``comm`` and leave ``run.h5`` and ``summary.json`` in ``folder``.

    Parameters
    ----------
    case
        A resolved case.
    folder
        Output folder; must not exist unless ``force`` (replaces the run in it) or ``resume`` (goes on with an
        unfinished one, to the same bits). A ``RunMemory`` keeps the run in memory.
    comm
        The ranks that share the lattice; those of a ``RunMemory`` are its own.
    native
        Register the right-hand side natively (default) or through Python.
    stop
        A request that ends the run after the step at hand.
    progress
        Report progress on stderr of rank 0.

    Raises
    ------
    FolderError
        If the folder cannot be used as asked.
    """
    begin = time.perf_counter(), time.process_time()
    model = case.model()
    home = folder if isinstance(folder, RunFolder) else RunFolder(Path(folder), comm)
    comm = home.comm
    on_root(comm, lambda: home.prepare(case, force, resume))
    run = _Run(case, model, home, native, stop, Progress(comm, model.end, "s", show=progress))
    if resume:
        run.restore(on_root(comm, home.last_state))
    complete, sentence = run.go()
    return run.finish(complete, sentence, begin)


class _Run:
    """The parts of one simulation and the loop over its samples."""

    def __init__(
        self, case: Case, model: Model, home: RunFolder, native: bool, stop: StopRequest | None, progress: Progress
    ) -> None:
        self.case, self.model, self.home, self.progress = case, model, home, progress
        self.comm = home.comm
        self.layout = Layout.of(model, self.comm)
        self.operator = LatticeOperator(model, self.layout)
        kind, self.refused = choose(case.time.engine, model, ENGINES)
        self.engine = kind.create(model, self.layout, self.operator, native, stop)
        self.ledger = Ledger(model, self.operator)
        self.recorder = Recorder(case, model, self.layout)
        self.parts = 0
        self.samples = 0
        self.episodes = 0
        self.last: float | None = None

    def restore(self, number: int) -> None:
        """Go on after checkpoint ``number``; -1 is the beginning."""
        if number < 0:
            return
        checkpoint = self.home.read_state(number)
        self.engine.restore(checkpoint)
        self.samples, self.episodes = (int(n) for n in checkpoint["done"])
        self.ledger.worst, self.ledger.most_work = checkpoint["ledger"].tolist()
        self.parts = number + 1
        self.last = self.engine.time
        self.progress.start_at(self.engine.time)

    def go(self) -> tuple[bool, str]:
        """Simulate to the end; whether it was reached, and how it ended in words."""
        engine, model = self.engine, self.model
        while self.samples < model.samples:
            t = self.samples * model.sample_interval
            try:
                going = engine.advance(t)
            except StalledError as error:
                return False, self._failure(f"stalled: {error}")
            if not going:
                return False, f"stopped on request at t = {engine.time:.6g} s"
            energies = self.ledger.measure(engine.state)
            problem = self.ledger.check(energies)
            if problem:
                return False, self._failure(problem)
            self.recorder.record(self.samples, t, engine.state, energies)
            self.energies, self.last = energies, t
            self.samples += 1
            if self.recorder.full:
                self._flush()
            self.progress.update(t)
        return True, f"complete: {model.samples} samples to t = {self.last:.6g} s"

    def _flush(self) -> None:
        episodes = self.engine.take_episodes()
        self.episodes += self.comm.allreduce(len(episodes))
        self.home.write_part(self.parts, self.recorder.take(episodes))
        done = {
            "done": np.array([self.samples, self.episodes]),
            "ledger": np.array([self.ledger.worst, self.ledger.most_work]),
        }
        self.home.write_state(self.parts, self.engine.checkpoint() | done)
        self.parts += 1

    def _failure(self, reason: str) -> str:
        """``reason`` with the time, the place where the lattice moves fastest, and the last good sample."""
        layout = self.layout
        half = layout.dofs * layout.owned
        y = self.engine.state.array_r
        finite = np.isfinite(y[:half]) & np.isfinite(y[half : 2 * half])
        speed = np.where(finite, np.abs(y[half : 2 * half]), np.inf).reshape(layout.dofs, layout.owned)
        cell = int(speed.max(axis=0).argmax()) if layout.owned else 0
        own = (float(speed.max()) if layout.owned else -1.0, layout.start + cell)
        _, fastest = max(self.comm.allgather(own))
        sites = self.model.chain.sites
        near = min(range(len(sites)), key=lambda i: abs(sites[i] - fastest), default=None)
        place = f"cell {fastest + 1}"
        if near is not None:
            place += f", nearest site {near + 1} in cell {sites[near] + 1}"
        good = "none" if self.last is None else f"t = {self.last:.6g} s"
        return f"{reason}, at t = {self.engine.time:.6g} s ({place}); last good sample: {good}"

    def finish(self, complete: bool, sentence: str, begin: tuple[float, float]) -> Result:
        """Write what is still in memory; unless the run was stopped on request, the final files too."""
        comm, home = self.comm, self.home
        self.progress.close()
        resumable = not complete and sentence.startswith("stopped")
        if resumable:
            self._flush()
            sentence += "; --resume goes on from there"
        else:
            self._write_last_part()
        statistics = self._statistics(begin)
        if not resumable:
            cells = self.recorder.cells if self.recorder.parallel else self._all_cells()
            about = provenance(comm) | {"status": sentence, "complete": complete, "statistics": statistics}
            home.assemble(self.case, cells + 1, self.parts, self.recorder.parallel, about)
            if comm.rank == 0:
                home.finish(about | {"case": self.case.model_dump(by_alias=True)})
            comm.Barrier()
        self.engine.destroy()
        return Result(complete, resumable, sentence, statistics, home.path)

    def _all_cells(self) -> np.ndarray:
        first, last = self.case.output.window or (1, self.layout.cells)
        return np.arange(first - 1, last, self.case.output.every)

    def _write_last_part(self) -> None:
        episodes = self.engine.take_episodes() + self.engine.unfinished()
        self.episodes += self.comm.allreduce(len(episodes))
        self.home.write_part(self.parts, self.recorder.take(episodes))
        self.parts += 1

    def _statistics(self, begin: tuple[float, float]) -> dict[str, Any]:
        comm = self.comm
        cpu = comm.allreduce(time.process_time() - begin[1])
        energies = getattr(self, "energies", None)
        statistics = {"samples": self.samples, "end": self.last or 0.0, "episodes": self.episodes}
        statistics |= {"engine": self.engine.name} | self.engine.statistics()
        if self.refused:
            statistics["engine_note"] = self.refused
        statistics["ledger_error"] = self.ledger.error
        if energies is not None:
            statistics["work"] = energies.work
            statistics["dissipated"] = energies.dissipated
        statistics |= {
            "wall_seconds": round(time.perf_counter() - begin[0], 3),
            "cpu_seconds": round(cpu, 3),
        }
        return statistics
