"""Compiled advance of a cluster of contact sites through one linear step, from change to change.

Sec. 2 to 4 of the derivation in the package's docstring.
"""

from __future__ import annotations

import numpy as np

from vipetsc.compiled import njit
from vipetsc.contact.changes import Change, extremes, first_change, switching
from vipetsc.contact.law import CLOSED, FREE, contact_force
from vipetsc.contact.search import LANDED, RETRY, SEARCH, begin_landing, correct, shorten
from vipetsc.dynamics.propagator.collocation import EXIT, NODES, ONSET, PLAIN
from vipetsc.dynamics.propagator.free_motion import ROUNDING, first_onset, shift
from vipetsc.dynamics.propagator.substep import (
    ClusterMotion,
    ClusterRecord,
    Substep,
    Trial,
    accumulate_moments,
    collocate,
    error_ratio,
    evaluate_site_motion,
    update_taylor,
)

# How an advance ended: at the end of the step, on a change of modes, or without progress.
DONE, CHANGED, FAILED = range(3)

MOST_SUBSTEPS = 20_000
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


@njit(error_model="numpy")
def _advance_freely(cluster: ClusterRecord, motion: ClusterMotion) -> int:
    """Go to the first onset, or to the end of the step, while no force acts."""
    state = motion.state[0]
    rest, first = 1.0 - state.position, 2.0
    for i in range(cluster.contacts.sites.size):
        first = min(first, first_onset(motion.taylor[i], cluster.contacts.sites[i].clearance, rest))
    if first > rest:
        state.position = 1.0
        return DONE
    shift(motion.taylor, first, motion.taylor)
    state.position += first
    evaluate_site_motion(cluster, state, motion.taylor, motion.site_motion)
    state.landings += 1
    return CHANGED


@njit(error_model="numpy", inline="always")
def _active_dofs(cluster: ClusterRecord, motion: ClusterMotion) -> np.ndarray:
    """The DoFs on which a force acts: sites in contact, then the driven mass."""
    state, sites, dofs = motion.state[0], cluster.contacts.sites, motion.taylor.shape[0]
    active, count = np.empty(dofs, np.int64), 0
    for i in range(dofs):
        if (sites[i].mode != FREE) if i < sites.size else (state.position < state.drive_end):
            active[count] = i
            count += 1
    return active[:count]


@njit(error_model="numpy", inline="always")
def _choose_substep(cluster: ClusterRecord, motion: ClusterMotion, active: np.ndarray) -> Substep:
    """The next substep: as long as its error allows, not beyond the drive's end, short while a contact is young."""
    state, sites = motion.state[0], cluster.contacts.sites
    length = min(1.0 - state.position, cluster.longest)
    if active[-1] == sites.size:
        length = min(length, state.drive_end - state.position)
    if active[0] < sites.size:
        length = min(length, state.length)
    longest = length
    for i in range(sites.size):
        # A young contact's force goes as the root of its age.
        if cluster.contacts.law.exponent != 1.0 and abs(sites[i].mode) == CLOSED:
            age = (state.begin - motion.history[i].onset) / cluster.interval + state.position
            if age * cluster.interval <= 1e-7 * motion.history[i].duration:
                return Substep(ONSET, longest)
            length = min(length, MOST_AGES * age)
    return Substep(PLAIN, length)


@njit(error_model="numpy", inline="always")
def _try_substep(cluster: ClusterRecord, motion: ClusterMotion, trial: Trial, substep: Substep) -> bool:
    """Leave the end of a substep in ``trial``; whether it could be collocated."""
    if not collocate(cluster, motion, trial, substep):
        return False
    update_taylor(cluster, motion, trial, substep)
    state = motion.state[0]
    state.position += substep.length
    evaluate_site_motion(cluster, state, trial.taylor, trial.site_motion)
    state.position -= substep.length
    return True


@njit(error_model="numpy")
def _land(
    cluster: ClusterRecord, motion: ClusterMotion, trial: Trial, substep: Substep, change: Change
) -> tuple[float, bool]:
    """Repeat a substep so that it ends on a ``change``; the length taken, and whether the change was met.

    A near miss may turn out to be none. A negative length could not be taken.
    """
    contacts, site, h = cluster.contacts, change.site, cluster.interval
    landing = begin_landing(change.share, substep.length)
    while True:
        if landing.length <= ROUNDING:
            begin = switching(contacts, site, change.function, motion.site_motion[site])
            return 0.0, begin.value > begin.tolerance or (begin.value >= -begin.tolerance and begin.rate > 0.0)
        if not _try_substep(cluster, motion, trial, Substep(substep.kind, landing.length)):
            return -landing.length, False
        end = switching(contacts, site, change.function, trial.site_motion[site])
        # Landings come to the rounding of w where Newton's steps still help.
        landing, outcome = correct(landing, end.value, end.rate * h, end.tolerance, 1e-4 * end.tolerance)
        if outcome == SEARCH:
            share = first_change(contacts, motion.site_motion, trial.site_motion, h * landing.length).share
            if share > 1.0:
                return landing.length, False
            landing = shorten(landing, share)
        elif outcome != RETRY:
            return landing.length, outcome == LANDED


@njit(error_model="numpy", inline="always")
def _search_and_land(
    cluster: ClusterRecord, motion: ClusterMotion, trial: Trial, substep: Substep
) -> tuple[Substep, bool]:
    """Search a substep just tried for a change and land on the first one: the substep taken, whether it was met.

    A substep of negative length was rejected; ``state.length`` has the next one to try.
    """
    state = motion.state[0]
    change = first_change(cluster.contacts, motion.site_motion, trial.site_motion, cluster.interval * substep.length)
    if change.share > 1.0:
        return substep, False
    separates = (
        cluster.contacts.law.exponent != 1.0
        and abs(cluster.contacts.sites[change.site].mode) == CLOSED
        and change.function == 0
    )
    if separates and substep.kind == ONSET and substep.length > SHORTEST:
        # The force begins and ends as a root: one substep for each.
        state.length = 0.5 * change.share * substep.length
        return Substep(ONSET, -1.0), False
    kind = EXIT if separates else substep.kind
    state.landings += 1
    taken, landed = _land(cluster, motion, trial, Substep(kind, substep.length), change)
    if taken < 0.0:
        state.rejected += 1
        state.length = -CUT * taken
    return Substep(kind, taken), landed


@njit(error_model="numpy", inline="always")
def _control_length(cluster: ClusterRecord, motion: ClusterMotion, trial: Trial, taken: float, landed: bool) -> bool:
    """Set the next substep's length by the error of the one ``taken``; whether that is small enough."""
    state = motion.state[0]
    ratio = error_ratio(cluster, trial, taken)
    factor = min(max(0.9 * (1.0 / max(ratio, 1e-30)) ** (1.0 / ORDER), LEAST_GROWTH), MOST_GROWTH)
    if ratio > 1.0 and taken > SHORTEST:
        state.rejected += 1
        state.length = factor * taken
        return False
    if not landed and trial.active[0] < cluster.contacts.sites.size:
        state.length = max(factor * taken, state.length if taken < state.length else 0.0)
    return True


@njit(error_model="numpy", inline="always")
def _accept(cluster: ClusterRecord, motion: ClusterMotion, trial: Trial, substep: Substep) -> None:
    """Take a substep as done."""
    accumulate_moments(cluster, motion, trial, substep)
    for i in trial.active:
        if i < cluster.contacts.sites.size:
            _update_extremes(cluster, motion, trial, i, cluster.interval * substep.length)
    motion.state[0].position += substep.length
    motion.taylor[:] = trial.taylor
    motion.site_motion[:] = trial.site_motion


@njit(error_model="numpy")
def _update_extremes(cluster: ClusterRecord, motion: ClusterMotion, trial: Trial, i: int, seconds: float) -> None:
    """Update the extremes of site ``i`` by a substep of so many ``seconds``."""
    start, end, history = motion.site_motion[i], trial.site_motion[i], motion.history[i]
    side = 1.0 if cluster.contacts.sites[i].mode > 0 else -1.0
    depth = max(side * start[0], side * end[0]) - cluster.contacts.sites[i].clearance
    first = side * contact_force(cluster.contacts, i, start[0], start[1])[0]
    last = side * contact_force(cluster.contacts, i, end[0], end[1])[0]
    force, smallest = max(first, last), min(first, last)
    inside = -side * trial.force[i]
    smallest = min(smallest, inside.min())
    if inside.max() > force or (side * start[1] > 0.0 and side * end[1] < 0.0):
        # A turn lies inside.
        depth, force, smallest = extremes(cluster.contacts, i, motion.site_motion, trial.site_motion, seconds)
    history.indentation = max(history.indentation, depth)
    history.force = max(history.force, force)
    history.smallest_force = min(history.smallest_force, smallest)


@njit(error_model="numpy")
def advance_cluster(cluster: ClusterRecord, motion: ClusterMotion, begin: float) -> int:
    """Advance a cluster in the step that begins at ``begin`` in s, to the first change of modes or to the step's end.

    Returns ``DONE``, ``CHANGED`` (``motion`` is that after it) or ``FAILED``.
    """
    state, blind = motion.state[0], False
    if begin != state.begin:
        state.begin, state.position = begin, 0.0
        state.drive_end = (cluster.burst.duration - begin) / cluster.interval
        motion.moments[:] = 0.0
    dofs = motion.taylor.shape[0]
    force, w, v = np.zeros((dofs, NODES)), np.zeros((dofs, NODES)), np.zeros((dofs, NODES))
    taylor, site_motion = np.empty_like(motion.taylor), np.empty_like(motion.site_motion)
    for _ in range(MOST_SUBSTEPS):
        if 1.0 - state.position <= ROUNDING:
            state.position = 1.0
            return DONE
        active = _active_dofs(cluster, motion)
        if active.size == 0:
            return _advance_freely(cluster, motion)
        trial = Trial(active, force, w, v, taylor, site_motion)
        evaluate_site_motion(cluster, state, motion.taylor, motion.site_motion)
        substep = _choose_substep(cluster, motion, active)
        if blind:
            substep = Substep(substep.kind, min(substep.length, BLIND))
        state.substeps += 1
        if not _try_substep(cluster, motion, trial, substep):
            state.rejected += 1
            state.length = CUT * substep.length
            if substep.length < ROUNDING:
                return FAILED
            continue
        landed = False
        if not blind:
            substep, landed = _search_and_land(cluster, motion, trial, substep)
            if substep.length < 0.0:
                continue
        # A change at the very start that is none: past it.
        blind = substep.length == 0.0 and not landed
        if substep.length > 0.0:
            # Judged only now: a force continued beyond its end is no smooth function.
            if not _control_length(cluster, motion, trial, substep.length, landed):
                continue
            _accept(cluster, motion, trial, substep)
        if landed:
            return CHANGED
    return FAILED
