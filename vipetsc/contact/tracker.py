"""Modes of sites over time: switching at located changes, and the log of impacts."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields, replace

import numpy as np
from scipy.special import gamma

from vipetsc.contact.changes import LANDED_G, LANDED_W, Extremes, extremes, switching
from vipetsc.contact.law import CLIPPED, FREE, SITE, Contacts, elastic_force

# Limits of the contact law, of which it is counted how often they acted.
LIMITS = ("grazes", "floored", "clipped", "pulled")
COUNTS = np.dtype([(name, np.int64) for name in LIMITS])


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


EPISODE = np.dtype([(field.name, field.type) for field in fields(Episode)])
_OF_SITES = {"number": np.int64, "site": SITE, "counts": COUNTS, "lasts": bool, "pulls": bool, "episode": EPISODE}
TRACKED = np.dtype(list(_OF_SITES.items()))
"""A site in a checkpoint: its number, its mode and law, counts of limits, its episode if one ``lasts``."""


class ImpactTracker:
    """Switches the modes of ``contacts`` at located changes and logs every episode.

    ``start`` and ``end`` (sites, 3) hold w, w', w'' at both ends of the step at hand; the engine fills them.
    ``numbers`` (sites,) are those of the sites in the log, from 0; ``reduced_mass`` is m_host m_resonator / (m_host +
    m_resonator) in kg.
    """

    def __init__(self, contacts: Contacts, numbers: Sequence[int], reduced_mass: float) -> None:
        self.contacts = contacts
        self.numbers = tuple(numbers)
        self.reduced_mass = reduced_mass
        self.start = np.zeros((len(numbers), 3))
        self.end = np.zeros((len(numbers), 3))
        self.open: dict[int, Episode] = {}
        self.pulling: set[int] = set()
        self.closed: list[Episode] = []
        self.counts = np.zeros(len(numbers), COUNTS)

    def contact_time(self) -> float:
        """Shortest duration in s of a contact now open, by its approach velocity; inf if none is open."""
        speeds = np.abs(self.contacts.sites["approach"])
        return min((self.duration(float(speeds[i])) for i in self.open), default=np.inf)

    def accept_step(self, h: float) -> None:
        """Take the step of ``h`` seconds as done: update the open episodes; its end is the next one's start."""
        for i, episode in self.open.items():
            self.update_episode(i, episode, extremes(self.contacts, i, self.start, self.end, h))
        self.start, self.end = self.end, self.start

    def update_episode(self, i: int, episode: Episode, reached: Extremes) -> None:
        """Update the open episode of site ``i`` with the extremes ``reached`` in a stretch of time."""
        episode.indentation = max(episode.indentation, reached.indentation)
        episode.force = max(episode.force, reached.force)
        pull = -reached.smallest_force
        if pull > 0.0 and i not in self.pulling and pull > self.landing_force(i, episode):
            self.pulling.add(i)
            self.counts["pulled"][i] += 1

    def landing_force(self, i: int, episode: Episode) -> float:
        """Largest pull in N that is none: of the law continued to a landing short of D, or beyond g = 0."""
        law, clearance = self.contacts.law, float(self.contacts.sites["clearance"][i])
        short_of_clearance = (1 + law.damping) * elastic_force(law, LANDED_W * clearance)
        return short_of_clearance + LANDED_G * elastic_force(law, episode.indentation)

    def switch(self, t: float, energies: np.ndarray) -> int:
        """Switch every site that has landed at time ``t`` (motion in ``start``); returns how many.

        ``energies`` (sites,) are the dissipated energies in J.
        """
        switched = 0
        for i, site in enumerate(self.contacts.sites):
            for function in range(2):
                value, rate, tolerance, mode = switching(self.contacts, i, function, self.start[i])
                if value < -tolerance:
                    continue
                # At a landing |w - D| is rounding: the rate tells on which side the site goes on.
                if rate <= 0 and value <= tolerance:
                    self.counts["grazes"][i] += int(site["mode"] == FREE)
                    continue
                self._set_mode(i, mode, t, float(energies[i]))
                switched += 1
                break
        return switched

    def _set_mode(self, i: int, mode: int, t: float, energy: float) -> None:
        site = self.contacts.sites[i]
        before, side = int(site["mode"]), int(np.sign(mode))
        site["mode"] = mode
        if before == FREE:
            rate, floor = float(self.start[i, 1]), self.contacts.law.approach_floor
            self.counts["floored"][i] += int(abs(rate) < floor)
            site["approach"] = side * max(abs(rate), floor)
            self.open[i] = Episode(self.numbers[i], side, t, rate, loss=-energy)
        elif mode == FREE:
            episode = self.open.pop(i)
            self.pulling.discard(i)
            episode.separation = t
            episode.loss += energy
            self.closed.append(episode)
        elif abs(mode) == CLIPPED:
            self.counts["clipped"][i] += 1

    def take_episodes(self, energies: np.ndarray, unfinished: bool = False) -> list[Episode]:
        """Episodes closed since the last call, and ``unfinished`` ones as they are; ``energies`` as in ``switch``."""
        episodes, self.closed = self.closed, []
        if unfinished:
            episodes += [replace(e, loss=e.loss + float(energies[i])) for i, e in self.open.items()]
        return episodes

    def duration(self, speed: float) -> float:
        """Contact time in s of an isolated conservative impact at ``speed`` in m/s (Johnson 1985, sec. 11.4)."""
        kc, n = self.contacts.law.stiffness, self.contacts.law.exponent
        depth = ((n + 1) / 2 * self.reduced_mass * speed**2 / kc) ** (1 / (n + 1))
        # Integral of dx / sqrt(1 - x^(n+1)) over [0, 1]: pi/2 for n = 1, 1.4716 for n = 3/2.
        integral = np.sqrt(np.pi) * gamma(1 / (n + 1)) / ((n + 1) * gamma(0.5 + 1 / (n + 1)))
        return float(2 * integral * depth / speed)

    def checkpoint(self) -> np.ndarray:
        """Sites with their modes, counts and open episodes (sites,) of dtype ``TRACKED``."""
        table = np.zeros(len(self.numbers), TRACKED)
        table["number"], table["site"], table["counts"] = self.numbers, self.contacts.sites, self.counts
        for i, episode in self.open.items():
            table["lasts"][i], table["pulls"][i], table["episode"][i] = True, i in self.pulling, astuple(episode)
        return table

    def restore(self, table: np.ndarray) -> None:
        """Go back to a checkpoint, the ``table`` of all sites by their numbers."""
        mine = table[list(self.numbers)]
        self.contacts.sites[:], self.counts[:] = mine["site"], mine["counts"]
        self.open = {i: Episode(*mine["episode"][i].tolist()) for i in np.flatnonzero(mine["lasts"]).tolist()}
        self.pulling = set(np.flatnonzero(mine["pulls"]).tolist())
