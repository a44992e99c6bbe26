"""How the cells of a lattice follow each other, and what lies beyond its ends.

A cell has the number of its place, from 0. What lies at another number is the other end of a ring, a wall that holds
springs and does not move, or nothing.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

Ends = Literal["fixed", "free", "periodic"]

WALL = -1
NOTHING = -2
_BEYOND = {"fixed": WALL, "free": NOTHING}


@dataclass(frozen=True)
class Topology:
    """``cells`` in a row, whose ``ends`` are walls (fixed), free, or joined to a ring (periodic).

    With ``ends`` None the row goes on for ever on both sides.
    """

    cells: int
    ends: Ends | None = "fixed"

    @property
    def is_ring(self) -> bool:
        """Whether the last cell is followed by the first one."""
        return self.ends == "periodic"

    @property
    def turns(self) -> tuple[int, ...]:
        """Distances in cells at which the same cells follow again: a ring's one turn before and one turn later."""
        if self.is_ring:
            return -self.cells, 0, self.cells
        return (0,)

    def neighbour(self, cells: ArrayLike, offset: ArrayLike = 0) -> np.ndarray:
        """Return the cell (...) ``offset`` cells further than each of ``cells`` (...), ``WALL`` or ``NOTHING``.

        The ``cells`` themselves may lie beyond the ends.
        """
        number = np.asarray(cells, np.int64) + np.asarray(offset, np.int64)
        if self.ends is None:
            return number
        if self.is_ring:
            return np.asarray(number % self.cells)
        return np.where((number >= 0) & (number < self.cells), number, _BEYOND[self.ends])

    def cells_ahead(self, cells: ArrayLike, other: ArrayLike) -> np.ndarray:
        """Return how many cells further than each of ``cells`` (...) the ``other`` is.

        On a ring that is never negative: one goes to higher cells, through its seam if need be.
        """
        steps = np.asarray(np.asarray(other, np.int64) - np.asarray(cells, np.int64))
        if self.is_ring:
            return np.asarray(steps % self.cells)
        return steps

    def distance(self, cells: ArrayLike, other: ArrayLike) -> np.ndarray:
        """Return the distance (...) in cells of each of ``cells`` (...) to ``other``; the shorter one on a ring."""
        return np.asarray(np.minimum(np.abs(self.cells_ahead(cells, other)), np.abs(self.cells_ahead(other, cells))))

    def nearest_index(self, cells: ArrayLike, other: int) -> int | None:
        """Return the index in ``cells`` (cell,) of the one nearest to ``other``; None without cells.

        The first of two at the same distance counts. The site nearest to the drive is the one that its wave meets
        first.
        """
        distance = self.distance(cells, other)
        if not distance.size:
            return None
        return int(np.argmin(distance))
