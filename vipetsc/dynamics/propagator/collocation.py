"""Collocation of the forces in a substep of a cluster; the motion, error estimate and moments that follow.

While forces act on a cluster's DoFs, the motion of each is its free motion plus integrals of all forces times the
responses G (sec. 3 of the derivation in the package's docstring). Over a substep every force is replaced by its
interpolant through eight nodes, by which the integrals become sums with the tables of ``nodes``, and the force law at
the nodes is a small system of equations that ``collocate`` solves by Picard's iteration. ``update_taylor`` then carries
the free motion of all DoFs to the substep's end, ``error_ratio`` judges the interpolant, and ``accumulate_moments``
adds the forces to the moments by which the step will move the lattice (sec. 5).

**Notation.** H is the linear step in s, s the position in it in units of H; a substep has its ``length`` d in these
units and nodes of one of three kinds, ``substep.kind``: plain ones, or ones that crowd where a force of Hertz begins or
ends; z in [0, 1] is the variable in which they are Gauss's (``nodes``). A DoF is the relative displacement w of a
contact site, the elongation of a nonlinear spring, or the displacement of a driven mass. Forces act on those that are
``trial.active``: ``trial.closed``, the sites in contact and, open or closed, those that touch or are pressed at rest;
all springs, ``trial.springs``; and the masses whose drive is on. The *free motion* of a DoF is its motion from here on
if no force acted on any DoF. A ``Cluster`` holds what has been taken, a ``Trial`` what may still be thrown away.

**Sums at the nodes.** H times the displacement of DoF i after a unit impulse on DoF l is the sum over p of g_p s^p, g_p
in m/N (``Cluster.response``). A force F acts for ds as the impulse F H ds, so that H cancels in displacements. With x
from 0 to 1 in the substep and l_k Lagrange's polynomials of its nodes, of degree 7 in z, a unit force of l at node k
moves i at node j by

    to_w[k, j] = sum over p of g_p d^(p + 1) powers[p, k, j],   powers[p, k, j] = integral_0^x_j (x_j - x)^p l_k(x) dx,

and its rate by to_v[k, j], the same with the derivative p g_p d^p/H and the power p - 1. The tables ``powers`` do not
depend on the lattice.

**Picard's iteration** puts the motion at the nodes into the force law, the forces into the integrals, and so on. With a
contact of stiffness k on a mass m each sweep leaves 0.006 (h omega)^2 of the error, omega^2 = k/m, h the substep's
length in s. 0.006 is the spectral radius of the tables' double integral ``powers[1]`` of plain nodes: the iteration
contracts up to h omega = 12.9, and in the substeps that the error estimate allows, h omega = 1 to 2, ten sweeps or so
reach rounding. With a force -c w' each sweep leaves 0.09 h c/m of it, by the single integral ``powers[0]``. Newton's
method would need fewer sweeps, but each of them would take the law's derivatives and the solution of a linear system of
8 equations for each active DoF.

**Stuck sites.** At a rigid site that sticks w'' = 0. In units of H the acceleration of DoF i is, apart from its free
motion, g_1 F of its own force at once and that of others on the same masses, and the sum over p >= 2 and over the nodes

    to_a[k, j] = p (p - 1) g_p d^(p - 1) powers[p - 2, k, j].

The reaction F at a node is what makes it vanish: a Volterra equation of the second kind, for which Picard's iteration
contracts as above. Forces at once of several stuck sites on one mass are solved for together, one after the other.

**Moments.** The integrals of a force times powers of the lag to the substep's end are sums over the nodes with Gauss's
weights times dx/dz. They are those of the interpolant, a polynomial of degree 7 in z, as long as the integrand's degree
in z is at most 15: up to the 8th power with plain nodes, where the lag is linear in z; up to the 3rd with the others,
where the lag is quadratic and dx/dz adds one degree more, 7 + 2 x 3 + 1 = 14. For higher powers, which the response
multiplies by its high, small terms, they err as Gauss's rule does; so do energies, integrals of force times rate.

Whether a function is a ``kernel`` or ``inlined``, put in place of its calls, matters for speed alone: see
``vipetsc.compiled``.
"""

import numpy as np
from scipy.special import binom

from vipetsc.compiled import inlined, kernel
from vipetsc.contact.law import STUCK, contact_force, side_of
from vipetsc.contact.together import entry, join, solve
from vipetsc.dynamics.drives import drive_force, drive_power
from vipetsc.dynamics.propagator.nodes import NODES
from vipetsc.dynamics.propagator.series import MOST_TERMS
from vipetsc.dynamics.propagator.substeps import Cluster, Substep, Trial, first_drive, has_stuck_sites
from vipetsc.dynamics.propagator.taylor import curvature, evaluate, shift
from vipetsc.dynamics.spring_law import nonlinear_force

# Sweeps beyond which a substep is cut instead: so many suffice up to h omega = 8, where the error is far from small
# enough. Any limit of some tens serves.
MOST_SWEEPS = 60
# Picard's iteration has converged when motion at the nodes changes by less than this, relative as in ``_replace``.
CONVERGED = 1e-15
# It has also converged when the change is below this and no smaller than in the sweep before: that is rounding.
STAGNANT = 1e-13
# Terms of a response are left out where their bound is below this, relative to the first terms of own responses.
SMALLEST_RESPONSE = 1e-18
# The error in w' at a substep's end is taken to be this times (|c_6| + |c_7|) d g_1/H, with the last two Legendre
# coefficients in z of the force at the nodes. Gauss's rule integrates these two exactly, so that the end errs by later,
# smaller coefficients only: on a linear contact and on one of Hertz by 2e-4 of the two or less, wherever that is above
# rounding. The hundredfold margin is for other forces, and cheap: half of it saves 8 % of the substeps of the built-in
# case, twice as much costs 9 %.
SUPERCONVERGENCE = 0.02
# Half of the time over which the rate of a force is a difference, in units of H.
RATE_SHIFT = 1e-4
# Binomial coefficients binom(p, k), p down, k across, of all powers of s that a series may have.
BINOMIALS = binom(*np.ogrid[: 2 * MOST_TERMS, : 2 * MOST_TERMS])


@kernel
def _force_on_site(contacts: np.ndarray, i: int, w: float, rate: float) -> float:
    """Return the force in N that moves the relative displacement w of site ``i``.

    ``contact_force`` is that on the host. It pushes the other mass the opposite way, and w is the other mass's
    displacement less the host's: so the sign. The load of a contact that is pressed at rest, ``preload``, is balanced
    there by static loads: only the difference moves w, which is the load alone while the contact is open.
    """
    on_host, _ = contact_force(contacts, i, w, rate)
    return -(on_host - contacts[i].preload)


@kernel
def _force_of_spring(cluster: Cluster, i: int, z: float) -> float:
    """Return the force in N on the elongation z in m of the spring that DoF ``i`` is, beyond its linear part."""
    return -nonlinear_force(cluster.springs[i - cluster.contacts.size].law, z)


@kernel
def evaluate_site_motion(cluster: Cluster, taylor: np.ndarray, out: np.ndarray) -> None:
    """Put w, w', w'' of every site at the present position into ``out`` (site, 3), in m, m/s and m/s^2.

    ``taylor`` (dof, coefficient) is the series of the free motion from that position on, in m. Of a stuck site it is
    the reaction R in N, R' in N/s and 0.
    """
    state = cluster.state[0]
    sites = cluster.contacts.size
    h = cluster.interval

    # The series is that of the free motion from here on: forces have had no time to change w and w', but add to w''.
    # They are put into a workspace; ``drives`` has a row for every DoF, so that the number i serves for it, too.
    forces = cluster.trial.sums.forces[: cluster.taylor.shape[0]]
    for i in range(sites):
        out[i, 0] = taylor[i, 0]
        out[i, 1] = taylor[i, 1] / h
        forces[i] = _force_on_site(cluster.contacts, i, out[i, 0], out[i, 1])
    for i in range(sites, first_drive(cluster)):
        forces[i] = _force_of_spring(cluster, i, taylor[i, 0])
    for i in range(first_drive(cluster), forces.size):
        forces[i] = drive_force(cluster.drives, i, state.begin + state.position * h)
    any_stuck = has_stuck_sites(cluster)
    if any_stuck:
        _find_reactions(cluster, taylor, forces)

    for i in range(sites):
        acceleration = 2.0 * taylor[i, 2]
        for j in range(forces.size):
            acceleration += cluster.response[i, j, 0] * forces[j]
        out[i, 2] = acceleration / (h * h)
    if any_stuck:
        _put_reactions(cluster, taylor, forces, out)


@kernel
def _balance(cluster: Cluster, given: np.ndarray, forces: np.ndarray) -> None:
    """Find ``forces`` (dof,) of stuck sites i with ``given`` (dof,) + sum over all j of g_ij forces_j = 0 there.

    g_ij is the acceleration of i by a force on j at once. Forces of other DoFs are given, those of stuck sites are 0;
    ``given`` is overwritten.
    """
    any_shared = False
    for i in range(cluster.contacts.size):
        if abs(cluster.contacts[i].mode) == STUCK:
            any_shared |= cluster.contacts[i].shares
            for j in range(forces.size):
                given[i] += cluster.response[i, j, 0] * forces[j]
            given[i] /= -cluster.response[i, i, 0]
    if any_shared:
        _balance_together(cluster.contacts, given)
    for i in range(cluster.contacts.size):
        if abs(cluster.contacts[i].mode) == STUCK:
            forces[i] += given[i]


@kernel
def _balance_together(contacts: np.ndarray, alone: np.ndarray) -> None:
    """Replace the forces ``alone`` (site or more,) of stuck sites, each by itself, by those that hold all together."""
    sites = np.empty(contacts.size, np.int64)
    corrections = np.empty((contacts.size, 1))
    for i in range(contacts.size):
        sites[i] = i
        corrections[i, 0] = alone[i]
    _correct_together(contacts, sites, corrections)
    for i in range(contacts.size):
        alone[i] = corrections[i, 0]


@kernel
def _find_reactions(cluster: Cluster, taylor: np.ndarray, forces: np.ndarray) -> None:
    """Put the reactions of stuck sites at the present position into ``forces`` (dof,), which has all other forces."""
    given = cluster.trial.sums.given[: forces.size]
    for i in range(cluster.contacts.size):
        given[i] = 2.0 * taylor[i, 2]
        if abs(cluster.contacts[i].mode) == STUCK:
            forces[i] = 0.0
    _balance(cluster, given, forces)
    for i in range(cluster.contacts.size):
        if abs(cluster.contacts[i].mode) == STUCK:
            cluster.contacts[i].reaction = -forces[i]


@kernel
def _put_reactions(cluster: Cluster, taylor: np.ndarray, forces: np.ndarray, out: np.ndarray) -> None:
    """Put R, R', 0 of stuck sites into ``out`` (site, 3), which has the motion of all; ``forces`` (dof,) act.

    The derivative of w'' = 0 has the rates of the others' forces, and with dashpots a term of the forces themselves.
    """
    state = cluster.state[0]
    sites = cluster.contacts.size
    h = cluster.interval
    rates = cluster.trial.sums.rates[: forces.size]
    for i in range(sites):
        step = RATE_SHIFT * h
        after = _force_on_site(cluster.contacts, i, out[i, 0] + step * out[i, 1], out[i, 1] + step * out[i, 2])
        before = _force_on_site(cluster.contacts, i, out[i, 0] - step * out[i, 1], out[i, 1] - step * out[i, 2])
        rates[i] = (after - before) / (2.0 * RATE_SHIFT)
    for i in range(sites, first_drive(cluster)):
        step = RATE_SHIFT * taylor[i, 1]
        after = _force_of_spring(cluster, i, taylor[i, 0] + step)
        rates[i] = (after - _force_of_spring(cluster, i, taylor[i, 0] - step)) / (2.0 * RATE_SHIFT)
    for i in range(first_drive(cluster), forces.size):
        t = state.begin + state.position * h
        after = drive_force(cluster.drives, i, t + RATE_SHIFT * h)
        rates[i] = (after - drive_force(cluster.drives, i, t - RATE_SHIFT * h)) / (2.0 * RATE_SHIFT)

    # Free motion, and with dashpots the second power in the responses.
    given = cluster.trial.sums.given[: forces.size]
    for i in range(sites):
        given[i] = 6.0 * taylor[i, 3]
        if _stride(cluster) == 1:
            for j in range(forces.size):
                given[i] += 2.0 * cluster.response[i, j, 1] * forces[j]
    _balance(cluster, given, rates)
    for i in range(sites):
        if abs(cluster.contacts[i].mode) == STUCK:
            side = side_of(cluster.contacts[i].mode)
            out[i, 0] = -side * forces[i]
            out[i, 1] = -side * rates[i] / h
            out[i, 2] = 0.0


@inlined
def _stride(cluster: Cluster) -> int:
    """Return the distance between powers of time in a response: 2, since they are odd, or with dashpots 1.

    A series has 2 n coefficients, a response its n odd ones, or with dashpots the 2 n - 1 after the zeroth: the sizes
    of the two arrays tell them apart.
    """
    return 1 if 2 * cluster.response.shape[2] > cluster.taylor.shape[1] else 2


@kernel
def node_responses(cluster: Cluster, substep: Substep, i: int, j: int, to_w: np.ndarray, to_v: np.ndarray) -> bool:
    """Fill ``to_w`` and ``to_v`` (node k, node) with what a unit force of DoF ``j`` at node k adds to w, w' of ``i``.

    They are in m/N and m/s/N, the sums of the module's docstring. Returns whether any term of them counts.
    """
    to_w[:] = 0.0
    to_v[:] = 0.0
    reaches = False

    # The power p of the term at hand, and d^p; then those of the next one.
    p = 1
    power = substep.length
    stride = _stride(cluster)
    ratio = substep.length
    if stride == 2:
        ratio *= substep.length

    # Terms have a bound that falls as those of the fastest mode's sine, with dashpots of its exponential function: from
    # one power p to the next by theta d/(p + 1), theta = ``omega_max_h``. It begins at (g_ii g_jj)^1/2, counted as 1.
    size = 1.0
    radians = cluster.omega_max_h * substep.length
    for m in range(cluster.response.shape[2]):
        g = cluster.response[i, j, m]
        if g != 0.0:
            reaches = True
            w_factor = g * power * substep.length
            v_factor = g * power * p / cluster.interval
            for k in range(NODES):
                for node in range(NODES):
                    to_w[k, node] += w_factor * cluster.nodes.powers[substep.kind, p, k, node]
                    to_v[k, node] += v_factor * cluster.nodes.powers[substep.kind, p - 1, k, node]
        power *= ratio
        if stride == 1:
            size *= radians / (p + 1)
        else:
            size *= radians**2 / ((p + 1) * (p + 2))
        if size < SMALLEST_RESPONSE:
            break
        p += stride
    return reaches


@kernel
def _prepare_stuck(cluster: Cluster, trial: Trial, substep: Substep) -> None:
    """Fill ``free_a`` and ``to_a`` of the stuck sites at the nodes: see the module's docstring."""
    sums = trial.sums
    active = trial.active
    stride = _stride(cluster)
    for target in range(trial.closed.size):
        i = active[target]
        if abs(cluster.contacts[i].mode) != STUCK:
            continue
        for node in range(NODES):
            s = substep.length * cluster.nodes.position[substep.kind, node]
            sums.free_a[target, node] = curvature(cluster.taylor[i], s)

        for source in range(active.size):
            to_a = sums.to_a[target, source]
            to_a[:] = 0.0
            for m in range(1, cluster.response.shape[2]):
                p = stride * m + 1
                factor = p * (p - 1) * cluster.response[i, active[source], m] * substep.length ** (p - 1)
                if factor != 0.0:
                    for k in range(NODES):
                        for node in range(NODES):
                            to_a[k, node] += factor * cluster.nodes.powers[substep.kind, p - 2, k, node]


@kernel
def _fill_residuals(cluster: Cluster, trial: Trial) -> None:
    """Fill what is left of w'' of the stuck sites at the nodes, by all forces of the sweep before."""
    sums = trial.sums
    active = trial.active
    for target in range(trial.closed.size):
        i = active[target]
        if abs(cluster.contacts[i].mode) != STUCK:
            continue
        for node in range(NODES):
            total = sums.free_a[target, node]
            for source in range(active.size):
                force = trial.force[active[source]]
                total += cluster.response[i, active[source], 0] * force[node]
                for k in range(NODES):
                    total += sums.to_a[target, source, k, node] * force[k]
            sums.residuals[target, node] = total
            sums.corrections[target, node] = 0.0


@kernel
def _find_corrections(cluster: Cluster, trial: Trial) -> None:
    """Find the corrections of the reactions at the nodes whose accelerations at once balance the residuals."""
    any_shared = False
    for target in range(trial.closed.size):
        i = trial.active[target]
        if abs(cluster.contacts[i].mode) == STUCK:
            any_shared |= cluster.contacts[i].shares
            for node in range(NODES):
                trial.sums.corrections[target, node] = -trial.sums.residuals[target, node] / cluster.response[i, i, 0]
    if any_shared:
        _correct_together(cluster.contacts, trial.closed, trial.sums.corrections)


@kernel
def _correct_together(contacts: np.ndarray, closed: np.ndarray, corrections: np.ndarray) -> None:
    """Replace forces on stuck sites that each would need alone by those that hold all of them together.

    They are ``corrections`` (row, column), whose first rows belong to the sites ``closed``, stuck or not.
    """
    stuck = np.empty(closed.size, np.int64)
    places = np.empty(closed.size, np.int64)
    count = 0
    for target in range(closed.size):
        if abs(contacts[closed[target]].mode) == STUCK:
            stuck[count] = closed[target]
            places[count] = target
            count += 1

    joined = join(contacts, stuck[:count])
    x = np.empty(count)
    for column in range(corrections.shape[1]):
        # The response at once is the matrix of ``join`` in units of H.
        for k in range(count):
            x[k] = corrections[places[k], column] * entry(contacts, stuck[k], stuck[k])
        solve(joined, x)
        for k in range(count):
            corrections[places[k], column] = x[k]


@kernel
def _hold_stuck(cluster: Cluster, trial: Trial, substep: Substep) -> float:
    """Correct the reactions of stuck sites at the nodes to what makes w'' vanish there, with the forces of others.

    Returns the largest correction, relative to the largest reaction of the site and to the force that would give its
    masses the speed of the motion within the substep.
    """
    _fill_residuals(cluster, trial)
    _find_corrections(cluster, trial)
    change = 0.0
    for target in range(trial.closed.size):
        i = trial.active[target]
        site = cluster.contacts[i]
        if abs(site.mode) != STUCK:
            continue
        correction = 0.0
        largest = 0.0
        for node in range(NODES):
            trial.force[i, node] += trial.sums.corrections[target, node]
            correction = max(correction, abs(trial.sums.corrections[target, node]))
            largest = max(largest, abs(trial.force[i, node]))
        scale = abs(site.approach) * cluster.interval / (substep.length * cluster.response[i, i, 0])
        # ``not ... <`` is true of NaN as well.
        if not correction / (largest + scale) < np.inf:
            return np.inf
        change = max(change, correction / (largest + scale))
    return change


@inlined
def _prepare_nodes(cluster: Cluster, trial: Trial, substep: Substep) -> None:
    """Fill what does not change while forces are iterated: free motion, drives' forces, responses at the nodes.

    All but the drives' forces goes into the workspace ``trial.sums``.
    """
    state = cluster.state[0]
    h = cluster.interval
    sums = trial.sums
    active = trial.active
    # Rows of the workspace are numbered by places among the active DoFs, those of the trial by DoFs.
    for place in range(active.size):
        i = active[place]
        for node in range(NODES):
            s = substep.length * cluster.nodes.position[substep.kind, node]
            sums.free_w[place, node], slope = evaluate(cluster.taylor[i], s)
            sums.free_v[place, node] = slope / h
            if i >= first_drive(cluster):
                trial.force[i, node] = drive_force(cluster.drives, i, state.begin + (state.position + s) * h)

    for target in range(active.size):
        for source in range(active.size):
            to_w = sums.to_w[target, source]
            to_v = sums.to_v[target, source]
            sums.reaches[target, source] = node_responses(cluster, substep, active[target], active[source], to_w, to_v)


@kernel
def _add_responses(to_w: np.ndarray, to_v: np.ndarray, forces: np.ndarray, w: np.ndarray, v: np.ndarray) -> None:
    """Add to ``w`` and ``v`` (node,) what the ``forces`` (node k,) add by their responses (node k, node)."""
    for k in range(NODES):
        for node in range(NODES):
            w[node] += to_w[k, node] * forces[k]
            v[node] += to_v[k, node] * forces[k]


@inlined
def _move(cluster: Cluster, trial: Trial) -> float:
    """Move the active DoFs at the nodes by the forces there.

    At node j of a DoF w_j = (free w)_j + sum over the sources and their nodes k of R_kj F_k, with the responses R of
    ``node_responses``, and v likewise. Returns the largest change as ``_replace`` measures it, inf if a motion is not
    finite.
    """
    active = trial.active
    sums = trial.sums
    # The new motion of one DoF. Each DoF moves by all forces of the sweep before: the order of DoFs does not count.
    w = sums.w
    v = sums.v
    change = 0.0
    for target in range(active.size):
        for node in range(NODES):
            w[node] = sums.free_w[target, node]
            v[node] = sums.free_v[target, node]

        for source in range(active.size):
            if sums.reaches[target, source]:
                _add_responses(sums.to_w[target, source], sums.to_v[target, source], trial.force[active[source]], w, v)
        change = max(change, _replace(cluster, active[target], w, v, trial))
    return change


@kernel
def _replace(cluster: Cluster, i: int, w: np.ndarray, v: np.ndarray, trial: Trial) -> float:
    """Put the motion ``w``, ``v`` of DoF ``i`` at the nodes into ``trial``; returns the largest change.

    A change of a site's w is divided by its ``scale``, its clearance or, where that is 0, the size of waves; one of w'
    by |w'| plus the contact's approach velocity; one of a spring's elongation by its largest value plus the spring's
    ``scale``, the size of waves in m. It is inf if the motion is not finite, and 0 for a driven mass, whose force does
    not depend on its motion.
    """
    contacts = cluster.contacts
    change = 0.0
    largest = 0.0
    for node in range(NODES):
        # ``not ... <`` is true of NaN as well.
        if not abs(w[node]) + abs(v[node]) < np.inf:
            return np.inf
        if i < contacts.size:
            site = contacts[i]
            if abs(site.mode) == STUCK:
                continue  # its reaction decides, not its motion
            change = max(change, abs(w[node] - trial.w[i, node]) / site.scale)
            # Never 0/0: a contact begins only at a speed above zero, and one that touches or is pressed at rest has the
            # typical speed of waves in its place (``contact.law.hold``).
            change = max(change, abs(v[node] - trial.v[i, node]) / (abs(v[node]) + abs(site.approach)))
        elif i < first_drive(cluster):
            change = max(change, abs(w[node] - trial.w[i, node]))
            largest = max(largest, abs(w[node]))
        trial.w[i, node] = w[node]
        trial.v[i, node] = v[node]
    if contacts.size <= i < first_drive(cluster):
        change /= largest + cluster.springs[i - contacts.size].scale
    return change


@kernel
def collocate(cluster: Cluster, trial: Trial, substep: Substep) -> bool:
    """Solve for the force and motion of the active DoFs at the nodes of a substep; whether the iteration converged.

    Picard's iteration, which begins with the forces that ``trial`` holds: those of the substep before are near. On
    return the motion at the nodes is exactly that which the forces in ``trial`` cause; the law, put to that motion,
    would give forces that differ by the last change, which is rounding.
    """
    contacts = cluster.contacts
    _prepare_nodes(cluster, trial, substep)
    any_stuck = has_stuck_sites(cluster)
    if any_stuck:
        _prepare_stuck(cluster, trial, substep)
    last = np.inf
    for _ in range(MOST_SWEEPS):
        change = _move(cluster, trial)
        if any_stuck:
            change = max(change, _hold_stuck(cluster, trial, substep))
        if change < CONVERGED or (change < STAGNANT and change >= last):
            return True
        if change == np.inf:
            break
        last = change
        for i in trial.closed:
            if abs(contacts[i].mode) == STUCK:
                continue
            for node in range(NODES):
                trial.force[i, node] = _force_on_site(contacts, i, trial.w[i, node], trial.v[i, node])
        for i in trial.springs:
            for node in range(NODES):
                trial.force[i, node] = _force_of_spring(cluster, i, trial.w[i, node])

    # The shorter substep that is tried next must not begin with forces that diverged, or with motions that did.
    trial.force[: first_drive(cluster)] = 0.0
    trial.w[:] = 0.0
    trial.v[:] = 0.0
    return False


@kernel
def update_taylor(cluster: Cluster, trial: Trial, substep: Substep) -> None:
    """Put the series of all DoFs' free motion after a substep, in which the forces of ``trial`` acted, into ``trial``.

    After the substep's end the term g s^p of a response adds g times the sum over k of binom(p, k) mu_(p - k) s^k: mu_k
    is the integral over the substep of the force times the k-th power of the lag, the time to the substep's end, in
    units of H. (``Cluster.moments`` are in N s, about the end of the step.)
    """
    moments = trial.sums.moments
    # Row m: what the m-th term of a response makes of the moments.
    series = trial.sums.series
    dofs, _, terms = cluster.response.shape
    stride = _stride(cluster)
    coefficients = cluster.taylor.shape[1]

    shift(cluster.taylor, substep.length, trial.taylor)
    for source in trial.active:
        moments[:] = 0.0
        for node in range(NODES):
            # The integrand of mu_k at this node, times the node's weight: k = 0 first, then times the lag.
            amount = substep.length * cluster.nodes.weight[substep.kind, node] * trial.force[source, node]
            lag = substep.length * (1.0 - cluster.nodes.position[substep.kind, node])
            for k in range(coefficients):
                moments[k] += amount
                amount *= lag

        # The powers p = stride m + 1 of the response, each expanded once for all DoFs that it moves: binom(p, k)
        # mu_(p - k) s^k. Then times each DoF's coefficient g of that power.
        for m in range(terms):
            p = stride * m + 1
            for k in range(p + 1):
                series[m, k] = BINOMIALS[p, k] * moments[p - k]
        for i in range(dofs):
            for m in range(terms):
                g = cluster.response[i, source, m]
                if g != 0.0:
                    for k in range(stride * m + 2):
                        trial.taylor[i, k] += g * series[m, k]


@kernel
def error_ratio(cluster: Cluster, trial: Trial, length: float) -> float:
    """Return estimated error of a substep of ``length`` over the allowed one, by the last two Legendre coefficients.

    ``advance`` accepts a ratio up to 1, and the next length follows from it. Both coefficients count, for in a force
    that is symmetric about the substep's middle every other one vanishes. The error of a force becomes one of velocity
    by the first term g_ii s of the site's own response, the sum of H^2/mass over the site's masses. The first term of
    another site's response is no larger, the same sum over the masses that belong to both, and the velocity that the
    force gives this site is smaller in the same ratio. Later terms bear higher powers of the length. Allowed are
    ``rtol`` |w'_minus| + ``atol`` in m/s, w'_minus the approach velocity, for a spring the largest rate at the nodes.
    """
    worst = 0.0
    for i in trial.closed:
        allowed = cluster.rtol * abs(cluster.contacts[i].approach) + cluster.atol
        worst = max(worst, _error_of_force(cluster, trial, i, length) / allowed)
    for i in trial.springs:
        largest = 0.0
        for node in range(NODES):
            largest = max(largest, abs(trial.v[i, node]))
        worst = max(worst, _error_of_force(cluster, trial, i, length) / (cluster.rtol * largest + cluster.atol))
    return worst


@kernel
def _error_of_force(cluster: Cluster, trial: Trial, i: int, length: float) -> float:
    """Return estimated error in m/s of the rate of DoF ``i`` by its own force in a substep of ``length``."""
    last = 0.0
    for row in range(2):
        coefficient = 0.0
        for node in range(NODES):
            coefficient += cluster.nodes.tail[row, node] * trial.force[i, node]
        last += abs(coefficient)
    return SUPERCONVERGENCE * last * length * cluster.response[i, i, 0] / cluster.interval


@kernel
def accumulate_moments(cluster: Cluster, trial: Trial, substep: Substep) -> None:
    """Add a substep's forces to ``Cluster.moments``, and to the energies what drives did and what sites dissipated."""
    h = cluster.interval
    position = cluster.state[0].position
    for i in trial.active:
        for node in range(NODES):
            duration = h * substep.length * cluster.nodes.weight[substep.kind, node]
            if i < cluster.contacts.size:
                # The elastic part of a contact's work comes back: its energy counts only what is lost.
                _, power = contact_force(cluster.contacts, i, trial.w[i, node], trial.v[i, node])
            elif i < first_drive(cluster):
                power = 0.0  # all of a spring's work comes back
            else:
                power = drive_power(cluster.drives, i, trial.force[i, node], trial.v[i, node])
            cluster.energy[i] += duration * power

            # Integrals over the step of F (1 - s)^k: k = 0 first, then times what remains of the step.
            remaining = 1.0 - position - substep.length * cluster.nodes.position[substep.kind, node]
            amount = duration * trial.force[i, node]
            for k in range(cluster.moments.shape[1]):
                cluster.moments[i, k] += amount
                amount *= remaining
