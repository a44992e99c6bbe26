"""Clusters: contact sites, and the driven mass, that feel one another within one linear step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.changes import Extremes
from vipetsc.contact.law import create_contacts
from vipetsc.contact.tracker import Episode, ImpactTracker
from vipetsc.dynamics.engine import StalledError
from vipetsc.dynamics.propagator.advance import DONE, FAILED, ORDER, advance_cluster
from vipetsc.dynamics.propagator.collocation import collocation
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.propagator.substep import ClusterMotion, ClusterRecord
from vipetsc.dynamics.records import Burst

# A contact's first substep as a share of its duration at a tolerance of 1e-6.
FIRST_SUBSTEP = 0.1
# Changes of one cluster in one step beyond which it counts as stalled.
MOST_CHANGES = 20_000
# Longest substeps in radians of the fastest oscillation: searched for changes; only driven.
SEARCHED, DRIVEN = 0.4, 1.25


@dataclass(frozen=True)
class ContactDof:
    """One relative displacement of a lattice: of a contact pair, ``site`` (0-based), or of the driven mass, site -1.

    ``form`` (mass,) weighs the displacements of ``cell``.
    """

    cell: int
    site: int
    form: tuple[float, ...]


def group_dofs(model: Model, reach: int) -> list[list[ContactDof]]:
    """Groups of DoFs of which each is within ``reach`` cells of another, in the lattice's order.

    In each group the sites come first, in their own order, then the driven mass.
    """
    cell, cells = model.chain.cell, model.chain.cells
    pair = np.zeros(cell.dofs)
    pair[cell.resonator], pair[cell.host] = 1.0, -1.0
    dofs = [ContactDof(c, i, tuple(pair)) for i, c in enumerate(model.chain.sites)]
    dofs.append(ContactDof(model.drive_cell, -1, tuple(np.eye(cell.dofs)[model.drive_mass])))
    dofs.sort(key=lambda dof: dof.cell)
    groups: list[list[ContactDof]] = []
    for dof in dofs:
        if groups and dof.cell - groups[-1][-1].cell <= reach:
            groups[-1].append(dof)
        else:
            groups.append([dof])
    joined = model.chain.ends == "periodic" and len(groups) > 1
    if joined and groups[0][0].cell + cells - groups[-1][-1].cell <= reach:
        groups[0] = groups.pop() + groups[0]
    return [sorted(group, key=lambda dof: (dof.site < 0, dof.site)) for group in groups]


class Cluster:
    """A group of DoFs on every rank that they reach, advanced through one linear step at a time.

    All such ranks do the same sums on the same numbers; one of them, with ``logs``, keeps the log. ``response`` is that
    of ``ClusterRecord``; ``motion.taylor`` is filled before each step, whose forces leave moments and energies there.
    """

    def __init__(
        self, model: Model, dofs: list[ContactDof], series: StepSeries, response: np.ndarray, motion: ClusterMotion,
        logs: bool,
    ) -> None:  # fmt: skip
        cell, drive = model.chain.cell, model.drive
        self.sites = [dof.site for dof in dofs if dof.site >= 0]
        self.logs = logs
        self._motion = motion
        self._first_substep = FIRST_SUBSTEP * min((model.rtol / 1e-6) ** (1 / ORDER), 2.0)
        fastest = series.omega_max_h
        if len(self.sites) < len(dofs):
            fastest += drive.frequency * (1 + 1 / drive.cycles) * series.interval
        self._record = ClusterRecord(
            contacts=create_contacts(model.contact, [model.chain.clearances[site] for site in self.sites]),
            burst=Burst(drive.window_amplitude, drive.frequency, float(drive.cycles), drive.duration),
            response=response,
            nodes=collocation(2 * series.terms),
            interval=series.interval,
            omega_max_h=series.omega_max_h,
            longest=(SEARCHED if self.sites else DRIVEN) / fastest,
            rtol=model.rtol,
            atol=model.atol[1],
        )
        reduced_mass = 1 / (1 / cell.masses[cell.host] + 1 / cell.masses[cell.resonator])
        self.tracker = ImpactTracker(self._record.contacts, self.sites, reduced_mass)
        self.tracker.start = motion.site_motion

    def advance(self, begin: float) -> None:
        """Go through the step that begins at ``begin`` in s; raises StalledError if the contacts cannot be followed."""
        now = begin
        for _ in range(MOST_CHANGES):
            outcome = advance_cluster(self._record, self._motion, begin)
            if outcome == DONE:
                return
            now = begin + float(self._motion.state["position"][0]) * self._record.interval
            if outcome == FAILED:
                break
            self._switch(now)
        sites = ", ".join(str(site + 1) for site in self.sites)
        raise StalledError(f"the contacts of sites {sites} at {now:.9g} s")

    def _switch(self, now: float) -> None:
        """Switch the sites that have landed, and set the length of the next substep."""
        tracker, state = self.tracker, self._motion.state
        self._update_episodes()
        before = set(tracker.open)
        state["switches"] += tracker.switch(now, self._motion.energy)
        for site in set(tracker.open) - before:
            duration = tracker.duration(abs(float(self._record.contacts.sites["approach"][site])))
            self._motion.history[site] = now, duration, 0.0, 0.0, 0.0
            first = self._first_substep * duration / self._record.interval
            state["length"] = min(state["length"][0], first)
        if not tracker.open:
            state["length"] = 1.0

    def _update_episodes(self) -> None:
        """Put the extremes so far into the open episodes."""
        for site, episode in self.tracker.open.items():
            _, _, *extremes = self._motion.history[site].tolist()
            self.tracker.update_episode(site, episode, Extremes(*extremes))

    def take_episodes(self, unfinished: bool) -> list[Episode]:
        """Episodes closed since the last call, and ``unfinished`` ones; none where another rank logs them."""
        if unfinished:
            self._update_episodes()
        episodes = self.tracker.take_episodes(self._motion.energy, unfinished)
        return episodes if self.logs else []
