"""Contact sites and driven masses as rows of the lattice's displacements: how they form clusters, and their tables.

A force acts on the lattice along a DoF x = c u, a relative displacement or a mass's own (sec. 2 of the derivation in
the package's docstring). DoFs so close that one feels the other within a step form a cluster (sec. 6). Two tables hold
all that a step must know of the lattice at their place: the rows c (-A)^m, by which ``expand_free_motion`` finds the
Taylor series of x(s) and ``apply_impulses`` adds what forces leave in the lattice (sec. 5); and the responses G of
``create_responses``, by which one DoF moves another (sec. 3).

**Notation.** M, K and C are the matrices of masses, springs and dashpots, H the step in s, t the time from its
beginning, s = t/H, and A = H^2 M^-1 K. From the displacements u_0 and velocities v_0 at the beginning free motion is

    u(s) = sum_m (-A)^m [u_0 s^2m / (2m)! + H v_0 s^(2m+1) / (2m+1)!].

Powers of A bear H^2m already; ``factors`` H^(k mod 2)/k! add what the power s^k lacks (see ``series``). With dashpots
(sec. 7) it is

    u(s) = sum_k s^k/k! (P_k u_0 + Q_k H v_0),   P_(k+1) = -Q_k H^2 M^-1 K,   Q_(k+1) = P_k - Q_k H M^-1 C,

from P_0 = 1 and Q_0 = 0, and the rows are c P_k and c Q_k, two for each power of time. ``StepSeries`` says how many
powers of A count, ``terms``, which make twice as many powers of s (with dashpots there is a row for each of these), and
at how many cells' distance they end, ``reach``.

**Numbers of DoFs** are those of ``contact_dofs``: 0 to n - 1 the n sites, then the nonlinear springs, and -1 - i for
drive i, counted from 0. Its array has the drives last and in reverse, so that a negative number is an index from the
end.

**Rows that serve both ways** (Maxwell's reciprocity). M and K are symmetric, so that (-A)^m M^-1 is: what the force on
x leaves in every displacement, (-A)^m M^-1 c^T, is M^-1 times the transposed row c (-A)^m, by which x is read from
every displacement. With dashpots C is symmetric, too, and so is Q_k M^-1, the series of the inverse of M p^2 + C p + K,
p being Laplace's variable. A force changes velocities alone at once; what follows is the motion from these velocities,
for which the Q_k stand: no P_k is needed. The velocity, the derivative of sum_k Q_k s^k H/k!, has the same Q_k with the
factor 1/(k-1)!.

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
def expand_free_motion(dofs: DofTables, c: int, columns: np.ndarray, taylor: np.ndarray) -> bool:
    """Expand the free motion of the DoFs of cluster ``c`` in powers of t/H; whether a force may act on one of them.

    A force may act on a site or spring that reaches its clearance; when drives are on the caller knows. Coefficients in
    m go into ``taylor`` (dof, coefficient); ``columns`` (2 mass, column) hold the lattice's state at the beginning of
    the step.
    """
    # With dashpots there are rows for displacements and rows for velocities, as many as ``columns`` has; without, the
    # rows of displacements serve for both, and are half as many.
    if dofs.rows.shape[1] == columns.shape[0]:
        return _expand_damped_motion(dofs, c, columns, taylor)

    masses = dofs.rows.shape[1]
    may_touch = False
    for i in range(dofs.first[c], dofs.first[c + 1]):
        rows = dofs.rows[dofs.table[i]]
        leftmost = dofs.column[i]
        taylor[i] = 0.0
        for j in range(masses):
            for k in range(rows.shape[1]):
                u = columns[j, leftmost + k]
                v = columns[masses + j, leftmost + k]
                _add_powers(rows[j, k], u, v, taylor[i])

        # The sum of all |a_k| bounds |x| in the whole step, 0 <= s <= 1.
        bound = 0.0
        for m in range(rows.shape[2]):
            taylor[i, 2 * m] *= dofs.factors[2 * m]
            taylor[i, 2 * m + 1] *= dofs.factors[2 * m + 1]
            bound += abs(taylor[i, 2 * m]) + abs(taylor[i, 2 * m + 1])
        # Not ``bound >= clearance``: a state that is not finite must be looked at, too.
        may_touch |= not bound < dofs.clearance[i]
    return may_touch


@kernel
def _add_powers(row: np.ndarray, u: float, v: float, series: np.ndarray) -> None:
    """Add ``row`` (term,) times ``u`` to the even coefficients of a ``series``, and times ``v`` to the odd ones."""
    for m in range(row.size):
        series[2 * m] += u * row[m]
        series[2 * m + 1] += v * row[m]


@kernel
def _expand_damped_motion(dofs: DofTables, c: int, columns: np.ndarray, taylor: np.ndarray) -> bool:
    """Expand the free motion as ``expand_free_motion`` does, in a lattice with dashpots."""
    _, rows, width, terms = dofs.rows.shape
    # For each power of time: the sum over displacements, and that over velocities.
    total = np.empty((2, terms))
    may_touch = False
    for i in range(dofs.first[c], dofs.first[c + 1]):
        leftmost = dofs.column[i]
        total[:] = 0.0
        for j in range(rows):
            for k in range(width):
                x = columns[j, leftmost + k]
                row = dofs.rows[dofs.table[i], j, k]
                # 2 j // rows is 0 in the first half of the rows, those of displacements, and 1 in the second.
                for m in range(terms):
                    total[2 * j // rows, m] += x * row[m]

        bound = 0.0
        for m in range(terms):
            taylor[i, m] = total[0, m] * dofs.factors[m] + total[1, m] * dofs.factors[terms + m]
            bound += abs(taylor[i, m])
        may_touch |= not bound < dofs.clearance[i]
    return may_touch


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
    # With dashpots: see ``expand_free_motion``.
    if dofs.rows.shape[1] == out.shape[0]:
        _apply_damped_impulses(dofs, first, moments, out)
        return

    masses, width, terms = dofs.rows.shape[1:]
    for i in range(moments.shape[0]):
        if is_zero(moments[i]):
            continue
        dof = first + i
        for k in range(width):
            cell = dofs.owned[dof, k]
            if cell < 0:
                continue
            for j in range(masses):
                row = dofs.rows[dofs.table[dof], j, k]
                u = 0.0
                v = 0.0
                for m in range(terms):
                    v += row[m] * dofs.factors[2 * m] * moments[i, 2 * m]
                    u += row[m] * dofs.factors[2 * m + 1] * moments[i, 2 * m + 1]
                inverse_mass = dofs.inverse_masses[dofs.table[dof], j, k]
                out[j, cell] += u * inverse_mass
                out[masses + j, cell] += v * inverse_mass


@kernel
def _apply_damped_impulses(dofs: DofTables, first: int, moments: np.ndarray, out: np.ndarray) -> None:
    """Add the motion that forces have caused as ``apply_impulses`` does, in a lattice with dashpots.

    Only the rows of velocities count: see **Rows that serve both ways** in the module's docstring.
    """
    rows, width, terms = dofs.rows.shape[1:]
    masses = rows // 2
    for i in range(moments.shape[0]):
        if is_zero(moments[i]):
            continue
        table = dofs.table[first + i]
        for k in range(width):
            cell = dofs.owned[first + i, k]
            if cell < 0:
                continue
            for j in range(masses):
                row = dofs.rows[table, masses + j, k]
                u = 0.0
                v = 0.0
                # An impulse moves nothing at once, Q_0 = 0: u begins with Q_1, and v has the same coefficient.
                for m in range(1, terms):
                    v += row[m] * dofs.factors[m - 1] * moments[i, m - 1]
                    u += row[m] * dofs.factors[terms + m] * moments[i, m]
                out[j, cell] += u * dofs.inverse_masses[table, j, k]
                out[masses + j, cell] += v * dofs.inverse_masses[table, j, k]
