"""Measures of the motion of single points, on arrays: peak, rms, steady amplitude, transmission by frequency."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import fft

WINDOWS = 3  # that are compared: two may agree where a slow beat turns
HARMONICS = 5  # of the drive that are fitted at most: contacts on both sides send the third and the fifth
RESOLVED = 0.8  # of the samples' Nyquist frequency: nearer to it sines and cosines at the samples are nearly parallel
FADING = 0.2  # of a record, over which a vibration fades out that does not end
SILENT = 1e-12  # of a mean square: a part of the frequencies with less than that holds rounding


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
    """Amplitude at the drive's frequency in the last window, and by how much windows differ, over it."""

    amplitude: float
    drift: float


def peak(values: np.ndarray) -> float:
    """The largest magnitude of samples (t,)."""
    return float(np.abs(values).max())


def rms(values: np.ndarray) -> float:
    """The root of the mean square of samples (t,)."""
    return float(np.sqrt(np.mean(np.square(values))))


def steady_amplitude(time: np.ndarray, values: np.ndarray, drive: SteadyDrive, periods: int) -> SteadyAmplitude:
    """The amplitude of ``values`` (t,) at the frequency of ``drive``, and its drift, as a lock-in amplifier has it.

    Of each of the last three windows of so many whole ``periods`` of the drive, a constant and sines of up to five
    harmonics are fitted by least squares, so that neither samples per period nor a static part matter. The amplitude is
    that of the first harmonic in the last window. The drift is the largest distance of its phasor, phase and all, from
    those of the two windows before, over its amplitude. Both are NaN where the drive is steady for less than the three
    windows, or where the samples do not resolve it.
    """
    window = periods * drive.period
    end = min(drive.stop, float(time[-1]))
    interval = np.inf
    if len(time) > 1:
        interval = float(time[1] - time[0])
    harmonics = min(HARMONICS, int(RESOLVED * np.pi / (interval * drive.frequency)))
    # Rounding of the times must not lose a window.
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
    """The complex amplitude A of the part Re(A exp(i w t)) of ``values`` with the ``frequency`` w in rad/s."""
    columns = [np.ones(len(time))]
    for harmonic in range(1, harmonics + 1):
        phase = harmonic * frequency * time
        columns += [np.cos(phase), -np.sin(phase)]
    # Least squares rather than a Fourier sum: the window need not hold a whole number of samples a period.
    solution = np.linalg.lstsq(np.column_stack(columns), values, rcond=None)[0]
    return complex(solution[1], solution[2])


def transmission(source: np.ndarray, receiver: np.ndarray) -> float:
    """The rms of the ``receiver`` (t,) over that of the ``source`` (t,); NaN where the source does not move."""
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
    """Transmission (part,) of the frequencies between the ``edges`` (part + 1) in rad/s, samples ``interval`` s apart.

    Records are continued by their mirror image (cosine transform), without a jump at their ends; the mean square of a
    record is the sum of those of its parts. A vibration that ``goes_on`` beyond the record fades out over the last
    fifth of it, because its kink at the end would be in all parts. NaN for parts in which the source has less than
    1e-12 of its mean square.
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
