"""Degrees of freedom on which forces act, and the groups of them that are solved for together.

They are contact sites, nonlinear springs, and driven masses. Those that feel one another within a step form a
group (sec. 6 of the derivation in the package's docstring).
"""

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.lattice import Chain, nonlinear_numbers

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
        """How many DoFs of each group (group,) are ``marked`` (dof,)."""
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
    """Whether forces act between masses of two cells: by contacts, or by nonlinear springs."""
    cells, numbers = nonlinear_numbers(chain).T
    inside = cells[[chain.cell.springs[number].next_cell for number in numbers]]
    if chain.ends == "fixed":
        # Springs to a wall act on one mass.
        inside = inside[(inside >= 0) & (inside < chain.cells - 1)]
    return chain.is_joined or inside.size > 0


@lru_cache(maxsize=2)  # each table of an engine asks for those of its model
def contact_dofs(model: Model) -> np.ndarray:
    """The DoFs on which forces act: relative displacements of the sites, elongations, displacements of driven masses.

    The array (dof,) can be indexed by a site's number, after the sites by that of a spring, or, from the end, by -n
    for the n-th drive: drives come last, in reverse. ``cell`` is a DoF's first cell and ``last`` its last one, the same
    or the next. ``form`` (cell, mass) are the weights c of the displacements in these cells: one cell if no force of
    the lattice ``spans_cells``, else two. ``clearance`` in m is the lesser of a site's two, inf for a driven mass, and
    of a spring with the coefficients ``quadratic`` in N/m^2 and ``cubic`` in N/m^3 the elongation below which the force
    that these add to the linear part is rounding.
    """
    lattice = model.chain
    drives = model.drives[::-1]
    sites = np.arange(len(lattice.sites))
    springs = nonlinear_numbers(lattice)

    shape = (1 + spans_cells(lattice), lattice.cell.dofs)
    fields = [("cell", int), ("last", int), ("form", float, shape), ("clearance", float)]
    dofs = np.zeros(len(sites) + len(springs) + len(drives), [*fields, ("quadratic", float), ("cubic", float)])
    first_drive = len(sites) + len(springs)
    dofs["cell"][sites] = lattice.sites
    dofs["cell"][first_drive:] = [drive.cell for drive in drives]

    # ``pairs`` is empty where all sites join the masses of the cell's own pair: one row for all.
    pairs = lattice.pairs or [(lattice.cell.host, lattice.cell.resonator, 0)]
    host, resonator, joins = np.broadcast_to(np.array(pairs, np.int64), (len(sites), 3)).T

    # A site's w is the second mass's displacement, in the next cell if it ``joins`` cells, less the host's. Ground has
    # the number -1, and so the last row, of zeros.
    unit = np.eye(lattice.cell.dofs + 1)[:, :-1]
    dofs["form"][sites, joins] = unit[resonator]
    dofs["form"][sites, 0] -= unit[host]
    dofs["form"][first_drive:, 0] = unit[[drive.mass for drive in drives]]
    dofs["last"] = dofs["cell"]
    dofs["last"][sites] += joins

    # ``gaps`` is empty where the clearances of every site are equal on both sides.
    dofs["clearance"][sites] = lattice.clearances
    if model.gaps:
        dofs["clearance"][sites] = np.min(model.gaps, axis=1)
    dofs["clearance"][first_drive:] = np.inf
    if len(springs):
        _fill_springs(dofs[len(sites) : first_drive], lattice, springs)
    dofs.flags.writeable = False  # all who ask get the same array
    return dofs


def _fill_springs(dofs: np.ndarray, lattice: Chain, springs: np.ndarray) -> None:
    """Fill the ``dofs`` (spring,) of the ``springs`` (spring, 2), cells and numbers, whose elongations they are."""
    cells, numbers = springs.T
    start, end, next_cell = np.array([(s.start, s.end, s.next_cell) for s in lattice.cell.springs], np.int64)[numbers].T
    starts_inside = cells >= 0
    ends_inside = (cells + next_cell < lattice.cells) | (lattice.ends == "periodic")
    joins = next_cell * (starts_inside & ends_inside)
    dofs["cell"] = np.maximum(cells, 0)
    dofs["last"] = dofs["cell"] + joins

    # The elongation is the displacement at the end less that at the start; a wall, number -1, does not move.
    unit = np.eye(lattice.cell.dofs + 1)[:, :-1]
    every = np.arange(len(springs))
    dofs["form"][every, joins] = unit[np.where(ends_inside, end, -1)]
    dofs["form"][every, 0] -= unit[np.where(starts_inside, start, -1)]

    terms = lattice.spring_terms(-1, lattice.cells)
    quadratic = terms.quadratic[cells + 1, numbers]
    cubic = terms.cubic[cells + 1, numbers]
    dofs["quadratic"] = quadratic
    dofs["cubic"] = cubic
    # The root of |c| z^2 + |q| z = NEGLIGIBLE k.
    least = NEGLIGIBLE * lattice.coefficients(-1, lattice.cells).stiffness[cells + 1, numbers]
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

    # On a ring the last group may reach the first one across the joint.
    if lattice.ends == "periodic" and cells[0] + lattice.cells - lasts[-1] <= reach:
        group[group == group.max()] = 0

    first = np.append(0, np.cumsum(np.bincount(group)))
    # By group, then drives last, then by their own count: the last key of lexsort counts most.
    by_group = np.lexsort((np.abs(numbers), numbers < 0, group))
    return Groups(numbers[by_group], first)
