"""Impacts: which sites are in contact, the approach velocity latched at onset, and the log of episodes."""

from __future__ import annotations

from dataclasses import asdict, astuple, dataclass

from petsc4py import PETSc

import numpy as np
from scipy.special import gamma

from vipetsc.contact import contact_kernel
from vipetsc.dynamics.operator import LatticeOperator
from vipetsc.dynamics.ts import kernel
from vipetsc.lattice import Contact


@dataclass
class Episode:
    """One contact of one site: 0-based site, side (+1, -1), times in s, velocity in m/s, depth in m, N, J.

    ``separation`` is NaN while the contact lasts.
    """

    site: int
    side: int
    onset: float
    approach_velocity: float
    separation: float = np.nan
    indentation: float = 0.0
    force: float = 0.0
    loss: float = 0.0


@dataclass
class ImpactCounts:
    """How often a limit of the contact law acted."""

    grazes: int = 0
    floored: int = 0
    clipped: int = 0
    pulled: int = 0


class ImpactTracker:
    """Contact state of the owned sites; switches modes at located changes and logs every episode."""

    def __init__(self, operator: LatticeOperator, contact: Contact) -> None:
        self.operator = operator
        self.contact = contact
        self.floor = contact.approach_floor
        mobility = operator.p[operator.q[kernel.INVERSE_MASS] :]
        pair = mobility[operator.q[kernel.HOST]] + mobility[operator.q[kernel.RESONATOR]]
        self.reduced_mass = 1 / float(pair)
        self.sites = operator.layout.sites
        self.start = np.zeros((len(self.sites), 3))
        self.end = np.zeros((len(self.sites), 3))
        self.open: dict[int, Episode] = {}
        self.pulling: set[int] = set()
        self.closed: list[Episode] = []
        self.counts = ImpactCounts()
        self._switching = np.empty((2, 4))

    def observe(self, t: float, state: PETSc.Vec, motion: np.ndarray) -> None:
        """Relative motion of all owned sites at time t; fetches ghosts, so all ranks must call it."""
        self.operator.exchange(state)
        with state.localForm() as local:
            contact_kernel.observe(t, local.array, self.operator.q, self.operator.p, motion)

    def first_change(self, h: float) -> tuple[float, int, int]:
        """Share of the step at which an owned site first changes its mode (above 1 if none does), site, row.

        The row is that of the site's switching function, as ``distance`` takes it.
        """
        operator = self.operator
        share, site, row = contact_kernel.first_change(operator.q, operator.p, self.start, self.end, h)
        return share, int(site), int(row)

    def distance(self, site: int, row: int) -> tuple[float, float, float]:
        """Value, rate and landing tolerance of a switching function at the end of the step."""
        contact_kernel.switching(self.operator.q, self.operator.p, site, self.end, self._switching)
        value, rate, tolerance, _ = self._switching[row].tolist()
        return value, rate, tolerance

    def contact_time(self) -> float:
        """Shortest duration in s of a contact now open, by its approach velocity; inf if none is open."""
        shortest = np.inf
        for site in self.open:
            shortest = min(shortest, self.duration(abs(float(self.operator.approach[site]))))
        return shortest

    def follow(self, h: float) -> None:
        """Take the step from ``start`` to ``end`` as done: update the running peaks of open episodes."""
        for site, episode in self.open.items():
            q, p = self.operator.q, self.operator.p
            self.grow(site, episode, *contact_kernel.peaks(q, p, self.start, self.end, h, site))
        self.start, self.end = self.end, self.start

    def grow(self, site: int, episode: Episode, depth: float, force: float, weakest: float) -> None:
        """Update an open episode with a stretch's largest indentation in m, largest and smallest force in N."""
        episode.indentation = max(episode.indentation, depth)
        episode.force = max(episode.force, force)
        # A pull within the landing's rounding is none.
        if weakest < -1e-9 * episode.force and site not in self.pulling:
            self.pulling.add(site)
            self.counts.pulled += 1

    def switch(self, t: float, energies: np.ndarray) -> int:
        """Switch every owned site that has landed at time t (motion in ``start``); returns how many.

        ``energies`` are the sites' dissipated energies in J.
        """
        switched = 0
        for site in range(len(self.sites)):
            contact_kernel.switching(self.operator.q, self.operator.p, site, self.start, self._switching)
            for value, rate, tolerance, mode in self._switching.tolist():
                if value < -tolerance:
                    continue
                # At a landing |w - D| is rounding: the rate tells on which side the site goes on.
                if rate <= 0 and value <= tolerance:
                    self.counts.grazes += int(self.operator.mode[site] == kernel.FREE)
                    continue
                self._change(site, int(mode), t, float(energies[site]))
                switched += 1
                break
        return switched

    def _change(self, site: int, mode: int, t: float, energy: float) -> None:
        operator = self.operator
        before = int(operator.mode[site])
        operator.mode[site] = mode
        if before == kernel.FREE:
            rate = self.start[site, 1]
            self.counts.floored += int(abs(rate) < self.floor)
            operator.approach[site] = np.sign(mode) * max(abs(rate), self.floor)
            self.open[site] = Episode(self.sites[site], int(np.sign(mode)), t, float(rate), loss=-energy)
        elif mode == kernel.FREE:
            episode = self.open.pop(site)
            self.pulling.discard(site)
            episode.separation = t
            episode.loss += energy
            self.closed.append(episode)
        elif abs(mode) == kernel.CLIPPED:
            self.counts.clipped += 1

    def unfinished(self, energies: np.ndarray) -> list[Episode]:
        """Copies of the episodes still open, with the loss so far; ``energies`` as in ``switch``."""
        return [Episode(**asdict(e) | {"loss": e.loss + float(energies[site])}) for site, e in self.open.items()]

    def duration(self, speed: float) -> float:
        """Contact time in s of an isolated conservative impact at ``speed`` in m/s (Johnson 1985, sec. 11.4)."""
        kc, n = self.contact.stiffness, self.contact.law.exponent
        depth = ((n + 1) / 2 * self.reduced_mass * speed**2 / kc) ** (1 / (n + 1))
        # Integral of dx / sqrt(1 - x^(n+1)) over [0, 1]: pi/2 for n = 1, 1.4716 for n = 3/2.
        integral = np.sqrt(np.pi) * gamma(1 / (n + 1)) / ((n + 1) * gamma(0.5 + 1 / (n + 1)))
        return float(2 * integral * depth / speed)

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Contact state of the owned sites."""
        episodes = [[site, site in self.pulling, *asdict(e).values()] for site, e in self.open.items()]
        return {
            "mode": self.operator.mode.copy(),
            "approach": self.operator.approach.copy(),
            "open": np.array(episodes, float),
            "impact_counts": np.array(astuple(self.counts)),
        }

    def restore(self, checkpoint: dict[str, np.ndarray]) -> None:
        """Go back to a checkpoint."""
        self.operator.mode[:] = checkpoint["mode"]
        self.operator.approach[:] = checkpoint["approach"]
        rows = checkpoint["open"].tolist()
        self.open = {int(row[0]): Episode(int(row[2]), int(row[3]), *row[4:]) for row in rows}
        self.pulling = {int(row[0]) for row in rows if row[1]}
        self.counts = ImpactCounts(*checkpoint["impact_counts"].tolist())
