"""Clusters: contact sites, and driven masses, that feel one another within one linear step; their records and log.

Sec. 5 and 6 of the derivation in the package's docstring.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

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
from vipetsc.dynamics.propagator.collocation import COUNTS, HISTORY, SUBSTEP_STATE, Cluster, create_trial
from vipetsc.dynamics.propagator.nodes import collocation
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.propagator.stencil import HaloRegions
from vipetsc.dynamics.propagator.tables import DofTables, owned_cells
from vipetsc.dynamics.propagator.tape import create_tape, select_tape

# A contact's first substep as a share of its duration at a tolerance of 1e-6.
FIRST_SUBSTEP = 0.1
# Changes of one cluster in one step beyond which it counts as stalled.
MOST_CHANGES = 5_000
FORCE = np.dtype([("number", np.int64), ("energy", float), ("history", HISTORY), ("cluster", SUBSTEP_STATE)])
"""A DoF of ``contact_dofs`` in a checkpoint: its number, below 0 of a drive, and what its cluster's record has."""


def contact_dofs(model: Model) -> np.ndarray:
    """The relative displacements of the contact sites and the displacements of driven masses, the first drive's last.

    A site has its number, the n-th drive -n. Each has its ``cell``, the weights ``form`` (mass,) of the displacements
    there and its ``clearance`` in m.
    """
    lattice, unit, drives = model.chain, np.eye(model.chain.cell.dofs), model.drives[::-1]
    dofs = np.zeros(len(lattice.sites) + len(drives), [("cell", int), ("form", float, len(unit)), ("clearance", float)])
    dofs["cell"] = *lattice.sites, *(drive.cell for drive in drives)
    dofs["form"] = unit[lattice.cell.resonator] - unit[lattice.cell.host]
    dofs["form"][len(lattice.sites) :] = unit[[drive.mass for drive in drives]]
    dofs["clearance"] = *lattice.clearances, *[np.inf] * len(drives)
    return dofs


class Groups(NamedTuple):
    """Groups of ``contact_dofs``: the ``numbers`` (dof,) of group g are ``first[g]`` to ``first[g + 1]``.

    In each group the sites' numbers come first, in their own order, then -1 for the first drive, -2 for the second.
    """

    numbers: np.ndarray
    first: np.ndarray


def group_dofs(model: Model, reach: int) -> Groups:
    """Groups of ``contact_dofs`` of which each is within ``reach`` cells of another, in the lattice's order."""
    lattice = model.chain
    cells = contact_dofs(model)["cell"]
    numbers = np.append(np.arange(len(lattice.sites)), np.arange(-len(model.drives), 0))
    order, group = np.argsort(cells), np.zeros(len(cells), np.int64)
    group[order[1:]] = np.cumsum(np.diff(cells[order]) > reach)
    if lattice.ends == "periodic" and cells.min() + lattice.cells - cells.max() <= reach:
        group[group == group.max()] = 0
    first = np.append(0, np.cumsum(np.bincount(group)))
    return Groups(numbers[np.lexsort((np.abs(numbers), numbers < 0, group))], first)


def _reaching(groups: Groups, cells: np.ndarray, reach: int, layout: Layout) -> Groups:
    """Those of ``groups``, whose DoFs are in ``cells``, that have a DoF within ``reach`` of the rank's cells."""
    ways = (-layout.cells, 0, layout.cells) if layout.periodic else (0,)
    near = [(cells + way >= layout.start - reach) & (cells + way < layout.stop + reach) for way in ways]
    sizes = np.diff(groups.first)
    feels = np.logical_or.reduceat(np.any(near, axis=0), groups.first[:-1]) & (layout.owned > 0)
    return Groups(groups.numbers[np.repeat(feels, sizes)], np.append(0, np.cumsum(sizes[feels])))


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
        groups = _reaching(every, all_dofs["cell"][every.numbers], series.reach, layout)
        dofs = all_dofs[groups.numbers]
        self.dofs = create_dof_tables(groups, model, layout, series, halo)
        count, terms = len(dofs), series.terms
        self.clusters = Cluster(
            contacts=site_records(model, groups.numbers),
            drives=create_drives(model.drives, np.where(groups.numbers < 0, -1 - groups.numbers, -1).tolist()),
            response=_responses(groups, self.dofs, model, series),
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


def create_dof_tables(groups: Groups, model: Model, layout: Layout, series: StepSeries, halo: HaloRegions) -> DofTables:
    """The record of the DoFs of ``groups``; adds to ``halo`` the cells that they reach."""
    numbers, dofs, r = groups.numbers, contact_dofs(model)[groups.numbers], series.reach
    # DoFs share their rows where the cells around them do.
    kinds = np.column_stack([series.like(dofs["cell"]), dofs["form"]])
    kinds, table = np.unique(kinds, axis=0, return_inverse=True)
    cells, forms = kinds[:, 0].astype(np.int64), kinds[:, 1:]
    rows = [
        np.einsum("i,imjc->jcm", form, series.cut(around, -r, 2 * r + 1).astype(float))
        for form, around in zip(forms, series.rows(cells), strict=True)
    ]
    masses = [model.chain.coefficients(cell - r, cell + r + 1).masses.T for cell in cells.tolist()]
    halves = 1 + series.is_damped
    places = np.full(len(contact_dofs(model)), -1)
    places[numbers] = np.arange(len(numbers))
    return DofTables(
        column=halo.add(dofs["cell"] - r, 2 * r + 1),
        owned=owned_cells(dofs["cell"], r, layout),
        table=table,
        rows=np.array(rows).reshape(len(rows), halves * layout.dofs, 2 * r + 1, halves * series.terms),
        factors=series.factors(),
        inverse_masses=1 / np.array(masses).reshape(len(rows), layout.dofs, 2 * r + 1),
        # An onset within rounding of the clearance is one.
        clearance=dofs["clearance"] * (1 - 1e-9),
        sites=np.add.reduceat(numbers >= 0, groups.first[:-1], dtype=np.int64) if len(numbers) else numbers[:0],
        first=groups.first,
        ledger=places[[*(-1 - i for i in layout.drives), *layout.sites]],
    )


def _responses(groups: Groups, tables: DofTables, model: Model, series: StepSeries) -> np.ndarray:
    """Motion (dof, dof, term) of each DoF after an impulse on each of its cluster, times H: ``Cluster.response``."""
    dofs, n, (first, r) = contact_dofs(model), model.chain.cells, (groups.first, series.reach)
    cells, d, damped = dofs["cell"][groups.numbers], model.chain.cell.dofs, series.is_damped
    # From velocities: (table, mass, cell, term).
    rows, factors = tables.rows[:, -d:, :, damped:], tables.factors[1::2] * series.interval
    if damped:
        factors = tables.factors[2 * series.terms + 1 :] * series.interval
    _, examples = np.unique(tables.table, return_index=True)
    weights = tables.inverse_masses[:, :, r] * dofs["form"][groups.numbers[examples]]
    sizes = np.diff(first)
    response = np.zeros((len(cells), max(sizes, default=0), rows.shape[-1]))
    for j in range(response.shape[1]):
        targets = np.flatnonzero(np.repeat(sizes, sizes) > j)
        sources = np.repeat(first[:-1], sizes)[targets] + j
        offsets = cells[sources] - cells[targets]
        if model.chain.ends == "periodic":
            offsets = (offsets + n // 2) % n - n // 2
        near = np.abs(offsets) <= r
        targets, sources, offsets = targets[near], sources[near], offsets[near]
        pairs = np.column_stack([tables.table[targets], tables.table[sources], r + offsets])
        pairs, which = np.unique(pairs, axis=0, return_inverse=True)
        of_pairs = [factors * (weights[source] @ rows[target, :, at]) for target, source, at in pairs.tolist()]
        response[targets, j] = np.reshape(of_pairs, (-1, rows.shape[-1]))[which]
    return response
