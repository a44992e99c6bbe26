"""Measures of the motion of single points, on arrays: peak, rms, steady amplitude, transmission by frequency."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import fft

# Windows whose amplitudes are compared. Two may agree by chance, one on either side of the extreme of a slow beat.
WINDOWS = 3
# Harmonics of the drive that are fitted at most: equal stops on both sides excite the third and the fifth.
HARMONICS = 5
# Highest frequency of a fitted harmonic over the samples' Nyquist frequency. Near 1, the samples of its sine and its
# cosine are nearly proportional to one another: over two periods the condition number of the fit is 2 at 0.8, 6 at 0.99
# and 64 at 0.999.
RESOLVED = 0.8
# Fraction of a record, at its end, over which a vibration is faded out that goes on beyond the record. In 300 records
# of two sines the transmission of the one with 1 to 100 % of the other's amplitude errs by 1e-4 (rms); with 0.1 in
# place of 0.2 it errs by 6e-4, with 0.05 by 2e-2, with 0.4, which leaves less of the record, by 5e-5.
FADING = 0.2
# Fraction of a mean square below which a range of frequencies is taken not to be excited. What bursts of 1 s and 4 s
# have there are tails of their spectra: with half or twice the number one range of 20 Hz more or less counts.
SILENT = 1e-12


class History(NamedTuple):
    """Motion of a point: ``time`` in s, ``displacement`` in m, ``velocity`` in m/s, ``acceleration`` in m/s^2, (t,)."""

    time: np.ndarray
    displacement: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


class SteadyDrive(NamedTuple):
    """A drive that is a sine of ``frequency`` in rad/s from the time ``start`` to ``stop`` in s."""

    frequency: float
    start: float
    stop: float

    @property
    def period(self) -> float:
        """Length of a period in s."""
        return 2 * np.pi / self.frequency


class SteadyAmplitude(NamedTuple):
    """The ``amplitude`` at the drive's frequency in the last window; ``drift``, the difference of windows over it."""

    amplitude: float
    drift: float


def peak(values: np.ndarray) -> float:
    """Return the largest magnitude of samples (t,)."""
    return float(np.abs(values).max())


def rms(values: np.ndarray) -> float:
    """Return the root of the mean square of samples (t,)."""
    return float(np.sqrt(np.mean(np.square(values))))


def steady_amplitude(time: np.ndarray, values: np.ndarray, drive: SteadyDrive, periods: int) -> SteadyAmplitude:
    """Return amplitude of ``values`` (t,) at the frequency of ``drive``, as a lock-in amplifier has it, and its drift.

    In each of the last three windows of so many ``periods`` of the drive, a constant and sines of up to five harmonics
    are fitted to the samples, at ``time`` (t,) in s, by least squares. The amplitude is that of the first harmonic in
    the last window. The drift is the largest distance of its phasor, amplitude and phase, from those of the two windows
    before, over its amplitude. Both are NaN where the drive is steady for less than the three windows, or where the
    samples do not resolve it.
    """
    window = periods * drive.period
    end = min(drive.stop, float(time[-1]))
    interval = np.inf
    if len(time) > 1:
        interval = float(time[1] - time[0])
    harmonics = min(HARMONICS, int(RESOLVED * np.pi / (interval * drive.frequency)))
    # The steady part may be exactly as long as the windows: the rounding of times must not make it too short.
    if harmonics < 1 or end - WINDOWS * window < drive.start * (1 - 1e-12) - 1e-12 * window:
        return SteadyAmplitude(np.nan, np.nan)

    phasors = []
    for number in range(WINDOWS, 0, -1):
        inside = (time > end - number * window) & (time <= end - (number - 1) * window)
        phasors.append(_phasor(time[inside], values[inside], drive.frequency, harmonics))
    last = phasors[-1]
    if last == 0:
        return SteadyAmplitude(0.0, 0.0)
    drift = max(abs(phasor - last) for phasor in phasors[:-1]) / abs(last)
    return SteadyAmplitude(float(abs(last)), float(drift))


def _phasor(time: np.ndarray, values: np.ndarray, frequency: float, harmonics: int) -> complex:
    """Return the complex amplitude A of the part Re(A exp(i w t)) of ``values`` (t,) with the ``frequency`` w in rad/s.

    Sines of so many ``harmonics`` are fitted with it.
    """
    columns = [np.ones(len(time))]
    for harmonic in range(1, harmonics + 1):
        phase = harmonic * frequency * time
        columns += [np.cos(phase), -np.sin(phase)]
    # Least squares rather than a Fourier sum, which is exact only for a whole number of samples a period.
    solution = np.linalg.lstsq(np.column_stack(columns), values, rcond=None)[0]
    return complex(solution[1], solution[2])


def transmission(source: np.ndarray, receiver: np.ndarray) -> float:
    """Return the rms of the ``receiver`` (t,) over that of the ``source`` (t,); NaN where the source does not move."""
    source_rms = rms(source)
    if source_rms == 0:
        return np.nan
    return rms(receiver) / source_rms


def transmission_by_part(
    source: np.ndarray,
    receiver: np.ndarray,
    interval: float,
    edges: Sequence[float] | np.ndarray,
    *,
    goes_on: bool = False,
) -> np.ndarray:
    """Return transmission (part,) of frequencies between ``edges`` (part + 1) in rad/s, sampled each ``interval`` s.

    ``source`` and ``receiver`` (t,) are continued by their mirror images (cosine transform), without a jump; the mean
    square of a record is the sum of those of its parts. A vibration that ``goes_on`` beyond the record is faded out
    over the last fifth of it: the mirror image would make a kink at the end, which has energy in all parts. NaN for
    parts in which the source has less than 1e-12 of its mean square.
    """
    window = np.ones(len(source))
    if goes_on:
        fading = int(FADING * len(source))
        window[len(source) - fading :] = np.cos(0.5 * np.pi * (np.arange(fading) + 0.5) / fading) ** 2

    energies = []
    for values in (source, receiver):
        squares = np.square(fft.dct(window * values, norm="ortho"))
        frequency = np.pi * np.arange(len(squares)) / (len(squares) * interval)
        bounds = np.searchsorted(frequency, edges)
        energies.append(np.array([squares[low:high].sum() for low, high in pairwise(bounds)]))

    of_source, of_receiver = energies
    has_source = of_source > SILENT * of_source.sum()
    return np.sqrt(np.divide(of_receiver, of_source, out=np.full(len(of_source), np.nan), where=has_source))
