"""Bloch bands of a unit cell: frequencies, eigenvectors, group velocities, pass bands and gaps."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from vipetsc.lattice.cell import UnitCell

# Wavenumbers between which extremes and waves are searched. What is found is refined off the grid: with half or twice
# as many, edges and speeds of the four-band cell stay within 1e-8.
GRID = np.linspace(0, np.pi, 721)
# Cells of more masses get fewer wavenumbers, since each costs the cube of the masses: bands of long cells are folded,
# and nearly straight. For 64 masses the whole grid costs 40 times as much, and the edges are the same to 3e-15, as they
# are with 31 and with 122 wavenumbers.
MANY_MASSES = 32
FEWEST = 61
BLOCK = 16  # wavenumbers whose matrices are held at once: with 8 a seventh slower, with 32 a twentieth faster
# A band whose largest speed on the grid is below this fraction of the largest of all is not refined. Refinement raises
# a speed by far less than a tenth: 0.8 and 0.95 find the same.
NEARLY_FASTEST = 0.9
FLAT = 1e-12  # a band whose frequencies differ by less than this fraction is flat to rounding
# A mode of a cell is at rest if its frequency is below this fraction of the highest one: its square, which is 0, has an
# error of 1e-16 of the highest square by rounding, so that the frequency has one of 1e-8.
STILL = 1e-7
# Smallest wavenumber at which group velocities are computed. The limit at 0 changes by 9e-8 of itself with half of it,
# by 4e-7 with twice: at smaller ones rounding of omega^2 counts, at larger ones the curvature of the band.
OFF_ZERO = 3e-4
# At smaller wavenumbers omega^2 of the acoustic branch is below this fraction of the highest one: it is 2e-8 at most.
SLOWLY = 1e-6
# Below this fraction of the highest one an omega^2 may differ by more than 1e-6 of itself by rounding.
ROUNDING = 1e-10
EPS = float(np.finfo(float).eps)
TINY = float(np.finfo(float).tiny)
# Bands touch where their omega^2 differ by less than this fraction of the highest one; rounding is 1e-14 of it.
TOUCHING = 1e-12
# Fraction of a frequency below which a gap is one of rounding. Two masses that differ by 1e-8 open a wider one.
NO_GAP = 1e-9


@dataclass(frozen=True)
class BlochPoint:
    """Solution of the Bloch problem; leading axes are those of the wavenumbers it was solved at.

    ``frequency`` (..., band) in rad/s, ``vectors`` (..., dof, band) mass-normalised, ``group_velocity``
    (..., band) in cells/s.
    """

    frequency: np.ndarray
    vectors: np.ndarray
    group_velocity: np.ndarray


@dataclass(frozen=True)
class Band:
    """A pass band (1-based ``number``, lowest first) between two frequencies in rad/s."""

    number: int
    low: float
    high: float


def bloch(cell: UnitCell, kappa: ArrayLike) -> BlochPoint:
    """Return frequencies, vectors and group velocities of ``cell`` at wavenumbers ``kappa`` (...) in rad per cell.

    Solves (K(kappa) - omega^2 M) u = 0 with u* M u = 1. The group velocity is d omega/d kappa = u* K' u / (2 omega)
    with K' = dK/d kappa, as follows from the derivative of u* K u = omega^2; where omega = 0 it is the limit from
    kappa > 0. Where bands touch, the vectors are those of the bands next to that wavenumber, on the side of 0.
    """
    kappa = np.asarray(kappa, float)
    root = 1 / np.sqrt(cell.masses)
    squared, vectors = _eigenpairs(cell, kappa)
    slope = _stiffness_slope(cell, kappa) * (root[:, None] * root)
    _resolve_touching(kappa, squared, vectors, slope)
    group_velocity = _group_velocity(squared, vectors, slope)

    # Closer to zero, rounding of omega^2 (eps times the top band's) outweighs that of the acoustic branch.
    near_zero = np.abs(kappa) < OFF_ZERO
    if near_zero.any():
        off_zero = np.asarray(OFF_ZERO)
        squared_there, vectors_there = _eigenpairs(cell, off_zero)
        slope_there = _stiffness_slope(cell, off_zero) * (root[:, None] * root)
        limit = _group_velocity(squared_there, vectors_there, slope_there)
        # Of cells that are hardly joined the branch is rounding even there. Its slope is not: omega^2 is v^2 kappa^2.
        is_rounding = squared_there < ROUNDING * squared_there[-1]
        slopes = np.maximum(_eigenvalue_slope(vectors_there, slope_there), 0)
        limit = np.where(is_rounding, np.sqrt(slopes / (2 * OFF_ZERO)), limit)
        is_slow = near_zero[..., None] & (squared < SLOWLY * squared[..., -1:])
        group_velocity = np.where(is_slow, limit, group_velocity)
    return BlochPoint(
        frequency=np.sqrt(np.maximum(squared, 0)), vectors=vectors * root[:, None], group_velocity=group_velocity
    )


def _group_velocity(squared: np.ndarray, vectors: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return u* K' u / (2 omega) (..., band) of ``vectors`` (..., dof, band), with K' = ``slope`` (..., dof, dof)."""
    # A smaller square is rounding: the slope over its root may be any number.
    least = np.maximum(EPS * squared[..., -1:], TINY)
    return np.asarray(_eigenvalue_slope(vectors, slope) / (2 * np.sqrt(np.maximum(squared, least))))


def _eigenvalue_slope(vectors: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return u* K' u (..., band), the derivatives of omega^2 by the wavenumber."""
    return np.asarray(np.einsum("...ij,...ij->...j", vectors.conj(), slope @ vectors).real)


def _resolve_touching(kappa: np.ndarray, squared: np.ndarray, vectors: np.ndarray, slope: np.ndarray) -> None:
    """Turn ``vectors`` of equal frequency to those of the bands that touch there.

    Any combination of them solves the eigenvalue problem; those of the bands diagonalise the ``slope`` K'.
    """
    touching = np.diff(squared, axis=-1) <= TOUCHING * squared[..., -1:]
    for point in np.argwhere(touching.any(axis=-1)):
        at = tuple(point) if kappa.ndim else ()
        # Bands that touch are consecutive, since frequencies are sorted.
        begins = np.flatnonzero(np.append(True, ~touching[at]))
        ends = np.append(begins[1:], squared.shape[-1])
        for begin, end in zip(begins, ends, strict=True):
            some = vectors[(*at, slice(None), slice(begin, end))]
            turning = some.conj().T @ slope[at] @ some
            # Bands that are flat, as those of loose masses, stay as they are.
            if end - begin == 1 or np.abs(turning).max() <= FLAT * squared[at][-1]:
                continue

            # Next to the wavenumber, on the side of 0, the lowest band is the one that rises most towards it.
            _, turned = np.linalg.eigh(turning)
            if kappa[at] > 0:
                turned = turned[:, ::-1]
            some[:] = some @ turned


def _eigenpairs(cell: UnitCell, kappa: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return squared frequencies (..., band), and vectors (..., dof, band) of displacements times roots of masses."""
    root = 1 / np.sqrt(cell.masses)
    squared, vectors = np.linalg.eigh(cell.stiffness_matrix(kappa) * (root[:, None] * root))
    return squared, vectors


def _stiffness_slope(cell: UnitCell, kappa: np.ndarray) -> np.ndarray:
    """Return the derivative of the stiffness matrix (..., dof, dof) in N/m by the wavenumbers ``kappa`` (...)."""
    slope = np.zeros((*kappa.shape, cell.dofs, cell.dofs), complex)
    for mass, offset, other, stiffness, *_ in cell.couplings():
        slope[..., mass, other] -= 1j * offset * stiffness * np.exp(1j * kappa * offset)
    return slope


class BandGrid(NamedTuple):
    """Frequencies and group velocities (kappa, band) at the wavenumbers ``kappa`` from 0 to pi."""

    kappa: np.ndarray
    frequency: np.ndarray
    group_velocity: np.ndarray


@lru_cache(maxsize=16)
def _grid(cell: UnitCell) -> BandGrid:
    """Return the bands of a cell where extremes and waves are searched."""
    kappa = GRID
    if cell.dofs > MANY_MASSES:
        count = max(FEWEST, len(GRID) * MANY_MASSES // cell.dofs)
        kappa = np.linspace(0, np.pi, count)
    blocks = [bloch(cell, kappa[i : i + BLOCK]) for i in range(0, len(kappa), BLOCK)]
    return BandGrid(
        kappa=kappa,
        frequency=np.concatenate([block.frequency for block in blocks]),
        group_velocity=np.concatenate([block.group_velocity for block in blocks]),
    )


def _frequency(cell: UnitCell, band: int, kappa: float, sign: int = 1) -> float:
    """Return the frequency in rad/s of ``band`` (from 1) at ``kappa``; ``sign`` -1 makes the lower edge a maximum."""
    # Without the group velocities of ``bloch``, which cost as much again as the frequencies.
    if cell.dofs <= MANY_MASSES:
        squared = float(_eigenpairs(cell, kappa)[0][band - 1])
    else:
        squared, _ = _eigenpair(cell, band, kappa)
    return sign * float(np.sqrt(max(squared, 0.0)))


def _speed(cell: UnitCell, band: int, kappa: float) -> float:
    """Return magnitude of the group velocity in cells/s of ``band`` (from 1) at ``kappa``."""
    # Where bands may touch, at 0 and at pi, the vector of one band is not enough.
    if cell.dofs <= MANY_MASSES or kappa < OFF_ZERO or kappa >= np.pi:
        return float(abs(bloch(cell, kappa).group_velocity[band - 1]))
    squared, vector = _eigenpair(cell, band, kappa)
    slope = float((vector.conj() @ _stiffness_slope(cell, np.asarray(kappa)) @ vector).real)
    # The mean of all squares, which the trace gives, is at most the largest one.
    mean = float(np.mean(np.diagonal(cell.stiffness_matrix(np.asarray(kappa))).real / cell.masses))
    return abs(slope) / (2 * float(np.sqrt(max(squared, EPS * mean, TINY))))


def _eigenpair(cell: UnitCell, band: int, kappa: float) -> tuple[float, np.ndarray]:
    """Return squared frequency of ``band`` (from 1) at ``kappa``, and its mass-normalised vector.

    One pair of a large matrix costs a quarter of all of them.
    """
    root = 1 / np.sqrt(cell.masses)
    matrix = cell.stiffness_matrix(np.asarray(kappa)) * (root[:, None] * root)
    (squared,), vectors = scipy.linalg.eigh(matrix, subset_by_index=[band - 1, band - 1])
    return float(squared), vectors[:, 0] * root


def _maximum(function: Callable[[float], float], values: np.ndarray, kappa: np.ndarray) -> tuple[float, float]:
    """Return argument in [0, pi] and value of a function's maximum: the best of ``values`` at ``kappa``, refined."""
    best = int(np.argmax(values))
    last = len(kappa) - 1
    if last + 1 < len(GRID):
        # Bands of long cells have their extremes at 0 and pi; a band so narrow that it is flat to rounding, anywhere.
        end = 0 if values[0] >= values[last] else last
        if values[best] - values[end] <= FLAT * np.abs(values).max():
            return float(kappa[end]), float(values[end])
    # At an extreme the value errs by the square of the argument's error: 1e-10 leaves none in the frequency.
    bracket = kappa[max(best - 1, 0)], kappa[min(best + 1, last)]
    refined = scipy.optimize.minimize_scalar(
        lambda x: -function(x), bounds=bracket, method="bounded", options={"xatol": 1e-10}
    )
    if -refined.fun > values[best]:
        return refined.x, -refined.fun
    # A bounded search does not reach the ends of its bracket, where an extreme at 0 or pi lies.
    return float(kappa[best]), float(values[best])


@lru_cache
def pass_bands(cell: UnitCell) -> tuple[Band, ...]:
    """Return the pass bands, lowest first; edges are the extremes over kappa in [0, pi], refined off the grid.

    Bands that touch have the same edge.
    """
    grid = _grid(cell)
    bands: list[Band] = []
    for number, frequency in enumerate(grid.frequency.T, 1):
        _, high = _maximum(partial(_frequency, cell, number), frequency, grid.kappa)
        _, low = _maximum(partial(_frequency, cell, number, sign=-1), -frequency, grid.kappa)
        low = max(-low, 0.0)
        if bands and abs(low - bands[-1].high) < NO_GAP * low:
            low = bands[-1].high
        bands.append(Band(number=number, low=low, high=high))
    return tuple(bands)


def wave_bands(cell: UnitCell) -> tuple[Band, ...]:
    """Return pass bands as of ``pass_bands``; () where contacts alone join the cells, so that no linear wave travels.

    ``pass_bands`` then has the frequencies of a single cell's modes, each as a band with two equal edges.
    """
    if not cell.joins_cells:
        return ()
    return pass_bands(cell)


def modes_of_a_cell(cell: UnitCell) -> np.ndarray:
    """Return frequencies (dof,) in rad/s of the modes of a ``cell`` that contacts alone join to others, lowest first.

    A motion of the cell as a whole has the frequency 0.
    """
    frequency = bloch(cell, 0.0).frequency
    return np.where(frequency > STILL * frequency.max(), frequency, 0.0)


def gaps(bands: Sequence[Band]) -> list[tuple[float, float]]:
    """Return the band gaps (low, high) in rad/s between consecutive pass bands; the region above is not one."""
    return [(a.high, b.low) for a, b in itertools.pairwise(bands) if b.low > a.high]


@lru_cache
def max_group_velocity(cell: UnitCell, band: int) -> tuple[float, float, float]:
    """Return wavenumber (rad per cell), frequency (rad/s) and |v_g| (cells/s) where ``band`` (1-based) is fastest."""
    grid = _grid(cell)
    speeds = np.abs(grid.group_velocity[:, band - 1])
    fastest, largest = _maximum(partial(_speed, cell, band), speeds, grid.kappa)
    return fastest, _frequency(cell, band, fastest), largest


@lru_cache
def fastest_speed(cell: UnitCell) -> float:
    """Return the largest group velocity of all bands in cells/s."""
    speeds = np.abs(_grid(cell).group_velocity).max(axis=0)
    (near,) = np.nonzero(speeds >= NEARLY_FASTEST * speeds.max())
    return max(max_group_velocity(cell, int(band) + 1)[2] for band in near)


@lru_cache
def waves_at(cell: UnitCell, frequency: float) -> tuple[tuple[int, float, float], ...]:
    """Return the waves of ``frequency`` (rad/s): (band from 1, kappa in [0, pi], |v_g| in cells/s); () in a gap.

    There are none, either, where contacts alone join the cells.
    """
    if not cell.joins_cells:
        return ()
    waves = []
    grid = _grid(cell)
    for number, offset in enumerate((grid.frequency - frequency).T, 1):
        # A band may pass the frequency several times, where it rises and falls.
        for i in np.nonzero(offset[:-1] * offset[1:] <= 0)[0]:
            if offset[i] == 0 and i > 0:
                continue  # a root on the grid, which the interval before has given

            def difference(kappa: float, band: int = number) -> float:
                return _frequency(cell, band, kappa) - frequency

            begin, end = grid.kappa[i : i + 2]
            before = difference(begin)
            after = difference(end)
            # At an edge of a band the grid's frequency and this one may differ by rounding, and have no change of sign.
            if before * after > 0:
                root = float(begin if abs(before) < abs(after) else end)
            else:
                root = scipy.optimize.brentq(difference, begin, end, xtol=1e-13)
            speed = _speed(cell, number, root)
            waves.append((number, root, speed))
    return tuple(waves)
