"""Compiled losses of dashpots in a step, by the tables of ``loss_tables`` and the stencil of ``free_losses``.

The loss in a step is the integral of v^T C v, C the matrix of dashpots. The velocities v consist of those of free
motion from the state y at the step's beginning and of those that the forces F_l on the DoFs l have left, so that the
loss has three parts (sec. 10 of the derivation in the package's docstring):

    loss = y^T S y + sum_l int F_l(t) (B_l(t) y) dt + sum_lm int F_l(t) int_(t' < t) K_lm(t, t') F_m(t') dt' dt.

With r_l the velocities after a unit impulse on l at the time t, r_m those after one on m at t', and v_free the free
ones, integrals over what is left of the step after t give

    B_l(t) y = 2 int r_l^T C v_free,    K_lm(t, t') = 2 int r_l^T C r_m.

B_l and K_lm do not depend on the motion. They are expanded in Legendre's polynomials P_p of what remains of the step
after the impulses, a = 1 - t/H and b = 1 - t'/H in units of its length H:

    B_l = sum_p B_lp P_p(2 a - 1),    K_lm = sum_(p + q < degrees) K_lm,pq P_p(2 a - 1) P_q(2 b - 1).

``FreeLosses.rows`` are the B_lp and ``PairLosses.kernels`` the K_lm,pq, from ``loss_tables``; the stencil of S is made
in ``free_losses``. Forces enter by their moments, the integrals of F P_p dt, to which each substep adds by the values
of F at its nodes: pairs of times need not be gone through. Of Legendre's polynomials a dozen are enough; of powers it
would take forty, whose sums cancel (``loss_modes``).
"""

from typing import NamedTuple

import numpy as np

from vipetsc.compiled import allocating, inlined, kernel
from vipetsc.dynamics.propagator.clusters import DofTables, is_zero
from vipetsc.dynamics.propagator.nodes import NODES
from vipetsc.dynamics.propagator.stencil import Stencil, multiply_dense
from vipetsc.dynamics.propagator.substeps import Cluster, Substep, Trial
from vipetsc.dynamics.vectors import LANES, add_lanes, add_product, store, zeros


class FreeLosses(NamedTuple):
    """Losses by forces on a rank's DoFs times the rates of free motion; empty without dashpots.

    ``rows`` (table, 2 mass, cell, mode) are the B_lp of the module's docstring: by the state of the cells in the halo's
    columns from ``column`` (dof,) on, the loss in J of an impulse of 1 N s on a DoF, by modes. ``table`` (dof,) numbers
    the DoF's rows. ``leader`` (cluster,) is the rank's cell in which ``engine`` books the losses of a cluster's forces,
    which belong to no cell alone, and -1 on ranks that do not own it: several ranks compute the same losses.
    """

    column: np.ndarray
    table: np.ndarray
    rows: np.ndarray
    leader: np.ndarray


class PairLosses(NamedTuple):
    """Losses of dashpots by pairs of forces of a cluster, or of all clusters of a rank: see ``loss_tables``.

    ``kernels`` (kind, mode of the later impulse, mode of the earlier one) are the coefficients of the loss in J by two
    unit impulses, both orders of a pair together; those whose modes sum to less than ``degrees`` (kind,) count.
    ``kinds`` (dof of the later impulse, dof of the earlier one) numbers the table of the pair, -1 if the two are too
    far apart; the earlier one is counted within the cluster. In the present step: ``moments`` (dof, mode) in N s of the
    forces, ``loss`` (cluster,) in J so far. ``legendre`` (mode, node) and ``before`` (dof, mode, node) are workspace.
    There are two modes at least (``mode_count``); without dashpots there are none, and nothing here is called.
    """

    kinds: np.ndarray
    kernels: np.ndarray
    degrees: np.ndarray
    moments: np.ndarray
    loss: np.ndarray
    legendre: np.ndarray
    before: np.ndarray


@inlined
def select_losses(losses: PairLosses, dofs: DofTables, c: int) -> PairLosses:
    """The part of ``losses`` that belongs to cluster ``c``."""
    first = dofs.first[c]
    stop = dofs.first[c + 1]
    return PairLosses(
        kinds=losses.kinds[first:stop],
        kernels=losses.kernels,
        degrees=losses.degrees,
        moments=losses.moments[first:stop],
        loss=losses.loss[c : c + 1],
        legendre=losses.legendre,
        before=losses.before,
    )


@kernel
def add_free_losses(
    stencil: Stencil, state: np.ndarray, columns: np.ndarray, before: np.ndarray, after: np.ndarray
) -> None:
    """Put into ``after`` (cell,) what is ``before`` and the loss in J of free motion from ``state`` (2 dof, cell).

    ``columns`` (2 dof, column) are the state's halo. The loss is y . (S y) of the state y. S is symmetric: a block of
    the ``stencil``, displacements and velocities of two masses, has its own entries of S and, doubled, those with later
    blocks of the cell and with cells on the right. A last mass that is alone leaves rows of zeros. Each product of S y
    is multiplied by its y at once, and S y is not stored. ``before`` and ``after`` are different arrays.
    """
    x = state.reshape(-1)
    to = stencil.blocks
    places = stencil.places
    values = stencil.values
    for cell in range(after.size):
        after[cell] = before[cell]
    for first, stop in stencil.interior:
        for a in range(first, stop, LANES):
            # The last vector overlaps the one before. ``create_loss_stencil`` leaves shorter ranges to the borders.
            i = min(a, stop - LANES)
            loss = zeros()
            for b in range(to.shape[0]):
                sum0 = zeros()
                sum1 = zeros()
                sum2 = zeros()
                sum3 = zeros()
                for t in range(stencil.starts[b], stencil.starts[b + 1]):
                    sum0 = add_product(sum0, values[t, 0], x, places[t] + i)
                    sum1 = add_product(sum1, values[t, 1], x, places[t] + i)
                    sum2 = add_product(sum2, values[t, 2], x, places[t] + i)
                    sum3 = add_product(sum3, values[t, 3], x, places[t] + i)
                loss = add_lanes(loss, sum0, x, to[b, 0] + i)
                loss = add_lanes(loss, sum1, x, to[b, 1] + i)
                loss = add_lanes(loss, sum2, x, to[b, 2] + i)
                loss = add_lanes(loss, sum3, x, to[b, 3] + i)
            store(add_product(loss, 1.0, before, i), after, i)

    masses = state.shape[0] // 2
    total = stencil.total
    for column, at, table in stencil.border_cells:
        multiply_dense(stencil.borders[table], columns, column, total)
        # Displacement and velocity mass by mass, as in the stencil's blocks: sums are rounded alike.
        dense = 0.0
        for mass in range(masses):
            dense += total[mass] * state[mass, at]
            dense += total[masses + mass] * state[masses + mass, at]
        after[at] = dense + before[at]


@allocating
def loss_by_forces(free: FreeLosses, pairs: PairLosses, dofs: DofTables, c: int, columns: np.ndarray) -> float:
    """Loss in J that the step's forces on the DoFs of cluster ``c`` have added, by pairs and with free motion.

    ``columns`` (2 mass, column) hold the lattice's state at the beginning of the step.
    """
    loss = pairs.loss[c]
    _, components, width, modes = free.rows.shape
    total = np.empty(modes)
    for i in range(dofs.first[c], dofs.first[c + 1]):
        moments = pairs.moments[i]
        if is_zero(moments):
            continue

        total[:] = 0.0
        for j in range(components):
            for k in range(width):
                x = columns[j, free.column[i] + k]
                row = free.rows[free.table[i], j, k]
                for p in range(modes):
                    total[p] += x * row[p]
        for p in range(modes):
            loss += total[p] * moments[p]
    return loss


@kernel
def _fill_legendre(losses: PairLosses, cluster: Cluster, substep: Substep) -> None:
    """Put Legendre's polynomials P_p(2 a - 1) into the workspace, a what remains of the step after each node."""
    legendre = losses.legendre
    position = cluster.state[0].position
    for node in range(NODES):
        legendre[0, node] = 1.0
        legendre[1, node] = 1.0 - 2.0 * (position + substep.length * cluster.nodes.position[substep.kind, node])
    for p in range(2, legendre.shape[0]):
        last = (2 * p - 1) / p
        last_but_one = (p - 1) / p
        for node in range(NODES):
            x = legendre[1, node]
            legendre[p, node] = last * x * legendre[p - 1, node] - last_but_one * legendre[p - 2, node]


@kernel
def _fill_before(losses: PairLosses, cluster: Cluster, trial: Trial, substep: Substep) -> None:
    """Put the moments that forces have up to each node, in Legendre's polynomials, into the workspace.

    Within the substep F P_q is replaced by its interpolant through the nodes, as F is where it moves the lattice.
    """
    modes = losses.moments.shape[1]
    # All DoFs, as forces that have ended within the step have moments too.
    for i in range(losses.moments.shape[0]):
        for q in range(modes):
            for node in range(NODES):
                losses.before[i, q, node] = losses.moments[i, q]

    for i in trial.active:
        for q in range(modes):
            for k in range(NODES):
                amount = cluster.interval * substep.length * trial.force[i, k] * losses.legendre[q, k]
                for node in range(NODES):
                    losses.before[i, q, node] += cluster.nodes.powers[substep.kind, 0, k, node] * amount


@kernel
def accumulate_losses(losses: PairLosses, cluster: Cluster, trial: Trial, substep: Substep) -> None:
    """Add a substep's forces to the losses by pairs of forces and to the moments in Legendre's polynomials."""
    modes = losses.moments.shape[1]
    _fill_legendre(losses, cluster, substep)
    _fill_before(losses, cluster, trial, substep)
    legendre = losses.legendre
    total = trial.sums.w
    part = trial.sums.v
    for later in trial.active:
        # What a unit impulse on this DoF at each node loses with all impulses before it, its own among them. The
        # trial's sums are free for it: the substep is accepted, and the next one begins them anew.
        total[:] = 0.0
        for source in range(losses.moments.shape[0]):
            number = losses.kinds[later, source]
            # All moments of a DoF on which nothing has acted in the step are exactly zero. The first of them alone, the
            # impulse, may vanish after a force that has changed its sign.
            if number < 0 or is_zero(losses.before[source, :, NODES - 1]):
                continue
            for p in range(losses.degrees[number]):
                part[:] = 0.0
                for q in range(losses.degrees[number] - p):
                    for node in range(NODES):
                        part[node] += losses.kernels[number, p, q] * losses.before[source, q, node]
                for node in range(NODES):
                    total[node] += legendre[p, node] * part[node]

        for node in range(NODES):
            weight = cluster.nodes.weight[substep.kind, node]
            losses.loss[0] += cluster.interval * substep.length * weight * trial.force[later, node] * total[node]

    # What the next substep begins with: ``before`` had the moments up to this one.
    for i in trial.active:
        for node in range(NODES):
            amount = cluster.interval * substep.length * cluster.nodes.weight[substep.kind, node] * trial.force[i, node]
            for p in range(modes):
                losses.moments[i, p] += amount * legendre[p, node]
