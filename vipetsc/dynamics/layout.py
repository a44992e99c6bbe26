"""The partition of cells over ranks, the order of a rank's part of the state, and its ghosts.

A rank's part of the state holds, one after another: displacements by mass (all owned cells of mass 1, then of
mass 2, ...), velocities likewise, then its ledger components (what the dashpots of each owned cell have dissipated, if
an engine integrates that; work of each drive whose cell it owns; dissipated energy of each owned site). The ghosts
follow them: displacements of the neighbouring cell on the left, with velocities where there are dashpots or contacts
with the next cell, then on the right. Mass by mass keeps every inner loop contiguous.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.case import Model
from vipetsc.lattice import Chain, contacts
from vipetsc.lattice.topology import NOTHING, WALL

LEDGER = np.dtype([("number", np.int64), ("energy", np.float64)])
"""A drive or a site, from 0, and its work or its dissipated energy in J."""


class Layout:
    """The part of a lattice that one rank owns: cells ``start`` to ``stop`` (0-based, half open), ``owned`` of them.

    Cells come in equal blocks, the first ranks have one more where they do not divide; a rank may be empty. ``ranges``
    and ``offsets`` are the cells and the first state component of every rank. This rank's part of the state has
    ``size`` components; the component of the first owned site's dissipated energy is ``dissipated``. ``sites`` are the
    numbers of the owned sites, ``acting_sites`` of all that act on its masses. A cell has ``per_cell`` components,
    as a ghost ``ghost_rows``. Ghosts have velocities where the lattice is ``damped``. If ``integrates_damping``, each
    cell of such a lattice has one more component, the energy that its dashpots have dissipated.
    """

    def __init__(self, model: Model, comm: MPI.Comm, integrates_damping: bool = True) -> None:
        chain = model.chain
        self.comm = comm
        self.cells = chain.cells
        self.dofs = chain.cell.dofs
        self.topology = chain.topology
        self.damped = chain.is_damped
        self.integrates_damping = self.damped and integrates_damping
        self.per_cell = 2 * self.dofs + self.integrates_damping
        self.ghost_rows = self.dofs * (1 + (self.damped or chain.sites.join_cells))

        cuts = cell_cuts(self.cells, comm.size)
        driven = np.array([drive.cell for drive in model.drives], np.int64)
        ledger_sizes, _ = np.histogram(np.append(driven, chain.sites.cells), cuts)
        # Behind a rank's cells one component for each drive and site that it owns.
        sizes = self.per_cell * np.diff(cuts) + ledger_sizes
        self.ranges = np.array([*pairwise(cuts)])
        self.offsets = np.append(0, np.cumsum(sizes))

        self.start, self.stop = self.ranges[comm.rank].tolist()
        self.owned = self.stop - self.start
        self.size = int(sizes[comm.rank])
        self.sites, self.acting_sites = _sites_within(chain, self.start, self.stop)
        self.drives = tuple(np.flatnonzero((driven >= self.start) & (driven < self.stop)).tolist())
        self.dissipated = self.per_cell * self.owned + len(self.drives)
        # Asked for at every change of a contact.
        self._is_own = np.isin(self.acting_sites, self.sites)

    def neighbours(self) -> tuple[int, int]:
        """Return the cells next to this rank's on the left and right, ``WALL`` or ``NOTHING``, as on an empty rank."""
        if not self.owned:
            return NOTHING, NOTHING
        left, right = self.topology.neighbour([self.start, self.stop - 1], [-1, 1]).tolist()
        return left, right

    @property
    def ghosts(self) -> list[int]:
        """The neighbouring cells of which this rank has a copy, the left one first."""
        return [cell for cell in self.neighbours() if cell >= 0]

    def ghost_places(self) -> tuple[int, int]:
        """Return the first components of the ghosts on the left and on the right, ``WALL`` or ``NOTHING``."""
        left, right = self.neighbours()
        first = self.size
        if left >= 0:
            left = first
            first += self.ghost_rows
        if right >= 0:
            right = first
        return left, right

    def components(self, masses: np.ndarray) -> np.ndarray:
        """Return where the state with its ghosts has displacement and velocity (mass, 2) of ``masses`` (mass,).

        They are counted through all cells, and are in this rank's or in neighbouring ones; -1 for ``WALL``.
        """
        cells, mass = np.divmod(masses, self.dofs)
        left_ghost, right_ghost = self.ghost_places()
        ghost = np.where(cells == self.neighbours()[0], left_ghost, right_ghost)
        is_own = (cells >= self.start) & (cells < self.stop)
        first = np.where(is_own, mass * self.owned + cells - self.start, ghost + mass)
        to_velocity = np.where(is_own, self.dofs * self.owned, self.dofs)
        components = np.column_stack([first, first + to_velocity])
        return np.where((masses == WALL)[:, None], -1, components)

    def state_indices(self, cells: ArrayLike) -> np.ndarray:
        """Return global indices (cell, 2 dofs) of displacements and then velocities of ``cells``, mass by mass."""
        cells = np.asarray(cells, np.int64)
        rank = np.searchsorted(self.ranges[:, 1], cells, side="right")
        start, stop = self.ranges[rank].T
        # PETSc reads the indices as its own type, of 32 or 64 bits by its configuration.
        mass_offsets = np.multiply.outer(stop - start, np.arange(2 * self.dofs))
        return ((self.offsets[rank] + cells - start)[:, None] + mass_offsets).astype(PETSc.IntType)

    def create_vector(self, array: np.ndarray | None = None) -> PETSc.Vec:
        """Return a zero state with ghosts for the neighbouring cells; all ranks must call it.

        It has its components in ``array`` (component,) if one is given: the rank's own, then those of the ghosts.
        """
        indices = self.state_indices(self.ghosts)
        indices = indices[:, : self.ghost_rows].ravel()
        # One array holds owned components and ghosts, so that compiled code reads both without a copy.
        if array is None:
            array = np.zeros(self.size + indices.size)
        return PETSc.Vec().createGhostWithArray(indices, array, size=(self.size, PETSc.DETERMINE), comm=self.comm)

    def losses(self, y: np.ndarray) -> np.ndarray:
        """Return energies (contact,) in J that the ``contacts`` have dissipated, 0 for those that other ranks own.

        ``y`` (component,) is the rank's part of the state.
        """
        losses = np.zeros(len(self.acting_sites))
        losses[self._is_own] = y[self.dissipated : self.size]
        return losses

    def place(self, cells: np.ndarray, work: float, y: np.ndarray) -> None:
        """Fill this rank's part ``y`` of the state: ``cells`` (cell, 2 dofs), ``work`` in J of the first drive."""
        motion = 2 * self.dofs * self.owned
        y[:motion] = cells.T.ravel()
        y[motion : self.per_cell * self.owned] = 0.0
        y[self.per_cell * self.owned : self.dissipated] = np.where(np.array(self.drives) == 0, work, 0.0)

    def motion(self, y: np.ndarray) -> np.ndarray:
        """Return displacements and velocities (cell, 2 dofs) of the part ``y`` of the state."""
        return y[: 2 * self.dofs * self.owned].reshape(2 * self.dofs, self.owned).T.copy()

    def checkpoint(self, y: np.ndarray) -> dict[str, np.ndarray]:
        """Return the part ``y`` of the state in natural order: ``cells`` (cell, 2 dofs), ``dashpots`` (cell,), ledger.

        ``dashpots`` in J is empty where their dissipation is not integrated.
        """
        dashpots = y[2 * self.dofs * self.owned : self.per_cell * self.owned].copy()
        ledger = np.zeros(len(self.drives) + len(self.sites), LEDGER)
        ledger["number"] = (*self.drives, *self.sites)
        ledger["energy"] = y[self.per_cell * self.owned : self.size]
        works, losses = np.split(ledger, [len(self.drives)])
        return {"cells": self.motion(y), "dashpots": dashpots, "work": works, "losses": losses}

    def restore(self, checkpoints: Sequence[Mapping[str, np.ndarray]], y: np.ndarray) -> None:
        """Fill this rank's part ``y`` (component,) of the state from the checkpoints of all ranks that wrote one.

        Each has the arrays of ``checkpoint``, ``cells`` (cell, 2 dofs) first. Sites that they do not name have
        dissipated nothing.
        """
        rows = y[: self.per_cell * self.owned].reshape(self.per_cell, self.owned)
        at = 0
        for checkpoint in checkpoints:  # one after the other: no rank holds all cells
            cells = checkpoint["cells"]
            first = max(self.start, at)
            stop = min(self.stop, at + len(cells))
            if first < stop:
                part = rows[:, first - self.start : stop - self.start]
                part[: 2 * self.dofs] = cells[first - at : stop - at].T
                if self.integrates_damping:
                    part[2 * self.dofs] = checkpoint["dashpots"][first - at : stop - at]
            at += len(cells)

        tables = join(checkpoints, {"work": "number", "losses": "number"})
        y[self.per_cell * self.owned : self.dissipated] = tables["work"]["energy"][list(self.drives)]
        losses = tables["losses"]
        named = np.isin(self.sites, losses["number"])
        y[self.dissipated : self.size] = 0.0
        y[self.dissipated : self.size][named] = losses["energy"][np.isin(losses["number"], self.sites)]


def cell_cuts(cells: int, ranks: int) -> list[int]:
    """Return first cell (rank + 1) of every rank, and ``cells``: equal blocks, of which the first may have one more."""
    return [r * (cells // ranks) + min(r, cells % ranks) for r in range(ranks + 1)]


def _sites_within(chain: Chain, start: int, stop: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return numbers of the sites of the cells ``start`` to ``stop``, and of all that act on a mass there."""
    elements = contacts(chain)
    owned = (elements.cell >= start) & (elements.cell < stop)
    # A site's host is in its own cell; its resonator may be in the next one, which another rank may own.
    resonator_cells = elements.end // chain.cell.dofs
    acting = owned | ((resonator_cells >= start) & (resonator_cells < stop))
    return tuple(np.flatnonzero(owned).tolist()), tuple(np.flatnonzero(acting).tolist())


def join(checkpoints: Sequence[Mapping[str, np.ndarray]], keys: Mapping[str, str | None]) -> dict[str, np.ndarray]:
    """Return the tables (row,) named in ``keys`` of all ranks' ``checkpoints``, one after the other.

    ``keys`` gives the field by which the rows of a table are put in order, None for the order of the ranks.
    """
    joined = {}
    for name, key in keys.items():
        table = np.concatenate([checkpoint[name] for checkpoint in checkpoints])
        if key:
            table = table[np.argsort(table[key])]
        joined[name] = table
    return joined
