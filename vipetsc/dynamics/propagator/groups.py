"""Degrees of freedom on which forces act, and the groups of them that are solved for together.

They are contact sites and driven masses. Those that feel one another within a step form a group (sec. 6 of the
derivation in the package's docstring).
"""

from typing import NamedTuple

import numpy as np

from vipetsc.case import Model


class Groups(NamedTuple):
    """Groups of ``contact_dofs``: those of group g are ``numbers[first[g] : first[g + 1]]``.

    In each group the sites' numbers come first, in their own order, then -1 for the first drive, -2 for the second:
    the sign tells drives from sites, however many sites there are.
    """

    numbers: np.ndarray
    first: np.ndarray


def contact_dofs(model: Model) -> np.ndarray:
    """The DoFs on which forces act: relative displacements of the sites, then displacements of driven masses.

    The array (dof,) can be indexed by a site's number or, from the end, by -n for the n-th drive: drives come last, in
    reverse. ``cell`` is a DoF's first cell and ``last`` its last one, the same or the next. ``form`` (cell, mass) are
    the weights c of the displacements in these cells: one cell if no contact of the lattice joins cells, else two.
    ``clearance`` in m is the lesser of a site's two, inf for a driven mass.
    """
    lattice = model.chain
    drives = model.drives[::-1]
    sites = np.arange(len(lattice.sites))

    shape = (1 + lattice.is_joined, lattice.cell.dofs)
    fields = [("cell", int), ("last", int), ("form", float, shape), ("clearance", float)]
    dofs = np.zeros(len(sites) + len(drives), fields)
    dofs["cell"] = [*lattice.sites, *(drive.cell for drive in drives)]

    # ``pairs`` is empty where all sites join the masses of the cell's own pair: one row for all.
    pairs = lattice.pairs or [(lattice.cell.host, lattice.cell.resonator, 0)]
    host, resonator, joins = np.broadcast_to(np.array(pairs, np.int64), (len(sites), 3)).T

    # A site's w is the second mass's displacement, in the next cell if it ``joins`` cells, less the host's. Ground has
    # the number -1, and so the last row, of zeros.
    unit = np.eye(lattice.cell.dofs + 1)[:, :-1]
    dofs["form"][sites, joins] = unit[resonator]
    dofs["form"][sites, 0] -= unit[host]
    dofs["form"][len(sites) :, 0] = unit[[drive.mass for drive in drives]]
    dofs["last"] = dofs["cell"]
    dofs["last"][sites] += joins

    # ``gaps`` is empty where the clearances of every site are equal on both sides.
    gaps = np.min(model.gaps, axis=1) if model.gaps else lattice.clearances
    dofs["clearance"] = [*gaps, *[np.inf] * len(drives)]
    return dofs


def group_dofs(model: Model, reach: int) -> Groups:
    """Divide ``contact_dofs`` into groups, in the lattice's order.

    DoFs within ``reach`` cells of each other are in one group, and so are those that are in one with a third.
    """
    lattice = model.chain
    dofs = contact_dofs(model)
    numbers = np.append(np.arange(len(lattice.sites)), np.arange(-len(model.drives), 0))

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
    # By group, then sites before drives, then by their own count: the last key of lexsort counts most.
    by_group = np.lexsort((np.abs(numbers), numbers < 0, group))
    return Groups(numbers[by_group], first)
