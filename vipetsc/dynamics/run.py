"""Simulation of a case: the loop over a run's samples, from the case to the result."""

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from mpi4py import MPI

import numpy as np

from vipetsc.case import Case
from vipetsc.dynamics import log
from vipetsc.dynamics.energies import EnergyMeter
from vipetsc.dynamics.engine import Engine, FillResult
from vipetsc.dynamics.failing_place import failing_place
from vipetsc.dynamics.initial import initial_fields, set_in_motion
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.lyapunov import LargestExponent
from vipetsc.dynamics.memory import check_memory
from vipetsc.dynamics.observers import Guard, Ledger, Observer, ProgressReport, RunawayError, Setup
from vipetsc.dynamics.options import petsc_options, with_database
from vipetsc.dynamics.plan import RunPlan, check_ranks
from vipetsc.dynamics.propagator.engine import Propagator
from vipetsc.dynamics.recorder import Recorder
from vipetsc.dynamics.result import Result
from vipetsc.dynamics.samples import Block, Samples
from vipetsc.dynamics.subnormals import subnormals_as_zero
from vipetsc.dynamics.ts.integrator import Integrator
from vipetsc.endings import Ended, Ending
from vipetsc.io.folder import claimed, provenance
from vipetsc.io.kinds import RUN
from vipetsc.io.store import RunFolder, RunMemory, RunOutput
from vipetsc.parallel import StopRequest, install_abort_hook, on_every_rank

ENGINES: dict[str, type[Engine]] = {kind.name: kind for kind in (Propagator, Integrator)}
# Cells times samples between two looks at requests to stop: a fraction of a second.
BLOCK_CELLS = 1_000_000


class Failure(NamedTuple):
    """The reason for which a run fails, and the ``time`` in s at which it does."""

    reason: str
    time: float


class Clocks(NamedTuple):
    """Readings in s of the wall's clock and of this process's CPU time."""

    wall: float
    cpu: float


def simulate(
    case: Case,
    folder: str | Path | RunOutput | None = None,
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    force: bool = False,
    resume: bool = False,
    extend: bool = False,
    stop: StopRequest | None = None,
    progress: bool = False,
    observers: Sequence[type[Observer]] = (),
) -> Result:
    """Simulate ``case`` on all ranks of ``comm``, in memory or into ``folder`` (``run.h5`` and ``summary.json``).

    Parameters
    ----------
    case
        A resolved case.
    folder
        Output folder; without one the run is held in memory, and is lost where it is stopped. An unfinished run of the
        same case in the folder is resumed, to the same bits; one that has ended is not simulated again. ``force``
        begins anew and replaces the run in the folder when the new one has ended; ``resume`` requires an unfinished
        run. ``extend`` goes on from the end of a run whose case ends earlier and is otherwise the same, to the bits of
        one long run. ``result.dataset`` is the run as an xarray dataset.
    comm
        The ranks over which the lattice is distributed; a ``RunMemory`` has its own.
    stop
        A request that ends the run at one of the next samples.
    progress
        Report progress on rank 0: a bar on a terminal or in a notebook, elsewhere lines on stderr.
    observers
        Further observers, which see all good samples.

    Raises
    ------
    CaseError
        If the run needs more memory than there is, or PETSc does not have its options.
    FolderError
        If the folder cannot be used as asked: it holds anything else, or another process works in it.
    OSError
        If a file cannot be written, on all ranks.
    """
    Case.expect(case, "simulate")
    # In a script under mpirun a rank that raises would leave the others waiting; a hook of the script's own stays.
    if MPI.COMM_WORLD.size > 1 and sys.excepthook is sys.__excepthook__:
        install_abort_hook()

    memory = RunMemory(comm)
    target: str | Path | RunOutput = memory
    if folder is not None:
        target = folder
    if isinstance(target, RunMemory) and resume:
        raise ValueError("a run in memory cannot be resumed")
    ranks = comm
    if isinstance(target, RunOutput):
        ranks = target.comm

    # What is wrong with the case is refused before anything is allocated or written.
    on_every_rank(ranks, case.import_plugins)
    plan = RunPlan.of(with_database(case))
    check_ranks(plan, ranks.size)
    check_memory(plan.model, plan.case.output, plan.engine.name, ranks)

    # The guard first: the others see only samples that it accepts.
    watching: list[type[Observer]] = [Guard, *observers, Ledger]
    if progress:
        watching.append(ProgressReport)
    if case.output.lyapunov:
        watching.append(LargestExponent)

    simulation = Simulation(plan, stop=stop, watching=watching)
    if isinstance(target, RunOutput):
        result = simulation.make(target)
        if folder is None:
            return replace(result, held=memory.dataset)
        return result

    output = RunFolder(Path(target), comm, keeps_end=True)
    obstacle = output.extension_obstacle if extend else None
    with claimed(comm, target, RUN, plan.case.to_toml(), force=force, resume=resume, extend=obstacle) as claim:
        # Also without ``extend``: a command that was to extend the run may have been killed.
        output.reopen(plan.model.end)
        # A run that a kill has ended after its file was written is complete.
        ended = output.ending()
        if ended:
            result = Result.from_attributes(ended, resumable=False, folder=output.folder)
        else:
            result = simulation.make(output)
        if not result.resumable:
            claim.publish()
    return replace(result, folder=claim.folder, plan=plan)


@dataclass(frozen=True)
class Simulation:
    """A simulation as its ``plan`` says, with observers.

    A new run begins in the ``state``, displacements and velocities (cell, dof) of the rank's cells, if one is given,
    else as the model says.
    """

    plan: RunPlan
    stop: StopRequest | None
    watching: Sequence[type[Observer]]
    state: tuple[np.ndarray, np.ndarray] | None = None

    def make(self, output: RunOutput) -> Result:
        """Simulate into ``output``, from its last checkpoint on if it has one; all ranks must call it."""
        case, model, engine_choice, _ = self.plan
        output.begin(case.to_toml())
        checkpoints = output.last_state()

        began = Clocks(wall=time.perf_counter(), cpu=time.process_time())
        sys.audit("vipetsc.set-up", case.name)
        with log.SET_UP, petsc_options(case.petsc_options):
            kind = ENGINES[engine_choice.name]
            layout = Layout(model, output.comm, kind.integrates_damping)
            engine = kind(model, layout, self.stop)
        with released(engine, output.comm):
            setup = Setup(
                case=case,
                model=model,
                layout=layout,
                meter=EnergyMeter(model, layout, engine.lattice),
                engine=engine,
                output=output,
            )
            run = Run(setup, self.watching)
            if checkpoints is not None:
                run.restore(checkpoints)
            elif self.state is not None:
                set_in_motion(run.setup, self.state)
            elif model.initial is not None:
                set_in_motion(run.setup, initial_fields(model, range(layout.start, layout.stop), layout.comm))
            with log.SAMPLES:
                ended = run.advance()
            note = {}
            if engine_choice.refused:
                note["engine_note"] = engine_choice.refused
            with log.ENDING:
                return run.finish(ended, began, note, self.plan.warnings)


@contextmanager
def released(engine: Engine, comm: MPI.Comm) -> Iterator[None]:
    """Free ``engine`` at the end of the block, on all ranks together.

    A rank that leaves the block alone, by an error of its own, does not free it: it would wait for the others.
    """
    try:
        yield
    except BaseException as error:
        if comm.size == 1 or getattr(error, "from_root", False):
            engine.destroy()
        raise
    engine.destroy()


class Run:
    """One run: its engine goes through blocks of samples, and its observers look at each block, the recorder last.

    A sample that one observer refuses is not seen by the observers after it, nor recorded.
    """

    def __init__(self, setup: Setup, observers: Sequence[type[Observer]]) -> None:
        self.setup = setup
        self.recorder = Recorder()
        # The recorder is the last one: it keeps what all others accept.
        self.observers = [*(kind() for kind in observers), self.recorder]
        self.samples = 0
        self.last: float | None = None  # time of the last good sample
        for observer in self.observers:
            observer.begin(setup)
        longest = max(BLOCK_CELLS // setup.layout.cells, 1)
        self.longest = min(longest, *(observer.longest for observer in self.observers))

    def restore(self, checkpoints: Sequence[Mapping[str, np.ndarray]]) -> None:
        """Go on after a checkpoint, given the parts of all ranks that wrote it; their number may differ."""
        # The engine first: observers may ask it for its time. What a checkpoint has of them is the same on all ranks.
        self.setup.engine.restore(checkpoints)
        state = checkpoints[0]
        self.samples = int(state["samples"])
        self.last = self.setup.engine.time
        for observer in self.observers:
            prefix = f"{observer.name}/"
            observer.restore({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})

    def advance(self) -> Ended:
        """Advance to the end, or until the run stops or fails; returns how it ended."""
        setup = self.setup
        engine = self.setup.engine
        total = setup.model.samples
        while self.samples < total:
            # Blocks end with multiples of their length, wherever a run is resumed.
            longest = self.longest - self.samples % self.longest
            samples = self.recorder.next_samples(self.samples, min(longest, total - self.samples))
            with subnormals_as_zero():
                filled = engine.fill(samples)
            block, failure = self._observe(samples, filled)
            if len(block):
                self.samples = block.first + len(block)
                self.last = float(block.times[-1])

            if failure:
                # Engines go through a block in one piece: episodes may have begun after the failure. The propagator
                # stalls within a step, at whose beginning it stands then: contacts of that step count, too.
                self.recorder.last_onset = failure.time + setup.model.sample_interval
                good = "none"
                if self.last is not None:
                    good = f"t = {self.last:.6g} s"
                return Ending.BROKEN_OFF.with_numbers(
                    reason=failure.reason, time=failure.time, place=failing_place(setup), good=good
                )
            if filled.stopped and self.samples < total:
                return Ending.STOPPED.with_numbers(where=f"at t = {engine.time:.6g} s")
            if any(observer.due for observer in self.observers):
                self.checkpoint()
        return Ending.COMPLETE.with_numbers(samples=total, end=self.last)

    def _observe(self, samples: Samples, filled: FillResult) -> tuple[Block, Failure | None]:
        """Show the filled samples to the observers; returns the block of good ones, and a failure that ends the run."""
        failure = None
        if filled.stalled:
            failure = Failure(f"stalled: {filled.stalled}", self.setup.engine.time)
        block = self.block(samples, filled.samples)
        for observer in self.observers:
            if not len(block):
                break
            try:
                observer.observe(block)
            except RunawayError as error:
                # The samples before this one are good, and the only ones that the observers after this one see. This
                # failure replaces that of an engine which has stalled after them.
                failure = Failure(str(error), block.times[error.sample])
                block = self.block(samples, error.sample)
        return block, failure

    def block(self, samples: Samples, count: int) -> Block:
        """Return block of the first ``count`` of ``samples``, with energies of all ranks; all ranks must call it."""
        energies = self.setup.meter.total(samples.sums[:count], samples.work[:count])
        times = np.arange(samples.number, samples.number + count) * self.setup.model.sample_interval
        return Block(
            first=samples.number, times=times, energies=energies, samples=samples, state=self.setup.engine.state
        )

    def checkpoint(self, stopped: bool = False) -> None:
        """Write the samples so far and, if it is due or the run has ``stopped``, the state that a run resumes from."""
        # Chunks before the state: a kill between them leaves a chunk that the last complete state does not count.
        with log.RECORDER:
            for observer in self.observers:
                observer.flush()
        sys.audit("vipetsc.checkpoint")
        if not self.setup.output.saves_states or not (stopped or self.recorder.is_state_due):
            return
        self.recorder.unsaved_samples = 0
        state = self.setup.engine.checkpoint() | {"samples": np.array(self.samples)}
        for observer in self.observers:
            state |= {f"{observer.name}/{key}": value for key, value in observer.checkpoint().items()}
        self.setup.output.save_state(state)

    def finish(self, ended: Ended, began: Clocks, note: dict[str, str], noticed: Sequence[str] = ()) -> Result:
        """Write the last checkpoint of a run that was stopped or can be extended, and the files of one that ended.

        The result warns of what was ``noticed`` before the run, too.
        """
        engine = self.setup.engine
        output = self.setup.output
        comm = self.setup.output.comm
        sentence = ended.sentence
        is_stopped = ended.ending is Ending.STOPPED
        is_complete = ended.ending is Ending.COMPLETE
        if is_stopped or (is_complete and output.keeps_end):
            self.checkpoint(stopped=True)
        if is_stopped:
            sentence += "; the same command continues from there"
        statistics = {"samples": self.samples, "end": self.last or 0.0, "engine": engine.name} | engine.statistics()
        if self.setup.model.chain.sites:
            statistics["effective_restitution"] = self.setup.model.effective_restitution

        warnings = [*noticed]
        for observer in self.observers:
            observer.finish(is_stopped)
            statistics |= observer.statistics()
            if not is_stopped:
                warnings += observer.warnings()
        if ended.ending is Ending.BROKEN_OFF:
            warnings.append(f"the record ends at sample {self.samples} of {self.setup.model.samples}: {sentence}")

        wall = time.perf_counter() - began.wall
        cpu = comm.allreduce(time.process_time() - began.cpu)
        statistics |= {**note, "wall_seconds": round(wall, 3), "cpu_seconds": round(cpu, 3)}

        about = {"status": sentence, "complete": is_complete, "statistics": statistics, "warnings": warnings}
        attributes = comm.bcast(provenance(comm) | about)  # what rank 0 states counts

        # The dataset of a run in memory also has the motion of its cells at the end.
        if is_complete and isinstance(output, RunMemory):
            motions = comm.gather(self.setup.layout.motion(engine.state.array_r))
            output.end_motion = np.concatenate(motions) if motions else None
        if not is_stopped:
            output.finish(attributes, {"case": self.setup.case.model_dump(by_alias=True)})
        return Result.from_attributes(attributes, resumable=is_stopped, folder=output.folder)
