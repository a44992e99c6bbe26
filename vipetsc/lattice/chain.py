"""A finite lattice: its cells, its ends, its contact sites, its linear response."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import scipy
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, diags

from vipetsc.lattice.cell import GROUND, Spring, UnitCell
from vipetsc.lattice.drive import Waveform
from vipetsc.lattice.sites import NO_SITES, Sites
from vipetsc.lattice.topology import NOTHING, WALL, Ends, Topology
from vipetsc.lattice.variation import Coefficients, SpringTerms, Variation

# Cells at most whose linear response is solved for, in 2 ms. With 200 or 800 in its place the scale of waves changes by
# 5e-4 and 2.5e-4 for a burst whose frequency is almost 0, and by 1e-13 to 1e-4 for others.
LONGEST = 400
# Where springs are negative, stability is looked at: at so many wavenumbers; with free ends in so many cells.
WAVENUMBERS = 65
FEW = 8
# An eigenvalue may be below zero by so many times the largest one, by rounding. A beam of 20 elements has -1e-14.
ROUNDING = 1e-10


@dataclass(frozen=True)
class Chain:
    """``cells`` unit cells in a row, with contact ``sites``.

    ``ends``: ``fixed`` puts a wall at either end, held by the inter-cell springs; ``free`` cuts those springs;
    ``periodic`` joins the last cell to the first. ``variation`` holds what differs from ``cell``; bands are those of
    ``cell`` alone. Raises ValueError if an array of ``variation`` has not one row for each cell.
    """

    cell: UnitCell
    cells: int
    ends: Ends = "fixed"
    sites: Sites = NO_SITES
    variation: Variation | None = None

    def __post_init__(self) -> None:
        # NumPy would spread the row of one cell over all of them without a word.
        for name, array in self._varied.items():
            shape = (self.cells, len(self._reference[name]))
            if array.shape != shape:
                raise ValueError(f"variation of {name}: shape {array.shape}, not {shape}")

    @property
    def topology(self) -> Topology:
        """How its cells follow each other."""
        return Topology(self.cells, self.ends)

    @property
    def _varied(self) -> dict[str, np.ndarray]:
        """The arrays of ``variation`` by name; empty for a lattice of equal cells."""
        return dict(self.variation.items()) if self.variation else {}

    @cached_property
    def differs(self) -> np.ndarray:
        """Whether each cell (cells,) has a mass, a spring or a dashpot other than the reference cell's."""
        differs = np.zeros(self.cells, bool)
        for name, array in self._varied.items():
            differs |= np.any(array != self._reference[name], axis=1)
        return differs

    @property
    def is_damped(self) -> bool:
        """Whether there is a dashpot anywhere."""
        dashpots = [array for name, array in self._varied.items() if name in ("grounding", "damping")]
        return self.cell.is_damped or any(array.any() for array in dashpots)

    @cached_property
    def is_linear(self) -> bool:
        """Whether no spring has a quadratic or a cubic part."""
        arrays = [self._varied.get(name, self._reference[name]) for name in SpringTerms._fields]
        return not any(array.any() for array in arrays) and all(spring.is_linear for spring in self._left_wall_springs)

    @property
    def is_odd(self) -> bool:
        """Whether the force of every spring at the elongation -z is minus that at z."""
        quadratic = self._varied.get("quadratic", self._reference["quadratic"])
        return not quadratic.any() and all(spring.is_odd for spring in self._left_wall_springs)

    @property
    def _left_wall_springs(self) -> list[Spring]:
        """The springs to a wall on the left: those of the reference cell, since no cell's ``variation`` has them."""
        return [spring for spring in self.cell.springs if spring.offset and self.topology.neighbour(-1) == WALL]

    def linearised(self) -> "Chain":
        """Return the lattice with the linear parts of its springs alone; itself if there is nothing else."""
        remaining = {name: array for name, array in self._varied.items() if name not in SpringTerms._fields}
        if self.cell.is_linear and len(remaining) == len(self._varied):
            return self
        springs = tuple(replace(spring, quadratic=0.0, cubic=0.0) for spring in self.cell.springs)
        cell = replace(self.cell, springs=springs)
        return replace(self, cell=cell, variation=Variation(**remaining) if remaining else None)

    def without_dashpots(self) -> "Chain":
        """Return the lattice with all dashpots left out; itself if it has none."""
        if not self.is_damped:
            return self
        springs = tuple(replace(spring, damping=0.0) for spring in self.cell.springs)
        remaining = {name: array for name, array in self._varied.items() if name not in ("grounding", "damping")}
        cell = replace(self.cell, springs=springs, grounding=())
        return replace(self, cell=cell, variation=Variation(**remaining) if remaining else None)

    @property
    def has_own_pairs(self) -> bool:
        """Whether a contact joins other masses than its cell's pair, or two contacts are in one cell."""
        table = self.sites.table
        differs = (
            (table["host"] != self.cell.host) | (table["resonator"] != self.cell.resonator) | (table["offset"] > 0)
        )
        return bool(differs.any()) or len(np.unique(table["cell"])) < len(table)

    def resonator_cells(self, topology: Topology | None = None) -> np.ndarray:
        """Return the cell (site,) of each site's resonator; cells follow each other as in ``topology``.

        Raises ValueError where it would lie beyond an end.
        """
        topology = topology or self.topology
        sites = self.sites.table
        if not len(sites):
            return np.zeros(0, np.int64)
        cells = topology.neighbour(sites["cell"], sites["offset"])
        if topology.ends is not None and cells.min() < 0:
            number = int(cells.argmin())
            raise ValueError(f"site {number + 1} in cell {sites['cell'][number] + 1} has no next cell to touch")
        return cells

    def reduced_masses(self) -> list[float]:
        """Return the mass (site,) in kg of the relative motion of each site."""
        # One row for all cells where they are equal, so that a long lattice costs no more than its sites.
        inverse = 1 / self._varied.get("masses", np.array([self.cell.masses]))
        rows = len(inverse)
        sites = self.sites.table
        inverse_host = np.where(sites["host"] >= 0, inverse[sites["cell"] % rows, sites["host"]], 0.0)
        inverse_resonator = inverse[self.resonator_cells() % rows, sites["resonator"]]
        return list((1 / (inverse_host + inverse_resonator)).tolist())

    def impact_times(self, speed: float) -> list[float]:
        """Return the durations in s of impacts at a ``speed`` in m/s, one for each kind of site whose stops yield."""
        # A set, since sites of one kind have one duration, and each takes a quadrature.
        kinds = {(site.law, mass) for site, mass in zip(self.sites, self.reduced_masses(), strict=True)}
        return [law.impact_time(speed, mass) for law, mass in kinds if not law.is_rigid]

    def is_uniform(self, start: int = 0, stop: int | None = None) -> bool:
        """Return whether no cell from ``start`` to ``stop`` differs from the reference cell.

        On a ring the numbers go on beyond the last cell, and then stand for the first cells again.
        """
        if self.variation is None:
            return True
        cells = self.topology.neighbour(np.arange(start, self.cells if stop is None else stop))
        return not self.differs[cells[cells >= 0]].any()

    @cached_property
    def _reference(self) -> dict[str, np.ndarray]:
        """Arrays (dof,) or (spring,) of the reference cell, by the names in ``Coefficients`` and ``SpringTerms``."""
        cell = self.cell
        reference = {"masses": np.array(cell.masses), "grounding": np.array(cell.grounding or np.zeros(cell.dofs))}
        for name in ("stiffness", "damping", "quadratic", "cubic"):
            reference[name] = np.array([getattr(spring, name) for spring in cell.springs], float)
        return reference

    def coefficients(self, start: int, stop: int) -> Coefficients:
        """Return masses, springs and dashpots of the cells ``start`` to ``stop``.

        On a ring, numbers beyond the ends stand for the cells at the other end. In other lattices the cells beyond the
        ends are as the reference cell: the spring to a wall on the left belongs to cell -1.
        """
        return Coefficients(*self._arrays(Coefficients._fields, start, stop))

    def spring_terms(self, start: int, stop: int) -> SpringTerms:
        """Return quadratic and cubic parts of springs of cells ``start`` to ``stop``, as by ``coefficients``."""
        return SpringTerms(*self._arrays(SpringTerms._fields, start, stop))

    def _arrays(self, names: tuple[str, ...], start: int, stop: int) -> list[np.ndarray]:
        """Return the arrays of these ``names`` of the cells ``start`` to ``stop``."""
        cells = self.topology.neighbour(np.arange(start, stop))
        exists = cells >= 0
        arrays = []
        for name in names:
            array = np.tile(self._reference[name], (len(cells), 1))
            if name in self._varied:
                array[exists] = self._varied[name][cells[exists]]
            arrays.append(array)
        return arrays

    def spring(self, cell: int, number: int) -> Spring:
        """Return the spring of that ``number`` (from 0) that begins in a ``cell``, -1 in a wall on the left."""
        linear = self.coefficients(cell, cell + 1)
        terms = self.spring_terms(cell, cell + 1)
        return replace(
            self.cell.springs[number],
            stiffness=float(linear.stiffness[0, number]),
            damping=float(linear.damping[0, number]),
            quadratic=float(terms.quadratic[0, number]),
            cubic=float(terms.cubic[0, number]),
        )

    def mean_cell(self, start: int, stop: int) -> UnitCell:
        """Return the reference cell with the mean masses, springs and dashpots of the cells ``start`` to ``stop``."""
        # Means of equal numbers are rounded: equal cells keep the reference cell, and what is cached for it.
        if self.linearised().is_uniform(start, stop):
            return self.cell
        means = [values.mean(axis=0).tolist() for values in self.coefficients(start, stop)]
        mean = Coefficients(*means)
        rows = zip(self.cell.springs, mean.stiffness, mean.damping, strict=True)
        springs = tuple(replace(spring, stiffness=k, damping=c) for spring, k, c in rows)
        return replace(self.cell, masses=tuple(mean.masses), springs=springs, grounding=tuple(mean.grounding))

    def stiffness_matrix(self) -> csc_matrix:
        """Return sparse stiffness (cells dofs, cells dofs) in N/m, ordered cell by cell; memory grows as the cells."""
        return self.stiffness_rows(0, self.cells).tocsc()

    def stiffness_rows(self, start: int, stop: int) -> csr_matrix:
        """Return the rows ((stop - start) dofs, cells dofs) of the stiffness in N/m of cells ``start`` to ``stop``."""
        return self._rows(start, stop, self.coefficients(start - 1, stop).stiffness)

    def damping_rows(self, start: int, stop: int) -> csr_matrix:
        """Return the rows ((stop - start) dofs, cells dofs) of the damping in N s/m of cells ``start`` to ``stop``."""
        d = self.cell.dofs
        coefficients = self.coefficients(start - 1, stop)
        ground = diags([coefficients.grounding[1:].ravel()], [start * d], ((stop - start) * d, self.cells * d))
        return (self._rows(start, stop, coefficients.damping) + ground).tocsr()

    def _rows(self, start: int, stop: int, values: np.ndarray) -> csr_matrix:
        """Return rows of a matrix of springs between masses, from ``values`` (cell, spring) of ``start`` - 1 on.

        A spring to the next cell belongs to the cell in which it begins, hence the cell before ``start``.
        """
        d = self.cell.dofs
        rows = [np.zeros(0, np.int64)]
        columns = [np.zeros(0, np.int64)]
        entries = [np.zeros(0)]
        index = np.arange(start, stop, dtype=np.int64)
        for coupling in self.cell.couplings():
            # The cell in which the spring begins, as a row of ``values``: this one's is 1.
            owner = 1 + min(coupling.offset, 0)
            value = values[owner : owner + stop - start, coupling.spring]
            here = index * d + coupling.mass
            if coupling.other == GROUND:
                rows.append(here - start * d)
                columns.append(here)
                entries.append(value)
                continue

            neighbour = self.topology.neighbour(index, coupling.offset)
            inside = neighbour >= 0
            held = neighbour != NOTHING  # a wall holds, and does not move
            rows += [here[held] - start * d, here[inside] - start * d]
            columns += [here[held], neighbour[inside] * d + coupling.other]
            entries += [value[held], -value[inside]]

        places = np.concatenate(rows), np.concatenate(columns)
        shape = ((stop - start) * d, self.cells * d)
        return coo_matrix((np.concatenate(entries), places), shape=shape).tocsr()

    def masses(self) -> np.ndarray:
        """Return masses (cells dofs,) in kg of all cells, in their order."""
        return self.coefficients(0, self.cells).masses.ravel()

    def wave_scale(self, drive: Waveform, cell: int = 0, mass: int = 0) -> float:
        """Return the amplitude in m of the linear wave that ``drive`` makes on a ``mass`` of a ``cell`` (0-based).

        With the drive's main frequency Om and its Nc cycles it is the largest steady response to the peak force at the
        complex frequency Om (1 - i/Nc), whose imaginary part stands for the finite burst; Om times that is the scale of
        velocities. It scales exactly with the drive's amplitude. A lattice of more than ``LONGEST`` cells is cut to so
        many: at a complex frequency waves decay before they reach the cut.
        """
        cells = min(self.cells, LONGEST)
        # As far from the nearer end as in the whole lattice, or in the middle if both ends are farther away than that.
        middle = cells // 2
        driven = min(cell, middle)
        to_right_end = self.cells - cell
        if to_right_end <= cells - middle:
            driven = cells - to_right_end

        # A burst of Nc cycles has a spectrum of about Om/Nc in width: a response with a decay as fast has its
        # sharpness.
        omega = drive.frequency * (1 - 1j / drive.cycles)
        return _largest_response(self.cell, cells, self.ends, driven * self.cell.dofs + mass, omega) * drive.peak


# Kept, since most cases of a sweep or a fit differ in their contacts or in the drive's amplitude alone.
@lru_cache(maxsize=64)
def _largest_response(cell: UnitCell, cells: int, ends: Ends, driven: int, omega: complex) -> float:
    """Return the largest displacement in m of equal cells under 1 N at the complex frequency ``omega`` in rad/s.

    The force acts on the mass of the number ``driven``, from 0, cell by cell.
    """
    chain = Chain(cell, cells, ends)
    dynamic = chain.stiffness_matrix() - diags(chain.masses() * omega**2)
    force = np.zeros(cells * cell.dofs, complex)
    force[driven] = 1.0
    # Eliminated column by column in SciPy's own order, a ring loses all digits: waves grow as they run along it.
    order = "MMD_AT_PLUS_A" if chain.topology.is_ring else "COLAMD"
    return float(np.abs(scipy.sparse.linalg.spsolve(dynamic.tocsc(), force, permc_spec=order)).max())


@lru_cache(maxsize=64)
def unstable_key(cell: UnitCell, ends: Ends, cells: int) -> str | None:
    """Return key of the first negative spring or dashpot of a ``cell`` that others do not outweigh; None if they do.

    With walls and on a ring the motions are sums of Bloch waves, whose energy, by K(kappa), and loss, by C(kappa), must
    not be negative. A free end has motions of its own, near it: a lattice of a few cells has them.
    """
    springs = list(enumerate(cell.springs, 1))
    stiffness = {f"springs[{i}].stiffness": spring.stiffness for i, spring in springs}
    damping = {f"springs[{i}].damping": spring.damping for i, spring in springs}
    damping |= {f"grounding[{i}]": value for i, value in enumerate(cell.grounding, 1)}
    free = Chain(cell, min(cells, FEW), "free")
    n = free.cells

    for values, waves, rows in (
        (stiffness, cell.stiffness_matrix, free.stiffness_rows),
        (damping, cell.damping_matrix, free.damping_rows),
    ):
        negative = [key for key, value in values.items() if value < 0]
        if not negative:
            continue
        matrices = waves(np.linspace(0, np.pi, WAVENUMBERS))
        if ends == "free":
            matrices = rows(0, n).toarray()
        root = 1 / np.sqrt(np.tile(cell.masses, matrices.shape[-1] // cell.dofs))
        squared = np.linalg.eigvalsh(matrices * (root[:, None] * root))
        if squared.min() < -ROUNDING * squared.max():
            return negative[0]
    return None
