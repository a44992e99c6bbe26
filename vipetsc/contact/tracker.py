"""Modes of sites over time: switching at located changes, and the log of episodes."""

from collections.abc import Sequence
from dataclasses import asdict, astuple

import numpy as np
from scipy.special import gamma

from vipetsc.contact import changes
from vipetsc.contact.changes import Change, Extremes, Switching
from vipetsc.contact.episodes import Episode, ImpactCounts
from vipetsc.contact.law import CLIPPED, FREE, Contacts


class ImpactTracker:
    """Switches the modes of ``contacts`` at located changes and logs every episode.

    ``start`` and ``end`` (sites, 3) hold w, w', w'' at both ends of the step at hand; the engine fills them.

    Parameters
    ----------
    contacts
        The sites, whose modes and approach velocities it sets.
    numbers
        (sites,) 0-based numbers of the sites in the log.
    reduced_mass
        m_host m_resonator / (m_host + m_resonator) in kg.
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
        self.counts = ImpactCounts()

    def first_change(self, h: float) -> Change:
        """The first change of a site's mode in the step of ``h`` seconds from ``start`` to ``end``."""
        return changes.first_change(self.contacts, self.start, self.end, h)

    def switching(self, change: Change) -> Switching:
        """The switching function of ``change`` at the end of the step."""
        return changes.switching(self.contacts, change.site, change.function, self.end[change.site])

    def contact_time(self) -> float:
        """Shortest duration in s of a contact now open, by its approach velocity; inf if none is open."""
        speeds = np.abs(self.contacts.sites["approach"])
        return min((self.duration(float(speeds[i])) for i in self.open), default=np.inf)

    def accept_step(self, h: float) -> None:
        """Take the step of ``h`` seconds as done: update the open episodes; its end is the next one's start."""
        for i, episode in self.open.items():
            self.update_episode(i, episode, changes.extremes(self.contacts, i, self.start, self.end, h))
        self.start, self.end = self.end, self.start

    def update_episode(self, i: int, episode: Episode, extremes: Extremes) -> None:
        """Update the open episode of site ``i`` with the extremes of a stretch of time."""
        episode.indentation = max(episode.indentation, extremes.indentation)
        episode.force = max(episode.force, extremes.force)
        # A pull within the landing's rounding is none.
        if extremes.smallest_force < -1e-9 * episode.force and i not in self.pulling:
            self.pulling.add(i)
            self.counts.pulled += 1

    def switch(self, t: float, energies: np.ndarray) -> int:
        """Switch every site that has landed at time ``t`` (motion in ``start``); returns how many.

        ``energies`` (sites,) are the dissipated energies in J.
        """
        switched = 0
        for i, site in enumerate(self.contacts.sites):
            for function in range(2):
                value, rate, tolerance, mode = changes.switching(self.contacts, i, function, self.start[i])
                if value < -tolerance:
                    continue
                # At a landing |w - D| is rounding: the rate tells on which side the site goes on.
                if rate <= 0 and value <= tolerance:
                    self.counts.grazes += int(site["mode"] == FREE)
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
            self.counts.floored += int(abs(rate) < floor)
            site["approach"] = side * max(abs(rate), floor)
            self.open[i] = Episode(self.numbers[i], side, t, rate, loss=-energy)
        elif mode == FREE:
            episode = self.open.pop(i)
            self.pulling.discard(i)
            episode.separation = t
            episode.loss += energy
            self.closed.append(episode)
        elif abs(mode) == CLIPPED:
            self.counts.clipped += 1

    def take_closed(self) -> list[Episode]:
        """Episodes closed since the last call."""
        closed, self.closed = self.closed, []
        return closed

    def unfinished(self, energies: np.ndarray) -> list[Episode]:
        """Copies of the episodes still open, with the loss so far; ``energies`` as in ``switch``."""
        return [Episode(**asdict(e) | {"loss": e.loss + float(energies[i])}) for i, e in self.open.items()]

    def duration(self, speed: float) -> float:
        """Contact time in s of an isolated conservative impact at ``speed`` in m/s (Johnson 1985, sec. 11.4)."""
        kc, n = self.contacts.law.stiffness, self.contacts.law.exponent
        depth = ((n + 1) / 2 * self.reduced_mass * speed**2 / kc) ** (1 / (n + 1))
        # Integral of dx / sqrt(1 - x^(n+1)) over [0, 1]: pi/2 for n = 1, 1.4716 for n = 3/2.
        integral = np.sqrt(np.pi) * gamma(1 / (n + 1)) / ((n + 1) * gamma(0.5 + 1 / (n + 1)))
        return float(2 * integral * depth / speed)

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Modes, approach velocities, open episodes and counts."""
        episodes = [[i, i in self.pulling, *asdict(e).values()] for i, e in self.open.items()]
        return {
            "mode": self.contacts.sites["mode"].copy(),
            "approach": self.contacts.sites["approach"].copy(),
            "open": np.array(episodes, float),
            "impact_counts": np.array(astuple(self.counts)),
        }

    def restore(self, checkpoint: dict[str, np.ndarray]) -> None:
        """Go back to a checkpoint."""
        self.contacts.sites["mode"] = checkpoint["mode"]
        self.contacts.sites["approach"] = checkpoint["approach"]
        rows = checkpoint["open"].tolist()
        self.open = {int(row[0]): Episode(int(row[2]), int(row[3]), *row[4:]) for row in rows}
        self.pulling = {int(row[0]) for row in rows if row[1]}
        self.counts = ImpactCounts(*checkpoint["impact_counts"].tolist())
