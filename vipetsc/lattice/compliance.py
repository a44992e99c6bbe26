r"""Compliance between contact pairs: what relative displacement harmonic forces make in a lattice of any length.

Of the Bloch waves (``waves``) half decay or carry energy to higher cells, half to lower ones. Loaded cells and the ends
are solved for with the amplitudes of both kinds in every stretch between, each counted from the end that it leaves: all
factors are at most one, and a stretch costs the same whatever its length. An infinite lattice has outgoing waves alone
on either side. Cf. Lopez Sancho et al., J. Phys. F 15 (1985) 851, who double stretches.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eigh

from vipetsc.lattice.bands import waves_at
from vipetsc.lattice.chain import Chain
from vipetsc.lattice.waves import NEUTRAL, BlochWaves, between, bloch_waves, coupling_blocks, energy_flux


class DenseCompliance:
    """Of a system: ``masses`` (dofs,) in kg, ``stiffness`` (dofs, dofs) in N/m, ``rows`` (pairs, dofs), z = rows u."""

    def __init__(self, masses: np.ndarray, stiffness: np.ndarray, rows: np.ndarray) -> None:
        root = 1 / np.sqrt(masses)
        squared, vectors = eigh(stiffness * np.outer(root, root))
        rigid = np.abs(squared) < 1e-12 * np.abs(squared).max()
        self.squared, self.vectors, self.parts = (
            np.where(rigid, 0, squared),
            vectors * root[:, None],
            rows * root @ vectors,
        )
        scale = np.abs(self.parts).max(initial=0.0)
        self.parts[:, rigid & (np.abs(self.parts).max(axis=0, initial=0.0) < 1e-10 * scale)] = 0  # pairs do not move it

    def at(self, omegas: ArrayLike) -> np.ndarray:
        """Relative displacements (omega, pair, pair) in m/N at frequencies ``omegas`` in rad/s, real or complex."""
        return np.einsum("in,wn,jn->wij", self.parts, self._gain(np.atleast_1d(omegas)), self.parts)

    def field(self, omega: complex, forces: np.ndarray) -> np.ndarray:
        """Displacement (dofs,) in m that ``forces`` (pairs,) in N, which pull pairs together, make."""
        return np.asarray(-self.vectors @ (self._gain(np.array([omega]))[0] * (forces @ self.parts)))

    def _gain(self, omega: np.ndarray) -> np.ndarray:
        gap = self.squared - omega[:, None] ** 2
        moved = np.any(self.parts != 0, axis=0)
        return np.divide(1, gap, out=np.zeros_like(gap), where=moved | (gap != 0))


class IncidentWave(NamedTuple):
    """A Bloch wave whose relative displacement at the first site is 1 m: ``relative`` (pairs,) at all of them.

    ``frequency`` in rad/s, ``band`` (from 1), ``direction`` +1 to higher cells or -1, ``wavenumber`` in (0, pi) rad a
    cell, energy ``flux`` in W/m^2. ``shape`` (dofs,) is the displacement at cell ``origin``, that of the next cell
    ``factor`` times it; ``channel`` is the wave's place among those of its direction.
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
        """Displacement (cells, dofs) in m at ``cells`` (from 0)."""
        return np.asarray(self.factor ** (np.asarray(cells)[:, None] - self.origin) * self.shape)


class Stretch(NamedTuple):
    """``length`` cells without loads between the loaded cells number ``left`` and ``right``; None: they never end."""

    left: int | None
    right: int | None
    length: int


@dataclass(frozen=True)
class WaveCompliance:
    """Of the sites of ``chain``; ``infinite``: its cells go on beyond both ends. ``points`` are (cell, mass), from 0.

    Relative displacements w = u_resonator - u_host of the contact pairs are made by pairs of opposite forces, and by
    forces on single masses at the ``points``. At omega = 0 forces on a lattice that is free to move must sum to zero.
    """

    chain: Chain
    infinite: bool = False
    points: tuple[tuple[int, int], ...] = ()

    @property
    def cells(self) -> list[int]:
        """The cells that are loaded, and the ends."""
        ends = [] if self.infinite or self.chain.ends == "periodic" else [0, self.chain.cells - 1]
        return sorted({*self.chain.sites, *(cell for cell, _ in self.points), *ends}) or [0]

    def _stretches(self) -> list[Stretch]:
        cells, last = self.cells, len(self.cells) - 1
        between = [Stretch(i, i + 1, cells[i + 1] - cells[i] - 1) for i in range(last)]
        if self.infinite:
            return [Stretch(None, 0, 0), *between, Stretch(last, None, 0)]
        return (
            [*between, Stretch(last, 0, cells[0] + self.chain.cells - cells[-1] - 1)]
            if self.chain.ends == "periodic"
            else between
        )

    def _loads(self) -> np.ndarray:
        """Unit loads (cells and dofs, pairs and points): rows that pick a relative displacement, or one of a mass."""
        cell, place = self.chain.cell, {c: i * self.chain.cell.dofs for i, c in enumerate(self.cells)}
        loads = np.zeros((len(place) * cell.dofs, len(self.chain.sites) + len(self.points)))
        for j, site in enumerate(self.chain.sites):
            loads[place[site] + cell.resonator, j], loads[place[site] + cell.host, j] = 1, -1
        for j, (site, mass) in enumerate(self.points, len(self.chain.sites)):
            loads[place[site] + mass, j] = 1
        return loads

    def response(self, omegas: ArrayLike) -> np.ndarray:
        """Relative displacements (omega, pair, pair and point) in m/N at ``omegas`` in rad/s, on or below the axis.

        Real for a finite lattice at real frequencies.
        """
        omega, back = _right_half(omegas)
        loads = self._loads()
        answer = loads[:, : len(self.chain.sites)].T @ self._solve(omega, loads)[0][:, : len(loads)]
        if not self.infinite and np.all(omega.imag == 0):
            return np.asarray(answer.real)
        return np.where(back[:, None, None], answer.conj(), answer)

    def at(self, omegas: ArrayLike) -> np.ndarray:
        """Compliance (omega, pair, pair) in m/N, see ``response``."""
        return self.response(omegas)[:, :, : len(self.chain.sites)]

    def field(self, omega: complex, forces: ArrayLike, cells: ArrayLike) -> np.ndarray:
        """Displacement (cells, dofs) in m at ``cells`` (from 0), of an infinite lattice any.

        ``forces`` in N are those of the pairs, which pull back (-F on the resonator, F on the host), then those on the
        points, if there are any.
        """
        (turned,), (back,) = _right_half(omega)
        given = np.asarray(forces, complex)
        solution, waves = self._solve(np.array([turned]), self._given(given.conj() if back else given))
        u = np.array([self._displacement(int(cell), solution[0, :, 0], waves) for cell in np.atleast_1d(cells)])
        return u.conj() if back else u

    def incident(self, omega: float, band: int, direction: int = 1) -> IncidentWave:
        """The wave of ``band`` (from 1) at ``omega`` in rad/s that carries energy to higher (+1) or lower (-1) cells.

        Raises ValueError if there is none, or if the contact pair does not move relatively in it.
        """
        cell, waves = self.chain.cell, bloch_waves(self.chain.cell, np.array([omega], complex))
        number = next((kappa for b, kappa, _ in waves_at(cell, omega) if b == band), None)
        if number is None:
            raise ValueError(f"no wave of band {band} has the frequency {omega:g} rad/s")
        r = waves.factor.shape[1] // 2
        channels = range(r) if direction > 0 else range(r, 2 * r)
        channel = min(
            channels, key=lambda n: abs(abs(np.angle(waves.factor[0, n])) - number) + abs(1 - abs(waves.factor[0, n]))
        )
        factor = waves.factor[0, channel] ** direction
        state = waves.state[0, :, channel]
        shape = between(cell, waves, state, factor * state)
        relative = shape[cell.resonator] - shape[cell.host]
        if abs(relative) < 1e-12 * np.abs(shape).max():
            raise ValueError(f"the contact pair does not move in the wave of band {band} at {omega:g} rad/s")
        origin = self.chain.sites[0]
        phases = factor ** (np.array(self.chain.sites) - origin)
        flux = abs(energy_flux(omega, state)) / abs(relative) ** 2
        return IncidentWave(omega, band, direction, number, phases, flux, shape / relative, factor, origin, channel % r)

    def outgoing(
        self, omega: float, forces: ArrayLike, wave: IncidentWave | None = None, amplitude: complex = 0.0
    ) -> np.ndarray:
        """Energy (direction, wave) in W, to higher cells and to lower ones, that leaves an infinite lattice.

        Of all waves at ``omega`` (rad/s, positive) that ``forces`` (as of ``field``) make beside the ``wave`` that
        comes in with an ``amplitude`` in m: its energy leaves, if nothing else happens, on its own way.
        """
        solution, waves = self._solve(np.array([omega], complex), self._given(np.asarray(forces, complex)))
        r, size, u = waves.factor.shape[1] // 2, len(self.cells) * self.chain.cell.dofs, solution[0, :, 0]
        amplitudes = np.array([u[-r:], u[size : size + r]])
        if wave is not None:
            way = 0 if wave.direction > 0 else 1
            state = waves.state[0, :, wave.channel + way * r]
            shape = between(self.chain.cell, waves, state, wave.factor * state)
            scale = wave.shape[self.chain.cell.host] / shape[self.chain.cell.host]
            steps = self.cells[-1] + 1 - wave.origin if way == 0 else self.cells[0] - wave.origin
            amplitudes[way, wave.channel] += amplitude * scale * wave.factor**steps
        each = np.array([[energy_flux(omega, waves.state[0, :, n + way * r]) for n in range(r)] for way in range(2)])
        travels = np.abs(1 - np.abs(waves.factor[0].reshape(2, r))) < NEUTRAL
        return np.where(travels, np.abs(each), 0) * np.abs(amplitudes) ** 2

    def _given(self, forces: np.ndarray) -> np.ndarray:
        """The load (cells and dofs, 1) of ``forces``."""
        loads, pairs = self._loads(), len(self.chain.sites)
        return np.asarray(loads[:, : len(forces)] @ np.concatenate([-forces[:pairs], forces[pairs:]]))[:, None]

    def _solve(self, omega: np.ndarray, loads: np.ndarray) -> tuple[np.ndarray, BlochWaves]:
        """Displacements of the loaded cells, then amplitudes of the stretches (omega, unknown, load), and the waves."""
        chain, cells = self.chain, self.cells
        (k, p, q, left, right), d = coupling_blocks(chain.cell), chain.cell.dofs
        waves, b = bloch_waves(chain.cell, omega), p @ q.T
        r, size = p.shape[1], len(cells) * d
        dynamic = k - omega[:, None, None] ** 2 * np.diag(chain.cell.masses)
        stretches = self._stretches()
        counts = [(r if None in s[:2] else 2 * r if s.length else 0) for s in stretches]
        total = size + sum(counts)
        matrix = np.zeros((len(omega), total, total), complex)
        at = [slice(i * d, i * d + d) for i in range(len(cells))]
        for here in at:
            matrix[:, here, here] += dynamic
        if chain.ends == "free" and not self.infinite:
            matrix[:, at[0], at[0]] -= left
            matrix[:, at[-1], at[-1]] -= right
        if chain.ends != "fixed" or self.infinite:
            matrix[omega == 0, chain.cell.host, chain.cell.host] += k[0, 0]  # forces that sum to zero put none on it
        start = size
        for stretch, count in zip(stretches, counts, strict=True):
            unknown = slice(start, start + count)
            if stretch.left is not None and stretch.right is not None and not count:
                matrix[:, at[stretch.left], at[stretch.right]] += b
                matrix[:, at[stretch.right], at[stretch.left]] += b.T
            row = start
            if stretch.left is not None and count:
                first = _states(waves, stretch, 0, stretch.length)
                matrix[:, at[stretch.left], unknown] += p @ first[:, :r]
                matrix[:, row : row + r, unknown] = first[:, r:]
                matrix[:, row : row + r, at[stretch.left]] -= p.T
                row += r
            if stretch.right is not None and count:
                last = _states(waves, stretch, stretch.length, 0)
                matrix[:, at[stretch.right], unknown] += q @ last[:, r:]
                matrix[:, row : row + r, unknown] = last[:, :r]
                matrix[:, row : row + r, at[stretch.right]] -= q.T
            start += count
        padded = np.zeros((1, total, loads.shape[1]), complex)
        padded[0, :size] = loads
        return np.linalg.solve(matrix, padded), waves

    def _displacement(self, cell: int, solution: np.ndarray, waves: BlochWaves) -> np.ndarray:
        """Displacement (dofs,) of a ``cell`` from a ``solution`` (unknown,)."""
        cells, d, r = self.cells, self.chain.cell.dofs, waves.factor.shape[1] // 2
        if cell in cells:
            return solution[cells.index(cell) * d :][:d]
        start = len(cells) * d
        for stretch in self._stretches():
            count = r if None in stretch[:2] else 2 * r if stretch.length else 0
            n = stretch.length
            if stretch.left is None:
                inside, i = cell < cells[0], n + 1 - (cells[0] - cell)
            else:
                i = (cell - cells[stretch.left]) % self.chain.cells if not self.infinite else cell - cells[stretch.left]
                inside = i > 0 and (stretch.right is None or i <= n)
            if inside:
                amplitudes = solution[start : start + count]
                before, after = (_states(waves, stretch, j, n - j)[0] @ amplitudes for j in (i - 1, i))
                return between(self.chain.cell, waves, before, after)
            start += count
        raise ValueError(f"cell {cell + 1} is not one of the lattice's {self.chain.cells}")


def _right_half(omegas: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (w,) with real parts >= 0, whose answers are the complex conjugate where the second array is true."""
    omega = np.atleast_1d(np.asarray(omegas, complex))
    back = omega.real < 0
    return np.where(back, -omega.conj(), omega), back


def _states(waves: BlochWaves, stretch: Stretch, after: int, before: int) -> np.ndarray:
    """States (omega, 2r, wave) of a stretch's waves ``after`` cells from its beginning, ``before`` its end."""
    r = waves.factor.shape[1] // 2
    parts = []
    if stretch.left is not None:
        parts.append(waves.state[:, :, :r] * waves.factor[:, None, :r] ** after)
    if stretch.right is not None:
        state, slope = waves.state[:, :, r:], waves.slope[:, :, r:]
        if stretch.left is None:  # without an end a shift in common alone is at rest
            state, slope = np.where(np.any(slope != 0, axis=1, keepdims=True), slope, state), 0 * slope
        parts.append(state * waves.factor[:, None, r:] ** before - before * slope)
    return np.concatenate(parts, axis=2)
