r"""Waves at the site of an infinite lattice with dashpots: their energies by band and direction, as they pass the site.

Energies at the end of a run would lack what dashpots have taken by then, which differs from wave to wave. The energies
here are those that flow past the site. The lattice is linear but for the force f of the contact on its two masses.
Therefore the waves at the site are exactly those of the drive and those that f sends out. With u = a phi lambda^n of a
wave at the real frequency omega (``lattice.damped``), |lambda| < 1 in its direction, and a force F(t),

    a(omega) = sum over the drive and the contact of s(omega) F^(omega) lambda^distance,

where F^ is the transform of the force, s the amplitude that a force of 1 N at that frequency sends out, and distance
the number of cells to the site. Motions are those of exp(i omega t). The wave carries the energy

    2/pi integral P |a|^2 d omega over omega > 0 (Parseval)

past the middle of the site's cell, or past that cell's end for a contact with the next cell; P |a|^2 is its mean power
there.

The integral is a sum over nodes, the middles of equal intervals of the wavenumber kappa of the lattice without
dashpots, with d omega = v_g d kappa: the spectra of what a force sends are singular at the edges of bands as functions
of omega, and smooth as functions of kappa. The kappa of a node also says which of the waves at its frequency is that of
the band: of the waves that go in one direction the one whose lambda is nearest to exp(-+ i kappa).

The force follows from the relative displacement w of the contact's masses and from w_0, that of the run without a site:
f = (w - w_0)/g at each frequency, with the response g of w to a pair of opposite forces. It is zero before the first
contact and after the last.

In the undamped limit the energies are those that ``spectra.directions`` finds at the end of a run. With dashpots, waves
that meet or decay near the site are not orthogonal. What arrives and what leaves then differ from the work of f by what
dashpots take there, which goes to zero with them.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.case.law import OneSite
from vipetsc.lattice import bloch
from vipetsc.lattice.damped import Waves, damped_waves
from vipetsc.lattice.sent import amplitudes_sent
from vipetsc.lattice.sites import Pair
from vipetsc.studies.pair_motion import PairMotion
from vipetsc.studies.response import DECAY, self_response

# Nodes of the wavenumber for each cell of the ring. With twice as many, predicted energies change by 0.0004 decades,
# and the CPU time grows by a fifth.
NODES_A_CELL = 1
# Samples before the first contact and after the last in which the force is not zero: the transform of a force that ends
# at a sample rings over a few of them. Half and twice as many change predicted energies by less than 1e-4 decades.
MARGIN = 4


class SentWave(NamedTuple):
    """The wave that forces of 1 N send in one direction: its amplitudes ``by_site`` and ``by_drive`` in m/N.

    A force of the site acts on both masses of the contact, with opposite signs. ``factor`` is the ratio of the
    amplitudes in the next cell in the wave's direction and in this one; ``flux`` in W/m^2 is the mean power past the
    site of a wave whose amplitude is 1 m in the site's cell.
    """

    by_site: complex
    by_drive: complex
    factor: complex
    flux: float


class SiteWaves:
    """The waves at the site of the ring ``setting`` of a ``model`` with dashpots; the contact joins a ``pair``.

    Over (node, band), without dashpots: ``frequency`` in rad/s and ``speed`` |v_g| in cells/s; ``weight`` in rad/s is
    that of a node in the integral over the frequency, 2/pi included. The waves of a drive of 1 N have the spectra
    ``leaving_drive`` at the drive and ``arriving`` at the site, in m s.

    Over (direction, node, band), forward (from the drive to the site and on) before backward: ``sends``, ``flux`` and
    ``factor``, which are the ``by_site``, ``flux`` and ``factor`` of each ``SentWave``.
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
        # d omega = v_g d kappa, and kappa has the steps pi/nodes.
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
        """Return the waves of one band that are sent forward and backward at ``omega`` in rad/s.

        ``up`` is the factor of the band's wave to higher cells without dashpots, near which the damped one lies.
        ``drive_mass`` is the mass, from 0, on which the drive acts.
        """
        waves = damped_waves(self.cell, omega)
        half = len(waves.factor) // 2
        site = self._amplitudes_of_pair(waves)
        unit = np.zeros(self.cell.dofs)
        unit[drive_mass] = 1.0
        drive = np.concatenate(amplitudes_sent(waves, unit, "right"))

        # The first half goes to higher cells. The band's wave to lower cells is its mirror image, with 1/lambda.
        higher = int(np.argmin(np.abs(waves.factor[:half] - up)))
        lower = half + int(np.argmin(np.abs(1 / waves.factor[half:] - up)))
        directions = []
        for wave in (higher, lower):
            factor = waves.factor[wave]
            flux = _power_past_end(waves, wave, omega)
            # Past the cell's other end it is flux/|factor|^2. Past the middle it is the geometric mean of both.
            if not self.pair.offset:
                flux = flux / abs(factor)
            # ``waves`` has the factor to the next higher cell, for waves to lower cells too.
            outwards = factor
            if wave == lower:
                outwards = 1 / factor
            directions.append(SentWave(by_site=site[wave], by_drive=drive[wave], factor=outwards, flux=flux))
        if self.setting.towards < 0:
            directions.reverse()
        return directions[0], directions[1]

    def _amplitudes_of_pair(self, waves: Waves) -> np.ndarray:
        """Return amplitudes (wave,) in m at the site's cell by a force of 1 N on its resonator and -1 N on its host."""
        resonator = np.zeros(self.cell.dofs)
        resonator[self.pair.resonator] = 1.0
        amplitudes = np.concatenate(amplitudes_sent(waves, resonator, "right"))
        # From the next cell, in which the force acts, back to the site's.
        if self.pair.offset:
            amplitudes = amplitudes / waves.factor
        # A contact with the ground has a force on one mass alone.
        if self.pair.host >= 0:
            host = np.zeros(self.cell.dofs)
            host[self.pair.host] = 1.0
            amplitudes = amplitudes - np.concatenate(amplitudes_sent(waves, host, "right"))
        return np.asarray(amplitudes)

    def amplitudes(self, force: np.ndarray | None = None) -> np.ndarray:
        """Return the spectrum (direction, node, band) in m s, in the site's cell, of the waves that leave the site.

        The drive is one of 1 N, ``force`` (time,) in N the contact's force on the resonator under it. Without a force
        the waves of the drive pass.
        """
        passing = np.stack([self.arriving, np.zeros_like(self.arriving)])
        if force is None:
            return passing
        return np.asarray(passing + self.sends * spectrum_of(force, self.setting.interval, self.frequency))

    def energies(self, force: np.ndarray | None = None) -> np.ndarray:
        """Return energies (band, direction) in J that the waves of ``amplitudes`` carry past the site."""
        return np.asarray((self.weight * self.flux * np.abs(self.amplitudes(force)) ** 2).sum(axis=1).T)

    def sent_by_bins(self, force: np.ndarray, bins: int) -> np.ndarray:
        """Return energies (band, bin) in J that the contact's ``force`` (time,) in N sends, by ``bins`` of kappa."""
        amplitudes = self.sends * spectrum_of(force, self.setting.interval, self.frequency)
        energies = (self.weight * self.flux * np.abs(amplitudes) ** 2).sum(axis=0)
        # By whole numbers: with the quotient of two floats a node on the border of bins would be a matter of rounding.
        of_bin = np.arange(len(energies)) * bins // len(energies)
        return np.array([np.bincount(of_bin, column, bins) for column in energies.T])

    @property
    def padded(self) -> int:
        """Length of transforms over time: the samples of a run and as many zeros, into which the response may ring."""
        return 2 * (self.setting.samples + 1)

    @property
    def decay(self) -> float:
        """Rate in 1/s of the window exp(-decay t) of signals: transforms are at the frequencies omega - i decay."""
        return DECAY / (self.padded * self.setting.interval)

    @cached_property
    def response(self) -> np.ndarray:
        """Compliance g (omega,) in m/N of the contact's masses (``self_response``) at the transforms' frequencies."""
        omega = 2 * np.pi * np.fft.rfftfreq(self.padded, self.setting.interval)
        return self_response(self.cell, omega - 1j * self.decay, self.pair)

    def late(self, since: float) -> float:
        """Return the energy in J of waves of the drive's band that take over ``since`` s from the drive to the site."""
        band = self.setting.band
        slow = self.speed[:, band] * since < self.setting.distance
        energy = self.weight * self.flux[0] * np.abs(self.arriving) ** 2
        return float(energy[slow, band].sum())

    def taken_before(self) -> float:
        """Return the share that dashpots take before the site of the energy sent forward in the drive's band."""
        band = self.setting.band
        energies = self.weight * self.flux[0]
        sent = (energies * np.abs(self.leaving_drive) ** 2)[:, band].sum()
        arrives = (energies * np.abs(self.arriving) ** 2)[:, band].sum()
        return float(1 - arrives / sent)

    def force(self, motion: PairMotion, linear: np.ndarray, begin: float, end: float) -> np.ndarray:
        """Return the contact's force (time,) in N on the resonator, opposite on the host, by a ``motion`` of the pair.

        ``linear`` (time,) in m is the relative displacement without the contact, which is first touched at ``begin`` s
        and left for good at ``end`` s.
        """
        time = motion.time
        by_contact = motion.displacement[:, 0] - linear
        spectrum = np.fft.rfft(by_contact * np.exp(-self.decay * time), self.padded) / self.response
        force = np.fft.irfft(spectrum, self.padded)[: len(time)] * np.exp(self.decay * time)
        # Outside of the contact the transform has rounding errors, and near the end of the record the force that would
        # stop the motion where the record is cut off.
        margin = MARGIN * self.setting.interval
        touching = (time >= begin - margin) & (time <= end + margin)
        return np.where(touching, force, 0.0)


def _power_past_end(waves: Waves, wave: int, omega: float) -> float:
    """Return the mean power in W through springs from a cell to the next higher one, of a ``wave`` of 1 m there.

    A dashpot parallel to a spring takes a part of the power, so that the two ends of the spring pass on different
    powers. What the spring alone carries is their mean, to the second order in the dashpot.
    """
    shape = waves.shape[:, wave]
    elastic = waves.coupling.real
    return float(abs(omega / 2 * np.imag(waves.factor[wave] * (shape.conj() @ elastic @ shape))))


def spectrum_of(signal: np.ndarray, step: float, omega: np.ndarray) -> np.ndarray:
    """Return the Fourier integral of a ``signal`` (time,), sampled each ``step`` s from 0, at ``omega`` (...) in rad/s.

    It has the shape of ``omega`` and the unit of the signal times s.
    """
    # With n = b m + k the factor exp(-i omega t_n) is that of the block b times that of the sample k in it: for N
    # samples 2 N^(1/2) exponentials a frequency are computed, not N.
    block = int(np.ceil(np.sqrt(len(signal))))
    padded = np.zeros(block * block)
    padded[: len(signal)] = signal
    within = np.exp(-1j * np.multiply.outer(step * np.arange(block), omega.ravel()))
    between = np.exp(-1j * np.multiply.outer(step * block * np.arange(block), omega.ravel()))
    sums = padded.reshape(block, block) @ within
    return np.asarray(step * (sums * between).sum(axis=0).reshape(omega.shape))
