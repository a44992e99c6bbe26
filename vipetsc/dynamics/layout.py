"""The partition of cells over ranks, the order of a rank's part of the state, and its ghosts; the records of kernels.

A rank's part of the state holds, one after another: displacements by mass (all owned cells of mass 1, then of
mass 2, ...), velocities likewise, then its ledger components (where an engine integrates it, what the dashpots of each
owned cell have dissipated; work of each drive whose cell it owns; dissipated energy of each owned site). Behind
them lie the ghosts: displacements of the neighbouring cell on the left, with velocities where there are dashpots to
integrate or contacts with the next cell, then on the right. Mass by mass keeps every inner loop contiguous.

Compiled kernels see a rank's part as a ``LatticeRecord``: tables of masses, springs, sites and drives.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.case import Model
from vipetsc.dynamics.drives import Drives, create_drives
from vipetsc.dynamics.places import PLACE, site_records, sites_within
from vipetsc.lattice import Chain


class Layout:
    """The share of a lattice that one rank owns: cells ``start`` to ``stop`` (0-based, half open), ``owned`` of them.

    Cells come in equal blocks, the first ranks have one more where they do not divide; a rank may be empty. ``ranges``
    and ``offsets`` are the cells and the first state component of every rank. This rank's part of the state has
    ``size`` components; that of the first owned site's dissipated energy is ``dissipated``. ``sites`` are
    the numbers of those it owns, ``contacts`` of all that act on its masses. A cell has ``rows`` of them
    and ``ghost_rows`` as a ghost: with ``dashpots``, of an engine that integrates what these dissipate, one and its
    velocities more in a damped lattice.
    """

    def __init__(self, model: Model, comm: MPI.Comm, dashpots: bool = False) -> None:
        chain = model.chain
        self.comm, self.cells, self.dofs = comm, chain.cells, chain.cell.dofs
        self.periodic = chain.ends == "periodic"
        cuts = cell_cuts(self.cells, comm.size)
        self.ranges = np.array([*pairwise(cuts)])
        driven = np.array([drive.cell for drive in model.drives], np.int64)
        of_ledger, _ = np.histogram([*driven, *chain.sites], cuts)
        self.damped = dashpots and chain.is_damped
        self.rows, self.ghost_rows = 2 * self.dofs + self.damped, self.dofs * (1 + (self.damped or chain.is_joined))
        sizes = self.rows * np.diff(cuts) + of_ledger
        self.offsets = np.append(0, np.cumsum(sizes))
        self.start, self.stop = self.ranges[comm.rank].tolist()
        self.owned, self.size = self.stop - self.start, int(sizes[comm.rank])
        self.sites, self.contacts = sites_within(chain, self.start, self.stop)
        self.drives = tuple(np.flatnonzero((driven >= self.start) & (driven < self.stop)).tolist())
        self.dissipated = self.rows * self.owned + len(self.drives)

    def neighbours(self) -> tuple[int | None, int | None]:
        """Cells to the left and to the right of this rank's; None beyond an end, or on an empty rank."""
        if not self.owned:
            return None, None
        left, right = self.start - 1, self.stop
        if self.periodic:
            return left % self.cells, right % self.cells
        return (left if left >= 0 else None), (right if right < self.cells else None)

    def state_indices(self, cells: ArrayLike) -> np.ndarray:
        """Global indices (cell, 2 dofs) of the displacements and then of the velocities of ``cells``, mass by mass."""
        cells = np.asarray(cells, np.int64)
        rank = np.searchsorted(self.ranges[:, 1], cells, side="right")
        a, b = self.ranges[rank].T
        of_mass = np.multiply.outer(b - a, np.arange(2 * self.dofs))
        return ((self.offsets[rank] + cells - a)[:, None] + of_mass).astype(PETSc.IntType)

    def create_vector(self, array: np.ndarray | None = None) -> PETSc.Vec:
        """A zero state with ghosts for the neighbouring cells, in ``array`` if one is given."""
        indices = self.state_indices([cell for cell in self.neighbours() if cell is not None])
        indices = indices[:, : self.ghost_rows].ravel()
        array = np.zeros(self.size + indices.size) if array is None else array
        return PETSc.Vec().createGhostWithArray(indices, array, size=(self.size, PETSc.DETERMINE), comm=self.comm)

    def losses(self, y: np.ndarray) -> np.ndarray:
        """What the ``contacts`` have dissipated in J in the part ``y`` of the state; 0 of those of other ranks."""
        losses = np.zeros(len(self.contacts))
        losses[np.isin(self.contacts, self.sites)] = y[self.dissipated : self.size]
        return losses

    def place(self, cells: np.ndarray, work: float, y: np.ndarray) -> None:
        """Fill this rank's part ``y`` of the state: ``cells`` (cell, 2 dofs), ``work`` in J of the first drive."""
        y[: 2 * self.dofs * self.owned] = cells.T.ravel()
        y[2 * self.dofs * self.owned : self.rows * self.owned] = 0.0
        y[self.rows * self.owned : self.dissipated] = np.where(np.array(self.drives) == 0, work, 0.0)

    def motion(self, y: np.ndarray) -> np.ndarray:
        """Displacements and velocities (cell, 2 dofs) of the part ``y`` of the state."""
        return y[: 2 * self.dofs * self.owned].reshape(2 * self.dofs, self.owned).T.copy()

    def checkpoint(self, y: np.ndarray) -> dict[str, np.ndarray]:
        """The part ``y`` of the state in natural order: ``cells`` (cell, rows), and the ledger."""
        motion, ledger = y[: self.rows * self.owned], y[self.rows * self.owned : self.size]
        rows = np.zeros(len(ledger), LEDGER)
        rows["number"], rows["energy"] = (*self.drives, *self.sites), ledger
        works, losses = np.split(rows, [len(self.drives)])
        return {"cells": motion.reshape(self.rows, self.owned).T.copy(), "work": works, "losses": losses}

    def restore(self, shares: Sequence[Mapping[str, np.ndarray]], y: np.ndarray) -> None:
        """Fill this rank's part ``y`` of the state, given the checkpoints of all ranks that there were."""
        tables, at = join(shares, {"work": "number", "losses": "number"}), 0
        for share in shares:  # one after the other: no rank holds all cells
            first, stop = max(self.start, at), min(self.stop, at + len(share["cells"]))
            if first < stop:
                motion = y[: self.rows * self.owned].reshape(self.rows, self.owned)
                motion[:, first - self.start : stop - self.start] = share["cells"][first - at : stop - at].T
            at += len(share["cells"])
        ledger = tables["work"][list(self.drives)], tables["losses"][list(self.sites)]
        y[self.rows * self.owned : self.size] = np.concatenate(ledger)["energy"]


def cell_cuts(cells: int, ranks: int) -> list[int]:
    """The first cell of every rank, and behind the last one: equal blocks, the first ranks have one more."""
    return [r * (cells // ranks) + min(r, cells % ranks) for r in range(ranks + 1)]


def join(shares: Sequence[Mapping[str, np.ndarray]], keys: Mapping[str, str | None]) -> dict[str, np.ndarray]:
    """Tables of a checkpoint's ``shares``, one after the other; their rows in the order of a key, if it is given."""
    tables = {name: np.concatenate([share[name] for share in shares]) for name in keys}
    return {name: tables[name][np.argsort(tables[name][key])] if key else tables[name] for name, key in keys.items()}


LEDGER = np.dtype([("number", np.int64), ("energy", np.float64)])
"""A drive or a site, from 0, and its work or its dissipated energy in J."""
MASS = np.dtype([("inverse_mass", np.float64), ("first", np.int64), ("last", np.int64)])
"""A mass of the cell: 1/kg; its rows of the couplings, half open."""
COUPLING = np.dtype([("offset", np.int64), ("other", np.int64), ("stiffness", np.float64), ("spring", np.int64)])
"""A spring as one of its masses sees it: cells to the other mass, that mass, N/m, the spring's number."""
SMOOTH = np.dtype([(name, np.int64) for name in ("mass", "offset", "other")]
                  + [(name, np.float64) for name in ("quadratic", "cubic")])  # fmt: skip
"""A spring that is not linear as one of its masses sees it: that mass, cells to the other one, N/m^2, N/m^3.

The force on the mass is q z^2 + c z^3, z what the other one is ahead; of each spring the end ``start`` comes first.
"""
SPRING = np.dtype([("start", np.int64), ("end", np.int64), ("next_cell", np.int64), ("stiffness", np.float64)])
"""A spring of the cell: its masses, whether ``end`` is in the next cell, N/m."""


class Shape(NamedTuple):
    """Sizes and indices of a rank's part of the lattice; an index is -1 where the rank has no such thing.

    ``owned`` and ``ghosted`` count the state's components without and with ghosts, ``exchange`` tells whether ghosts
    must be fetched, ``paired`` whether contacts join other masses than the cell's pair. ``left_ghost`` and
    ``right_ghost`` are the first components of the neighbouring cells,
    ``left_free`` and ``right_free`` tell whether the lattice has a free end there. ``work``, ``dissipated`` and
    ``damping`` are the components of the first drive's work, of the energies that the first site and the first cell's
    dashpots have dissipated.
    """

    cells: int
    dofs: int
    paired: bool
    owned: int
    ghosted: int
    exchange: bool
    left_ghost: int
    right_ghost: int
    left_free: bool
    right_free: bool
    work: int
    dissipated: int
    damping: int


class LatticeRecord(NamedTuple):
    """A rank's part of a lattice: sizes, tables of the dtypes above, the sites' ``places`` and laws, its drives.

    Where cells differ or there are dashpots, each cell has its own ``inverse_masses`` (dof, cell) in 1/kg and
    ``stiffness`` (spring, 1 + cell) in N/m, which begins with the cell before, and where dashpots are integrated
    ``grounding`` (dof, cell) and ``damping`` (spring, 1 + cell) in N s/m; else these are empty.
    """

    shape: Shape
    masses: np.ndarray
    couplings: np.ndarray
    springs: np.ndarray
    places: np.ndarray
    contacts: np.ndarray
    drives: Drives
    smooth: np.ndarray
    inverse_masses: np.ndarray
    grounding: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray


COEFFICIENTS = LatticeRecord._fields[-4:]


def create_record(model: Model, layout: Layout) -> LatticeRecord:
    """The record of the part of ``model`` that ``layout`` gives to this rank; all sites are free."""
    chain, cell = model.chain, model.chain.cell
    n, d, (left, right) = layout.owned, layout.dofs, layout.neighbours()
    shape = Shape(
        cells=n,
        dofs=d,
        paired=bool(chain.pairs),
        owned=layout.size,
        ghosted=layout.size + layout.ghost_rows * ((left is not None) + (right is not None)),
        exchange=layout.comm.size > 1 or layout.periodic,
        left_ghost=-1 if left is None else layout.size,
        right_ghost=-1 if right is None else layout.size + layout.ghost_rows * (left is not None),
        left_free=chain.ends == "free" and left is None,
        right_free=chain.ends == "free" and right is None,
        work=layout.rows * n,
        dissipated=layout.dissipated,
        damping=2 * d * n if layout.damped else -1,
    )
    couplings = cell.couplings()
    rows = np.searchsorted([c[0] for c in couplings], np.arange(d + 1)).tolist()
    masses = [(1 / mass, *bounds) for mass, bounds in zip(cell.masses, pairwise(rows), strict=True)]
    bent = [spring for spring in cell.springs if spring.quadratic or spring.cubic]
    smooth = [row for s in bent for row in ((s.start, s.next_cell, s.end, s.quadratic, s.cubic),
                                            (s.end, -s.next_cell, s.start, -s.quadratic, s.cubic))]  # fmt: skip
    drives = create_drives(model.drives, layout.drives)
    for row, drive in zip(drives.rows, (model.drives[i] for i in layout.drives), strict=True):
        row["target"] = (d + drive.mass) * n + drive.cell - layout.start
        row["inverse"] = 1 / chain.coefficients(drive.cell, drive.cell + 1).masses[0, drive.mass]
    return LatticeRecord(
        shape,
        np.array(masses, MASS),
        np.array([(c.offset, c.other, c.stiffness, c.spring) for c in couplings], COUPLING),
        np.array([(s.start, s.end, s.next_cell, s.stiffness) for s in cell.springs], SPRING),
        create_places(model, layout, (shape.left_ghost, shape.right_ghost)),
        site_records(model, layout.contacts),
        drives,
        np.array(smooth, SMOOTH),
        *_coefficients(chain, layout),
    )


def create_places(model: Model, layout: Layout, ghosts: tuple[int, int]) -> np.ndarray:
    """Records (site,) of dtype ``PLACE`` of the sites ``layout.contacts``; ``ghosts`` are their first components."""
    chain, n, d = model.chain, layout.owned, layout.dofs

    def end(cell: int, mass: int) -> tuple[int, int, int, int]:
        if mass < 0:
            return -1, -1, -1, -1
        here = cell % chain.cells - layout.start
        if 0 <= here < n:
            return mass * n + here, (d + mass) * n + here, here, mass
        first = ghosts[cell >= layout.stop]
        return first + mass, first + d + mass, -1, mass

    places, pairs = np.zeros(len(layout.contacts), PLACE), chain.contact_pairs
    for row, i in zip(places, layout.contacts, strict=True):
        pair, cell = pairs[i], chain.sites[i]
        if cell == chain.cells - 1 and layout.start == 0 and n < chain.cells:
            cell = -1  # of a ring, as its first cells see it
        row["host"], row["resonator"] = end(cell, pair.host), end(cell + pair.next_cell, pair.resonator)
    owned = np.isin(layout.contacts, layout.sites)
    places["ledger"] = np.where(owned, layout.dissipated + np.cumsum(owned) - 1, -1)
    return places


def _coefficients(chain: Chain, layout: Layout) -> list[np.ndarray]:
    """The arrays ``COEFFICIENTS`` of a rank's cells."""
    if chain.is_uniform() and not layout.damped:
        return [np.zeros(0)] * 4
    masses, grounding, stiffness, damping = chain.coefficients(layout.start - 1, layout.stop)
    stop = None if layout.damped else 0
    arrays = 1 / masses[1:], grounding[1:][:stop], stiffness, damping[:stop]
    return [array.T.flatten() for array in arrays]
