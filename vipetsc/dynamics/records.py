"""The lattice as compiled kernels see it: tables of masses, springs and sites, and the drive.

A rank's part of the state is ordered as ``layout`` says.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.compiled import njit
from vipetsc.contact.law import Contacts, create_contacts
from vipetsc.dynamics.layout import Layout
from vipetsc.lattice import ToneBurst

MASS = np.dtype([("inverse_mass", np.float64), ("first", np.int64), ("last", np.int64)])
"""A mass of the cell: 1/kg; its rows of the couplings, half open."""
COUPLING = np.dtype([("offset", np.int64), ("other", np.int64), ("stiffness", np.float64)])
"""A spring as one of its masses sees it: cells to the other mass, that mass, N/m."""
SPRING = np.dtype([("start", np.int64), ("end", np.int64), ("next_cell", np.int64), ("stiffness", np.float64)])
"""A spring of the cell: its masses, whether ``end`` is in the next cell, N/m."""


class Shape(NamedTuple):
    """Sizes and indices of a rank's part of the lattice; an index is -1 where the rank has no such thing.

    ``owned`` and ``ghosted`` count the state's components without and with ghosts, ``exchange`` tells whether ghosts
    must be fetched. ``left_ghost`` and ``right_ghost`` are the first components of the neighbouring cells,
    ``left_free`` and ``right_free`` tell whether the lattice has a free end there. ``driven``, ``work`` and
    ``dissipated`` are the components of the driven mass's velocity, the work, the first site's dissipated energy.
    """

    cells: int
    dofs: int
    host: int
    resonator: int
    owned: int
    ghosted: int
    exchange: bool
    left_ghost: int
    right_ghost: int
    left_free: bool
    right_free: bool
    driven: int
    work: int
    dissipated: int


class Burst(NamedTuple):
    """A tone burst: factor before 1 - cos in N, frequency in rad/s, cycles, duration in s."""

    amplitude: float
    frequency: float
    cycles: float
    duration: float


class LatticeRecord(NamedTuple):
    """A rank's part of a lattice: sizes, tables of the dtypes above, the sites' local cells, the drive."""

    shape: Shape
    masses: np.ndarray
    couplings: np.ndarray
    springs: np.ndarray
    site_cells: np.ndarray
    contacts: Contacts
    burst: Burst


def create_burst(drive: ToneBurst) -> Burst:
    """The record of a tone burst."""
    return Burst(drive.window_amplitude, drive.frequency, float(drive.cycles), drive.duration)


def create_record(model: Model, layout: Layout) -> LatticeRecord:
    """The record of the part of ``model`` that ``layout`` gives to this rank; all sites are free."""
    chain, cell = model.chain, model.chain.cell
    n, d, (left, right) = layout.owned, layout.dofs, layout.neighbours()
    shape = Shape(
        cells=n,
        dofs=d,
        host=cell.host,
        resonator=cell.resonator,
        owned=layout.size,
        ghosted=layout.size + d * ((left is not None) + (right is not None)),
        exchange=layout.comm.size > 1 or layout.periodic,
        left_ghost=-1 if left is None else layout.size,
        right_ghost=-1 if right is None else layout.size + d * (left is not None),
        left_free=chain.ends == "free" and left is None,
        right_free=chain.ends == "free" and right is None,
        driven=(d + model.drive_mass) * n + model.drive_cell - layout.start if layout.owns_drive else -1,
        work=layout.work,
        dissipated=layout.dissipated,
    )
    couplings = cell.couplings()
    rows = np.searchsorted([c[0] for c in couplings], np.arange(d + 1)).tolist()
    masses = [(1 / mass, *bounds) for mass, bounds in zip(cell.masses, pairwise(rows), strict=True)]
    return LatticeRecord(
        shape,
        np.array(masses, MASS),
        np.array([c[1:] for c in couplings], COUPLING),
        np.array([(s.start, s.end, s.next_cell, s.stiffness) for s in cell.springs], SPRING),
        np.array([chain.sites[i] - layout.start for i in layout.sites], np.int64),
        create_contacts(model.contact, [chain.clearances[i] for i in layout.sites]),
        create_burst(model.drive),
    )


@njit(error_model="numpy")
def drive_force(burst: Burst, t: float) -> float:
    """Force in N of the tone burst at time t in s, Eq. (3)."""
    if t <= 0.0 or t >= burst.duration:
        return 0.0
    phase = burst.frequency * t
    return burst.amplitude * (1.0 - np.cos(phase / burst.cycles)) * np.sin(phase)
