"""Bloch bands of a unit cell: frequencies, eigenvectors, group velocities, pass bands and gaps."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq, minimize_scalar

from vipetsc.lattice.cell import UnitCell

GRID = np.linspace(0, np.pi, 721)  # wavenumbers between which extremes and waves are searched
OFF_ZERO = 3e-4  # smallest wavenumber at which group velocities are computed


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
    """Frequencies, eigenvectors and group velocities of ``cell`` at wavenumbers ``kappa`` (rad per cell).

    Solves (K(kappa) - omega^2 M) u = 0; the group velocity is d omega/d kappa = u* K' u / (2 omega), taken
    as the limit from kappa > 0 where omega = 0.
    """
    kappa = np.asarray(kappa, float)
    root = 1 / np.sqrt(cell.masses)
    scale = root[:, None] * root
    squared, vectors = np.linalg.eigh(cell.stiffness_matrix(kappa) * scale)

    # Closer to zero, rounding of omega^2 (eps times the top band's) outweighs that of the acoustic branch.
    off_zero = np.where(np.abs(kappa) < OFF_ZERO, OFF_ZERO, kappa)
    eigenvalue, u = np.linalg.eigh(cell.stiffness_matrix(off_zero) * scale)
    stiffness_slope = np.zeros((*kappa.shape, cell.dofs, cell.dofs), complex)
    for mass, offset, other, stiffness, *_ in cell.couplings():
        stiffness_slope[..., mass, other] -= 1j * offset * stiffness * np.exp(1j * off_zero * offset)
    eigenvalue_slope = np.einsum("...ij,...ij->...j", u.conj(), stiffness_slope * scale @ u).real
    return BlochPoint(
        frequency=np.sqrt(np.maximum(squared, 0)),
        vectors=vectors * root[:, None],
        group_velocity=eigenvalue_slope / (2 * np.sqrt(np.maximum(eigenvalue, np.finfo(float).tiny))),
    )


def _frequency(cell: UnitCell, band: int, kappa: float, sign: int = 1) -> float:
    """Frequency in rad/s of ``band`` (from 1) at ``kappa``; ``sign`` -1 makes the lower edge a maximum."""
    return sign * float(bloch(cell, kappa).frequency[band - 1])


def _maximum(function: Callable[[float], float], values: np.ndarray) -> tuple[float, float]:
    """Argument in [0, pi] and value of a function's maximum: the best of its ``values`` on GRID, refined."""
    best = int(np.argmax(values))
    bracket = GRID[max(best - 1, 0)], GRID[min(best + 1, len(GRID) - 1)]
    refined = minimize_scalar(lambda x: -function(x), bounds=bracket, method="bounded", options={"xatol": 1e-10})
    if -refined.fun > values[best]:
        return refined.x, -refined.fun
    # A bounded search does not reach the ends of its bracket, where an extreme at 0 or pi lies.
    return float(GRID[best]), float(values[best])


@lru_cache
def pass_bands(cell: UnitCell) -> tuple[Band, ...]:
    """Pass bands, lowest first; edges are the extremes over kappa in [0, pi], refined off the grid."""
    bands = []
    for number, frequency in enumerate(bloch(cell, GRID).frequency.T, 1):
        _, high = _maximum(partial(_frequency, cell, number), frequency)
        _, low = _maximum(partial(_frequency, cell, number, sign=-1), -frequency)
        bands.append(Band(number=number, low=max(-low, 0.0), high=high))
    return tuple(bands)


def gaps(bands: Sequence[Band]) -> list[tuple[float, float]]:
    """Band gaps (low, high) in rad/s between consecutive pass bands; the region above is not one."""
    return [(a.high, b.low) for a, b in itertools.pairwise(bands) if b.low > a.high]


@lru_cache
def max_group_velocity(cell: UnitCell, band: int) -> tuple[float, float, float]:
    """Wavenumber (rad per cell), frequency (rad/s) and |v_g| (cells/s) at which ``band`` (1-based) is fastest."""
    speeds = np.abs(bloch(cell, GRID).group_velocity[:, band - 1])
    fastest, largest = _maximum(lambda kappa: float(abs(bloch(cell, kappa).group_velocity[band - 1])), speeds)
    return fastest, _frequency(cell, band, fastest), largest


@lru_cache
def waves_at(cell: UnitCell, frequency: float) -> tuple[tuple[int, float, float], ...]:
    """Propagating waves of ``frequency`` (rad/s): (band, kappa in (0, pi), |v_g| in cells/s); () in a gap."""
    waves = []
    for number, offset in enumerate((bloch(cell, GRID).frequency - frequency).T, 1):
        for i in np.nonzero(offset[:-1] * offset[1:] <= 0)[0]:
            if offset[i] == 0 and i > 0:
                continue  # a root on the grid, which the interval before has given
            root = brentq(lambda x, n=number: _frequency(cell, n, x) - frequency, GRID[i], GRID[i + 1], xtol=1e-13)
            speed = float(abs(bloch(cell, root).group_velocity[number - 1]))
            waves.append((number, root, speed))
    return tuple(waves)
