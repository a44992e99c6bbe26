"""A rank's part of the lattice for compiled kernels: sizes, and tables of masses, springs, sites and drives."""

from itertools import pairwise
from typing import NamedTuple, get_type_hints

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.law import SITE
from vipetsc.dynamics.drives import DRIVE, Drives, create_drives
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.site_dofs import SITE_DOFS, create_site_dofs, site_records
from vipetsc.dynamics.spring_law import SPRING_LAW
from vipetsc.lattice import Chain, UnitCell
from vipetsc.lattice.cell import GROUND
from vipetsc.lattice.drive import PIECE
from vipetsc.lattice.topology import WALL
from vipetsc.records import Record, record_type

# Cells in one pass over springs: a pass over those of a mass touches a row of each of its neighbours and one of the
# result, 4 kB each of so many cells, which stay in a first-level cache of 32 kB. Not sharp where the second level is
# near: 256 to 2048 take the same CPU time of ``ts`` at 20,000 cells, to the 7 % of its scatter, and give the same bits.
CHUNK = 512
MASS = np.dtype([("inverse_mass", np.float64), ("first", np.int64), ("last", np.int64)])
"""A mass of the cell: 1/kg; its rows of the couplings, half open."""
_INTEGERS = ("mass", "offset", "other", "spring", "law", "stride", "outside_u", "outside_v")
COUPLING = np.dtype([(name, np.int64) for name in _INTEGERS] + [(name, np.float64) for name in ("sign", "stiffness")])
"""A spring as one of its masses sees it, as ``lattice.cell.Coupling``, for a rank's cells.

``law`` is the number of its nonlinear part in the rank's first cell, -1 without one, and ``stride`` the step from a
cell's law to the next cell's, 0 if all have one. ``outside_u`` and ``outside_v`` are the components of displacement and
velocity of the other mass where it is not in the rank's cells, ``WALL``, which the ground is, too, or ``NOTHING``.
"""


class Shape(NamedTuple):
    """Sizes and indices of a rank's part of the lattice; an index is -1 where the rank has no such thing.

    ``owned`` and ``ghosted`` count the state's components without and with ghosts; ``exchange`` says whether ghosts
    must be fetched, ``paired`` whether contacts join other masses than the cell's pair. ``work``, ``dissipated`` and
    ``damping`` are the components of the first drive's work, of the energies that the first site and the first cell's
    dashpots have dissipated.
    """

    cells: int
    dofs: int
    paired: bool
    owned: int
    ghosted: int
    exchange: bool
    work: int
    dissipated: int
    damping: int


class LatticeRecord(NamedTuple):
    """A rank's part of a lattice: sizes, tables of the dtypes above, its sites and its drives.

    ``couplings`` are in the order of their masses; ``spring_ends`` are their numbers in the order of the springs, each
    spring's start before its end.
    ``site_dofs`` (site,) of dtype ``SITE_DOFS`` and ``contacts`` (site,) of dtype ``SITE`` are those of the same sites.
    ``spring_laws`` (law,) of dtype ``SPRING_LAW`` are those that ``couplings`` refer to.
    Where cells differ or there are dashpots, each cell has its own ``inverse_masses`` (dof, cell) in 1/kg and
    ``stiffness`` (spring, 1 + cell) in N/m, which begins with the cell before, and where there are dashpots
    ``grounding`` (dof, cell) and ``damping`` (spring, 1 + cell) in N s/m; else these are empty. ``zeros`` (``CHUNK``,)
    are the motion of the ground.
    """

    shape: Shape
    masses: np.ndarray
    couplings: np.ndarray
    spring_ends: np.ndarray
    site_dofs: np.ndarray
    contacts: np.ndarray
    drives: Drives
    spring_laws: np.ndarray
    inverse_masses: np.ndarray
    grounding: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    zeros: np.ndarray


def create_record(model: Model, layout: Layout) -> Record:
    """Return the record of the part of ``model`` that ``layout`` gives to this rank; all sites are free."""
    chain = model.chain
    cell = chain.cell
    shape = _create_shape(chain, layout)
    drives = create_drives(model.drives, layout.drives)
    for row, number in zip(drives.rows, layout.drives, strict=True):
        drive = model.drives[number]
        row["target"] = (layout.dofs + drive.mass) * layout.owned + drive.cell - layout.start
        row["inverse"] = 1 / chain.coefficients(drive.cell, drive.cell + 1).masses[0, drive.mass]

    laws, laws_of_springs = _spring_laws(chain, layout)
    couplings = _couplings(cell, layout, laws_of_springs)
    # Couplings are in the order of their masses: a mass has consecutive rows.
    rows = np.searchsorted(couplings["mass"], np.arange(layout.dofs + 1)).tolist()
    masses = [(1 / mass, *bounds) for mass, bounds in zip(cell.masses, pairwise(rows), strict=True)]
    inverse_masses, grounding, stiffness, damping = _coefficients(chain, layout)
    lattice = LatticeRecord(
        shape=shape,
        masses=np.array(masses, MASS),
        couplings=couplings,
        spring_ends=np.lexsort((-couplings["sign"], couplings["spring"])),
        site_dofs=create_site_dofs(model, layout),
        contacts=site_records(model, layout.acting_sites),
        drives=drives,
        spring_laws=laws,
        inverse_masses=inverse_masses,
        grounding=grounding,
        stiffness=stiffness,
        damping=damping,
        zeros=np.zeros(CHUNK),
    )
    return Record(lattice)


def empty_record() -> LatticeRecord:
    """Return a record of no cells."""
    none = np.zeros(0)
    return LatticeRecord(
        shape=Shape(**{name: kind() for name, kind in get_type_hints(Shape).items()}),
        masses=np.zeros(0, MASS),
        couplings=np.zeros(0, COUPLING),
        spring_ends=np.zeros(0, np.int64),
        site_dofs=np.zeros(0, SITE_DOFS),
        contacts=np.zeros(0, SITE),
        drives=Drives(np.zeros(0, DRIVE), np.zeros(0, PIECE)),
        spring_laws=np.zeros(0, SPRING_LAW),
        inverse_masses=none,
        grounding=none,
        stiffness=none,
        damping=none,
        zeros=none,
    )


LATTICE = record_type(empty_record())
"""The type of all lattices in compiled code, which PETSc's callbacks must know before there is a lattice."""


def _create_shape(chain: Chain, layout: Layout) -> Shape:
    """Return sizes and indices of the part of ``chain`` that ``layout`` gives to this rank."""
    damping = -1
    if layout.integrates_damping:
        damping = 2 * layout.dofs * layout.owned

    return Shape(
        cells=layout.owned,
        dofs=layout.dofs,
        paired=chain.has_own_pairs,
        owned=layout.size,
        ghosted=layout.size + layout.ghost_rows * len(layout.ghosts),
        exchange=layout.comm.size > 1 or layout.topology.is_ring,
        work=layout.per_cell * layout.owned,
        dissipated=layout.dissipated,
        damping=damping,
    )


def _spring_laws(chain: Chain, layout: Layout) -> tuple[np.ndarray, dict[int, tuple[int, int]]]:
    """Return nonlinear parts of the rank's springs; by the number of each such spring its law and stride."""
    if chain.is_linear:
        return np.zeros(0, SPRING_LAW), {}
    # One law of each spring where cells have equal ones; else one for each cell, from that before the first one on.
    table = np.stack(chain.spring_terms(layout.start - 1, layout.stop), axis=-1)
    if np.array_equal(table, np.broadcast_to(table[:1], table.shape)):
        table = table[:1]
    numbers = np.flatnonzero(table.any(axis=(0, 2))).tolist()
    per_spring = len(table)
    stride = int(per_spring > 1)

    laws = np.zeros(len(numbers) * per_spring, SPRING_LAW)
    for place, name in enumerate(SPRING_LAW.names or ()):
        laws[name] = table[:, numbers, place].T.ravel()
    return laws, {number: (row * per_spring + stride, stride) for row, number in enumerate(numbers)}


def _couplings(cell: UnitCell, layout: Layout, laws: dict[int, tuple[int, int]]) -> np.ndarray:
    """Return the couplings (coupling,) of dtype ``COUPLING`` of a ``cell``, whose springs have the ``laws``."""
    left_ghost, right_ghost = layout.ghost_places()
    couplings = cell.couplings()
    rows = np.zeros(len(couplings), COUPLING)
    for row, coupling in zip(rows, couplings, strict=True):
        for name in ("mass", "offset", "other", "spring", "sign", "stiffness"):
            row[name] = getattr(coupling, name)

        law, stride = laws.get(coupling.spring, (-1, 0))
        # The law of a spring from the cell before is stored with that cell.
        row["law"] = law + stride * min(coupling.offset, 0)
        row["stride"] = stride

        outside = right_ghost
        if coupling.offset < 0:
            outside = left_ghost
        if coupling.other == GROUND:
            outside = WALL
        row["outside_u"] = outside
        row["outside_v"] = outside
        if outside >= 0:
            row["outside_u"] += coupling.other
            row["outside_v"] += layout.dofs + coupling.other
    return rows


def _coefficients(chain: Chain, layout: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the last four arrays of ``LatticeRecord`` of a rank's cells."""
    if chain.linearised().is_uniform() and not layout.damped:
        none = np.zeros(0)
        return none, none, none, none

    masses, grounding, stiffness, damping = chain.coefficients(layout.start - 1, layout.stop)
    # Springs are those from the cell before the first one on, which reach into it; masses begin with the first one.
    inverse_masses = (1 / masses[1:]).T.flatten()
    if not layout.damped:
        none = np.zeros(0)
        return inverse_masses, none, stiffness.T.flatten(), none
    return inverse_masses, grounding[1:].T.flatten(), stiffness.T.flatten(), damping.T.flatten()
