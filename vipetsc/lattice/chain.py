"""A finite lattice: its cells, its ends, its contact sites, its linear response."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, diags
from scipy.sparse.linalg import spsolve

from vipetsc.lattice.cell import UnitCell
from vipetsc.lattice.drive import Waveform
from vipetsc.lattice.variation import Coefficients, Variation

Ends = Literal["fixed", "free", "periodic"]

LONGEST = 400  # cells whose linear response is solved for


class Pair(NamedTuple):
    """What a contact joins: masses (0-based; host -1 is ground), ``resonator`` in the next cell if ``next_cell``."""

    host: int
    resonator: int
    next_cell: bool = False


@dataclass(frozen=True)
class Chain:
    """``cells`` unit cells in a row; contact ``sites`` are 0-based cells, ``clearances`` in m, one a site.

    ``ends``: ``fixed`` puts a wall at either end, held by the inter-cell springs; ``free`` cuts those
    springs; ``periodic`` joins the last cell to the first. ``pairs`` are what contacts join, the cell's pair if
    (). ``variation`` has what differs from ``cell``, which stands for the lattice in all that is said of its bands;
    raises ValueError if it is not of all cells.
    """

    cell: UnitCell
    cells: int
    ends: Ends = "fixed"
    sites: tuple[int, ...] = ()
    clearances: tuple[float, ...] = ()
    variation: Variation | None = None
    pairs: tuple[Pair, ...] = ()

    def __post_init__(self) -> None:
        for name, array in self.variation.items() if self.variation else ():
            if array.shape != (shape := (self.cells, len(getattr(self._reference, name)))):
                raise ValueError(f"variation of {name}: shape {array.shape}, not {shape}")

    @cached_property
    def differs(self) -> np.ndarray:
        """Whether each cell (cells,) has a mass, a spring or a dashpot other than the reference cell's."""
        differs = np.zeros(self.cells, bool)
        for name, array in self.variation.items() if self.variation else ():
            differs |= np.any(array != getattr(self._reference, name), axis=1)
        return differs

    @property
    def is_damped(self) -> bool:
        """Whether there is a dashpot anywhere."""
        varied = [a for n, a in self.variation.items() if n in ("grounding", "damping")] if self.variation else []
        return self.cell.is_damped or any(array.any() for array in varied)

    @property
    def contact_pairs(self) -> tuple[Pair, ...]:
        """The pair of each site: those of ``pairs``, or the cell's."""
        return self.pairs or (Pair(self.cell.host, self.cell.resonator),) * len(self.sites)

    @property
    def is_joined(self) -> bool:
        """Whether contacts join cells."""
        return any(pair.next_cell for pair in self.pairs)

    def reduced_masses(self) -> list[float]:
        """Mass in kg of each site's relative motion."""
        varied = self.variation.masses if self.variation else None
        inverse = 1 / (np.array([self.cell.masses]) if varied is None else varied)
        host, resonator, joins = np.array(self.contact_pairs, np.int64).reshape(-1, 3).T
        sites = np.array(self.sites, np.int64)
        of_host = np.where(host >= 0, inverse[sites % len(inverse), host], 0.0)
        return np.asarray(1 / (of_host + inverse[(sites + joins) % len(inverse), resonator])).tolist()

    def is_uniform(self, start: int = 0, stop: int | None = None) -> bool:
        """Whether no cell from ``start`` to ``stop`` differs from the reference cell; of a ring they count on."""
        if self.variation is None:
            return True
        cells = np.arange(start, self.cells if stop is None else stop)
        return not self.differs[cells[self._exist(cells)] % self.cells].any()

    def _exist(self, cells: np.ndarray) -> np.ndarray:
        """Which of ``cells`` there are; of a ring all, counted on beyond its ends."""
        return (cells >= 0) & (cells < self.cells) | (self.ends == "periodic")

    @property
    def _reference(self) -> Coefficients:
        cell = self.cell
        of_springs = np.array([(s.stiffness, s.damping) for s in cell.springs]).reshape(-1, 2).T
        return Coefficients(np.array(cell.masses), np.array(cell.grounding or np.zeros(cell.dofs)), *of_springs)

    def coefficients(self, start: int, stop: int) -> Coefficients:
        """Masses, springs and dashpots of the cells ``start`` to ``stop``.

        Cells beyond the ends are those of the ring, or as the reference cell: the spring to a wall on the left
        belongs to cell -1.
        """
        cells = np.arange(start, stop)
        exists = self._exist(cells)
        arrays = [np.tile(reference, (len(cells), 1)) for reference in self._reference]
        for array, name in zip(arrays, Coefficients._fields, strict=True):
            if self.variation and (varied := getattr(self.variation, name)) is not None:
                array[exists] = varied[cells[exists] % self.cells]
        return Coefficients(*arrays)

    def mean_cell(self, start: int, stop: int) -> UnitCell:
        """The reference cell with the mean masses, springs and dashpots of the cells ``start`` to ``stop``."""
        if self.is_uniform(start, stop):
            return self.cell
        masses, grounding, *of_springs = (values.mean(axis=0).tolist() for values in self.coefficients(start, stop))
        rows = zip(self.cell.springs, *of_springs, strict=True)
        springs = tuple(replace(spring, stiffness=k, damping=c) for spring, k, c in rows)
        return replace(self.cell, masses=tuple(masses), springs=springs, grounding=tuple(grounding))

    def stiffness_matrix(self) -> csc_matrix:
        """Sparse stiffness (cells dofs, cells dofs) in N/m, ordered cell by cell; needs little for <= 1e6."""
        return self.stiffness_rows(0, self.cells).tocsc()

    def stiffness_rows(self, start: int, stop: int) -> csr_matrix:
        """The rows ((stop - start) dofs, cells dofs) of the stiffness in N/m of cells ``start`` to ``stop``."""
        return self._rows(start, stop, self.coefficients(start - 1, stop).stiffness)

    def damping_rows(self, start: int, stop: int) -> csr_matrix:
        """The same rows of the damping in N s/m."""
        of_cells = self.coefficients(start - 1, stop)
        shape = (stop - start) * self.cell.dofs, self.cells * self.cell.dofs
        ground = diags([of_cells.grounding[1:].ravel()], [start * self.cell.dofs], shape)
        return (self._rows(start, stop, of_cells.damping) + ground).tocsr()

    def _rows(self, start: int, stop: int, values: np.ndarray) -> csr_matrix:
        """Rows made of ``values`` (cell, spring) of the cells from ``start`` - 1 on."""
        n, d = self.cells, self.cell.dofs
        rows, columns, entries = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
        index, every = np.arange(start, stop, dtype=np.int64), np.ones(stop - start, bool)
        for mass, offset, other, _, _, spring in self.cell.couplings():
            neighbour = index + offset
            inside = every if self.ends == "periodic" else (neighbour >= 0) & (neighbour < n)
            held = every if self.ends == "fixed" else inside
            here = index * d + mass
            rows += [here[held] - start * d, here[inside] - start * d]
            columns += [here[held], neighbour[inside] % n * d + other]
            value = values[1 + min(offset, 0) :][: stop - start, spring]
            entries += [value[held], -value[inside]]
        of_springs = np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))
        return coo_matrix(of_springs, shape=((stop - start) * d, n * d)).tocsr()

    def masses(self) -> np.ndarray:
        """Masses (cells dofs,) in kg, ordered cell by cell."""
        return self.coefficients(0, self.cells).masses.ravel()

    def wave_scale(self, drive: Waveform, cell: int = 0, mass: int = 0) -> float:
        """Displacement amplitude in m of the linear wave that ``drive`` makes; velocity is Om times that.

        The largest steady response to the burst's peak force at the complex frequency Om (1 - i/Nc), whose
        imaginary part stands for the finite burst. Scales exactly with the drive's amplitude. A lattice
        longer than LONGEST cells is cut there: the wave is evanescent at that frequency.
        """
        cut = Chain(self.cell, min(self.cells, LONGEST), self.ends)
        driven = cell if cell < cut.cells // 2 else max(cut.cells - (self.cells - cell), 0)
        omega = drive.frequency * (1 - 1j / drive.cycles)
        dynamic = cut.stiffness_matrix() - diags(cut.masses() * omega**2)
        force = np.zeros(cut.cells * self.cell.dofs, complex)
        force[driven * self.cell.dofs + mass] = 1.0
        response = float(np.abs(spsolve(dynamic.tocsc(), force)).max())
        return response * drive.peak


def cells_between(cell: ArrayLike, other: int, cells: int, ends: Ends) -> np.ndarray:
    """Number of cells from ``cell`` to ``other`` in a lattice of ``cells``; the shorter way around a ring."""
    way = np.abs(np.asarray(cell, np.int64) - other)
    return np.asarray(np.minimum(way, cells - way) if ends == "periodic" else way)
