"""Contact sites and driven masses as rows of the lattice's displacements: how they form clusters, and their tables.

A force acts on the lattice along a DoF x = c u, a relative displacement or a mass's own (sec. 2 of the derivation in
the package's docstring). DoFs so close that one feels the other within a step form a cluster (sec. 6). Two tables hold
all that a step must know of the lattice at their place: the rows c (-A)^m, with dashpots c P_k and c Q_k (sec. 7, and
``series`` for their factors), by which ``expand_free_motion`` finds the Taylor series of x(s) and ``apply_impulses``
adds what forces leave in the lattice (sec. 5); and the responses G of ``create_responses``, by which one DoF moves
another (sec. 3).

**Numbers of DoFs** are those of ``contact_dofs``: 0 to n - 1 the n sites, then the nonlinear springs, and -1 - i for
drive i, counted from 0. Its array has the drives last and in reverse, so that a negative number is an index from the
end.

**Rows that serve both ways** (Maxwell's reciprocity, sec. 5 and 7). A force changes velocities alone at once; what
follows is the motion from these, for which with dashpots the Q_k stand: no P_k is needed. The velocity, the derivative
of sum_k Q_k s^k H/k!, has the same Q_k with the factor 1/(k-1)!.

**Words.** The *form* of a DoF is its c, the weights of the masses of its cell and, if forces join cells, of the next
one. A *group* is a set of DoFs of the lattice that are solved for together, as numbers (``Groups``); a *cluster* is
such a group on a rank that has cells within reach of it, with its tables (``DofTables``). ``groups`` finds them. Every
rank within reach solves a cluster for itself, from the same halo, and applies the impulses to its own cells alone: no
forces are sent.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.compiled import kernel
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.groups import Groups, contact_dofs
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.propagator.stencil import HaloRegions
from vipetsc.records import Record

# The tables' clearances are the sites' times 1 less this. A site whose bound sum |a_k| on |w| is below the clearance is
# not searched at all. ``first_onset`` takes an approach to 1e-10 of the clearance for an onset, and the sum is rounded:
# ten times that much keeps both on the safe side, and hardly a site is searched for it.
NEARLY_TOUCHING = 1e-9


class DofTables(NamedTuple):
    """The contact DoFs of a rank, cluster by cluster, and the tables by which they and the lattice move each other.

    The DoFs of cluster c begin at ``first[c]`` and end before ``first[c + 1]``: its sites, ``sites[c]`` of them,
    ``springs[c]`` nonlinear springs, and then its driven masses. A DoF's rows span ``StepSeries.width`` cells, from
    ``reach`` before its own on. ``column`` (dof,) is the first of these among the columns of the halo,
    ``owned`` (dof, cell) their numbers among the rank's cells, -1 for cells of other ranks. ``clearance`` (dof,) in m
    is the displacement below which no force acts. For a site it is the lesser of its two clearances, 0 or negative for
    one that touches or is pressed at rest, which therefore acts in every step; for a spring the elongation below which
    its nonlinear force is rounding; inf for a driven mass.

    DoFs that have equal rows share a table: ``table`` (dof,) numbers it in ``rows`` (table, mass, cell, term) and in
    ``inverse_masses`` (table, mass, cell) in 1/kg. ``factors`` (coefficient,) are H^(k mod 2)/k! of
    each power s^k, two for each term. With dashpots ``rows`` are (table, 2 mass, cell, coefficient), those of P_k and
    then those of Q_k, and ``factors`` 1/k! and then H/k!.

    ``ledger`` lists the DoFs whose energies the rank's part of the state contains, in the order in which it does: the
    works of the rank's drives, then what its sites have dissipated. ``acting`` lists those of ``Layout.acting_sites``.
    """

    column: np.ndarray
    owned: np.ndarray
    table: np.ndarray
    rows: np.ndarray
    factors: np.ndarray
    inverse_masses: np.ndarray
    clearance: np.ndarray
    sites: np.ndarray
    springs: np.ndarray
    first: np.ndarray
    ledger: np.ndarray
    acting: np.ndarray


def groups_within_reach(groups: Groups, dofs: np.ndarray, reach: int, layout: Layout) -> Groups:
    """Return the ``groups`` of which a DoF lies within ``reach`` cells of the rank's.

    ``dofs`` (dof,) are the records of ``contact_dofs`` of ``groups.numbers``, in that order.
    """
    near = np.zeros(len(dofs), bool)
    # "last" is a DoF's last cell, ``stop`` the cell after the rank's last one.
    for turn in layout.topology.turns:
        near |= (dofs["last"] + turn >= layout.start - reach) & (dofs["cell"] + turn < layout.stop + reach)

    # A group is near if one of its DoFs is; a rank without cells has no group, though its place is near some.
    sizes = np.diff(groups.first)
    selected = np.logical_or.reduceat(near, groups.first[:-1]) & (layout.owned > 0)
    return Groups(groups.numbers[np.repeat(selected, sizes)], np.append(0, np.cumsum(sizes[selected])))


def create_dof_tables(groups: Groups, model: Model, layout: Layout, series: StepSeries, halo: HaloRegions) -> Record:
    """Create the tables of the DoFs of ``groups``; adds to ``halo`` the cells that they reach."""
    numbers = groups.numbers
    all_dofs = contact_dofs(model)
    dofs = all_dofs[numbers]
    # Cells that a form has weights for: 2 if forces join cells, else 1.
    span = dofs["form"].shape[1]

    # DoFs of equal form have one table in common where their cells have equal rows. ``representatives`` gives for each
    # the first cell with the same masses, springs and dashpots up to ``reach`` + 1 cells away: both the rows and all
    # masses that the table holds are then the same, as the second cell of a form is one cell further on.
    form_cells = np.stack([dofs["cell"], dofs["last"] % layout.cells][:span], axis=1)
    weights = dofs["form"].reshape(len(dofs), span * layout.dofs)
    representatives = series.representatives(form_cells.ravel()).reshape(form_cells.shape)
    kinds, table = np.unique(np.hstack([representatives, weights]), axis=0, return_inverse=True)
    cells = kinds[:, :span].astype(np.int64)
    forms = kinds[:, span:].reshape(len(kinds), span, layout.dofs)

    # Masses near a representative are those near all DoFs of its table. On a ring ``coefficients`` goes round. Beyond
    # an end of the lattice the numbers are those of an endless one, and none is used: rows have zeros there.
    masses = np.zeros((len(kinds), layout.dofs, series.width))
    for i, cell in enumerate(cells[:, 0].tolist()):
        leftmost = cell - series.reach
        masses[i] = model.chain.coefficients(leftmost, leftmost + series.width).masses.T

    # Sites and drives of the rank's ledger, in its order, by their place in ``numbers``. All of them lie in the rank's
    # own cells, and so in its groups: none has the place -1.
    places = np.full(len(all_dofs), -1)
    places[numbers] = np.arange(len(numbers))
    ledger = places[[*(-1 - i for i in layout.drives), *layout.sites]]

    leftmost_cells = dofs["cell"] - series.reach
    tables = DofTables(
        column=halo.add(leftmost_cells, series.width),
        owned=_owned_cells(leftmost_cells, series.width, layout),
        table=table,
        rows=_form_rows(cells, forms, series),
        factors=series.factors(),
        inverse_masses=1 / masses,
        clearance=dofs["clearance"] * (1 - NEARLY_TOUCHING),
        sites=groups.counts((numbers >= 0) & (numbers < len(model.chain.sites))),
        springs=groups.counts(numbers >= len(model.chain.sites)),
        first=groups.first,
        ledger=ledger,
        acting=places[list(layout.acting_sites)],
    )
    return Record(tables)


def _owned_cells(leftmost: np.ndarray, count: int, layout: Layout) -> np.ndarray:
    """Return local numbers (dof, count) of ``count`` cells from ``leftmost`` (dof,) on, -1 for another rank's cell."""
    cells = layout.topology.neighbour(leftmost[:, None], np.arange(count))
    return np.where((cells >= layout.start) & (cells < layout.stop), cells - layout.start, -1)


def _form_rows(cells: np.ndarray, forms: np.ndarray, series: StepSeries) -> np.ndarray:
    """Return the rows c (-A)^m as in ``DofTables`` of ``forms`` c (table, k, mass), k = 0, 1 this and the next cell.

    ``cells`` (table, k) are these cells, or representatives of them.
    """
    tables, span, masses = forms.shape
    # With dashpots rows for velocities next to those for displacements, and twice as many powers.
    halves = 1 + series.is_damped
    rows = np.zeros((tables, halves * masses, series.width, halves * series.terms))

    band = 2 * series.reach + 1
    for k in range(span):
        for row, form, mass_rows in zip(rows, forms[:, k], series.power_rows(cells[:, k]), strict=True):
            part = series.cut(mass_rows, -series.reach, band).astype(float)
            # The rows of a mass in the next cell lie one cell further on: where there are such, ``width`` is one more
            # than the band.
            row[:, k : k + band] += np.einsum("i,imjc->jcm", form, part)
    return rows


def create_responses(groups: Groups, tables: Record, model: Model, series: StepSeries) -> np.ndarray:
    """Create the motion (dof, source, term) of each DoF after a unit impulse on each DoF of its cluster.

    It is the coefficients g_p in m/N of H times the displacement, by powers s^p: term m is that of p = 2 m + 1, or with
    dashpots of p = m + 1. An impulse on DoF l leaves the velocities M^-1 c_l^T, on which the rows of DoF i act.
    Sources are counted within the cluster; columns beyond a smaller cluster's size are zero.
    """
    all_dofs = contact_dofs(model)
    cells = all_dofs["cell"][groups.numbers]
    masses = model.chain.cell.dofs

    # What DoFs take from velocities: (table, mass, cell, term). The factors are those of the odd powers; with dashpots
    # of all but the zeroth, since Q_0 = 0.
    if series.is_damped:
        rows = tables.rows[:, -masses:, :, 1:]
        factors = tables.factors[2 * series.terms + 1 :] * series.interval
    else:
        rows = tables.rows[:, -masses:, :, :]
        factors = tables.factors[1::2] * series.interval
    # One cell more, of zeros, stands for all that are not reached.
    rows = np.pad(rows, [(0, 0), (0, 0), (0, 1), (0, 0)])

    # The velocities after a unit impulse: (table, cell of the form, mass). One DoF of each table shows its form.
    _, first_dofs = np.unique(tables.table, return_index=True)
    forms = all_dofs["form"][groups.numbers[first_dofs]]
    form_cells = np.arange(forms.shape[1])
    velocities = tables.inverse_masses[:, :, series.reach + form_cells].swapaxes(1, 2) * forms

    response = np.zeros((len(cells), max(np.diff(groups.first), default=0), rows.shape[-1]))
    for j, targets, sources in groups.pairs():
        # Columns of the target's rows in which the cells of the source lie. A ring has at least ``width`` cells: each
        # of them is in one column at most.
        leftmost = cells[targets] - series.reach
        columns = model.chain.topology.cells_ahead(leftmost[:, None], cells[sources][:, None] + form_cells)
        columns = np.where((columns >= 0) & (columns < series.width), columns, series.width)
        near = np.any(columns < series.width, axis=1)
        targets = targets[near]

        # Pairs of equal tables at equal distances respond alike: thousands of sites make few kinds of pairs.
        pairs = np.column_stack([tables.table[targets], tables.table[sources[near]], columns[near]])
        pairs, which = np.unique(pairs, axis=0, return_inverse=True)
        responses = np.zeros((len(pairs), rows.shape[-1]))
        for out, (target, source, *pair_columns) in zip(responses, pairs.tolist(), strict=True):
            for k, column in enumerate(pair_columns):
                out += velocities[source, k] @ rows[target, :, column]
        response[targets, j] = (factors * responses)[which]
    return response


@kernel
def _is_damped(dofs: DofTables, rows: int) -> bool:
    """Return whether ``dofs`` have rows for displacements and rows for velocities, of a state with so many ``rows``.

    Without dashpots the rows of displacements serve for both, and are half as many.
    """
    return dofs.rows.shape[1] == rows


@kernel
def expand_free_motion(dofs: DofTables, c: int, columns: np.ndarray, taylor: np.ndarray) -> bool:
    """Expand the free motion of the DoFs of cluster ``c`` in powers of t/H; whether a force may act on one of them.

    A force may act on a site or spring that reaches its clearance; when drives are on the caller knows. Coefficients in
    m go into ``taylor`` (dof, coefficient); ``columns`` (2 mass, column) hold the lattice's state at the beginning of
    the step.
    """
    masses = columns.shape[0] // 2
    terms = dofs.rows.shape[3]
    # Displacements add to the even coefficients and velocities to the odd ones, with dashpots both to all of them.
    of_velocities = 0
    stride = 2
    odd = 1
    factors_of_velocities = 1
    if _is_damped(dofs, columns.shape[0]):
        of_velocities = masses
        stride = 1
        odd = 0
        factors_of_velocities = terms

    # For each term: the sum over displacements, and that over velocities.
    total = np.empty((2, terms))
    may_touch = False
    for i in range(dofs.first[c], dofs.first[c + 1]):
        rows = dofs.rows[dofs.table[i]]
        leftmost = dofs.column[i]
        total[:] = 0.0
        for j in range(masses):
            for k in range(rows.shape[1]):
                _add_row(rows[j, k], columns[j, leftmost + k], total[0])
                _add_row(rows[of_velocities + j, k], columns[masses + j, leftmost + k], total[1])

        # The sum of all |a_k| bounds |x| in the whole step, 0 <= s <= 1.
        bound = 0.0
        taylor[i] = 0.0
        for m in range(terms):
            taylor[i, stride * m] += total[0, m] * dofs.factors[stride * m]
            taylor[i, stride * m + odd] += total[1, m] * dofs.factors[stride * m + factors_of_velocities]
        for coefficient in taylor[i]:
            bound += abs(coefficient)
        # Not ``bound >= clearance``: a state that is not finite must be looked at, too.
        may_touch |= not bound < dofs.clearance[i]
    return may_touch


@kernel
def _add_row(row: np.ndarray, x: float, total: np.ndarray) -> None:
    """Add ``row`` (term,) times ``x`` to ``total`` (term,)."""
    for m in range(row.size):
        total[m] += x * row[m]


@kernel
def is_zero(row: np.ndarray) -> bool:
    """Return whether all numbers of a ``row`` (number,) are zero."""
    zero = True
    for value in row:
        zero &= value == 0.0
    return zero


@kernel
def apply_impulses(dofs: DofTables, first: int, moments: np.ndarray, out: np.ndarray) -> None:
    """Add to the owned cells ``out`` (2 mass, cell) the motion that forces within the step have caused at its end.

    Row i of ``moments`` (dof, k) in N s belongs to the DoF ``first`` + i: integrals of its force times (1 - t/H)^k dt
    over the step. Displacements in m come before velocities in m/s.
    """
    masses = out.shape[0] // 2
    terms = dofs.rows.shape[3]
    # Term m of u goes with the factor and the moment of the power 2 m + 1, that of v with those of 2 m. With dashpots
    # the terms are those of Q_m, which go with the powers m and m - 1; u begins with Q_1, and v has the same rows.
    first_row = 0
    begin = 0
    stride = 2
    shift = 0
    factors_of_u = 0
    if _is_damped(dofs, out.shape[0]):
        first_row = masses
        begin = 1
        stride = 1
        shift = -1
        factors_of_u = terms

    for i in range(moments.shape[0]):
        if is_zero(moments[i]):
            continue
        table = dofs.table[first + i]
        for k in range(dofs.rows.shape[2]):
            cell = dofs.owned[first + i, k]
            if cell < 0:
                continue
            for j in range(masses):
                row = dofs.rows[table, first_row + j, k]
                u = 0.0
                v = 0.0
                for m in range(begin, terms):
                    power = stride * m + shift
                    v += row[m] * dofs.factors[power] * moments[i, power]
                    u += row[m] * dofs.factors[factors_of_u + power + 1] * moments[i, power + 1]
                out[j, cell] += u * dofs.inverse_masses[table, j, k]
                out[masses + j, cell] += v * dofs.inverse_masses[table, j, k]
