"""The contact DoFs' tables: free motion and, by Maxwell's reciprocity, what impulses on them leave in the lattice.

Sec. 2 and 5 of the derivation in the package's docstring.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.compiled import njit
from vipetsc.dynamics.layout import Layout


def owned_cells(firsts: np.ndarray, count: int, layout: Layout) -> np.ndarray:
    """Local numbers (dof, count) of so many cells from each of ``firsts`` (dof,) on, -1 where nothing is owned."""
    around = firsts[:, None] + np.arange(count)
    around = around % layout.cells if layout.periodic else around
    return np.where((around >= layout.start) & (around < layout.stop), around - layout.start, -1)


class DofTables(NamedTuple):
    """The contact DoFs of a rank, cluster by cluster, and what joins them to the dofs.

    ``column`` (dof,) is the first column in the halo of the cells that a DoF reaches, ``owned`` (dof, cell) which of
    the rank's cells they are, -1 for cells of other ranks. ``table`` (dof,) numbers its rows in ``rows`` (table,
    mass, cell, term) and the masses there in ``inverse_masses`` (table, mass, cell) in 1/kg; ``factors`` (2 term,) are
    H^(k mod 2)/k!. With dashpots rows are (table, 2 mass, cell, 2 term), ``factors`` 1/k! and then H/k!. ``clearance``
    (dof,) in m is the lesser of a site, inf for a driven mass; so many ``sites`` (cluster,) come before these. The DoFs
    of cluster c are ``first[c]`` to ``first[c + 1]``, those with an energy in the rank's ledger are in ``ledger``.
    """

    column: np.ndarray
    owned: np.ndarray
    table: np.ndarray
    rows: np.ndarray
    factors: np.ndarray
    inverse_masses: np.ndarray
    clearance: np.ndarray
    sites: np.ndarray
    first: np.ndarray
    ledger: np.ndarray


@njit(error_model="numpy")
def _expand_damped_motion(dofs: DofTables, c: int, columns: np.ndarray, taylor: np.ndarray) -> bool:
    """As ``expand_free_motion``, of a lattice with dashpots."""
    _, rows, width, terms = dofs.rows.shape
    total, may_touch = np.empty((2, terms)), False
    for i in range(dofs.first[c], dofs.first[c + 1]):
        first, bound = dofs.column[i], 0.0
        total[:] = 0.0
        for j in range(rows):
            for k in range(width):
                x, row = columns[j, first + k], dofs.rows[dofs.table[i], j, k]
                for m in range(terms):
                    total[2 * j // rows, m] += x * row[m]
        for m in range(terms):
            taylor[i, m] = total[0, m] * dofs.factors[m] + total[1, m] * dofs.factors[terms + m]
            bound += abs(taylor[i, m])
        may_touch |= not bound < dofs.clearance[i]
    return may_touch


@njit(error_model="numpy")
def _apply_damped_impulses(dofs: DofTables, first: int, moments: np.ndarray, out: np.ndarray) -> None:
    """As ``apply_impulses``, in a lattice with dashpots."""
    rows, width, terms = dofs.rows.shape[1:]
    masses = rows // 2
    for i in range(moments.shape[0]):
        for k in range(width if moments[i].any() else 0):
            c, table = dofs.owned[first + i, k], dofs.table[first + i]
            for j in range(masses if c >= 0 else 0):
                u, v, row = 0.0, 0.0, dofs.rows[table, masses + j, k]
                for m in range(1, terms):
                    v += row[m] * dofs.factors[m - 1] * moments[i, m - 1]
                    u += row[m] * dofs.factors[terms + m] * moments[i, m]
                out[j, c] += u * dofs.inverse_masses[table, j, k]
                out[masses + j, c] += v * dofs.inverse_masses[table, j, k]


@njit(error_model="numpy")
def expand_free_motion(dofs: DofTables, c: int, columns: np.ndarray, taylor: np.ndarray) -> bool:
    """Expand the free motion of the DoFs of cluster ``c`` in powers of t/H; whether a site may reach its clearance.

    Coefficients in m go into ``taylor`` (dof, 2 term); ``columns`` (2 mass, column) hold the lattice's state at the
    beginning of the step.
    """
    _, masses, width, terms = dofs.rows.shape
    if masses == columns.shape[0]:
        return _expand_damped_motion(dofs, c, columns, taylor)
    even, odd, may_touch = np.empty(terms), np.empty(terms), False
    for i in range(dofs.first[c], dofs.first[c + 1]):
        rows, first, bound = dofs.rows[dofs.table[i]], dofs.column[i], 0.0
        even[:] = odd[:] = 0.0
        for j in range(masses):
            for k in range(width):
                u, v = columns[j, first + k], columns[masses + j, first + k]
                row = rows[j, k]
                for m in range(terms):
                    even[m] += u * row[m]
                    odd[m] += v * row[m]
        for m in range(terms):
            taylor[i, 2 * m] = even[m] * dofs.factors[2 * m]
            taylor[i, 2 * m + 1] = odd[m] * dofs.factors[2 * m + 1]
            bound += abs(taylor[i, 2 * m]) + abs(taylor[i, 2 * m + 1])
        may_touch |= not bound < dofs.clearance[i]
    return may_touch


@njit(error_model="numpy")
def apply_impulses(dofs: DofTables, first: int, moments: np.ndarray, out: np.ndarray) -> None:
    """Add to the owned cells ``out`` (2 mass, cell) what forces within the step leave there at its end.

    Row i of ``moments`` (dof, 2 term) belongs to the DoF ``first`` + i: integrals of its force times (1 - t/H)^k dt.
    """
    masses, width, terms = dofs.rows.shape[1:]
    if masses == out.shape[0]:
        _apply_damped_impulses(dofs, first, moments, out)
        return
    for i in range(moments.shape[0]):
        if not moments[i].any():
            continue
        dof = first + i
        for k in range(width):
            c = dofs.owned[dof, k]
            if c < 0:
                continue
            for j in range(masses):
                u = v = 0.0
                row = dofs.rows[dofs.table[dof], j, k]
                for m in range(terms):
                    v += row[m] * dofs.factors[2 * m] * moments[i, 2 * m]
                    u += row[m] * dofs.factors[2 * m + 1] * moments[i, 2 * m + 1]
                inverse_mass = dofs.inverse_masses[dofs.table[dof], j, k]
                out[j, c] += u * inverse_mass
                out[masses + j, c] += v * inverse_mass
