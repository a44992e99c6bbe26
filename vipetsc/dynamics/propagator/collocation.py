"""Collocation of the forces in a substep of a cluster, and what they leave: motion, error estimate, moments.

While forces act on a cluster's DoFs, the motion of each is its free motion plus integrals of all forces times the
responses G (sec. 3 of the derivation in the package's docstring). Over a substep every force is replaced by its
interpolant through eight nodes, by which the integrals become sums with the tables of ``nodes``, and the force law at
the nodes is a small system of equations that ``collocate`` solves by Picard's iteration. ``update_taylor`` then carries
the free motion of all DoFs to the substep's end, ``error_ratio`` judges the interpolant, and ``accumulate_moments``
adds the forces to the moments by which the step will move the lattice (sec. 5).
"""

import numpy as np
from scipy.special import binom

from vipetsc.compiled import inlined, kernel
from vipetsc.contact.law import contact_force
from vipetsc.dynamics.drives import drive_force
from vipetsc.dynamics.propagator.nodes import NODES
from vipetsc.dynamics.propagator.series import MOST_TERMS, evaluate, shift
from vipetsc.dynamics.propagator.substeps import Cluster, Substep, Trial

MOST_SWEEPS = 60
# Picard's iteration has converged when motion at the nodes changes by less than this, relative as in ``_replace``.
CONVERGED = 1e-15
# ... or by less than this, if another sweep no longer changes it by less: what is left is rounding.
STAGNANT = 1e-13
# Responses smaller than this, relative to the first one, are left out.
SMALLEST_RESPONSE = 1e-18
# Fraction of the estimated error (interpolation of the force) that the end of a substep is left with.
SUPERCONVERGENCE = 0.02
BINOMIALS = binom(*np.ogrid[: 2 * MOST_TERMS, : 2 * MOST_TERMS])


@kernel
def _force_on_site(contacts: np.ndarray, i: int, w: float, rate: float) -> float:
    """Force in N on the relative displacement of site ``i``, beyond the load that a pressed one has at rest."""
    return -(contact_force(contacts, i, w, rate)[0] - contacts[i].preload)


@kernel
def evaluate_site_motion(cluster: Cluster, taylor: np.ndarray, out: np.ndarray) -> None:
    """Put w, w', w'' of every site at the present position, where the series is ``taylor``, into ``out`` (site, 3)."""
    state = cluster.state[0]
    sites = cluster.contacts.size
    h = cluster.interval

    # The series is that of the free motion from here on: forces have had no time to change w and w', but add to w''.
    forces = cluster.trial.sums.forces[: cluster.taylor.shape[0]]
    for i in range(sites):
        out[i, 0] = taylor[i, 0]
        out[i, 1] = taylor[i, 1] / h
        forces[i] = _force_on_site(cluster.contacts, i, out[i, 0], out[i, 1])
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
    """Fill (node k, node) with what DoF ``j``'s force at node k adds to w, w' of DoF ``i``; whether it reaches it.

    With the substep's length d, the term g s^p of the response adds g d^(p + 1) to w and p g d^p/H to w', times the
    tables' integrals of the powers p and p - 1.
    """
    to_w[:] = 0.0
    to_v[:] = 0.0
    reaches = False
    all_powers = has_all_powers(cluster)
    power = substep.length
    ratio = substep.length if all_powers else substep.length * substep.length
    # Terms fall with m as those of the fastest mode's sine do, with dashpots as those of its exponential function.
    size = 1.0
    turned = cluster.omega_max_h * substep.length
    for m in range(cluster.response.shape[2]):
        p = m + 1 if all_powers else 2 * m + 1
        g = cluster.response[i, j, m]
        if g != 0.0:
            reaches = True
            by_w = g * power * substep.length
            by_v = g * power * p / cluster.interval
            for k in range(NODES):
                for node in range(NODES):
                    to_w[k, node] += by_w * cluster.nodes.powers[substep.kind, p, k, node]
                    to_v[k, node] += by_v * cluster.nodes.powers[substep.kind, p - 1, k, node]
        power *= ratio
        size *= turned / (p + 1) if all_powers else turned**2 / ((2 * m + 2) * (2 * m + 3))
        if size < SMALLEST_RESPONSE:
            break
    return reaches


@inlined
def _prepare_nodes(cluster: Cluster, trial: Trial, substep: Substep) -> None:
    """Fill what does not change while forces are iterated: free motion, drives' forces, responses at the nodes."""
    state = cluster.state[0]
    h = cluster.interval
    sums = trial.sums
    active = trial.active
    for a in range(active.size):
        i = active[a]
        for node in range(NODES):
            s = substep.length * cluster.nodes.position[substep.kind, node]
            sums.free_w[a, node], slope = evaluate(cluster.taylor[i], s)
            sums.free_v[a, node] = slope / h
            if i >= cluster.contacts.size:
                trial.force[i, node] = drive_force(cluster.drives, i, state.begin + (state.position + s) * h)

    for a in range(active.size):
        for b in range(active.size):
            to_w = sums.to_w[a, b]
            to_v = sums.to_v[a, b]
            sums.reaches[a, b] = node_responses(cluster, substep, active[a], active[b], to_w, to_v)


@inlined
def _move(contacts: np.ndarray, trial: Trial) -> float:
    """Move the active DoFs at the nodes by the forces there; the largest change, inf if a motion is not finite."""
    active = trial.active
    sums = trial.sums
    w = sums.w
    v = sums.v
    change = 0.0
    for a in range(active.size):
        for node in range(NODES):
            w[node] = sums.free_w[a, node]
            v[node] = sums.free_v[a, node]
        for b in range(active.size):
            if sums.reaches[a, b]:
                for k in range(NODES):
                    force = trial.force[active[b], k]
                    for node in range(NODES):
                        w[node] += sums.to_w[a, b, k, node] * force
                        v[node] += sums.to_v[a, b, k, node] * force
        change = max(change, _replace(contacts, active[a], w, v, trial))
    return change


@kernel
def _replace(contacts: np.ndarray, i: int, w: np.ndarray, v: np.ndarray, trial: Trial) -> float:
    """Put the motion of DoF ``i`` at the nodes into ``trial``; largest change of a site's, inf if it is not finite.

    Displacements change relative to the site's clearance, velocities to themselves and the approach velocity.
    """
    change = 0.0
    for node in range(NODES):
        if not abs(w[node]) + abs(v[node]) < np.inf:
            return np.inf
        if i < contacts.size:
            site = contacts[i]
            change = max(change, abs(w[node] - trial.w[i, node]) / site.scale)
            change = max(change, abs(v[node] - trial.v[i, node]) / (abs(v[node]) + abs(site.approach)))
        trial.w[i, node] = w[node]
        trial.v[i, node] = v[node]
    return change


@kernel
def collocate(cluster: Cluster, trial: Trial, substep: Substep) -> bool:
    """Solve for the force and motion of the ``active`` DoFs at the nodes of a substep; whether the iteration converged.

    Picard's iteration, which begins with the forces that ``trial`` holds: those of the substep before are near.
    """
    contacts = cluster.contacts
    _prepare_nodes(cluster, trial, substep)
    last = np.inf
    for _ in range(MOST_SWEEPS):
        change = _move(contacts, trial)
        if change < CONVERGED or (change < STAGNANT and change >= last):
            return True
        if change == np.inf:
            break
        last = change
        for i in trial.closed:
            for node in range(NODES):
                trial.force[i, node] = _force_on_site(contacts, i, trial.w[i, node], trial.v[i, node])

    # Forces that diverged are no beginning for a shorter substep.
    trial.force[: contacts.size] = 0.0
    return False


@kernel
def update_taylor(cluster: Cluster, trial: Trial, substep: Substep) -> None:
    """Put the series of all DoFs' free motion after a substep, in which the forces of ``trial`` acted, into ``trial``.

    After the substep's end the term g s^p of a response adds g times the sum over k of binom(p, k) mu_(p - k) s^k, mu_k
    the moments of the force about the end.
    """
    moments = trial.sums.moments
    series = trial.sums.series
    dofs, _, terms = cluster.response.shape
    by = 1 if has_all_powers(cluster) else 2
    coefficients = cluster.taylor.shape[1]

    shift(cluster.taylor, substep.length, trial.taylor)
    for source in trial.active:
        moments[:] = 0.0
        for node in range(NODES):
            amount = substep.length * cluster.nodes.weight[substep.kind, node] * trial.force[source, node]
            lag = substep.length * (1.0 - cluster.nodes.position[substep.kind, node])
            for k in range(coefficients):
                moments[k] += amount
                amount *= lag

        # The powers p = by m + 1 of the response, expanded once for all DoFs that it moves.
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
    """Estimated error of a substep over the allowed one, by the forces' last two Legendre coefficients.

    Two, since every other one of a force that is symmetric about the middle vanishes. By the first term of the response
    a force's error becomes one of velocity: ``rtol`` times the approach velocity and ``atol`` are allowed.
    """
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
    h = cluster.interval
    position = cluster.state[0].position
    for i in trial.active:
        for node in range(NODES):
            duration = h * substep.length * cluster.nodes.weight[substep.kind, node]
            # A drive's work; of a contact only what it dissipates.
            power = trial.force[i, node] * trial.v[i, node]
            if i < cluster.contacts.size:
                power = contact_force(cluster.contacts, i, trial.w[i, node], trial.v[i, node])[1]
            cluster.energy[i] += duration * power

            remaining = 1.0 - position - substep.length * cluster.nodes.position[substep.kind, node]
            amount = duration * trial.force[i, node]
            for k in range(cluster.moments.shape[1]):
                cluster.moments[i, k] += amount
                amount *= remaining
