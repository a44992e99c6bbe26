"""Forces on the lattice within linear steps: all clusters that a rank's cells feel, and what they do to the cells."""

from __future__ import annotations

from dataclasses import fields
from math import factorial
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.episodes import Episode, ImpactCounts
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.cluster import Cluster, ContactDof, group_dofs
from vipetsc.dynamics.propagator.free_motion import ClusterIndex, LatticeRows, active_clusters, apply_impulses
from vipetsc.dynamics.propagator.halo import HaloRegions
from vipetsc.dynamics.propagator.series import StepSeries

# What clusters count.
COUNTS = ("substeps", "rejected", "landings", "switches", *(field.name for field in fields(ImpactCounts)))


class Forces:
    """Clusters of contact sites and the drive; adds to ``halo`` the cells whose motion they need."""

    def __init__(self, model: Model, layout: Layout, series: StepSeries, halo: HaloRegions) -> None:
        self._comm, self._interval, self._halo = layout.comm, series.interval, halo
        groups = [g for g in group_dofs(model, series.reach)
                  if any((_owned_cells(dof.cell, series.reach, layout) >= 0).any() for dof in g)]  # fmt: skip
        dofs = [dof for group in groups for dof in group]
        self._lattice = _lattice_rows(groups, layout, series, halo)
        first = np.cumsum([0, *map(len, groups)])
        # An onset within rounding of the clearance is one.
        clearances = [model.chain.clearances[dof.site] if dof.site >= 0 else np.inf for dof in dofs]
        self._taylor = np.zeros((len(dofs), 2 * series.terms))
        self._moments, self._energy = np.zeros_like(self._taylor), np.zeros(len(dofs))
        self.clusters = []
        for group, a, b in zip(groups, first[:-1], first[1:], strict=True):
            logs = layout.start <= group[0].cell < layout.stop
            response = self._response(group, slice(a, b), layout, series)
            arrays = (values[a:b] for values in (self._taylor, self._moments, self._energy))
            self.clusters.append(Cluster(model, group, series, response, logs, *arrays))
        self._index = ClusterIndex(
            first=first,
            clearance=np.array(clearances) * (1 - 1e-9),
            busy=np.array([cluster.is_busy(0.0) for cluster in self.clusters], bool),
            active=np.zeros(len(groups), np.int64),
        )
        numbers = {dof.site: i for i, dof in enumerate(dofs)}
        self._ledger = [numbers[site] for site in ((-1,) if layout.owns_drive else ()) + layout.sites]

    def _response(self, group: list[ContactDof], own: slice, layout: Layout, series: StepSeries) -> np.ndarray:
        """Motion of each DoF after an impulse on each, (dof, dof, term), in powers 2 m + 1 of t/H, times H."""
        lattice, r = self._lattice, series.reach
        factors = lattice.factors[1::2] * series.interval
        response = np.zeros((len(group), len(group), series.terms))
        for i, table in enumerate(lattice.table[own]):
            for j, source in enumerate(group):
                offset = _unwrapped(source.cell, group[i].cell, layout) - group[i].cell
                if abs(offset) <= r:
                    weights = lattice.inverse_masses * source.form
                    response[i, j] = factors * (weights @ lattice.rows[table][:, r + offset])
        return response

    @property
    def ledger(self) -> np.ndarray:
        """The rank's work and dissipated energies in J, in the state's order."""
        return self._energy[self._ledger]

    def act(self, begin: float, out: np.ndarray) -> None:
        """Add to the owned cells ``out`` (2 dof, cell) what forces do in the step that begins at ``begin`` in s.

        The halo holds the state then. Raises StalledError.
        """
        index = self._index
        count = active_clusters(self._lattice, index, self._halo.columns, self._taylor)
        for i in index.active[:count].tolist():
            self.clusters[i].advance(begin)
            apply_impulses(self._lattice, index.first[i], self._moments[index.first[i] : index.first[i + 1]], out)
            index.busy[i] = self.clusters[i].is_busy(begin + self._interval)

    def take_episodes(self) -> list[Episode]:
        """Episodes closed since the last call that this rank logs."""
        return [episode for cluster in self.clusters for episode in cluster.take_episodes()]

    def unfinished(self) -> list[Episode]:
        """Copies of the open episodes that this rank logs."""
        return [episode for cluster in self.clusters for episode in cluster.unfinished()]

    def statistics(self) -> dict[str, Any]:
        """Substeps, landings and limits of the contact law, over all ranks; all must call it."""
        total = np.zeros(len(COUNTS), np.int64)
        for cluster in self.clusters:
            if cluster.logs:
                total += [cluster.counts()[name] for name in COUNTS]
        self._comm.Allreduce(MPI.IN_PLACE, total, MPI.SUM)
        return dict(zip(COUNTS, total.tolist(), strict=True))

    def checkpoint(self) -> dict[str, np.ndarray]:
        """All that a resumed run needs."""
        clusters = {f"cluster-{i}-{k}": v for i, c in enumerate(self.clusters) for k, v in c.checkpoint().items()}
        return clusters | {"busy": self._index.busy.copy()}

    def restore(self, checkpoint: dict[str, np.ndarray]) -> None:
        """Go back to a checkpoint."""
        self._index.busy[:] = checkpoint["busy"]
        for i, cluster in enumerate(self.clusters):
            prefix = f"cluster-{i}-"
            cluster.restore({k.removeprefix(prefix): v for k, v in checkpoint.items() if k.startswith(prefix)})


def _unwrapped(cell: int, near: int, layout: Layout) -> int:
    """``cell``, or in a periodic lattice its copy next to ``near``."""
    return near + (cell - near + layout.cells // 2) % layout.cells - layout.cells // 2 if layout.periodic else cell


def _owned_cells(cell: int, reach: int, layout: Layout) -> np.ndarray:
    """Local numbers (2 reach + 1,) of the cells within ``reach`` of ``cell``, -1 for those of other ranks and none."""
    cells = np.arange(cell - reach, cell + reach + 1)
    cells = cells % layout.cells if layout.periodic else cells
    return np.where((cells >= layout.start) & (cells < layout.stop), cells - layout.start, -1)


def _lattice_rows(groups: list[list[ContactDof]], layout: Layout, series: StepSeries, halo: HaloRegions) -> LatticeRows:
    """The record of the DoFs of ``groups``; adds to ``halo`` the cells that they reach."""
    r, cell = series.reach, series.chain.cell
    columns: list[int] = []
    owned, tables = [], []
    rows: list[np.ndarray] = []
    numbers: dict[tuple, int] = {}  # DoFs away from the ends share their rows
    for group in groups:
        cells = [_unwrapped(dof.cell, group[0].cell, layout) for dof in group]
        first = min(cells)
        column = halo.add(first - r, max(cells) - first + 2 * r + 1)
        columns += [column + c - first for c in cells]
        for dof in group:
            owned.append(_owned_cells(dof.cell, r, layout))
            key = (None if series.is_interior(dof.cell) else dof.cell, dof.form)
            if key not in numbers:
                numbers[key] = len(rows)
                around = series.rows(dof.cell, dof.cell - r, 2 * r + 1).astype(float)
                rows.append(np.einsum("i,imjc->jcm", np.array(dof.form), around))
            tables.append(numbers[key])
    shape = (len(rows), cell.dofs, 2 * r + 1, series.terms)
    return LatticeRows(
        column=np.array(columns, np.int64),
        owned=np.array(owned, np.int64).reshape(-1, 2 * r + 1),
        table=np.array(tables, np.int64),
        rows=np.ascontiguousarray(np.array(rows).reshape(shape)),
        factors=np.array([series.interval ** (k % 2) / factorial(k) for k in range(2 * series.terms)]),
        inverse_masses=1 / np.asarray(cell.masses),
    )
