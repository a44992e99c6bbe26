"""Motion of named points at every sample: displacement, velocity, and acceleration from the equation of motion.

The rank that owns a cell samples its masses; the acceleration of a point follows on rank 0 from the motion of its own
cell and of the cells next to it, from the drives and from the forces of the contacts that act on it,

    m a = sum over springs of k (u_other - u) + dashpots + drives + contacts,

summed in one order, so that the number of ranks does not show in the bits.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.case.points import PointTable
from vipetsc.dynamics.drives import create_drives, drive_forces
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.site_dofs import site_records
from vipetsc.lattice import Chain, Spring
from vipetsc.lattice.cell import GROUND
from vipetsc.lattice.chain import Pair


class _SpringAtPoint(NamedTuple):
    """A spring at a point: column and mass of its other end (column -1: a wall or the ground), N/m, N s/m, the spring.

    ``direction`` is 1 where the point is the spring's start, -1 where it is its end.
    """

    column: int
    mass: int
    stiffness: float
    damping: float
    spring: Spring
    direction: int


class _ForceAtPoint(NamedTuple):
    """A contact at a point: the column of its site; 1 on the host, -1 on the resonator; static force in N."""

    column: int
    direction: int
    preload: float


class _PointTerms(NamedTuple):
    """Terms of a point's equation of motion: its column and mass (0-based) among sampled cells, kg, N s/m, forces."""

    column: int
    mass: int
    inertia: float
    grounding: float
    springs: list[_SpringAtPoint]
    contacts: list[_ForceAtPoint]
    drives: list[int]


class PointMotion:
    """The motion of ``points`` in the lattice of ``model``.

    ``cells`` (cell,) are those, 0-based, whose masses must be sampled, ``sites`` (site,) the numbers of the sites whose
    forces must be; ``own_cells`` are the places of this rank's among its owned cells.
    """

    def __init__(self, points: list[PointTable], model: Model, layout: Layout) -> None:
        chain = model.chain
        places = [(point.cell - 1, point.mass - 1) for point in points]
        reach = {cell + offset for cell, _ in places for offset in (-1, 0, 1)}
        if chain.ends == "periodic":
            reach = {cell % chain.cells for cell in reach}
        self.cells = np.array(sorted(cell for cell in reach if 0 <= cell < chain.cells), np.int64)
        self.sites = np.array(_sites_at(chain, places), np.int64)

        owned = (self.cells >= layout.start) & (self.cells < layout.stop)
        self.own_cells = self.cells[owned] - layout.start
        self._comm = layout.comm
        # Columns of this rank's sites among those that it owns.
        self._own_sites = np.flatnonzero(np.isin(layout.sites, self.sites))
        self._own_numbers = np.array(layout.sites, np.int64)[self._own_sites]

        preloads = site_records(model, self.sites)["preload"]
        self._drives = create_drives(model.drives, range(len(model.drives)))
        self._terms = [self._terms_of(cell, mass, model, preloads) for cell, mass in places]

    def _terms_of(self, cell: int, mass: int, model: Model, preloads: np.ndarray) -> _PointTerms:
        """The terms of the equation of motion of a ``mass`` of a ``cell``, both 0-based."""
        chain = model.chain
        coefficients = chain.coefficients(cell - 1, cell + 1)
        springs = []
        for coupling in chain.cell.couplings():
            if coupling.mass != mass:
                continue
            other = cell + coupling.offset
            if chain.ends == "periodic":
                other %= chain.cells
            is_inside = 0 <= other < chain.cells
            if chain.ends == "free" and not is_inside:
                continue
            column = -1
            if is_inside and coupling.other != GROUND:
                column = int(np.searchsorted(self.cells, other))

            # A spring between cells belongs to the left one.
            owner = 1 + min(coupling.offset, 0)
            spring = chain.spring(cell - 1 + owner, coupling.spring)
            direction = -1
            if coupling.offset > 0 or (coupling.offset == 0 and spring.start == mass):
                direction = 1
            springs.append(
                _SpringAtPoint(
                    column=column,
                    mass=coupling.other,
                    stiffness=spring.stiffness,
                    damping=spring.damping,
                    spring=spring,
                    direction=direction,
                )
            )

        contacts = []
        pairs = chain.contact_pairs
        for column, number in enumerate(self.sites.tolist()):
            for direction, place in _ends_of(chain, number, pairs[number]):
                if place == (cell, mass):
                    force = _ForceAtPoint(column=column, direction=direction, preload=float(preloads[column]))
                    contacts.append(force)
        return _PointTerms(
            column=int(np.searchsorted(self.cells, cell)),
            mass=mass,
            inertia=float(coefficients.masses[1, mass]),
            grounding=float(coefficients.grounding[1, mass]),
            springs=springs,
            contacts=contacts,
            drives=[i for i, drive in enumerate(model.drives) if (drive.cell, drive.mass) == (cell, mass)],
        )

    def gather(self, times: np.ndarray, motion: np.ndarray, forces: np.ndarray) -> dict[str, np.ndarray]:
        """Displacement, velocity and acceleration (t, point) by name, on rank 0; none elsewhere. Collective.

        ``motion`` (t, 2 dof, own cell) are displacements before velocities, ``forces`` (t, own site) in N.
        """
        parts = self._comm.gather((motion, self._own_numbers, forces[:, self._own_sites]))
        if parts is None:
            return {}
        # Ranks own cells in the order of their numbers, but sites are numbered in any order.
        motions, numbers, own_forces = zip(*parts, strict=True)
        order = np.argsort(np.concatenate(numbers))
        every_motion = np.concatenate(motions, axis=2)
        return self._histories(times, every_motion, np.concatenate(own_forces, axis=1)[:, order])

    def _histories(self, times: np.ndarray, motion: np.ndarray, forces: np.ndarray) -> dict[str, np.ndarray]:
        """The histories by name from the ``motion`` of all ``cells`` and the ``forces`` of all ``sites``."""
        dofs = motion.shape[1] // 2
        shape = len(times), len(self._terms)
        displacement, velocity, acceleration = np.zeros((3, *shape))
        drives = drive_forces(self._drives, times)
        at_wall = np.zeros(len(times))
        for point, terms in enumerate(self._terms):
            u = motion[:, terms.mass, terms.column]
            v = motion[:, dofs + terms.mass, terms.column]
            displacement[:, point] = u
            velocity[:, point] = v

            total = -terms.grounding * v
            for at in terms.springs:
                other_u = other_v = at_wall
                if at.column >= 0:
                    other_u = motion[:, at.mass, at.column]
                    other_v = motion[:, dofs + at.mass, at.column]
                total += at.stiffness * (other_u - u)
                if at.damping:
                    total += at.damping * (other_v - v)
                if not at.spring.is_linear:
                    total += at.direction * at.spring.nonlinear_force(at.direction * (other_u - u))
            for contact in terms.contacts:
                total += contact.direction * (forces[:, contact.column] - contact.preload)
            for i in terms.drives:
                total += drives[i]
            acceleration[:, point] = total / terms.inertia
        return {"points/displacement": displacement, "points/velocity": velocity, "points/acceleration": acceleration}


def _ends_of(chain: Chain, site: int, pair: Pair) -> list[tuple[int, tuple[int, int]]]:
    """The masses that the contact of a ``site`` acts on, as (cell, mass): 1 and the host, -1 and the resonator."""
    cell = chain.sites[site]
    ends = [(-1, ((cell + pair.offset) % chain.cells, pair.resonator))]
    if pair.host >= 0:
        ends.append((1, (cell, pair.host)))
    return ends


def _sites_at(chain: Chain, places: list[tuple[int, int]]) -> list[int]:
    """Numbers of the sites whose contacts act on a mass among ``places``, each a (cell, mass)."""
    at = set(places)
    sites = []
    for site, pair in enumerate(chain.contact_pairs):
        if any(place in at for _, place in _ends_of(chain, site, pair)):
            sites.append(site)
    return sites
