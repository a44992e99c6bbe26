"""Clusters: contact sites, and the driven mass, that feel one another within one linear step; their records and log.

Sec. 5 and 6 of the derivation in the package's docstring.
"""

from collections.abc import Mapping, Sequence
from itertools import chain, compress
from math import factorial
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.compiled import njit
from vipetsc.contact.changes import Extremes
from vipetsc.contact.law import Contacts, create_contacts
from vipetsc.contact.tracker import LIMITS, TRACKED, Episode, ImpactTracker
from vipetsc.dynamics.layout import Layout, create_burst, join
from vipetsc.dynamics.propagator.advance import ORDER
from vipetsc.dynamics.propagator.collocation import COUNTS, HISTORY, SUBSTEP_STATE, Cluster, collocation
from vipetsc.dynamics.propagator.series import DofTables, StepSeries
from vipetsc.dynamics.propagator.stencil import HaloRegions

# A contact's first substep as a share of its duration at a tolerance of 1e-6.
FIRST_SUBSTEP = 0.1
FORCE = np.dtype([("number", np.int64), ("energy", float), ("history", HISTORY), ("cluster", SUBSTEP_STATE)])
"""A DoF of ``contact_dofs`` in a checkpoint: its number, -1 for the driven mass, and what its cluster's record has."""


def contact_dofs(model: Model) -> np.ndarray:
    """The relative displacements of the contact sites and, as the last one, the displacement of the driven mass.

    Each has its ``cell``, the weights ``form`` (mass,) of the displacements there and its ``clearance`` in m.
    """
    lattice, unit = model.chain, np.eye(model.chain.cell.dofs)
    dofs = np.zeros(len(lattice.sites) + 1, [("cell", int), ("form", float, len(unit)), ("clearance", float)])
    dofs["cell"] = *lattice.sites, model.drive_cell
    dofs["form"] = unit[lattice.cell.resonator] - unit[lattice.cell.host]
    dofs["form"][-1] = unit[model.drive_mass]
    dofs["clearance"] = *lattice.clearances, np.inf
    return dofs


def group_dofs(model: Model, reach: int) -> list[list[int]]:
    """Groups of ``contact_dofs`` of which each is within ``reach`` cells of another, in the lattice's order.

    In each group the sites' numbers come first, in their own order, then -1 for the driven mass.
    """
    cells = contact_dofs(model)["cell"].tolist()
    groups: list[list[int]] = []
    for dof in sorted(range(-1, len(cells) - 1), key=lambda dof: cells[dof]):
        if groups and cells[dof] - cells[groups[-1][-1]] <= reach:
            groups[-1].append(dof)
        else:
            groups.append([dof])
    joined = model.chain.ends == "periodic" and len(groups) > 1
    if joined and cells[groups[0][0]] + model.chain.cells - cells[groups[-1][-1]] <= reach:
        groups[0] = groups.pop() + groups[0]
    return [sorted(group, key=lambda dof: (dof < 0, dof)) for group in groups]


@njit(error_model="numpy")
def select_cluster(clusters: Cluster, dofs: DofTables, c: int) -> Cluster:
    """Cluster ``c`` of all: the same constants, views of its arrays."""
    first, stop = dofs.first[c], dofs.first[c + 1]
    sites = stop - 1 if stop - 1 == dofs.driven else stop
    return Cluster(
        Contacts(clusters.contacts.law, clusters.contacts.sites[first:sites]),
        clusters.burst,
        clusters.response[first:stop],
        clusters.nodes,
        clusters.interval,
        clusters.omega_max_h,
        clusters.rtol,
        clusters.atol,
        clusters.taylor[first:stop],
        clusters.site_motion[first:sites],
        clusters.moments[first:stop],
        clusters.energy[first:stop],
        clusters.history[first:stop],
        clusters.state[c : c + 1],
    )


class Forces:
    """Clusters that a rank's cells feel; adds to ``halo`` the cells whose motion they need.

    Every rank that a cluster reaches does the same sums on the same numbers; the one that owns its first cell logs it.
    """

    def __init__(self, model: Model, layout: Layout, series: StepSeries, halo: HaloRegions) -> None:
        self._comm = layout.comm
        dofs, r = contact_dofs(model), series.reach
        groups = [g for g in group_dofs(model, r) if (_owned_cells(dofs["cell"][g], r, layout) >= 0).any()]
        self.dofs = create_dof_tables(groups, model, layout, series, halo)
        count, terms = len(self.dofs.column), series.terms
        self.clusters = Cluster(
            contacts=create_contacts(model.contact, dofs["clearance"][list(chain(*groups))].tolist()),
            burst=create_burst(model.drive),
            response=_responses(groups, self.dofs, model, series),
            nodes=collocation(2 * terms),
            interval=series.interval,
            omega_max_h=series.omega_max_h,
            rtol=model.rtol,
            atol=model.atol[1],
            taylor=np.zeros((count, 2 * terms)),
            site_motion=np.zeros((count, 3)),
            moments=np.zeros((count, 2 * terms)),
            energy=np.zeros(count),
            history=np.zeros(count, HISTORY),
            state=np.zeros(len(groups), SUBSTEP_STATE),
        )
        self.clusters.state["length"] = 1.0
        self._first_substep = FIRST_SUBSTEP * min((model.rtol / 1e-6) ** (1 / ORDER), 2.0)
        self._numbers = list(chain(*groups))
        self._logs = np.array([layout.start <= dofs["cell"][group[0]] < layout.stop for group in groups], bool)
        self._clusters = [select_cluster(self.clusters, self.dofs, c) for c in range(len(groups))]
        self.trackers = []
        for group, cluster in zip(groups, self._clusters, strict=True):
            sites = group[: cluster.contacts.sites.size]
            self.trackers.append(ImpactTracker(cluster.contacts, sites, model.chain.cell.reduced_mass))
            self.trackers[-1].start = cluster.site_motion

    def switch(self, c: int, now: float) -> None:
        """Switch the sites of cluster ``c`` that have landed, ``now`` in s; sets the length of the next substep."""
        tracker, cluster = self.trackers[c], self._clusters[c]
        self._update_episodes(c)
        before = set(tracker.open)
        cluster.state["switches"] += tracker.switch(now, cluster.energy)
        for site in set(tracker.open) - before:
            duration = tracker.duration(abs(float(tracker.contacts.sites["approach"][site])))
            cluster.history[site] = now, duration, 0.0, 0.0, 0.0
            first = self._first_substep * duration / cluster.interval
            cluster.state["length"] = min(cluster.state["length"][0], first)
        if not tracker.open:
            cluster.state["length"] = 1.0

    def _update_episodes(self, c: int) -> None:
        for site, episode in self.trackers[c].open.items():
            _, _, *extremes = self._clusters[c].history[site].tolist()
            self.trackers[c].update_episode(site, episode, Extremes(*extremes))

    def take_episodes(self, unfinished: bool) -> list[Episode]:
        """Episodes closed since the last call, and ``unfinished`` ones as they are, that this rank logs."""
        episodes = []
        for c, (tracker, cluster) in enumerate(zip(self.trackers, self._clusters, strict=True)):
            if unfinished:
                self._update_episodes(c)
            closed = tracker.take_episodes(cluster.energy, unfinished)
            episodes += closed if self._logs[c] else []
        return episodes

    def statistics(self) -> dict[str, Any]:
        """Substeps, landings and limits of the contact law, over all ranks; all must call it."""
        sites = self.checkpoint()["sites"]["counts"]
        total = np.array([*(self.clusters.state[name][self._logs].sum() for name in COUNTS),
                          *(sites[name].sum() for name in LIMITS)])  # fmt: skip
        self._comm.Allreduce(MPI.IN_PLACE, total, MPI.SUM)
        return dict(zip((*COUNTS, *LIMITS), total.tolist(), strict=True))

    def checkpoint(self) -> dict[str, np.ndarray]:
        """``forces`` and ``sites`` of the clusters that this rank logs."""
        sizes, clusters = np.diff(self.dofs.first), self.clusters
        forces = np.zeros(len(self._numbers), FORCE)
        forces["number"], forces["energy"], forces["history"] = self._numbers, clusters.energy, clusters.history
        forces["cluster"] = np.repeat(clusters.state, sizes)
        sites = [np.zeros(0, TRACKED), *(tracker.checkpoint() for tracker in compress(self.trackers, self._logs))]
        return {"forces": forces[np.repeat(self._logs, sizes)], "sites": np.concatenate(sites)}

    def restore(self, shares: Sequence[Mapping[str, np.ndarray]]) -> None:
        """Go back to a checkpoint; all ranks that a cluster reaches go on from the same numbers."""
        tables = {name: np.sort(table, order="number") for name, table in join(shares, ("forces", "sites")).items()}
        mine = tables["forces"][np.array(self._numbers, int) + 1]  # from -1, the driven mass
        self.clusters.energy[:], self.clusters.history[:] = mine["energy"], mine["history"]
        self.clusters.state[:] = mine["cluster"][self.dofs.first[:-1]]
        for tracker in self.trackers:
            tracker.restore(tables["sites"])


def _owned_cells(cells: np.ndarray, reach: int, layout: Layout) -> np.ndarray:
    """Local numbers (dof, 2 reach + 1) of what lies within ``reach`` of ``cells`` (dof,), -1 where nothing is owned."""
    around = cells[:, None] + np.arange(-reach, reach + 1)
    around = around % layout.cells if layout.periodic else around
    return np.where((around >= layout.start) & (around < layout.stop), around - layout.start, -1)


def create_dof_tables(
    groups: list[list[int]], model: Model, layout: Layout, series: StepSeries, halo: HaloRegions
) -> DofTables:
    """The record of the DoFs of ``groups``; adds to ``halo`` the cells that they reach."""
    numbers = list(chain.from_iterable(groups))
    dofs, r = contact_dofs(model)[numbers], series.reach
    # DoFs away from the ends share their rows.
    keys = [(number < 0, -1 if series.is_interior(dof["cell"]) else dof["cell"])
            for number, dof in zip(numbers, dofs, strict=True)]  # fmt: skip
    rows = {}
    for key, dof in dict(zip(keys, dofs, strict=True)).items():
        around = series.rows(dof["cell"], dof["cell"] - r, 2 * r + 1).astype(float)
        rows[key] = np.einsum("i,imjc->jcm", dof["form"], around)
    return DofTables(
        column=np.array([halo.add(cell - r, 2 * r + 1) for cell in dofs["cell"]], np.int64),
        owned=_owned_cells(dofs["cell"], r, layout),
        table=np.array([list(rows).index(key) for key in keys], np.int64),
        rows=np.array(list(rows.values())).reshape(len(rows), layout.dofs, 2 * r + 1, series.terms),
        factors=np.array([series.interval ** (k % 2) / factorial(k) for k in range(2 * series.terms)]),
        inverse_masses=1 / np.asarray(model.chain.cell.masses),
        # An onset within rounding of the clearance is one.
        clearance=dofs["clearance"] * (1 - 1e-9),
        driven=numbers.index(-1) if -1 in numbers else -1,
        first=np.cumsum([0, *map(len, groups)]),
        ledger=np.array([numbers.index(dof) for dof in (-1,) * layout.owns_drive + layout.sites], np.int64),
    )


def _responses(groups: list[list[int]], tables: DofTables, model: Model, series: StepSeries) -> np.ndarray:
    """Motion (dof, dof, term) of each DoF after an impulse on each of its cluster, times H, in powers 2 m + 1 of s."""
    dofs, cells, factors = contact_dofs(model), model.chain.cells, tables.factors[1::2] * series.interval
    response = np.zeros((len(tables.column), max(map(len, groups), default=0), series.terms))
    for group, first in zip(groups, tables.first[:-1], strict=True):
        for i, target in enumerate(dofs[group], first):
            for j, source in enumerate(dofs[group]):
                offset = source["cell"] - target["cell"]
                if model.chain.ends == "periodic":
                    offset = (offset + cells // 2) % cells - cells // 2
                if abs(offset) <= series.reach:
                    weights = tables.inverse_masses * source["form"]
                    response[i, j] = factors * (weights @ tables.rows[tables.table[i], :, series.reach + offset])
    return response
