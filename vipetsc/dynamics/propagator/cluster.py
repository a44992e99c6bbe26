"""Clusters: contact sites, and the driven mass, that feel one another within one linear step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.episodes import Episode, ImpactTracker
from vipetsc.dynamics.engine import StalledError
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.operator import LatticeOperator
from vipetsc.dynamics.propagator import cluster_kernel as words
from vipetsc.dynamics.propagator import march_kernel
from vipetsc.dynamics.propagator.collocation import collocation
from vipetsc.dynamics.propagator.series import StepSeries

# A contact's first substep as a share of its duration at a tolerance of 1e-6.
FIRST_SUBSTEP = 0.1
# Changes of one cluster in one step beyond which it counts as stalled.
MOST_CHANGES = 20_000
# Longest substeps in radians of the fastest oscillation: searched for changes; only driven.
SEARCHED, DRIVEN = 0.4, 1.25


@dataclass(frozen=True)
class Member:
    """One relative displacement of a lattice: of a contact pair, ``site`` (0-based), or of the driven mass, site -1.

    ``form`` (dof,) weighs the displacements of ``cell``.
    """

    cell: int
    site: int
    form: tuple[float, ...]


def members_of(model: Model, reach: int) -> list[list[Member]]:
    """Groups of members of which each is within ``reach`` cells of another, in the lattice's order.

    In each group the sites come first, in their own order, then the driven mass.
    """
    cell, cells = model.chain.cell, model.chain.cells
    pair = np.zeros(cell.dofs)
    pair[cell.resonator], pair[cell.host] = 1.0, -1.0
    found = [Member(c, i, tuple(pair)) for i, c in enumerate(model.chain.sites)]
    found.append(Member(model.drive_cell, -1, tuple(np.eye(cell.dofs)[model.drive_mass])))
    found.sort(key=lambda m: m.cell)
    groups: list[list[Member]] = []
    for member in found:
        if groups and member.cell - groups[-1][-1].cell <= reach:
            groups[-1].append(member)
        else:
            groups.append([member])
    wrapped = model.chain.ends == "periodic" and len(groups) > 1
    if wrapped and groups[0][0].cell + cells - groups[-1][-1].cell <= reach:
        groups[0] = groups.pop() + groups[0]
    return [sorted(group, key=lambda m: (m.site < 0, m.site)) for group in groups]


class Cluster:
    """The contact state of a group of members on every rank that they reach, marched through one step at a time.

    All such ranks do the same sums on the same numbers; the one that owns the first member keeps the log.

    Parameters
    ----------
    model, layout
        The lattice and its distribution.
    members
        One group of ``members_of``.
    series
        The step's series.
    responses
        (member, member, term): series of a member's motion after an impulse on another, times H.
    jets
        (member, coefficient): filled with the free motion's series before each step.
    """

    def __init__(
        self, model: Model, layout: Layout, members: list[Member], series: StepSeries, responses: np.ndarray,
        jets: np.ndarray,
    ) -> None:  # fmt: skip
        self.members = members
        self.sites = [m.site for m in members if m.site >= 0]
        self.driven = len(self.sites) < len(members)
        self.logs = layout.start <= members[0].cell < layout.stop
        self.operator = LatticeOperator(model, replace(layout, sites=tuple(self.sites)))
        self.tracker = ImpactTracker(self.operator, model.contact)
        self.energy = np.zeros(len(members))
        self.moments = np.zeros_like(jets)
        self.counts = np.zeros(3, np.int64)
        self.switches = 0
        self._burst = model.drive.duration
        self._first = FIRST_SUBSTEP * min((model.rtol / 1e-6) ** (1 / march_kernel.ORDER), 2.0)
        self._since = np.zeros(len(self.sites))
        self._durations = np.ones(len(self.sites))
        self._tops = np.zeros((len(self.sites), 3))
        nodes = collocation(jets.shape[1])
        self._clock = np.zeros(9)
        self._clock[words.INTERVAL] = series.interval
        self._clock[words.RTOL], self._clock[words.ATOL] = model.rtol, model.atol[1]
        self._clock[words.TOP] = series.top
        self._clock[words.SUBSTEP] = 1.0
        fastest = series.top
        if self.driven:
            fastest += model.drive.frequency * (1 + 1 / model.drive.cycles) * series.interval
        self._clock[words.LONGEST] = (SEARCHED if self.sites else DRIVEN) / fastest
        self._arguments = (jets, responses, nodes.share, nodes.weight, nodes.powers, nodes.tail, self.moments,
                           self.energy, self.tracker.start, self.tracker.end, self._tops, self.counts)  # fmt: skip

    def busy(self, t: float) -> bool:
        """Whether a force acts on a member at time t in s."""
        return bool(self.tracker.open) or (self.driven and t < self._burst)

    def march(self, begin: float) -> None:
        """Go through the step that begins at time ``begin`` in s; leaves the forces' moments and energies.

        Raises StalledError where the contacts cannot be followed.
        """
        clock, operator, h = self._clock, self.operator, self._clock[words.INTERVAL]
        clock[words.BEGIN], clock[words.PLACE] = begin, 0.0
        clock[words.DRIVE_END] = (self._burst - begin) / h if self.driven else 0.0
        self.moments[:] = 0.0
        for _ in range(MOST_CHANGES):
            outcome = march_kernel.march(
                operator.q, operator.p, clock, self._since, self._durations, *self._arguments
            )  # fmt: skip
            if outcome == march_kernel.DONE:
                return
            if outcome == march_kernel.FAILED:
                break
            self._switch(begin + float(clock[words.PLACE]) * h)
        now = begin + float(clock[words.PLACE]) * h
        raise StalledError(f"the contacts of sites {', '.join(str(s + 1) for s in self.sites)} at {now:.9g} s")

    def _switch(self, now: float) -> None:
        tracker = self.tracker
        self._settle()
        before = set(tracker.open)
        self.switches += tracker.switch(now, self.energy)
        for site in set(tracker.open) - before:
            self._since[site] = now
            self._durations[site] = tracker.duration(abs(float(self.operator.approach[site])))
            first = self._first * self._durations[site] / self._clock[words.INTERVAL]
            self._clock[words.SUBSTEP] = min(self._clock[words.SUBSTEP], first)
        if not tracker.open:
            self._clock[words.SUBSTEP] = 1.0

    def _settle(self) -> None:
        """Put the largest indentations and forces so far into the open episodes."""
        for site, episode in self.tracker.open.items():
            self.tracker.grow(site, episode, *self._tops[site].tolist())
        self._tops[:] = 0.0

    def take_episodes(self) -> list[Episode]:
        """Episodes closed since the last call; none where another rank logs them."""
        closed, self.tracker.closed = self.tracker.closed, []
        return closed if self.logs else []

    def unfinished(self) -> list[Episode]:
        """Copies of the open episodes; none where another rank logs them."""
        self._settle()
        return self.tracker.unfinished(self.energy) if self.logs else []

    def checkpoint(self) -> dict[str, np.ndarray]:
        """All that a resumed run needs."""
        self._settle()
        return self.tracker.checkpoint() | {
            "energy": self.energy.copy(),
            "since": self._since.copy(),
            "durations": self._durations.copy(),
            "substep": np.array(self._clock[words.SUBSTEP]),
            "cluster_counts": np.append(self.counts, self.switches),
        }

    def restore(self, checkpoint: dict[str, np.ndarray]) -> None:
        """Go back to a checkpoint."""
        self.tracker.restore(checkpoint)
        self.energy[:] = checkpoint["energy"]
        self._since[:] = checkpoint["since"]
        self._durations[:] = checkpoint["durations"]
        self._clock[words.SUBSTEP] = checkpoint["substep"]
        *counts, self.switches = checkpoint["cluster_counts"].tolist()
        self.counts[:] = counts
