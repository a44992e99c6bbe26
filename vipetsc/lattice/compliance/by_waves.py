r"""Compliance between contact pairs: relative displacements per harmonic force in a lattice of any length.

With b_i = 1 at the resonator and -1 at the host of pair i it is G_ij = b_i^T (K - omega^2 M)^-1 b_j in m/N, here of
equal cells without dashpots. Of the Bloch waves (``waves``) half decay or carry energy to higher cells, half to lower
ones. The unknowns are the displacements of the loaded cells and of those at the ends, and the amplitudes of both kinds
of waves in every stretch without loads between them. Each wave has its amplitude at the end of the stretch that it
leaves: all powers of factors are then at most one, and a stretch costs the same whatever its length. An infinite
lattice has outgoing waves alone on either side. Cf. Lopez Sancho et al., J. Phys. F 15 (1985) 851, who double stretches
in place of waves.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.lattice.bands import pass_bands, waves_at
from vipetsc.lattice.compliance.base import ChainCompliance, ComplianceError
from vipetsc.lattice.elements import contacts
from vipetsc.lattice.sites import Pair
from vipetsc.lattice.topology import NOTHING, WALL, Topology
from vipetsc.lattice.waves import NEUTRAL, BlochWaves, bloch_waves, cell_between, coupling_blocks, energy_flux

AT_REST = 1e-12  # a contact pair that moves less than this fraction of its cell does not move


class IncidentWave(NamedTuple):
    """A Bloch wave whose relative displacement at the first site is 1 m: ``relative`` (pairs,) at all of them.

    ``frequency`` in rad/s, ``band`` (from 1), ``direction`` +1 to higher cells or -1, ``wavenumber`` in (0, pi) rad a
    cell. ``flux`` in W/m^2 is the power of a wave over the square of its relative displacement. ``shape`` (dofs,) is
    the displacement at cell ``origin``, that of the next cell ``factor`` times it; ``channel`` is the wave's place
    among those of its direction.
    """

    frequency: float
    band: int
    direction: int
    wavenumber: float
    relative: np.ndarray
    flux: float
    shape: np.ndarray
    factor: complex
    origin: int
    channel: int

    def field(self, cells: ArrayLike) -> np.ndarray:
        """Return the displacement (cells, dofs) in m at ``cells`` (from 0)."""
        return np.asarray(self.factor ** (np.asarray(cells)[:, None] - self.origin) * self.shape)


class Stretch(NamedTuple):
    """``length`` cells without loads between the loaded cells number ``left`` and ``right``; None: they never end."""

    left: int | None
    right: int | None
    length: int

    def unknowns(self, half: int) -> int:
        """Return amplitudes of the stretch, with ``half`` waves each way, by number; 0 between neighbouring cells."""
        if self.left is None or self.right is None:
            return half
        return 2 * half if self.length else 0


class _Solution(NamedTuple):
    """Solution of a loaded lattice, and the ``waves`` of which its stretches consist.

    ``unknowns`` (omega, unknown, load): displacements of the loaded cells, then the amplitudes of each stretch.
    """

    unknowns: np.ndarray
    waves: BlochWaves


@dataclass(frozen=True)
class WaveCompliance(ChainCompliance):
    """Compliance of the sites of ``chain``, from Bloch waves; ``infinite``: its cells go on beyond both ends.

    All cells are as ``chain.cell``, whose dashpots are left out. At omega = 0 forces on a lattice that is free to move,
    as an infinite one is, must sum to zero.
    """

    infinite: bool = False

    @cached_property
    def highest(self) -> float:
        """The highest frequency of a wave in rad/s."""
        return pass_bands(self.chain.cell)[-1].high

    @cached_property
    def loaded_cells(self) -> list[int]:
        """The cells that are loaded, and the ends."""
        joined = [mass for pair in self._elements for mass in pair if mass != WALL]
        loaded = {*(mass // self.chain.cell.dofs for mass in joined), *(cell for cell, _ in self.points)}
        last = self.chain.cells - 1
        loaded |= {end for end, step in ((0, -1), (last, 1)) if self._topology.neighbour(end, step) < 0}
        return sorted(loaded) or [0]

    @property
    def _topology(self) -> Topology:
        """How the cells follow each other: in an infinite lattice for ever, whatever the ends of ``chain`` are."""
        if self.infinite:
            return Topology(self.chain.cells, None)
        return self.chain.topology

    @property
    def _elements(self) -> list[tuple[int, int]]:
        return contacts(self.chain, self._topology).mass_pairs()

    def response(self, omegas: ArrayLike) -> np.ndarray:
        """Return the motions of ``ChainCompliance.response``."""
        omega, mirrored = _right_half(omegas)
        loads = self.loads
        pairs = loads[:, : self.pairs]
        motions = pairs.T @ self._solve(omega, loads).unknowns[:, : len(loads)]

        if not self.infinite and np.all(omega.imag == 0):
            return np.asarray(motions.real)
        return np.where(mirrored[:, None, None], motions.conj(), motions)

    def field(self, omega: complex, forces: ArrayLike, cells: ArrayLike) -> np.ndarray:
        """Return displacements (cells, dofs) in m at ``cells`` (from 0); an infinite lattice has negative ones too.

        ``forces`` in N are as of ``signed``. Raises ValueError for a cell that the lattice does not have.
        """
        right_half, mirrored = _right_half(omega)
        given = np.asarray(forces, complex)
        if mirrored[0]:
            given = given.conj()

        solution = self._solve(right_half, self._load_of(given))
        u = np.array([self._displacement(int(cell), solution) for cell in np.atleast_1d(cells)])
        return u.conj() if mirrored[0] else u

    def incident(self, omega: float, band: int, direction: int = 1) -> IncidentWave:
        """Return the wave of ``band`` (from 1) at ``omega`` in rad/s with energy to higher (+1) or lower (-1) cells.

        Raises ComplianceError if there is none, or if the contact pair does not move relatively in it.
        """
        cell = self.chain.cell
        wavenumbers = [kappa for number, kappa, _ in waves_at(cell, omega) if number == band]
        if not wavenumbers:
            raise ComplianceError(f"no wave of band {band} has the frequency {omega:g} rad/s")

        waves = bloch_waves(cell, np.array([omega], complex))
        half = waves.factor.shape[1] // 2
        channel = _propagating_channel(waves.factor[0], direction, wavenumbers[0])
        factor = waves.factor[0, channel] ** direction
        state = waves.state[0, :, channel]
        shape = cell_between(cell, waves, state, factor * state)

        pairs = self.chain.sites.pairs
        relative = _relative_motion(pairs[0], shape, factor)
        if abs(relative) < AT_REST * np.abs(shape).max():
            raise ComplianceError(f"the contact pair does not move in the wave of band {band} at {omega:g} rad/s")
        # A pair like the first one moves as it does, but for the phase.
        ratios = [1.0 if pair == pairs[0] else _relative_motion(pair, shape, factor) / relative for pair in pairs]

        origin = self.chain.sites[0].cell
        return IncidentWave(
            frequency=omega,
            band=band,
            direction=direction,
            wavenumber=wavenumbers[0],
            relative=factor ** (self.chain.sites.cells - origin) * ratios,
            flux=abs(energy_flux(omega, state)) / abs(relative) ** 2,
            shape=shape / relative,
            factor=factor,
            origin=origin,
            channel=channel % half,
        )

    def outgoing(
        self, omega: float, forces: ArrayLike, wave: IncidentWave | None = None, amplitude: complex = 0.0
    ) -> np.ndarray:
        """Return the energy (direction, wave) in W, to higher cells and to lower ones, that leaves an infinite lattice.

        ``forces`` are as for ``field``, at ``omega`` in rad/s, positive. A ``wave`` that comes in with an ``amplitude``
        in m goes on in its direction, where it interferes with the waves of the forces.
        """
        solution = self._solve(np.array([omega], complex), self._load_of(np.asarray(forces, complex)))
        waves = solution.waves
        half = waves.factor.shape[1] // 2
        size = len(self.loaded_cells) * self.chain.cell.dofs

        # The first stretch goes on to lower cells, the last one to higher ones.
        u = solution.unknowns[0, :, 0]
        amplitudes = np.array([u[-half:], u[size : size + half]])
        if wave is not None:
            row = int(wave.direction < 0)
            amplitudes[row, wave.channel] += self._transmitted(wave, amplitude, waves)

        unit_flux = np.empty((2, half))
        for row in range(2):
            for n in range(half):
                unit_flux[row, n] = energy_flux(omega, waves.state[0, :, n + row * half])
        # Waves that decay carry no energy away; rounding would give them some.
        travels = np.abs(1 - np.abs(waves.factor[0].reshape(2, half))) < NEUTRAL
        return np.where(travels, np.abs(unit_flux), 0) * np.abs(amplitudes) ** 2

    def _transmitted(self, wave: IncidentWave, amplitude: complex, waves: BlochWaves) -> complex:
        """Return amplitude beyond the last loaded cell, scaled as ``waves``, of a ``wave`` of ``amplitude`` in m."""
        channel = wave.channel
        steps = self.loaded_cells[-1] + 1 - wave.origin
        if wave.direction < 0:
            # Waves to lower cells come after those to higher ones.
            channel += waves.factor.shape[1] // 2
            steps = self.loaded_cells[0] - wave.origin
        state = waves.state[0, :, channel]
        shape = cell_between(self.chain.cell, waves, state, wave.factor * state)
        scale = wave.shape[self.chain.cell.host] / shape[self.chain.cell.host]
        return complex(amplitude * scale * wave.factor**steps)

    @cached_property
    def _stretches(self) -> list[Stretch]:
        """The stretches without loads, from lower to higher cells; a ring's last one leads back to the first."""
        cells = self.loaded_cells
        last = len(cells) - 1
        stretches = [Stretch(i, i + 1, cells[i + 1] - cells[i] - 1) for i in range(last)]
        if self.infinite:
            return [Stretch(None, 0, 0), *stretches, Stretch(last, None, 0)]
        if self._topology.is_ring:
            stretches.append(Stretch(last, 0, cells[0] + self.chain.cells - cells[-1] - 1))
        return stretches

    def _load_of(self, forces: np.ndarray) -> np.ndarray:
        """Return the load (cells and dofs, 1) that ``forces``, as of ``signed``, amount to."""
        return np.asarray(self.loads[:, : len(forces)] @ self.signed(forces))[:, None]

    def _solve(self, omega: np.ndarray, loads: np.ndarray) -> _Solution:
        """Return the lattice under ``loads`` (cells and dofs, load) at ``omega`` in rad/s, of ``_right_half``."""
        waves = bloch_waves(self.chain.cell, omega)
        matrix = self._matrix(omega, waves)
        padded = np.zeros((1, matrix.shape[1], loads.shape[1]), complex)
        padded[0, : len(loads)] = loads
        return _Solution(unknowns=np.linalg.solve(matrix, padded), waves=waves)

    def _matrix(self, omega: np.ndarray, waves: BlochWaves) -> np.ndarray:
        """Return the equations (omega, unknown, unknown): balance of loaded cells, then states at stretches' ends."""
        chain = self.chain
        d = chain.cell.dofs
        blocks = coupling_blocks(chain.cell)
        coupling = blocks.out @ blocks.into.T
        half = blocks.out.shape[1]
        stretches = self._stretches
        size = len(self.loaded_cells) * d
        total = size + sum(stretch.unknowns(half) for stretch in stretches)

        matrix = np.zeros((len(omega), total, total), complex)
        at = [slice(i * d, i * d + d) for i in range(len(self.loaded_cells))]
        dynamic = blocks.stiffness - omega[:, None, None] ** 2 * np.diag(chain.cell.masses)
        for cell in at:
            matrix[:, cell, cell] += dynamic
        beyond = self._topology.neighbour(-1)
        if beyond == NOTHING:
            matrix[:, at[0], at[0]] -= blocks.left
            matrix[:, at[-1], at[-1]] -= blocks.right
        if beyond != WALL or self.infinite:
            # At omega = 0 such a lattice may move as a whole. A spring to ground stops that: forces that sum to zero
            # put no load on it.
            matrix[omega == 0, chain.cell.host, chain.cell.host] += blocks.stiffness[0, 0]

        # At each end of a stretch the loaded cell feels the springs that lead into it, whose far ends are states of the
        # stretch's waves; and the same states have the displacements of the loaded cell as their near ends.
        row = size
        for stretch in stretches:
            count = stretch.unknowns(half)
            amplitudes = slice(row, row + count)
            if not count:
                # Loaded cells that are neighbours are coupled without waves between them.
                assert stretch.left is not None and stretch.right is not None
                matrix[:, at[stretch.left], at[stretch.right]] += coupling
                matrix[:, at[stretch.right], at[stretch.left]] += coupling.T
                continue
            if stretch.left is not None:
                first = _states(waves, stretch, 0)
                matrix[:, at[stretch.left], amplitudes] += blocks.out @ first[:, :half]
                matrix[:, row : row + half, amplitudes] = first[:, half:]
                matrix[:, row : row + half, at[stretch.left]] -= blocks.out.T
                row += half
            if stretch.right is not None:
                last = _states(waves, stretch, stretch.length)
                matrix[:, at[stretch.right], amplitudes] += blocks.into @ last[:, half:]
                matrix[:, row : row + half, amplitudes] = last[:, :half]
                matrix[:, row : row + half, at[stretch.right]] -= blocks.into.T
                row += half
        return matrix

    def _displacement(self, cell: int, solution: _Solution) -> np.ndarray:
        """Return the displacement (dofs,) of a ``cell`` under the first load, at the first frequency."""
        cells = self.loaded_cells
        d = self.chain.cell.dofs
        unknowns = solution.unknowns[0, :, 0]
        if cell in cells:
            first = cells.index(cell) * d
            return unknowns[first : first + d]

        half = solution.waves.factor.shape[1] // 2
        start = len(cells) * d
        for stretch in self._stretches:
            stop = start + stretch.unknowns(half)
            place = self._place(cell, stretch)
            if place is not None:
                before = _states(solution.waves, stretch, place - 1)[0] @ unknowns[start:stop]
                after = _states(solution.waves, stretch, place)[0] @ unknowns[start:stop]
                return cell_between(self.chain.cell, solution.waves, before, after)
            start = stop
        raise ValueError(f"cell {cell + 1} is not one of the lattice's {self.chain.cells}")

    def _place(self, cell: int, stretch: Stretch) -> int | None:
        """Return the position of a ``cell`` in a ``stretch``, from 1; None outside.

        In a stretch without a beginning the last cell has 0, those before it negative numbers.
        """
        cells = self.loaded_cells
        if stretch.left is None:
            if cell >= cells[0]:
                return None
            return 1 - (cells[0] - cell)

        place = cell - cells[stretch.left]
        if not self.infinite:
            place %= self.chain.cells
        if place > 0 and (stretch.right is None or place <= stretch.length):
            return place
        return None


def _relative_motion(pair: Pair, shape: np.ndarray, factor: complex) -> complex:
    """Return relative displacement in m of a ``pair`` in the cell of a wave of the ``shape`` (dofs,) in m there.

    The next cell has ``factor`` times that shape; the ground does not move.
    """
    resonator = shape[pair.resonator] * factor if pair.offset else shape[pair.resonator]
    host = shape[pair.host] if pair.host >= 0 else 0.0
    return complex(resonator - host)


def _right_half(omegas: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return the ``omegas`` (w,), or -conj(omega) where the real part is negative, and the mask (w,) of the latter.

    The response at omega is there the complex conjugate of that at -conj(omega).
    """
    # Waves are sorted by the direction in which they carry energy at a positive frequency: at -omega it is the other.
    omega = np.atleast_1d(np.asarray(omegas, complex))
    mirrored = omega.real < 0
    return np.where(mirrored, -omega.conj(), omega), mirrored


def _propagating_channel(factor: np.ndarray, direction: int, wavenumber: float) -> int:
    """Return the number of the wave of ``factor`` (2r,) in a ``direction`` with a real ``wavenumber`` in (0, pi)."""
    half = len(factor) // 2
    channels = range(half)
    if direction < 0:
        channels = range(half, 2 * half)

    def mismatch(n: int) -> float:
        return float(abs(abs(np.angle(factor[n])) - wavenumber) + abs(1 - abs(factor[n])))

    return min(channels, key=mismatch)


def _states(waves: BlochWaves, stretch: Stretch, place: int) -> np.ndarray:
    """Return states (omega, 2r, wave) of a stretch's waves after its cell number ``place`` (0: before the first one).

    Waves to higher cells are counted from its beginning, waves to lower ones from its end.
    """
    half = waves.factor.shape[1] // 2
    states = []
    if stretch.left is not None:
        states.append(waves.state[:, :, :half] * waves.factor[:, None, :half] ** place)
    if stretch.right is not None:
        before_end = stretch.length - place
        state = waves.state[:, :, half:]
        slope = waves.slope[:, :, half:]
        if stretch.left is None:
            # A displacement linear in the cells grows without bound where there is no end: at omega = 0 the rigid
            # translation takes its place.
            state = np.where(np.any(slope != 0, axis=1, keepdims=True), slope, state)
            slope = 0 * slope
        states.append(state * waves.factor[:, None, half:] ** before_end - before_end * slope)
    return np.concatenate(states, axis=2)
