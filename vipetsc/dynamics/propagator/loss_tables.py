"""Tables of what dashpots dissipate in a step in which forces act, beyond the loss of free motion.

With v = v_free + v_F the loss, the integral of v^T C v over the step (sec. 10 of the derivation in the package's
docstring), has two parts that forces bring in. An impulse on DoF l leaves velocities M^-1 c_l^T, after which a dashpot
has the rate r_l(x), x the time since then over H. What the impulse adds to the loss is twice the integral of r_l times
the rate that there was without it: the rate of free motion, a row of the state at the step's beginning, and the rates
r_m that earlier forces have left. Both integrals are smooth in what remains of the step after the impulses, and are
expanded in the polynomials of ``loss_modes``.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.clusters import DofTables
from vipetsc.dynamics.propagator.dashpots import NO_DASHPOTS, DashpotRows
from vipetsc.dynamics.propagator.groups import Groups, contact_dofs
from vipetsc.dynamics.propagator.loss_modes import SMALLEST_MODE, mode_count, overlaps
from vipetsc.dynamics.propagator.losses import FreeLosses, PairLosses
from vipetsc.dynamics.propagator.nodes import NODES


class _Responses(NamedTuple):
    """Rates after a unit impulse on each kind of DoFs: ``table`` (dof,) numbers ``rates`` (table, cell, rate, power).

    The cells are those whose dashpots it reaches, from ``first`` (dof,) on; ``kinds`` (table, cell) are their kinds.
    """

    first: np.ndarray
    table: np.ndarray
    kinds: np.ndarray
    rates: np.ndarray


def no_losses(dofs: int, clusters: int) -> tuple[FreeLosses, PairLosses]:
    """The tables of a rank with so many DoFs and clusters in a lattice without dashpots."""
    none = np.zeros(0, np.int64)
    free = FreeLosses(column=none, table=none, rows=np.zeros((0, 0, 0, 0)), leader=none)
    return free, PairLosses(
        kinds=np.zeros((dofs, 0), np.int64),
        kernels=np.zeros((0, 0, 0)),
        degrees=none,
        moments=np.zeros((dofs, 0)),
        loss=np.zeros(clusters),
        legendre=np.zeros((0, NODES)),
        before=np.zeros((0, 0, NODES)),
    )


def create_losses(
    groups: Groups, tables: DofTables, model: Model, layout: Layout, dashpots: DashpotRows
) -> tuple[FreeLosses, PairLosses]:
    """Create the tables of the DoFs of ``groups``, whose ``tables`` have been created."""
    series = dashpots.series
    modes = mode_count(series.omega_max_h)
    dofs = contact_dofs(model)[groups.numbers]
    responses = _create_responses(dofs, model, dashpots)
    integrals = overlaps(modes, dashpots.powers)

    # A force at the beginning stands for the state there: b = 1, where all of Legendre's polynomials are 1.
    from_start = integrals.sum(axis=1)
    leaders = dofs["cell"][groups.first[:-1]]
    owns = (leaders >= layout.start) & (leaders < layout.stop)
    free = FreeLosses(
        column=tables.column - series.reach - 1,
        table=responses.table,
        rows=_free_rows(responses, from_start, dashpots),
        leader=np.where(owns, leaders - layout.start, -1),
    )

    sizes = np.diff(groups.first)
    kinds, kernels = _pair_kernels(groups, responses, integrals, dashpots)
    kinds, degrees = _significant(kinds, kernels, groups)
    return free, PairLosses(
        kinds=kinds,
        kernels=kernels,
        degrees=degrees,
        moments=np.zeros((len(dofs), modes)),
        loss=np.zeros(len(sizes)),
        legendre=np.zeros((modes, NODES)),
        before=np.zeros((int(sizes.max(initial=0)), modes, NODES)),
    )


def _create_responses(dofs: np.ndarray, model: Model, dashpots: DashpotRows) -> _Responses:
    """Rates after unit impulses on ``dofs``, of the dtype of ``contact_dofs``."""
    chain = model.chain
    reach = dashpots.series.reach
    span = dofs["form"].shape[1]
    # A dashpot's rows begin ``reach`` before its cell and end ``reach`` after the next one.
    first = dofs["cell"] - reach - 1
    count = dashpots.width + span - 1
    kinds = dashpots.kinds((first[:, None] + np.arange(count)).ravel()).reshape(len(dofs), count)

    # Where a dashpot reaches the DoF, its kind says which masses there are.
    inverse = np.array([1 / chain.coefficients(cell, cell + span).masses for cell in dofs["cell"].tolist()])
    velocities = dofs["form"] * inverse.reshape(dofs["form"].shape)
    # The number of columns is given: a rank far from contacts and drives has no rows, from which it could be found.
    keys = np.hstack([kinds, velocities.reshape(len(dofs), span * chain.cell.dofs)])
    _, examples, table = np.unique(keys, axis=0, return_index=True, return_inverse=True)

    # On a short ring a dashpot is reached from both sides: it is one.
    distinct = count
    if chain.ends == "periodic":
        distinct = min(count, chain.cells)
    rates = np.zeros((len(examples), distinct, dashpots.rates, dashpots.powers))
    for out, example in zip(rates, examples.tolist(), strict=True):
        for k in range(count):
            kind = int(kinds[example, k])
            if kind == NO_DASHPOTS:
                continue
            rows = dashpots.rows(kind)[:, :, chain.cell.dofs :]
            for i, velocity in enumerate(velocities[example]):
                # The DoF's cell is the (reach + 1)-th from ``first``, the dashpot's rows begin at the (k - reach)-th.
                column = 2 * reach + 1 + i - k
                if 0 <= column < dashpots.width:
                    out[k % distinct] += np.einsum("rkj,j->rk", rows[..., column], velocity)
    return _Responses(first=first, table=table, kinds=kinds[examples][:, :distinct], rates=rates)


def _free_rows(responses: _Responses, from_start: np.ndarray, dashpots: DashpotRows) -> np.ndarray:
    """Rows (table, 2 mass, cell, mode) of the loss by a unit impulse times the rates of free motion.

    ``from_start`` (mode, power of the impulse's rate, power of the free one) are their integrals.
    """
    tables, cells, rates, powers = responses.rates.shape
    rows = 2 * dashpots.chain.cell.dofs
    modes = len(from_start)
    out = np.zeros((tables, modes, rows, cells + dashpots.width - 1))
    for table in range(tables):
        for k in range(cells):
            kind = int(responses.kinds[table, k])
            if kind == NO_DASHPOTS:
                continue
            weights = np.einsum("pij,ri->prj", from_start, responses.rates[table, k])
            of_state = dashpots.rows(kind).reshape(rates * powers, -1)
            products = weights.reshape(modes, rates * powers) @ of_state
            out[table, :, :, k : k + dashpots.width] += products.reshape(modes, rows, dashpots.width)
    # Twice the product of two rates, and the integral's dt is H dx.
    return 2 * dashpots.series.interval * np.ascontiguousarray(np.moveaxis(out, 1, -1))


def _pair_kernels(
    groups: Groups, responses: _Responses, integrals: np.ndarray, dashpots: DashpotRows
) -> tuple[np.ndarray, np.ndarray]:
    """Losses by pairs of unit impulses: the number (dof, source) of each pair's, and these (kind, mode, mode).

    Modes are those of the later impulse, on the DoF, and of the earlier one, on the source. Sources are counted in
    their cluster, and the number is -1 for one that is too far away.
    """
    chain = dashpots.chain
    numbers = np.full((len(groups.numbers), max(np.diff(groups.first), default=0)), -1)
    number_of: dict[tuple[int, int, int], int] = {}
    kernels: list[np.ndarray] = []
    modes = len(integrals)
    for j, targets, sources in groups.pairs():
        distances = responses.first[sources] - responses.first[targets]
        for target, source, distance in zip(targets.tolist(), sources.tolist(), distances.tolist(), strict=True):
            if chain.ends == "periodic":
                distance = distance % chain.cells
            key = (int(responses.table[target]), int(responses.table[source]), distance)
            if key not in number_of:
                number_of[key] = -1
                products = _products(responses, dashpots, *key)
                if products.any():
                    number_of[key] = len(kernels)
                    kernels.append(2 * dashpots.series.interval * np.tensordot(integrals, products, axes=2))
            numbers[target, j] = number_of[key]
    return numbers, np.array(kernels).reshape(len(kernels), modes, modes)


def _products(responses: _Responses, dashpots: DashpotRows, later: int, earlier: int, distance: int) -> np.ndarray:
    """Sums (power, power) over the dashpots that two impulses reach, of the products of their rates' coefficients.

    ``later`` and ``earlier`` are the tables of their responses; the first dashpot of the earlier one is ``distance``
    cells to the right of that of the later one.
    """
    chain = dashpots.chain
    cells = responses.rates.shape[1]
    cells_of_later = np.arange(cells)
    cells_of_earlier = cells_of_later - distance
    if chain.ends == "periodic":
        cells_of_earlier %= chain.cells
    common = (cells_of_earlier >= 0) & (cells_of_earlier < cells)

    first = responses.rates[later, cells_of_later[common]].reshape(-1, dashpots.powers)
    second = responses.rates[earlier, cells_of_earlier[common]].reshape(-1, dashpots.powers)
    return first.T @ second


def _significant(kinds: np.ndarray, kernels: np.ndarray, groups: Groups) -> tuple[np.ndarray, np.ndarray]:
    """The ``kinds`` (dof, source) without those whose losses are too small to count, and the degrees of all that count.

    A pair's loss is compared with those of each of the two impulses with itself.
    """
    if not len(kernels):
        return kinds, np.zeros(0, np.int64)
    modes = kernels.shape[1]
    sizes = np.abs(kernels)
    largest = sizes.max(axis=(1, 2))

    first = np.repeat(groups.first[:-1], np.diff(groups.first))
    dofs = np.arange(len(kinds))
    with_itself = kinds[dofs, dofs - first]
    own_loss = np.where(with_itself >= 0, largest[with_itself], 0.0)
    targets, places = np.nonzero(kinds >= 0)
    scale = np.sqrt(own_loss[targets] * own_loss[first[targets] + places])

    # Equal kinds are pairs of equal DoFs.
    least = np.zeros(len(kernels))
    least[kinds[targets, places]] = SMALLEST_MODE * scale
    counts = sizes > least[:, None, None]
    degree = np.add.outer(np.arange(modes), np.arange(modes))
    # Coefficients of higher degrees than the modes' are as small as those of modes left out.
    degrees = np.minimum(np.where(counts, degree + 1, 0).max(axis=(1, 2)), modes)
    return np.where((kinds >= 0) & (degrees[kinds] > 0), kinds, -1), degrees
