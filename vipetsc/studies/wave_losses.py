"""Losses of the waves between sites in dashpots and absorbing ends, until the end of the run.

Waves in other bands than the drive's fade along rays (``studies.rays``). In the drive's band the waves of the drive and
of the sites interfere, so that their energies do not add. There the energy E at the end follows from the balance of the
driven wave: it is E_0, that of the run without contacts, less all that the wave has given since, each part faded by the
dashpots of the cells from then on,

    E = E_0 - integral (P_given + P_ends - P_ends,0) exp(-2 gamma (t_end - t)) dt.

P_given is the power that goes to contacts, to other bands and to harmonics. P_ends is the power that absorbing ends
take, which follows from the forces of contacts and drive by the compliance of the lattice; E_0 has lost P_ends,0, the
same without contacts. 2 gamma is the rate of the wave at the drive's frequency. Envelopes about it have the
frequencies and instants of a ``SpectralLine``.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.lattice.compliance.by_elimination import DirectCompliance
from vipetsc.studies.rays import Rays
from vipetsc.studies.response import DECAY, TravellingWave


@dataclass(frozen=True)
class SpectralLine:
    """A grid of the frequencies within ``half`` rad/s of a middle, and of the instants of envelopes about it.

    A signal about the frequency middle in rad/s is Re a exp(i middle t) with the envelope a. ``length`` in s is twice
    the time of the run: in its second half responses die away that the transform, which is periodic, would otherwise
    fold back into the run.
    """

    half: float
    length: float

    @cached_property
    def most(self) -> int:
        """Number of frequencies above the middle, and of those below it."""
        return int(np.ceil(self.half * self.length / (2 * np.pi)))

    @cached_property
    def offset(self) -> np.ndarray:
        """The frequencies (offset,) in rad/s, relative to the middle."""
        return 2 * np.pi * np.arange(-self.most, self.most + 1) / self.length

    @cached_property
    def time(self) -> np.ndarray:
        """The instants (time,) in s of envelopes, as many as there are frequencies."""
        return np.arange(len(self.offset)) * self.length / len(self.offset)

    @property
    def decay(self) -> float:
        """Rate in 1/s of the window exp(-decay t) of envelopes: spectra are at the frequencies offset - i decay."""
        return DECAY / self.length

    def forward(self, a: np.ndarray) -> np.ndarray:
        """Return the spectrum (..., offset) of an envelope ``a`` (..., time): a sum, without the step in s."""
        return np.asarray(np.fft.fftshift(np.fft.fft(a * np.exp(-self.decay * self.time)), axes=-1))

    def backward(self, spectrum: np.ndarray) -> np.ndarray:
        """Return the envelope (..., time) of a spectrum (..., offset)."""
        return np.asarray(np.fft.ifft(np.fft.ifftshift(spectrum, axes=-1)) * np.exp(self.decay * self.time))


class SentPowers(NamedTuple):
    """Powers that the contacts send out in a lattice with dashpots, and their forces.

    ``bands`` (band, site, time) in W is what goes to bands other than the drive's; ``spectrum`` (site, band, bin) are
    the fractions of a band's energy in bins of the wavenumber. ``third`` (site, time) in W is what the third harmonics
    of all sites carry beyond those of each site alone, which are in ``bands``. ``given`` (site, time) in W is all that
    the driven wave gives. ``force`` (site, time) in N is the envelope of the contact's force about the drive's
    frequency.
    """

    bands: np.ndarray
    spectrum: np.ndarray
    third: np.ndarray
    given: np.ndarray
    force: np.ndarray


class EndEnergies(NamedTuple):
    """Energies in J at the end of the run, as the contacts have changed them.

    ``remaining`` (band,) are the energies of the bands, in the drive's band its change by the contacts; ``absorbed`` is
    the change of what absorbing ends have taken.
    """

    remaining: np.ndarray
    absorbed: float


class WaveLosses:
    """What the dashpots of a ``model`` take of waves about the frequency ``middle`` in rad/s and of their harmonics.

    ``line`` is the grid of frequencies about ``middle``, ``compliance`` that of the lattice with its dashpots.
    ``driving`` (drive, offset) are the spectra of the drives' forces in N, under a drive of 1 N (or 1 m of a wall).
    ``driven`` is the wave of the drive's frequency, ``third`` that of its triple, None where there is none.
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
        self.sites = model.chain.sites.cells.tolist()
        self.line = line
        self.driving = driving
        self.driven = driven
        self.third = third
        self.rays = Rays(model, line.time)
        self.during = line.time <= model.end

        # The masses of absorbing ends, which have dashpots that the reference cell has not, and for each a column that
        # selects its displacement.
        (masses,) = np.nonzero(self.rays.extra.ravel())
        self.dashpots = self.rays.extra.ravel()[masses]
        rows = np.zeros((self.rays.extra.size, len(masses)))
        rows[masses, np.arange(len(masses))] = 1.0

        # Velocities (offset, mass, force) of these masses under unit forces at the sites and of the drives, at the
        # frequencies of ``line``.
        omega = middle + line.offset - 1j * line.decay
        motions = compliance.motion(omega, rows) if len(masses) else np.zeros((len(omega), 0, 0))
        self.velocities = 1j * omega[:, None, None] * motions

    @property
    def has_ends(self) -> bool:
        """Whether there are absorbing ends."""
        return len(self.dashpots) > 0

    def rate(self, wave: TravellingWave) -> float:
        """Return the rate in 1/s at which the dashpots of the cells take the energy of a ``wave``."""
        return self.rays.rate(wave.band, wave.wavenumber)

    def at_end(self, sent: SentPowers, amplitude: float) -> EndEnergies:
        """Return energies at the end of a run under ``amplitude`` in N (m of a wall) whose contacts have ``sent``."""
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
        # The third harmonics may lie in the drive's band, whose change may be negative; the other bands have energies,
        # of which rounding, or third harmonics that cancel each other, may leave less than nothing.
        in_driven_band = remaining[self.driven.band]
        remaining = np.maximum(remaining, 0.0)

        # What the ends take without contacts is missing from the energy of the run without them already.
        in_ends = self._power_in_ends(amplitude, sent.force) - self._power_in_ends(amplitude)
        since = np.exp(-self.rate(self.driven) * self.rays.since)
        remaining[self.driven.band] = in_driven_band - float((sent.given.sum(axis=0) + in_ends) @ since) * step
        return EndEnergies(remaining=remaining, absorbed=absorbed + float(in_ends.sum()) * step)

    def absorbed_without_contacts(self) -> float:
        """Return the energy in J that absorbing ends take without contacts, under a drive of 1 N (1 m of a wall)."""
        return float(self._power_in_ends(1.0).sum()) * float(self.line.time[1])

    def _power_in_ends(self, amplitude: float, force: np.ndarray | None = None) -> np.ndarray:
        """Return power (time,) in W that absorbing ends take from the driven wave, averaged over a period of the drive.

        ``force`` (site, time) in N are the envelopes of the contacts' forces; None for the run without contacts.
        """
        if not self.has_ends:
            return np.zeros(len(self.line.time))
        of_sites = np.zeros((len(self.sites), len(self.line.offset)), complex)
        if force is not None:
            of_sites = self.line.forward(force)
        forces = np.vstack([of_sites, abs(amplitude) * self.driving])
        velocity = self.line.backward(np.einsum("wms,sw->mw", self.velocities, forces))
        # Half is the mean of a squared cosine. The second half of the line's time is no part of the run.
        return np.where(self.during, 0.5 * self.dashpots @ np.abs(velocity) ** 2, 0.0)
