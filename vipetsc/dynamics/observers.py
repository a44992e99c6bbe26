"""What watches a run, sample by sample, without changing it: the contract, and the observers of every run.

``guard`` ends a run whose state is no solution any more, ``ledger`` keeps the error of the energy balance, ``progress``
tells how far it is, ``recorder`` keeps what is written. A further observer is a subclass of ``Observer`` with a name,
which ``simulate`` is given.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from vipetsc.case import Case, Model
from vipetsc.contact.tracker import Episode
from vipetsc.dynamics.energies import Energies, EnergyMeter
from vipetsc.dynamics.engine import Engine
from vipetsc.dynamics.layout import Layout
from vipetsc.io.store import GATHER_LIMIT, Recording, RunOutput
from vipetsc.parallel import Progress

# A ledger that misses by this share of the largest work is no longer a solution but an instability.
RUNAWAY = 0.1
# A chunk is at most this many samples, and at most this many bytes of fields on a rank.
CHUNK_SAMPLES = 256
CHUNK_BYTES = 64 * 2**20


class RunawayError(RuntimeError):
    """The state is no solution any more; says why."""


@dataclass(frozen=True)
class Setup:
    """What a run is made of: the case, its model in the lattice's own terms, and who does what on which cells."""

    case: Case
    model: Model
    layout: Layout
    meter: EnergyMeter
    engine: Engine
    output: RunOutput


@dataclass(frozen=True)
class Sample:
    """The lattice at one of the uniform times: ``number`` from 0, ``time`` in s.

    ``state`` is ordered as ``Layout`` says, ghosts up to date; it changes with the next sample.
    """

    number: int
    time: float
    state: PETSc.Vec
    energies: Energies


class Observer:
    """Watches a run.

    Calls come on all ranks in the same order: ``begin``, perhaps ``restore``, then ``observe`` for every sample;
    whenever some observer is ``due``, and when the run is stopped on request, ``flush`` of all and then ``checkpoint``
    of all; at the end ``finish`` and ``statistics``.

    A subclass has a ``name``, by which ``simulate`` finds it. It must not change the state, and what it raises it must
    raise on all ranks.
    """

    name: ClassVar[str]
    saved: ClassVar[tuple[str, ...]] = ()  # numbers among its attributes that a checkpoint keeps
    registry: ClassVar[dict[str, "type[Observer]"]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        Observer.registry[cls.name] = cls

    def begin(self, setup: Setup) -> None:
        """Make ready for a run from t = 0 on."""
        self.setup = setup

    def observe(self, sample: Sample) -> None:
        """Look at the next sample; raises RunawayError to end the run before it."""

    @property
    def due(self) -> bool:
        """Whether a checkpoint should be made now."""
        return False

    def flush(self) -> None:
        """Hand what was kept since the last checkpoint to the run's output."""

    def checkpoint(self) -> dict[str, np.ndarray]:
        """What a resumed run needs to go on with the same bits, this rank's share."""
        return {key: np.array(getattr(self, key)) for key in self.saved}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from what ``checkpoint`` gave; the engine is there already."""
        for key in self.saved:
            setattr(self, key, state[key].item())

    def finish(self, stopped: bool) -> None:
        """Come to an end; ``stopped`` on request, to be gone on with from the checkpoint just made."""

    def statistics(self) -> dict[str, Any]:
        """Numbers for ``summary.json`` and the attributes of ``run.h5``; those of rank 0 count."""
        return {}


class Guard(Observer):
    """Raises RunawayError for a state that is not finite, or holds energy that nothing has put in."""

    name = "guard"
    saved = ("most_work",)
    most_work = 0.0

    def observe(self, sample: Sample) -> None:
        """See ``Observer``."""
        energies, largest = sample.energies, self.setup.meter.largest
        if not (np.isfinite(energies.work) and energies.total < largest):
            raise RunawayError("the state is not finite")
        self.most_work = max(self.most_work, abs(energies.work))
        if abs(energies.residual) > RUNAWAY * self.most_work and energies.total > 1e-12 * largest:
            raise RunawayError(
                f"the energy runs away: {energies.total:.4g} J in the lattice, {energies.work:.4g} J of work done"
            )


class Ledger(Observer):
    """Keeps the largest residual of the energy balance, work - dissipated - (kinetic + spring + contact), in J."""

    name = "ledger"
    saved = ("worst", "most_work", "work", "dissipated")
    worst = most_work = 0.0
    work = dissipated = float("nan")

    def observe(self, sample: Sample) -> None:
        """See ``Observer``."""
        self.work, self.dissipated = sample.energies.work, sample.energies.dissipated
        self.worst = max(self.worst, abs(sample.energies.residual))
        self.most_work = max(self.most_work, abs(self.work))

    def statistics(self) -> dict[str, Any]:
        """``ledger_error``: largest residual over the largest work; ``work`` and ``dissipated`` in J at the end."""
        error = {"ledger_error": self.worst / self.most_work if self.most_work else 0.0}
        return error if np.isnan(self.work) else error | {"work": self.work, "dissipated": self.dissipated}


class ProgressReport(Observer):
    """Tells on stderr of rank 0 how far the lattice's time is."""

    name = "progress"

    def begin(self, setup: Setup) -> None:
        """See ``Observer``."""
        super().begin(setup)
        self._progress = Progress(setup.layout.comm, setup.model.end, "s")

    def observe(self, sample: Sample) -> None:
        """See ``Observer``."""
        self._progress.update(sample.time)

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """See ``Observer``."""
        self._progress.start_at(self.setup.engine.time)

    def finish(self, stopped: bool) -> None:
        """See ``Observer``."""
        self._progress.close()


class Recorder(Observer):
    """Keeps the case's share of the fields, the energies and the contact episodes, and writes them in chunks."""

    name = "recorder"
    saved = ("episodes",)
    episodes = 0

    def begin(self, setup: Setup) -> None:
        """See ``Observer``."""
        super().begin(setup)
        layout, output, chain = setup.layout, setup.case.output, setup.model.chain
        begin, end = output.window or (1, chain.cells)
        recorded = np.arange(begin - 1, end, output.every)
        first, stop = np.searchsorted(recorded, [layout.start, layout.stop]).tolist()
        local = recorded[first:stop] - layout.start
        self._cells = slice(int(local[0]), int(local[-1]) + 1, output.every) if local.size else slice(0)
        sample_bytes = len(output.fields) * layout.dofs * 8
        large = sample_bytes * len(recorded) * -(-setup.model.samples // output.stride) > GATHER_LIMIT
        parallel = output.writer == "parallel" or (output.writer == "auto" and large)
        # A run in memory is gathered whatever the writer is.
        columns = slice(first, stop) if layout.comm.size > 1 and setup.output.folder and parallel else None
        given = {
            "cell": recorded + 1,
            "dof": np.arange(1, layout.dofs + 1),
            "site": np.arange(1, len(chain.sites) + 1),
            "sites/cell": np.array(chain.sites, np.int64) + 1,
            "sites/clearance": np.array(chain.clearances, float),
        }
        setup.output.recording = Recording(given, tuple(output.fields), columns)
        most = layout.comm.allreduce(local.size, MPI.MAX) if columns else len(recorded)
        self._length = int(np.clip(CHUNK_BYTES // max(sample_bytes * most, 1), 1, CHUNK_SAMPLES))
        self._buffer = np.empty((self._length, len(output.fields), layout.dofs, local.size))
        self._dissipated = np.empty((self._length, len(layout.sites)))
        self._samples: list[tuple[float, Energies]] = []
        self._field_times: list[float] = []

    def observe(self, sample: Sample) -> None:
        """See ``Observer``."""
        layout, output = self.setup.layout, self.setup.case.output
        y = sample.state.array_r
        self._dissipated[len(self._samples)] = y[layout.dissipated :]
        self._samples.append((sample.time, sample.energies))
        if sample.number % output.stride == 0:
            both = y[: 2 * layout.dofs * layout.owned].reshape(2, layout.dofs, layout.owned)
            for i, name in enumerate(output.fields):
                self._buffer[len(self._field_times), i] = both[int(name == "velocity")][:, self._cells]
            self._field_times.append(sample.time)

    @property
    def due(self) -> bool:
        """See ``Observer``: a chunk is full."""
        return len(self._samples) == self._length

    def flush(self, last: bool = False) -> None:
        """See ``Observer``: the samples kept so far and this rank's closed episodes become a chunk.

        Rank 0's chunk holds times, energies and all ranks' episodes, the ``last`` one those that are still open, too;
        the fields are those of a rank's own cells, or on rank 0 of all.
        """
        sys.audit("vipetsc.flush")
        episodes = self.setup.engine.take_episodes(unfinished=last)
        layout, comm, output = self.setup.layout, self.setup.layout.comm, self.setup.output
        columns = output.recording.columns
        block = np.moveaxis(self._buffer[: len(self._field_times)], 2, 3)  # (samples, field, cell, dof)
        share = layout.sites, self._dissipated[: len(self._samples)], episodes, None if columns else block
        shares = comm.gather(share) if comm.size > 1 else [share]
        chunk: dict[str, np.ndarray] = {}
        if shares is not None:
            sites, dissipated, logs, blocks = zip(*shares, strict=True)
            chunk |= {"time": np.array([t for t, _ in self._samples]), "field_time": np.array(self._field_times)}
            chunk |= as_columns("energy", Energies, [energies for _, energies in self._samples])
            order = np.argsort([site for some in sites for site in some])
            chunk["energy/dissipated_by_site"] = np.concatenate(dissipated, axis=1)[:, order]
            chunk |= as_columns("impacts", Episode, [episode for log in logs for episode in log])
            chunk["impacts/site"] += 1  # counted from 1
            block = block if columns else np.concatenate(blocks, axis=2)
        if shares is not None or columns:
            chunk |= {name: block[:, i] for i, name in enumerate(output.recording.fields)}
        output.append(chunk or None)
        self.episodes += comm.allreduce(len(episodes))
        self._samples.clear()
        self._field_times.clear()

    def finish(self, stopped: bool) -> None:
        """See ``Observer``."""
        if not stopped:
            self.flush(last=True)

    def statistics(self) -> dict[str, Any]:
        """Contact episodes logged."""
        return {"episodes": self.episodes}


def as_columns(group: str, record: type, rows: list[Any]) -> dict[str, np.ndarray]:
    """``rows`` of a dataclass ``record`` as arrays ``group/<field>``."""
    return {f"{group}/{c.name}": np.array([getattr(row, c.name) for row in rows], c.type) for c in fields(record)}
