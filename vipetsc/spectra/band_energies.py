"""Energies of the pass bands, the gaps and the region above, by frequency filters over all wavenumbers.

A filter that lets every wavenumber through acts along time alone, so no transform in space is needed. The
record is continued by its mirror image (a cosine transform): it then has no jump where its end meets its
start, which would leak about 1e-4 of the driven band's energy into all the others.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft
from scipy.special import diric

from vipetsc.lattice import Band
from vipetsc.spectra.cosine_transform import cosine_transform
from vipetsc.spectra.pooling import block_means, blocks

# Histories of masses that are transformed together. Those of 4,421 samples are 1 MB, the size of a core's cache: from
# 16 to 128 the time is the same, with 8 it is a sixth more.
COLUMNS = 32


@dataclass(frozen=True)
class Parts:
    """A partition of all frequencies: ``edges`` (part + 1) in rad/s from 0 to infinity, a name for each part.

    ``bands`` names for each part the pass bands in it (1-based numbers), () for a gap and for the region
    above the top band; pass bands that overlap are one part.
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
        """Whether each of the parts (part) is a pass band above the one driven at ``frequency`` (rad/s)."""
        driven = int(np.searchsorted(self.edges, frequency, side="right")) - 1
        return np.array([bool(b) and i > driven for i, b in enumerate(self.bands)])


class PartEnergies(NamedTuple):
    """Kinetic energies in J of parts of the frequency axis, by frequency filters.

    ``total`` (part, t) are summed over the cells, ``maps`` (mapped part, t', cell') means over blocks of samples and
    cells, in single precision.
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
    """Kinetic energies of every part, from ``velocity`` (t, cell, dof) in m/s; maps of the parts ``mapped``.

    The energy of a part from the frequency low to high has frequencies up to high - low and between 2 low and 2 high.
    It is computed at as few even times as tell these apart (the filtered spectrum is folded onto them), which gives it
    at every sample. A last part that is too wide for that, the region above the bands, is taken at every ``stride``-th
    and interpolated; it has no map. ``velocity`` may be stored; no more than ``memory`` bytes of it are read at once.
    Maps are means over blocks of ``sizes`` (samples, cells).
    """
    nt, cells, dofs = velocity.shape
    last = nt - 1
    bounds = np.searchsorted(np.pi * np.arange(last + 1) / (last * interval), edges)
    parts = [_Cosines(int(low), int(high) - 1) for low, high in itertools.pairwise(bounds)]
    steps = [_fewest_steps(part, last, stride=1) for part in parts[:-1]]
    steps.append(_fewest_steps(parts[-1], last, stride))

    energies = [np.zeros(count + 1) for count in steps]
    maps = np.empty((len(mapped), -(-nt // sizes[0]), -(-cells // sizes[1])), np.float32)
    weights = np.asarray(masses) / (8 * last**2)
    # Blocks hold whole columns of the maps.
    for block in blocks(maps.shape[2], 8 * dofs * nt * sizes[1], memory):
        held = np.asarray(velocity[:, block.start * sizes[1] : block.stop * sizes[1]])
        of_cells = {number: np.zeros((steps[number] + 1, held.shape[1])) for number in mapped}
        # Mass by mass: the cells of one lie together where runs in memory hold them.
        for mass, first in itertools.product(range(dofs), range(0, held.shape[1], COLUMNS)):
            together = slice(first, first + COLUMNS)
            spectrum = cosine_transform(held[:, together, mass])
            # The first and the last cosine are their own mirror images: their amplitudes count half.
            spectrum[[0, -1]] *= 0.5
            for number, (energy, part) in enumerate(zip(energies, parts, strict=True)):
                filtered = _folded(spectrum[part.low : part.high + 1], part.low, steps[number])
                energy += weights[mass] * np.einsum("tc,tc->t", filtered, filtered)
                if number in of_cells:
                    of_cells[number][:, together] += weights[mass] * filtered**2

        for row, number in enumerate(mapped):
            columns = block_means(of_cells[number], sizes[1], 1)
            maps[row, :, block] = _means_over_samples(columns, parts[number], last, sizes[0])

    total = [_at_samples(energy, part, last) for energy, part in zip(energies, parts, strict=True)]
    return PartEnergies(np.array(total), maps)


class _Cosines(NamedTuple):
    """The cosines ``low`` to ``high``, in half waves in the record, that a part lets through; none if high < low."""

    low: int
    high: int


def _looks_like(wave: Any, steps: int) -> Any:
    """The cosine (half waves in the record) that equals ``wave`` at ``steps`` + 1 even times."""
    return steps - np.abs(wave % (2 * steps) - steps)


def _fewest_steps(part: _Cosines, most: int, stride: int) -> int:
    """Fewest even steps, a fast length up to ``most``, that tell apart the cosines in the energy of a ``part``.

    These are 0 to high - low and 2 low to 2 high (products of cosines). most/``stride`` where no number of steps below
    ``most`` does.
    """
    width = part.high - part.low
    low = 2 * part.low
    high = 2 * part.high
    steps = fft.next_fast_len(max(3 * width, 1), real=True)
    if steps >= most:
        if stride == 1:
            return most
        return min(fft.next_fast_len(-(-most // stride), real=True), most)

    while steps < min(high, most):
        # The cosines from low to high must not turn back within their range, nor fall on those up to ``width``.
        monotonic = low // steps == max(high - 1, low) // steps
        if monotonic and min(_looks_like(low, steps), _looks_like(high, steps)) > width:
            break
        steps = fft.next_fast_len(steps + 1, real=True)
    return min(steps, most)


def _folded(amplitudes: np.ndarray, low: int, steps: int) -> np.ndarray:
    """Twice the sum (t', n) of the cosines ``low``, ... with ``amplitudes`` (k, n), at ``steps`` + 1 even times."""
    folded = np.zeros((steps + 1, amplitudes.shape[1]))
    end = low + len(amplitudes)
    for start in range(low - low % steps, end, steps):
        piece = amplitudes[max(start - low, 0) : start + steps - low]
        first = max(low, start) - start
        if start // steps % 2:  # every second piece runs backwards
            piece = piece[::-1]
            first = steps - first - len(piece) + 1
        folded[first : first + len(piece)] += piece
    folded[[0, -1]] *= 2.0
    return cosine_transform(folded)


def _at_samples(energy: np.ndarray, part: _Cosines, last: int) -> np.ndarray:
    """Energy of a ``part`` at ``last`` + 1 even times, from those (t') of ``_fewest_steps``."""
    steps = len(energy) - 1
    width = part.high - part.low
    if steps == last or width < 0:
        return np.resize(energy, last + 1)
    if 3 * width > steps and steps < 2 * part.high:  # too wide: cosines are not distinguished
        return np.interp(np.linspace(0, steps, last + 1), np.arange(steps + 1), energy)

    waves, amplitudes = _waves_of_energy(energy, part)
    spread = np.bincount(_looks_like(waves, last), amplitudes, last + 1)
    return np.maximum(_folded(spread[:, None], 0, last)[:, 0], 0.0)


def _waves_of_energy(energy: np.ndarray, part: _Cosines) -> tuple[np.ndarray, np.ndarray]:
    """The cosines (wave) in the ``energy`` (t', ...) of a ``part`` at few even times, and half of their amplitudes."""
    width = part.high - part.low
    steps = len(energy) - 1
    waves = np.union1d(np.arange(width + 1), np.arange(2 * part.low, 2 * part.high + 1))
    amplitudes = fft.dct(energy, type=1, axis=0) / (2 * steps)
    amplitudes[[0, -1]] *= 0.5
    # Each amplitude at few times goes to the cosine of the energy that it stands for.
    return waves, amplitudes[_looks_like(waves, steps)]


def _means_over_samples(energy: np.ndarray, part: _Cosines, last: int, size: int) -> np.ndarray:
    """Means over each ``size`` of ``last`` + 1 samples of the ``energy`` (t', cell) of a ``part`` at few even times."""
    if part.high < part.low:
        return np.zeros((-(-(last + 1) // size), energy.shape[1]))
    if len(energy) == last + 1:
        return block_means(energy, size, 0)

    waves, amplitudes = _waves_of_energy(energy, part)
    radians = np.pi * waves / last  # of a wave in a sample
    first = np.arange(0, last + 1, size)
    counts = np.minimum(size, last + 1 - first)
    # The mean of a cosine over even times is its value at their middle times Dirichlet's kernel.
    middles = np.cos(np.outer(first + (counts - 1) / 2, radians))
    means = middles * diric(radians, size)
    means[-1] = middles[-1] * diric(radians, counts[-1])
    return np.maximum(2 * means @ amplitudes, 0.0)


def front_arrival(energy: np.ndarray) -> int:
    """First sample at which ``energy`` (t) of one cell exceeds 1 % of its largest value."""
    return int(np.argmax(energy > 0.01 * energy.max()))


def ibtet(energy: np.ndarray, above: np.ndarray, start: int = 0) -> float:
    """Inter-band targeted energy transfer: fraction of energy in the parts ``above`` (part), mean from ``start`` on.

    ``energy`` (part, t) in J. The fraction is that of the sum of all parts at every sample, as the paper's
    (E_3 + E_4)/E_total of the four-band lattice driven on band 2; for any other cell the bands above the
    driven one take the place of 3 and 4. NaN when there are none, or no energy.
    """
    total = energy[:, start:].sum(axis=0)
    moving = total > 0
    if not above.any() or not moving.any():
        return float("nan")
    transferred = energy[above, start:].sum(axis=0)
    return float(np.mean(transferred[moving] / total[moving]))
