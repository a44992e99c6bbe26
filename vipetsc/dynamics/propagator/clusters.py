"""Contacts and driven masses as rows of the lattice's displacements: which of them feel one another, their tables.

Sec. 2, 5 and 6 of the derivation in the package's docstring.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.propagator.stencil import HaloRegions
from vipetsc.dynamics.propagator.tables import DofTables, owned_cells


def contact_dofs(model: Model) -> np.ndarray:
    """The relative displacements of the contact sites and the displacements of driven masses, the first drive's last.

    A site has its number, the n-th drive -n. Each has its ``cell`` and the ``last`` one, that or the next; the weights
    ``form`` (cell, mass) of the displacements there, of one cell where no contact joins cells; its lesser
    ``clearance`` in m.
    """
    lattice, drives, unit = model.chain, model.drives[::-1], np.eye(model.chain.cell.dofs + 1)[:, :-1]
    shape, sites = (1 + lattice.is_joined, lattice.cell.dofs), np.arange(len(lattice.sites))
    fields = [("cell", int), ("last", int), ("form", float, shape), ("clearance", float)]
    dofs = np.zeros(len(sites) + len(drives), fields)
    dofs["cell"] = *lattice.sites, *(drive.cell for drive in drives)
    pairs = lattice.pairs or [(lattice.cell.host, lattice.cell.resonator, 0)]
    host, resonator, joins = np.broadcast_to(np.array(pairs, np.int64), (len(sites), 3)).T
    dofs["form"][sites, joins] = unit[resonator]
    dofs["form"][sites, 0] -= unit[host]  # the last row, of ground, is zero
    dofs["form"][len(sites) :, 0] = unit[[drive.mass for drive in drives]]
    dofs["last"] = dofs["cell"]
    dofs["last"][sites] += joins
    gaps = np.min(model.gaps, axis=1) if model.gaps else lattice.clearances
    dofs["clearance"] = *gaps, *[np.inf] * len(drives)
    return dofs


class Groups(NamedTuple):
    """Groups of ``contact_dofs``: the ``numbers`` (dof,) of group g are ``first[g]`` to ``first[g + 1]``.

    In each group the sites' numbers come first, in their own order, then -1 for the first drive, -2 for the second.
    """

    numbers: np.ndarray
    first: np.ndarray


def group_dofs(model: Model, reach: int) -> Groups:
    """Groups of ``contact_dofs`` of which each is within ``reach`` cells of another, in the lattice's order."""
    lattice, dofs = model.chain, contact_dofs(model)
    numbers = np.append(np.arange(len(lattice.sites)), np.arange(-len(model.drives), 0))
    order, group = np.argsort(dofs["cell"]), np.zeros(len(dofs), np.int64)
    cells, lasts = dofs["cell"][order], np.maximum.accumulate(dofs["last"][order])
    group[order[1:]] = np.cumsum(cells[1:] - lasts[:-1] > reach)
    if lattice.ends == "periodic" and cells[0] + lattice.cells - lasts[-1] <= reach:
        group[group == group.max()] = 0
    first = np.append(0, np.cumsum(np.bincount(group)))
    return Groups(numbers[np.lexsort((np.abs(numbers), numbers < 0, group))], first)


def reaching(groups: Groups, dofs: np.ndarray, reach: int, layout: Layout) -> Groups:
    """Those of ``groups``, of the ``contact_dofs`` ``dofs``, with one within ``reach`` of the rank's cells."""
    ways, (cells, lasts) = (-layout.cells, 0, layout.cells) if layout.periodic else (0,), (dofs["cell"], dofs["last"])
    near = [(lasts + way >= layout.start - reach) & (cells + way < layout.stop + reach) for way in ways]
    sizes = np.diff(groups.first)
    feels = np.logical_or.reduceat(np.any(near, axis=0), groups.first[:-1]) & (layout.owned > 0)
    return Groups(groups.numbers[np.repeat(feels, sizes)], np.append(0, np.cumsum(sizes[feels])))


def create_dof_tables(groups: Groups, model: Model, layout: Layout, series: StepSeries, halo: HaloRegions) -> DofTables:
    """The record of the DoFs of ``groups``; adds to ``halo`` the cells that they reach."""
    numbers, dofs, r, width = groups.numbers, contact_dofs(model)[groups.numbers], series.reach, series.width
    # DoFs share their rows where the cells around them do.
    ends = np.stack([dofs["cell"], dofs["last"] % layout.cells][: dofs["form"].shape[1]], axis=1)
    forms = dofs["form"].reshape(len(dofs), ends.shape[1] * layout.dofs)  # of none, too
    kinds, table = np.unique(
        np.hstack([series.like(ends.ravel()).reshape(ends.shape), forms]), axis=0, return_inverse=True
    )
    cells, forms = np.split(kinds, [ends.shape[1]], axis=1)
    cells, forms = cells.astype(np.int64), forms.reshape(-1, *dofs["form"].shape[1:])
    halves = 1 + series.is_damped
    rows = np.zeros((len(kinds), halves * layout.dofs, width, halves * series.terms))
    for end in range(ends.shape[1]):
        for row, form, around in zip(rows, forms[:, end], series.rows(cells[:, end]), strict=True):
            part = series.cut(around, -r, 2 * r + 1).astype(float)
            row[:, end : end + 2 * r + 1] += np.einsum("i,imjc->jcm", form, part)
    masses = [model.chain.coefficients(cell - r, cell - r + width).masses.T for cell in cells[:, 0].tolist()]
    places = np.full(len(contact_dofs(model)), -1)
    places[numbers] = np.arange(len(numbers))
    return DofTables(
        column=halo.add(dofs["cell"] - r, width),
        owned=owned_cells(dofs["cell"] - r, width, layout),
        table=table,
        rows=rows,
        factors=series.factors(),
        inverse_masses=1 / np.array(masses).reshape(len(rows), layout.dofs, width),
        # An onset within rounding of the clearance is one.
        clearance=dofs["clearance"] * (1 - 1e-9),
        sites=np.add.reduceat(numbers >= 0, groups.first[:-1], dtype=np.int64) if len(numbers) else numbers[:0],
        first=groups.first,
        ledger=places[[*(-1 - i for i in layout.drives), *layout.sites]],
    )


def create_responses(groups: Groups, tables: DofTables, model: Model, series: StepSeries) -> np.ndarray:
    """Motion (dof, dof, term) of each DoF after an impulse on each of its cluster, times H: ``Cluster.response``."""
    dofs, n, (first, r) = contact_dofs(model), model.chain.cells, (groups.first, series.reach)
    cells, d, damped = dofs["cell"][groups.numbers], model.chain.cell.dofs, series.is_damped
    # From velocities: (table, mass, cell, term); one cell more, of zeros, is for all that are not reached.
    rows, factors = tables.rows[:, -d:, :, damped:], tables.factors[1::2] * series.interval
    rows = np.pad(rows, [(0, 0), (0, 0), (0, 1), (0, 0)])
    if damped:
        factors = tables.factors[2 * series.terms + 1 :] * series.interval
    _, examples = np.unique(tables.table, return_index=True)
    forms = dofs["form"][groups.numbers[examples]]
    ends = np.arange(forms.shape[1])
    weights = tables.inverse_masses[:, :, r + ends].swapaxes(1, 2) * forms
    sizes = np.diff(first)
    response = np.zeros((len(cells), max(sizes, default=0), rows.shape[-1]))
    for j in range(response.shape[1]):
        targets = np.flatnonzero(np.repeat(sizes, sizes) > j)
        sources = np.repeat(first[:-1], sizes)[targets] + j
        at = r + (cells[sources] - cells[targets])[:, None] + ends
        at = at % n if model.chain.ends == "periodic" else at
        at = np.where((at >= 0) & (at < series.width), at, series.width)
        near = np.any(at < series.width, axis=1)
        targets, sources, at = targets[near], sources[near], at[near]
        pairs = np.column_stack([tables.table[targets], tables.table[sources], at])
        pairs, which = np.unique(pairs, axis=0, return_inverse=True)
        of_pairs = [
            factors * sum(weights[source, end] @ rows[target, :, at] for end, at in enumerate(cells_at))
            for target, source, *cells_at in pairs.tolist()
        ]
        response[targets, j] = np.reshape(of_pairs, (-1, rows.shape[-1]))[which]
    return response
