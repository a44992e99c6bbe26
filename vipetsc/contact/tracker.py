"""Modes of sites over time, compiled: switching at located changes, and the log of impacts."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vipetsc.compiled import kernel, njit
from vipetsc.contact.changes import LANDED_G, LANDED_W, Extremes, extremes, switching
from vipetsc.contact.law import (
    CLIPPED,
    CLOSED,
    FREE,
    PERMANENT,
    SITE,
    contact_force,
    elastic_energy,
    elastic_force,
    gap_of,
    impact_time,
)

# Limits of the contact law, of which it is counted how often they acted.
LIMITS = ("grazes", "floored", "clipped", "pulled")
COUNTS = np.dtype([(name, np.int64) for name in LIMITS])
_REALS = ("onset", "approach_velocity", "separation", "indentation", "force", "loss")
EPISODE = np.dtype([("site", np.int64), ("side", np.int64), *((name, np.float64) for name in _REALS)])
"""One contact of one site: 0-based site, side (+1, -1), times in s, velocity in m/s, depth in m, N, J."""
TRACKED = np.dtype([("number", np.int64), ("site", SITE), ("counts", COUNTS), ("pulls", bool), ("episode", EPISODE)])
"""A site: its number in the log; in a checkpoint its mode and law; counts of limits; its episode unless it is free, of
which the separation is NaN, and whether it was seen to pull."""


class Tracks(NamedTuple):
    """``sites`` (site,) of dtype ``TRACKED``; the first ``closed[0]`` rows of ``log`` are episodes that have ended."""

    sites: np.ndarray
    log: np.ndarray
    closed: np.ndarray


@njit(error_model="numpy")
def with_room(tracks: Tracks) -> Tracks:
    """The same with room in the log for an episode of every site."""
    used, wanted = tracks.closed[0], tracks.closed[0] + tracks.sites.size
    if wanted <= tracks.log.size:
        return tracks
    log = np.empty(2 * wanted, tracks.log.dtype)
    log[:used] = tracks.log[:used]
    return Tracks(tracks.sites, log, tracks.closed)


@njit(error_model="numpy")
def update_episode(contacts: np.ndarray, tracks: Tracks, i: int, reached: Extremes) -> None:
    """Update the open episode of site ``i`` with the extremes ``reached`` in a stretch of time."""
    site, law = tracks.sites[i], contacts[i]
    episode, pull = site.episode, -reached.smallest_force
    episode.indentation = max(episode.indentation, reached.indentation)
    episode.force = max(episode.force, reached.force)
    # No pull is that of the law continued to a landing short of D, or beyond g = 0.
    none = (1.0 + law.damping) * elastic_force(law.elastic, LANDED_W * law.scale)
    if pull > 0.0 and not site.pulls and pull > none + LANDED_G * elastic_force(law.elastic, episode.indentation):
        site.pulls = True
        site.counts.pulled += 1


@njit(error_model="numpy")
def update_episodes(contacts: np.ndarray, tracks: Tracks, start: np.ndarray, end: np.ndarray, h: float) -> None:
    """Update all open episodes with a step of ``h`` seconds between the motions ``start`` and ``end`` (sites, 3)."""
    for i in range(contacts.size):
        side = 1 if contacts[i].mode > 0 else -1
        if abs(contacts[i].mode) == PERMANENT and not side * start[i, 1] > 0.0 > side * end[i, 1]:  # no turn inside
            episode = tracks.sites[i].episode
            episode.indentation = max(episode.indentation, side * end[i, 0] - gap_of(contacts[i], side))
            episode.force = max(episode.force, side * contact_force(contacts, i, end[i, 0], end[i, 1])[0])
        elif contacts[i].mode != FREE:
            update_episode(contacts, tracks, i, extremes(contacts, i, start, end, h))


@njit(error_model="numpy")
def switch_sites(contacts: np.ndarray, tracks: Tracks, motion: np.ndarray, energies: np.ndarray, t: float) -> int:
    """Switch every site that has landed at time ``t`` in s; returns how many. The log must have room.

    ``motion`` (sites, 3) holds w, w', w'', ``energies`` (sites,) what they dissipated so far in J.
    """
    switched = 0
    for i in range(contacts.size):
        for function in range(2):
            value, rate, tolerance, mode = switching(contacts, i, function, motion[i])
            if value < -tolerance:
                continue
            # At a landing |w - D| is rounding: the rate tells on which side the site goes on.
            if rate <= 0.0 and value <= tolerance:
                if contacts[i].mode == FREE:
                    tracks.sites[i].counts.grazes += 1
                continue
            _set_mode(contacts, tracks, i, mode, motion[i, 1], energies[i], t)
            switched += 1
            break
    return switched


@njit(error_model="numpy")
def _set_mode(contacts: np.ndarray, tracks: Tracks, i: int, mode: int, rate: float, energy: float, t: float) -> None:
    site, track, floor = contacts[i], tracks.sites[i], contacts[i].floor
    episode, was_free, side = track.episode, site.mode == FREE, (1 if mode > 0 else -1)
    site.mode = mode
    if was_free:
        track.counts.floored += abs(rate) < floor
        site.approach = side * max(abs(rate), floor)
        episode.site, episode.side, episode.onset, episode.approach_velocity = track.number, side, t, rate
        episode.separation, episode.indentation, episode.force, episode.loss = np.nan, 0.0, 0.0, -energy
    elif mode == FREE:
        track.pulls = False
        episode.separation = t
        episode.loss += energy
        tracks.log[tracks.closed[0]] = episode
        tracks.closed[0] += 1
    elif abs(mode) == CLIPPED:
        track.counts.clipped += 1


@kernel
def shortest_impact(contacts: np.ndarray) -> float:
    """The smallest ``impact_time`` in s of the sites in contact, of the approach of each; inf if there is none."""
    shortest = np.inf
    for i in range(contacts.size):
        if abs(contacts[i].mode) in (CLOSED, CLIPPED):
            shortest = min(shortest, impact_time(contacts[i], abs(contacts[i].approach)))
    return shortest


class ImpactTracker:
    """Switches the modes of ``contacts`` at located changes and logs every episode.

    ``start`` and ``end`` (sites, 3) hold w, w', w'' at both ends of the step at hand; the engine fills them.
    ``numbers`` (sites,) are those of the sites in the log, from 0, or -1 for none.
    """

    def __init__(self, contacts: np.ndarray, numbers: Sequence[int]) -> None:
        self.contacts, sites = contacts, np.zeros(len(numbers), TRACKED)
        self.start, self.end = np.zeros((2, len(sites), 3))
        sites["number"] = numbers
        held = np.flatnonzero(np.abs(contacts["mode"]) == PERMANENT)
        sites["episode"]["site"][held], sites["episode"]["separation"][held] = sites["number"][held], np.nan
        sites["episode"]["side"][held] = np.sign(contacts["mode"][held])
        self.tracks = Tracks(sites, np.zeros(2 * len(sites), EPISODE), np.zeros(1, np.int64))

    def begin(self, motion: np.ndarray) -> np.ndarray:
        """Close the sites that begin beyond their clearance at t = 0; returns their indices.

        ``motion`` (site, 2) has w and w' of all numbered sites. When these contacts began is not known: w'_minus is the
        speed with which two masses alone come to w at w' without loss: mu (w'_minus^2 - w'^2)/2 is the elastic energy.
        """
        sites, mine = self.contacts, np.flatnonzero(self.tracks.sites["number"] >= 0)
        (w, rate), near = motion[self.tracks.sites["number"][mine]].T, LANDED_W * sites["scale"][mine]
        depths = w - sites["clearance"][mine], -w - sites["clearance_minus"][mine]
        side, deep = np.where(depths[0] < depths[1], -1, 1), np.maximum(*depths)
        touching = (deep > near) | ((deep >= -near) & (side * rate > 0))
        closed = touching & (sites["mode"][mine] == FREE)
        some, side, deep, rate = mine[closed], side[closed], np.maximum(deep[closed], 0.0), rate[closed]
        law = sites[some]
        stored = np.array([elastic_energy(site["elastic"], x) for site, x in zip(law, deep, strict=True)])
        speed = np.sqrt(rate**2 + 2 * stored / law["reduced_mass"])
        sites["approach"][some] = side * np.maximum(speed, law["floor"])
        sites["mode"][some] = side * CLOSED
        clipped = law["clip"] & (1 + law["damping"] * rate / sites["approach"][some] < 0)
        sites["mode"][some[clipped]] *= CLIPPED
        episodes = self.tracks.sites["episode"]
        episodes["site"][some], episodes["side"][some] = self.tracks.sites["number"][some], side
        episodes["approach_velocity"][some], episodes["separation"][some] = side * speed, np.nan
        return some

    @property
    def counts(self) -> np.ndarray:
        """How often the limits of the contact law acted on each site, of dtype ``COUNTS``."""
        return self.tracks.sites["counts"]

    @property
    def _lasting(self) -> np.ndarray:
        """The sites in contact."""
        return np.flatnonzero(self.contacts["mode"] != FREE)

    def contact_time(self) -> float:
        """Shortest duration in s of a contact now open, by its approach velocity; inf if none is open."""
        return shortest_impact(self.contacts)

    def accept_step(self, h: float) -> None:
        """Take the step of ``h`` seconds as done: update the open episodes; its end is the next one's start."""
        update_episodes(self.contacts, self.tracks, self.start, self.end, h)
        self.start, self.end = self.end, self.start

    def switch(self, t: float, energies: np.ndarray) -> int:
        """Switch every site that has landed at time ``t`` in s (motion in ``start``); returns how many.

        ``energies`` (sites,) are the dissipated energies in J.
        """
        self.tracks = with_room(self.tracks)
        return switch_sites(self.contacts, self.tracks, self.start, energies, t)

    def take_episodes(self, energies: np.ndarray, unfinished: bool = False) -> np.ndarray:
        """Episodes closed since the last call, and ``unfinished`` ones as they are; ``energies`` as in ``switch``."""
        closed = self.tracks.log[: self.tracks.closed[0]].copy()
        self.tracks.closed[:] = 0
        lasting = self._lasting if unfinished else np.zeros(0, int)
        still_open = self.tracks.sites["episode"][lasting]
        still_open["loss"] += energies[lasting]
        return np.concatenate([closed, still_open])

    def checkpoint(self) -> np.ndarray:
        """Sites with their modes, counts and episodes (sites,) of dtype ``TRACKED``."""
        self.tracks.sites["site"] = self.contacts
        return self.tracks.sites.copy()

    def restore(self, table: np.ndarray) -> None:
        """Go back to a checkpoint, the ``table`` of all sites by their numbers."""
        known = self.tracks.sites["number"] >= 0
        self.tracks.sites[known] = table[self.tracks.sites["number"][known]]
        self.contacts[known] = self.tracks.sites["site"][known]
