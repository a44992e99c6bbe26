"""Free motion of the contact DoFs within a step, and what impulses on them leave in the dofs.

Both directions use the same rows, by Maxwell's reciprocity: sec. 2 and 5 of the derivation in the package's docstring.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.compiled import njit
from vipetsc.contact.changes import LANDED_W

# Shares of a step below this are rounding.
ROUNDING = 1e-15


class DofTables(NamedTuple):
    """The contact DoFs of a rank, cluster by cluster, and what joins them to the dofs.

    ``column`` (dof,) is the first column in the halo of the cells that a DoF reaches, ``owned`` (dof, cell) which of
    the rank's cells they are, -1 for cells of other ranks. ``table`` (dof,) numbers its rows in ``rows`` (table,
    mass, cell, term); ``factors`` (2 term,) are H^(k mod 2)/k!; ``inverse_masses`` (mass,) are in 1/kg. ``clearance``
    (dof,) in m is that of a site, inf for the DoF ``driven``, the driven mass (-1 where it is out of reach). The DoFs
    of cluster c are ``first[c]`` to ``first[c + 1]``, those with an energy in the rank's ledger are in ``ledger``.
    """

    column: np.ndarray
    owned: np.ndarray
    table: np.ndarray
    rows: np.ndarray
    factors: np.ndarray
    inverse_masses: np.ndarray
    clearance: np.ndarray
    driven: int
    first: np.ndarray
    ledger: np.ndarray


@njit(error_model="numpy")
def expand_free_motion(dofs: DofTables, c: int, columns: np.ndarray, taylor: np.ndarray) -> bool:
    """Expand the free motion of the DoFs of cluster ``c`` in powers of t/H; whether a site may reach its clearance.

    Coefficients in m go into ``taylor`` (dof, 2 term); ``columns`` (2 mass, column) hold the lattice's state at the
    beginning of the step.
    """
    _, masses, width, terms = dofs.rows.shape
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
                out[j, c] += u * dofs.inverse_masses[j]
                out[masses + j, c] += v * dofs.inverse_masses[j]


@njit(error_model="numpy")
def shift(taylor: np.ndarray, s: float, out: np.ndarray) -> None:
    """Series ``taylor`` (dof, coefficient) expanded about ``s`` instead of 0 into ``out``, which may be ``taylor``."""
    # Coefficient by coefficient, so that the innermost loop runs over contiguous DoFs.
    series = np.ascontiguousarray(taylor.T)
    last, dofs = series.shape[0] - 1, series.shape[1]
    for k in range(last):
        for i in range(last - 1, k - 1, -1):
            for j in range(dofs):
                series[i, j] += s * series[i + 1, j]
    out[:] = series.T


@njit(error_model="numpy")
def evaluate(series: np.ndarray, s: float) -> tuple[float, float]:
    """Value and slope of a ``series`` at ``s``, by Horner's scheme."""
    value = slope = 0.0
    for k in range(series.size - 1, -1, -1):
        slope = slope * s + value
        value = value * s + series[k]
    return value, slope


@njit(error_model="numpy")
def first_onset(series: np.ndarray, clearance: float, length: float) -> float:
    """First s in [0, length] at which |w| comes within rounding of the clearance and grows; 2 if none does.

    |w''| has a bound over the whole length, so that a parabola bounds |w| from above: up to where that meets the
    clearance nothing can have happened.
    """
    bound = curvature = 0.0
    scale = 1.0
    for k in range(series.size):
        bound += abs(series[k]) * scale
        if k >= 2:
            curvature += k * (k - 1) * abs(series[k]) * scale / (length * length)
        scale *= length
    tolerance = LANDED_W * clearance
    if bound < clearance - tolerance:
        return 2.0
    first = 2.0
    for side in (1.0, -1.0):
        s = 0.0
        while s <= length:
            w, rate = evaluate(series, s)
            gap, closing = clearance - side * w, side * rate
            if gap < 0.5 * tolerance and closing > 0.0:
                newton = gap / closing
                first = min(first, max(s + newton, 0.0) if curvature * newton * newton < tolerance else s)
                break
            gap += tolerance
            root = np.sqrt(max(closing * closing + 2.0 * curvature * gap, 0.0))
            # The root of curvature/2 d^2 + closing d = gap, without cancellation.
            step = 2.0 * gap / (closing + root) if closing > 0.0 else (root - closing) / curvature
            s += max(step, ROUNDING)
    return first
