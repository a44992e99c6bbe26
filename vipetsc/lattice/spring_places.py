"""The nonlinear springs of a finite lattice: which there are, and the masses that each joins."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from vipetsc.lattice.cell import Spring
from vipetsc.lattice.chain import Chain


class SpringPlace(NamedTuple):
    """A spring of a lattice between two masses, counted from 0 through all cells; -1 is a wall.

    ``law`` is the spring itself and ``number`` its place in the cell from 0, ``cell`` the one that it begins in from 0:
    -1 on the left of the first one. Its elongation is u_end - u_start, and u = 0 in a wall.
    """

    law: Spring
    number: int
    cell: int
    start: int
    end: int


def nonlinear_numbers(chain: Chain, also: Collection[int] = ()) -> np.ndarray:
    """Cells and numbers (spring, 2), as in ``SpringPlace``, of the springs that ``nonlinear_places`` returns."""
    # A lattice may have a billion cells: none is looked at where all springs are linear.
    if chain.is_linear and not also:
        return np.zeros((0, 2), np.int64)
    terms = chain.spring_terms(-1, chain.cells)
    is_wanted = (terms.quadratic != 0) | (terms.cubic != 0)
    is_wanted[:, list(also)] = True
    rows, numbers = np.nonzero(is_wanted)
    cells = rows - 1

    # Before the first cell there is a spring to the left wall, and none at all unless the ends are fixed.
    next_cell = np.array([spring.next_cell for spring in chain.cell.springs], bool)[numbers]
    exists = next_cell | (cells >= 0)
    if chain.ends != "fixed":
        exists &= cells >= 0
    if chain.ends == "free":
        exists &= cells + next_cell < chain.cells
    return np.column_stack([cells, numbers])[exists]


def nonlinear_places(chain: Chain, also: Collection[int] = ()) -> list[SpringPlace]:
    """The springs of a finite ``chain`` whose force has a quadratic or cubic part, from the left.

    Those with the numbers ``also`` (from 0) in the cell are among them whatever their force is.
    """
    d = chain.cell.dofs
    places = []
    for cell, number in nonlinear_numbers(chain, also).tolist():
        law = chain.spring(cell, number)
        ends_inside = chain.ends == "periodic" or cell + law.next_cell < chain.cells
        # In a ring the cell after the last one is the first.
        after = (cell + law.next_cell) % chain.cells
        places.append(
            SpringPlace(
                law=law,
                number=number,
                cell=cell,
                start=cell * d + law.start if cell >= 0 else -1,
                end=after * d + law.end if ends_inside else -1,
            )
        )
    return places
