"""Space-wavenumber entropy of a lattice's velocity, and its averages over a run (the paper's Sec. II C, Eq. (6)).

With the Morlet transform X (kappa, x) of a snapshot (``vipetsc.spectra.wavelet``) and its power S = |X|^2::

    W(x) = sum_kappa S,   P = S/W,   H(x) = -sum_kappa P log2 P = log2 W - (1/W) sum_kappa S log2 S    (a)
    energy-weighted   H(t) = sum_x Q H,   Q = W / sum_x W                                              (b)
    joint over kappa and x   H_j(t) = H(t) - sum_x Q log2 Q                                            (c)
    masked   the mean of H over the points (x, t) with W > 0.01 max W                                   (d)

X is often needed at every n-th cell alone. There, exp(i kappa x) is the same for wavenumbers that differ by 2 pi/n: a
filtered spectrum is added up over these ("folded") before its inverse transform, which is n times shorter. The values
of X are exact; only the sums over x have fewer cells.

Averages are taken from the arrival of the linear wave's peak on. They are weighted by the energy, or leave out cells at
rest: in a plain mean over all points these would count as much as the others, and the mean shows no trend with the
amplitude.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np
from scipy import fft
from scipy.ndimage import uniform_filter1d

from vipetsc.compiled import kernel
from vipetsc.spectra.wavelet import padded_length, transform_filters

# The number of wavenumbers at which wavelets are taken, and their centre wavenumber. The paper states neither. An
# entropy depends on both, so that they are the same for all runs.
NODES = 60
KC = 12.0
# Snapshots that are transformed together, and nodes that are filtered together: for 300 cells such an array just fits
# into a core's cache. 8 snapshots take 10 % more time, 32 the same; 16 nodes and 32 snapshots take twice the time.
CHUNK = 16
GROUP = 8
# The largest weight of a run is sought in so many snapshots: those with the largest energy in any window of so many
# cells. In the built-in run 2 and 32 find the same weight.
STRONGEST = 8
FLOOR = 0.01
"""Points below this fraction of the largest weight are masked, Eq. (d)."""


class LocalEntropy(NamedTuple):
    """H of Eq. (a) in bits, ``local`` (t, cell), and W in the signal's unit squared, ``weight`` (t, cell)."""

    local: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Entropy:
    """Entropies in bits over the wavenumber nodes; the means are over the samples from ``start`` on.

    ``local`` H and ``weight`` W (t, cell) of Eq. (a) at the cells taken, 0 where nothing moves (W in the signal's unit
    squared); ``snapshot`` (t) of Eq. (b), 0 at rest, and its mean ``energy_weighted``; ``joint``, the mean of Eq. (c);
    ``masked``, Eq. (d), with the standard deviation ``error`` over the cells of each one's masked time mean.
    """

    local: np.ndarray
    weight: np.ndarray
    snapshot: np.ndarray
    energy_weighted: float
    joint: float
    masked: float
    error: float


def entropy(velocity: np.ndarray, start: int = 0, stride: int = 1, every: int = 1) -> Entropy:
    """Return entropy of ``velocity`` (t, cell) in m/s with wavelets at the NODES wavenumbers i pi/NODES, i = 1, 2, ...

    ``start`` is the sample at which the linear wave's peak is at the first site. Every ``every``-th sample is
    transformed (a snapshot), and every ``stride``-th cell averaged over; the largest weight of Eq. (d) is sought in the
    other samples too. Raises ValueError if ``start`` is not a sample, or one is not finite.
    """
    nt = len(velocity)
    if not 0 <= start < nt:
        raise ValueError(f"start = {start}: outside the {nt} samples")
    snapshots = velocity[::every]
    # The threshold of Eq. (d) should not depend on which samples are snapshots.
    others = velocity[_strongest_others(velocity, start, every)]

    local, weight = local_entropy(np.concatenate([snapshots, others]), stride)
    largest = weight[len(snapshots) :].max(initial=0.0)
    local = local[: len(snapshots)]
    weight = weight[: len(snapshots)]

    arrival = min(-(-start // every), len(local) - 1)
    return averages(local, weight, arrival, stride, largest)


def _strongest_others(velocity: np.ndarray, start: int, every: int) -> np.ndarray:
    """Return the numbers of samples from ``start`` on in which the largest weight is sought, snapshots left out."""
    if every == 1:
        return np.zeros(0, int)
    energy = uniform_filter1d(np.square(velocity[start:]), STRONGEST, axis=1).max(axis=1)
    strongest = start + np.argsort(energy)[-STRONGEST:]
    return strongest[strongest % every != 0]


def averages(local: np.ndarray, weight: np.ndarray, start: int, stride: int, largest: float = 0.0) -> Entropy:
    """Return averages of ``local`` and ``weight`` (t, cell) of every ``stride``-th cell, from the sample ``start`` on.

    ``largest`` is the largest weight of samples that are not among them.
    """
    # Q of Eqs. (b) and (c) over the cells of each snapshot. Weights are divided by their peak first: they then neither
    # overflow nor underflow in a sum.
    peak = weight.max(axis=1, keepdims=True)
    fraction = np.divide(weight, peak, out=np.zeros_like(weight), where=peak > 0)
    # The sum over the cells is 1 or more if anything moves, and 0 at rest, where Q is 0.
    fraction /= np.maximum(fraction.sum(axis=1, keepdims=True), 1.0)
    snapshot = np.einsum("tc,tc->t", fraction, local)
    log_fraction = np.log2(fraction, out=np.zeros_like(fraction), where=fraction > 0)
    position = -np.sum(fraction * log_fraction, axis=1)
    # Each cell stands for ``stride`` cells of equal weight, which have log2(stride) bits of position more.
    joint = snapshot + np.where(peak[:, 0] > 0, position + np.log2(stride), 0.0)

    # Eq. (d), of all cells and of each.
    above_threshold = weight[start:] > FLOOR * max(weight[start:].max(), largest)
    count = above_threshold.sum(axis=0)
    sums = np.where(above_threshold, local[start:], 0.0).sum(axis=0)
    counted = count > 0
    masked = 0.0
    error = 0.0
    if counted.any():
        masked = float(sums.sum() / count.sum())
        error = float(np.std(sums[counted] / count[counted]))

    return Entropy(
        local=local,
        weight=weight,
        snapshot=snapshot,
        energy_weighted=float(snapshot[start:].mean()),
        joint=float(joint[start:].mean()),
        masked=masked,
        error=error,
    )


def local_entropy(velocity: np.ndarray, stride: int = 1) -> LocalEntropy:
    """Return H (t, cell) in bits and W (t, cell) at every ``stride``-th cell of ``velocity`` (t, cell), chunk by chunk.

    Every snapshot is scaled by a power of two before and after, so H does not depend on the amplitude. Raises
    ValueError for a sample that is not finite.
    """
    nt, cells = velocity.shape
    local, weight = np.empty((2, nt, -(-cells // stride)))
    for first in range(0, nt, CHUNK):
        rows = slice(first, min(first + CHUNK, nt))
        signal = np.asarray(velocity[rows], dtype=float)
        largest = np.abs(signal).max(axis=1)
        if not np.all(np.isfinite(largest)):
            raise ValueError(f"velocity: not finite in samples {first} to {rows.stop - 1}")
        # A power of two changes no digit.
        exponent = np.frexp(largest)[1]
        signal = np.ldexp(signal, -exponent[:, None])

        total, s_log_s = np.zeros((2, len(signal), local.shape[1]))
        for octave in _octaves(cells, stride):
            for x in octave.transforms(signal):
                _accumulate(x, total, s_log_s)

        _entropies(total, s_log_s, local[rows])
        weight[rows] = np.ldexp(total, 2 * exponent[:, None])
    return LocalEntropy(local, weight)


class _Filters(NamedTuple):
    """The ``values`` (kappa, k) of the filters of some nodes at consecutive wavenumbers k of a transform.

    ``first`` is the number of the first of these wavenumbers; at all others the filters let nothing through.
    """

    first: int
    values: np.ndarray

    @classmethod
    def of(cls, filters: np.ndarray) -> Self:
        """Return the ``filters`` (kappa, k) from the first to the last wavenumber that any lets through."""
        # Whatever does not exceed the rounding of the largest value lets nothing through.
        inside = np.flatnonzero(filters.max(axis=0) > np.finfo(float).eps * filters.max())
        first = int(inside[0])
        return cls(first=first, values=np.ascontiguousarray(filters[:, first : inside[-1] + 1]))


class _Octave(NamedTuple):
    """An octave of nodes, whose wavelet transforms have one padding.

    A signal is transformed with the length ``padded``; the inverse transform, at every ``stride``-th cell, has the
    ``length`` padded/stride. ``groups`` are the filters of nodes that are filtered together.
    """

    padded: int
    length: int
    groups: list[_Filters]

    def transforms(self, signal: np.ndarray) -> Iterator[np.ndarray]:
        """Yield X (t, kappa, cell) at every ``stride``-th cell of the padded ``signal`` (t, cell), group by group."""
        spectrum = fft.rfft(signal, self.padded)
        for group in self.groups:
            x = np.empty((len(signal), len(group.values), self.length), dtype=complex)
            _filter(spectrum, group.first, group.values, x)
            # Transforms "forward" are the ones that are divided by the length: here the filters are.
            yield fft.ifft(x, norm="forward", overwrite_x=True)


@lru_cache(maxsize=8)
def _octaves(cells: int, stride: int) -> list[_Octave]:
    """Return the octaves of the nodes for lattices of ``cells``, of which every ``stride``-th one is needed."""
    kappa = np.pi * np.arange(1, NODES + 1) / NODES
    octaves: list[_Octave] = []
    # Wavelets of higher nodes are shorter: the padding of an octave is that of its lowest node.
    for number in range(int(np.log2(NODES)) + 1):
        nodes = kappa[2**number - 1 : 2 ** (number + 1) - 1]
        length = fft.next_fast_len(-(-padded_length(cells, KC, nodes[0]) // stride))
        padded = length * stride
        # The inverse transforms are not divided by the length of the line.
        filters = transform_filters(nodes, KC, padded) / padded

        groups = [_Filters.of(filters[first : first + GROUP]) for first in range(0, len(nodes), GROUP)]
        octaves.append(_Octave(padded=padded, length=length, groups=groups))
    return octaves


@kernel
def _filter(spectrum: np.ndarray, first: int, values: np.ndarray, x: np.ndarray) -> None:
    """Write a ``spectrum`` (t, k) times the ``values`` (kappa, k) of filters to ``x`` (t, kappa, k).

    The first of the values belongs to the column ``first`` of the spectrum. Columns that differ by a multiple of the
    number of columns of ``x`` are added up ("folded"). The kernel gets whole arrays, which are contiguous: for views of
    them it would be compiled once more.
    """
    length = x.shape[2]
    end = first + values.shape[1]
    begin = first // length * length
    for t in range(x.shape[0]):
        for i in range(x.shape[1]):
            x[t, i, : first - begin] = 0.0
            x[t, i, min(end - begin, length) :] = 0.0
            for cut in range(begin, end, length):
                low = max(first, cut)
                high = min(end, cut + length)
                unfiltered = spectrum[t, low:high]
                factors = values[i, low - first : high - first]
                filtered = x[t, i, low - cut : high - cut]
                for k in range(high - low):
                    z = unfiltered[k]
                    value = factors[k]
                    # Part by part: a real factor would be multiplied as a complex one, which takes longer.
                    product = complex(z.real * value, z.imag * value)
                    if cut > begin:
                        product += filtered[k]
                    filtered[k] = product


@kernel(fastmath={"contract"})
def _accumulate(x: np.ndarray, weight: np.ndarray, s_log_s: np.ndarray) -> None:
    """Add the sums of Eq. (a) over the nodes of ``x`` (t, kappa, cell), of S and of S log2 S, to arrays (t, cell).

    The logarithm is written out so that the loop is vectorised, which is four times as fast as calls of log2: with
    S = 2^e m, sqrt(1/2) <= m < sqrt(2), u = (m - 1)/(m + 1) and z = u^2 it is e + (2 u + u z R(z))/ln 2, with the
    minimax polynomial R of fdlibm's e_log.c (error below 2^-58).
    """
    cells = weight.shape[1]
    power = np.empty(cells)
    mantissa = np.empty(cells)
    # The same memory as integers, whose upper bits are the exponents of the numbers.
    bits = power.view(np.int64)
    mantissa_bits = mantissa.view(np.int64)
    for t in range(x.shape[0]):
        for k in range(x.shape[1]):
            for c in range(cells):
                z = x[t, k, c]
                power[c] = z.real * z.real + z.imag * z.imag + 1e-300  # S log2 S is 0 at S = 0
            for c in range(cells):
                e = (bits[c] - 0x3FE6A09E667F3BCD) >> 52  # the bits of sqrt(1/2)
                mantissa_bits[c] = bits[c] - (e << 52)
                u = (mantissa[c] - 1.0) / (mantissa[c] + 1.0)
                z = u * u
                r = 1.479819860511658591e-01
                r = r * z + 1.531383769920937332e-01
                r = r * z + 1.818357216161805012e-01
                r = r * z + 2.222219843214978396e-01
                r = r * z + 2.857142874366239149e-01
                r = r * z + 3.999999999940941908e-01
                r = r * z + 6.666666666666735130e-01
                weight[t, c] += power[c]
                s_log_s[t, c] += power[c] * (e + 1.4426950408889634 * (2.0 * u + u * z * r))


@kernel
def _entropies(weight: np.ndarray, s_log_s: np.ndarray, local: np.ndarray) -> None:
    """Write H of Eq. (a) to ``local`` (t, cell), at least 0, from the sums ``weight`` and ``s_log_s`` (t, cell).

    Where nothing moves the weight has only the numbers 1e-300 that ``_accumulate`` adds: H and W are set to 0 there.
    """
    for t in range(weight.shape[0]):
        for c in range(weight.shape[1]):
            w = weight[t, c]
            if w > 1e-290:
                local[t, c] = max(np.log2(w) - s_log_s[t, c] / w, 0.0)
            else:
                weight[t, c] = local[t, c] = 0.0
