"""Compiled passes of one exact linear step: stencil, end cells, jets of sites, responses to forces.

States are arrays (2 dof, cell), displacements before velocities. Every sum runs in an order that depends on the
cell alone, so that results have the same bits on any partition.
"""

from __future__ import annotations

import numpy as np

from vipetsc.compiled import njit

# Cells in one pass: what a pass reads stays in the first-level cache.
CHUNK = 512
# Terms that one pass over a chunk adds.
GROUP = 8

_options = {"cache": True, "error_model": "numpy", "boundscheck": False}


@njit("void(f8[::1], u8, u8, f8[::1], i8, f8[::1], u8, u8, u8, u8, u8, u8, u8, u8)", **_options)
def _add_eight(out, at, count, c, g, x, a0, a1, a2, a3, a4, a5, a6, a7):
    """Add eight terms, of values ``c[g : g + 8]`` and from ``x`` at a0 to a7, to ``out[at : at + count]``.

    Unsigned places need no look at negative ones: the loop is vectorised.
    """
    c0, c1, c2, c3, c4, c5, c6, c7 = c[g], c[g + 1], c[g + 2], c[g + 3], c[g + 4], c[g + 5], c[g + 6], c[g + 7]
    for i in range(count):
        out[at + i] = (
            out[at + i] + c0 * x[a0 + i] + c1 * x[a1 + i] + c2 * x[a2 + i] + c3 * x[a3 + i] + c4 * x[a4 + i]
            + c5 * x[a5 + i] + c6 * x[a6 + i] + c7 * x[a7 + i]
        )  # fmt: skip


@njit("void(f8[:, ::1], i8, f8[:, ::1], i8, i8, i8[::1], i8[::1], i8[::1], f8[::1])", **_options)
def stencil(x, first, out, at, count, starts, rows, offsets, values):
    """``out[:, at : at + count]`` = P times ``x``, whose column ``first`` holds the first of these cells.

    The terms of output row o are ``starts[o]`` to ``starts[o + 1]``, a multiple of ``GROUP``: ``values`` times row
    ``rows`` at the cell ``offsets`` away.
    """
    width, flat, flat_out = x.shape[1], x.reshape(-1), out.reshape(-1)
    for a in range(0, count, CHUNK):
        n = np.uint64(min(CHUNK, count - a))
        for o in range(out.shape[0]):
            y = out[o, at + a : at + min(a + CHUNK, count)]
            y[:] = 0.0
            place = np.uint64(o * out.shape[1] + at + a)
            for g in range(starts[o], starts[o + 1], GROUP):
                b = first + a
                _add_eight(
                    flat_out,
                    place,
                    n,
                    values,
                    g,
                    flat,
                    np.uint64(rows[g] * width + b + offsets[g]),
                    np.uint64(rows[g + 1] * width + b + offsets[g + 1]),
                    np.uint64(rows[g + 2] * width + b + offsets[g + 2]),
                    np.uint64(rows[g + 3] * width + b + offsets[g + 3]),
                    np.uint64(rows[g + 4] * width + b + offsets[g + 4]),
                    np.uint64(rows[g + 5] * width + b + offsets[g + 5]),
                    np.uint64(rows[g + 6] * width + b + offsets[g + 6]),
                    np.uint64(rows[g + 7] * width + b + offsets[g + 7]),
                )


@njit("void(f8[:, ::1], i8, f8[:, :, ::1], f8[:, ::1], i8, f8[::1], i8[::1])", **_options)
def end_cells(x, first, block, out, at, total, wanted):
    """Cells of an end: ``block`` (2 dof, 2 reach, outputs) times the columns of ``x`` from ``first`` on.

    Outputs are (2 dof, reach) in one row; of the cells, ``wanted`` (first, count) go to the columns of ``out``
    from ``at`` on.
    """
    total[:] = 0.0
    for i in range(block.shape[0]):
        for k in range(block.shape[1]):
            value = x[i, first + k]
            for o in range(total.size):
                total[o] += value * block[i, k, o]
    reach = block.shape[1] // 2
    for i in range(out.shape[0]):
        for k in range(wanted[1]):
            out[i, at + k] = total[i * reach + wanted[0] + k]


@njit("void(f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1])", **_options)
def gather(state, halo, columns, out):
    """Columns of ``state`` and, behind them, of ``halo`` into ``out``."""
    owned = state.shape[1]
    for i in range(out.shape[0]):
        for k in range(columns.size):
            c = columns[k]
            out[i, k] = state[i, c] if c < owned else halo[i, c - owned]


@njit("void(f8[:, ::1], i8[::1], i8[::1], f8[:, :, :, ::1], f8[::1], f8[:, ::1], f8[::1])", **_options)
def jets(x, first, kinds, tables, factors, found, bounds):
    """Jets of every member: series in t/H of its free motion over the step, and a bound on its magnitude.

    Parameters
    ----------
    x
        State columns (2 dof, column).
    first, kinds
        Per member: its first column, its table.
    tables
        Rows (kind, dof, cell, term).
    factors
        H / k for odd k, 1 / k for even k by which k! builds up: coefficient k of the series is row times factor.
    found, bounds
        Jets (member, 2 term) and bounds (member,).
    """
    dofs, width, terms = tables.shape[1], tables.shape[2], tables.shape[3]
    for member in range(first.size):
        jet = found[member]
        jet[:] = 0.0
        table = tables[kinds[member]]
        even, odd = jet[:terms], jet[terms:]
        for j in range(dofs):
            for k in range(width):
                u, v = x[j, first[member] + k], x[dofs + j, first[member] + k]
                row = table[j, k]
                for m in range(terms):
                    even[m] += u * row[m]
                    odd[m] += v * row[m]
        mixed = jet.copy()
        bound = 0.0
        for m in range(terms):
            jet[2 * m] = mixed[m] * factors[2 * m]
            jet[2 * m + 1] = mixed[terms + m] * factors[2 * m + 1]
            bound += abs(jet[2 * m]) + abs(jet[2 * m + 1])
        bounds[member] = bound


@njit("void(f8[:, ::1], i8[:, ::1], i8[::1], f8[:, :, :, ::1], f8[::1], f8[::1], f8[:, ::1])", **_options)
def respond(out, columns, kinds, tables, inverse_masses, factors, moments):
    """Add to ``out`` what the forces on a cluster's members leave, at the step's end, in the cells that they reach.

    ``columns`` (member, cell) are those cells in ``out``, -1 for cells of other ranks and none; ``moments`` of
    order k carry (1 - t/H)^k dt.
    """
    dofs, width, terms = tables.shape[1], tables.shape[2], tables.shape[3]
    for member in range(kinds.size):
        acts = False
        for k in range(2 * terms):
            acts |= moments[member, k] != 0.0
        if not acts:
            continue
        for k in range(width):
            c = columns[member, k]
            if c < 0:
                continue
            for j in range(dofs):
                u = v = 0.0
                row = tables[kinds[member], j, k]
                for m in range(terms):
                    v += row[m] * factors[2 * m] * moments[member, 2 * m]
                    u += row[m] * factors[2 * m + 1] * moments[member, 2 * m + 1]
                out[j, c] += u * inverse_masses[j]
                out[dofs + j, c] += v * inverse_masses[j]


@njit("i8(f8[::1], f8[::1], i8[::1], b1[::1], i8[::1])", **_options)
def awake(bounds, limits, firsts, busy, found):
    """Clusters that are busy or have a member whose bound reaches its limit, into ``found``; returns how many."""
    count = 0
    for cluster in range(busy.size):
        up = busy[cluster]
        for member in range(firsts[cluster], firsts[cluster + 1]):
            up |= not bounds[member] < limits[member]
        if up:
            found[count] = cluster
            count += 1
    return count
