"""Collocation of the forces in a substep of a cluster, and what they leave: motion, error estimate, moments.

Sec. 3 and 5 of the derivation in the package's docstring.
"""

from collections import namedtuple
from typing import NamedTuple

import numpy as np
from scipy.special import binom

from vipetsc.compiled import inlined, kernel
from vipetsc.contact.law import contact_force
from vipetsc.dynamics.drives import Drives, drive_force
from vipetsc.dynamics.propagator.nodes import NODES, Collocation
from vipetsc.dynamics.propagator.series import MOST_TERMS, evaluate, shift
from vipetsc.dynamics.propagator.tape import Tape

MOST_SWEEPS = 60
# Responses smaller than this, beside the first one, are left out.
SMALLEST_RESPONSE = 1e-18
# Share of the estimated error (interpolation of the force) that the end of a substep is left with.
SUPERCONVERGENCE = 0.02
BINOMIALS = binom(*np.ogrid[: 2 * MOST_TERMS, : 2 * MOST_TERMS])

COUNTS = ("substeps", "rejected", "landings", "switches")
SUBSTEP_STATE = np.dtype(
    [(name, float) for name in ("begin", "position", "length")] + [(name, np.int64) for name in COUNTS]
)
"""Where a cluster stands: the step's begin in s; in shares of the step the position and the next substep's
length; counts of substeps, of rejected ones, of landings and of switches of a site's mode."""

HISTORY = np.dtype([(name, float) for name in ("onset", "duration", "indentation", "force", "smallest_force")])
"""A site's contact: its onset in s, its expected duration in s, and its extremes so far in m and N."""


class Cluster(NamedTuple):
    """A cluster, or all that a rank feels one after another: constants, and what changes as it is advanced.

    The DoFs of a cluster are its sites, those of ``contacts``, and the driven masses in reach with their ``drives``, in
    which sites have rows that drive nothing. ``response`` (dof, dof of the same cluster, term) is the motion of one
    after an impulse on another, times H, in powers 2 m + 1 of s, with dashpots m + 1 (2 term - 1 of them); ``interval``
    is H in s, ``atol`` in m/s; a contact begins with the share ``first_substep`` of its duration.
    ``taylor`` (dof, 2 term) holds the series of the free motion about the present position, ``site_motion`` (dof, 3) w,
    w', w'' of the sites there. ``moments`` (dof, 2 term) in N s are those of the step's forces about its end,
    ``energy`` (dof,) in J what sites dissipated and the work of drives; ``history`` (dof,) is of dtype ``HISTORY``,
    ``state`` (cluster,) of dtype ``SUBSTEP_STATE``; ``trial`` is room for a substep of the largest, ``tape`` a log.
    """

    contacts: np.ndarray
    drives: Drives
    response: np.ndarray
    nodes: Collocation
    interval: float
    omega_max_h: float
    rtol: float
    atol: float
    first_substep: float
    taylor: np.ndarray
    site_motion: np.ndarray
    moments: np.ndarray
    energy: np.ndarray
    history: np.ndarray
    state: np.ndarray
    trial: "Trial"
    tape: Tape


class Substep(NamedTuple):
    """A substep: how its nodes lie, its length as a share of the step."""

    kind: int
    length: float


class Trial(NamedTuple):
    """A substep that has been computed but not yet taken.

    Forces act on the DoFs ``active``, of which those ``closed`` are sites. ``force`` in N, ``w`` in m and ``v`` in m/s
    (dof, node) at its nodes; at its end ``taylor`` and ``site_motion`` as in ``Cluster``.
    """

    active: np.ndarray
    closed: np.ndarray
    force: np.ndarray
    w: np.ndarray
    v: np.ndarray
    taylor: np.ndarray
    site_motion: np.ndarray
    sums: "Sums"


Sums = namedtuple("Sums", "free_w free_v to_w to_v reaches w v forces moments series bernstein")
"""Room for what a substep adds up: compiled code that makes no arrays need not count references to them."""


def create_trial(dofs: int, terms: int) -> Trial:
    """Room for a substep of ``dofs`` DoFs, all of which are active."""
    numbers, taylor, (force, w, v) = np.arange(dofs), np.zeros((dofs, 2 * terms)), np.zeros((3, dofs, NODES))
    pairs = *np.zeros((2, dofs, NODES)), *np.zeros((2, dofs, dofs, NODES, NODES)), np.zeros((dofs, dofs), bool)
    series = np.zeros((2 * terms, 2 * terms))
    rest = *np.zeros((2, NODES)), np.zeros(dofs), np.zeros(2 * terms), series, np.zeros((2, 6))
    return Trial(numbers, numbers.copy(), force, w, v, taylor, np.zeros((dofs, 3)), Sums(*pairs, *rest))


@kernel
def _pull(contacts: np.ndarray, i: int, w: float, rate: float) -> float:
    """Force in N on the relative displacement of site ``i``, beyond the load that a pressed one has at rest."""
    return -(contact_force(contacts, i, w, rate)[0] - contacts[i].preload)


@kernel
def evaluate_site_motion(cluster: Cluster, taylor: np.ndarray, out: np.ndarray) -> None:
    """``out`` (site, 3) = w, w', w'' of every site at the present position, where the series is ``taylor``."""
    state, sites, h = cluster.state[0], cluster.contacts.size, cluster.interval
    forces = cluster.trial.sums.forces[: cluster.taylor.shape[0]]
    for i in range(sites):
        out[i, 0], out[i, 1] = taylor[i, 0], taylor[i, 1] / h
        forces[i] = _pull(cluster.contacts, i, out[i, 0], out[i, 1])
    for i in range(sites, forces.size):
        forces[i] = drive_force(cluster.drives, i, state.begin + state.position * h)
    for i in range(sites):
        acceleration = 2.0 * taylor[i, 2]
        for j in range(forces.size):
            acceleration += cluster.response[i, j, 0] * forces[j]
        out[i, 2] = acceleration / (h * h)


@inlined
def has_all_powers(cluster: Cluster) -> bool:
    """Whether responses have all powers of time, not odd ones alone: whether there are dashpots."""
    return 2 * cluster.response.shape[2] > cluster.taylor.shape[1]


@kernel
def node_responses(cluster: Cluster, substep: Substep, i: int, j: int, to_w: np.ndarray, to_v: np.ndarray) -> bool:
    """Fill (node k, node) with what DoF ``j``'s force at node k adds to w, w' of DoF ``i``; whether it reaches it."""
    to_w[:] = to_v[:] = 0.0
    size, reaches, all_powers = 1.0, False, has_all_powers(cluster)
    power, ratio = substep.length, substep.length if all_powers else substep.length * substep.length
    for m in range(cluster.response.shape[2]):
        p = m + 1 if all_powers else 2 * m + 1
        g = cluster.response[i, j, m]
        if g != 0.0:
            reaches = True
            by_w, by_v = g * power * substep.length, g * power * p / cluster.interval
            for k in range(NODES):
                for node in range(NODES):
                    to_w[k, node] += by_w * cluster.nodes.powers[substep.kind, p, k, node]
                    to_v[k, node] += by_v * cluster.nodes.powers[substep.kind, p - 1, k, node]
        power *= ratio
        turned = cluster.omega_max_h * substep.length
        size *= turned / (p + 1) if all_powers else turned**2 / ((2 * m + 2) * (2 * m + 3))
        if size < SMALLEST_RESPONSE:
            break
    return reaches


@kernel
def collocate(cluster: Cluster, trial: Trial, substep: Substep) -> bool:
    """Solve for the force and motion of the ``active`` DoFs at the nodes of a substep; whether the iteration converged.

    Picard's iteration, which begins with the forces that ``trial`` holds.
    """
    state, contacts, h, last = cluster.state[0], cluster.contacts, cluster.interval, np.inf
    active, n = trial.active, trial.active.size
    free_w, free_v, to_w, to_v, reaches, w, v, _, _, _, _ = trial.sums
    for a in range(n):
        for node in range(NODES):
            at = substep.length * cluster.nodes.share[substep.kind, node]
            free_w[a, node], slope = evaluate(cluster.taylor[active[a]], at)
            free_v[a, node] = slope / h
            if active[a] >= contacts.size:
                time = state.begin + (state.position + at) * h
                trial.force[active[a], node] = drive_force(cluster.drives, active[a], time)
    for a in range(n):
        for b in range(n):
            reaches[a, b] = node_responses(cluster, substep, active[a], active[b], to_w[a, b], to_v[a, b])
    for _ in range(MOST_SWEEPS):
        change = 0.0
        for a in range(n):
            for node in range(NODES):
                w[node], v[node] = free_w[a, node], free_v[a, node]
            for b in range(n):
                if reaches[a, b]:
                    for k in range(NODES):
                        force = trial.force[active[b], k]
                        for node in range(NODES):
                            w[node] += to_w[a, b, k, node] * force
                            v[node] += to_v[a, b, k, node] * force
            change = max(change, _replace(contacts, active[a], w, v, trial))
        if change < 1e-15 or (change < 1e-13 and change >= last):
            return True
        if change == np.inf:
            break
        last = change
        for i in trial.closed:
            for node in range(NODES):
                trial.force[i, node] = _pull(contacts, i, trial.w[i, node], trial.v[i, node])
    trial.force[: contacts.size] = 0.0
    return False


@kernel
def _replace(contacts: np.ndarray, i: int, w: np.ndarray, v: np.ndarray, trial: Trial) -> float:
    """Put the motion of DoF ``i`` at the nodes into ``trial``; largest change of a site's, inf if it is not finite."""
    change = 0.0
    for node in range(NODES):
        if not abs(w[node]) + abs(v[node]) < np.inf:
            return np.inf
        if i < contacts.size:
            site = contacts[i]
            change = max(change, abs(w[node] - trial.w[i, node]) / site.scale)
            change = max(change, abs(v[node] - trial.v[i, node]) / (abs(v[node]) + abs(site.approach)))
        trial.w[i, node], trial.v[i, node] = w[node], v[node]
    return change


@kernel
def update_taylor(cluster: Cluster, trial: Trial, substep: Substep) -> None:
    """The series of all DoFs' free motion after a substep in which the forces of ``trial`` acted, into ``trial``."""
    shift(cluster.taylor, substep.length, trial.taylor)
    (dofs, _, terms), moments, series = cluster.response.shape, trial.sums.moments, trial.sums.series
    by, coefficients = 1 if has_all_powers(cluster) else 2, cluster.taylor.shape[1]
    for source in trial.active:
        moments[:] = 0.0
        for node in range(NODES):
            amount = substep.length * cluster.nodes.weight[substep.kind, node] * trial.force[source, node]
            lag = substep.length * (1.0 - cluster.nodes.share[substep.kind, node])
            for k in range(coefficients):
                moments[k] += amount
                amount *= lag
        for m in range(terms):
            for k in range(by * m + 2):
                series[m, k] = BINOMIALS[by * m + 1, k] * moments[by * m + 1 - k]
        for i in range(dofs):
            for m in range(terms):
                g = cluster.response[i, source, m]
                if g != 0.0:
                    for k in range(by * m + 2):
                        trial.taylor[i, k] += g * series[m, k]


@kernel
def error_ratio(cluster: Cluster, trial: Trial, length: float) -> float:
    """Estimated error of a substep over the allowed one, by the forces' last two Legendre coefficients."""
    worst = 0.0
    for i in trial.closed:
        last = 0.0
        for row in range(2):
            coefficient = 0.0
            for node in range(NODES):
                coefficient += cluster.nodes.tail[row, node] * trial.force[i, node]
            last += abs(coefficient)
        allowed = cluster.rtol * abs(cluster.contacts[i].approach) + cluster.atol
        error = SUPERCONVERGENCE * last * length * cluster.response[i, i, 0] / cluster.interval
        worst = max(worst, error / allowed)
    return worst


@kernel
def accumulate_moments(cluster: Cluster, trial: Trial, substep: Substep) -> None:
    """Add a substep's forces to the moments about the step's end, and their work to the energies."""
    h, position = cluster.interval, cluster.state[0].position
    for i in trial.active:
        for node in range(NODES):
            duration = h * substep.length * cluster.nodes.weight[substep.kind, node]
            power = trial.force[i, node] * trial.v[i, node]
            if i < cluster.contacts.size:
                power = contact_force(cluster.contacts, i, trial.w[i, node], trial.v[i, node])[1]
            cluster.energy[i] += duration * power
            rest = 1.0 - position - substep.length * cluster.nodes.share[substep.kind, node]
            amount = duration * trial.force[i, node]
            for k in range(cluster.moments.shape[1]):
                cluster.moments[i, k] += amount
                amount *= rest
