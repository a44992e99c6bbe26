"""Energies of the pass bands, the gaps and the region above, by frequency filters over all wavenumbers.

A filter that lets every wavenumber through acts along time alone, so no transform in space is needed. The
record is continued by its mirror image (a cosine transform): it then has no jump where its end meets its
start, which would leak about 1e-4 of the driven band's energy into all the others.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from vipetsc.lattice import Band

BLOCK = 2_000_000


@dataclass(frozen=True)
class Parts:
    """A partition of all frequencies: ``edges`` (part + 1) in rad/s from 0 to infinity, a name for each part.

    ``bands`` names for each part the pass bands in it (1-based numbers), () for a gap and for the region
    above the top band; pass bands that overlap share a part.
    """

    edges: np.ndarray
    names: tuple[str, ...]
    bands: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, bands: Sequence[Band]) -> Self:
        """The partition that ``bands``, lowest first, make of the frequency axis."""
        edges: list[float] = [0.0]
        inside: list[tuple[int, ...]] = []  # the bands of each part
        # Rounding leaves the first band of a free lattice a hair above zero; nothing is below it.
        tiny = 1e-6 * max(band.high for band in bands)
        for band in sorted(bands, key=lambda b: (b.low, b.high)):
            if inside and band.low <= edges[-1]:
                edges[-1], inside[-1] = max(edges[-1], band.high), (*inside[-1], band.number)
                continue
            if band.low > edges[-1] + tiny:
                edges.append(band.low)
                inside.append(())
            edges.append(band.high)
            inside.append((band.number,))
        gap = itertools.count(1)
        names = (f"band {'+'.join(map(str, sorted(part)))}" if part else f"gap {next(gap)}" for part in inside)
        return cls(np.array([*edges, np.inf]), (*names, "above"), (*inside, ()))

    def above(self, frequency: float) -> np.ndarray:
        """Which parts (part) are pass bands above the one driven at ``frequency`` (rad/s)."""
        driven = int(np.searchsorted(self.edges, frequency, side="right")) - 1
        return np.array([bool(b) and i > driven for i, b in enumerate(self.bands)])


def split(signal: np.ndarray, interval: float, edges: ArrayLike) -> Iterator[np.ndarray]:
    """The parts of ``signal`` (t, ...) sampled every ``interval`` s, between consecutive ``edges`` (rad/s).

    Yields one array of the signal's shape a part. With edges from 0 to infinity they add up to the signal, and their
    mean squares over time (trapezoidal rule) to its mean square.
    """
    nt = len(signal)
    spectrum = fft.dct(signal, type=1, axis=0)
    part = np.searchsorted(edges, np.pi * np.arange(nt) / ((nt - 1) * interval), side="right") - 1
    for p in range(len(np.asarray(edges)) - 1):
        inside = np.zeros_like(spectrum)
        inside[part == p] = spectrum[part == p]
        yield fft.idct(inside, type=1, axis=0, overwrite_x=True)


def part_energies(velocity: np.ndarray, masses: ArrayLike, interval: float, edges: ArrayLike) -> np.ndarray:
    """Kinetic energy (part, t) in J of every part, from ``velocity`` (t, cell, dof) in m/s.

    Summed over the cells, a block of them at a time.
    """
    nt, cells = velocity.shape[:2]
    energy = np.zeros((len(np.asarray(edges)) - 1, nt))
    block = max(BLOCK // nt, 1)
    for j, mass in enumerate(np.asarray(masses)):
        of_mass = np.asarray(velocity[..., j])
        for first in range(0, cells, block):
            for p, part in enumerate(split(of_mass[:, first : first + block], interval, edges)):
                energy[p] += 0.5 * mass * np.einsum("tc,tc->t", part, part)
    return energy


def front_arrival(energy: np.ndarray) -> int:
    """First sample at which ``energy`` (t) of one cell exceeds 1 % of its largest value."""
    return int(np.argmax(energy > 0.01 * energy.max()))


def ibtet(energy: np.ndarray, above: np.ndarray, start: int = 0) -> float:
    """Inter-band targeted energy transfer: share of the parts ``above`` (part), averaged from ``start`` on.

    ``energy`` (part, t) in J. The share is taken of the sum of all parts at every sample, as the paper's
    (E_3 + E_4)/E_total of the four-band lattice driven on band 2; for any other cell the bands above the
    driven one take the place of 3 and 4. NaN when there are none, or no energy.
    """
    total = energy[:, start:].sum(axis=0)
    moving = total > 0
    if not above.any() or not moving.any():
        return float("nan")
    return float(np.mean(energy[above, start:].sum(axis=0)[moving] / total[moving]))
