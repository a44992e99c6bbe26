"""Modes of sites over time, compiled: switching at located changes, and the log of impacts.

Engines locate the instants at which a contact opens or closes (``contact.changes``) and end a step there. The tracker
then gives the site its new mode, and keeps the log of contact episodes. An episode begins where a site closes; the
largest indentation and force of every step update it; where the site opens it is written to the log.

A rigid site that lands is struck: the tracker says by which impulse, and whether the site flies on or is stuck; the
engine adds the impulse to its motion. Several rigid sites that have one mass in common may be struck at one instant,
one after the other by their numbers until none approaches.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.contact.changes import MOVED, RELEASED, Extremes, extremes, shortest_beginning, shortest_impact, switching
from vipetsc.contact.law import (
    CLOSED,
    FREE,
    RESTING,
    STUCK,
    UNSWITCHED,
    elastic_energy,
    elastic_force,
    elastic_force_and_slope,
    gap_of,
    landed_side,
    side_of,
)
from vipetsc.contact.together import join, solve

# What is counted of each site: landings on the clearance without an onset, onsets below the floor of the approach
# velocity, contacts that separated while clipped, and contacts that pulled.
LIMITS = ("grazes", "floored", "clipped", "pulled")
# Blows of all sites at one instant beyond which the run fails.
MOST_BLOWS = 20_000_000
# Rounds of blows after which stuck sites come to rest together, where all of their impulses push. Blow by blow a row of
# n stuck masses would come to the same after some 3 n^3.
ROUNDS = 8
# Of several sites that are struck at one instant one that approaches at less than this fraction of the fastest speed is
# at rest: without restitution, or in a row of stuck masses, speeds fall by a fraction from blow to blow.
SLOW = 1e-13
COUNTS = np.dtype([(name, np.int64) for name in LIMITS])
_REALS = ("onset", "approach_velocity", "separation", "indentation", "force", "impulse", "loss")
EPISODE = np.dtype([("site", np.int64), ("side", np.int64), *((name, np.float64) for name in _REALS)])
"""One contact of one site: 0-based site, side (+1, -1), times of ``onset`` and ``separation`` in s.

The ``approach_velocity`` is in m/s, the largest ``indentation`` in m, the largest ``force`` in N; ``impulse`` is the
integral of the force in N s, positive where the contact pushes; ``loss`` is the energy in J that the contact has
dissipated. An impact on a rigid stop takes no time: its separation is its onset, unless the site sticks; indentation
and force are 0, but for the reaction of a stuck site.
"""
TRACKED = np.dtype(
    [
        ("number", np.int64),
        ("mode", np.int64),
        ("approach", np.float64),
        ("counts", COUNTS),
        ("pulls", bool),
        ("episode", EPISODE),
    ]
)
"""A site: its ``number`` in the log, its ``counts`` of ``LIMITS``, and its open ``episode``, whose separation is NaN.

``pulls`` says whether the contact has pulled in this episode, since an episode is counted once. ``mode`` and
``approach`` (w'_minus in m/s) are set in a checkpoint alone; a running simulation has them in its ``SITE``. The
``episode`` of a free site is the last one, and means nothing.
"""


class Tracks(NamedTuple):
    """``sites`` (site,) of dtype ``TRACKED``; the first ``closed[0]`` rows of ``log`` are episodes that have ended."""

    sites: np.ndarray
    log: np.ndarray
    closed: np.ndarray


@kernel
def in_episode(mode: int) -> bool:
    """Return whether a site of this ``mode`` is in a contact that is logged: neither free nor at rest in contact."""
    return mode != FREE and abs(mode) != RESTING


@kernel
def with_room(tracks: Tracks) -> Tracks:
    """Return ``tracks`` with room in the log for an episode of every site."""
    used = tracks.closed[0]
    wanted = used + tracks.sites.size
    if wanted <= tracks.log.size:
        return tracks
    # Twice what is wanted: however many episodes there are, the log is copied a few times only.
    log = np.empty(2 * wanted, tracks.log.dtype)
    for i in range(used):
        log[i] = tracks.log[i]
    return Tracks(tracks.sites, log, tracks.closed)


@kernel
def update_episode(contacts: np.ndarray, tracks: Tracks, i: int, reached: Extremes) -> None:
    """Update the open episode of site ``i`` of ``contacts`` (site,) with the extremes ``reached`` in an interval."""
    track = tracks.sites[i]
    site = contacts[i]
    episode = track.episode
    episode.indentation = max(episode.indentation, reached.indentation)
    episode.force = max(episode.force, reached.force)

    # A landing ends within a tolerance of w = D. There the law, continued beyond its limit, has a small force that
    # pulls, which is the error of the landing. Only a larger one counts: at x = -tolerance the pull is at most
    # f(tolerance) (1 + c), since g is at most 1 + c.
    pull = -reached.smallest_force
    before_onset = (1.0 + site.damping) * elastic_force(site.elastic, site.tolerance)
    if pull > 0.0 and not track.pulls and pull > before_onset:
        track.pulls = True
        track.counts.pulled += 1


@kernel
def hold_episode(episode: Any, start: np.ndarray, end: np.ndarray, h: float) -> None:
    """Update the open ``episode`` of a stuck site with ``h`` seconds from ``start`` to ``end`` (3,): R, R', 0."""
    episode.force = max(episode.force, max(start[0], end[0]))
    # The integral of the cubic with these values and rates.
    episode.impulse += 0.5 * h * (start[0] + end[0]) + h * h / 12.0 * (start[1] - end[1])


@kernel
def _force_and_rate(site: Any, side: float, motion: np.ndarray) -> tuple[float, float]:
    """Return the force in N of a ``site`` that touches at rest, and its rate in N/s, at its ``motion`` (3,)."""
    x = side * motion[0] - gap_of(site, side)
    if x <= 0.0:
        return 0.0, 0.0
    force, slope = elastic_force_and_slope(site.elastic, x)
    return force, slope * side * motion[1]


@kernel
def update_episodes(contacts: np.ndarray, tracks: Tracks, start: np.ndarray, end: np.ndarray, h: float) -> bool:
    """Update all open episodes with a step of ``h`` seconds between the motions ``start`` and ``end`` (sites, 3).

    Returns whether there are any.
    """
    any_open = False
    for i in range(contacts.size):
        side = side_of(contacts[i].mode)
        turns = side * start[i, 1] > 0.0 > side * end[i, 1]
        if abs(contacts[i].mode) == STUCK:
            hold_episode(tracks.sites[i].episode, start[i], end[i], h)
        elif abs(contacts[i].mode) == UNSWITCHED and not turns:
            # The depth is largest at an end of the step, and its start was the end of the last step. A search for
            # extremes would cost as much as the step where thousands of beads touch all the time.
            episode = tracks.sites[i].episode
            episode.indentation = max(episode.indentation, side * end[i, 0] - gap_of(contacts[i], side))
            first, first_rate = _force_and_rate(contacts[i], side, start[i])
            last, last_rate = _force_and_rate(contacts[i], side, end[i])
            episode.force = max(episode.force, last)
            # The integral of the cubic with these forces and rates.
            episode.impulse += 0.5 * h * (first + last) + h * h / 12.0 * (first_rate - last_rate)
        elif in_episode(contacts[i].mode):
            reached = extremes(contacts, i, start, end, h)
            update_episode(contacts, tracks, i, reached)
            tracks.sites[i].episode.impulse += reached.impulse
        any_open |= in_episode(contacts[i].mode)
    return any_open


@kernel
def _is_unresolved(site: Any, motion: np.ndarray, t: float) -> bool:
    """Return whether an impact on a ``site`` with this ``motion`` (3,) at ``t`` in s is within the resolution.

    By its energy it ends within the tolerance of its landing, and its rebound in the range of a site at rest: it comes
    back there under the acceleration of now, or is so slow that it would take longer than the run so far to leave it.
    """
    rate = abs(motion[1])
    if 0.5 * site.reduced_mass * rate * rate > elastic_energy(site.elastic, site.tolerance):
        return False
    return min(0.5 * rate * rate / abs(motion[2]), rate * t) <= MOVED * site.tolerance


@kernel
def switch_sites(
    contacts: np.ndarray, tracks: Tracks, motion: np.ndarray, energies: np.ndarray, impulses: np.ndarray, t: float
) -> int:
    """Switch every site that has landed at time ``t`` in s; returns how many. The log must have room.

    ``impulses`` (sites,) in N s get what strikes the hosts of rigid sites at this instant, and their resonators the
    other way; the rows of ``motion`` of rigid sites are overwritten by what follows.
    ``motion`` (sites, 3) holds w, w', w''. ``energies`` (sites,) in J are what each site has dissipated so far.
    """
    switched = 0
    any_rigid = False
    for i in range(contacts.size):
        impulses[i] = 0.0
        if contacts[i].rigid:
            any_rigid = True
            continue
        # A step may end on the kink of an unswitched contact, whose mode stays.
        if abs(contacts[i].mode) == UNSWITCHED:
            continue
        for function in range(2):
            value, rate, tolerance, mode = switching(contacts, i, function, motion[i])
            if value < -tolerance:
                continue
            # Within the tolerance the value's sign is an error of the landing: the rate tells where the site goes.
            if rate <= 0.0 and value <= tolerance:
                if contacts[i].mode == FREE:
                    tracks.sites[i].counts.grazes += 1
                continue
            if contacts[i].mode == FREE and _is_unresolved(contacts[i], motion[i], t):
                mode = side_of(mode) * RESTING
            _set_mode(contacts, tracks, i, mode, motion[i], energies, t)
            switched += 1
            break
    if any_rigid:
        switched += _switch_rigid_sites(contacts, tracks, motion, energies, impulses, t, -1)
    return switched


@kernel
def _switch_rigid_sites(
    contacts: np.ndarray,
    tracks: Tracks,
    motion: np.ndarray,
    energies: np.ndarray,
    impulses: np.ndarray,
    t: float,
    resting: int,
) -> int:
    """Return release rigid sites that are pulled, strike those that approach their stops; see ``switch_sites``.

    The site ``resting``, if it is not -1, has landed on a stop and sticks there, however it moves.
    """
    switched = 0
    for i in range(contacts.size):
        site = contacts[i]
        if site.rigid and abs(site.mode) == STUCK:
            value, _, tolerance, _ = switching(contacts, i, 0, motion[i])
            side = side_of(site.mode)
            if value >= -tolerance:
                site.mode = FREE
                switched += 1
            # From here on the row has the motion: without its reaction a stuck site would have the acceleration R/mu.
            motion[i, 2] = side * motion[i, 0] / site.reduced_mass
            motion[i, 0] = side * gap_of(site, side)
            motion[i, 1] = 0.0

    if resting >= 0:
        side = landed_side(contacts[resting], motion[resting, 0])
        _strike(contacts, tracks, resting, side, motion, energies, impulses, t, True)
    switched += _strike_sites(contacts, tracks, motion, energies, impulses, t)

    # Episodes of sites that are free again are over, those of an impact without duration among them.
    for i in range(contacts.size):
        episode = tracks.sites[i].episode
        if contacts[i].rigid and contacts[i].mode == FREE and np.isnan(episode.separation):
            episode.separation = t
            episode.loss += energies[i]
            if episode.impulse > _least_impulse(contacts[i]):
                tracks.log[tracks.closed[0]] = episode
                tracks.closed[0] += 1
    return switched


@kernel
def _least_impulse(site: Any) -> float:
    """Return the impulse in N s below which the contact of a rigid ``site`` is no impact.

    At a stop without clearance a site sticks before the front of a wave arrives; if that pulls, nothing has happened.
    """
    return RELEASED * site.reduced_mass * abs(site.approach)


@kernel
def _approached_side(site: Any, w: float, rate: float) -> int:
    """Return the side, 1 or -1, of the stop that a rigid ``site`` at ``w`` in m hits at ``rate``, else 0."""
    if site.mode != FREE:
        side = side_of(site.mode)
        return side if side * rate > 0.0 else 0
    for side in (1, -1):
        if side * rate > 0.0 and side * w - gap_of(site, side) >= -site.tolerance:
            return side
    return 0


@kernel
def _strike_sites(
    contacts: np.ndarray, tracks: Tracks, motion: np.ndarray, energies: np.ndarray, impulses: np.ndarray, t: float
) -> int:
    """Strike rigid sites that approach, one after the other by number until none does; returns the number of blows.

    Where they do not come to an end the impulses are NaN, so that the engine ends the run.
    """
    slow = 0.0
    for i in range(contacts.size):
        if contacts[i].rigid and _approached_side(contacts[i], motion[i, 0], motion[i, 1]) != 0:
            slow = max(slow, SLOW * abs(motion[i, 1]))

    blows = 0
    rounds = 0
    is_calm = False
    while not is_calm and blows < MOST_BLOWS:
        is_calm = True
        rounds += 1
        if rounds % ROUNDS == 0:
            blows += _stop_together(contacts, tracks, motion, energies, impulses, slow)
        for i in range(contacts.size):
            site = contacts[i]
            if not site.rigid:
                continue
            side = _approached_side(site, motion[i, 0], motion[i, 1])
            if side != 0 and abs(motion[i, 1]) > slow:
                _strike(contacts, tracks, i, side, motion, energies, impulses, t, False)
                blows += 1
                # One site alone needs no second look.
                is_calm &= not site.shares
            elif abs(site.mode) == STUCK and side_of(site.mode) * motion[i, 1] < -slow:
                # The blow on another site has thrown the masses apart.
                site.mode = FREE
    if not is_calm:
        impulses[:] = np.nan
        return blows

    # What still approaches is at rest: it would be struck again at the beginning of the next step, for ever.
    is_calm = False
    while not is_calm:
        is_calm = True
        for i in range(contacts.size):
            site = contacts[i]
            if site.rigid and site.shares and site.mode == FREE:
                side = _approached_side(site, motion[i, 0], motion[i, 1])
                if side != 0:
                    _strike(contacts, tracks, i, side, motion, energies, impulses, t, True)
                    is_calm = False
    return blows


@kernel
def _stop_together(
    contacts: np.ndarray, tracks: Tracks, motion: np.ndarray, energies: np.ndarray, impulses: np.ndarray, slow: float
) -> int:
    """Stop all stuck sites at once, w' = 0, if none parts and all of their impulses push; returns how many were struck.

    Speeds up to ``slow`` in m/s count as 0.
    """
    count = 0
    for i in range(contacts.size):
        if contacts[i].rigid and abs(contacts[i].mode) == STUCK:
            if side_of(contacts[i].mode) * motion[i, 1] < -slow:
                return 0
            count += 1
    stuck = np.empty(count, np.int64)
    rates = np.empty(count)
    k = 0
    for i in range(contacts.size):
        if contacts[i].rigid and abs(contacts[i].mode) == STUCK:
            stuck[k] = i
            rates[k] = motion[i, 1]
            k += 1

    solve(join(contacts, stuck), rates)
    for k in range(count):
        site = contacts[stuck[k]]
        if side_of(site.mode) * rates[k] < -slow * site.reduced_mass:
            return 0
    for k in range(count):
        i = stuck[k]
        energies[i] += 0.5 * rates[k] * motion[i, 1]
        tracks.sites[i].episode.impulse += side_of(contacts[i].mode) * rates[k]
    # Only then: each push changes the rates of the others.
    for k in range(count):
        _push(contacts, stuck[k], rates[k], motion, impulses)
    for k in range(count):
        motion[stuck[k], 1] = 0.0
    return count


@kernel
def _strike(
    contacts: np.ndarray,
    tracks: Tracks,
    i: int,
    side: int,
    motion: np.ndarray,
    energies: np.ndarray,
    impulses: np.ndarray,
    t: float,
    rests: bool,
) -> None:
    """Strike the rigid site ``i`` at its stop on a ``side``: an impulse, an episode, and a new mode.

    It flies on, or sticks where its flight would be too short or too low, and in any case if it ``rests``.
    """
    site = contacts[i]
    speed = side * motion[i, 1]
    pressing = side * motion[i, 2]
    rebound = site.restitution * speed
    # Its next flight is too short, or does not leave the tolerance of its landing.
    is_brief = 2.0 * rebound <= site.flight * pressing
    is_low = 0.5 * rebound * rebound <= site.tolerance * pressing
    sticks = rests or (pressing >= 0.0 and (is_brief or is_low))
    if not sticks and pressing < 0.0 and 0.5 * speed * speed <= -pressing * site.tolerance:
        # It would turn by itself within the tolerance of its landing: no impact, and no loss.
        tracks.sites[i].counts.grazes += 1
        _push(contacts, i, side * 2.0 * site.reduced_mass * speed, motion, impulses)
        motion[i, 1] = -side * speed
        return

    if sticks:
        rebound = 0.0
    impulse = site.reduced_mass * (speed + rebound)
    _begin_blow(tracks.sites[i], side, motion[i, 1], energies[i], t)
    tracks.sites[i].episode.impulse += impulse
    energies[i] += 0.5 * impulse * (speed - rebound)
    _push(contacts, i, side * impulse, motion, impulses)
    motion[i, 1] = -side * rebound
    site.mode = FREE
    if sticks:
        site.mode = side * STUCK


@kernel
def _begin_blow(track: Any, side: int, rate: float, energy: float, t: float) -> None:
    """Begin the episode of a rigid site that is struck at ``t`` in s, unless one is open: stuck, or struck just now.

    ``rate`` in m/s is w' before the blow, ``energy`` in J what the site has dissipated up to now.
    """
    episode = track.episode
    if np.isnan(episode.separation):
        return
    episode.site = track.number
    episode.side = side
    episode.onset = t
    episode.approach_velocity = rate
    episode.separation = np.nan
    episode.indentation = 0.0
    episode.force = 0.0
    episode.impulse = 0.0
    episode.loss = -energy


@kernel
def _push(contacts: np.ndarray, i: int, impulse: float, motion: np.ndarray, impulses: np.ndarray) -> None:
    """Add an ``impulse`` in N s to the host of site ``i``, and the opposite one to its resonator.

    It changes the rates w' in ``motion`` (site, 3) of the other rigid sites on these masses; the caller sets its own.
    """
    struck = contacts[i]
    impulses[i] += impulse
    if not struck.shares:
        return
    for j in range(contacts.size):
        site = contacts[j]
        if j == i or not site.rigid:
            continue
        for sign, mass in ((-1.0, site.host), (1.0, site.resonator)):
            if mass == struck.host:
                motion[j, 1] += sign * impulse * struck.host_inverse
            if mass == struck.resonator:
                motion[j, 1] -= sign * impulse * struck.resonator_inverse


@kernel
def rest_site(
    contacts: np.ndarray,
    tracks: Tracks,
    i: int,
    motion: np.ndarray,
    energies: np.ndarray,
    impulses: np.ndarray,
    t: float,
) -> bool:
    """Let site ``i`` rest in contact if it has landed on a stop; returns whether it does. A rigid one is stuck then.

    ``contacts`` (site,) are of dtype ``SITE``; ``motion`` (site, 3) has w, w' and w'' at the time ``t`` in s, and
    ``energies`` (site,) in J are the ledger's, which change as in ``switch_sites``, and ``impulses`` (site,) what
    strikes hosts. The log must have room. Why sites rest: see the package's docstring.
    """
    impulses[:] = 0.0
    site = contacts[i]
    side = landed_side(site, motion[i, 0])
    if side == 0 or abs(site.mode) >= UNSWITCHED:
        return False
    if site.rigid:
        _switch_rigid_sites(contacts, tracks, motion, energies, impulses, t, i)
        return True
    _set_mode(contacts, tracks, i, side * RESTING, motion[i], energies, t)
    return True


@kernel
def _approach_speed(site: Any, side: int, w: float, rate: float) -> float:
    """Return the speed in m/s with which two masses alone come from the clearance of a ``site`` to ``w`` at ``rate``.

    They do so without loss, so that mu (w'_minus^2 - w'^2)/2 is the elastic energy at w, mu the reduced mass. A contact
    begins where it has landed, within the tolerance, or beyond it: after rest, or at the beginning of a run.
    """
    stored = elastic_energy(site.elastic, side * w - gap_of(site, side))
    return np.sqrt(rate * rate + 2.0 * stored / site.reduced_mass)


@kernel
def _begin_episode(site: Any, track: Any, w: float, rate: float, t: float, rested: bool) -> None:
    """Begin the episode of a ``site`` that closes at ``w`` in m, w' = ``rate`` in m/s and ``t`` in s.

    ``rested`` says that it closes from rest.
    """
    side = side_of(site.mode)
    speed = _approach_speed(site, side, w, rate)
    # Without the floor a grazing onset would make the factor g unbounded.
    track.counts.floored += speed < site.floor
    site.approach = side * max(speed, site.floor)

    episode = track.episode
    episode.site = track.number
    episode.side = side
    episode.onset = t
    episode.approach_velocity = rate
    if rested:
        episode.approach_velocity = 0.0
    episode.separation = np.nan
    episode.indentation = 0.0
    episode.force = 0.0
    episode.impulse = 0.0


@kernel
def _end_episode(site: Any, track: Any, tracks: Tracks, energy: float, t: float) -> None:
    """Write the episode of a ``site`` whose contact has ended at ``t`` in s to the log, if it was an impact.

    ``energy`` in J is what the site has dissipated from the run's beginning to its separation.
    """
    track.pulls = False
    episode = track.episode
    # A site that comes to rest where it had landed has had no impact.
    if site.mode != FREE and episode.indentation <= site.tolerance:
        return
    episode.separation = t
    episode.loss += energy
    tracks.log[tracks.closed[0]] = episode
    tracks.closed[0] += 1


@kernel
def _set_mode(
    contacts: np.ndarray, tracks: Tracks, i: int, mode: int, motion: np.ndarray, energies: np.ndarray, t: float
) -> None:
    """Give site ``i`` its new ``mode`` at its ``motion`` (3,) and the time ``t`` in s; begin or end its episode.

    ``energies`` (site,) in J are the ledger's, as in ``switch_sites``.
    """
    site = contacts[i]
    track = tracks.sites[i]
    had_episode = in_episode(site.mode)
    rested = abs(site.mode) == RESTING

    energy = energies[i]
    site.mode = mode
    if not had_episode and in_episode(mode):
        _begin_episode(site, track, motion[0], motion[1], t, rested)
        # The loss of an episode is the difference of ``energy`` between its end and its beginning.
        track.episode.loss = -energy
    elif had_episode and not in_episode(mode):
        # A force that has been cut off at zero is zero up to the separation, unless others turn the masses round.
        track.counts.clipped += site.clip and site.damping * motion[1] / site.approach < -1.0
        _end_episode(site, track, tracks, energy, t)


class ImpactTracker:
    """Switches the modes of ``contacts`` at located changes and logs every episode.

    ``before`` and ``after`` (sites, 3) hold w, w', w'' at both ends of the step at hand; the engine fills them.
    ``numbers`` (sites,) are those of the sites in the log, from 0, or -1 for none.
    """

    def __init__(self, contacts: np.ndarray, numbers: Sequence[int]) -> None:
        self.contacts = contacts
        self.before, self.after = np.zeros((2, len(numbers), 3))
        sites = np.zeros(len(numbers), TRACKED)
        sites["number"] = numbers
        # Whether any episode may be open: false only after a step in which none was, until a mode may change.
        self._may_be_open = True
        self.tracks = Tracks(sites, log=np.zeros(2 * len(sites), EPISODE), closed=np.zeros(1, np.int64))
        # What has struck the hosts of rigid sites in N s, when sites last switched or came to rest.
        self.impulses = np.zeros(len(sites))

        # Unswitched contacts are in an episode from the start.
        held = np.flatnonzero(np.abs(contacts["mode"]) == UNSWITCHED)
        episodes = sites["episode"]
        episodes["site"][held] = sites["number"][held]
        episodes["side"][held] = np.sign(contacts["mode"][held])
        episodes["separation"][held] = np.nan

    def close_at_start(self, motion: np.ndarray) -> np.ndarray:
        """Close the sites that begin beyond their clearance at t = 0; returns their indices (closed site,).

        ``motion`` (site, 2) has w in m and w' in m/s of all sites by their numbers in the log. The onsets of these
        contacts lie before the run.
        """
        self._may_be_open = True
        sites = self.contacts
        tracked = self.tracks.sites
        numbered = np.flatnonzero(tracked["number"] >= 0)
        w, rate = motion[tracked["number"][numbered]].T
        plus = w - sites["clearance"][numbered]
        minus = -w - sites["clearance_minus"][numbered]
        side = np.where(plus < minus, -1, 1)
        deep = np.maximum(plus, minus)

        # On the clearance itself, to the tolerance of a landing, w' decides.
        near = sites["tolerance"][numbered]
        touching = (deep > near) | ((deep >= -near) & (side * rate > 0))
        closing = touching & (sites["mode"][numbered] == FREE) & ~sites["rigid"][numbered]
        closed = numbered[closing]
        side = side[closing]
        rate = rate[closing]

        law = sites[closed]
        motions = zip(law, side.tolist(), w[closing].tolist(), rate.tolist(), strict=True)
        speed = np.array([_approach_speed(*motion) for motion in motions])
        sites["approach"][closed] = side * np.maximum(speed, law["floor"])
        sites["mode"][closed] = side * CLOSED

        episodes = tracked["episode"]
        episodes["site"][closed] = tracked["number"][closed]
        episodes["side"][closed] = side
        episodes["approach_velocity"][closed] = side * speed
        episodes["separation"][closed] = np.nan
        return closed

    @property
    def counts(self) -> np.ndarray:
        """Number of times that each limit of the contact law acted on each site, of dtype ``COUNTS``."""
        return self.tracks.sites["counts"]

    def contact_time(self) -> float:
        """Return the shortest duration in s of a contact that is closed now, by its approach velocity; inf if none is.

        Of unswitched contacts those count that close at the motion in ``before``, by the velocity there.
        """
        return min(shortest_impact(self.contacts), shortest_beginning(self.contacts, self.before))

    def accept_step(self, h: float) -> None:
        """Take the step of ``h`` seconds as done: update the open episodes; its end is the next one's start."""
        if self._may_be_open:
            self._may_be_open = update_episodes(self.contacts, self.tracks, self.before, self.after, h)
        self.before, self.after = self.after, self.before

    def switch(self, t: float, energies: np.ndarray) -> int:
        """Switch every site that has landed at time ``t`` in s (motion in ``before``); returns how many.

        ``energies`` (sites,) are the ledger's in J, and change as in ``switch_sites``.
        """
        self._may_be_open = True
        self.tracks = with_room(self.tracks)
        return switch_sites(self.contacts, self.tracks, self.before, energies, self.impulses, t)

    def rest(self, number: int, t: float, energies: np.ndarray) -> None:
        """Let the site of that ``number`` in the log rest in contact at ``t`` in s, if this rank has it.

        ``energies`` (sites,) are the ledger's in J, and change as in ``switch_sites``; the motion is ``before``.
        """
        self._may_be_open = True
        self.tracks = with_room(self.tracks)
        self.impulses[:] = 0.0
        for i in np.flatnonzero(self.tracks.sites["number"] == number):
            rest_site(self.contacts, self.tracks, i, self.before, energies, self.impulses, t)

    def take_episodes(self, energies: np.ndarray, unfinished: bool = False) -> np.ndarray:
        """Return the episodes (episode,) of dtype ``EPISODE`` that ended since the last call; ``unfinished`` ones too.

        ``energies`` (sites,) are what the sites have dissipated so far, in J. The separation of an open one is NaN.
        """
        closed = self.tracks.log[: self.tracks.closed[0]].copy()
        self.tracks.closed[:] = 0
        if not unfinished:
            return closed

        modes = self.contacts["mode"]
        in_contact = np.flatnonzero((modes != FREE) & (np.abs(modes) != RESTING))
        impulse = self.tracks.sites["episode"]["impulse"]
        at_rest = [
            i for i in in_contact if self.contacts["rigid"][i] and impulse[i] <= _least_impulse(self.contacts[i])
        ]
        in_contact = np.setdiff1d(in_contact, at_rest)
        still_open = self.tracks.sites["episode"][in_contact]
        still_open["loss"] += energies[in_contact]
        return np.concatenate([closed, still_open])

    def checkpoint(self) -> np.ndarray:
        """Return sites with their modes, counts and episodes (sites,) of dtype ``TRACKED``."""
        sites = self.tracks.sites.copy()
        sites["mode"] = self.contacts["mode"]
        sites["approach"] = self.contacts["approach"]
        return sites

    def restore(self, table: np.ndarray) -> None:
        """Go back to a checkpoint, the ``table`` (site,) of dtype ``TRACKED`` of all sites by their numbers.

        The log is empty then: checkpoints are made where its episodes have been taken.
        """
        self._may_be_open = True
        self.tracks.closed[:] = 0
        numbered = self.tracks.sites["number"] >= 0
        sites = table[self.tracks.sites["number"][numbered]]
        self.tracks.sites[numbered] = sites
        self.contacts["mode"][numbered] = sites["mode"]
        self.contacts["approach"][numbered] = sites["approach"]
