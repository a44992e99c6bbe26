"""Rates of dashpots in free motion, as rows of the lattice's state: what the losses in a step are made of.

A dashpot between two masses dissipates c e'^2, e' the difference of their velocities, one to ground c v^2. With
dashpots (sec. 7 of the derivation in the package's docstring) free motion has the velocities

    v(s) = sum_k s^k/k! (P_(k+1) u_0/H + Q_(k+1) v_0),

so that c^1/2 e' is a polynomial in s whose coefficients are rows of the state at the step's beginning. ``DashpotRows``
gives them for all dashpots of a cell. They come from the matrices of the lattice and not from its energies: a loss that
is computed by them (sec. 10) closes the energy balance only if the lattice moves as it should.
"""

from functools import lru_cache
from math import factorial

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.dynamics.propagator.rows import local_recursion, power_rows
from vipetsc.dynamics.propagator.series import StepSeries

# Kinds whose rows are computed together. Where no two cells are alike, the built-in run of 300 cells takes a sixth more
# CPU time with 8 than with 32, and the same with 128.
BATCH = 32
# Kind of a cell whose springs have no dashpots and whose masses have none to ground.
NO_DASHPOTS = -1


class DashpotRows:
    """Rows of the dashpots of each cell of a damped lattice, of the springs that begin in it and of its masses.

    Cells with equal dashpots and equal surroundings are of one *kind*; ``interior`` is that of a cell far from ends and
    from cells that differ. A kind's rows span the cells from ``reach`` before the cell to ``reach`` after the next
    one, ``width`` of them.
    """

    def __init__(self, series: StepSeries) -> None:
        self.series = series
        self.chain = series.chain
        self.width = 2 * series.reach + 2
        self._examples: list[int] = []
        self._numbers: dict[object, int] = {}
        self.interior = NO_DASHPOTS
        # Tables ask for the rows of neighbouring cells, whose kinds have near numbers.
        self._batch = lru_cache(maxsize=4 + 2 * self.width // BATCH)(self._compute_batch)

    def kinds(self, cells: ArrayLike) -> np.ndarray:
        """The kind (cell,) of each of ``cells``, ``NO_DASHPOTS`` of one without or beyond the ends.

        On a ring cells may be counted beyond its joint; the spring to a wall on the left is that of cell -1.
        """
        chain = self.chain
        cells = np.asarray(cells, np.int64)
        if chain.ends == "periodic":
            cells = cells % chain.cells
            next_cells = (cells + 1) % chain.cells
            exists = np.ones(len(cells), bool)
        else:
            next_cells = cells + 1
            exists = (cells >= -(chain.ends == "fixed")) & (cells < chain.cells)

        is_inner = (cells >= 0) & (next_cells >= 0) & (cells < chain.cells) & (next_cells < chain.cells)
        inner = cells[is_inner]
        is_inner[is_inner] = self.series.is_interior(inner) & self.series.is_interior(next_cells[is_inner])

        kinds = np.full(len(cells), NO_DASHPOTS)
        if is_inner.any() and chain.cell.is_damped:
            self.interior = self._number("interior", int(cells[is_inner][0]))
            kinds[is_inner] = self.interior
        for i in np.flatnonzero(exists & ~is_inner).tolist():
            kinds[i] = self._kind_of(int(cells[i]))
        return kinds

    def _kind_of(self, cell: int) -> int:
        """The kind of a ``cell`` that is not an interior one."""
        chain = self.chain
        coefficients = chain.coefficients(cell, cell + 1)
        if not (coefficients.damping.any() or coefficients.grounding.any()):
            return NO_DASHPOTS

        # Rows near an end are like no others; elsewhere equal coefficients make equal rows.
        near = self.series.reach + 1
        if chain.ends != "periodic" and (cell < near or cell + 1 + near >= chain.cells):
            return self._number(cell, cell)
        neighbourhood = chain.coefficients(cell - near, cell + 1 + near + 1)
        return self._number(b"".join(array.tobytes() for array in neighbourhood), cell)

    def _number(self, key: object, cell: int) -> int:
        """The number of the kind with this ``key``, of which ``cell`` is the first one seen."""
        if key not in self._numbers:
            self._numbers[key] = len(self._examples)
            self._examples.append(cell)
        return self._numbers[key]

    @property
    def rates(self) -> int:
        """How many rates a kind's rows have: the springs of a cell, then its masses."""
        return len(self.chain.cell.springs) + self.chain.cell.dofs

    @property
    def powers(self) -> int:
        """How many powers of s a velocity's series has."""
        return 2 * self.series.terms - 1

    def rows(self, kind: int) -> np.ndarray:
        """Rows (rate, power, 2 dof, cell) of c^1/2 e' in W^1/2: coefficients of s^k, from u in m and v in m/s.

        Rates whose dashpot does not exist are zero.
        """
        first = kind - kind % BATCH
        return self._batch(first, min(first + BATCH, len(self._examples)))[kind - first]

    def _compute_batch(self, first: int, stop: int) -> list[np.ndarray]:
        """The rows of the kinds from ``first`` to ``stop``."""
        examples = self._examples[first:stop]
        velocities = self._velocities([*examples, *(cell + 1 for cell in examples)])
        return [self._rates(cell, velocities[cell], velocities[cell + 1]) for cell in examples]

    def _rates(self, cell: int, here: np.ndarray | None, after: np.ndarray | None) -> np.ndarray:
        """The rows of the kind of ``cell``, from those of the velocities in it and in the next one, None of a wall."""
        chain = self.chain
        coefficients = chain.coefficients(cell, cell + 1)
        band = self.width - 1
        out = np.zeros((self.rates, self.powers, 2 * chain.cell.dofs, self.width))

        for row, spring, damping in zip(out, chain.cell.springs, coefficients.damping[0], strict=False):
            # A free end has no spring to the next cell, the wall on the left no other one.
            is_cut = spring.next_cell and chain.ends == "free" and after is None
            if is_cut or (here is None and not spring.next_cell):
                continue
            if here is not None:
                row[..., :band] -= np.sqrt(damping) * here[spring.start]
            if spring.next_cell and after is not None:
                row[..., 1:] += np.sqrt(damping) * after[spring.end]
            elif not spring.next_cell and here is not None:
                row[..., :band] += np.sqrt(damping) * here[spring.end]

        if here is not None:
            grounding = out[len(chain.cell.springs) :]
            grounding[..., :band] = np.sqrt(coefficients.grounding[0])[:, None, None, None] * here
        return out

    def _velocities(self, cells: list[int]) -> dict[int, np.ndarray | None]:
        """Rows (dof, power, 2 dof, cell) of the velocities of the masses of each of ``cells``; None of a wall."""
        series = self.series
        chain = self.chain
        d = chain.cell.dofs
        velocities: dict[int, np.ndarray | None] = dict.fromkeys(cells)
        existing = [cell for cell in velocities if chain.ends == "periodic" or 0 <= cell < chain.cells]
        at = np.array(existing, int) % chain.cells

        # Beyond the reach and a cell more a wall stands: it changes the rows by less than what they leave out. A cell
        # that no end is within reach of has the rows of an endless chain: any such cell may be the first of its kind.
        distances = np.arange(-series.reach - 2, series.reach + 3)
        neighbours = at[:, None] + distances
        is_inside = (neighbours >= 0) & (neighbours < chain.cells)
        is_endless = ~series.is_near_end(at)[:, None]
        exists = (is_inside | is_endless) & (np.abs(distances) < series.reach + 2)
        zeroth = np.zeros((len(at), d, d, len(distances)))
        zeroth[..., series.reach + 2] = np.eye(d)
        recursion = local_recursion(chain, series.interval, at, exists, series.reach + 1, float)
        rows = power_rows(zeroth, series.terms, recursion)[..., 2:-2]

        # A velocity's series is the derivative of its displacement's.
        factorials = np.array([factorial(k) for k in range(self.powers)], float)
        of_velocities = rows[:, :, 1:] / factorials[:, None, None]
        of_velocities[..., :d, :] /= series.interval
        velocities.update(zip(existing, of_velocities, strict=True))
        return velocities
