"""Losses of the waves between sites in dashpots and absorbing ends, until the end of the run.

Waves in other bands than the drive's fade along rays (``studies.rays``). The driven wave is one of interference: its
energy at the end is that of the run without contacts less all that it gives to contacts, to other bands and to the
ends in the meantime, each faded by the dashpots of the cells since then,

    E = E_0 - integral (P_given + P_ends - P_ends,0) exp(-2 gamma (t_end - t)) dt,

with the rate 2 gamma of the wave of the drive's frequency. The power P_ends that absorbing ends take follows from the
forces of contacts and drive and the compliance of the lattice, with and without (0) contacts.
"""

from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.lattice.direct_compliance import DirectCompliance
from vipetsc.studies.rays import Rays
from vipetsc.studies.response import TravellingWave
from vipetsc.studies.spectral_line import SpectralLine


class SentPowers(NamedTuple):
    """Powers in W (site, time) that contacts send out and take in a lattice with dashpots.

    ``bands`` (band, site, time) is what goes to bands other than the drive's, and ``spectrum`` (site, band, bin) the
    fractions of it in bins of the wavenumber; ``third`` is the gain of third harmonics together, ``given`` all that the
    driven wave loses. ``force`` (site, time) in N is the envelope of the contacts' forces about the drive's frequency.
    """

    bands: np.ndarray
    spectrum: np.ndarray
    third: np.ndarray
    given: np.ndarray
    force: np.ndarray


class AtEnd(NamedTuple):
    """Energies in J at the end: ``remaining`` (band,), in the drive's band its change, and ``absorbed`` by ends."""

    remaining: np.ndarray
    absorbed: float


class WaveLosses:
    """The dashpots of a ``model``, for waves of the frequency ``middle`` in rad/s and of its third harmonic.

    ``driving`` (drive, offset) are spectra about it of the drives in N, under a drive of 1 N (1 m of a wall).
    """

    def __init__(
        self,
        model: Model,
        line: SpectralLine,
        compliance: DirectCompliance,
        middle: float,
        driving: np.ndarray,
        driven: TravellingWave,
        third: TravellingWave | None,
    ) -> None:
        self.sites = model.chain.sites
        self.line = line
        self.driving = driving
        self.driven = driven
        self.third = third
        self.rays = Rays(model, line.time)
        self.during = line.time <= model.end

        # The motions of masses with dashpots that the reference cell has not.
        (masses,) = np.nonzero(self.rays.extra.ravel())
        self.dashpots = self.rays.extra.ravel()[masses]
        rows = np.zeros((self.rays.extra.size, len(masses)))
        rows[masses, np.arange(len(masses))] = 1.0
        # Damped, so that the transform's period does not fold the response back.
        omega = middle + line.offset - 1j * line.decay
        motions = compliance.motion(omega, rows) if len(masses) else np.zeros((len(omega), 0, 0))
        self.velocities = 1j * omega[:, None, None] * motions

    @property
    def has_ends(self) -> bool:
        """Whether there are absorbing ends."""
        return len(self.dashpots) > 0

    def rate(self, wave: TravellingWave) -> float:
        """Rate in 1/s at which the dashpots of the cells take the energy of a ``wave``."""
        return self.rays.rate(wave.band, wave.wavenumber)

    def at_end(self, sent: SentPowers, amplitude: float) -> AtEnd:
        """The energies at the end of a run under ``amplitude`` in N (of a wall m)."""
        step = float(self.line.time[1])
        remaining = np.zeros(len(sent.bands))
        absorbed = 0.0
        for number, cell in enumerate(self.sites):
            left = self.rays.of_bands(cell, sent.spectrum[number])
            remaining += (sent.bands[:, number] * left.remaining).sum(axis=1) * step
            absorbed += float((sent.bands[:, number] * left.absorbed).sum()) * step
            if self.third:
                of_third = self.rays.of_wave(cell, self.third.band, self.third.wavenumber)
                remaining[self.third.band] += float(sent.third[number] @ of_third.remaining) * step
                absorbed += float(sent.third[number] @ of_third.absorbed) * step
        # Rounding may leave a negative energy where nothing is sent.
        remaining = np.maximum(remaining, 0.0)

        # The difference: what ends take without contacts is in the energy of the run without them already.
        in_ends = self._power_in_ends(amplitude, sent.force) - self._power_in_ends(amplitude)
        since = np.exp(-self.rate(self.driven) * self.rays.since)
        remaining[self.driven.band] = -float((sent.given.sum(axis=0) + in_ends) @ since) * step
        return AtEnd(remaining, absorbed + float(in_ends.sum()) * step)

    def absorbed_without_contacts(self) -> float:
        """Energy in J that absorbing ends take in the run without contacts, under a drive of 1 N (1 m of a wall)."""
        return float(self._power_in_ends(1.0).sum()) * float(self.line.time[1])

    def _power_in_ends(self, amplitude: float, force: np.ndarray | None = None) -> np.ndarray:
        """Power (time,) in W that absorbing ends take from the driven wave, averaged over a period.

        ``force`` (site, time) in N are the envelopes of contacts' forces, without any if there are none.
        """
        if not self.has_ends:
            return np.zeros(len(self.line.time))
        of_sites = np.zeros((len(self.sites), len(self.line.offset)), complex)
        if force is not None:
            of_sites = self.line.forward(force)
        forces = np.vstack([of_sites, abs(amplitude) * self.driving])
        velocity = self.line.backward(np.einsum("wms,sw->mw", self.velocities, forces))
        # Half, the mean of a squared cosine. The line's time goes on beyond the run.
        return np.where(self.during, 0.5 * self.dashpots @ np.abs(velocity) ** 2, 0.0)
