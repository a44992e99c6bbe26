"""Energies of the pass bands, the gaps and the region above, by frequency filters over all wavenumbers.

A filter that lets every wavenumber through acts along time alone, so no transform in space is needed. The
record is continued by its mirror image (a cosine transform): it then has no jump where its end meets its
start, which would leak about 1e-4 of the driven band's energy into all the others.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from vipetsc.lattice import Band
from vipetsc.spectra.fourier import kinetic_energy
from vipetsc.spectra.pooling import block_means, blocks

COLUMNS = 64  # histories of masses that are transformed together


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


def part_energies(
    velocity: np.ndarray, masses: ArrayLike, interval: float, edges: ArrayLike, stride: int = 1, memory: float = np.inf
) -> np.ndarray:
    """Kinetic energy (part, t) in J of every part, from ``velocity`` (t, cell, dof) in m/s, summed over the cells.

    The energy of a part from the frequency low to high has frequencies up to high - low and between 2 low and 2 high.
    It is computed at as few even times as tell these apart (the filtered spectrum is folded onto them), which gives it
    at every sample. A last part that is too wide for that, the region above the bands, is taken at every ``stride``-th
    and interpolated. ``velocity`` may be stored; no more than ``memory`` bytes of it are read at once.
    """
    nt, cells, dofs = velocity.shape
    last = nt - 1
    bounds = np.searchsorted(np.pi * np.arange(last + 1) / (last * interval), edges)
    ranges = [(int(low), int(high) - 1) for low, high in itertools.pairwise(bounds)]
    steps = [_fewest_steps(high - low, 2 * low, 2 * high, last, 1) for low, high in ranges[:-1]]
    low, high = ranges[-1]
    steps.append(_fewest_steps(high - low, 2 * low, 2 * high, last, stride))
    sums = [np.zeros(count + 1) for count in steps]
    together = max(COLUMNS // dofs, 1)
    for some in blocks(cells, 8 * dofs * nt, memory):
        held = np.asarray(velocity[:, some])
        for first in range(0, held.shape[1], together):
            columns = np.moveaxis(held[:, first : first + together], 1, 2)  # as runs in memory hold them
            weights = np.repeat(np.asarray(masses) / (8 * last**2), columns.shape[2])
            spectrum = _cosines(columns.reshape(nt, -1))
            spectrum[[0, -1]] *= 0.5
            for energy, (low, high) in zip(sums, ranges, strict=True):
                part = _folded(spectrum[low : high + 1], low, len(energy) - 1)
                energy += np.einsum("tc,tc,c->t", part, part, weights)
    return np.array([_at_samples(energy, *pair, last) for energy, pair in zip(sums, ranges, strict=True)])


def part_maps(
    velocity: np.ndarray, masses: ArrayLike, interval: float, ranges: ArrayLike, sizes: Sequence[int], memory: float
) -> np.ndarray:
    """Kinetic energy (part, t', cell') in J of cells in each part, means over blocks of ``sizes`` (samples, cells).

    ``ranges`` (part, 2) are the parts' lowest and highest frequencies in rad/s, as consecutive edges of ``Parts``.
    """
    nt, cells, dofs = velocity.shape
    last, wanted = nt - 1, np.asarray(ranges)
    bounds = np.searchsorted(np.pi * np.arange(nt) / (last * interval), wanted)
    maps = np.empty((len(wanted), -(-nt // sizes[0]), -(-cells // sizes[1])), np.float32)
    for some in blocks(maps.shape[2], 8 * nt * dofs * sizes[1], min(memory, 8 * nt * COLUMNS)):
        held = np.asarray(velocity[:, some.start * sizes[1] : some.stop * sizes[1]])
        spectrum = _cosines(held.reshape(nt, -1)) / (2 * last)
        for p, (low, high) in enumerate(bounds):
            inside = np.zeros_like(spectrum)
            inside[low:high] = spectrum[low:high]
            energy = kinetic_energy(_cosines(inside).reshape(held.shape), masses)
            maps[p, :, some] = block_means(block_means(energy, sizes[0], 0), sizes[1], 1)
    return maps


def _cosines(columns: np.ndarray) -> np.ndarray:
    """``fft.dct(columns, 1, axis=0)``, two columns a transform: faster where the length has large factors."""
    (nt, count), half = columns.shape, -(-columns.shape[1] // 2)
    pairs = np.zeros((2 * nt - 2, half), dtype=complex)
    pairs[:nt].real, pairs[:nt, : count - half].imag = columns[:, :half], columns[:, half:]
    pairs[nt:] = pairs[nt - 2 : 0 : -1]
    pairs = fft.fft(pairs, axis=0, overwrite_x=True)[:nt]  # of real even columns, so real
    return np.concatenate([pairs.real, pairs.imag[:, : count - half]], axis=1)


def _looks_like(wave: Any, steps: int) -> Any:
    """The cosine (half waves in the record) that ``wave`` cannot be told from at ``steps`` + 1 even times."""
    return steps - np.abs(wave % (2 * steps) - steps)


def _fewest_steps(width: int, low: int, high: int, most: int, stride: int) -> int:
    """Fewest steps that tell apart the cosines 0 to ``width`` and ``low`` to ``high``, a fast length up to ``most``.

    For a ``width`` that leaves none, most/``stride``.
    """
    steps = fft.next_fast_len(max(3 * width, 1), real=True)
    if steps >= most:
        return most if stride == 1 else min(fft.next_fast_len(-(-most // stride), real=True), most)
    while steps < min(high, most):
        one_way = low // steps == max(high - 1, low) // steps
        if one_way and min(_looks_like(low, steps), _looks_like(high, steps)) > width:
            break
        steps = fft.next_fast_len(steps + 1, real=True)
    return min(steps, most)


def _folded(amplitudes: np.ndarray, low: int, steps: int) -> np.ndarray:
    """Twice the sum (t', ...) of the cosines ``low``, ... with ``amplitudes`` (k, ...), at ``steps`` + 1 even times."""
    folded, end = np.zeros((steps + 1, *amplitudes.shape[1:])), low + len(amplitudes)
    for start in range(low - low % steps, end, steps):
        piece = amplitudes[max(start - low, 0) : start + steps - low]
        first = max(low, start) - start
        if start // steps % 2:
            piece, first = piece[::-1], steps - first - len(piece) + 1
        folded[first : first + len(piece)] += piece
    folded[[0, -1]] *= 2.0
    return fft.dct(folded, type=1, axis=0, overwrite_x=True)


def _at_samples(energy: np.ndarray, low: int, high: int, last: int) -> np.ndarray:
    """Energy at ``last`` + 1 even times of the cosines ``low`` to ``high``, from those (t') of ``_fewest_steps``."""
    steps, width = len(energy) - 1, high - low
    if steps == last or width < 0:
        return np.resize(energy, last + 1)
    if 3 * width > steps and steps < 2 * high:
        return np.interp(np.linspace(0, steps, last + 1), np.arange(steps + 1), energy)
    waves = np.union1d(np.arange(width + 1), np.arange(2 * low, 2 * high + 1))
    amplitudes = fft.dct(energy, type=1) / (2 * steps)
    amplitudes[[0, -1]] *= 0.5
    spread = np.bincount(_looks_like(waves, last), amplitudes[_looks_like(waves, steps)], last + 1)
    return np.maximum(_folded(spread, 0, last), 0.0)


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
