"""Samples on their way to a file: buffered on each rank, sent in parts to whoever writes them."""

from __future__ import annotations

from dataclasses import asdict

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from vipetsc.case import Case, Model
from vipetsc.contact.episodes import Episode
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.ledger import Energies
from vipetsc.io.store import GATHER_LIMIT

# A part is at most this many samples, and at most this many bytes of fields on a rank.
PART_SAMPLES = 256
PART_BYTES = 64 * 2**20


class Recorder:
    """Keeps a case's share of the fields, the ledger and the impacts until a part is taken.

    ``cells`` are this rank's recorded cells (0-based, of the lattice); ``parallel`` tells whether every rank
    writes its own.
    """

    def __init__(self, case: Case, model: Model, layout: Layout) -> None:
        self.comm = layout.comm
        self.layout = layout
        output = case.output
        first, last = output.window or (1, layout.cells)
        # The first kept cell at or behind this rank's first, without a list of the whole lattice.
        begin = first - 1 + output.every * max(-(-(layout.start - first + 1) // output.every), 0)
        self.total = len(range(first - 1, last, output.every))
        self.cells = np.arange(begin, min(last, layout.stop), output.every)
        begin = int(self.cells[0]) - layout.start if self.cells.size else 0
        self._pick = slice(begin, int(self.cells[-1]) - layout.start + 1 if self.cells.size else 0, output.every)
        self.fields = tuple(output.fields)
        self.stride = output.stride
        sample = len(self.fields) * layout.dofs * 8
        samples = -(-model.samples // self.stride)
        big = sample * self.total * samples > GATHER_LIMIT
        self.parallel = self.comm.size > 1 and (output.writer == "parallel" or (output.writer == "auto" and big))
        largest = self.comm.allreduce(len(self.cells), MPI.MAX) if self.parallel else self.total
        self.length = int(np.clip(PART_BYTES // max(sample * largest, 1), 1, PART_SAMPLES))
        self._buffer = np.empty((self.length, len(self.fields), layout.dofs, len(self.cells)))
        self._local = np.empty((self.length, len(layout.sites)))
        self._ledger: list[tuple[float, Energies]] = []
        self._field_times: list[float] = []

    @property
    def full(self) -> bool:
        """Whether a part should be taken now."""
        return len(self._ledger) == self.length

    def record(self, number: int, t: float, state: PETSc.Vec, energies: Energies) -> None:
        """Keep sample ``number``, taken at time t."""
        layout = self.layout
        y = state.array_r
        self._local[len(self._ledger)] = y[layout.dissipated :]
        self._ledger.append((t, energies))
        if number % self.stride:
            return
        half = layout.dofs * layout.owned
        for i, name in enumerate(self.fields):
            block = y[:half] if name == "displacement" else y[half : 2 * half]
            kept = block.reshape(layout.dofs, layout.owned)[:, self._pick]
            self._buffer[len(self._field_times), i] = kept
        self._field_times.append(t)

    def take(self, episodes: list[Episode]) -> dict[str, np.ndarray] | None:
        """The samples kept so far and ``episodes`` as a part, or None on a rank that writes none; then forget.

        All ranks must call it. A rank's part holds the fields of its own cells, or on rank 0 of all ranks'.
        """
        comm = self.comm
        count, fields = len(self._ledger), len(self._field_times)
        own = np.moveaxis(self._buffer[:fields], 2, 3)  # (samples, field, cell, dof)
        block = own if self.parallel else self._gather_cells(own)
        by_site = self._gather_sites(self._local[:count])
        logs = comm.gather(episodes)
        part = None
        if comm.rank == 0:
            part = {"time": np.array([t for t, _ in self._ledger]), "field_time": np.array(self._field_times)}
            for name in ("kinetic", "spring", "contact", "work", "dissipated"):
                part[name] = np.array([getattr(e, name) for _, e in self._ledger])
            part["dissipated_by_site"] = by_site
            part |= _impact_table([e for log in logs for e in log])
        if comm.rank == 0 or self.parallel:
            shares = {name: block[:, i] for i, name in enumerate(self.fields)}
            part = (part or {}) | shares
        self._ledger.clear()
        self._field_times.clear()
        return part

    def _gather_cells(self, own: np.ndarray) -> np.ndarray | None:
        comm = self.comm
        if comm.size == 1:
            return np.ascontiguousarray(own)
        samples, fields, _, dofs = own.shape
        counts = comm.gather(own.shape[2])
        root = comm.rank == 0
        sizes = [samples * fields * dofs * n for n in counts] if root else None
        received = np.empty(sum(sizes)) if root else None
        comm.Gatherv(np.ascontiguousarray(own), [received, sizes] if root else None)
        if not root:
            return None
        pieces = np.split(received, np.cumsum(sizes)[:-1])
        shaped = [p.reshape(samples, fields, n, dofs) for p, n in zip(pieces, counts, strict=True)]
        return np.concatenate(shaped, axis=2)

    def _gather_sites(self, own: np.ndarray) -> np.ndarray | None:
        gathered = self.comm.gather((self.layout.sites, own.copy()))
        if gathered is None:
            return None
        sites = np.concatenate([np.asarray(s, np.int64) for s, _ in gathered])
        table = np.concatenate([values for _, values in gathered], axis=1)
        ordered = np.empty_like(table)
        ordered[:, sites] = table
        return ordered


def _impact_table(episodes: list[Episode]) -> dict[str, np.ndarray]:
    rows = [asdict(e) for e in sorted(episodes, key=lambda e: (e.onset, e.site))]
    kinds = {"site": np.int64, "side": np.int64}
    names = Episode.__dataclass_fields__
    table = {f"impact_{n}": np.array([row[n] for row in rows], kinds.get(n, float)) for n in names}
    table["impact_site"] += 1
    return table
