"""How one site answers a wave: contact force and energies, by the driven wave's amplitude at the moment.

A burst meets a site in a lattice so long that nothing comes back. With w the relative displacement of the contact pair,
w_0 that of the lattice without contacts and g(omega) the response of w to a pair of opposite forces at the infinite
lattice, the contact's force is f = (w - w_0)/g at every frequency. Around the drive's frequency Om,
w_0 = Re c exp(i Om t) and f = Re f1 exp(i Om t), around 3 Om f = Re f3 exp(3 i Om t). Once |c| exceeds the clearance D,
contact goes on until the last one ends, at the z = |c|/D that the run tells (``release``). Meanwhile all of it is taken
for a function of z, averaged over bins of log z, over the burst's rise and fall and over runs of several amplitudes.
What a whole burst loses and gives to other bands then comes out right by a factor. Both the factor and the release are
those of bursts with the same largest z.
"""

from typing import NamedTuple, Self

import numpy as np

from vipetsc.io.records import Record
from vipetsc.lattice import Band, Chain, UnitCell, WaveCompliance, bloch, pass_bands, waves_at

LOWEST = 0.15  # z of the first of the bins
BINS = 40
DECAY = 4.0  # windows fall by e^-4 over the transformed time, so that nothing comes round


def self_response(cell: UnitCell, omega: np.ndarray) -> np.ndarray:
    """g (omega) in m/N of an infinite lattice at frequencies ``omega`` in rad/s, below the real axis."""
    return WaveCompliance(Chain(cell, 1, sites=(0,)), infinite=True).at(omega)[:, 0, 0]


def power_per_area(cell: UnitCell, omega: float) -> tuple[int, float, float] | None:
    """Of the fastest wave at ``omega``: band (from 0), |v_g| (cells/s), power over |w|^2 (W/m^2); None in a gap."""
    if not (waves := waves_at(cell, omega)):
        return None
    number, kappa, speed = max(waves, key=lambda wave: wave[2])
    vector = bloch(cell, kappa).vectors[:, number - 1]
    relative = abs(vector[cell.resonator] - vector[cell.host])
    return number - 1, speed, speed * omega**2 / (2 * max(relative, 1e-300) ** 2)


def in_contact(z: np.ndarray, release: np.ndarray) -> np.ndarray:
    """Whether sites (site, time) are in contact: from z > 1 until z < ``release`` (site)."""
    on, state = np.zeros(z.shape, bool), np.zeros(len(z), bool)
    for i, now in enumerate(z.T):
        on[:, i] = state = np.where(state, now >= release, now > 1)
    return on


class Burst:
    """The linear wave at a site: ``time`` in s (uniform), relative displacement ``w`` in m and what follows from it."""

    def __init__(self, cell: UnitCell, drive: float, time: np.ndarray, w: np.ndarray) -> None:
        self.cell, self.drive, self.time, self.step = cell, drive, time, float(time[1] - time[0])
        length = 2 * len(time) * self.step
        self.decay = DECAY / length
        self.omega = 2 * np.pi * np.fft.rfftfreq(2 * len(time), self.step)
        self.g = self_response(cell, self.omega - 1j * self.decay)
        self.bands: tuple[Band, ...] = pass_bands(cell)
        self.linear = self.spectrum(w)
        self.c = self.envelope(self.linear, drive, 0.3 * drive)

    def spectrum(self, w: np.ndarray) -> np.ndarray:
        """Fourier transform of ``w`` at ``omega`` - i decay."""
        return np.asarray(np.fft.rfft(w * np.exp(-self.decay * self.time), 2 * len(self.time)))

    def envelope(self, spectrum: np.ndarray, middle: float, half: float) -> np.ndarray:
        """a(t) of the part Re a exp(i middle t) of a signal within ``half`` of ``middle``."""
        part = np.zeros(2 * len(self.time), complex)
        part[: len(self.omega)] = np.where(np.abs(self.omega - middle) < half, 2 * spectrum, 0)
        return np.asarray(np.fft.ifft(part)[: len(self.time)] * np.exp((self.decay - 1j * middle) * self.time))

    def sums(self, amplitude: float, gap: float, largest: float, w: np.ndarray, lost: np.ndarray, end: float) -> Record:
        """Sums (quantity, bin) over a run's samples in contact, totals, and the z of the release.

        ``gap`` is the clearance in m, ``lost`` (time) in J is dissipated, contacts ``end`` in s (NaN without any).

        Quantities: |c|^2, Re and Im of f1 c*, Re and Im of f3 (c*/|c|)^3 |c|, power that the driven wave gives, power
        dissipated, power into each band.
        """
        c, drive = amplitude * self.c, self.drive
        force = np.where(
            self.omega < 1.02 * self.bands[-1].high, (self.spectrum(w) - amplitude * self.linear) / self.g, 0
        )
        rate = 1j * (self.omega - 1j * self.decay)
        f1, f3 = self.envelope(force, drive, 0.3 * drive), self.envelope(force, 3 * drive, 0.4 * drive)
        v1 = self.envelope(rate * (self.g * force + amplitude * self.linear), drive, 0.3 * drive)
        rows = [np.abs(c) ** 2, f1 * c.conj(), f3 * (c.conj() / np.maximum(np.abs(c), 1e-300)) ** 3 * np.abs(c)]
        rows = [rows[0], rows[1].real, rows[1].imag, rows[2].real, rows[2].imag, -0.5 * (f1 * v1.conj()).real]
        rows.append(np.gradient(lost, self.step))
        for band in self.bands:
            within = (band.low + band.high) / 2, (band.high - band.low) / 2
            pair = self.envelope(force, *within), self.envelope(rate * self.g * force, *within)
            rows.append(0.5 * (pair[0] * pair[1].conj()).real)
        z = np.abs(c) / gap
        release = min(float(np.interp(end, self.time, z)), 1.0) if np.isfinite(end) else 1.0
        on = in_contact(z[None], np.array([release]))[0] & np.isfinite(end)
        grid = np.linspace(np.log(LOWEST), np.log(largest), BINS)
        place = np.clip(np.rint((np.log(np.maximum(z[on], LOWEST)) - grid[0]) / (grid[1] - grid[0])), 0, BINS - 1)
        bins = [np.bincount(place.astype(int), row[on], BINS).tolist() for row in rows]
        return {"sums": bins, "totals": [float(row.sum()) for row in rows[6:]], "release": release}


class SiteResponse(NamedTuple):
    """What a site in contact does at z = exp(``x``): all arrays over ``x``.

    ``fundamental`` is f1/c and ``third`` f3 (c*/|c|)^3/|c| in N/m (complex). ``given``, ``lost`` and ``into`` (band, x)
    are powers over that of a travelling wave of the same |c|: what the driven wave loses, what is dissipated, and what
    goes to every band but its own, scaled to sum to it. Of bursts whose largest z is exp(``peaks``): ``factor`` (loss
    and bands, run), by which the sum over a burst is that of the run, and ``release`` (run), z at which contact ends.
    """

    x: np.ndarray
    fundamental: np.ndarray
    third: np.ndarray
    lost: np.ndarray
    into: np.ndarray
    peaks: np.ndarray
    factor: np.ndarray
    release: np.ndarray

    @classmethod
    def of(cls, records: list[Record], cell: UnitCell, drive: float, largest: float) -> Self:
        """From the sums of all runs, in any order; without contacts a response that is zero."""
        x = np.linspace(np.log(LOWEST), np.log(largest), BINS)
        records = sorted(records, key=lambda record: record["z"])
        sums, peaks = np.array([record["sums"] for record in records]), np.log([record["z"] for record in records])
        release, rows = np.array([record["release"] for record in records]), sums.sum(axis=0)
        here = power_per_area(cell, drive)
        seen = rows[0] > 0
        if here is None or not seen.any():
            none = np.zeros((cell.dofs, BINS))
            return cls(x, 0j * x, 0j * x, 0 * x, none, peaks, np.ones((1 + cell.dofs, len(peaks))), release)
        mean = np.array([np.interp(x, x[seen], row[seen] / rows[0][seen]) for row in rows])
        given, lost, into = mean[5] / here[2], mean[6], mean[7:].copy()
        into[here[0]] = 0
        into, lost = np.maximum(into, 0), np.maximum(lost, 0)
        scale = np.maximum(given, 0) / np.maximum(into.sum(axis=0) + lost, 1e-300)
        table = np.array([lost * scale, *(into * scale)])
        totals = np.array([record["totals"] for record in records]).T / here[2]
        factor = np.maximum(totals, 0) / np.maximum(table @ sums[:, 0].T, 1e-300)
        factor = np.where(table @ sums[:, 0].T > 0, factor, 1.0)
        factor[1 + here[0]] = 1.0
        return cls(x, mean[1] + 1j * mean[2], mean[3] + 1j * mean[4], table[0], table[1:], peaks, factor, release)

    def at(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """fundamental, third, lost (shape of z) and into (band, shape of z) at ``z``."""
        x = np.log(np.maximum(z, LOWEST))
        f1, f3 = (np.interp(x, self.x, q.real) + 1j * np.interp(x, self.x, q.imag) for q in self[1:3])
        return f1, f3, np.interp(x, self.x, self.lost), np.array([np.interp(x, self.x, q) for q in self.into])

    def of_bursts(self, largest: np.ndarray) -> np.ndarray:
        """The factor (loss and bands) and last the release of sites (site) under bursts with these ``largest`` z."""
        x = np.log(np.maximum(largest, 1e-9))
        return np.array([np.interp(x, self.peaks, row) for row in (*self.factor, self.release)])
