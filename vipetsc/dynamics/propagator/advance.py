"""Compiled advance of a cluster of contact sites through one linear step, from change to change.

A step (sec. 4 of the derivation in the package's docstring) is a chain of substeps: collocate one of a length that
seems right (sec. 3), search it for the first time at which a site changes its mode, and if there is one, repeat the
substep so that it ends there, since the force law inside a substep must be smooth. Then judge its error, take it or try
a shorter one. ``advance_cluster`` returns at each change, where its caller ``clusters.follow_contacts`` switches the
site, and at the end of the step. While no site is closed, no drive is on and there is no nonlinear spring, the motion
is a polynomial and the cluster goes to its first onset at once (sec. 2). Contacts that touch or are pressed at rest,
of mode ``UNSWITCHED``, change no mode; substeps end where they open or close, too, on a *kink* of
their force, but without a landing: a kink that lies a little inside the end hardly changes the force's integral.

Positions and lengths are in units of the step H: a substep's ``length``, a cluster's ``position``. The ``position`` of
a change is a fraction of the substep that was searched. 2 stands for none, since no position exceeds 1.

**Blind substeps.** Rounding may show the search a change at the very start of a substep, where the site has just
landed, though its switching function does not rise there. That is no change, but a search of any substep from there
would find it again. The next substep is therefore taken without a search, and so short (``BLIND``) that a site which
does change in it is found beyond its switching point at the start of the one after.

**Rest.** A site can come to its stop again before it has left the tolerance of its last landing: the front of a wave
passes through all magnitudes below that tolerance, and each of its roots would be landed on and switched. Such a site
is to rest: the advance ends with ``RESTS`` in place of ``CHANGED``. So is one with a
change at the very start of a substep, but the first in a step may be an accident of rounding: it rests from the second
one on (``may_rest``). ``vipetsc.contact`` says what force a site at rest has and when it leaves.
"""

import numpy as np

from vipetsc.compiled import inlined, kernel
from vipetsc.contact.changes import Extremes, ModeChange, extremes, first_change, stays_landed, switching
from vipetsc.contact.law import CLOSED, STUCK, UNSWITCHED, begins_linearly, contact_force, gap_of, side_of
from vipetsc.contact.search import LANDED, MOST_ATTEMPTS, RETRY, SEARCH, Landing, correct, shorten
from vipetsc.contact.tracker import Tracks, in_episode, update_episode
from vipetsc.dynamics.drives import drive_end
from vipetsc.dynamics.propagator.collocation import (
    accumulate_moments,
    collocate,
    error_ratio,
    evaluate_site_motion,
    update_taylor,
)
from vipetsc.dynamics.propagator.nodes import EXIT, NODES, ONSET, PLAIN
from vipetsc.dynamics.propagator.substeps import Cluster, Substep, Trial, first_drive, select_active
from vipetsc.dynamics.propagator.taylor import ROUNDING, copy, first_onset, shift

# How an advance ended: at the end of the step, on a change of modes, on one of a site that is to rest instead, or
# without progress.
DONE, CHANGED, RESTS, FAILED = range(4)

# None of the numbers below is sharp. On the built-in case up to 0.5 s (5,200 substeps tried with Hertz's law, 960 of
# them rejected; 3,000 and 80 with the bilinear one) each was halved and doubled, and ``SAFETY`` set to 0.8 and 0.95.
# The number of substeps changes by 5 % at most, but for half of ``DRIVEN``, which doubles the drive's own 920 substeps;
# ``MOST_SUBSTEPS`` and ``SHORTEST`` change no digit. Displacements differ from those of a run with rtol = 1e-13 by
# 2e-12 to 4e-11 of the largest one, with the bilinear law by 3e-9 to 3e-8, whichever number is varied. So do runs with
# rtol = 1e-12 to 3e-14 from one another: impacts amplify rounding, with that law from 2e-13 at .25 s to 1e-8 at .5 s.
#
# Substeps from one change to the next beyond which a cluster counts as stalled: nearly a thousand times what the
# built-in case takes in a whole step at most, 18, or 22 at 1000 N. ``forces.MOST_CHANGES`` bounds the changes.
MOST_SUBSTEPS = 20_000
# Longest substep where sites are searched for changes, in radians of the sum of the highest frequencies of lattice and
# drives: the quintic that the search sees misses (omega h)^6/46080 of an oscillation's amplitude, 9e-8 at this length.
# A contact may be stiffer and faster than that. Its substeps are bounded by their error; what the quintic misses of
# them can hide two changes that follow each other closely, but no change is placed by it: landings are on the motion.
SEARCHED = 0.4
# ... and without sites: nothing is searched, and eight nodes integrate a drive's sine over 1.25 rad to rounding.
DRIVEN = 1.25
# Longest substep of a contact in ages of the contact. Hertz's force goes as the power 3/2 of the age: plain nodes
# integrate that over 1.5 ages to 3e-14 of it, over 3 ages to 1e-11.
MOST_AGES = 1.5
# A contact is new up to an age of this fraction of the duration in s that was predicted at its onset (``impact_time``).
NEW = 1e-7
# Longest substep, as a fraction of the step, that is taken without a search for changes.
BLIND = 1e-7
# Shortest substep, as a fraction of the step, that is rejected for its error, or halved because a contact both begins
# and ends in it; the shortest that a cut at a kink leaves. That ends the search for an allowed length.
SHORTEST = 1e-9
# Order by which the substep follows its error: the last coefficients fall as h^6 and h^7, and the error is their sum
# times the substep's length. Of the orders 7 and 8 the higher one changes the length less.
ORDER = 8.0
# What of the length that would just be allowed is tried, and bounds of its growth.
SAFETY = 0.9
LEAST_GROWTH = 0.2
MOST_GROWTH = 2.0
# A substep that could not be collocated is repeated at this fraction of its length.
CUT = 0.4
# A landing is good within its tolerance. Newton's steps go on as long as they help, to this fraction of the tolerance,
# which for a site with a clearance is fifty times the rounding of w.
LANDING_GOAL = 0.05


@kernel
def _has_stayed(cluster: Cluster, trial: Trial, site: int, length: float) -> bool:
    """Return whether a ``site`` has stayed within the tolerance of a landing in a substep of that ``length``."""
    # Without a length nothing was tried: the site is where it was.
    end = cluster.site_motion[site]
    if length > 0.0:
        end = trial.site_motion[site]
    seconds = length * cluster.interval
    return stays_landed(cluster.contacts[site], cluster.site_motion[site], end, seconds, trial.sums.bernstein[0])


@kernel
def _advance_freely(cluster: Cluster) -> tuple[int, int]:
    """Go to the first onset, or to the end of the step, while no force acts; returns what ``advance_cluster`` does."""
    state = cluster.state[0]
    remaining = 1.0 - state.position
    first = 2.0  # the distance to the first onset in units of H, 2 if there is none
    site = -1
    for i in range(cluster.contacts.size):
        onset = first_onset(cluster.taylor[i], cluster.contacts[i], remaining)
        if onset < first:
            first = onset
            site = i
    if first > remaining:
        state.position = 1.0
        return DONE, -1

    trial = cluster.trial
    evaluate_site_motion(cluster, cluster.taylor, cluster.site_motion)
    shift(cluster.taylor, first, cluster.taylor)
    state.position += first
    evaluate_site_motion(cluster, cluster.taylor, trial.site_motion)
    rests = _has_stayed(cluster, trial, site, first)
    copy(trial.site_motion, cluster.site_motion)
    state.landings += 1
    if rests:
        return RESTS, site
    return CHANGED, -1


@inlined
def _choose_substep(cluster: Cluster, trial: Trial) -> Substep:
    """Return the next substep: as long as its error allows, and not beyond a point where a drive is not smooth.

    While a contact is young its force is a root of time: nodes of the kind ``ONSET`` follow it from the onset on, plain
    ones over ``MOST_AGES`` of its age.
    """
    state = cluster.state[0]
    sites = cluster.contacts
    highest = 0.0
    for i in range(first_drive(cluster), cluster.taylor.shape[0]):
        highest = max(highest, cluster.drives.rows[i].highest)
    fastest = cluster.omega_max_h + highest * cluster.interval
    radians = DRIVEN
    if sites.size > 0:
        radians = SEARCHED
    length = min(1.0 - state.position, state.length, radians / fastest)
    # ``active`` has the closed sites, then the springs, then the drives that are on.
    for j in range(trial.closed.size + trial.springs.size, trial.active.size):
        end = drive_end(cluster.drives, trial.active[j], state.begin, cluster.interval, state.position)
        length = min(length, end - state.position)

    longest = length
    for i in trial.closed:
        # Forces that begin linearly are smooth from the onset on.
        if not begins_linearly(sites[i].elastic) and abs(sites[i].mode) == CLOSED:
            age = (state.begin - cluster.history[i].onset) / cluster.interval + state.position
            if age * cluster.interval <= NEW * cluster.history[i].duration:
                # These nodes suit this contact at any length. Another contact that is young as well limits the length
                # by the error of the substep alone.
                return Substep(ONSET, longest)
            length = min(length, MOST_AGES * age)
    return Substep(PLAIN, length)


@inlined
def _try_substep(cluster: Cluster, trial: Trial, substep: Substep) -> bool:
    """Compute a substep and leave its end in ``trial``; whether it could be collocated."""
    if not collocate(cluster, trial, substep):
        return False
    update_taylor(cluster, trial, substep)
    state = cluster.state[0]
    # Drives are evaluated at the cluster's position, which is the substep's end for this call. Taking the length off
    # again may leave a rounding error in it.
    state.position += substep.length
    evaluate_site_motion(cluster, trial.taylor, trial.site_motion)
    state.position -= substep.length
    return True


@kernel
def _first_kink(cluster: Cluster, trial: Trial, length: float) -> float:
    """Return position, as a fraction of a substep tried, of the first kink; 2 if none or another change comes first."""
    has_unswitched = False
    for i in trial.closed:
        has_unswitched |= abs(cluster.contacts[i].mode) == UNSWITCHED
    if not has_unswitched:
        return 2.0
    seconds = length * cluster.interval
    contacts = cluster.contacts
    first = first_change(contacts, cluster.site_motion, trial.site_motion, seconds, trial.sums.bernstein, True)
    if first.position <= 1.0 and abs(contacts[first.site].mode) == UNSWITCHED:
        return first.position
    return 2.0


@inlined
def _end_on_kink(cluster: Cluster, trial: Trial, substep: Substep) -> Substep:
    """Repeat a substep just tried so that it ends where an unswitched contact first opens or closes inside it.

    Returns the substep that is now in ``trial``; its length is negative if it could not be collocated.
    """
    state = cluster.state[0]
    # The shorter substep has a slightly other motion, in which the kink may lie a little before its end: once or twice
    # is enough. A kink that remains inside after all attempts is left to the control of the error.
    for _ in range(MOST_ATTEMPTS):
        fraction = _first_kink(cluster, trial, substep.length)
        if fraction > 1.0 or fraction * substep.length < SHORTEST:
            return substep
        substep = Substep(substep.kind, fraction * substep.length)
        if not _try_substep(cluster, trial, substep):
            state.rejected += 1
            state.length = CUT * substep.length
            return Substep(substep.kind, -1.0)
    if _first_kink(cluster, trial, substep.length) <= 1.0:
        state.missed += 1
    return substep


@kernel
def _land(cluster: Cluster, trial: Trial, substep: Substep, change: ModeChange) -> tuple[float, bool]:
    """Repeat a substep so that it ends on a ``change``.

    Returns its length, with a minus sign if it could not be collocated, and whether it ends on the change. Without a
    change at its end the substep is valid all the same, and has none inside.
    """
    contacts = cluster.contacts
    site = change.site
    h = cluster.interval
    landing = Landing(length=change.position * substep.length, longest=substep.length, residual=np.inf, attempts=0)
    while True:
        if landing.length <= ROUNDING:
            begin = switching(contacts, site, change.function, cluster.site_motion[site])
            is_met = begin.value > begin.tolerance or (begin.value >= -begin.tolerance and begin.rate > 0.0)
            return 0.0, is_met
        if not _try_substep(cluster, trial, Substep(substep.kind, landing.length)):
            return -landing.length, False

        end = switching(contacts, site, change.function, trial.site_motion[site])
        landing, outcome = correct(landing, end.value, end.rate * h, end.tolerance, LANDING_GOAL * end.tolerance)
        if outcome == SEARCH:
            # Newton's method comes no nearer. The first change in the repeated substep, of this site or another, bounds
            # the length on which this site's change is sought further; another's is met at the start of the next
            # substep. If there is none, the change was a near miss of the quintic: the substep is taken up to here.
            seconds = h * landing.length
            earlier = first_change(contacts, cluster.site_motion, trial.site_motion, seconds, trial.sums.bernstein)
            if earlier.position > 1.0:
                return landing.length, False
            landing = shorten(landing, earlier.position)
        elif outcome != RETRY:
            cluster.state[0].missed += outcome != LANDED
            return landing.length, outcome == LANDED


@inlined
def _search_and_land(cluster: Cluster, trial: Trial, substep: Substep) -> tuple[Substep, bool, int]:
    """Search a substep just tried, and land on its first change if there is one.

    Returns the substep to be taken, whether it ends on the change, and the site of the change, else -1. A substep of
    negative length is to be tried again with ``state.length``.
    """
    state = cluster.state[0]
    seconds = cluster.interval * substep.length
    change = first_change(cluster.contacts, cluster.site_motion, trial.site_motion, seconds, trial.sums.bernstein)
    if change.position > 1.0:
        return substep, False, -1

    # The switching function 0 of a closed site is that of separation (``contact.changes``).
    site = cluster.contacts[change.site]
    separates = not begins_linearly(site.elastic) and abs(site.mode) == CLOSED and change.function == 0
    if separates and substep.kind == ONSET and substep.length > SHORTEST:
        # The force begins and ends as a power 3/2. ONSET nodes suit its beginning, EXIT nodes its end: with half the
        # length each gets a substep of its own.
        state.length = 0.5 * change.position * substep.length
        return Substep(ONSET, -1.0), False, -1
    kind = substep.kind
    if separates:
        kind = EXIT
    state.landings += 1
    taken, landed = _land(cluster, trial, Substep(kind, substep.length), change)
    if taken < 0.0:
        state.rejected += 1
        state.length = -CUT * taken
    return Substep(kind, taken), landed, change.site


@inlined
def _control_length(cluster: Cluster, trial: Trial, taken: float, landed: bool) -> bool:
    """Set the next substep's length by the error of the one ``taken``, its length; whether the error is allowed."""
    state = cluster.state[0]
    ratio = error_ratio(cluster, trial, taken)
    factor = min(max(SAFETY * (1.0 / max(ratio, 1e-30)) ** (1.0 / ORDER), LEAST_GROWTH), MOST_GROWTH)
    # One of the shortest length is taken whatever its error.
    if ratio > 1.0 and taken > SHORTEST:
        state.rejected += 1
        state.length = factor * taken
        return False
    state.forced += ratio > 1.0
    # A substep that was cut short, by the end of the step say, is no reason for a shorter one after it. After a landing
    # a site has another mode, for which this error says nothing.
    if not landed and trial.closed.size + trial.springs.size > 0:
        was_cut_short = taken < state.length
        if not was_cut_short or factor * taken > state.length:
            state.length = factor * taken
    return True


@kernel
def _update_episode(cluster: Cluster, tracks: Tracks, trial: Trial, i: int, seconds: float, kind: int) -> None:
    """Update the open episode of site ``i`` by a substep of so many ``seconds`` and a ``kind`` of nodes."""
    if not in_episode(cluster.contacts[i].mode):
        return
    start = cluster.site_motion[i]
    end = trial.site_motion[i]
    episode = tracks.sites[i].episode
    side = side_of(cluster.contacts[i].mode)
    if abs(cluster.contacts[i].mode) == STUCK:
        episode.force = max(episode.force, max(start[0], end[0]))
        for node in range(NODES):
            episode.impulse -= seconds * cluster.nodes.weight[kind, node] * side * trial.force[i, node]
        return
    depth = max(side * start[0], side * end[0]) - gap_of(cluster.contacts[i], side)
    first = side * contact_force(cluster.contacts, i, start[0], start[1])[0]
    last = side * contact_force(cluster.contacts, i, end[0], end[1])[0]
    force = max(first, last)

    smallest = min(first, last)
    largest = max(first, last)
    for node in range(NODES):
        inside = -side * (trial.force[i, node] - cluster.contacts[i].preload)
        smallest = min(smallest, inside)
        largest = max(largest, inside)
        episode.impulse += seconds * cluster.nodes.weight[kind, node] * inside
    # The costly search within the substep only where a turn lies inside.
    if largest > force or (side * start[1] > 0.0 and side * end[1] < 0.0):
        depth, force, smallest, _ = extremes(cluster.contacts, i, cluster.site_motion, trial.site_motion, seconds)
    update_episode(cluster.contacts, tracks, i, Extremes(depth, force, smallest, 0.0))


@inlined
def _take(cluster: Cluster, tracks: Tracks, trial: Trial, substep: Substep) -> None:
    """Take the substep of ``trial`` with its moments, energies and episodes; the cluster then stands at its end."""
    state = cluster.state[0]
    accumulate_moments(cluster, trial, substep)
    for i in trial.closed:
        _update_episode(cluster, tracks, trial, i, cluster.interval * substep.length, substep.kind)
    state.position += substep.length
    copy(trial.taylor, cluster.taylor)
    copy(trial.site_motion, cluster.site_motion)


@kernel
def advance_cluster(cluster: Cluster, tracks: Tracks, may_rest: bool) -> tuple[int, int]:
    """Advance a cluster, with the ``tracks`` of its sites, to the first change of modes or to the step's end.

    Returns how it ended, and a site or -1. ``DONE``: at the step's end. ``CHANGED``: the cluster stands on a change of
    modes, and the caller switches the sites whose switching functions say so; the site is one that changes again before
    it has moved from where it last landed. ``RESTS``: that site is to rest instead. At a substep's very beginning this
    needs ``may_rest``, or a second such change. ``FAILED``: no progress.
    """
    state = cluster.state[0]
    room = cluster.trial
    # The workspace has served other clusters before, and which ones depends on the rank. The iteration begins from
    # zero, so that the bits do not depend on the number of ranks.
    room.force[:] = 0.0
    room.w[:] = 0.0
    room.v[:] = 0.0
    blind = False
    for _ in range(MOST_SUBSTEPS):
        if 1.0 - state.position <= ROUNDING:
            state.position = 1.0
            return DONE, -1
        trial = select_active(cluster)
        if trial.active.size == 0:
            return _advance_freely(cluster)

        evaluate_site_motion(cluster, cluster.taylor, cluster.site_motion)
        substep = _choose_substep(cluster, trial)
        if blind:
            substep = Substep(substep.kind, min(substep.length, BLIND))
        state.substeps += 1
        if not _try_substep(cluster, trial, substep):
            state.rejected += 1
            state.length = CUT * substep.length
            if substep.length < ROUNDING:
                return FAILED, -1
            continue

        substep = _end_on_kink(cluster, trial, substep)
        if substep.length < 0.0:
            continue
        landed = False
        site = -1
        if not blind:
            substep, landed, site = _search_and_land(cluster, trial, substep)
            if substep.length < 0.0:
                continue

        if site >= 0 and not _has_stayed(cluster, trial, site, substep.length):
            site = -1

        # A change at the very start at which the switching function does not rise is none: the next substep is blind.
        leads_nowhere = substep.length == 0.0 and not landed
        if leads_nowhere and site >= 0:
            if may_rest:
                return RESTS, site
            may_rest = True
        if substep.length > 0.0:
            # Judged only now: a force continued beyond its end is no smooth function.
            if not _control_length(cluster, trial, substep.length, landed):
                continue
            _take(cluster, tracks, trial, substep)
        # A substep that was rejected is repeated without a search, too.
        blind = leads_nowhere
        if landed:
            if site >= 0 and (may_rest or substep.length > 0.0):
                return RESTS, site
            return CHANGED, site
    return FAILED, -1
