"""Response of one site to a wave: contact force and energies, as functions of the wave's instantaneous amplitude.

A burst meets a site in a lattice so long that nothing returns. With w the relative displacement of the contact pair,
w_0 that of the lattice without contacts and g(omega) the response of w to a pair of opposite forces in the infinite
lattice, the contact's force is f = (w - w_0)/g at every frequency. Near the drive's frequency Om,
w_0 = Re c exp(i Om t) and f = Re f1 exp(i Om t), near 3 Om f = Re f3 exp(3 i Om t).

A site counts as in contact from the instant at which z = |c|/D, D being the clearance, exceeds 1 until the last contact
of the burst ends. The z at that instant, the ``release``, is read from the run. While a site is in contact, force, loss
and transfer are taken as functions of z alone: they are averaged over bins of log z, over the burst's rise and its
fall, and over runs of several amplitudes. A burst whose own sums differ from these averages has a correction factor for
its loss and for each band. Factor and release are looked up by the largest z of a burst.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from vipetsc.io.records import Record
from vipetsc.lattice import Band, Chain, OpenCompliance, UnitCell, WaveCompliance, bloch, pass_bands, sites_at, waves_at
from vipetsc.lattice.sites import Pair

# Changes of energies below are those of predicted energies of bands, whose error is 0.1 decades.
LOWEST = 0.15  # z of the first bin, to which smaller ones count; half and twice of it change energies by 0.02 decades
BINS = 40  # of log z; half as many change energies by 0.02 decades, twice as many by 0.03
# Windows fall by e^-4 over the transformed time, so that little of a response is folded back. With e^-2 energies change
# by 0.004 decades; with e^-8, which amplifies the end of the record, by 0.02.
DECAY = 4.0
TINY = 1e-300  # in place of zero in a divisor
# Rows of ``Burst.sums``; from ``INTO`` on there is one a band.
SQUARE, FUNDAMENTAL_REAL, FUNDAMENTAL_IMAGINARY, THIRD_REAL, THIRD_IMAGINARY, GIVEN, DISSIPATED = range(7)
INTO = slice(7, None)
# Half-widths of the lines at Om and 3 Om, over Om: what belongs to other lines is cut off. With 0.2 or 0.45 at Om
# energies change by 0.012 decades, with 0.2 or 0.6 at 3 Om by 0.002.
FIRST_LINE = 0.3
THIRD_LINE = 0.4
# Forces are followed up to this many times the top band's edge: above, g falls as 1/omega^2 and (w - w_0)/g is noise.
# From 1 to 1.5 energies are the same to 1e-4 decades.
TOP = 1.02


def self_response(cell: UnitCell, omega: np.ndarray, pair: Pair) -> np.ndarray:
    """Return the compliance g (omega,) in m/N of a ``pair`` in an infinite lattice of ``cell``.

    It is the relative displacement of the pair by opposite unit forces on its masses. ``omega`` (omega,) in rad/s lie
    below the real axis, where the waves that decay away from the pair are those that leave it.
    """
    if cell.is_damped:
        # A segment of two cells, since a contact may join neighbours, with the lattice going on at both ends.
        chain = Chain(cell, 2, sites=sites_at([0], pair))
        return OpenCompliance(chain, open_ends=("left", "right")).at(omega)[:, 0, 0]
    return WaveCompliance(Chain(cell, 1, sites=sites_at([0], pair)), infinite=True).at(omega)[:, 0, 0]


class TravellingWave(NamedTuple):
    """The fastest wave at a frequency: its ``band`` from 0, ``wavenumber`` in rad per cell, ``speed`` |v_g| in cells/s.

    ``power_per_area`` in W/m^2 is the power that it carries over |w|^2, w being the complex amplitude of the relative
    displacement of a pair of masses in it.
    """

    band: int
    wavenumber: float
    speed: float
    power_per_area: float


def fastest_wave(cell: UnitCell, omega: float, pair: Pair) -> TravellingWave | None:
    """Return the fastest wave at ``omega`` in rad/s, with the relative displacement of a ``pair``; None in a gap."""
    waves = waves_at(cell, omega)
    if not waves:
        return None

    # The vectors have M-norm 1: a mode of amplitude q has the energy omega^2 |q|^2/2, and w = relative * q.
    number, kappa, speed = max(waves, key=lambda wave: wave[2])
    vector = bloch(cell, kappa).vectors[:, number - 1]
    w = vector[pair.resonator]
    # The next cell moves as this one does, times Bloch's factor.
    if pair.offset:
        w = w * np.exp(1j * kappa)
    # The ground does not move.
    if pair.host >= 0:
        w = w - vector[pair.host]
    relative = abs(w)
    return TravellingWave(
        band=number - 1, wavenumber=kappa, speed=speed, power_per_area=speed * omega**2 / (2 * max(relative, TINY) ** 2)
    )


def in_contact(z: np.ndarray, release: np.ndarray) -> np.ndarray:
    """Return whether sites (site, time) are in contact: from z > 1 until z < ``release`` (site)."""
    on = np.zeros(z.shape, bool)
    state = np.zeros(len(z), bool)
    # Instant by instant: between release and 1 the state before decides.
    for i, now in enumerate(z.T):
        state = np.where(state, now >= release, now > 1)
        on[:, i] = state
    return on


def unit_phase(c: np.ndarray) -> np.ndarray:
    """Return c/|c| of complex numbers ``c`` (...); 0 where c is."""
    return c / np.maximum(np.abs(c), TINY)


@dataclass(frozen=True)
class SiteRun:
    """A run with one site, at the samples of its ``Burst``.

    ``amplitude`` of the drive in N; ``clearance`` in m; ``displacement`` (time) is w in m; ``dissipated`` (time) is the
    energy in J that the contact has dissipated since the beginning; ``last_contact`` is the time in s at which the last
    contact ends, NaN if there is none.
    """

    amplitude: float
    clearance: float
    displacement: np.ndarray
    dissipated: np.ndarray
    last_contact: float


class Burst:
    """The linear wave at a site under 1 N, and the transforms by which runs with a contact are compared with it.

    ``time`` (time,) in s is uniform, ``w`` (time,) in m the relative displacement of the ``pair``, ``drive`` the
    frequency in rad/s of the burst. Over the frequencies ``omega`` (omega,) in rad/s, shifted by -i ``decay``, are the
    compliance ``g`` in m/N and the spectrum ``linear`` of w; ``c`` (time,) in m is the envelope of w about ``drive``.
    """

    def __init__(self, cell: UnitCell, drive: float, time: np.ndarray, w: np.ndarray, pair: Pair) -> None:
        self.cell = cell
        self.drive = drive
        self.time = time
        self.step = float(time[1] - time[0])
        # Padded to twice the time, so that the transform's period does not fold the response back.
        self.padded = 2 * len(time)
        self.decay = DECAY / (self.padded * self.step)
        self.omega = 2 * np.pi * np.fft.rfftfreq(self.padded, self.step)
        self.g = self_response(cell, self.omega - 1j * self.decay, pair)
        self.bands: tuple[Band, ...] = pass_bands(cell)
        self.linear = self.spectrum(w)
        self.c = self.envelope(self.linear, drive, FIRST_LINE * drive)

    def spectrum(self, w: np.ndarray) -> np.ndarray:
        """Return Fourier transform (omega,) of a signal ``w`` (time,) at ``omega`` - i decay."""
        return np.asarray(np.fft.rfft(w * np.exp(-self.decay * self.time), self.padded))

    def envelope(self, spectrum: np.ndarray, middle: float, half: float) -> np.ndarray:
        """Return the envelope a (time,) of a signal's part Re a exp(i middle t), from its ``spectrum`` (omega,).

        The part has the frequencies that are less than ``half`` from ``middle``, both in rad/s.
        """
        # A real signal has half of Re a exp(i middle t) at positive frequencies, hence twice the spectrum.
        part = np.zeros(self.padded, complex)
        part[: len(self.omega)] = np.where(np.abs(self.omega - middle) < half, 2 * spectrum, 0)
        return np.asarray(np.fft.ifft(part)[: len(self.time)] * np.exp((self.decay - 1j * middle) * self.time))

    def sums(self, run: SiteRun, largest: float) -> Record:
        """Return sums over the samples of a ``run`` in contact, as its record holds them.

        ``sums`` (quantity, bin) are over bins of log z, the first of ``LOWEST``, the last of ``largest``. The
        quantities are |c|^2 in m^2 (``SQUARE``), Re and Im of f1 c*, Re and Im of f3 (c*/|c|)^3 |c| in N m, the power
        in W that the driven wave gives (``GIVEN``), the power dissipated (``DISSIPATED``), and the power into each band
        (``INTO``). ``totals`` are the sums of the last two over all samples, in contact or not. ``release`` is the z at
        which the last contact ends, at most 1; 1 without any contact.
        """
        c = run.amplitude * self.c
        incident = run.amplitude * self.linear
        carried = self.omega < TOP * self.bands[-1].high
        force = np.where(carried, (self.spectrum(run.displacement) - incident) / self.g, 0)
        powers = [np.gradient(run.dissipated, self.step), *self._band_powers(force)]
        rows = [*self._force_rows(c, force, incident), *powers]

        z = np.abs(c) / run.clearance
        touched = np.isfinite(run.last_contact)
        release = 1.0
        if touched:
            # At most 1, where contact begins: a higher release would end it in the same instant.
            release = min(float(np.interp(run.last_contact, self.time, z)), 1.0)
        on = in_contact(z[None], np.array([release]))[0] & touched

        grid = np.linspace(np.log(LOWEST), np.log(largest), BINS)
        position = (np.log(np.maximum(z[on], LOWEST)) - grid[0]) / (grid[1] - grid[0])
        # To the nearest bin, with no interpolation: sums of bins are then sums over disjoint samples.
        nearest = np.clip(np.rint(position), 0, BINS - 1).astype(int)
        return {
            "sums": [np.bincount(nearest, row[on], BINS).tolist() for row in rows],
            "totals": [float(row.sum()) for row in powers],
            "release": release,
        }

    def _force_rows(self, c: np.ndarray, force: np.ndarray, incident: np.ndarray) -> list[np.ndarray]:
        """Return the quantities of ``sums`` from ``SQUARE`` to ``GIVEN``, each over time."""
        drive = self.drive
        f1 = self.envelope(force, drive, FIRST_LINE * drive)
        f3 = self.envelope(force, 3 * drive, THIRD_LINE * drive)
        velocity = self.envelope(self._rate() * (self.g * force + incident), drive, FIRST_LINE * drive)
        fundamental = f1 * c.conj()
        third = f3 * unit_phase(c.conj()) ** 3 * np.abs(c)
        return [
            np.abs(c) ** 2,
            fundamental.real,
            fundamental.imag,
            third.real,
            third.imag,
            -0.5 * (f1 * velocity.conj()).real,
        ]

    def _band_powers(self, force: np.ndarray) -> list[np.ndarray]:
        """Return the power in W that the ``force`` radiates into each band, over time."""
        powers = []
        for band in self.bands:
            middle = (band.low + band.high) / 2
            half = (band.high - band.low) / 2
            f = self.envelope(force, middle, half)
            velocity = self.envelope(self._rate() * self.g * force, middle, half)
            powers.append(0.5 * (f * velocity.conj()).real)
        return powers

    def _rate(self) -> np.ndarray:
        """Return factor (omega) that turns a spectrum into that of the time derivative."""
        return np.asarray(1j * (self.omega - 1j * self.decay))


class ContactState(NamedTuple):
    """What a site in contact does at the amplitudes z (...): the quantities of ``SiteResponse``, interpolated.

    ``fundamental``, ``third`` and ``lost`` are (...), ``into`` is (band, ...).
    """

    fundamental: np.ndarray
    third: np.ndarray
    lost: np.ndarray
    into: np.ndarray


class BurstState(NamedTuple):
    """Values for whole bursts of given largest z (...): the correction factors, the release and the spectra.

    ``lost`` (...) and ``into`` (band, ...) are the factors of the loss and of the power into each band, ``release``
    (...) the z at which contact ends, ``spectrum`` (..., band, bin) the fractions of the energy in a band that each bin
    of the wavenumber gets.
    """

    lost: np.ndarray
    into: np.ndarray
    release: np.ndarray
    spectrum: np.ndarray


class SiteResponse(NamedTuple):
    """Response of a site in contact as a function of z = exp(x), at the bins ``x`` (x,) of ``Burst.sums``.

    ``fundamental`` (x,) is f1/c and ``third`` (x,) is f3 (c*/|c|)^3/|c|, both complex, in N/m. ``lost`` (x,) and
    ``into`` (band, x) are powers over the power of a travelling wave of the same |c|: what the contact dissipates, and
    what it sends into every band. The driven band has 0 there, and the others are scaled such that with ``lost`` they
    add up to what the driven wave gives.

    The rest is over the runs, whose bursts have the largest z exp(``peaks``) (run,), see ``BurstState``: ``factor``
    (1 + band, run), of the loss and of each band, is a run's own energy over that by the averages; ``release`` (run,);
    ``spectrum`` (band, bin, run), without bins if the lattice has no dashpots.
    """

    x: np.ndarray
    fundamental: np.ndarray
    third: np.ndarray
    lost: np.ndarray
    into: np.ndarray
    peaks: np.ndarray
    factor: np.ndarray
    release: np.ndarray
    spectrum: np.ndarray

    @classmethod
    def of(cls, records: list[Record], cell: UnitCell, drive: float, largest: float, pair: Pair) -> Self:
        """Return the response of a ``pair`` from the ``records`` of all runs, in any order; zero if none had a contact.

        ``drive`` is the frequency in rad/s, ``largest`` the z of the last bin, as ``Burst.sums`` was given them.
        """
        # By z: interpolation needs rising peaks, and sums an order that does not depend on which run ended first.
        records = sorted(records, key=lambda record: record["z"])
        x = np.linspace(np.log(LOWEST), np.log(largest), BINS)
        sums = np.array([record["sums"] for record in records])
        peaks = np.log([record["z"] for record in records])
        release = np.array([record["release"] for record in records])
        spectrum = np.stack([_fractions(record.get("spectrum", [[]] * cell.dofs)) for record in records], axis=-1)
        wave = fastest_wave(cell, drive, pair)
        squares = sums[:, SQUARE]
        total = sums.sum(axis=0)
        seen = total[SQUARE] > 0
        if wave is None or not seen.any():
            return cls(
                x=x,
                fundamental=0j * x,
                third=0j * x,
                lost=0 * x,
                into=np.zeros((cell.dofs, BINS)),
                peaks=peaks,
                factor=np.ones((1 + cell.dofs, len(peaks))),
                release=release,
                spectrum=spectrum,
            )

        # Means over samples, weighted by |c|^2. A bin without samples takes the line between its neighbours that have
        # some, or the nearest value where it has them on one side alone.
        mean = np.array([np.interp(x, x[seen], row[seen] / total[SQUARE][seen]) for row in total])
        given = mean[GIVEN] / wave.power_per_area
        lost = np.maximum(mean[DISSIPATED], 0)
        into = mean[INTO].copy()
        into[wave.band] = 0
        into = np.maximum(into, 0)
        # The filter of a band spreads its power over the inverse of the band's width in time: in a bin the powers need
        # not sum to what is given. Their ratios are kept, and their sum is set.
        scale = np.maximum(given, 0) / np.maximum(into.sum(axis=0) + lost, TINY)
        table = np.array([lost * scale, *(into * scale)])

        totals = np.array([record["totals"] for record in records]).T / wave.power_per_area
        composed = table @ squares.T
        factor = np.where(composed > 0, np.maximum(totals, 0) / np.maximum(composed, TINY), 1.0)
        # ``into`` is 0 in the driven band, so no factor follows from the sums.
        factor[1 + wave.band] = 1.0
        return cls(
            x=x,
            fundamental=mean[FUNDAMENTAL_REAL] + 1j * mean[FUNDAMENTAL_IMAGINARY],
            third=mean[THIRD_REAL] + 1j * mean[THIRD_IMAGINARY],
            lost=table[0],
            into=table[1:],
            peaks=peaks,
            factor=factor,
            release=release,
            spectrum=spectrum,
        )

    def at(self, z: np.ndarray) -> ContactState:
        """Return response at amplitudes ``z`` (...) in clearances; beyond the bins that of the first or last one."""
        x = np.log(np.maximum(z, LOWEST))
        return ContactState(
            fundamental=self._interpolated(x, self.fundamental),
            third=self._interpolated(x, self.third),
            lost=np.interp(x, self.x, self.lost),
            into=np.array([np.interp(x, self.x, row) for row in self.into]),
        )

    def _interpolated(self, x: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return complex ``values`` (bin,) of the response, interpolated at ``x`` (...)."""
        return np.asarray(np.interp(x, self.x, values.real) + 1j * np.interp(x, self.x, values.imag))

    def over_bursts(self, largest: np.ndarray) -> BurstState:
        """Return factors, release and spectra of bursts with these ``largest`` z (...), at most the last run's."""
        x = np.log(np.maximum(largest, TINY))
        factors = np.array([np.interp(x, self.peaks, row) for row in self.factor])
        spectrum = np.zeros((*np.shape(x), *self.spectrum.shape[:-1]))
        for band, of_bin in np.ndindex(self.spectrum.shape[:-1]):
            spectrum[..., band, of_bin] = np.interp(x, self.peaks, self.spectrum[band, of_bin])
        return BurstState(
            lost=factors[0], into=factors[1:], release=np.interp(x, self.peaks, self.release), spectrum=spectrum
        )


class SiteResponses(NamedTuple):
    """The responses of all sites: ``of_kind`` holds that of each kind, ``kind`` (site,) the number of a site's kind."""

    of_kind: tuple[SiteResponse, ...]
    kind: np.ndarray

    def of_site(self, site: int) -> SiteResponse:
        """Return the response of one ``site`` (from 0)."""
        return self.of_kind[self.kind[site]]

    def at(self, z: np.ndarray) -> ContactState:
        """Return what sites in contact do at the amplitudes ``z`` (site, time), in clearances."""
        if len(self.of_kind) == 1:
            return self.of_kind[0].at(z)
        states = [self.of_site(site).at(row) for site, row in enumerate(z)]
        return ContactState(
            fundamental=np.array([state.fundamental for state in states]),
            third=np.array([state.third for state in states]),
            lost=np.array([state.lost for state in states]),
            into=np.stack([state.into for state in states], axis=1),
        )

    def over_bursts(self, largest: np.ndarray) -> BurstState:
        """Return factors, release and spectra of bursts with these ``largest`` z (site,)."""
        if len(self.of_kind) == 1:
            return self.of_kind[0].over_bursts(largest)
        states = [self.of_site(site).over_bursts(np.asarray(z)) for site, z in enumerate(largest)]
        return BurstState(
            lost=np.array([state.lost for state in states]),
            into=np.stack([state.into for state in states], axis=1),
            release=np.array([state.release for state in states]),
            spectrum=np.array([state.spectrum for state in states]),
        )


def _fractions(energies: list[list[float]]) -> np.ndarray:
    """Return the ``energies`` (band, bin) over their sums in each band; 0 in a band without energy."""
    values = np.array(energies)
    sums = values.sum(axis=1, keepdims=True)
    return np.divide(values, sums, out=np.zeros_like(values), where=sums > 0)
