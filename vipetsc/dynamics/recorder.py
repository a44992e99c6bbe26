"""Samples on their way to a file: buffered on each rank, sent in chunks to whoever writes them."""

from dataclasses import fields
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.contact.tracker import Episode
from vipetsc.dynamics.energies import Energies
from vipetsc.dynamics.observers import Observer, Sample, Setup
from vipetsc.io.store import GATHER_LIMIT, Recording

# A chunk is at most this many samples, and at most this many bytes of fields on a rank.
CHUNK_SAMPLES = 256
CHUNK_BYTES = 64 * 2**20


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
        first, stop = (int(i) for i in np.searchsorted(recorded, [layout.start, layout.stop]))
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

    def flush(self) -> None:
        """See ``Observer``."""
        self._write(self.setup.engine.take_episodes())

    def finish(self, stopped: bool) -> None:
        """See ``Observer``: the last chunk holds the episodes that are still open, too."""
        if not stopped:
            self._write(self.setup.engine.take_episodes(unfinished=True))

    def statistics(self) -> dict[str, Any]:
        """Contact episodes logged."""
        return {"episodes": self.episodes}

    def _write(self, episodes: list[Episode]) -> None:
        """Hand the samples kept so far and this rank's ``episodes`` on as a chunk, then forget them.

        Rank 0's chunk holds times, energies and all ranks' episodes; the fields are those of a rank's own cells, or on
        rank 0 of all.
        """
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


def as_columns(group: str, record: type, rows: list[Any]) -> dict[str, np.ndarray]:
    """``rows`` of a dataclass ``record`` as arrays ``group/<field>``."""
    return {f"{group}/{c.name}": np.array([getattr(row, c.name) for row in rows], c.type) for c in fields(record)}
