"""A case in, a result out: the loop over a run's samples."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import Case, Model
from vipetsc.dynamics.engine import StalledError, select_engine
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.meter import EnergyMeter
from vipetsc.dynamics.observers import Observer, Recorder, RunawayError, Sample, Setup
from vipetsc.dynamics.observers.guard import fastest_place
from vipetsc.dynamics.observers.recorder import recorded_cells
from vipetsc.dynamics.propagator.engine import Propagator
from vipetsc.dynamics.ts.integrator import Integrator
from vipetsc.io.folder import provenance
from vipetsc.io.store import RunDescription, RunFolder, RunOutput
from vipetsc.parallel import StopRequest

# In the order in which engine = "auto" tries them.
ENGINES = (Propagator, Integrator)
# The guard first: a sample that it refuses is not recorded.
OBSERVERS = ("guard", "ledger", "recorder")


@dataclass(frozen=True)
class Result:
    """How a run ended.

    ``complete``: the whole case was simulated; ``resumable``: it was stopped and can go on from its last
    checkpoint; neither: it failed, and ``run.h5`` holds the samples up to the last good one. ``sentence`` says
    it in words, ``statistics`` in numbers, the same on all ranks.
    """

    complete: bool
    resumable: bool
    sentence: str
    statistics: dict[str, Any]
    folder: Path | None


def simulate(
    case: Case,
    folder: str | Path | RunOutput,
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    force: bool = False,
    resume: bool = False,
    native: bool = True,
    stop: StopRequest | None = None,
    progress: bool = False,
    observers: Sequence[str] = (),
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
    observers
        Names of further observers (subclasses of ``dynamics.observers.Observer``), which see every good sample.

    Raises
    ------
    FolderError
        If the folder cannot be used as asked.
    OSError
        If a file cannot be written, on all ranks.
    """
    clock = Clock()
    output = folder if isinstance(folder, RunOutput) else RunFolder(Path(folder), comm)
    names = [*OBSERVERS, *(["progress"] if progress else []), *observers]
    model = case.model()
    output.begin(describe(case, model), force, resume)
    run = Run(case, model, output, native, stop, [Observer.registry[name]() for name in names])
    state = output.chunks.last_state() if resume else None
    if state is not None:
        run.restore(state)
    ending = run.advance()
    return run.finish(ending, clock)


def describe(case: Case, model: Model) -> RunDescription:
    """What the run's file tells of ``case``."""
    return RunDescription(
        case=case.to_toml(),
        cells=recorded_cells(case) + 1,
        dofs=model.chain.cell.dofs,
        sites=tuple(cell + 1 for cell in model.chain.sites),
        clearances=tuple(model.chain.clearances),
        fields=tuple(case.output.fields),
    )


class Clock:
    """Wall and processor time since it was made."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def read(self, comm: MPI.Comm) -> dict[str, float]:
        """Seconds since then, those of the processors summed over the ranks; all must call it."""
        cpu = comm.allreduce(time.process_time() - self._cpu)
        return {"wall_seconds": round(time.perf_counter() - self._wall, 3), "cpu_seconds": round(cpu, 3)}


@dataclass(frozen=True)
class Ending:
    """How the loop ended: all samples are there, or it was stopped on request, or it failed; why, in a sentence."""

    sentence: str
    complete: bool = False
    stopped: bool = False


class Run:
    """One simulation: an engine that advances, and observers that watch its samples."""

    def __init__(
        self,
        case: Case,
        model: Model,
        output: RunOutput,
        native: bool,
        stop: StopRequest | None,
        observers: Sequence[Observer],
    ) -> None:
        self.comm, self.observers = output.comm, observers
        layout = Layout.of(model, self.comm)
        kind, self._refusal = select_engine(case.time.engine, model, ENGINES)
        engine = kind(model, layout, native, stop)
        self.setup = Setup(case, model, layout, EnergyMeter(model, layout), engine, output)
        self.samples = 0
        self.last: float | None = None
        for observer in observers:
            observer.begin(self.setup)

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on after a checkpoint."""
        self.setup.engine.restore(dict(state))
        self.samples, self.last = int(state["samples"]), self.setup.engine.time
        for observer in self.observers:
            prefix = f"{observer.name}/"
            observer.restore({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})

    def advance(self) -> Ending:
        """Simulate to the end, or to where it stops or fails."""
        engine, model = self.setup.engine, self.setup.model
        while self.samples < model.samples:
            t = self.samples * model.sample_interval
            try:
                if not engine.advance(t):
                    return Ending(f"stopped on request at t = {engine.time:.6g} s", stopped=True)
                self._observe(Sample(self.samples, t, engine.state, self.setup.meter.measure(engine.state)))
            except StalledError as error:
                return self._failure(f"stalled: {error}")
            except RunawayError as error:
                return self._failure(str(error))
            self.samples, self.last = self.samples + 1, t
            if any(observer.due for observer in self.observers):
                self._checkpoint()
        return Ending(f"complete: {model.samples} samples to t = {self.last:.6g} s", complete=True)

    def _observe(self, sample: Sample) -> None:
        for observer in self.observers:
            observer.observe(sample)

    def _failure(self, reason: str) -> Ending:
        good = "none" if self.last is None else f"t = {self.last:.6g} s"
        place = fastest_place(self.setup)
        return Ending(f"{reason}, at t = {self.setup.engine.time:.6g} s ({place}); last good sample: {good}")

    def _checkpoint(self) -> None:
        for observer in self.observers:
            observer.flush()
        state = self.setup.engine.checkpoint() | {"samples": np.array(self.samples)}
        for observer in self.observers:
            state |= {f"{observer.name}/{key}": value for key, value in observer.checkpoint().items()}
        self.setup.output.chunks.save_state(state)

    def finish(self, ending: Ending, clock: Clock) -> Result:
        """Write what is still in memory; unless the run was stopped on request, the final files too."""
        output, sentence = self.setup.output, ending.sentence
        if ending.stopped:
            self._checkpoint()
            sentence += "; --resume goes on from there"
        for observer in self.observers:
            observer.finish(ending.stopped)
        statistics = self._statistics(clock)
        if not ending.stopped:
            attributes = {"status": sentence, "complete": ending.complete, "statistics": statistics}
            attributes = self.comm.bcast(provenance(self.comm) | attributes)
            recorder = next(observer for observer in self.observers if isinstance(observer, Recorder))
            summary = {"case": self.setup.case.model_dump(by_alias=True)}
            output.finish(attributes, recorder.columns, summary)
        self.setup.engine.destroy()
        return Result(ending.complete, ending.stopped, sentence, statistics, output.folder)

    def _statistics(self, clock: Clock) -> dict[str, Any]:
        engine = self.setup.engine
        statistics = {"samples": self.samples, "end": self.last or 0.0, "engine": engine.name} | engine.statistics()
        if self._refusal:
            statistics["engine_note"] = self._refusal
        for observer in self.observers:
            statistics |= observer.statistics()
        return self.comm.bcast(statistics | clock.read(self.comm))
