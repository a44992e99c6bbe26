"""What joins the masses of a lattice: contacts and springs.

An *element* has a start and an end, masses that are counted from 0 through all cells; its elongation is u_end -
u_start. Where it ends in a wall or on the ground, which do not move, the number is ``WALL``.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_matrix, diags

from vipetsc.lattice.cell import GROUND, Spring
from vipetsc.lattice.chain import Chain
from vipetsc.lattice.topology import NOTHING, WALL, Topology


class Elements(NamedTuple):
    """Contacts or springs (element,): the masses at ``start`` and ``end``, a host and its resonator or a spring's.

    ``cell`` is the one that an element belongs to, -1 for a spring from the wall on the left. ``number`` is that of the
    site, or of the spring in its cell, from 0.
    """

    cell: np.ndarray
    number: np.ndarray
    start: np.ndarray
    end: np.ndarray

    def labels(self) -> list[str]:
        """Return cell and number of each element, both from 1, with a point between them."""
        return [f"{cell + 1}.{number + 1}" for cell, number in zip(self.cell, self.number, strict=True)]

    def mass_pairs(self) -> list[tuple[int, int]]:
        """Return the masses at start and end of each element."""
        return list(zip(self.start.tolist(), self.end.tolist(), strict=True))


def contacts(chain: Chain, topology: Topology | None = None) -> Elements:
    """Return the contacts of all sites of ``chain``, in their order; its cells follow each other as in ``topology``.

    Raises ValueError for a contact with the next cell where there is none.
    """
    sites = chain.sites.table
    dofs = chain.cell.dofs
    return Elements(
        cell=chain.sites.cells,
        number=np.arange(len(sites)),
        start=np.where(sites["host"] >= 0, sites["cell"] * dofs + sites["host"], WALL),
        end=chain.resonator_cells(topology) * dofs + sites["resonator"],
    )


def nonlinear_springs(chain: Chain) -> Elements:
    """Return the springs of ``chain`` whose force has a quadratic or cubic part, from the left."""
    # A lattice may have a billion cells: none is looked at where all springs are linear.
    if chain.is_linear:
        none = np.zeros(0, np.int64)
        return Elements(none, none, none, none)

    topology = chain.topology
    # The springs that begin in a wall on the left belong to the cell before the first one.
    first = 0
    if topology.neighbour(-1) == WALL:
        first = -1
    terms = chain.spring_terms(first, chain.cells)
    cells, numbers = np.nonzero((terms.quadratic != 0) | (terms.cubic != 0))
    cells += first
    table = np.array([(spring.start, spring.end, spring.offset) for spring in chain.cell.springs], np.int64)
    start, end, offset = table[numbers].T

    before = topology.neighbour(cells)
    after = topology.neighbour(cells, offset)
    # Before the first cell, too, there are springs only where one of their ends is in the lattice.
    exists = (after != NOTHING) & ((before >= 0) | (after >= 0))
    dofs = chain.cell.dofs
    springs = Elements(
        cell=cells,
        number=numbers,
        start=np.where((before >= 0) & (start != GROUND), before * dofs + start, WALL),
        end=np.where(after >= 0, after * dofs + end, WALL),
    )
    return Elements(*(column[exists] for column in springs))


def spring_laws(chain: Chain) -> list[Spring]:
    """Return each of the ``nonlinear_springs``, with its own coefficients."""
    springs = nonlinear_springs(chain)
    return [chain.spring(*place) for place in zip(springs.cell.tolist(), springs.number.tolist(), strict=True)]


def incidence(pairs: Sequence[tuple[int, int]], masses: np.ndarray) -> np.ndarray:
    """Return loads (mass, element) of 1 N at both ends of elements, the ``pairs``: -1 at the start, 1 at the end.

    Each column also picks the elongation from the displacements of ``masses`` (mass,), which are in rising order; all
    masses that the elements join are among them.
    """
    loads = np.zeros((len(masses), len(pairs)))
    for weight, of_elements in zip((-1.0, 1.0), np.array(pairs, np.int64).reshape(-1, 2).T, strict=True):
        moves = np.flatnonzero(of_elements >= 0)
        loads[np.searchsorted(masses, of_elements[moves]), moves] += weight
    return loads


def joined_stiffness(elements: Elements, springs: Sequence[float], masses: int, rows: slice) -> csr_matrix:
    """Return ``rows`` of the stiffness (masses, masses) of ``springs`` in N/m, one in the place of each element."""
    ends = np.column_stack([elements.start, elements.end])
    number, side = np.nonzero(ends >= 0)
    # The weights of the masses in the elongations.
    weights = csr_matrix((2.0 * side - 1.0, (number, ends[number, side])), shape=(len(ends), masses))
    stiffness = (weights[:, rows].T @ diags(springs) @ weights).tocsr()
    stiffness.eliminate_zeros()
    return stiffness


def masses_of(cells: ArrayLike, dofs: int) -> np.ndarray:
    """Return the masses (cells dofs,) of ``cells`` (cell,), counted through all cells."""
    return np.asarray(np.add.outer(np.asarray(cells) * dofs, np.arange(dofs)).ravel())
