"""Stuck sites that share masses: the forces or impulses that keep all of them closed, compiled.

Site i has w = u_resonator - u_host, whose row h_i holds 1 and -1. Forces R (site,) that push hosts and resonators apart
add (A R)_i to the relative acceleration w'' of site i, and impulses likewise to w', with

    A_ij = h_i M^-1 h_j^T,

which is 0 where two sites have no mass in common. A is symmetric and positive semidefinite. Its factors L D L^T fill no
entry before the first one of a row: a row of masses has two entries a site, a ring one full row more. Where sites close
a loop, as three between three masses do, one of them follows from the others: its pivot vanishes, and it gets no force.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.compiled import kernel

# A pivot below this fraction of its diagonal entry is zero: rounding leaves 1e-13 of it in a loop of 1,000 sites, and
# masses that differ by a factor of 1e9 leave 1e-9.
DEPENDENT = 1e-11


class JoinedSites(NamedTuple):
    """The matrix A of sites that are held together, or its factors, below the diagonal row by row.

    Row i has the entries (i, j) for j from ``first[i]`` to i - 1 in ``values`` from ``start[i]`` on, and the diagonal
    entry or pivot ``diagonal[i]``.
    """

    first: np.ndarray
    start: np.ndarray
    values: np.ndarray
    diagonal: np.ndarray


@kernel
def entry(contacts: np.ndarray, i: int, j: int) -> float:
    """Return A_ij in 1/kg of the sites ``i`` and ``j`` of ``contacts`` (site,) of dtype ``SITE``."""
    one = contacts[i]
    other = contacts[j]
    total = 0.0
    # The ground has the number -1, and its inverse mass is 0.
    if one.host == other.host:
        total += one.host_inverse
    if one.resonator == other.resonator:
        total += one.resonator_inverse
    if one.host == other.resonator:
        total -= one.host_inverse
    if one.resonator == other.host:
        total -= one.resonator_inverse
    return total


@kernel
def _first_neighbours(contacts: np.ndarray, sites: np.ndarray) -> np.ndarray:
    """Return the places (k,) among the ``sites`` (k,) of the first with which each has a mass in common, or its own."""
    count = sites.size
    masses = np.empty(2 * count, np.int64)
    for i in range(count):
        masses[2 * i] = contacts[sites[i]].host
        masses[2 * i + 1] = contacts[sites[i]].resonator

    # In the order of masses the sites of one mass lie side by side; to search all pairs would take longer than a step.
    first = np.arange(count)
    order = np.argsort(masses)
    begin = 0
    while begin < order.size:
        end = begin
        least = count
        while end < order.size and masses[order[end]] == masses[order[begin]]:
            least = min(least, order[end] // 2)
            end += 1
        # The ground, -1, joins nothing.
        if masses[order[begin]] >= 0:
            for place in order[begin:end]:
                first[place // 2] = min(first[place // 2], least)
        begin = end
    return first


@kernel
def join(contacts: np.ndarray, sites: np.ndarray) -> JoinedSites:
    """Return the factors of A of the ``sites`` (k,), numbers of ``contacts``."""
    count = sites.size
    first = _first_neighbours(contacts, sites)
    start = np.empty(count, np.int64)
    used = 0
    for i in range(count):
        start[i] = used
        used += i - first[i]

    joined = JoinedSites(first, start, np.empty(used), np.empty(count))
    for i in range(count):
        joined.diagonal[i] = entry(contacts, sites[i], sites[i])
        for j in range(first[i], i):
            joined.values[start[i] + j - first[i]] = entry(contacts, sites[i], sites[j])
    factorise(joined)
    return joined


@kernel
def factorise(joined: JoinedSites) -> None:
    """Replace the matrix by its factors, L below the diagonal and D on it; a D that vanishes is 0 to the bit."""
    first, start, values, diagonal = joined
    for i in range(diagonal.size):
        # Row i of L D first, entry by entry, then that of L.
        for j in range(first[i], i):
            total = values[start[i] + j - first[i]]
            for k in range(max(first[i], first[j]), j):
                total -= values[start[i] + k - first[i]] * values[start[j] + k - first[j]]
            values[start[i] + j - first[i]] = total

        pivot = diagonal[i]
        for j in range(first[i], i):
            place = start[i] + j - first[i]
            scaled = 0.0
            if diagonal[j] > 0.0:
                scaled = values[place] / diagonal[j]
            pivot -= scaled * values[place]
            values[place] = scaled
        if pivot <= DEPENDENT * diagonal[i]:
            pivot = 0.0
        diagonal[i] = pivot


@kernel
def solve(joined: JoinedSites, x: np.ndarray) -> None:
    """Replace ``x`` (k,) by the solution R of A R = x, by the factors; dependent sites have R = 0."""
    first, start, values, diagonal = joined
    for i in range(x.size):
        for j in range(first[i], i):
            x[i] -= values[start[i] + j - first[i]] * x[j]
    for i in range(x.size - 1, -1, -1):
        # In place: x[i] is complete once all rows below it have taken their part off.
        if diagonal[i] > 0.0:
            x[i] /= diagonal[i]
        else:
            x[i] = 0.0
    for i in range(x.size - 1, -1, -1):
        for j in range(first[i], i):
            # Of a dependent site j this entry is 0, so that its 0 stays.
            x[j] -= values[start[i] + j - first[i]] * x[i]
