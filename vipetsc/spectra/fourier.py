"""Fourier measures of a sampled lattice: kinetic energy, wavenumber content, dispersion and its ridge.

A field is anything that can be indexed as ``velocity[..., dof]`` to give a (t, cell) array: a numpy array
or an HDF5 dataset, of which one mass at a time is then held in memory.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from vipetsc.spectra.pooling import block_means, block_sums, blocks

# Fraction of a window under cosine flanks, unless asked otherwise. They leave 7e-5 of a sine's energy more than 20 bins
# away; half as wide ones leave 1e-3, none 5e-3. Twice as wide ones leave 3e-6, and weigh down more of the record.
TAPER = 0.1


@dataclass(frozen=True)
class Dispersion:
    """Mean kinetic energy in J per bin, ``energy`` (wavenumber, frequency); sums to that of the window.

    ``wavenumber`` in rad per cell, ``frequency`` in rad/s. A wave that travels towards higher cells with
    phase velocity omega/kappa > 0 has kappa > 0.
    """

    wavenumber: np.ndarray
    frequency: np.ndarray
    energy: np.ndarray

    def folded(self) -> "Dispersion":
        """Return dispersion with kappa and -kappa added up, on [0, pi]."""
        zero = (len(self.wavenumber) - 1) // 2  # row of kappa = 0 in ascending order over (-pi, pi]
        energy = self.energy[zero:].copy()
        # 0 is its own opposite, and so is pi, which an even number of wavenumbers has once.
        energy[1 : zero + 1] += self.energy[:zero][::-1]
        return Dispersion(wavenumber=self.wavenumber[zero:], frequency=self.frequency, energy=energy)

    def pooled(self, wavenumbers: int, frequencies: int) -> "Dispersion":
        """Return the dispersion in bins ``wavenumbers`` and ``frequencies`` times as wide: sums, at bins' middles.

        The last bin of either axis may be narrower.
        """
        return Dispersion(
            wavenumber=block_means(self.wavenumber, wavenumbers, 0),
            frequency=block_means(self.frequency, frequencies, 0),
            energy=block_sums(block_sums(self.energy, wavenumbers, 0), frequencies, 1),
        )


def kinetic_energy(velocity: np.ndarray, masses: ArrayLike) -> np.ndarray:
    """Return the kinetic energy (t, cell) in J of every cell, from ``velocity`` (t, cell, dof) in m/s, masses in kg."""
    energy = np.zeros(velocity.shape[:-1])
    for j, mass in enumerate(np.asarray(masses)):
        energy += 0.5 * mass * np.square(np.asarray(velocity[..., j]))
    return energy


def wavenumber_content(velocity: np.ndarray, masses: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return the kinetic energy per wavenumber over time: kappa (k) in [0, pi] rad per cell, content (t, k) in J.

    Both signs of kappa are added up; the content of a sample sums to its kinetic energy (Parseval).
    """
    samples, cells = velocity.shape[:2]
    content = np.zeros((samples, cells // 2 + 1))
    for j, mass in enumerate(np.asarray(masses)):
        spectrum = fft.rfft(np.asarray(velocity[..., j]), axis=1)
        content += 0.5 * mass / cells * (spectrum.real**2 + spectrum.imag**2)
    content[:, 1 : (cells + 1) // 2] *= 2  # -kappa has as much; 0 and pi are their own opposites
    kappa = 2 * np.pi * np.arange(cells // 2 + 1) / cells
    return kappa, content


def taper(length: int, fraction: float) -> np.ndarray:
    """Return Tukey window (length) with cosine flanks over ``fraction`` of it, scaled to mean square 1."""
    x = (np.arange(length) + 0.5) / length
    flank = np.minimum(x, 1 - x)
    window = np.ones(length)
    if fraction > 0:
        window = 0.5 * (1 - np.cos(2 * np.pi * np.minimum(flank / fraction, 0.5)))
    # With a mean square of 1 the window leaves the energy of a stationary signal as it is on the average.
    return window / np.sqrt(np.mean(window**2))


class CellWindow(NamedTuple):
    """Cells of which a dispersion is taken: a slice of them, and the fraction of it under cosine flanks at its ends."""

    cells: slice = slice(None)
    taper: float = TAPER


def dispersion(
    velocity: np.ndarray, masses: ArrayLike, interval: float, *, tapers: tuple[float, float] = (TAPER, TAPER)
) -> Dispersion:
    """Return the `dispersions` of all cells of a ``velocity`` (time, cell, dof) in m/s.

    ``masses`` (dof,) are in kg, the ``interval`` of samples in s. Flanks take the fractions ``tapers`` of the record
    and of the cells.
    """
    (spectrum,) = dispersions(velocity, masses, interval, [CellWindow(taper=tapers[1])], in_time=tapers[0])
    return spectrum


def dispersions(
    velocity: np.ndarray,
    masses: ArrayLike,
    interval: float,
    windows: Sequence[CellWindow],
    *,
    in_time: float = TAPER,
    lengths: tuple[int, int] | None = None,
    highest: float = np.inf,
    rows: slice = slice(None),
    memory: float = np.inf,
) -> list[Dispersion]:
    """Return kinetic energy over wavenumber and frequency in ``windows``, by 2-D Fourier transforms of velocities.

    ``velocity`` (t, cell, dof) is in m/s every ``interval`` s, ``masses`` (dof) in kg, ones for a plain velocity
    spectrum; energies are added over the masses. Cosine flanks cover the fraction ``in_time`` of the record, half of it
    at either end. ``lengths`` (time, space) are those to which records are padded with zeros, by default the next that
    have fast transforms. ``rows`` says which of the frequencies up to ``highest`` (rad/s) are returned. No more than
    ``memory`` bytes of the velocity are read at once.

    Returns the energies on kappa in (-pi, pi] and omega >= 0, where those of omega and -omega are added up.
    """
    t, x = velocity.shape[:2]
    nt, nx = lengths or (fft.next_fast_len(t, real=True), fft.next_fast_len(x))
    frequency = 2 * np.pi * fft.rfftfreq(nt, interval)
    # Numbers of the frequencies that are computed: a slice of a range is a range.
    taken = range(np.count_nonzero(frequency <= highest))[rows]
    flanks = taper(t, in_time)[:, None]

    energies = [np.zeros((len(taken), nx)) for _ in windows]
    # Over time first, block of cells by block: frequencies that are dropped are never held for all cells. Windows only
    # weight cells: this transform is the same for all of them.
    spectrum = np.empty((len(taken), x), dtype=complex)
    for j, mass in enumerate(np.asarray(masses)):
        for block in blocks(x, 8 * t, memory):
            signal = np.asarray(velocity[:, block, j])
            spectrum[:, block] = fft.rfft(signal * flanks, nt, axis=0)[taken]
        for window, energy in zip(windows, energies, strict=True):
            part = spectrum[:, window.cells]
            # The inverse transform's sign in space makes exp(i (kappa x - omega t)) land on +kappa.
            waves = fft.ifft(part * taper(part.shape[1], window.taper), nx, axis=1, norm="forward")
            energy += mass * (waves.real**2 + waves.imag**2)

    # A real signal has as much at -omega as at omega; 0 and the highest frequency of an even length have no opposite.
    has_opposite = [0 < row < (nt + 1) // 2 for row in taken]
    # From the transform's order of wavenumbers to ascending ones over (-pi, pi].
    order = np.roll(np.arange(nx), (nx - 1) // 2)
    wavenumber = 2 * np.pi * np.where(order > nx // 2, order - nx, order) / nx
    for energy in energies:
        # Half of m v^2, its mean over the t samples, and Parseval's theorem for both transforms of padded lengths.
        energy /= 2 * t * nt * nx
        energy[has_opposite] *= 2
    return [
        Dispersion(wavenumber=wavenumber, frequency=frequency[taken], energy=energy.T[order]) for energy in energies
    ]


def ridge(spectrum: Dispersion, floor: float = 1e-2) -> tuple[np.ndarray, np.ndarray]:
    """Return ridge of a dispersion: energetic wavenumbers (k) in rad per cell, frequencies (k) in rad/s of their peaks.

    A wavenumber is energetic if its peak exceeds ``floor`` times the largest energy of a bin. The frequency of the peak
    is that of the parabola through the logarithms of the peak and its two neighbours, which is exact for a Gaussian
    line.
    """
    energy = spectrum.energy
    frequency = spectrum.frequency
    rows = np.arange(len(energy))
    peak = np.argmax(energy[:, 1:-1], axis=1) + 1  # not at an end: a peak needs a neighbour on either side
    energetic = np.nonzero(energy[rows, peak] > floor * energy.max())[0]

    neighbours = energy[energetic[:, None], peak[energetic, None] + np.array([-1, 0, 1])]
    # A neighbour may have no energy at all, and 0 no logarithm.
    left, top, right = np.log(np.maximum(neighbours, np.finfo(float).tiny)).T
    offset = 0.5 * (left - right) / (left - 2 * top + right)
    step = frequency[1] - frequency[0]
    refined = frequency[peak[energetic]] + np.clip(offset, -0.5, 0.5) * step
    return spectrum.wavenumber[energetic], refined


def amplitude_spectrum(values: np.ndarray, interval: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the frequencies (k,) in rad/s and amplitudes (k,) of even samples (t,) at an ``interval`` in s.

    A sine of amplitude a at one of the frequencies has a peak of the height a, and of .85 a or more between them: the
    samples are weighted by Hann's window.
    """
    window = np.hanning(len(values) + 2)[1:-1]
    amplitude = 2 * np.abs(fft.rfft(values * window)) / window.sum()
    amplitude[0] /= 2
    return 2 * np.pi * fft.rfftfreq(len(values), interval), amplitude


def spectrogram(values: np.ndarray, interval: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (m,) in s from the first sample, frequencies (k,) in rad/s, and amplitudes (m, k) about each time.

    Each is an ``amplitude_spectrum`` of about twice the root of the number of samples (t,), which resolves time and
    frequency equally well; neighbouring ones share three quarters of these.
    """
    length = min(len(values), max(8, 4 * round(np.sqrt(len(values)) / 2)))
    begins = np.arange(0, len(values) - length + 1, max(1, length // 4))
    rows = [amplitude_spectrum(values[begin : begin + length], interval) for begin in begins]
    amplitudes = np.stack([amplitude for _, amplitude in rows])
    return (begins + 0.5 * length) * interval, rows[0][0], amplitudes
