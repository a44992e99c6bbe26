"""Energies of the pass bands, the gaps and the region above, by frequency filters over all wavenumbers.

A filter that lets every wavenumber through acts along time alone, so no transform in space is needed. The record is
continued by its mirror image (a cosine transform), which has no jump. A Fourier transform repeats the record instead:
the jump from its end to its start would leak about 1e-4 of the driven band's energy into all the other parts.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft
from scipy.special import diric

from vipetsc.lattice import Band
from vipetsc.spectra.cosine_squares import Cosines, CosineSquares
from vipetsc.spectra.cosine_transform import CosineTransform
from vipetsc.spectra.pooling import block_means, blocks

# Histories of masses that are transformed together. Those of 4,421 samples are 1 MB, the size of a core's cache: from
# 30 to 100 the time is the same, with 16 it is a fifth more.
COLUMNS = 32


@dataclass(frozen=True)
class Parts:
    """A partition of all frequencies: ``edges`` (part + 1) in rad/s from 0 to infinity, a name for each part.

    ``bands`` (part,) are the numbers, from 1, of the pass bands in each part: () for a gap and for the region above
    the top band. Pass bands that overlap are one part.
    """

    edges: np.ndarray
    names: tuple[str, ...]
    bands: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, bands: Sequence[Band]) -> Self:
        """Return the partition that ``bands``, lowest first, make of the frequency axis."""
        edges: list[float] = [0.0]
        inside: list[tuple[int, ...]] = []  # the bands of each part
        # The first band of a free lattice begins at zero, as the root of an eigenvalue with a rounding of 1e-16 of the
        # largest one: at 1e-8 of the highest frequency. No gap lies below it.
        tiny = 1e-6 * max(band.high for band in bands)
        for band in sorted(bands, key=lambda b: (b.low, b.high)):
            if inside and band.low <= edges[-1]:
                edges[-1] = max(edges[-1], band.high)
                inside[-1] = (*inside[-1], band.number)
                continue
            if band.low > edges[-1] + tiny:
                edges.append(band.low)
                inside.append(())
            edges.append(band.high)
            inside.append((band.number,))

        names = []
        gaps = 0
        for numbers in inside:
            if numbers:
                names.append(f"band {'+'.join(map(str, sorted(numbers)))}")
            else:
                gaps += 1
                names.append(f"gap {gaps}")
        return cls(edges=np.array([*edges, np.inf]), names=(*names, "above"), bands=(*inside, ()))

    def above(self, frequency: float) -> np.ndarray:
        """Return whether each of the parts (part) is a pass band above the one driven at ``frequency`` (rad/s)."""
        driven = int(np.searchsorted(self.edges, frequency, side="right")) - 1
        return np.array([bool(b) and i > driven for i, b in enumerate(self.bands)])


class PartEnergies(NamedTuple):
    """Kinetic energies in J of parts of the frequency axis, by frequency filters.

    ``total`` (part, t) are sums over the cells at every sample. ``maps`` (mapped part, t', cell') are those of cells:
    means over blocks of samples and cells, in single precision.
    """

    total: np.ndarray
    maps: np.ndarray


def part_energies(
    velocity: np.ndarray,
    masses: ArrayLike,
    interval: float,
    edges: ArrayLike,
    stride: int = 1,
    memory: float = np.inf,
    mapped: Sequence[int] = (),
    sizes: tuple[int, int] = (1, 1),
) -> PartEnergies:
    """Return the kinetic energies of every part, from ``velocity`` (t, cell, dof) in m/s; maps of the parts ``mapped``.

    ``masses`` (dof,) are in kg, the ``interval`` of samples in s, ``edges`` (part + 1) in rad/s. Energies follow at
    every sample from as few values as the width of a part needs (see ``cosine_squares``). With a ``stride`` above 1 the
    last part, the region above the bands, is taken at every ``stride``-th sample or so and interpolated if it is wide;
    it has no map then. ``velocity`` may be a dataset; no more than ``memory`` bytes of it are read at once. Maps are
    means over blocks of ``sizes`` (samples, cells).
    """
    nt, cells, dofs = velocity.shape
    last = nt - 1
    bounds = np.searchsorted(np.pi * np.arange(nt) / (last * interval), edges)
    exact = [CosineSquares.zeros(int(low), int(high) - 1) for low, high in itertools.pairwise(bounds)]
    strided = None
    # Wide: a third of all cosines or more, whose exact energy takes transforms of two thirds of the record or more.
    if stride > 1 and 3 * (exact[-1].high - exact[-1].low) >= last:
        strided = _StridedSquares(exact.pop().low, last, stride)

    maps = np.empty((len(mapped), -(-nt // sizes[0]), -(-cells // sizes[1])), np.float32)
    # A signal is the sum of its transform times cosines, over ``last``: of this the square, times m/2.
    weights = np.asarray(masses) / (2 * last**2)
    transform = CosineTransform(nt, min(COLUMNS, cells))
    # Blocks hold whole columns of the maps.
    for block in blocks(maps.shape[2], 8 * dofs * nt * sizes[1], memory):
        held = np.asarray(velocity[:, block.start * sizes[1] : block.stop * sizes[1]])
        of_cells = {number: exact[number].of_columns(held.shape[1]) for number in mapped}
        # Mass by mass: in a run's memory the cells of one mass lie next to each other.
        for mass, first in itertools.product(range(dofs), range(0, held.shape[1], COLUMNS)):
            together = slice(first, first + COLUMNS)
            spectrum = transform(held[:, together, mass])
            # The first and the last cosine are their own mirror images: their amplitudes count half.
            spectrum[[0, -1]] *= 0.5
            for number, part in enumerate(exact):
                if number in of_cells:
                    of_cells[number].add_to_columns(spectrum, weights[mass], together)
                else:
                    part.add(spectrum, weights[mass])
            if strided:
                strided.add(spectrum, weights[mass])

        for row, number in enumerate(mapped):
            exact[number].add_columns_of(of_cells[number])
            maps[row, :, block] = _means_over_samples(of_cells[number].cosines(), last, *sizes)

    total = _at_samples([part.cosines() for part in exact], last)
    if strided:
        total = np.vstack([total, strided.at_samples()])
    return PartEnergies(total, maps)


class _StridedSquares:
    """Sums over signals of their squares, at about every ``stride``-th sample.

    Signals have the cosines from ``low`` half waves in the record on; ``last`` is the number of the last sample. The
    squares are taken at the ends of ``_steps`` equal intervals, a number that has a fast transform.
    """

    def __init__(self, low: int, last: int, stride: int) -> None:
        self._low = low
        self._last = last
        self._steps = min(fft.next_fast_len(-(-last // stride), real=True), last)
        self._sums = np.zeros(self._steps + 1)

    def add(self, spectrum: np.ndarray, weight: float) -> None:
        """Add the squares of signals with amplitudes ``spectrum`` (wave from 0, signal), ``weight`` times."""
        signals = self._signals(spectrum)
        self._sums += weight * np.einsum("tn,tn->t", signals, signals)

    def _signals(self, spectrum: np.ndarray) -> np.ndarray:
        """Return signals (t', signal) with amplitudes ``spectrum`` (wave from 0, signal) at ``_steps`` + 1 even times.

        At these times cosines whose numbers of half waves differ by twice the steps have the same values, as have
        those whose numbers add up to it: their amplitudes are added up ("folded") before the transform.
        """
        steps = self._steps
        folded = np.zeros((steps + 1, spectrum.shape[1]))
        for start in range(self._low - self._low % steps, len(spectrum), steps):
            piece = spectrum[max(start, self._low) : start + steps]
            first = max(self._low - start, 0)
            if start // steps % 2:  # every second piece runs backwards: its last number has the least alias
                piece = piece[::-1]
                first = steps - first - len(piece) + 1
            folded[first : first + len(piece)] += piece
        folded[1:-1] *= 0.5
        return CosineTransform(*folded.shape)(folded)

    def at_samples(self) -> np.ndarray:
        """Return the sums at every sample, interpolated."""
        return np.interp(np.linspace(0, self._steps, self._last + 1), np.arange(self._steps + 1), self._sums)


def _at_samples(energies: Sequence[Cosines], last: int) -> np.ndarray:
    """Return the values (energy, sample) of ``energies`` of one column each at ``last`` + 1 even times, from 0 on."""
    amplitudes = np.zeros((last + 1, len(energies)))
    for column, energy in enumerate(energies):
        # At the samples, cosines have equal values if their numbers of half waves, or those numbers with the opposite
        # sign, differ by a multiple of twice ``last``. One of these cosines has ``last`` half waves at most.
        aliases = last - np.abs(energy.wave % (2 * last) - last)
        amplitudes[:, column] = np.bincount(aliases, energy.amplitude[:, 0], last + 1)
    amplitudes[1:-1] *= 0.5
    return np.maximum(CosineTransform(*amplitudes.shape)(amplitudes).T, 0.0)


def _means_over_samples(energy: Cosines, last: int, samples: int, cells: int) -> np.ndarray:
    """Return means (t', cell') of an ``energy`` (wave, cell) over blocks of ``samples`` and ``cells``.

    The record has ``last`` + 1 samples; its last block may be shorter.
    """
    amplitude = block_means(energy.amplitude, cells, 1)
    radians = np.pi * energy.wave / last  # of a wave in a sample
    first = np.arange(0, last + 1, samples)
    counts = np.minimum(samples, last + 1 - first)
    # The mean of a cosine over n even times is its value in their middle times sin(n x/2)/(n sin(x/2)), Dirichlet's
    # kernel, with x radians from one time to the next.
    middles = np.cos(np.outer(first + (counts - 1) / 2, radians))
    means = middles * diric(radians, samples)
    means[-1] = middles[-1] * diric(radians, counts[-1])
    return np.maximum(means @ amplitude, 0.0)


def ibtet(energy: np.ndarray, above: np.ndarray, start: int = 0) -> float:
    """Return the inter-band targeted energy transfer: mean share of the parts ``above`` (part) the driven one.

    ``energy`` (part, t) is in J; the mean is over the samples from ``start`` on at which anything moves. At a sample
    the fraction is that of the sum over all parts: the paper's (E_3 + E_4)/E_total for the four-band lattice driven on
    band 2. NaN if no part is above, or nothing moves.
    """
    total = energy[:, start:].sum(axis=0)
    moving = total > 0
    if not above.any() or not moving.any():
        return float("nan")
    transferred = energy[above, start:].sum(axis=0)
    return float(np.mean(transferred[moving] / total[moving]))
