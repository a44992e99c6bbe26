"""Response of one site to a wave: contact force and energies, as functions of the wave's instantaneous amplitude.

A burst meets a site in a lattice so long that nothing returns. With w the relative displacement of the contact pair,
w_0 that of the lattice without contacts and g(omega) the response of w to a pair of opposite forces at the infinite
lattice, the contact's force is f = (w - w_0)/g at every frequency. Near the drive's frequency Om,
w_0 = Re c exp(i Om t) and f = Re f1 exp(i Om t), near 3 Om f = Re f3 exp(3 i Om t). Once |c| exceeds the clearance D,
contact goes on until the last one ends, at the z = |c|/D that the run shows (``release``). Meanwhile all of it is taken
for a function of z, averaged over bins of log z, over the burst's rise and fall and over runs of several amplitudes.
A factor corrects the loss and the transfer of a whole burst. Both the factor and the release are those of bursts with
the same largest z.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from vipetsc.io.records import Record
from vipetsc.lattice import Band, Chain, OpenCompliance, UnitCell, WaveCompliance, bloch, pass_bands, waves_at
from vipetsc.lattice.chain import Pair

# The z of the first of the bins, below which no contact goes on. Half and twice of it change predicted energies by 0.02
# decades, a fifth of the prediction's error.
LOWEST = 0.15
# Bins of log z. With half as many energies change by 0.02 decades, with twice as many by 0.03, where the
# prediction's error is 0.1.
BINS = 40
DECAY = 4.0  # windows fall by e^-4 over the transformed time, so that no response is folded back
TINY = 1e-300  # in place of zero in a divisor
# The quantities that are summed over the samples of a run, in the order of the rows of ``Burst.sums``.
SQUARE, FUNDAMENTAL_REAL, FUNDAMENTAL_IMAGINARY, THIRD_REAL, THIRD_IMAGINARY, GIVEN, DISSIPATED = range(7)
INTO = slice(7, None)
# Half-widths of the lines at Om and 3 Om, over Om: frequencies outside the signal's own line are cut off.
FIRST_LINE = 0.3
THIRD_LINE = 0.4
# Forces are followed up to this many times the top band's edge: above, g falls as 1/omega^2 and (w - w_0)/g is noise.
TOP = 1.02


def self_response(cell: UnitCell, omega: np.ndarray, pair: Pair) -> np.ndarray:
    """g (omega) in m/N of a ``pair`` in an infinite lattice at frequencies ``omega`` in rad/s, below the real axis."""
    if cell.is_damped:
        # Two cells, for a contact that joins them, which go on in both directions.
        chain = Chain(cell, 2, sites=(0,), pairs=(pair,))
        return OpenCompliance(chain, open_ends=("left", "right")).at(omega)[:, 0, 0]
    return WaveCompliance(Chain(cell, 1, sites=(0,), pairs=(pair,)), infinite=True).at(omega)[:, 0, 0]


class TravellingWave(NamedTuple):
    """The fastest wave at a frequency: its ``band`` from 0, |v_g| ``speed`` in cells/s, power over |w|^2 in W/m^2.

    w is the relative displacement of a pair of masses; ``wavenumber`` is in rad per cell.
    """

    band: int
    wavenumber: float
    speed: float
    power_per_area: float


def fastest_wave(cell: UnitCell, omega: float, pair: Pair) -> TravellingWave | None:
    """The fastest wave at ``omega`` in rad/s, with the relative displacement of a ``pair``; None in a gap."""
    waves = waves_at(cell, omega)
    if not waves:
        return None

    number, kappa, speed = max(waves, key=lambda wave: wave[2])
    vector = bloch(cell, kappa).vectors[:, number - 1]
    w = vector[pair.resonator]
    # The next cell moves as this one does, times Bloch's factor.
    if pair.next_cell:
        w = w * np.exp(1j * kappa)
    # The ground does not move.
    if pair.host >= 0:
        w = w - vector[pair.host]
    relative = abs(w)
    return TravellingWave(
        band=number - 1, wavenumber=kappa, speed=speed, power_per_area=speed * omega**2 / (2 * max(relative, TINY) ** 2)
    )


def in_contact(z: np.ndarray, release: np.ndarray) -> np.ndarray:
    """Whether sites (site, time) are in contact: from z > 1 until z < ``release`` (site)."""
    on = np.zeros(z.shape, bool)
    state = np.zeros(len(z), bool)
    # Instant by instant: between release and 1 the state before decides.
    for i, now in enumerate(z.T):
        state = np.where(state, now >= release, now > 1)
        on[:, i] = state
    return on


def unit_phase(c: np.ndarray) -> np.ndarray:
    """c/|c| of complex numbers ``c`` (...); 0 where c is."""
    return c / np.maximum(np.abs(c), TINY)


@dataclass(frozen=True)
class SiteRun:
    """A run with one site in contact, at the samples of its burst.

    ``amplitude`` of the drive in N, ``clearance`` in m, w (time) in m as ``displacement``, ``dissipated`` (time) in J
    since the begin, ``last_contact``: the time in s at which the last contact ends, NaN without any.
    """

    amplitude: float
    clearance: float
    displacement: np.ndarray
    dissipated: np.ndarray
    last_contact: float


class Burst:
    """The linear wave at a site: ``time`` in s (uniform), relative displacement ``w`` in m and what follows from it.

    The response ``g`` in m/N and the ``linear`` spectrum are over the frequencies ``omega`` in rad/s; ``c`` (time) is
    the envelope at the frequency ``drive``.
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
        """Fourier transform (omega,) of a signal ``w`` (time,) at ``omega`` - i decay."""
        return np.asarray(np.fft.rfft(w * np.exp(-self.decay * self.time), self.padded))

    def envelope(self, spectrum: np.ndarray, middle: float, half: float) -> np.ndarray:
        """a(t) (time,) of the part Re a exp(i middle t) of a signal within ``half`` of ``middle``, both in rad/s.

        ``spectrum`` (omega,) is the signal's.
        """
        part = np.zeros(self.padded, complex)
        part[: len(self.omega)] = np.where(np.abs(self.omega - middle) < half, 2 * spectrum, 0)
        return np.asarray(np.fft.ifft(part)[: len(self.time)] * np.exp((self.decay - 1j * middle) * self.time))

    def sums(self, run: SiteRun, largest: float) -> Record:
        """``sums`` (quantity, bin) over a ``run``'s samples in contact, ``totals``, and the z of the ``release``.

        The bins of log z go from ``LOWEST`` to ``largest``. Quantities: |c|^2 (``SQUARE``), Re and Im of f1 c*, Re and
        Im of f3 (c*/|c|)^3 |c|, power that the driven wave gives (``GIVEN``), power dissipated, power into each band
        (``INTO``). The totals are those of the last two over all samples.
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
        """The quantities from ``SQUARE`` to ``GIVEN`` over time."""
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
        """Power in W that the ``force`` radiates into each band, over time."""
        powers = []
        for band in self.bands:
            middle = (band.low + band.high) / 2
            half = (band.high - band.low) / 2
            f = self.envelope(force, middle, half)
            velocity = self.envelope(self._rate() * self.g * force, middle, half)
            powers.append(0.5 * (f * velocity.conj()).real)
        return powers

    def _rate(self) -> np.ndarray:
        """Factor (omega) that turns a spectrum into that of the time derivative."""
        return np.asarray(1j * (self.omega - 1j * self.decay))


class ContactState(NamedTuple):
    """State of a site in contact, over the shape of z; ``into`` has the bands as first axis. See ``SiteResponse``."""

    fundamental: np.ndarray
    third: np.ndarray
    lost: np.ndarray
    into: np.ndarray


class BurstState(NamedTuple):
    """Values for a whole burst, over its largest z: factors of loss and of bands (band, ...), and release.

    ``spectrum`` (..., band, bin) are the fractions of the energy in a band that each bin of the wavenumber gets.
    """

    lost: np.ndarray
    into: np.ndarray
    release: np.ndarray
    spectrum: np.ndarray


class SiteResponse(NamedTuple):
    """Response of a site in contact at z = exp(``x``): all arrays over ``x``.

    ``fundamental`` is f1/c and ``third`` f3 (c*/|c|)^3/|c| in N/m (complex). ``lost`` and ``into`` (band, x) are powers
    over that of a travelling wave of the same |c|: what is dissipated, and what goes to every band but its own, scaled
    to sum to what the driven wave loses. Of bursts whose largest z is exp(``peaks``): ``factor`` (loss and bands, run),
    by which the sum over a burst is that of the run, ``release`` (run), z at which contact ends, and ``spectrum``
    (band, bin, run): see ``BurstState``; of lattices without dashpots it has no bin.
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
        """The response of a ``pair`` from the sums of all runs, in any order; zero if there was no contact."""
        # Rising peaks, which interpolation needs; and the same sums whatever the order in which runs ended.
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

        # Bins that no sample fell into lie between others that have some.
        mean = np.array([np.interp(x, x[seen], row[seen] / total[SQUARE][seen]) for row in total])
        given = mean[GIVEN] / wave.power_per_area
        lost = np.maximum(mean[DISSIPATED], 0)
        into = mean[INTO].copy()
        into[wave.band] = 0
        into = np.maximum(into, 0)
        # Powers by band overlap in time and need not sum to what is given: their ratios are kept, and their sum is
        # set.
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
        """State of a site in contact at the amplitudes ``z`` (...), over the clearance."""
        x = np.log(np.maximum(z, LOWEST))
        return ContactState(
            fundamental=self._interpolated(x, self.fundamental),
            third=self._interpolated(x, self.third),
            lost=np.interp(x, self.x, self.lost),
            into=np.array([np.interp(x, self.x, row) for row in self.into]),
        )

    def _interpolated(self, x: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Complex ``values`` at ``x``."""
        return np.asarray(np.interp(x, self.x, values.real) + 1j * np.interp(x, self.x, values.imag))

    def over_bursts(self, largest: np.ndarray) -> BurstState:
        """Factors and release of bursts with these ``largest`` z (site)."""
        x = np.log(np.maximum(largest, 1e-9))
        factors = np.array([np.interp(x, self.peaks, row) for row in self.factor])
        spectrum = np.zeros((*np.shape(x), *self.spectrum.shape[:-1]))
        for band, of_bin in np.ndindex(self.spectrum.shape[:-1]):
            spectrum[..., band, of_bin] = np.interp(x, self.peaks, self.spectrum[band, of_bin])
        return BurstState(
            lost=factors[0], into=factors[1:], release=np.interp(x, self.peaks, self.release), spectrum=spectrum
        )


class SiteResponses(NamedTuple):
    """The response of every site: ``of_kind`` are those of the kinds of sites, ``kind`` (site,) the number of each."""

    of_kind: tuple[SiteResponse, ...]
    kind: np.ndarray

    def of_site(self, site: int) -> SiteResponse:
        """The response of one ``site`` (from 0)."""
        return self.of_kind[self.kind[site]]

    def at(self, z: np.ndarray) -> ContactState:
        """State of the sites in contact at ``z`` (site, time)."""
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
        """Factors and release of bursts with these ``largest`` z (site)."""
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
    """The ``energies`` (band, bin) over their sums, of bands that have any."""
    values = np.array(energies)
    sums = values.sum(axis=1, keepdims=True)
    return np.divide(values, sums, out=np.zeros_like(values), where=sums > 0)
