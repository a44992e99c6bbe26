"""Samples on their way to a file: buffered on each rank, sent in chunks to whoever writes them."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import Case
from vipetsc.contact.episodes import Episode
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.meter import Energies
from vipetsc.dynamics.observers.base import Observer, Sample, Setup
from vipetsc.io.store import GATHER_LIMIT, IMPACTS, LEDGER

# A chunk is at most this many samples, and at most this many bytes of fields on a rank.
CHUNK_SAMPLES = 256
CHUNK_BYTES = 64 * 2**20


class Recorder(Observer):
    """Keeps the case's share of the fields, the energies and the contact episodes, and writes them in chunks.

    ``columns`` are this rank's places among the recorded cells if every rank writes its own, else None.
    """

    name = "recorder"

    def begin(self, setup: Setup) -> None:
        """See ``Observer``."""
        super().begin(setup)
        layout, output = setup.layout, setup.case.output
        self.comm = layout.comm
        recorded = recorded_cells(setup.case)
        begin, stop = (int(i) for i in np.searchsorted(recorded, [layout.start, layout.stop]))
        local = recorded[begin:stop] - layout.start
        self._cells = slice(int(local[0]), int(local[-1]) + 1, output.every) if local.size else slice(0)
        self._fields = tuple(output.fields)
        sample_bytes = len(self._fields) * layout.dofs * 8
        samples = -(-setup.model.samples // output.stride)
        large = sample_bytes * len(recorded) * samples > GATHER_LIMIT
        parallel = output.writer == "parallel" or (output.writer == "auto" and large)
        shared = self.comm.size > 1 and setup.output.shared and parallel
        self.columns = slice(begin, stop) if shared else None
        most = self.comm.allreduce(local.size, MPI.MAX) if shared else len(recorded)
        self._length = int(np.clip(CHUNK_BYTES // max(sample_bytes * most, 1), 1, CHUNK_SAMPLES))
        self._buffer = np.empty((self._length, len(self._fields), layout.dofs, local.size))
        self._dissipated = np.empty((self._length, len(layout.sites)))
        self._samples: list[tuple[float, Energies]] = []
        self._field_times: list[float] = []
        self._episodes = 0

    def observe(self, sample: Sample) -> None:
        """See ``Observer``."""
        layout = self.setup.layout
        y = sample.state.array_r
        self._dissipated[len(self._samples)] = y[layout.dissipated :]
        self._samples.append((sample.time, sample.energies))
        if sample.number % self.setup.case.output.stride:
            return
        half = layout.dofs * layout.owned
        for i, name in enumerate(self._fields):
            block = y[:half] if name == "displacement" else y[half : 2 * half]
            self._buffer[len(self._field_times), i] = block.reshape(layout.dofs, layout.owned)[:, self._cells]
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
            self._write(self.setup.engine.take_episodes() + self.setup.engine.unfinished())

    def checkpoint(self) -> dict[str, np.ndarray]:
        """See ``Observer``."""
        return {"episodes": np.array(self._episodes)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """See ``Observer``."""
        self._episodes = int(state["episodes"])

    def statistics(self) -> dict[str, Any]:
        """Contact episodes logged."""
        return {"episodes": self._episodes}

    def _write(self, episodes: list[Episode]) -> None:
        """Hand the samples kept so far and this rank's ``episodes`` on as a chunk, then forget them.

        Rank 0's chunk holds times, energies and all ranks' episodes; the fields are those of a rank's own cells, or on
        rank 0 of all.
        """
        comm = self.comm
        count, fields = len(self._samples), len(self._field_times)
        local = np.moveaxis(self._buffer[:fields], 2, 3)  # (samples, field, cell, dof)
        block = gather_cells(comm, local) if self.columns is None else local
        by_site = gather_sites(self.setup.layout, self._dissipated[:count])
        logs = comm.gather(episodes)
        chunk: dict[str, np.ndarray] = {}
        if logs is not None and by_site is not None:
            chunk["time"] = np.array([time for time, _ in self._samples])
            chunk["field_time"] = np.array(self._field_times)
            chunk |= {name: np.array([getattr(energies, name) for _, energies in self._samples]) for name in LEDGER}
            chunk["dissipated_by_site"] = by_site
            chunk |= impact_table([episode for log in logs for episode in log])
        if block is not None:
            chunk |= {name: block[:, i] for i, name in enumerate(self._fields)}
        self.setup.output.chunks.append(chunk or None)
        self._episodes += comm.allreduce(len(episodes))
        self._samples.clear()
        self._field_times.clear()


def recorded_cells(case: Case) -> np.ndarray:
    """Cells (0-based) of the whole lattice whose fields are recorded."""
    first, last = case.output.window or (1, case.lattice.cells)
    return np.arange(first - 1, last, case.output.every)


def gather_cells(comm: MPI.Comm, block: np.ndarray) -> np.ndarray | None:
    """All ranks' blocks (samples, field, cell, dof) along the cells, on rank 0; all ranks must call it."""
    block = np.ascontiguousarray(block)
    if comm.size == 1:
        return block
    samples, fields, cells, dofs = block.shape
    counts = comm.gather(cells)
    if counts is None:
        comm.Gatherv(block, None)
        return None
    sizes = [samples * fields * dofs * n for n in counts]
    received = np.empty(sum(sizes))
    comm.Gatherv(block, [received, sizes])
    pieces = np.split(received, np.cumsum(sizes)[:-1])
    shaped = [piece.reshape(samples, fields, n, dofs) for piece, n in zip(pieces, counts, strict=True)]
    return np.concatenate(shaped, axis=2)


def gather_sites(layout: Layout, values: np.ndarray) -> np.ndarray | None:
    """All ranks' ``values`` (samples, site) in the order of the sites, on rank 0; all ranks must call it."""
    gathered = layout.comm.gather((layout.sites, values.copy()))
    if gathered is None:
        return None
    sites = np.concatenate([np.asarray(sites, np.int64) for sites, _ in gathered])
    table = np.concatenate([columns for _, columns in gathered], axis=1)
    return table[:, np.argsort(sites)]


def impact_table(episodes: list[Episode]) -> dict[str, np.ndarray]:
    """The log as columns ``impact_<name>``; sites counted from 1."""
    rows = [asdict(episode) for episode in episodes]
    integers = ("site", "side")
    table = {f"impact_{n}": np.array([row[n] for row in rows], np.int64 if n in integers else float) for n in IMPACTS}
    table["impact_site"] += 1
    return table
