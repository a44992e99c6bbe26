"""The equations of motion of a lattice and of its derivatives with respect to parameters, compiled.

They are derived in the docstring of the package.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.contact.law import CLIPPED, FREE, elastic_force_and_slope, gap_of, side_of
from vipetsc.dynamics.drives import Drives, drive_force
from vipetsc.dynamics.spring_law import nonlinear_force, nonlinear_slope

# Half the time, over 1/omega of a drive's highest frequency, between whose ends a difference of its force gives the
# rate. The relative error of the difference is 1e-12/6, that of rounding 1e-10.
SHORT = 1e-6


class Slopes(NamedTuple):
    """Derivatives of the lattice's coefficients with respect to each parameter.

    ``masses`` (parameter, n), ``stiffness`` and ``damping`` (parameter, entry); ``gaps`` (parameter, site, 2) on the
    sides + and -; ``laws`` (parameter, site, 3) of the contact stiffness, the exponent and the damping c; ``drives``
    (parameter, drive), relative to the drive's amplitude; ``curves`` (parameter, spring of the cell, 2) of the
    springs' quadratic and cubic parts. ``linear`` (parameter,): whether a mass, a spring or a dashpot depends on it.
    """

    masses: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    gaps: np.ndarray
    laws: np.ndarray
    drives: np.ndarray
    curves: np.ndarray
    linear: np.ndarray


class CurvedSprings(NamedTuple):
    """Springs with a quadratic or cubic part, beyond their linear part, which is in K.

    ``ends`` (place, 2): masses, -1 for a wall; ``numbers`` (place,) of the springs in the cell; ``laws`` (place,) of
    dtype ``SPRING_LAW``.
    """

    ends: np.ndarray
    numbers: np.ndarray
    laws: np.ndarray


class Lattice(NamedTuple):
    """A lattice of n masses: ``inverse_mass`` (n,) in 1/kg, the matrices K and C, contacts, drives, their ``slopes``.

    Row i of K and C has the entries ``first[i]`` to ``first[i + 1]`` of ``stiffness`` and ``damping`` (entry,), in the
    columns ``columns`` (entry,). ``ends`` (site, 2) are the host, -1 for the ground, and the resonator of the
    ``contacts`` (site,) of dtype ``SITE``; the ``target`` of each row of ``drives`` is a mass.
    """

    inverse_mass: np.ndarray
    first: np.ndarray
    columns: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    curved: CurvedSprings
    contacts: np.ndarray
    ends: np.ndarray
    drives: Drives
    slopes: Slopes


class MotionState(NamedTuple):
    """State and workspace. Column 0 is the motion, column 1 + p its derivative with respect to parameter p.

    A coordinate of the initial state is such a parameter: its column begins with the derivative of that state. Rows are
    the displacements of all masses, then the velocities.

    ``state`` and ``end`` (2n, column) are those at both ends of a step, ``rates`` (2n, column) the time derivatives at
    its end, ``stages`` (stage, 2n, column) those of the method, of which the first belongs to ``state``. ``estimates``
    (2, 2n, column) are those of errors, of orders 3 and 5; ``approach`` (site, column) has the derivatives of w'_minus
    in columns from 1 on. ``before`` and ``after`` (site, 3) hold w, w', w'' at both ends of a step, ``largest``
    (column,) the largest displacements, and velocities over the highest frequency, so far. ``tolerances`` (2,) are the
    errors allowed per step, relative to these, of the motion and of its derivatives; ``room`` (2, 6) is scratch.
    """

    state: np.ndarray
    end: np.ndarray
    stages: np.ndarray
    rates: np.ndarray
    estimates: np.ndarray
    approach: np.ndarray
    before: np.ndarray
    after: np.ndarray
    largest: np.ndarray
    tolerances: np.ndarray
    room: np.ndarray


@kernel
def difference(y: np.ndarray, ends: np.ndarray, i: int, first: int, j: int) -> float:
    """Entry of column ``j`` of ``y``, from row ``first`` on, at the second end of the pair ``i`` less at the first one.

    ``ends`` are (pair, 2) rows of ``y`` (row, column): host and resonator of a site. An end of -1, ground or wall, has
    an entry of zero.
    """
    value = 0.0
    if ends[i, 1] >= 0:
        value = y[first + ends[i, 1], j]
    if ends[i, 0] >= 0:
        value -= y[first + ends[i, 0], j]
    return value


@kernel
def _add_contact(lattice: Lattice, i: int, y: np.ndarray, approach: np.ndarray, out: np.ndarray) -> None:
    """Add the force of the closed site ``i`` and its derivatives to ``out`` (2n, column), in the rows of velocities.

    F = sigma f(x) g with x = sigma w - D and g = 1 + c v/q, where v = w', q = w'_minus and c is the damping. Hence

        F_w = f' g,    F_v = sigma f c/q,    F_q = -F_v v/q,    F_D = -sigma f' g,    F_c = sigma f v/q.
    """
    n = lattice.inverse_mass.size
    site = lattice.contacts[i]
    slopes = lattice.slopes
    side = side_of(site.mode)
    which = 0 if site.mode > 0 else 1
    w = difference(y, lattice.ends, i, 0, 0)
    rate = difference(y, lattice.ends, i, n, 0)
    x = side * w - gap_of(site, side)
    elastic, slope = elastic_force_and_slope(site.elastic, x)
    g = 1.0 + site.damping * rate / site.approach
    by_rate = side * elastic * site.damping / site.approach
    by_approach = -by_rate * rate / site.approach
    # The derivative of k x^n by n is k x^n log x, which vanishes at the onset. A landing may end at x just below zero.
    by_exponent = 0.0
    if x > 0.0:
        by_exponent = elastic * np.log(x)

    host = lattice.ends[i, 0]
    resonator = lattice.ends[i, 1]
    for j in range(y.shape[1]):
        force = side * elastic * g
        if j > 0:
            force = slope * g * difference(y, lattice.ends, i, 0, j)
            force += by_rate * difference(y, lattice.ends, i, n, j)
            force += by_approach * approach[i, j]
            force -= side * slope * g * slopes.gaps[j - 1, i, which]
            force += side * g * elastic / site.elastic.stiffness * slopes.laws[j - 1, i, 0]
            force += side * g * by_exponent * slopes.laws[j - 1, i, 1]
            force += side * elastic * rate / site.approach * slopes.laws[j - 1, i, 2]
        out[n + resonator, j] -= force
        if host >= 0:
            out[n + host, j] += force


@kernel
def _add_springs(lattice: Lattice, y: np.ndarray, out: np.ndarray) -> None:
    """Add the forces of linear springs and dashpots and their derivatives to ``out`` (2n, column), in rows from n on.

    ``y`` (2n, column) are the motion and its derivatives.
    """
    n = lattice.inverse_mass.size
    slopes = lattice.slopes
    for i in range(n):
        for e in range(lattice.first[i], lattice.first[i + 1]):
            c = lattice.columns[e]
            stiffness = lattice.stiffness[e]
            damping = lattice.damping[e]
            for j in range(y.shape[1]):
                out[n + i, j] -= stiffness * y[c, j]
            if damping != 0.0:
                for j in range(y.shape[1]):
                    out[n + i, j] -= damping * y[n + c, j]
            # -K_p u - C_p u' of the parameters on which K and C depend.
            for p in range(slopes.linear.size):
                if slopes.linear[p]:
                    out[n + i, 1 + p] -= slopes.stiffness[p, e] * y[c, 0] + slopes.damping[p, e] * y[n + c, 0]


@kernel
def _add_curved_springs(lattice: Lattice, y: np.ndarray, out: np.ndarray) -> None:
    """Add the forces of springs beyond their linear parts, and their derivatives, to ``out``, in rows from n on.

    With N = q z^2 + c z^3 of an elongation z, the derivative is N_z dz + q_p z^2 + c_p z^3.
    """
    n = lattice.inverse_mass.size
    ends = lattice.curved.ends
    for k in range(lattice.curved.numbers.size):
        number = lattice.curved.numbers[k]
        law = lattice.curved.laws[k]
        z = difference(y, ends, k, 0, 0)
        slope = nonlinear_slope(law, z)
        for j in range(y.shape[1]):
            if j == 0:
                force = nonlinear_force(law, z)
            else:
                curves = lattice.slopes.curves[j - 1, number]
                force = slope * difference(y, ends, k, 0, j) + (curves[0] + curves[1] * z) * z * z
            if ends[k, 0] >= 0:
                out[n + ends[k, 0], j] += force
            if ends[k, 1] >= 0:
                out[n + ends[k, 1], j] -= force


@kernel
def rates_of(lattice: Lattice, t: float, y: np.ndarray, approach: np.ndarray, out: np.ndarray) -> None:
    """Time derivatives ``out`` (2n, column) of the motion and its derivatives ``y`` (2n, column) at time ``t`` in s.

    ``approach`` (site, column) are the derivatives of w'_minus in columns from 1 on.
    """
    n = lattice.inverse_mass.size
    slopes = lattice.slopes
    for i in range(n):
        for j in range(y.shape[1]):
            out[i, j] = y[n + i, j]
            out[n + i, j] = 0.0
    # Until masses divide them, the rows of accelerations are sums of forces.
    _add_springs(lattice, y, out)
    _add_curved_springs(lattice, y, out)
    for d in range(lattice.drives.rows.size):
        force = drive_force(lattice.drives, d, t)
        target = n + lattice.drives.rows[d].target
        out[target, 0] += force
        for p in range(slopes.linear.size):
            out[target, 1 + p] += slopes.drives[p, d] * force
    for i in range(lattice.contacts.size):
        mode = abs(lattice.contacts[i].mode)
        if mode != FREE and mode != CLIPPED:
            _add_contact(lattice, i, y, approach, out)

    for i in range(n):
        for j in range(y.shape[1]):
            out[n + i, j] *= lattice.inverse_mass[i]
        # From M du'' = df - dM u'': dM times the acceleration acts as a force.
        for p in range(slopes.linear.size):
            if slopes.linear[p]:
                out[n + i, 1 + p] -= slopes.masses[p, i] * lattice.inverse_mass[i] * out[n + i, 0]


@kernel
def observe(lattice: Lattice, y: np.ndarray, rates: np.ndarray, motion: np.ndarray) -> None:
    """Put w, w' and w'' of every site into ``motion`` (site, 3), from ``y`` (2n, column) and its ``rates``."""
    n = lattice.inverse_mass.size
    for i in range(lattice.contacts.size):
        motion[i, 0] = difference(y, lattice.ends, i, 0, 0)
        motion[i, 1] = difference(y, lattice.ends, i, n, 0)
        motion[i, 2] = difference(rates, lattice.ends, i, n, 0)


@kernel
def jerk(lattice: Lattice, motion: MotionState, t: float, i: int) -> float:
    """Rate of the acceleration in m/s^3 of mass ``i`` at the state of ``motion``, ``t`` in s.

    It is the time derivative of the equation of motion; the state's rates are the first stage.
    """
    n = lattice.inverse_mass.size
    rates = motion.stages[0]
    total = 0.0

    # Springs and dashpots.
    for e in range(lattice.first[i], lattice.first[i + 1]):
        c = lattice.columns[e]
        total -= lattice.stiffness[e] * rates[c, 0] + lattice.damping[e] * rates[n + c, 0]

    for k in range(lattice.curved.numbers.size):
        ends = lattice.curved.ends
        if ends[k, 0] == i or ends[k, 1] == i:
            slope = nonlinear_slope(lattice.curved.laws[k], difference(motion.state, ends, k, 0, 0))
            change = slope * difference(rates, ends, k, 0, 0)
            total += change if ends[k, 0] == i else -change

    # Drives have no formula for the rate of their force: a difference takes its place.
    for d in range(lattice.drives.rows.size):
        row = lattice.drives.rows[d]
        if row.target == i and row.highest > 0.0:
            short = SHORT / row.highest
            change = drive_force(lattice.drives, d, t + short) - drive_force(lattice.drives, d, t - short)
            total += change / (2.0 * short)

    # Closed contacts on this mass: the force F on the host is -F on the resonator.
    for c in range(lattice.contacts.size):
        site = lattice.contacts[c]
        is_host = lattice.ends[c, 0] == i
        if not (is_host or lattice.ends[c, 1] == i) or site.mode == FREE or abs(site.mode) == CLIPPED:
            continue

        side = side_of(site.mode)
        x = side * motion.before[c, 0] - gap_of(site, side)
        elastic, slope = elastic_force_and_slope(site.elastic, x)
        # The rate of F = sigma f(x) g(w') is f' g w' + sigma f c w''/w'_minus.
        g = 1.0 + site.damping * motion.before[c, 1] / site.approach
        change = slope * g * motion.before[c, 1]
        change += side * elastic * site.damping / site.approach * motion.before[c, 2]
        total += change if is_host else -change
    return total * lattice.inverse_mass[i]
