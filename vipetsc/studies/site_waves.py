r"""Waves at the site of an infinite lattice with dashpots: their energies by band and direction, as they pass the site.

Energies at the end of a run would lack what dashpots take before, which differs from wave to wave. Here they
are those that flow past the site. The lattice is linear but for the force f of the contact on its two masses, so that
the waves at the site are those of the drive and those that f sends out, exactly: with u = a phi lambda^n of a wave at
the real frequency omega (``lattice.damped``), |lambda| < 1 in its direction, and a force F(t),

    a(omega) = sum over the drive and the contact of s(omega) F^(omega) lambda^distance,

where s is what a force of 1 N at that frequency sends out. The wave carries the energy 2/pi integral P |a|^2 d omega
past the middle of the site's cell, P |a|^2 being its flux there (or past its end, for a contact with the next cell).

The integral is a sum over nodes in the middles of equal intervals of the wavenumber kappa of the lattice without
dashpots, d omega = v_g d kappa: spectra of what a force sends are singular at the edges of bands as functions of omega,
and smooth in kappa. Each node also says which of the waves at its frequency belongs to a band: of those that go in one
direction the one whose lambda is nearest to exp(-+ i kappa). Motions are those of exp(i omega t).

The force follows from the motion w of the contact's masses and that of the run without a site, w_0: f = (w - w_0)/g at
each frequency, g being the response of w to a pair of forces. It is zero before the first contact and after the last.

In the undamped limit energies are those that ``spectra.directions`` finds at the end of a run. With dashpots waves
that meet or die away near the site are not orthogonal: what comes and what leaves differ from the work of f by what
dashpots take there, which goes to zero with them.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.case.law import OneSite
from vipetsc.lattice import bloch
from vipetsc.lattice.chain import Pair
from vipetsc.lattice.damped import Waves, damped_waves
from vipetsc.lattice.sent import amplitudes_sent
from vipetsc.studies.pair_motion import PairMotion
from vipetsc.studies.response import DECAY, self_response

# Nodes of the wavenumber over the cells of the ring, in which waves do not come round. With twice as many, predicted
# energies change by 0.0004 decades, and CPU time by a fifth.
NODES_A_CELL = 1
# Samples before the first contact and after the last in which the force is not zero: the transform of a force that ends
# at a sample rings over a few of them. Half and twice as many change predicted energies by less than 1e-4 decades.
MARGIN = 4


class SentWave(NamedTuple):
    """The wave that unit forces send in one direction: amplitudes ``by_site`` and ``by_drive`` in m/N.

    ``factor`` is that to the next cell, ``flux`` in W/m^2 that past the site of a wave of 1 m in its cell.
    """

    by_site: complex
    by_drive: complex
    factor: complex
    flux: float


class SiteWaves:
    """The waves at the site of the ring ``setting`` of a ``model`` with dashpots; the contact joins a ``pair``.

    Arrays are over (node, band), those of two directions have them as first axis, forward (from the drive to the site
    and on) before backward. ``frequency`` in rad/s and ``speed`` in cells/s are those without dashpots; ``flux`` in
    W/m^2 is that of a wave of 1 m in the site's cell, ``factor`` that by which a wave changes from cell to cell. The
    waves of a drive of 1 N have the spectrum ``arriving`` in m s at the site, and ``leaving_drive`` at the drive; a
    force of 1 N on the contact's masses ``sends`` waves out, in m/N. ``weight`` in rad/s is that of a node in sums.
    """

    def __init__(self, model: Model, setting: OneSite, pair: Pair) -> None:
        self.cell = model.chain.cell
        self.pair = pair
        self.setting = setting

        nodes = NODES_A_CELL * setting.cells
        kappa = np.pi * (np.arange(nodes) + 0.5) / nodes
        point = bloch(self.cell, kappa)
        self.frequency = point.frequency
        self.speed = np.abs(point.group_velocity)
        self.weight = 2 / np.pi * self.speed * np.pi / nodes

        shape = self.frequency.shape
        self.sends = np.zeros((2, *shape), complex)
        self.flux = np.zeros((2, *shape))
        self.factor = np.zeros((2, *shape), complex)
        self.arriving = np.zeros(shape, complex)
        self.leaving_drive = np.zeros(shape, complex)
        drive = model.drive
        spectrum = drive.spectrum(self.frequency) / drive.amplitude
        for node, band in np.ndindex(shape):
            # The wave to higher cells: exp(i (omega t - kappa n)) if its group velocity is positive.
            up = np.exp(-1j * kappa[node] * np.sign(point.group_velocity[node, band]))
            forward, backward = self._sent(self.frequency[node, band], up, model.drive_mass)
            self.sends[:, node, band] = forward.by_site, backward.by_site
            self.flux[:, node, band] = forward.flux, backward.flux
            self.factor[:, node, band] = forward.factor, backward.factor
            leaving = forward.by_drive * spectrum[node, band]
            self.leaving_drive[node, band] = leaving
            self.arriving[node, band] = leaving * forward.factor**setting.distance

    def _sent(self, omega: float, up: complex, drive_mass: int) -> tuple[SentWave, SentWave]:
        """Waves sent forward and backward at ``omega``, near to the wave to higher cells whose factor is ``up``."""
        waves = damped_waves(self.cell, omega)
        half = len(waves.factor) // 2
        site = self._amplitudes_of_pair(waves)
        unit = np.zeros(self.cell.dofs)
        unit[drive_mass] = 1.0
        drive = np.concatenate(amplitudes_sent(waves, unit, "right"))

        higher = int(np.argmin(np.abs(waves.factor[:half] - up)))
        lower = half + int(np.argmin(np.abs(1 / waves.factor[half:] - up)))
        directions = []
        for wave in (higher, lower):
            factor = waves.factor[wave]
            flux = _power_to_next(waves, wave, omega)
            # In the middle of the cell it is the geometric mean of that on both sides.
            if not self.pair.next_cell:
                flux = flux / abs(factor)
            # Factors are those to the next higher cell: to the next one in its direction, a wave to lower cells has
            # the inverse.
            outwards = factor
            if wave == lower:
                outwards = 1 / factor
            directions.append(SentWave(by_site=site[wave], by_drive=drive[wave], factor=outwards, flux=flux))
        if self.setting.towards < 0:
            directions.reverse()
        return directions[0], directions[1]

    def _amplitudes_of_pair(self, waves: Waves) -> np.ndarray:
        """Amplitudes (wave,) in m at the site's cell by a force of 1 N on its resonator and -1 N on its host."""
        resonator = np.zeros(self.cell.dofs)
        resonator[self.pair.resonator] = 1.0
        amplitudes = np.concatenate(amplitudes_sent(waves, resonator, "right"))
        if self.pair.next_cell:
            amplitudes = amplitudes / waves.factor
        # The ground does not move.
        if self.pair.host >= 0:
            host = np.zeros(self.cell.dofs)
            host[self.pair.host] = 1.0
            amplitudes = amplitudes - np.concatenate(amplitudes_sent(waves, host, "right"))
        return np.asarray(amplitudes)

    def amplitudes(self, force: np.ndarray | None = None) -> np.ndarray:
        """Spectrum (direction, node, band) in m s, at the site's cell, of the waves that leave it under a drive of 1 N.

        ``force`` (time) in N is the contact's; without any, waves pass.
        """
        passing = np.stack([self.arriving, np.zeros_like(self.arriving)])
        if force is None:
            return passing
        return np.asarray(passing + self.sends * spectrum_of(force, self.setting.interval, self.frequency))

    def energies(self, force: np.ndarray | None = None) -> np.ndarray:
        """Energies (band, direction) in J past the site, of the waves of ``amplitudes``."""
        return np.asarray((self.weight * self.flux * np.abs(self.amplitudes(force)) ** 2).sum(axis=1).T)

    def sent_by_bins(self, force: np.ndarray, bins: int) -> np.ndarray:
        """Energies (band, bin) in J that the contact's ``force`` (time) in N sends out, by bins of the wavenumber."""
        amplitudes = self.sends * spectrum_of(force, self.setting.interval, self.frequency)
        energies = (self.weight * self.flux * np.abs(amplitudes) ** 2).sum(axis=0)
        # Whole numbers, so that no node falls between two bins by rounding.
        of_bin = np.arange(len(energies)) * bins // len(energies)
        return np.array([np.bincount(of_bin, column, bins) for column in energies.T])

    @property
    def padded(self) -> int:
        """Samples of a run and as many more, so that the transform does not fold the response back."""
        return 2 * (self.setting.samples + 1)

    @property
    def decay(self) -> float:
        """Rate in 1/s of the signals' decay: less the imaginary part of their frequencies."""
        return DECAY / (self.padded * self.setting.interval)

    @cached_property
    def response(self) -> np.ndarray:
        """g (omega,) in m/N of the contact's masses to a pair of forces, at the frequencies of the transform."""
        omega = 2 * np.pi * np.fft.rfftfreq(self.padded, self.setting.interval)
        return self_response(self.cell, omega - 1j * self.decay, self.pair)

    def late(self, since: float) -> float:
        """Energy in J of the drive's band that arrives later than ``since`` s after it was sent."""
        band = self.setting.band
        slow = self.speed[:, band] * since < self.setting.distance
        energy = self.weight * self.flux[0] * np.abs(self.arriving) ** 2
        return float(energy[slow, band].sum())

    def taken_before(self) -> float:
        """Fraction of the energy sent forward in the drive's band that dashpots take before the site."""
        band = self.setting.band
        energies = self.weight * self.flux[0]
        sent = (energies * np.abs(self.leaving_drive) ** 2)[:, band].sum()
        arrives = (energies * np.abs(self.arriving) ** 2)[:, band].sum()
        return float(1 - arrives / sent)

    def force(self, motion: PairMotion, linear: np.ndarray, begin: float, end: float) -> np.ndarray:
        """The contact's force (time) in N on the resonator, its opposite on the host, from a ``motion`` of the pair.

        ``linear`` (time) in m is what w would be without the contact, which lasts from ``begin`` to ``end`` in s.
        """
        time = motion.time
        by_contact = motion.displacement[:, 0] - linear
        spectrum = np.fft.rfft(by_contact * np.exp(-self.decay * time), self.padded) / self.response
        force = np.fft.irfft(spectrum, self.padded)[: len(time)] * np.exp(self.decay * time)
        # Rounding aside, all else of it is what the end of the record would need to stop the motion there.
        margin = MARGIN * self.setting.interval
        touching = (time >= begin - margin) & (time <= end + margin)
        return np.where(touching, force, 0.0)


def _power_to_next(waves: Waves, wave: int, omega: float) -> float:
    """Power in W that a ``wave`` of 1 m in a cell carries through the springs to the next one, in its direction.

    A dashpot takes part of it between the ends of its spring: the power is their mean, to the second order in it.
    """
    shape = waves.shape[:, wave]
    elastic = waves.coupling.real
    return float(abs(omega / 2 * np.imag(waves.factor[wave] * (shape.conj() @ elastic @ shape))))


def spectrum_of(signal: np.ndarray, step: float, omega: np.ndarray) -> np.ndarray:
    """Fourier transform of a ``signal`` (time), sampled every ``step`` s from t = 0, at any ``omega`` in rad/s.

    Factors of blocks of samples and of samples in a block replace those of all samples, so that few exponentials are
    computed.
    """
    block = int(np.ceil(np.sqrt(len(signal))))
    padded = np.zeros(block * block)
    padded[: len(signal)] = signal
    within = np.exp(-1j * np.multiply.outer(step * np.arange(block), omega.ravel()))
    between = np.exp(-1j * np.multiply.outer(step * block * np.arange(block), omega.ravel()))
    sums = padded.reshape(block, block) @ within
    return np.asarray(step * (sums * between).sum(axis=0).reshape(omega.shape))
