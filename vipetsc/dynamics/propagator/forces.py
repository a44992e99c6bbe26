"""Forces on the lattice within linear steps: all clusters that a rank's cells feel, and what they do to the cells."""

from __future__ import annotations

from dataclasses import asdict, fields
from math import factorial
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.episodes import Episode, ImpactCounts
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator import linear_kernel
from vipetsc.dynamics.propagator.cluster import Cluster, Member, members_of
from vipetsc.dynamics.propagator.series import StepSeries


class Forces:
    """Clusters of contact sites and the drive.

    ``stretches`` are the cells (first, number) whose motion they need, in patches at the columns that ``place`` is
    told. ``ledger`` holds the rank's work and dissipated energies, in the state's order.
    """

    def __init__(self, model: Model, layout: Layout, series: StepSeries) -> None:
        self._series, self._layout = series, layout
        r = series.reach
        terms = series.terms
        self._factors = np.array([series.interval ** (k % 2) / factorial(k) for k in range(2 * terms)])
        self._inverse_masses = 1 / np.asarray(model.chain.cell.masses)
        self._tables, self._kinds = _Tables(series), []
        groups = [g for g in members_of(model, r) if any((self._columns(m) >= 0).any() for m in g)]
        members = [m for g in groups for m in g]
        self._offsets = []  # of each member's first column from its stretch's
        self.stretches = []
        for group in groups:
            cells = [_unwrapped(m.cell, group[0].cell, layout) for m in group]
            first = min(cells) - r
            self.stretches.append((first, max(cells) + r + 1 - first))
            self._offsets.append([c - r - first for c in cells])
        self._kinds = np.array([self._tables.kind(m) for m in members], np.int64)
        self._columns_of = np.array([self._columns(m) for m in members], np.int64).reshape(-1, 2 * r + 1)
        self._first = np.zeros(len(members), np.int64)
        self._firsts = np.concatenate([[0], np.cumsum([len(g) for g in groups])]).astype(np.int64)
        self._jets = np.zeros((len(members), 2 * terms))
        self._bounds = np.zeros(len(members))
        # An onset within rounding of the clearance is one.
        self._limits = np.array([model.chain.clearances[m.site] if m.site >= 0 else np.inf for m in members])
        self._limits *= 1 - 1e-9
        self.clusters = []
        for group, a, b in zip(groups, self._firsts[:-1], self._firsts[1:], strict=True):
            responses = self._responses(group)
            self.clusters.append(Cluster(model, layout, group, series, responses, self._jets[a:b]))
        self._table = self._tables.array()
        self._busy = np.array([c.busy(0.0) for c in self.clusters], bool)
        self._found = np.zeros(len(groups), np.int64)
        self.ledger = np.zeros(layout.owns_drive + len(layout.sites))
        places = {-1: 0} if layout.owns_drive else {}
        places |= {site: layout.owns_drive + i for i, site in enumerate(layout.sites)}
        self._entries = [[(i, places[m.site]) for i, m in enumerate(g) if m.site in places] for g in groups]

    def _columns(self, member: Member) -> np.ndarray:
        """Owned columns of the cells that a member reaches, -1 for others."""
        layout, r = self._layout, self._series.reach
        cells = np.arange(member.cell - r, member.cell + r + 1)
        cells = cells % layout.cells if layout.periodic else cells
        return np.where((cells >= layout.start) & (cells < layout.stop), cells - layout.start, -1)

    def _responses(self, group: list[Member]) -> np.ndarray:
        """Motion of each member after an impulse on each, (member, member, term), in powers 2 m + 1 of t/H."""
        r, count = self._series.reach, len(group)
        odd = self._factors[1::2] * self._series.interval
        found = np.zeros((count, count, self._series.terms))
        for i, member in enumerate(group):
            rows = self._tables.rows(member)  # (dof, cell, term)
            for j, source in enumerate(group):
                offset = _unwrapped(source.cell, member.cell, self._layout) - member.cell
                if abs(offset) <= r:
                    found[i, j] = odd * ((self._inverse_masses * source.form) @ rows[:, r + offset])
        return found

    def place(self, columns: list[int]) -> None:
        """Say at which columns of the patches the stretches begin."""
        firsts = [a + o for a, offsets in zip(columns, self._offsets, strict=True) for o in offsets]
        self._first = np.array(firsts, np.int64)

    def act(self, begin: float, patches: np.ndarray, out: np.ndarray) -> None:
        """Add to the owned cells ``out`` (2 dof, cell) what forces do in the step that begins at ``begin`` in s.

        ``patches`` hold the state then. Raises StalledError.
        """
        linear_kernel.jets(
            patches, self._first, self._kinds, self._table, self._factors, self._jets, self._bounds
        )  # fmt: skip
        count = linear_kernel.awake(self._bounds, self._limits, self._firsts, self._busy, self._found)
        for index in self._found[:count].tolist():
            cluster = self.clusters[index]
            cluster.march(begin)
            own = slice(self._firsts[index], self._firsts[index + 1])
            linear_kernel.respond(out, self._columns_of[own], self._kinds[own], self._table, self._inverse_masses,
                                  self._factors, cluster.moments)  # fmt: skip
            self._busy[index] = cluster.busy(begin + self._series.interval)
            for i, place in self._entries[index]:
                self.ledger[place] = cluster.energy[i]

    def take_episodes(self) -> list[Episode]:
        """Episodes closed since the last call that this rank logs."""
        return [e for c in self.clusters for e in c.take_episodes()]

    def unfinished(self) -> list[Episode]:
        """Copies of the open episodes that this rank logs."""
        return [e for c in self.clusters for e in c.unfinished()]

    def statistics(self) -> dict[str, Any]:
        """Substeps, landings and limits of the contact law, over all ranks; all must call it."""
        names = ["substeps", "rejected", "landings", "switches", *(f.name for f in fields(ImpactCounts))]
        rows = [[*c.counts.tolist(), c.switches, *asdict(c.tracker.counts).values()] for c in self.clusters if c.logs]
        total = np.sum(np.array(rows, np.int64).reshape(-1, len(names)), axis=0)
        self._layout.comm.Allreduce(MPI.IN_PLACE, total, MPI.SUM)
        return dict(zip(names, total.tolist(), strict=True))

    def checkpoint(self) -> dict[str, np.ndarray]:
        """All that a resumed run needs."""
        return {f"cluster-{i}-{k}": v for i, c in enumerate(self.clusters) for k, v in c.checkpoint().items()}

    def restore(self, checkpoint: dict[str, np.ndarray], now: float) -> None:
        """Go back to a checkpoint taken at time ``now`` in s."""
        for i, cluster in enumerate(self.clusters):
            prefix = f"cluster-{i}-"
            cluster.restore({k.removeprefix(prefix): v for k, v in checkpoint.items() if k.startswith(prefix)})
            self._busy[i] = cluster.busy(now)
            for member, place in self._entries[i]:
                self.ledger[place] = cluster.energy[member]


def _unwrapped(cell: int, near: int, layout: Layout) -> int:
    """``cell``, or in a periodic lattice its copy next to ``near``."""
    return near + (cell - near + layout.cells // 2) % layout.cells - layout.cells // 2 if layout.periodic else cell


class _Tables:
    """Rows of members; those away from the ends share them."""

    def __init__(self, series: StepSeries) -> None:
        self._series = series
        self._found: dict[tuple, int] = {}
        self._rows: list[np.ndarray] = []

    def kind(self, member: Member) -> int:
        """Number of the member's table."""
        key = (None if self._series.is_interior(member.cell) else member.cell, member.form)
        if key not in self._found:
            self._found[key] = len(self._rows)
            rows = np.einsum("i,imjc->jcm", np.array(member.form), self._series.around(member.cell))
            self._rows.append(np.ascontiguousarray(rows))
        return self._found[key]

    def rows(self, member: Member) -> np.ndarray:
        """Rows (dof, cell, term) of a member over the cells that it reaches."""
        return self._rows[self.kind(member)]

    def array(self) -> np.ndarray:
        """All tables (kind, dof, cell, term)."""
        return np.stack(self._rows) if self._rows else np.zeros((0, 1, 1, self._series.terms))
