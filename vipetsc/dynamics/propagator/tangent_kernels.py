r"""Compiled motion of variations along an orbit, by the same exact steps: sec. 9 of the derivation.

**9. Variations.** A variation dy is the difference to a neighbouring orbit, to first order. It moves through a step by

    dy+ = P dy + (impulses of dmu),    (dmu, dq+) = J (da, dq),    da linear in dy (sec. 2),

with the exact linear step P, the series a of a cluster's free motion, the moments mu of its forces and the approach
velocities q of its contacts. ``tangent`` explains why only q is varied at onsets, and why substeps keep their lengths.
``move_variations`` applies these lines, and ``linearise`` computes J, for one step and cluster, from the substeps on
the orbit's tape.

**J.** Column j of J is what becomes of a unit of the j-th of the numbers (a, q): all unit vectors are carried through
the step together. Where the tape has nothing, series are shifted. In a substep the collocation of sec. 3 is linearised
at its nodes: the variations of the forces there and of the motion obey

    dF = F_w dw + F_v dv + F_q dq,    (dw, dv) = (dw, dv)_free + R dF,

with the derivatives F_w, F_v, F_q of the law and the responses R of sec. 3, a linear system for dF. From dF the series
at the substep's end and the moments follow as those of the motion do from F. At an onset dq = dw' - w'' dw/w'.
"""

from typing import Any, NamedTuple

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.contact.law import CLIPPED, PERMANENT, elastic_force_and_slope, gap_of, side_of
from vipetsc.dynamics.propagator.clusters import DofTables, apply_impulses, expand_free_motion
from vipetsc.dynamics.propagator.collocation import accumulate_moments, node_responses, update_taylor
from vipetsc.dynamics.propagator.linear_system import solve_in_place
from vipetsc.dynamics.propagator.nodes import NODES
from vipetsc.dynamics.propagator.stencil import Halo, Stencil, apply_propagator, exchange
from vipetsc.dynamics.propagator.substeps import Cluster, Substep, Trial
from vipetsc.dynamics.propagator.taylor import copy, evaluate, shift


class Variations(NamedTuple):
    """Variations that are moved together.

    ``components`` (variation, 2, component) are states as ``Layout`` orders them: step k reads slot k % 2 and writes
    the other one. ``approach`` (variation, dof) are those of w'_minus. ``places`` (step, cluster) numbers the
    ``matrices`` (number, row, column), -1 without contact; ``taylor`` (dof, coefficient) is workspace.
    """

    components: np.ndarray
    approach: np.ndarray
    places: np.ndarray
    matrices: np.ndarray
    taylor: np.ndarray


@kernel
def _slopes(site: Any, row: Any, w: float, v: float) -> tuple[float, float, float]:
    """Derivatives with respect to w, w' and w'_minus of the force on a closed site's relative displacement."""
    # The site's own mode may have changed since: the tape has that of the substep.
    if abs(row.mode) == CLIPPED:
        # The force is clipped to zero.
        return 0.0, 0.0, 0.0
    side = side_of(row.mode)
    depth = side * w - gap_of(site, side)
    if abs(row.mode) >= PERMANENT and depth <= 0.0:
        # A contact that is pressed at rest has opened.
        return 0.0, 0.0, 0.0
    elastic, slope = elastic_force_and_slope(site.elastic, depth)
    g = 1.0 + site.damping * v / row.approach
    by_rate = -side * elastic * site.damping / row.approach
    return -slope * g, by_rate, -by_rate * v / row.approach


@kernel
def _begin_contact(cluster: Cluster, row: Any, x: np.ndarray, first: int) -> None:
    """Set the variations of w'_minus of a site whose contact begins, in the images ``x`` of unit vectors.

    ``x[j]`` holds the coefficients of all DoFs' series, then w'_minus of every site, from ``first`` on. The onset comes
    earlier by dw/w', and w'_minus changes by dw' - w'' dw/w'. Below its floor |w'_minus| is held there and does not
    vary.
    """
    # The place of dw in x[j]; that of dw' times the interval is the next one.
    w = row.site * cluster.taylor.shape[1]
    floored = abs(row.rate) < cluster.contacts[row.site].floor
    for j in range(x.shape[0]):
        change = 0.0
        if not floored:
            change = x[j, w + 1] / cluster.interval - row.acceleration * x[j, w] / row.rate
        x[j, first + row.site] = change


@kernel
def _force_variations(
    cluster: Cluster, rows: np.ndarray, motion: np.ndarray, substep: Substep, x: np.ndarray
) -> np.ndarray:
    """Variations (site and node, column) of the forces of the closed sites ``rows`` in a substep.

    At the nodes dF = F_w dw + F_v dv + F_q dq. The motion dw, dv is that of the free motion, by ``x``, and what dF adds
    through the responses R: with S = (F_w, F_v) on the diagonal

        (1 - S R) dF = S (dw, dv)_free + F_q dq.

    Drives do not depend on the state: their variations are zero.
    """
    sites = rows.size
    left = np.eye(sites * NODES)
    right = np.zeros((sites * NODES, x.shape[0]))
    slopes = np.zeros((NODES, 3))
    to_w = np.zeros((NODES, NODES))
    to_v = np.zeros((NODES, NODES))
    for target in range(sites):
        row = rows[target]
        of_target = slice(target * NODES, (target + 1) * NODES)
        for node in range(NODES):
            w = motion[target, 0, node]
            v = motion[target, 1, node]
            by_w, by_rate, by_approach = _slopes(cluster.contacts[row.site], row, w, v)
            slopes[node, 0] = by_w
            slopes[node, 1] = by_rate
            slopes[node, 2] = by_approach
        _fill_free_forces(cluster, substep, row.site, slopes, x, right[of_target])

        for source in range(sites):
            if node_responses(cluster, substep, row.site, rows[source].site, to_w, to_v):
                of_source = slice(source * NODES, (source + 1) * NODES)
                _subtract_responses(slopes, to_w, to_v, left[of_target, of_source])
    solve_in_place(left, right)
    return right


@kernel
def _fill_free_forces(
    cluster: Cluster, substep: Substep, i: int, slopes: np.ndarray, x: np.ndarray, out: np.ndarray
) -> None:
    """Put F_w dw + F_v dv + F_q dq of site ``i`` with the free motion's dw and dv into ``out`` (node, column).

    ``slopes`` (node, 3) are F_w, F_v and F_q; ``x`` (column, coefficient) as in ``_begin_contact``.
    """
    dofs, terms = cluster.taylor.shape
    for node in range(NODES):
        s = substep.length * cluster.nodes.position[substep.kind, node]
        for j in range(x.shape[0]):
            w, v = evaluate(x[j, i * terms : (i + 1) * terms], s)
            change = slopes[node, 0] * w + slopes[node, 1] * v / cluster.interval
            out[node, j] = change + slopes[node, 2] * x[j, dofs * terms + i]


@kernel
def _subtract_responses(slopes: np.ndarray, to_w: np.ndarray, to_v: np.ndarray, out: np.ndarray) -> None:
    """Subtract S R from the block ``out`` (node of the target, node k of the source) of the system."""
    for node in range(NODES):
        for k in range(NODES):
            # The responses are displacement (m/N) and velocity (m/s/N); only series are in units of H.
            out[node, k] -= slopes[node, 0] * to_w[k, node] + slopes[node, 1] * to_v[k, node]


@kernel
def _end_of_substep(rows: np.ndarray, begin: int) -> int:
    """The row after those of the substep that begins with the row ``begin``: it has one for each closed site."""
    stop = begin
    while stop < rows.size and rows[stop].position == rows[begin].position:
        stop += 1
    return stop


# Not a ``kernel``: it returns views to a function that counts references to them.
@kernel
def _select_closed(cluster: Cluster, rows: np.ndarray) -> Trial:
    """The workspace for variations in a substep whose closed sites are those of ``rows``.

    Nothing else acts on variations: drives do not depend on the motion, and nonlinear springs are refused.
    """
    room = cluster.trial
    active = room.active[: rows.size]
    for a in range(active.size):
        active[a] = rows[a].site
    return Trial(
        active=active,
        closed=active,
        springs=active[:0],
        force=room.force,
        w=room.w,
        v=room.v,
        taylor=room.taylor,
        site_motion=room.site_motion,
        sums=room.sums,
    )


@kernel
def _shift_all(x: np.ndarray, count: int, terms: int, s: float) -> None:
    """Shift the series (``count``, ``terms``) of free motion in each row of ``x`` to ``s`` later."""
    for j in range(x.shape[0]):
        series = x[j, : count * terms].reshape(count, terms)
        shift(series, s, series)


@kernel
def linearise(each: Any, c: int, rows: np.ndarray, motion: np.ndarray, out: np.ndarray) -> None:
    """Put the matrix J of cluster ``c`` in a step whose part of the tape is ``rows`` and ``motion`` into ``out``.

    J maps the series of the free motion (dof, coefficient) and the variations of w'_minus (site,) at the step's
    beginning to the moments of the forces and the variations of w'_minus at its end. The cluster's Taylor coefficients,
    moments, energies and position, and the workspace of a trial, are overwritten.
    """
    cluster = each[c]
    count, terms = cluster.taylor.shape
    size = count * terms
    columns = size + cluster.contacts.size

    # Column j of J is what becomes of a unit of the j-th number: all are carried through the step together.
    x = np.eye(columns)
    moments = np.zeros((columns, count, terms))
    begin = 0
    position = 0.0
    while begin < rows.size:
        stop = _end_of_substep(rows, begin)
        row = rows[begin]
        substep = Substep(row.kind, row.length)
        trial = _select_closed(cluster, rows[begin:stop])

        # Free motion up to it, where the tape has nothing.
        if row.position > position:
            _shift_all(x, count, terms, row.position - position)
        for a in range(begin, stop):
            if rows[a].onset:
                _begin_contact(cluster, rows[a], x, size)

        # Motion and moments are linear in the forces: the kernels for forces serve for their variations. Moments are
        # about the step's end, so that these need the position.
        forces = _force_variations(cluster, rows[begin:stop], motion[begin:stop], substep, x)
        cluster.state[0].position = row.position
        for j in range(columns):
            series = x[j, :size].reshape(count, terms)
            copy(series, cluster.taylor)
            copy(moments[j], cluster.moments)
            for a in range(trial.active.size):
                for node in range(NODES):
                    trial.force[trial.active[a], node] = forces[a * NODES + node, j]
            update_taylor(cluster, trial, substep)
            accumulate_moments(cluster, trial, substep)
            copy(trial.taylor, series)
            copy(cluster.moments, moments[j])
        begin = stop
        position = row.position + row.length

    for j in range(columns):
        moment = moments[j].reshape(size)
        for i in range(size):
            out[i, j] = moment[i]
        for i in range(size, columns):
            out[i, j] = x[j, i]


@kernel
def _contact_step(dofs: DofTables, c: int, variations: Variations, j: int, number: int, cells: np.ndarray) -> None:
    """Add to ``cells`` (2 dof, cell) what the forces of variation ``j`` in cluster ``c`` leave there.

    ``variations.taylor`` has the series of its free motion; ``variations.approach`` is updated. ``number`` is that of
    the matrix.
    """
    first = dofs.first[c]
    stop = dofs.first[c + 1]
    sites = dofs.sites[c]
    terms = variations.taylor.shape[1]
    size = (stop - first) * terms
    # The series of the DoFs, then w'_minus of the sites. Loops in place of array functions, which take seconds to
    # compile.
    series = variations.taylor[first:stop].reshape(size)
    approach = variations.approach[j, first : first + sites]
    before = np.empty(size + sites)
    for i in range(size):
        before[i] = series[i]
    for i in range(sites):
        before[size + i] = approach[i]

    matrix = variations.matrices[number]
    after = np.zeros(before.size)
    # A loop in place of BLAS, whose order of summation depends on the machine.
    for row in range(before.size):
        for k in range(before.size):
            after[row] += matrix[row, k] * before[k]
    apply_impulses(dofs, first, after[:size].reshape(stop - first, terms), cells)
    for i in range(sites):
        approach[i] = after[size + i]


@kernel
def _move_variation(
    variations: Variations, stencil: Stencil, halo: Halo, dofs: DofTables, owned: int, step: int, j: int
) -> int:
    """Move variation ``j`` through one ``step``: dy+ = P dy + (impulses of dmu); PETSc's error code. Collective."""
    # Two slots are read and written in turn, as the engine's states are.
    here = step % 2
    rows = halo.columns.shape[0]
    cells = variations.components[j, here, : rows * owned].reshape(rows, owned)
    next_cells = variations.components[j, 1 - here, : rows * owned].reshape(rows, owned)
    error = exchange(halo, 2 * j + here, cells)
    apply_propagator(stencil, cells, halo.columns, next_cells)

    # Only clusters in contact leave impulses; their series come from the halo, that is from before the step.
    for c in range(variations.places.shape[1]):
        number = variations.places[step, c]
        if number >= 0:
            expand_free_motion(dofs, c, halo.columns, variations.taylor)
            _contact_step(dofs, c, variations, j, number, next_cells)
    return error


@kernel
def move_variations(variations: Variations, stencil: Stencil, halo: Halo, dofs: DofTables, owned: int) -> int:
    """Move all variations through the orbit's steps; returns PETSc's error code. Collective."""
    for step in range(variations.places.shape[0]):
        # One after another in each step: the rows of P are then in the cache.
        for j in range(variations.components.shape[0]):
            error = _move_variation(variations, stencil, halo, dofs, owned, step, j)
            if error != 0:
                return error
    return 0
