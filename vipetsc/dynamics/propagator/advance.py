"""Compiled advance of a cluster of contact sites through one linear step, from change to change.

Sec. 2 to 4 of the derivation in the package's docstring.
"""

import numpy as np

from vipetsc.compiled import inlined, kernel
from vipetsc.contact.changes import Change, extremes, first_change, switching
from vipetsc.contact.law import CLOSED, FREE, begins_linearly, contact_force, gap_of
from vipetsc.contact.search import LANDED, MOST_ATTEMPTS, RETRY, SEARCH, Landing, correct, shorten
from vipetsc.dynamics.drives import drive_end
from vipetsc.dynamics.propagator.collocation import (
    Cluster,
    Substep,
    Trial,
    accumulate_moments,
    collocate,
    error_ratio,
    evaluate_site_motion,
    update_taylor,
)
from vipetsc.dynamics.propagator.kinks import first_kink
from vipetsc.dynamics.propagator.nodes import EXIT, NODES, ONSET, PLAIN
from vipetsc.dynamics.propagator.series import ROUNDING, copy, first_onset, shift

# How an advance ended: at the end of the step, on a change of modes, or without progress.
DONE, CHANGED, FAILED = range(3)

MOST_SUBSTEPS = 20_000
# Longest substeps in radians of the fastest oscillation: searched for changes; only driven.
SEARCHED, DRIVEN = 0.4, 1.25
# Longest substep of a contact in ages of the contact.
MOST_AGES = 1.5
# Share of a step that is too short for anything to happen.
BLIND = 1e-7
# Shortest substep, as a share of the step, that is rejected for its error or cut for an onset.
SHORTEST = 1e-9
# Order by which the substep follows its error, and bounds of its growth.
ORDER = 8.0
LEAST_GROWTH, MOST_GROWTH = 0.2, 2.0
# A substep that could not be collocated is repeated at this share of its length.
CUT = 0.4


@kernel
def _advance_freely(cluster: Cluster) -> int:
    """Go to the first onset, or to the end of the step, while no force acts."""
    state = cluster.state[0]
    rest, first = 1.0 - state.position, 2.0
    for i in range(cluster.contacts.size):
        first = min(first, first_onset(cluster.taylor[i], cluster.contacts[i], rest))
    if first > rest:
        state.position = 1.0
        return DONE
    shift(cluster.taylor, first, cluster.taylor)
    state.position += first
    evaluate_site_motion(cluster, cluster.taylor, cluster.site_motion)
    state.landings += 1
    return CHANGED


@inlined
def _choose_substep(cluster: Cluster, trial: Trial) -> Substep:
    """The next substep: as long as its error allows, to where a drive is not smooth, short while a contact is young."""
    state, sites = cluster.state[0], cluster.contacts
    highest = 0.0
    for i in range(sites.size, cluster.taylor.shape[0]):
        highest = max(highest, cluster.drives.rows[i].highest)
    fastest = cluster.omega_max_h + highest * cluster.interval
    length = min(1.0 - state.position, state.length, (SEARCHED if sites.size > 0 else DRIVEN) / fastest)
    for j in range(trial.closed.size, trial.active.size):
        length = min(
            length,
            drive_end(cluster.drives, trial.active[j], state.begin, cluster.interval, state.position) - state.position,
        )
    longest = length
    for i in trial.closed:
        # A young contact's force goes as the root of its age.
        if not begins_linearly(sites[i].elastic) and abs(sites[i].mode) == CLOSED:
            age = (state.begin - cluster.history[i].onset) / cluster.interval + state.position
            if age * cluster.interval <= 1e-7 * cluster.history[i].duration:
                return Substep(ONSET, longest)
            length = min(length, MOST_AGES * age)
    return Substep(PLAIN, length)


@inlined
def _try_substep(cluster: Cluster, trial: Trial, substep: Substep) -> bool:
    """Leave the end of a substep in ``trial``; whether it could be collocated."""
    if not collocate(cluster, trial, substep):
        return False
    update_taylor(cluster, trial, substep)
    state = cluster.state[0]
    state.position += substep.length
    evaluate_site_motion(cluster, trial.taylor, trial.site_motion)
    state.position -= substep.length
    return True


@inlined
def _end_on_kink(cluster: Cluster, trial: Trial, substep: Substep) -> Substep:
    """Repeat a substep just tried to end where a contact without modes first opens or closes; the one that is tried.

    One of negative length could not be collocated.
    """
    state = cluster.state[0]
    for _ in range(MOST_ATTEMPTS):
        share = first_kink(cluster, trial, substep.length)
        if share > 1.0 or share * substep.length < SHORTEST:
            break
        substep = Substep(substep.kind, share * substep.length)
        if not _try_substep(cluster, trial, substep):
            state.rejected += 1
            state.length = CUT * substep.length
            return Substep(substep.kind, -1.0)
    return substep


@kernel
def _land(cluster: Cluster, trial: Trial, substep: Substep, change: Change) -> tuple[float, bool]:
    """Repeat a substep to end on a ``change``; the length taken, negative if it could not be, whether it was met."""
    contacts, site, h = cluster.contacts, change.site, cluster.interval
    landing = Landing(change.share * substep.length, substep.length, np.inf, 0)
    while True:
        if landing.length <= ROUNDING:
            begin = switching(contacts, site, change.function, cluster.site_motion[site])
            return 0.0, begin.value > begin.tolerance or (begin.value >= -begin.tolerance and begin.rate > 0.0)
        if not _try_substep(cluster, trial, Substep(substep.kind, landing.length)):
            return -landing.length, False
        end = switching(contacts, site, change.function, trial.site_motion[site])
        # Landings come to the rounding of w where Newton's steps still help.
        landing, outcome = correct(landing, end.value, end.rate * h, end.tolerance, 1e-4 * end.tolerance)
        if outcome == SEARCH:
            motion = cluster.site_motion, trial.site_motion
            share = first_change(contacts, *motion, h * landing.length, trial.sums.bernstein).share
            if share > 1.0:
                return landing.length, False
            landing = shorten(landing, share)
        elif outcome != RETRY:
            return landing.length, outcome == LANDED


@inlined
def _search_and_land(cluster: Cluster, trial: Trial, substep: Substep) -> tuple[Substep, bool]:
    """Search a substep just tried and land on its first change: the substep taken, whether the change was met.

    A substep of negative length was rejected; ``state.length`` has the next one to try.
    """
    state = cluster.state[0]
    motion, h = (cluster.site_motion, trial.site_motion), cluster.interval
    change = first_change(cluster.contacts, *motion, h * substep.length, trial.sums.bernstein)
    if change.share > 1.0:
        return substep, False
    site = cluster.contacts[change.site]
    separates = not begins_linearly(site.elastic) and abs(site.mode) == CLOSED and change.function == 0
    if separates and substep.kind == ONSET and substep.length > SHORTEST:
        # The force begins and ends as a root: one substep for each.
        state.length = 0.5 * change.share * substep.length
        return Substep(ONSET, -1.0), False
    kind = EXIT if separates else substep.kind
    state.landings += 1
    taken, landed = _land(cluster, trial, Substep(kind, substep.length), change)
    if taken < 0.0:
        state.rejected += 1
        state.length = -CUT * taken
    return Substep(kind, taken), landed


@inlined
def _control_length(cluster: Cluster, trial: Trial, taken: float, landed: bool) -> bool:
    """Set the next substep's length by the error of the one ``taken``; whether that is small enough."""
    state = cluster.state[0]
    ratio = error_ratio(cluster, trial, taken)
    factor = min(max(0.9 * (1.0 / max(ratio, 1e-30)) ** (1.0 / ORDER), LEAST_GROWTH), MOST_GROWTH)
    if ratio > 1.0 and taken > SHORTEST:
        state.rejected += 1
        state.length = factor * taken
        return False
    if not landed and trial.closed.size > 0:
        state.length = max(factor * taken, state.length if taken < state.length else 0.0)
    return True


@kernel
def _take_down(cluster: Cluster, trial: Trial, substep: Substep) -> None:
    """Write a substep that is taken onto the cluster's tape, for each closed site; on a full tape they are counted."""
    tape, state = cluster.tape, cluster.state[0]
    if tape.rows.shape[1] == 0:
        return
    for i in trial.closed:
        k, site, motion = tape.used[0], cluster.contacts[i], cluster.site_motion[i]
        tape.used[0] += 1
        if k < tape.rows.shape[1]:
            row = tape.rows[0, k]
            row.begin, row.position, row.length, row.kind = state.begin, state.position, substep.length, substep.kind
            row.site, row.mode, row.approach = i, site.mode, site.approach
            row.rate, row.acceleration = motion[1], motion[2]
            # Trials leave the position to a rounding.
            time = state.begin + state.position * cluster.interval
            row.onset = abs(time - cluster.history[i].onset) <= 4.0 * ROUNDING * (time + cluster.interval)
            for node in range(NODES):
                tape.motion[0, k, 0, node], tape.motion[0, k, 1, node] = trial.w[i, node], trial.v[i, node]


@kernel
def _update_extremes(cluster: Cluster, trial: Trial, i: int, seconds: float) -> None:
    """Update the extremes of site ``i`` by a substep of so many ``seconds``."""
    start, end, history = cluster.site_motion[i], trial.site_motion[i], cluster.history[i]
    side = 1.0 if cluster.contacts[i].mode > 0 else -1.0
    depth = max(side * start[0], side * end[0]) - gap_of(cluster.contacts[i], side)
    first = side * contact_force(cluster.contacts, i, start[0], start[1])[0]
    last = side * contact_force(cluster.contacts, i, end[0], end[1])[0]
    force, smallest, largest = max(first, last), min(first, last), max(first, last)
    for node in range(NODES):
        inside = -side * (trial.force[i, node] - cluster.contacts[i].preload)
        smallest, largest = min(smallest, inside), max(largest, inside)
    if largest > force or (side * start[1] > 0.0 and side * end[1] < 0.0):
        # A turn lies inside.
        depth, force, smallest = extremes(cluster.contacts, i, cluster.site_motion, trial.site_motion, seconds)
    history.indentation = max(history.indentation, depth)
    history.force = max(history.force, force)
    history.smallest_force = min(history.smallest_force, smallest)


@kernel
def _select_active(cluster: Cluster) -> Trial:
    """The room for a substep of a cluster, of those DoFs on which forces act."""
    state, sites, room, closed = cluster.state[0], cluster.contacts, cluster.trial, 0
    for i in range(sites.size):
        if sites[i].mode != FREE:
            room.active[closed] = room.closed[closed] = i
            closed += 1
    count = closed
    for i in range(sites.size, cluster.taylor.shape[0]):
        if state.position < drive_end(cluster.drives, i, state.begin, cluster.interval, state.position):
            room.active[count] = i
            count += 1
    values = room.force, room.w, room.v, room.taylor, room.site_motion, room.sums
    return Trial(room.active[:count], room.closed[:closed], *values)


@kernel
def advance_cluster(cluster: Cluster) -> int:
    """Advance a cluster to the first change of modes or to the step's end.

    Returns ``DONE``, ``CHANGED`` (``cluster`` stands behind it) or ``FAILED``.
    """
    state, blind, room = cluster.state[0], False, cluster.trial
    room.force[:] = room.w[:] = room.v[:] = 0.0
    for _ in range(MOST_SUBSTEPS):
        if 1.0 - state.position <= ROUNDING:
            state.position = 1.0
            return DONE
        trial = _select_active(cluster)
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
                return FAILED
            continue
        landed, substep = False, _end_on_kink(cluster, trial, substep)
        if substep.length < 0.0:
            continue
        if not blind:
            substep, landed = _search_and_land(cluster, trial, substep)
            if substep.length < 0.0:
                continue
        # A change at the very start that is none: past it.
        blind = substep.length == 0.0 and not landed
        if substep.length > 0.0:
            # Judged only now: a force continued beyond its end is no smooth function.
            if not _control_length(cluster, trial, substep.length, landed):
                continue
            accumulate_moments(cluster, trial, substep)
            _take_down(cluster, trial, substep)
            for i in trial.closed:
                _update_extremes(cluster, trial, i, cluster.interval * substep.length)
            state.position += substep.length
            copy(trial.taylor, cluster.taylor)
            copy(trial.site_motion, cluster.site_motion)
        if landed:
            return CHANGED
    return FAILED
