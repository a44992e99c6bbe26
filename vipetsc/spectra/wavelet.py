"""Morlet wavelets in space: transform, inverse per wavenumber bin, the equivalent bank of FFT filters, bin energies.

The paper's Eqs. (A4)-(A7), corrected to be consistent: in the space of the wavenumbers eta the wavelet of the node
kappa is Psi(kc eta/kappa) with Psi(s) = exp(-(s - kc)^2 / 2), over 0 < eta <= pi alone. In space it is a wave exp(i
kappa x) in a Gaussian envelope, of which one standard deviation holds kc radians of the wave. A real signal is twice
the real part of its components of positive wavenumber; eta = pi belongs to both signs and counts half on either.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from vipetsc.spectra.pooling import block_means

# Of waves of 48 cells the first bin then has 99.7 % of the energy, and a line of 300 cells is padded to 1280. With half
# of it these are 99.9 % and 2250, with twice 78 % and 800. The other bins change by 2e-4 of the energy at most.
LOWEST = np.pi / 60
"""Lowest node in rad per cell; wavenumbers below it belong to the first bin."""

BINS = 12  # wavenumber bins of equal width in [0, pi]
# Nodes an octave. Bins begin between nodes: next to the bounds of the bins the filters differ from those of ever more
# nodes by 0.8 % with 256, by 1.1 % with 128, by 2.4 % with 64. Filters are computed once, in 0.01 s.
VOICES = 256
CHUNK = 16  # snapshots that are partitioned together: with 4 a fifth slower, with 64 a tenth, in twice the memory


@dataclass(frozen=True)
class Nodes:
    """Nodes of the transform: ``kappa`` (node) in rad per cell on a log grid, ``weight`` dkappa/kappa of each."""

    kappa: np.ndarray
    weight: float

    @classmethod
    def log(cls, kc: float, voices: float = VOICES) -> Self:
        """Return nodes from pi/60 to pi (1 + 4/kc), both included, ``voices`` an octave or a few more.

        Higher nodes would add less than 0.1 % to the sum of the filters at eta = pi (kc = 6). Raises ValueError below
        0.65 kc voices, where the sum over the nodes would ripple.
        """
        if voices < 0.65 * kc:
            raise ValueError(f"voices = {voices}: kc = {kc} needs at least {0.65 * kc:.3g} an octave")
        ratio = np.pi * (1 + 4 / kc) / LOWEST
        steps = int(np.ceil(voices * np.log2(ratio)))
        kappa = LOWEST * ratio ** (np.arange(steps + 1) / steps)
        return cls(kappa=kappa, weight=float(np.log(ratio) / steps))

    @property
    def bins(self) -> np.ndarray:
        """Number (node,), from 0, of the bin of every node; the edges are k pi/BINS, nodes above pi are in the last."""
        return np.minimum((self.kappa * BINS / np.pi).astype(int), BINS - 1)


def wavelet_spectrum(kappa: ArrayLike, kc: float, eta: ArrayLike) -> np.ndarray:
    """Return Psi(kc eta/kappa) (kappa, eta), zero for eta <= 0.

    Raises ValueError for ``kc`` below 5: the uncorrected Morlet wavelet then has weight at eta = 0.
    """
    if kc < 5:
        raise ValueError(f"kc = {kc}: the Morlet wavelet is admissible from 5 on")
    eta = np.asarray(eta, dtype=float)
    s = kc * eta / np.asarray(kappa)[..., None]
    return np.where(eta > 0, np.exp(-0.5 * (s - kc) ** 2), 0.0)


@lru_cache
def constant(kc: float) -> float:
    """Return C = integral of |Psi(kc e^x)|^2 over x from log(1e-3) on, by the trapezoidal rule.

    The rule is exact to rounding for a smooth bell that has fallen to nothing at both ends. At the upper end the
    integrand is exp(-49). At the lower one, and on to x = -infinity, it is exp(-kc^2): 2e-16 for the kc = 6 of the
    partition, 1e-11 for the smallest kc that is allowed.
    """
    x = np.linspace(np.log(1e-3), np.log(1 + 7 / kc), 4001)
    return float(np.sum(np.exp(-((kc * np.exp(x) - kc) ** 2))) * (x[1] - x[0]))


def padded_length(cells: int, kc: float, lowest: float = LOWEST) -> int:
    """Return transform length that keeps ``cells`` apart from their periodic images, the next that is fast.

    Room is left for the wavelet of the node ``lowest`` (rad per cell), until its Gaussian envelope
    exp(-(lowest x / kc)^2 / 2) is below rounding. Within the first ``cells`` the transform is then that of the lattice
    with rest on either side. Wavelets that are cut at eta = pi fall off as 1/x only: their tails, below 1/(pi x), do
    reach the images.
    """
    reach = np.sqrt(-2 * np.log(np.finfo(float).eps)) * kc / lowest
    return fft.next_fast_len(cells + int(np.ceil(reach)), real=True)


def wavenumbers(length: int) -> np.ndarray:
    """Return wavenumbers (k) in rad per cell of a real Fourier transform of so many cells (``length``)."""
    return 2 * np.pi * np.arange(length // 2 + 1) / length


def transform_filters(kappa: np.ndarray, kc: float, length: int) -> np.ndarray:
    """Return sqrt(kc/kappa) Psi(kc eta/kappa) (kappa, k) over the wavenumbers of a real transform of ``length``."""
    filters = np.sqrt(kc / kappa)[:, None] * wavelet_spectrum(kappa, kc, wavenumbers(length))
    if length % 2 == 0:
        filters[:, -1] *= 0.5  # eta = pi belongs to both signs
    return filters


def transform(signal: np.ndarray, kappa: ArrayLike, kc: float, length: int | None = None) -> np.ndarray:
    """Return the wavelet transform X (..., kappa, x), Eq. (A5), of real signals (..., cell), in the signal's unit.

    X = sqrt(kc/kappa) IFFT[FFT(signal) Psi(kc eta/kappa)] on the line padded to ``length``, by default
    ``padded_length`` of the lowest node. The first columns over x are those of the cells; the inverse needs the others
    as well, which stand for places beyond the lattice: counted from the last column backwards, those before cell 0.
    Raises ValueError if ``length`` is less than the number of cells.
    """
    kappa = np.asarray(kappa, dtype=float)
    cells = signal.shape[-1]
    if length is None:
        length = padded_length(cells, kc, float(kappa.min()))
    if length < cells:
        raise ValueError(f"length = {length}: below the {cells} cells of the signal")
    # Negative wavenumbers stay zero: the wavelets have none, which makes the transform complex.
    spectrum = np.zeros((*signal.shape[:-1], len(kappa), length), dtype=complex)
    spectrum[..., : length // 2 + 1] = fft.rfft(signal, length)[..., None, :] * transform_filters(kappa, kc, length)
    return fft.ifft(spectrum, overwrite_x=True)


def inverse(x: np.ndarray, nodes: Nodes, kc: float) -> np.ndarray:
    """Return parts (bin, ..., x), Eq. (A7), of signals whose ``transform`` at ``nodes`` is ``x`` (..., kappa, x).

    u_b = 2 Re (1/C) sum over the nodes of bin b of (dkappa/kappa) sqrt(kappa/kc) IFFT[FFT(X) Psi(kc eta/kappa)].
    The parts sum to the signal but for its mean and the wavenumbers near and below pi/60 (see ``Bank``).
    """
    length = x.shape[-1]
    weights = nodes.weight / constant(kc) * np.sqrt(nodes.kappa / kc)
    filters = weights[:, None] * wavelet_spectrum(nodes.kappa, kc, wavenumbers(length))
    if length % 2 == 0:
        filters[:, -1] *= 2  # ``transform`` has halved eta = pi
    spectrum = fft.fft(x)[..., : length // 2 + 1] * filters
    parts = [fft.irfft(spectrum[..., nodes.bins == b, :].sum(axis=-2), length) for b in range(BINS)]
    return np.stack(parts)


@dataclass(frozen=True)
class Bank:
    """Filters of the wavenumber bins that do in one step what transform, choice of a bin's nodes and inverse do.

    Each of these steps multiplies every wavenumber eta by a number, and so do all three together: ``transfer`` (bin, k)
    over the wavenumbers of the padded ``length``,
    T_b(eta) = (1/C) sum over the nodes of bin b of (dkappa/kappa) |Psi(kc eta/kappa)|^2. The sum over b is at most 1:
    over nodes from 0 to infinity it would be 1. It is 0.99 at least from 1.3 pi/60 to pi, 0.55 at pi/60 and 0 at
    eta = 0 (kc = 6).
    """

    transfer: np.ndarray
    length: int

    def split(self, signal: np.ndarray) -> np.ndarray:
        """Return parts (bin, ..., cell) of real signals (..., cell), without the padding."""
        spectrum = fft.rfft(signal, self.length)
        cells = signal.shape[-1]
        return np.stack([fft.irfft(transfer * spectrum, self.length)[..., :cells] for transfer in self.transfer])


@lru_cache(maxsize=16)
def filter_bank(cells: int, kc: float = 6.0) -> Bank:
    """Return the bank of filters of all bins for lattices of ``cells``."""
    length = padded_length(cells, kc)
    nodes = Nodes.log(kc)
    # The factors sqrt(kc/kappa) of the transform and sqrt(kappa/kc) of its inverse cancel.
    gain = nodes.weight / constant(kc) * wavelet_spectrum(nodes.kappa, kc, wavenumbers(length)) ** 2
    transfer = np.stack([gain[nodes.bins == b].sum(axis=0) for b in range(BINS)])
    transfer.flags.writeable = False  # the cache hands out the same array again
    return Bank(transfer=transfer, length=length)


@dataclass(frozen=True)
class Partition:
    """Kinetic energies in J of the parts v_b of a velocity field.

    ``energy`` (bin, t) KE_b are sums over the lattice, ``field`` (bin, t, cell') means over some cells, or None.
    ``kinetic`` (t) KE is that of the velocities themselves, ``reconstructed`` (t) KE_rec = 1/2 sum m (sum_b v_b)^2.
    ``error`` (t) = |KE_rec - KE|/KE is the paper's Eq. (A8), and ``cross_share`` (t) = 1 - sum_b KE_b/KE the fraction
    of energy that parts do not have by themselves: that of products of different parts, and of what no part has. Both
    are 0 at rest.
    """

    energy: np.ndarray
    field: np.ndarray | None
    kinetic: np.ndarray
    reconstructed: np.ndarray
    error: np.ndarray
    cross_share: np.ndarray


def partition(velocity: np.ndarray, masses: ArrayLike, mean_over: int = 0) -> Partition:
    """Partition the kinetic energy of ``velocity``, (t, cell) or (t, cell, dof) in m/s, by wavenumber bins.

    ``masses`` in kg, (dof) or a scalar. A few snapshots at a time are held, so ``velocity`` may be an HDF5
    dataset. The energies in space-time are kept as means over ``mean_over`` cells, if that is not 0. Raises ValueError
    if there is not one mass for each column of the velocity.
    """
    mass_list = np.atleast_1d(np.asarray(masses, dtype=float))
    nt, cells = velocity.shape[:2]
    if mass_list.shape != (velocity.shape[2:] or (1,)):
        raise ValueError(f"masses: {len(mass_list)} given for velocities of shape {velocity.shape}")

    bank = filter_bank(cells)
    energy = np.zeros((BINS, nt))
    kinetic = np.zeros(nt)
    reconstructed = np.zeros(nt)
    field = np.zeros((BINS, nt, -(-cells // mean_over))) if mean_over else None
    for first in range(0, nt, CHUNK):
        rows = slice(first, min(first + CHUNK, nt))
        block = np.asarray(velocity[rows], dtype=float).reshape(-1, cells, len(mass_list))
        for j, mass in enumerate(mass_list):
            signal = np.ascontiguousarray(block[..., j])
            parts = bank.split(signal)
            whole = parts.sum(axis=0)
            kinetic[rows] += 0.5 * mass * np.einsum("tc,tc->t", signal, signal)
            energy[:, rows] += 0.5 * mass * np.einsum("btc,btc->bt", parts, parts)
            reconstructed[rows] += 0.5 * mass * np.einsum("tc,tc->t", whole, whole)
            if field is not None:
                field[:, rows] += 0.5 * mass * block_means(parts**2, mean_over, 2)

    missing = np.stack([np.abs(reconstructed - kinetic), kinetic - energy.sum(axis=0)])
    error, cross_share = np.divide(missing, kinetic, out=np.zeros_like(missing), where=kinetic > 0)
    return Partition(
        energy=energy, field=field, kinetic=kinetic, reconstructed=reconstructed, error=error, cross_share=cross_share
    )
