"""Several sites composed from the answer of one: waves between them, there and back, without a fitted number.

Between the sites the lattice is linear, so all that sites do to each other goes through G_kj(omega), the response of
the relative displacement at site k to a pair of forces at site j, ends of the lattice included. With the self response
g of an infinite lattice, c_k = c0_k + sum_j (G_kj - delta_kj g) f1_j: what arrives at a site is the linear wave and
what the others, and the ends, send back. f1 = Phi1(|c|/D) c closes the system: it is solved by GMRES with Phi1 held,
and once more with that of what comes out, until it stays.

Third harmonics f3 = Phi3(z) |c| (c/|c|)^3 of the sites add with their phases; a site in contact is stiff to those of
others: f3 has -c3/g besides. They press on contacts: z = (|c| + |c3|)/D. Of what the upper bands carry past a site in
contact, the share is lost that a driven wave of that amplitude loses. Waves that are not harmonics add by energies.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse.linalg import LinearOperator, gmres

from vipetsc.case import Model
from vipetsc.lattice import ToneBurst, WaveCompliance, bloch
from vipetsc.studies.response import DECAY, SiteResponse, in_contact, power_per_area, self_response

WIDTH = 14  # of the burst's line, half of what is followed around a frequency
WEAK = 0.35  # over clearance: weaker waves lose as much at a site in contact as a driven wave of this amplitude
MOST, HELD = 60, 30  # iterations; those after which the sites in contact are held
CLOSE = 1e-3


class Composed(NamedTuple):
    """Energies in J at the end under an amplitude: ``into`` (band) other than the drive's, ``dissipated``.

    ``z`` (site) is the largest at every site; ``change`` the last iteration's, over the linear wave.
    """

    into: np.ndarray
    dissipated: float
    z: np.ndarray
    change: float


class Network:
    """The sites of a ``model`` and the linear lattice between them; solved once for all amplitudes."""

    def __init__(self, model: Model) -> None:
        self.model, chain, drive = model, model.chain, model.drive
        assert isinstance(drive, ToneBurst)
        self.cell, self.om, self.clearance = chain.cell, drive.frequency, np.array(chain.clearances)
        length, half = 2 * model.end, min(WIDTH * 2 * np.pi / drive.duration, 0.45 * drive.frequency)
        most = int(np.ceil(half * length / (2 * np.pi)))
        self.offset = 2 * np.pi * np.arange(-most, most + 1) / length
        self.time = np.arange(len(self.offset)) * length / len(self.offset)
        self.decay, self.during = DECAY / length, self.time <= model.end
        force = drive.window_amplitude / abs(drive.amplitude) * (1 - np.cos(self.om * self.time / drive.cycles))
        pulse = self._forward(np.where(self.time < drive.duration, -1j * force, 0))
        response, g = self._responses(self.om)
        self.linear = self._backward(response[:, :, -1].T * pulse)
        inside = self._propagates(self.om)
        radiated = 1j * g.imag  # the part of g that leaves as waves
        eye = np.eye(len(chain.sites))
        self.between = np.where(inside, (response[:, :, :-1] - g[:, None, None] * eye).T / radiated, 0)
        self.radiated = radiated[most]
        self.third = power_per_area(self.cell, 3 * self.om)
        if self.third:
            response, g = self._responses(3 * self.om)
            inside = self._propagates(3 * self.om)
            self.g3, self.centre = g, g[most]
            self.response3 = response[:, :, :-1].T
            self.between3 = np.where(inside, self.response3 / g - eye[:, :, None], 0)

    def _responses(self, middle: float) -> tuple[np.ndarray, np.ndarray]:
        """Of w at the sites to forces at the sites and the drive (frequency, site, site and 1); of a site alone."""
        omega, drive = middle + self.offset - 1j * self.decay, (self.model.drive_cell, self.model.drive_mass)
        return WaveCompliance(self.model.chain, points=(drive,)).response(omega), self_response(self.cell, omega)

    def _propagates(self, middle: float) -> np.ndarray:
        """Whether a wave of each frequency around ``middle`` exists."""
        frequency = bloch(self.cell, np.linspace(0, np.pi, 181)).frequency
        omega = middle + self.offset
        low, high = frequency.min(axis=0), frequency.max(axis=0)
        return np.asarray(((omega[:, None] >= low) & (omega[:, None] <= high)).any(axis=1))

    def _forward(self, a: np.ndarray) -> np.ndarray:
        return np.asarray(np.fft.fftshift(np.fft.fft(a * np.exp(-self.decay * self.time)), axes=-1))

    def _backward(self, spectrum: np.ndarray) -> np.ndarray:
        return np.asarray(np.fft.ifft(np.fft.ifftshift(spectrum, axes=-1)) * np.exp(self.decay * self.time))

    def _sent(self, between: np.ndarray, source: np.ndarray) -> np.ndarray:
        """What ``source`` (site, time) sends to every site while the run goes on."""
        arriving = self._backward(np.einsum("jkt,jt->kt", between, self._forward(source)))
        return np.where(self.during, arriving, 0)

    def _solve(self, between: np.ndarray, factor: np.ndarray, right: np.ndarray, guess: np.ndarray) -> np.ndarray:
        """x = right + sent(factor x)."""

        def left(x: np.ndarray) -> np.ndarray:
            y = x.reshape(right.shape)
            return np.asarray((y - self._sent(between, factor * y)).ravel())

        size = right.size
        operator = LinearOperator((size, size), left, dtype=complex)
        x, _ = gmres(operator, right.ravel(), guess.ravel(), tol=1e-5, atol=0.0, restart=40, maxiter=5)
        return np.asarray(x).reshape(right.shape)

    def compose(self, amplitude: float, site: SiteResponse) -> Composed:
        """The energies at the end under ``amplitude`` (N), from the answer of one ``site``."""
        linear = np.where(self.during, abs(amplitude) * self.linear, 0)
        c, c3, on = linear.copy(), np.zeros_like(linear), np.zeros(linear.shape, bool)
        size, change = float(np.abs(linear).max()), 0.0
        for i in range(MOST):
            z = (np.abs(c) + np.abs(c3)) / self.clearance[:, None]
            on = in_contact(z, site.of_bursts(z.max(axis=1))[-1]) & self.during if i < HELD else on
            if not on.any():
                break
            fundamental, third, *_ = site.at(z)
            arriving = self._solve(self.between, self.radiated * fundamental * on, linear, c)
            step, change = (1.0 if i < 4 else 0.5), float(np.abs(arriving - c).max()) / size
            c = c + step * (arriving - c)
            if self.third:
                f3 = third * np.abs(c) * (c / np.maximum(np.abs(c), 1e-300)) ** 3 * on
                arriving = self._sent(self.between3, f3) * self.centre
                c3 = c3 + 0.5 * (self._solve(self.between3, -1.0 * on, arriving, c3) - c3)
            if change < CLOSE and i > 8:
                break
        return self._energies(c, c3, on, site, change)

    def _energies(self, c: np.ndarray, c3: np.ndarray, on: np.ndarray, site: SiteResponse, change: float) -> Composed:
        """The energies of waves ``c`` that arrive at the sites, with the third harmonics ``c3`` of the others."""
        z, step = (np.abs(c) + np.abs(c3)) / self.clearance[:, None], float(self.time[1])
        here = power_per_area(self.cell, self.om)
        assert here is not None
        _, third, lost, into = site.at(z)
        factor = site.of_bursts(z.max(axis=1))[:, :, None]
        lost, into = lost * factor[0], into * factor[1:-1]
        power = here[2] * np.abs(c) ** 2 * on
        emitted = power * into
        dissipated, bands = float((power * lost).sum()) * step, emitted.sum(axis=(1, 2)) * step
        if self.third:
            absorbed = self._absorbed(emitted.sum(axis=0), on, site) * step
            total = float(bands.sum())
            bands, dissipated = bands * (1 - absorbed / total if total else 1.0), dissipated + absorbed
            alone = third * np.abs(c) * (c / np.maximum(np.abs(c), 1e-300)) ** 3 * on
            rate = 1j * (3 * self.om + self.offset - 1j * self.decay)
            apart = self._backward(rate * self.g3 * self._forward(alone))
            force = alone - on * c3 / self.centre
            together = self._backward(rate * np.einsum("jkt,jt->kt", self.response3, self._forward(force)))
            gain = 0.5 * float(((force * together.conj()).real - (alone * apart.conj()).real).sum()) * step
            bands[self.third[0]] = max(bands[self.third[0]] + gain, 0.0)
        return Composed(bands, dissipated, np.abs(c).max(axis=1) / self.clearance, change)

    def _absorbed(self, emitted: np.ndarray, on: np.ndarray, site: SiteResponse) -> float:
        """Sum over time of the power in W that sites in contact take from what others have ``emitted`` (site, time)."""
        assert self.third
        _, speed, area = self.third
        cells, total = np.array(self.model.chain.sites), 0.0
        for order in (np.argsort(cells), np.argsort(-cells)):
            passing, last = np.zeros(len(self.time)), order[0]
            for k in order:
                late = self.time - abs(cells[k] - cells[last]) / speed
                passing, last = np.interp(late, self.time, passing, left=0.0), k
                z = np.sqrt(np.maximum(passing, 0) / area) / self.clearance[k]
                share = np.minimum(site.at(np.maximum(z, WEAK))[2], 1) * on[k]
                total += float((passing * share).sum())
                passing = passing * (1 - share) + emitted[k] / 2
        return total
