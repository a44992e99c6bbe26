"""The forces of clusters of contact sites and driven masses within one linear step; their records and log.

Sec. 5 and 6 of the derivation in the package's docstring.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.compiled import njit
from vipetsc.contact.changes import Extremes
from vipetsc.contact.law import FREE, impact_time
from vipetsc.contact.tracker import LIMITS, ImpactTracker, Tracks, switch_sites, update_episode, with_room
from vipetsc.dynamics.drives import Drives, create_drives
from vipetsc.dynamics.layout import Layout, join
from vipetsc.dynamics.places import site_records
from vipetsc.dynamics.propagator.advance import CHANGED, DONE, ORDER, advance_cluster
from vipetsc.dynamics.propagator.clusters import contact_dofs, create_dof_tables, create_responses, group_dofs, reaching
from vipetsc.dynamics.propagator.collocation import COUNTS, HISTORY, SUBSTEP_STATE, Cluster, create_trial
from vipetsc.dynamics.propagator.nodes import collocation
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.propagator.stencil import HaloRegions
from vipetsc.dynamics.propagator.tables import DofTables
from vipetsc.dynamics.propagator.tape import create_tape, select_tape

# A contact's first substep as a share of its duration at a tolerance of 1e-6.
FIRST_SUBSTEP = 0.1
# Changes of one cluster in one step beyond which it counts as stalled.
MOST_CHANGES = 5_000
FORCE = np.dtype([("number", np.int64), ("energy", float), ("history", HISTORY), ("cluster", SUBSTEP_STATE)])
"""A DoF of ``contact_dofs`` in a checkpoint: its number, below 0 of a drive, and what its cluster's record has."""


@njit(error_model="numpy")
def select_cluster(clusters: Cluster, dofs: DofTables, c: int) -> Cluster:
    """Cluster ``c`` of all: the same constants, views of its arrays."""
    first, stop = dofs.first[c], dofs.first[c + 1]
    sites = first + dofs.sites[c]
    return Cluster(
        clusters.contacts[first:sites],
        Drives(clusters.drives.rows[first:stop], clusters.drives.pieces),
        clusters.response[first:stop],
        clusters.nodes,
        clusters.interval,
        clusters.omega_max_h,
        clusters.rtol,
        clusters.atol,
        clusters.first_substep,
        clusters.taylor[first:stop],
        clusters.site_motion[first:sites],
        clusters.moments[first:stop],
        clusters.energy[first:stop],
        clusters.history[first:stop],
        clusters.state[c : c + 1],
        clusters.trial,
        select_tape(clusters.tape, c),
    )


@njit(error_model="numpy")
def update_extremes(cluster: Cluster, tracks: Tracks) -> None:
    """Bring the open episodes of a cluster up to date."""
    for i in range(cluster.contacts.size):
        if cluster.contacts[i].mode != FREE:
            history = cluster.history[i]
            reached = Extremes(history.indentation, history.force, history.smallest_force)
            update_episode(cluster.contacts, tracks, i, reached)


@njit(error_model="numpy")
def _switch(cluster: Cluster, tracks: Tracks, now: float) -> None:
    """Switch the sites of a cluster that have landed, ``now`` in s; sets the length of the next substep."""
    contacts, state = cluster.contacts, cluster.state[0]
    update_extremes(cluster, tracks)
    was_free = contacts["mode"] == FREE
    state.switches += switch_sites(contacts, tracks, cluster.site_motion, cluster.energy, now)
    is_free = contacts["mode"] == FREE
    for i in np.flatnonzero(was_free & ~is_free):
        duration, history = impact_time(contacts[i], abs(contacts[i].approach)), cluster.history[i]
        history.onset, history.duration = now, duration
        history.indentation, history.force, history.smallest_force = 0.0, 0.0, 0.0
        state.length = min(state.length, cluster.first_substep * duration / cluster.interval)
    if is_free.all():
        state.length = 1.0


@njit(error_model="numpy")
def follow_contacts(clusters: Cluster, dofs: DofTables, c: int, tracks: Tracks, begin: float) -> tuple[bool, Tracks]:
    """Advance cluster ``c`` through the step that begins at ``begin`` in s, from one switching to the next.

    Returns whether that was possible, and ``tracks`` with as much room as was needed.
    """
    cluster = select_cluster(clusters, dofs, c)
    state, first = cluster.state[0], dofs.first[c]
    state.begin, state.position = begin, 0.0
    cluster.moments[:] = 0.0
    for _ in range(MOST_CHANGES):
        outcome = advance_cluster(cluster)
        if outcome != CHANGED:
            return outcome == DONE, tracks
        tracks = with_room(tracks)
        sites = tracks.sites[first : first + cluster.contacts.size]
        now = begin + state.position * cluster.interval
        _switch(cluster, Tracks(sites, tracks.log, tracks.closed), now)
    return False, tracks


class Forces:
    """Clusters that a rank's cells feel; adds to ``halo`` the cells whose motion they need.

    Every rank that a cluster reaches does the same sums on the same numbers; the one that owns its first cell logs it.
    """

    def __init__(self, model: Model, layout: Layout, series: StepSeries, halo: HaloRegions) -> None:
        self._comm = layout.comm
        all_dofs, every = contact_dofs(model), group_dofs(model, series.reach)
        groups = reaching(every, all_dofs[every.numbers], series.reach, layout)
        dofs = all_dofs[groups.numbers]
        self.dofs = create_dof_tables(groups, model, layout, series, halo)
        count, terms = len(dofs), series.terms
        self.clusters = Cluster(
            contacts=site_records(model, groups.numbers),
            drives=create_drives(model.drives, np.where(groups.numbers < 0, -1 - groups.numbers, -1).tolist()),
            response=create_responses(groups, self.dofs, model, series),
            nodes=collocation(2 * terms),
            interval=series.interval,
            omega_max_h=series.omega_max_h,
            rtol=model.rtol,
            atol=model.atol[1],
            first_substep=FIRST_SUBSTEP * min((model.rtol / 1e-6) ** (1 / ORDER), 2.0),
            taylor=np.zeros((count, 2 * terms)),
            site_motion=np.zeros((count, 3)),
            moments=np.zeros((count, 2 * terms)),
            energy=np.zeros(count),
            history=np.zeros(count, HISTORY),
            state=np.zeros(len(groups.first) - 1, SUBSTEP_STATE),
            trial=create_trial(int(np.diff(groups.first).max(initial=0)), terms),
            tape=create_tape(0, 0),
        )
        self.clusters.state["length"] = 1.0
        leaders = dofs["cell"][groups.first[:-1]]
        self.logs = (leaders >= layout.start) & (leaders < layout.stop)
        self._mine = np.repeat(self.logs, np.diff(groups.first))  # DoFs
        self._numbers, self._logged = groups.numbers, np.zeros(len(all_dofs), bool)
        self._logged[groups.numbers[self._mine]] = True
        self.tracker = ImpactTracker(self.clusters.contacts, groups.numbers.tolist())

    def begin(self, motion: np.ndarray, energy: float) -> None:
        """Begin with w and w' of all sites as ``motion`` (site, 2), and so much ``energy`` in J as work."""
        clusters = self.clusters
        clusters.energy[self._numbers == -1] = energy
        for i in self.tracker.begin(motion).tolist():
            # As if the contact were old: its force is smooth.
            duration = impact_time(clusters.contacts[i], abs(clusters.contacts["approach"][i]))
            clusters.history["onset"][i], clusters.history["duration"][i] = -duration, duration
            c = int(np.searchsorted(self.dofs.first, i, side="right")) - 1
            first = clusters.first_substep * duration / clusters.interval
            clusters.state["length"][c] = min(clusters.state["length"][c], first)

    def sites(self, c: int) -> list[int]:
        """The sites, counted from 1, of cluster ``c``; none of -1."""
        numbers = self._numbers[self.dofs.first[c] : self.dofs.first[c + 1]] if c >= 0 else self._numbers[:0]
        return (numbers[numbers >= 0] + 1).tolist()

    def take_episodes(self, unfinished: bool) -> np.ndarray:
        """Episodes closed since the last call, and ``unfinished`` ones as they are, that this rank logs."""
        if unfinished:
            update_extremes(self.clusters, self.tracker.tracks)
        episodes = self.tracker.take_episodes(self.clusters.energy, unfinished)
        return episodes[self._logged[episodes["site"]]]

    def statistics(self) -> dict[str, Any]:
        """Substeps, landings and limits of the contact law, over all ranks; all must call it."""
        sites = self.tracker.counts[self._mine]
        total = np.array([*(self.clusters.state[name][self.logs].sum() for name in COUNTS),
                          *(sites[name].sum() for name in LIMITS)])  # fmt: skip
        self._comm.Allreduce(MPI.IN_PLACE, total, MPI.SUM)
        return dict(zip((*COUNTS, *LIMITS), total.tolist(), strict=True))

    def checkpoint(self) -> dict[str, np.ndarray]:
        """``forces`` and ``sites`` of the clusters that this rank logs."""
        clusters, forces = self.clusters, np.zeros(len(self._numbers), FORCE)
        forces["number"], forces["energy"], forces["history"] = self._numbers, clusters.energy, clusters.history
        forces["cluster"] = np.repeat(clusters.state, np.diff(self.dofs.first))
        return {"forces": forces[self._mine], "sites": self.tracker.checkpoint()[self._mine & (self._numbers >= 0)]}

    def restore(self, shares: Sequence[Mapping[str, np.ndarray]]) -> None:
        """Go back to a checkpoint; all ranks that a cluster reaches go on from the same numbers."""
        tables = join(shares, {"forces": "number", "sites": "number"})
        mine = tables["forces"][np.searchsorted(tables["forces"]["number"], self._numbers)]
        self.clusters.energy[:], self.clusters.history[:] = mine["energy"], mine["history"]
        self.clusters.state[:] = mine["cluster"][self.dofs.first[:-1]]
        self.tracker.restore(tables["sites"])
