"""Degrees of freedom on which forces act, and the groups of them that are solved for together.

They are contact sites, nonlinear springs, and driven masses. Those that feel one another within a step form a
group (sec. 6 of the derivation in the package's docstring).
"""

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.lattice import Chain, Elements, contacts, nonlinear_springs

# A spring's force beyond its linear part counts from this fraction of the linear part on: below, it is rounding.
NEGLIGIBLE = float(np.finfo(float).epsneg)


class Groups(NamedTuple):
    """Groups of ``contact_dofs``: those of group g are ``numbers[first[g] : first[g + 1]]``.

    In each group the sites' numbers come first, in their own order, then those of springs, which go on after the
    lattice's last site, then -1 for the first drive, -2 for the second.
    """

    numbers: np.ndarray
    first: np.ndarray

    def counts(self, marked: np.ndarray) -> np.ndarray:
        """Return how many DoFs of each group (group,) are ``marked`` (dof,)."""
        before = np.append(0, np.cumsum(marked))
        return before[self.first[1:]] - before[self.first[:-1]]

    def pairs(self) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Yield, for each place j in a group, j and two arrays (pair,) of DoFs, counted in ``numbers``.

        The first has all DoFs of the groups with more than j DoFs, the second the j-th DoF of the same group: the j-th
        is thus paired with all of its group, itself included.
        """
        sizes = np.diff(self.first)
        for j in range(int(sizes.max(initial=0))):
            targets = np.flatnonzero(np.repeat(sizes, sizes) > j)
            yield j, targets, np.repeat(self.first[:-1], sizes)[targets] + j


def spans_cells(chain: Chain) -> bool:
    """Return whether forces act between masses of two cells: by contacts, or by nonlinear springs."""
    springs = nonlinear_springs(chain)
    # Springs to a wall act on one mass.
    joins = (springs.start >= 0) & (springs.end >= 0)
    apart = springs.start // chain.cell.dofs != springs.end // chain.cell.dofs
    return chain.sites.join_cells or bool(np.any(joins & apart))


@lru_cache(maxsize=2)  # each table of an engine asks for those of its model
def contact_dofs(model: Model) -> np.ndarray:
    """Return the DoFs on which forces act: relative displacements of sites, elongations, driven masses.

    The array (dof,) can be indexed by a site's number, after the sites by that of a spring, or, from the end, by -n
    for the n-th drive: drives come last, in reverse. ``cell`` is a DoF's first cell and ``last`` its last one, the same
    or the next. ``form`` (cell, mass) are the weights c of the displacements in these cells: one cell if no force of
    the lattice ``spans_cells``, else two. ``clearance`` in m is the lesser of a site's two, inf for a driven mass, and
    of a spring with the coefficients ``quadratic`` in N/m^2 and ``cubic`` in N/m^3 the elongation below which the force
    that these add to the linear part is rounding.
    """
    lattice = model.chain
    drives = model.drives[::-1]
    springs = nonlinear_springs(lattice)
    of_sites = contacts(lattice)
    first_spring = len(of_sites.cell)
    first_drive = first_spring + len(springs.cell)

    shape = (1 + spans_cells(lattice), lattice.cell.dofs)
    fields = [("cell", int), ("last", int), ("form", float, shape), ("clearance", float)]
    dofs = np.zeros(first_drive + len(drives), [*fields, ("quadratic", float), ("cubic", float)])
    _fill_forms(dofs[:first_spring], of_sites, lattice)
    _fill_forms(dofs[first_spring:first_drive], springs, lattice)
    driven = dofs[first_drive:]
    driven["cell"] = driven["last"] = [drive.cell for drive in drives]
    driven["form"][np.arange(len(drives)), 0, [drive.mass for drive in drives]] = 1.0

    dofs["clearance"][:first_spring] = lattice.sites.gaps.min(axis=1)
    driven["clearance"] = np.inf
    if len(springs.cell):
        _fill_springs(dofs[first_spring:first_drive], lattice, springs)
    dofs.flags.writeable = False  # all who ask get the same array
    return dofs


def _fill_forms(dofs: np.ndarray, elements: Elements, lattice: Chain) -> None:
    """Fill cells and forms of the ``dofs`` (element,) that are the elongations of ``elements``."""
    # The first cell of an element is that of its start, or of its end where it starts in a wall or on the ground.
    masses = lattice.cell.dofs
    dofs["cell"] = np.where(elements.start >= 0, elements.start, elements.end) // masses
    dofs["last"] = dofs["cell"]
    for weight, ends in ((1.0, elements.end), (-1.0, elements.start)):
        moves = np.flatnonzero(ends >= 0)
        cells, mass = np.divmod(ends[moves], masses)
        further = lattice.topology.cells_ahead(dofs["cell"][moves], cells)
        dofs["form"][moves, further, mass] += weight
        dofs["last"][moves] = np.maximum(dofs["last"][moves], dofs["cell"][moves] + further)


def _fill_springs(dofs: np.ndarray, lattice: Chain, springs: Elements) -> None:
    """Fill the laws of the ``dofs`` (spring,) that are elongations of ``springs``, and where these begin to count."""
    terms = lattice.spring_terms(-1, lattice.cells)
    quadratic = terms.quadratic[springs.cell + 1, springs.number]
    cubic = terms.cubic[springs.cell + 1, springs.number]
    dofs["quadratic"] = quadratic
    dofs["cubic"] = cubic
    # The root of |c| z^2 + |q| z = NEGLIGIBLE k.
    stiffness = lattice.coefficients(-1, lattice.cells).stiffness[springs.cell + 1, springs.number]
    least = NEGLIGIBLE * stiffness
    dofs["clearance"] = 2 * least / (np.abs(quadratic) + np.sqrt(quadratic**2 + 4 * np.abs(cubic) * least))


def group_dofs(model: Model, reach: int) -> Groups:
    """Divide ``contact_dofs`` into groups, in the lattice's order.

    DoFs within ``reach`` cells of each other are in one group, and so are those that others link in this way.
    """
    lattice = model.chain
    dofs = contact_dofs(model)
    undriven = len(dofs) - len(model.drives)
    numbers = np.append(np.arange(undriven), np.arange(-len(model.drives), 0))

    # A group ends where the next DoF begins more than ``reach`` cells beyond the last cell of all before it.
    order = np.argsort(dofs["cell"])
    cells = dofs["cell"][order]
    lasts = np.maximum.accumulate(dofs["last"][order])
    group = np.zeros(len(dofs), np.int64)
    group[order[1:]] = np.cumsum(cells[1:] - lasts[:-1] > reach)

    # On a ring the last group may reach the first one across the joint. Elsewhere all are in one group if it does.
    if len(dofs) and lattice.topology.distance(lasts[-1], cells[0]) <= reach:
        group[group == group.max()] = 0

    first = np.append(0, np.cumsum(np.bincount(group)))
    # By group, then drives last, then by their own count: the last key of lexsort counts most.
    by_group = np.lexsort((np.abs(numbers), numbers < 0, group))
    return Groups(numbers[by_group], first)
