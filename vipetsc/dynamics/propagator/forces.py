"""Forces on the lattice within linear steps: all clusters that a rank's cells feel, and what they do to the cells."""

from __future__ import annotations

from itertools import pairwise
from math import factorial
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.tracker import LIMITS
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.cluster import Cluster, ContactDof, group_dofs
from vipetsc.dynamics.propagator.free_motion import DofTables, active_clusters, apply_impulses
from vipetsc.dynamics.propagator.halo import HaloRegions
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.propagator.substep import HISTORY, SUBSTEP_STATE, ClusterMotion

# What clusters count.
COUNTS = ("substeps", "rejected", "landings", "switches")


class Forces:
    """Clusters of contact sites and the drive; adds to ``halo`` the cells whose motion they need."""

    def __init__(self, model: Model, layout: Layout, series: StepSeries, halo: HaloRegions) -> None:
        self._comm, self._halo = layout.comm, halo
        groups = [group for group in group_dofs(model, series.reach)
                  if any((_owned_cells(dof.cell, series.reach, layout) >= 0).any() for dof in group)]  # fmt: skip
        self._dofs = _dof_tables(model, groups, layout, series, halo)
        count = len(self._dofs.column)
        state = np.zeros(len(groups), SUBSTEP_STATE)
        state["begin"], state["length"] = np.nan, 1.0
        shape = (count, 2 * series.terms)
        self._motion = ClusterMotion(
            np.zeros(shape), np.zeros((count, 3)), np.zeros(shape), np.zeros(count), np.zeros(count, HISTORY), state
        )
        self._active = np.zeros(len(groups), np.int64)
        self._of_cluster = [slice(a, b) for a, b in pairwise(self._dofs.first.tolist())]
        self.clusters = []
        for i, (group, span) in enumerate(zip(groups, self._of_cluster, strict=True)):
            motion = ClusterMotion._make([*(array[span] for array in self._motion[:-1]), state[i : i + 1]])
            response = _responses(group, self._dofs, span, layout, series)
            logs = layout.start <= group[0].cell < layout.stop
            self.clusters.append(Cluster(model, group, series, response, motion, logs))
        numbers = {dof.site: i for i, dof in enumerate(dof for group in groups for dof in group)}
        self._ledger = [numbers[site] for site in ((-1,) if layout.owns_drive else ()) + layout.sites]
        self._drive_end = model.drive.duration
        self._driven = slice(numbers.get(-1, count), numbers.get(-1, count) + 1)
        self._saved = {"energy": self._motion.energy, "history": self._motion.history, "clusters": state}

    @property
    def ledger(self) -> np.ndarray:
        """The rank's work and dissipated energies in J, in the state's order."""
        return self._motion.energy[self._ledger]

    def act(self, begin: float, out: np.ndarray) -> None:
        """Add to the owned cells ``out`` (2 dof, cell) what forces do in the step that begins at ``begin`` in s.

        The halo holds the state then. Raises StalledError.
        """
        dofs = self._dofs
        # A site in contact reaches its clearance anyway; the drive must be asked for.
        dofs.clearance[self._driven] = -np.inf if begin < self._drive_end else np.inf
        count = active_clusters(dofs, self._halo.columns, self._motion.taylor, self._active)
        for i in self._active[:count].tolist():
            self.clusters[i].advance(begin)
            apply_impulses(dofs, dofs.first[i], self._motion.moments[self._of_cluster[i]], out)

    def statistics(self) -> dict[str, Any]:
        """Substeps, landings and limits of the contact law, over all ranks; all must call it."""
        logs = [cluster.logs for cluster in self.clusters]
        limits = [list(cluster.tracker.counts.values()) for cluster in self.clusters if cluster.logs]
        total = np.array([*(self._motion.state[name][logs].sum() for name in COUNTS),
                          *np.array(limits, np.int64).reshape(-1, len(LIMITS)).sum(axis=0)])  # fmt: skip
        self._comm.Allreduce(MPI.IN_PLACE, total, MPI.SUM)
        return dict(zip((*COUNTS, *LIMITS), total.tolist(), strict=True))

    def checkpoint(self) -> dict[str, np.ndarray]:
        """All that a resumed run needs."""
        trackers = [cluster.tracker.checkpoint() for cluster in self.clusters]
        logs = {f"cluster-{i}-{name}": array for i, arrays in enumerate(trackers) for name, array in arrays.items()}
        return logs | {name: array.copy() for name, array in self._saved.items()}

    def restore(self, checkpoint: dict[str, np.ndarray]) -> None:
        """Go back to a checkpoint."""
        for name, array in self._saved.items():
            array[:] = checkpoint[name]
        for i, cluster in enumerate(self.clusters):
            prefix = f"cluster-{i}-"
            cluster.tracker.restore({k.removeprefix(prefix): v for k, v in checkpoint.items() if k.startswith(prefix)})


def _unwrapped(cell: int, near: int, layout: Layout) -> int:
    """``cell``, or in a periodic lattice its copy next to ``near``."""
    return near + (cell - near + layout.cells // 2) % layout.cells - layout.cells // 2 if layout.periodic else cell


def _owned_cells(cell: int, reach: int, layout: Layout) -> np.ndarray:
    """Local numbers (2 reach + 1,) of the cells within ``reach`` of ``cell``, -1 for those of other ranks and none."""
    cells = np.arange(cell - reach, cell + reach + 1)
    cells = cells % layout.cells if layout.periodic else cells
    return np.where((cells >= layout.start) & (cells < layout.stop), cells - layout.start, -1)


def _dof_tables(
    model: Model, groups: list[list[ContactDof]], layout: Layout, series: StepSeries, halo: HaloRegions
) -> DofTables:
    """The record of the DoFs of ``groups``; adds to ``halo`` the cells that they reach."""
    r, chain = series.reach, model.chain
    columns: list[int] = []
    for group in groups:
        cells = [_unwrapped(dof.cell, group[0].cell, layout) for dof in group]
        column = halo.add(min(cells) - r, max(cells) - min(cells) + 2 * r + 1)
        columns += [column + cell - min(cells) for cell in cells]
    dofs = [dof for group in groups for dof in group]
    # DoFs away from the ends share their rows.
    keys = [(None if series.is_interior(dof.cell) else dof.cell, dof.form) for dof in dofs]
    rows = {}
    for key, dof in dict(zip(keys, dofs, strict=True)).items():
        around = series.rows(dof.cell, dof.cell - r, 2 * r + 1).astype(float)
        rows[key] = np.einsum("i,imjc->jcm", np.array(dof.form), around)
    clearances = [chain.clearances[dof.site] if dof.site >= 0 else np.inf for dof in dofs]
    return DofTables(
        column=np.array(columns, np.int64),
        owned=np.array([_owned_cells(dof.cell, r, layout) for dof in dofs], np.int64).reshape(-1, 2 * r + 1),
        table=np.array([list(rows).index(key) for key in keys], np.int64),
        rows=np.array(list(rows.values())).reshape(len(rows), chain.cell.dofs, 2 * r + 1, series.terms),
        factors=np.array([series.interval ** (k % 2) / factorial(k) for k in range(2 * series.terms)]),
        inverse_masses=1 / np.asarray(chain.cell.masses),
        clearance=np.array(clearances) * (1 - 1e-9),  # an onset within rounding of the clearance is one
        first=np.cumsum([0, *map(len, groups)]),
    )


def _responses(group: list[ContactDof], dofs: DofTables, span: slice, layout: Layout, series: StepSeries) -> np.ndarray:
    """Motion (dof, dof, term) of each DoF of a ``group`` after an impulse on each, times H, in powers 2 m + 1 of s."""
    factors = dofs.factors[1::2] * series.interval
    response = np.zeros((len(group), len(group), series.terms))
    for i, rows in enumerate(dofs.rows[dofs.table[span]]):
        for j, source in enumerate(group):
            offset = _unwrapped(source.cell, group[i].cell, layout) - group[i].cell
            if abs(offset) <= series.reach:
                weights = dofs.inverse_masses * source.form
                response[i, j] = factors * (weights @ rows[:, series.reach + offset])
    return response
