"""What is kept of a run: the observer ``recorder``, which hands it to the run's output in chunks."""

import sys
from dataclasses import fields
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.case.schema import OutputTable
from vipetsc.contact.tracker import Episode
from vipetsc.dynamics.energies import Energies
from vipetsc.dynamics.observers import Observer, Sample, Setup
from vipetsc.io.store import GATHER_LIMIT, Recording

# A chunk is at most this many samples, and at most this many bytes of fields on a rank.
CHUNK_SAMPLES = 256
CHUNK_BYTES = 64 * 2**20


def recorded_cells(output: OutputTable, cells: int) -> range:
    """Cells (0-based) whose fields are kept, of so many."""
    first, last = output.window or (1, cells)
    return range(first - 1, last, output.every)


def written_together(model: Model, output: OutputTable, ranks: int) -> bool:
    """Whether each of the ``ranks`` writes the fields of its own cells into the file that all share."""
    sample_bytes = len(output.fields) * model.chain.cell.dofs * 8 * len(recorded_cells(output, model.chain.cells))
    large = sample_bytes * -(-model.samples // output.stride) > GATHER_LIMIT
    return ranks > 1 and (output.writer == "parallel" or (output.writer == "auto" and large))


def chunk_samples(sample_bytes: int) -> int:
    """Samples in a chunk, of each of which a rank keeps so many bytes of fields."""
    return min(max(CHUNK_BYTES // max(sample_bytes, 1), 1), CHUNK_SAMPLES)


class Recorder(Observer):
    """Keeps the case's share of the fields, the energies and the contact episodes, and writes them in chunks."""

    name = "recorder"
    saved = ("episodes", "deepest")
    episodes = 0
    deepest = 0.0  # indentation in m

    def begin(self, setup: Setup) -> None:
        """See ``Observer``."""
        super().begin(setup)
        layout, output, chain = setup.layout, setup.case.output, setup.model.chain
        recorded = np.array(recorded_cells(output, chain.cells))
        first, stop = np.searchsorted(recorded, [layout.start, layout.stop]).tolist()
        local = recorded[first:stop] - layout.start
        self._cells = slice(int(local[0]), int(local[-1]) + 1, output.every) if local.size else slice(0)
        # A run in memory is gathered whatever the writer is.
        together = bool(setup.output.folder) and written_together(setup.model, output, layout.comm.size)
        given = {
            "cell": recorded + 1,
            "dof": np.arange(1, layout.dofs + 1),
            "site": np.arange(1, len(chain.sites) + 1),
            "sites/cell": np.array(chain.sites, np.int64) + 1,
            "sites/clearance": np.array(chain.clearances, float),
        }
        setup.output.recording = Recording(given, tuple(output.fields), together)
        self._columns = np.array([first, stop] if together else [0, len(recorded)])
        most = layout.comm.allreduce(local.size, MPI.MAX) if together else len(recorded)
        self._length = chunk_samples(len(output.fields) * layout.dofs * 8 * most)
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
        the fields are those of a rank's own cells, or on rank 0 of all: ``columns`` says which of the recorded ones.
        """
        sys.audit("vipetsc.flush")
        episodes = self.setup.engine.take_episodes(unfinished=last)
        layout, comm, output = self.setup.layout, self.setup.layout.comm, self.setup.output
        together = output.recording.together
        block = np.moveaxis(self._buffer[: len(self._field_times)], 2, 3)  # (samples, field, cell, dof)
        share = layout.sites, self._dissipated[: len(self._samples)], episodes, None if together else block
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
            block = block if together else np.concatenate(blocks, axis=2)
        if shares is not None or together:
            chunk |= {name: block[:, i] for i, name in enumerate(output.recording.fields)}
            chunk["columns"] = self._columns
        output.append(chunk or None)
        self.episodes += comm.allreduce(len(episodes))
        self.deepest = comm.allreduce(max([self.deepest, *(episode.indentation for episode in episodes)]), MPI.MAX)
        self._samples.clear()
        self._field_times.clear()

    def finish(self, stopped: bool) -> None:
        """See ``Observer``."""
        if not stopped:
            self.flush(last=True)

    def statistics(self) -> dict[str, Any]:
        """Contact episodes logged."""
        return {"episodes": self.episodes, "deepest_indentation": self.deepest}

    def warnings(self) -> list[str]:
        """Sites that nothing reached; indentations for which there is no theory of contact."""
        sites, radius = len(self.setup.model.chain.sites), self.setup.case.contact_radius
        if sites and not self.episodes:
            return [f"no contact: nothing reached {'the site' if sites == 1 else f'one of the {sites} sites'}"]
        if radius is None or self.setup.model.contact.law != "hertz" or self.deepest <= radius:
            return []
        beyond = f"the deepest indentation, {self.deepest:.3g} m, is beyond the contacts' radius of {radius:g} m"
        return [f"{beyond}: Hertz's law holds for indentations far below it"]


def as_columns(group: str, record: type, rows: list[Any]) -> dict[str, np.ndarray]:
    """``rows`` of a dataclass ``record`` as arrays ``group/<field>``."""
    return {f"{group}/{c.name}": np.array([getattr(row, c.name) for row in rows], c.type) for c in fields(record)}
