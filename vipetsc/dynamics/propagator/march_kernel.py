"""Compiled march of a cluster of contact sites through one linear step, from change to change.

- While nothing acts, the sites' motion is a known series: the first onset is found by steps that a bound on |w''|
  keeps short of it.
- Otherwise substeps of adaptive length with frozen contact modes are searched for changes on the quintic Hermite
  of w, as the time stepper's steps are, and repeated shorter to land on the first one.
"""

from __future__ import annotations

import numpy as np

from vipetsc.compiled import njit
from vipetsc.contact.contact_kernel import first_change, peaks, switching
from vipetsc.dynamics.propagator.cluster_kernel import (
    BEGIN,
    DRIVE_END,
    INTERVAL,
    LONGEST,
    PLACE,
    ROUNDING,
    SUBSTEP,
    book,
    collocate,
    error,
    first_onset,
    motion,
    renew,
    shift,
)
from vipetsc.dynamics.propagator.collocation import EXIT, NODES, ONSET, PLAIN
from vipetsc.dynamics.ts.kernel import CLEARANCE, CONTACT_MODE, FREE, HERTZ, SITE_MODE, SITES, contact_force

# How a march ended: at the end of the step, on a change of modes, or without progress.
DONE, CHANGE, FAILED = range(3)
# What a march counts.
SUBSTEPS, REJECTED, LANDINGS = range(3)

MOST_SUBSTEPS = 20_000
LANDING_STEPS = 8
# A contact's substep in ages of the contact.
AGES = 1.5
# Share of a step that is too short for anything to happen.
BLIND = 1e-7
# Order by which the substep follows its error.
ORDER = 8.0
GROWTH = 2.0

_options = {"cache": True, "error_model": "numpy", "boundscheck": False}


@njit(
    "Tuple((f8, b1))(i8[::1], f8[::1], f8[::1], i8, f8, f8, i8, i8, b1, f8[:, ::1], f8[:, :, ::1], f8[:, ::1],"
    " f8[:, ::1], f8[:, :, :, ::1], i8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])",
    **_options,
)
def _land(
    q, p, clock, kind, length, first, site, row, driven, jets, gamma, share, weight, powers, active, f, w, v, trial,
    start, end,
):  # fmt: skip
    """Repeat a substep of ``length`` so that it ends on the change at its share ``first``.

    Returns the length taken and whether the change was met: a graze may turn out to be none. A negative length
    could not be taken.
    """
    values = np.empty((2, 4))
    h = clock[INTERVAL]
    at, last = first * length, np.inf
    for attempt in range(2 * LANDING_STEPS):
        if at <= ROUNDING:
            switching(q, p, site, start, values)
            value, rate, tolerance = values[row, 0], values[row, 1], values[row, 2]
            return 0.0, value > tolerance or (value >= -tolerance and rate > 0.0)
        if not collocate(q, p, clock, kind, at, jets, gamma, share, powers, active, f, w, v):
            return -at, False
        renew(kind, at, jets, gamma, share, weight, active, f, trial)
        clock[PLACE] += at
        motion(q, p, clock, driven, trial, gamma, end)
        clock[PLACE] -= at
        switching(q, p, site, end, values)
        value, rate, tolerance = values[row, 0], values[row, 1] * h, values[row, 2]
        better = abs(value) < 0.5 * last
        # Landings come to the rounding of w where Newton's steps still help.
        if abs(value) <= 1e-4 * tolerance or (abs(value) <= tolerance and not better):
            return at, True
        newton = at - value / rate if rate != 0.0 else np.inf
        if attempt < LANDING_STEPS and 0.0 < newton <= length and better:
            at, last = newton, abs(value)
            continue
        if abs(value) <= tolerance:
            return at, True
        again = first_change(q, p, start, end, h * at)[0]
        if again > 1.0:
            return at, False
        at *= again
    return at, False


@njit("void(i8[::1], f8[::1], i8, f8[:, ::1], f8[:, ::1], f8, f8[:, ::1], f8[:, ::1])", **_options)
def _top(q, p, i, start, end, h, f, top):
    """Update a contact's largest indentation and force and its smallest force by a substep."""
    side = 1.0 if q[q[SITE_MODE] + i] > 0 else -1.0
    depth = max(side * start[i, 0], side * end[i, 0]) - p[q[CLEARANCE] + i]
    first = side * contact_force(q, p, i, start[i, 0], start[i, 1])[0]
    last = side * contact_force(q, p, i, end[i, 0], end[i, 1])[0]
    force, weakest, inside = max(first, last), min(first, last), -np.inf
    for j in range(NODES):
        inside = max(inside, -side * f[i, j])
        weakest = min(weakest, -side * f[i, j])
    if inside > force or (side * start[i, 1] > 0.0 and side * end[i, 1] < 0.0):
        # A turn lies inside.
        depth, force, weakest = peaks(q, p, start, end, h, i)
    top[i, 0], top[i, 1], top[i, 2] = max(top[i, 0], depth), max(top[i, 1], force), min(top[i, 2], weakest)


@njit(
    "i8(i8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1],"
    " f8[:, :, :, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], i8[::1])",
    **_options,
)
def march(
    q, p, clock, since, durations, jets, gamma, share, weight, powers, tail, moments, energy, start, end, top, counts
):
    """March from the clock's place to the first change of modes or to the end of the step.

    Parameters
    ----------
    q, p
        The sites' block, as ``kernel`` lays it out.
    clock
        Words as in ``cluster_kernel``.
    since, durations
        Per site: time of its last onset and duration of its contact in s.
    jets, gamma
        Jets (member, coefficient) at the clock's place; responses (member, member, term) between members.
    share, weight, powers, tail
        Nodes of a substep, as ``collocation`` has them.
    moments, energy
        Per member: moments (coefficient) of its force about the end of the step; dissipated energy, work of the drive.
    start, end
        Scratch for w, w', w'' of the sites; ``start`` holds them at the clock's place afterwards.
    top
        Per site: largest indentation and force, smallest force of the contact so far.
    counts
        Substeps, rejected ones, landings.
    """
    sites, h = q[SITES], clock[INTERVAL]
    modes = q[q[SITE_MODE] : q[SITE_MODE] + sites]
    members = jets.shape[0]
    f, w, v = np.zeros((members, NODES)), np.zeros((members, NODES)), np.zeros((members, NODES))
    trial, blind = np.empty_like(jets), False
    for _ in range(MOST_SUBSTEPS):
        rest = 1.0 - clock[PLACE]
        if rest <= ROUNDING:
            clock[PLACE] = 1.0
            return DONE
        driven = members > sites and clock[PLACE] < clock[DRIVE_END]
        count = int(driven)
        for i in range(sites):
            count += modes[i] != FREE
        if count == 0:
            first = 2.0
            for i in range(sites):
                first = min(first, first_onset(jets[i], p[q[CLEARANCE] + i], rest))
            if first > rest:
                clock[PLACE] = 1.0
                return DONE
            for i in range(members):
                shift(jets[i], first)
            clock[PLACE] += first
            motion(q, p, clock, False, jets, gamma, start)
            counts[LANDINGS] += 1
            return CHANGE

        active = np.empty(count, np.int64)
        a = 0
        for i in range(sites):
            if modes[i] != FREE:
                active[a] = i
                a += 1
        if driven:
            active[a] = sites
        motion(q, p, clock, driven, jets, gamma, start)
        longest = min(rest, clock[LONGEST])
        if driven:
            longest = min(longest, clock[DRIVE_END] - clock[PLACE])
        kind, wanted = PLAIN, min(longest, clock[SUBSTEP]) if count > int(driven) else longest
        length = wanted
        for i in range(sites):
            # A young contact's force goes as the root of its age.
            if q[HERTZ] == 1 and abs(modes[i]) == CONTACT_MODE:
                age = (clock[BEGIN] - since[i]) / h + clock[PLACE]
                if age * h <= 1e-7 * durations[i]:
                    kind = ONSET
                else:
                    length = min(length, AGES * age)
        if kind == ONSET:
            length = wanted
        if blind:
            length = min(length, BLIND)
        counts[SUBSTEPS] += 1
        if not collocate(q, p, clock, kind, length, jets, gamma, share, powers, active, f, w, v):
            counts[REJECTED] += 1
            clock[SUBSTEP] = 0.4 * length
            if length < ROUNDING:
                return FAILED
            continue
        renew(kind, length, jets, gamma, share, weight, active, f, trial)
        clock[PLACE] += length
        motion(q, p, clock, driven, trial, gamma, end)
        clock[PLACE] -= length
        taken, landed = length, False
        first, which, row = first_change(q, p, start, end, h * length)
        if first <= 1.0 and not blind:
            site, function = int(which), int(row)
            separates = q[HERTZ] == 1 and abs(modes[site]) == CONTACT_MODE and function == 0
            if separates and kind == ONSET and length > 1e-9:
                # The force begins and ends as a root: one substep for each.
                clock[SUBSTEP] = 0.5 * first * length
                continue
            kind = EXIT if separates else kind
            counts[LANDINGS] += 1
            taken, landed = _land(q, p, clock, kind, length, first, site, function, driven, jets, gamma, share,
                                  weight, powers, active, f, w, v, trial, start, end)  # fmt: skip
            if taken < 0.0:
                counts[REJECTED] += 1
                clock[SUBSTEP] = -0.4 * taken
                continue
        # A change at the very start that is none: past it.
        blind = taken == 0.0 and not landed
        if taken > 0.0:
            # Judged only now: a force continued beyond its end is no smooth function.
            wrong = error(q, p, clock, taken, gamma, tail, active, f)
            factor = min(max(0.9 * (1.0 / max(wrong, 1e-30)) ** (1.0 / ORDER), 0.2), GROWTH)
            if wrong > 1.0 and taken > 1e-9:
                counts[REJECTED] += 1
                clock[SUBSTEP] = factor * taken
                continue
            if not landed and count > int(driven):
                clock[SUBSTEP] = max(factor * taken, clock[SUBSTEP] if taken < clock[SUBSTEP] else 0.0)
        length = taken
        if length > 0.0:
            book(q, p, clock, kind, length, share, weight, active, f, w, v, moments, energy)
            for i in range(sites):
                if modes[i] != FREE:
                    _top(q, p, i, start, end, h * length, f, top)
            clock[PLACE] += length
            jets[:] = trial
            start[:] = end
        if landed:
            return CHANGE
    return FAILED
