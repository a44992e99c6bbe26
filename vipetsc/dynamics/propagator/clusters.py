"""The forces of clusters of sites, nonlinear springs and driven masses within one linear step; their records and log.

``SiteClusters`` keeps all clusters that a rank's cells feel (sec. 6 of the derivation in the package's docstring), and
``follow_contacts`` takes one of them through a step: ``advance`` carries it to the next change of a site's mode, the
site is switched and the change is written in the log of impacts, until the step is over; the moments of the forces are
then what the step adds to the lattice (sec. 5). A cluster that several ranks feel is followed by each of them, from the
same numbers to the same bits, instead of by one that sends the result; one of them, the owner of the cluster's first
cell, logs it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.compiled import kernel
from vipetsc.contact.law import impact_time
from vipetsc.contact.tracker import LIMITS, ImpactTracker, Tracks, in_episode, rest_site, switch_sites, with_room
from vipetsc.dynamics.drives import create_drives
from vipetsc.dynamics.layout import Layout, join
from vipetsc.dynamics.propagator.advance import CHANGED, DONE, ORDER, RESTS, advance_cluster
from vipetsc.dynamics.propagator.dof_tables import create_dof_tables, create_responses, groups_within_reach
from vipetsc.dynamics.propagator.groups import Groups, contact_dofs, group_dofs
from vipetsc.dynamics.propagator.nodes import collocation
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.propagator.stencil import HaloRegions
from vipetsc.dynamics.propagator.substeps import COUNTS, HISTORY, SPRING_DOF, SUBSTEP_STATE, Cluster, create_trial
from vipetsc.dynamics.site_dofs import site_records
from vipetsc.dynamics.spring_law import SPRING_LAW
from vipetsc.records import PartRecords, Record

# A contact's first substep as a fraction of its duration at a tolerance of 1e-6; it goes with the error as others do.
# On the built-in case half as much saves 5 % of all substeps with Hertz's law and costs 6 % with the bilinear one;
# twice as much does the reverse, 3 % and 4 %.
FIRST_SUBSTEP = 0.1
FIRST_TOLERANCE = 1e-6
# Most by which a loose tolerance lengthens it. At tolerances of 1e-3 to 1e-5 the small lattice of the tests has equal
# errors with 1 and with 4; with 1 it takes up to 14 % more substeps, with 4 as many.
LONGEST_FIRST = 2.0
# Changes of one cluster in one step beyond which it counts as stalled; the built-in case has two at most, and a mass
# that bounces on a rigid stop with the restitution 1 - e until it sticks some ln(3e5 e)/e: 6,000 with e = 0.001.
MOST_CHANGES = 50_000
DOF = np.dtype([("number", np.int64), ("energy", float), ("history", HISTORY), ("cluster", SUBSTEP_STATE)])
"""A DoF of ``contact_dofs`` in a checkpoint: its number, below 0 of a drive, and what its cluster's record has."""


@kernel
def _switch(cluster: Cluster, tracks: Tracks, now: float) -> None:
    """Switch the sites of a cluster that have landed, ``now`` in s; sets the length of the next substep."""
    contacts = cluster.contacts
    state = cluster.state[0]
    had_contact = cluster.trial.sums.had_contact
    for i in range(contacts.size):
        had_contact[i] = in_episode(contacts[i].mode)
    impulses = cluster.trial.sums.impulses
    state.switches += switch_sites(contacts, tracks, cluster.site_motion, cluster.energy, impulses, now)
    _apply_impulses(cluster, impulses)

    all_free = True
    for i in range(contacts.size):
        if in_episode(contacts[i].mode):
            all_free = False
            if not had_contact[i]:
                _begin_contact(cluster, i, now)
    if all_free:
        state.length = 1.0


@kernel
def _apply_impulses(cluster: Cluster, impulses: np.ndarray) -> None:
    """Add what has struck rigid sites, ``impulses`` (site,) on their hosts in N s, to the motion from here on.

    They add to the series of the free motion as to the moments: a force F in the time dt does so as the impulse F dt.
    """
    contacts = cluster.contacts
    remaining = 1.0 - cluster.state[0].position
    stride = 1 if 2 * cluster.response.shape[2] > cluster.taylor.shape[1] else 2
    for i in range(contacts.size):
        if not contacts[i].rigid:
            continue
        if impulses[i] != 0.0:
            for j in range(cluster.taylor.shape[0]):
                for m in range(cluster.response.shape[2]):
                    cluster.taylor[j, stride * m + 1] -= cluster.response[j, i, m] * impulses[i] / cluster.interval
            amount = -impulses[i]
            for k in range(cluster.moments.shape[1]):
                cluster.moments[i, k] += amount
                amount *= remaining
    for i in range(contacts.size):
        if contacts[i].rigid and impulses[i] != 0.0:
            # To the last bit, so that what has been turned does not approach by its rounding.
            cluster.taylor[i, 1] = cluster.site_motion[i, 1] * cluster.interval


@kernel
def _begin_contact(cluster: Cluster, i: int, now: float) -> None:
    """Begin the history of a contact of site ``i``, ``now`` in s; the next substep is no longer than suits it."""
    if cluster.contacts[i].rigid:
        return  # what is stuck has no first moment that is brief
    duration = impact_time(cluster.contacts[i], abs(cluster.contacts[i].approach))
    cluster.history[i].onset = now
    cluster.history[i].duration = duration
    state = cluster.state[0]
    state.length = min(state.length, cluster.first_substep * duration / cluster.interval)


@kernel
def follow_contacts(cluster: Cluster, tracks: Tracks, begin: float) -> tuple[bool, Tracks]:
    """Advance a cluster through the step that begins at ``begin`` in s, from one switching to the next.

    Returns whether that was possible, and the ``tracks`` of its sites with as much room in the log as was needed.
    """
    state = cluster.state[0]
    state.begin = begin
    state.position = 0.0
    cluster.moments[:] = 0.0

    # One landing that leads nowhere may be an accident; from the second one in a step on, its site rests. Numba would
    # compile the call twice for a variable that begins as False, once for the constant.
    landings_nowhere = 0
    for _ in range(MOST_CHANGES):
        outcome, site = advance_cluster(cluster, tracks, landings_nowhere > 0)
        if outcome not in (CHANGED, RESTS):
            return outcome == DONE, tracks

        tracks = with_room(tracks)
        now = state.begin + state.position * cluster.interval
        if outcome == CHANGED:
            _switch(cluster, tracks, now)
        else:
            impulses = cluster.trial.sums.impulses
            rest_site(cluster.contacts, tracks, site, cluster.site_motion, cluster.energy, impulses, now)
            _apply_impulses(cluster, impulses)
        landings_nowhere += outcome == CHANGED and site >= 0
    return False, tracks


class SiteClusters:
    """Clusters that a rank's cells feel; adds to ``halo`` the cells whose motion they need.

    ``dofs`` are their tables, ``record`` that of all of them, ``each`` those of single ones, and ``tracker``
    has the modes of their sites and the log.
    ``logs`` (cluster,) marks those that this rank logs: every rank that a cluster reaches does the same sums on the
    same numbers, and the one that owns its first cell logs it.
    """

    def __init__(self, model: Model, layout: Layout, series: StepSeries, halo: HaloRegions) -> None:
        self._comm = layout.comm
        all_dofs = contact_dofs(model)
        all_groups = group_dofs(model, series.reach)
        groups = groups_within_reach(all_groups, all_dofs[all_groups.numbers], series.reach, layout)
        self._numbers = groups.numbers
        self._cells = all_dofs["cell"][groups.numbers]
        self.dofs = create_dof_tables(groups, model, layout, series, halo)
        self.record = _create_clusters(groups, self.dofs, model, series)
        self.each = self._each_cluster()
        self.tracker = ImpactTracker(self.record.contacts, _site_numbers(groups, model).tolist())

        leaders = all_dofs["cell"][groups.numbers[groups.first[:-1]]]
        self.logs = (leaders >= layout.start) & (leaders < layout.stop)
        # Which DoFs belong to a logged cluster: by their place on this rank, and by their number in the model.
        self._is_logged = np.repeat(self.logs, np.diff(groups.first))
        self._logs_number = np.zeros(len(all_dofs), bool)
        self._logs_number[groups.numbers[self._is_logged]] = True

    def _each_cluster(self) -> PartRecords:
        """Return the record of each cluster, by its number."""
        first = self.dofs.first[:-1]
        stop = self.dofs.first[1:]
        last_site = first + self.dofs.sites
        members = (first, stop)
        bounds: dict[str, Any] = dict.fromkeys(("response", "taylor", "moments", "energy", "history"), members)
        bounds |= {
            "contacts": (first, last_site),
            "site_motion": (first, last_site),
            "springs": (last_site, last_site + self.dofs.springs),
            "drives": {"rows": members},
        }
        number = np.arange(len(first))
        bounds["state"] = (number, number + 1)
        return PartRecords(self.record, len(first), bounds)

    def set_motion(self, motion: np.ndarray, energy: float) -> None:
        """Begin with w and w' of all sites as ``motion`` (site, 2), and so much ``energy`` in J as work."""
        clusters = self.record
        clusters.energy[self._numbers == -1] = energy
        for i in self.tracker.close_at_start(motion).tolist():
            # As if the contact were old: its force is smooth.
            duration = impact_time(clusters.contacts[i], abs(clusters.contacts["approach"][i]))
            clusters.history["onset"][i] = -duration
            clusters.history["duration"][i] = duration
            c = int(np.searchsorted(self.dofs.first, i, side="right")) - 1
            first = clusters.first_substep * duration / clusters.interval
            clusters.state["length"][c] = min(clusters.state["length"][c], first)

    def sites(self, c: int) -> list[int]:
        """Return the sites, counted from 1, of cluster ``c``; none of -1."""
        if c < 0:
            return []
        numbers = self._numbers[self.dofs.first[c] :][: self.dofs.sites[c]]
        return (numbers + 1).tolist()

    def first_cell(self, c: int) -> int:
        """Return the first cell, from 0, in which cluster ``c`` has a DoF; -1 of -1. It grows with ``c``."""
        if c < 0:
            return -1
        return int(self._cells[self.dofs.first[c] : self.dofs.first[c + 1]].min())

    def describe(self, c: int) -> str:
        """Return contacts and the nonlinear springs of cluster ``c`` in words; empty of -1, or if there are none."""
        if c < 0:
            return ""
        sites = self.sites(c)
        first_spring = self.dofs.first[c] + self.dofs.sites[c]
        cells = self._cells[first_spring:][: self.dofs.springs[c]] + 1
        acting = []
        if sites:
            acting.append(f"the contacts of sites {', '.join(map(str, sites))}")
        if len(cells):
            acting.append(f"the nonlinear springs of cells {', '.join(map(str, cells.tolist()))}")
        return " and ".join(acting)

    def take_episodes(self, unfinished: bool) -> np.ndarray:
        """Return episodes closed since the last call, and ``unfinished`` ones as they are, that this rank logs."""
        episodes = self.tracker.take_episodes(self.record.energy, unfinished)
        return episodes[self._logs_number[episodes["site"]]]

    def statistics(self) -> dict[str, Any]:
        """Return substeps, landings and limits of the contact law, over all ranks; all must call it."""
        state = self.record.state[self.logs]
        sites = self.tracker.counts[self._is_logged]
        counts = [state[name].sum() for name in COUNTS] + [sites[name].sum() for name in LIMITS]
        total = np.array(counts)
        self._comm.Allreduce(MPI.IN_PLACE, total, MPI.SUM)
        return dict(zip((*COUNTS, *LIMITS), total.tolist(), strict=True))

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Return ``dofs`` and ``sites`` of the clusters that this rank logs."""
        dofs = np.zeros(len(self._numbers), DOF)
        dofs["number"] = self._numbers
        dofs["energy"] = self.record.energy
        dofs["history"] = self.record.history
        dofs["cluster"] = np.repeat(self.record.state, np.diff(self.dofs.first))
        sites = self.tracker.checkpoint()
        return {"dofs": dofs[self._is_logged], "sites": sites[self._is_logged & (sites["number"] >= 0)]}

    def restore(self, checkpoints: Sequence[Mapping[str, np.ndarray]]) -> None:
        """Go back to the ``checkpoints`` of all ranks, each with the tables (dof,) and (site,) of ``checkpoint``.

        All ranks that a cluster reaches go on from the same numbers.
        """
        tables = join(checkpoints, {"dofs": "number", "sites": "number"})
        dofs = tables["dofs"][np.searchsorted(tables["dofs"]["number"], self._numbers)]
        self.record.energy[:] = dofs["energy"]
        self.record.history[:] = dofs["history"]
        self.record.state[:] = dofs["cluster"][self.dofs.first[:-1]]
        self.tracker.restore(tables["sites"])


def _site_numbers(groups: Groups, model: Model) -> np.ndarray:
    """Return the numbers (dof,) of the sites in ``groups``, -1 for springs and drives."""
    return np.where(groups.numbers < len(model.chain.sites), np.maximum(groups.numbers, -1), -1)


def _create_clusters(groups: Groups, dofs: Record, model: Model, series: StepSeries) -> Record:
    """Create the record of all clusters at rest, one for each of ``groups``."""
    count = len(groups.numbers)
    terms = series.terms

    state = np.zeros(len(groups.first) - 1, SUBSTEP_STATE)
    state["length"] = 1.0

    springs = np.zeros(count, SPRING_DOF)
    springs["scale"] = model.scale
    for name in SPRING_LAW.names or ():
        springs["law"][name] = contact_dofs(model)[name][groups.numbers]

    # The error of a substep grows with the power ORDER of its length.
    tolerance = (model.rtol / FIRST_TOLERANCE) ** (1 / ORDER)
    drives = np.where(groups.numbers < 0, -1 - groups.numbers, -1)
    clusters = Cluster(
        contacts=site_records(model, _site_numbers(groups, model)),
        springs=springs,
        drives=create_drives(model.drives, drives.tolist()),
        response=create_responses(groups, dofs, model, series),
        nodes=collocation(2 * terms),
        interval=series.interval,
        omega_max_h=series.omega_max_h,
        rtol=model.rtol,
        atol=model.atol[1],
        first_substep=FIRST_SUBSTEP * min(tolerance, LONGEST_FIRST),
        taylor=np.zeros((count, 2 * terms)),
        site_motion=np.zeros((count, 3)),
        moments=np.zeros((count, 2 * terms)),
        energy=np.zeros(count),
        history=np.zeros(count, HISTORY),
        state=state,
        trial=create_trial(int(np.diff(groups.first).max(initial=0)), terms, model.has_rigid_sites),
    )
    return Record(clusters)
