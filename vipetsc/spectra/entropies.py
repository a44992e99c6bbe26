"""Space-wavenumber entropy of a lattice's velocity, and its averages over a run (the paper's Sec. II C, Eq. (6)).

With the Morlet transform X (kappa, x) of a snapshot (``vipetsc.spectra.wavelet``) and its power S = |X|^2::

    W(x) = sum_kappa S,   P = S/W,   H(x) = -sum_kappa P log2 P = log2 W - (1/W) sum_kappa S log2 S    (a)
    energy-weighted   H(t) = sum_x Q H,   Q = W / sum_x W                                              (b)
    joint over kappa and x   H_j(t) = H(t) - sum_x Q log2 Q                                            (c)
    masked   the mean of H over the points (x, t) with W > .01 max W                                   (d)

A filtered snapshot holds positive wavenumbers alone, so its spectrum folded onto every n-th wavenumber of the padded
line gives it at every n-th cell without loss; only the sums over x are then sums over fewer cells.

Averages are taken from the linear wave's arrival on. A plain mean over all points shows no trend: cells at rest would
count in it as much as the others.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import fft
from scipy.ndimage import uniform_filter1d

from vipetsc.compiled import njit
from vipetsc.spectra.wavelet import padded_length, transform_filters

NODES = 60
KC = 12.0  # centre wavenumber of the wavelets
CHUNK = 8  # snapshots that are transformed together
GROUP = 8  # nodes that are filtered together
LOUD = 8  # snapshots that are sought for the largest weight, by their energy over as many cells
FLOOR = 0.01
"""Points below this fraction of the largest weight are masked, Eq. (d)."""


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
    """Entropy of ``velocity`` (t, cell) in m/s with wavelets at the NODES wavenumbers i pi/NODES, i = 1, 2, ...

    ``velocity`` may be an HDF5 dataset: a few snapshots at a time are read. ``start`` is the sample of the linear
    wave's arrival at the first site. Every ``every``-th sample is transformed, and every ``stride``-th cell averaged
    over; the largest weight of Eq. (d) is sought in the other samples too. Raises ValueError if no sample comes from
    ``start`` on, or one is not finite.
    """
    nt = len(velocity)
    if not 0 <= start < nt:
        raise ValueError(f"start = {start}: outside the {nt} samples")
    local, weight = local_entropy(velocity[::every], stride)
    largest = 0.0
    if every > 1:
        energy = uniform_filter1d(np.square(velocity[start:]), LOUD, axis=1).max(axis=1)
        largest = local_entropy(velocity[start:][np.argsort(energy)[-LOUD:]], stride)[1].max()
    return averages(local, weight, min(-(-start // every), len(local) - 1), stride, largest)


def averages(local: np.ndarray, weight: np.ndarray, start: int, stride: int, largest: float = 0.0) -> Entropy:
    """The averages of ``local`` and ``weight`` (t, cell) of every ``stride``-th cell; ``largest`` of other weights."""
    # Eqs. (b) and (c) over the cells of each snapshot.
    peak = weight.max(axis=1, keepdims=True)
    share = np.divide(weight, peak, out=np.zeros_like(weight), where=peak > 0)
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1.0)
    snapshot = np.einsum("tc,tc->t", share, local)
    position = -np.sum(share * np.log2(share, out=np.zeros_like(share), where=share > 0), axis=1)
    joint = snapshot + np.where(peak[:, 0] > 0, position + np.log2(stride), 0.0)  # bits of the cells between
    means = float(snapshot[start:].mean()), float(joint[start:].mean())
    # Eq. (d), of all cells and of each.
    above_threshold = weight[start:] > FLOOR * max(weight[start:].max(), largest)
    count = above_threshold.sum(axis=0)
    sums = np.where(above_threshold, local[start:], 0.0).sum(axis=0)
    counted = count > 0
    if not counted.any():
        return Entropy(local, weight, snapshot, *means, masked=0.0, error=0.0)
    of_cells = sums[counted] / count[counted]
    return Entropy(local, weight, snapshot, *means, float(sums.sum() / count.sum()), float(np.std(of_cells)))


def local_entropy(velocity: np.ndarray, stride: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """H (t, cell) in bits and W (t, cell) at every ``stride``-th cell of ``velocity`` (t, cell), in chunks of time.

    Every snapshot is scaled by a power of two before and after, so H does not depend on the amplitude.
    """
    nt, cells = velocity.shape
    local, weight = np.empty((2, nt, -(-cells // stride)))
    for first in range(0, nt, CHUNK):
        rows = slice(first, min(first + CHUNK, nt))
        signal = np.asarray(velocity[rows], dtype=float)
        largest = np.abs(signal).max(axis=1)
        if not np.all(np.isfinite(largest)):
            raise ValueError(f"velocity: not finite in samples {first} to {rows.stop - 1}")
        exponent = np.frexp(largest)[1]
        signal = np.ldexp(signal, -exponent[:, None])
        total, s_log_s = np.zeros((2, len(signal), local.shape[1]))
        for length, groups in _octaves(cells, stride):
            spectrum = fft.rfft(signal, length * stride)
            for filters in groups:
                x = np.zeros((len(signal), len(filters[0][1]), length), dtype=complex)
                for band, values in filters:
                    first = band.start % length
                    x[:, :, first : first + values.shape[1]] += spectrum[:, None, band] * values
                _accumulate(fft.ifft(x, overwrite_x=True), total, s_log_s)
        _entropies(total, s_log_s, local[rows])
        weight[rows] = np.ldexp(total, 2 * exponent[:, None])
    return local, weight


@lru_cache(maxsize=8)
def _octaves(cells: int, stride: int) -> list[tuple[int, list[list[tuple[slice, np.ndarray]]]]]:
    """For each octave of nodes the transforms' length, the padded one over ``stride``, and its filters.

    The lowest node sets the padded length. The filters come in groups: the bands where any of them lets something
    through, cut at multiples of the length, and what they are there (kappa, k).
    """
    kappa = np.pi * np.arange(1, NODES + 1) / NODES
    octaves = []
    for number in range(int(np.log2(NODES)) + 1):
        some = kappa[2**number - 1 : 2 ** (number + 1) - 1]
        length, groups = fft.next_fast_len(-(-padded_length(cells, KC, some[0]) // stride)), []
        filters = transform_filters(some, KC, length * stride) / stride
        for first in range(0, len(some), GROUP):
            group = filters[first : first + GROUP]
            inside = np.flatnonzero(group.max(axis=0) > np.finfo(float).eps * group.max())
            cuts = range(inside[0] // length * length, inside[-1] + 1, length)
            bands = [slice(max(inside[0], cut), min(inside[-1] + 1, cut + length)) for cut in cuts]
            groups.append([(band, group[:, band]) for band in bands])
        octaves.append((length, groups))
    return octaves


@njit("void(c16[:,:,::1], f8[:,::1], f8[:,::1])", error_model="numpy", fastmath={"contract"})
def _accumulate(x: np.ndarray, weight: np.ndarray, s_log_s: np.ndarray) -> None:
    """Add the sums of Eq. (a), S and S log2 S of the nodes of ``x`` (t, kappa, x), to arrays (t, cell).

    The logarithm is written out so that the loop is vectorised, four times as fast as calls of log2: S = 2^e m
    with sqrt(1/2) <= m < sqrt(2), ln m = 2 u + u z R(z), u = (m - 1)/(m + 1), z = u^2, with the minimax R of
    fdlibm's e_log.c (error below 2^-58).
    """
    cells = weight.shape[1]
    power, mantissa = np.empty(cells), np.empty(cells)
    bits, mantissa_bits = power.view(np.int64), mantissa.view(np.int64)
    for t in range(x.shape[0]):
        for k in range(x.shape[1]):
            for c in range(cells):
                z = x[t, k, c]
                power[c] = z.real * z.real + z.imag * z.imag + 1e-300
            for c in range(cells):
                e = (bits[c] - 0x3FE6A09E667F3BCD) >> 52
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


@njit("void(f8[:,::1], f8[:,::1], f8[:,::1])")
def _entropies(weight: np.ndarray, s_log_s: np.ndarray, local: np.ndarray) -> None:
    """Eq. (a) from its sums, kept from rounding below zero; W and H are 0 where S stands at its floor."""
    for t in range(weight.shape[0]):
        for c in range(weight.shape[1]):
            w = weight[t, c]
            if w > 1e-290:
                local[t, c] = max(np.log2(w) - s_log_s[t, c] / w, 0.0)
            else:
                weight[t, c] = local[t, c] = 0.0
