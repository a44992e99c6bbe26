"""Where the springs of a finite lattice that are not linear lie."""

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


def nonlinear_places(chain: Chain, also: Collection[int] = ()) -> list[SpringPlace]:
    """The springs of a finite ``chain`` whose force has a quadratic or cubic part, from the left.

    Those with the numbers ``also`` (from 0) in the cell are among them whatever their force is.
    """
    d = chain.cell.dofs
    is_ring = chain.ends == "periodic"
    terms = chain.spring_terms(-1, chain.cells)
    is_wanted = (terms.quadratic != 0) | (terms.cubic != 0)
    is_wanted[:, list(also)] = True

    places = []
    for row, number in np.argwhere(is_wanted).tolist():
        # What begins before the first cell is the spring to the left wall.
        cell = row - 1
        law = chain.spring(cell, number)
        starts_inside = cell >= 0
        ends_inside = is_ring or cell + law.next_cell < chain.cells
        is_cut = chain.ends != "fixed" and not (starts_inside and ends_inside)
        if is_cut or not (starts_inside or law.next_cell):
            continue
        after = (cell + law.next_cell) % chain.cells
        places.append(
            SpringPlace(
                law=law,
                number=number,
                cell=cell,
                start=cell * d + law.start if starts_inside else -1,
                end=after * d + law.end if ends_inside else -1,
            )
        )
    return places
