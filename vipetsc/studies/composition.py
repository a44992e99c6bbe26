"""Prediction of several sites from the response of one, with waves between them in both directions and no fit.

About the drive's frequency Om the wave that arrives at site k is w = Re c_k exp(i Om t), and the force there is
f = Re f1_k exp(i Om t), with envelopes c in m and f1 in N that vary slowly. Between the sites the lattice is linear, so
all that sites do to each other goes through G_kj(omega) in m/N, the response of the relative displacement at site k to
a pair of forces at site j, ends of the lattice included. What a site alone does to itself is the response g of an
infinite lattice, which the response of one site has in it already. So there arrive at a site the linear wave c0, and
the waves from the other sites and from the ends,

    c_k = c0_k + sum_j (G_kj - delta_kj g) f1_j,    f1 = Phi1(z) c,    z = |c|/D,

with the clearance D and Phi1 in N/m of ``studies.response``. GMRES solves this with Phi1 fixed, and it is iterated with
the Phi1 of the solution until it converges. Phi1 is that of the frequency Om. At other frequencies omega of the burst a
site is taken to send out the same multiple of the wave that arrives, so that its force is f1 times g''(Om)/g''(omega),
where g'' is the imaginary part of g, by which waves leave the site. (With the same force instead, energies change by
0.005 decades in a short lattice.)

Third harmonics, about 3 Om, have envelopes c3 and f3. The forces f3 = Phi3(z) |c| (c/|c|)^3 of the sites send out waves
that add with their phases. A closed contact does not yield to the waves c3 of other sites, which adds -c3/g to its f3.
The waves also press on contacts: z = (|c| + |c3|)/D. The energy that the upper bands carry past a site in contact loses
the fraction that a driven wave of that amplitude loses. Waves that are not harmonics add by energies. G and g are those
of the lattice with its dashpots; ``studies.wave_losses`` has what these take until the end.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse.linalg import LinearOperator, gmres

from vipetsc.case import Model
from vipetsc.case.law import lesser_clearances
from vipetsc.lattice import ToneBurst, WaveCompliance, Waveform, bloch
from vipetsc.lattice.compliance.by_elimination import DirectCompliance
from vipetsc.studies.response import SiteResponses, fastest_wave, in_contact, self_response, unit_phase
from vipetsc.studies.wave_losses import SentPowers, SpectralLine, WaveLosses

# The changes below are those of the energies of bands in the built-in lattice and a shorter one with shorter bursts,
# where predictions differ from simulations by 0.08 and 0.1 decades (root mean square).

# Lines of a burst (2 pi over its duration) that are followed on either side of a frequency. With 10 energies change by
# 0.06 decades, with 7 by 0.05; with more it is WIDEST that limits the line.
WIDTH = 14
# Largest half width over the drive's frequency: the line reaches neither 0 nor 2 Om. With 0.3 energies change by 0.004
# decades, with 0.2 by 0.008.
WIDEST = 0.45
WAVENUMBERS = 181  # from 0 to pi, at which the bands are sampled for their edges; a quarter of them changes nothing
# Amplitude over clearance: weaker waves lose as much at a site in contact as a driven wave of this amplitude. Half
# of it changes energies by 0.02 decades, twice as much by 0.006.
WEAK = 0.35
SAMPLES_OF_PERIOD = 40  # of a waveform's highest frequency: rectangles then integrate its spectrum to 1e-3
# Iterations: at least LEAST, since the third harmonics converge after c does (with 5 energies change by 0.01 decades,
# with 18 by 0.0008 in 1.4 times the CPU time), until c changes by less than CLOSE of the linear wave (at a tenth of it
# energies change by 0.0005 decades), and at most MOST, of which the built-in lattice never needs half.
MOST = 60
LEAST = 9
CLOSE = 1e-3
HELD = 30  # iterations after which the sites in contact are held: a site at its limit would switch for ever
FULL_STEPS = 4  # iterations before steps are halved; without any energies change by 0.001 decades


class Composed(NamedTuple):
    """Energies in J at the end under an amplitude: ``into`` (band) other than the drive's, ``dissipated`` in contacts.

    In a lattice with dashpots ``into`` has the change of the drive's band as well. ``absorbed`` is what absorbing ends
    have taken. ``z`` (site) is the largest at every site; ``change`` the last iteration's, over the linear wave, in
    which the linear equations were ``solved`` or not. ``defect`` in J is the energy that the sites take from the
    drive's wave, by the work of their forces, less what they dissipate and send into bands by their own runs.
    """

    into: np.ndarray
    dissipated: float
    absorbed: float
    z: np.ndarray
    change: float
    solved: bool
    defect: float


class Arriving(NamedTuple):
    """Envelopes (site, time) in m of what arrives at the sites, and where these are in contact.

    ``first`` is c about the drive's frequency, ``third`` c3 about three times it, ``on`` is true during contact.
    """

    first: np.ndarray
    third: np.ndarray
    on: np.ndarray


class Network:
    """The sites of a ``model`` and the linear lattice between them; solved once for all amplitudes.

    The frequencies ``offset`` in rad/s are relative to the middle of a ``line``; their transform is over ``time`` in s,
    twice as long as the run, of which ``during`` is true while the run lasts. Arrays (site, site, offset) have the site
    that sends first, and are 0 where no wave propagates. ``clearance`` (site,) in m is that of the side where it is
    less.

    About the drive's frequency ``om`` in rad/s, ``linear`` (site, time) in m is the envelope c0 under 1 N. ``between``
    (site, site, offset) is the wave that arrives over the one that is sent out, (G - delta g)/(i g'') with the g of the
    sender, and ``radiated`` (site, 1) in m/N is i g'' at ``om``; it is a number where all sites have the same.

    About three times ``om``, if there is a wave ``third``: ``response3`` (site, site, offset) is G, ``g3`` (site,
    offset) is g, and ``centre`` (site, 1), or a number as ``radiated``, its value at three times ``om``; ``received3``
    and ``between3`` (site, site, offset) are G/g - delta with the g of the receiver and of the sender. ``power`` and
    ``power3`` (site, 1) are the powers in W/m^2 of travelling waves at ``om`` and three times it over the |w|^2 of each
    site's pair.
    """

    def __init__(self, model: Model) -> None:
        chain = model.chain
        drive = model.drive
        self.model = model
        self.cell = chain.cell
        self.om = drive.frequency
        self.clearance = lesser_clearances(chain.sites.gaps)

        half = min(_half_width(drive), WIDEST * drive.frequency)
        self.line = SpectralLine(half=half, length=2 * model.end)
        self.offset = self.line.offset
        self.time = self.line.time
        self.during = self.time <= model.end
        most = self.line.most

        pulse = self._pulse(drive)
        response, g = self._responses(self.om)
        sites = len(chain.sites)
        self.linear = np.zeros((sites, len(self.time)), complex)
        # A wall acts through springs, on several masses if they are tied to it.
        driving = np.array([(acting.stiffness or 1.0) * pulse for acting in model.drives])
        for number, spectrum in enumerate(driving, sites):
            self.linear += self.line.backward(response[:, :, number].T * spectrum)

        inside = self._propagates(self.om)
        radiated = 1j * g.imag  # the part of g that leaves as waves
        eye = np.eye(len(chain.sites))
        # The last axis is that of the site that sends.
        others = (response[:, :, :sites] - g.T[:, :, None] * eye) / radiated.T[:, None]
        self.between = np.where(inside, others.T, 0)
        self.radiated = _of_sites(radiated[:, most])
        self.alone = _of_sites(g[:, most])
        self.power = self._powers(self.om)

        self.third = fastest_wave(self.cell, 3 * self.om, chain.sites[0].pair)
        if self.third:
            response, g = self._responses(3 * self.om)
            inside = self._propagates(3 * self.om)
            self.power3 = self._powers(3 * self.om)
            self.g3 = g
            self.centre = _of_sites(g[:, most])
            self.response3 = response[:, :, :sites].T
            # Both are the same where all sites have equal pairs, and so one g.
            received = response[:, :, :sites] / g.T[:, :, None]
            sent = response[:, :, :sites] / g.T[:, None]
            self.received3 = np.where(inside, received.T - eye[:, :, None], 0)
            self.between3 = np.where(inside, sent.T - eye[:, :, None], 0)
        self.losses = self._losses(driving)

    def compose(self, amplitude: float, sites: SiteResponses) -> Composed:
        """Return the energies at the end under ``amplitude`` (N, of a wall m), from the response of each site alone."""
        linear = np.where(self.during, abs(amplitude) * self.linear, 0)
        size = float(np.abs(linear).max())
        c = linear.copy()
        c3 = np.zeros_like(linear)
        on = np.zeros(linear.shape, bool)
        change = 0.0
        solved = True

        for i in range(MOST):
            z = self._over_clearance(c, c3)
            if i < HELD:
                on = in_contact(z, sites.over_bursts(z.max(axis=1)).release) & self.during
            if not on.any():
                break

            state = sites.at(z)
            # GMRES begins with the last c, which is near the next one.
            arriving, solved = self._solve(self.between, self.radiated * state.fundamental * on, linear, c)
            change = float(np.abs(arriving - c).max()) / size
            step = 1.0
            if i >= FULL_STEPS:
                step = 0.5
            # Full steps come near the solution, but may swing about it, since Phi1 depends on c; half steps converge.
            c = c + step * (arriving - c)

            if self.third:
                f3 = state.third * np.abs(c) * unit_phase(c) ** 3 * on
                sent = self._sent(self.received3, f3) * self.centre
                arriving3, is_solved = self._solve(self.between3, -1.0 * on, sent, c3)
                c3 = c3 + 0.5 * (arriving3 - c3)
                solved = solved and is_solved
            if change < CLOSE and i >= LEAST:
                break
        return self._energies(Arriving(c, c3, on), sites, change, solved, amplitude)

    def _pulse(self, drive: Waveform) -> np.ndarray:
        """Return the spectrum (offset,) of the envelope of a drive of 1 N, or of 1 m of a wall, about its frequency."""
        if isinstance(drive, ToneBurst):
            # Its sine is -i exp(i Om t), under a Hann window.
            force = drive.window_amplitude / abs(drive.amplitude) * (1 - np.cos(self.om * self.time / drive.cycles))
            return self.line.forward(np.where(self.time < drive.duration, -1j * force, 0))

        # F = Re a exp(i Om t): at positive frequencies the transform of a is twice that of F.
        step = 2 * np.pi / (drive.highest or self.om) / SAMPLES_OF_PERIOD
        samples = np.arange(int(np.ceil(drive.duration / step)) + 1) * step
        force = drive.force(samples) / abs(drive.amplitude) * np.exp(-self.line.decay * samples)
        transform = step * np.exp(-1j * np.multiply.outer(self.om + self.offset, samples)) @ force
        # Spectra of the line are sums over its instants, without their distance.
        return np.asarray(2 * transform / self.time[1])

    def _responses(self, middle: float) -> tuple[np.ndarray, np.ndarray]:
        """Return compliances in m/N at the frequencies of a line about ``middle`` in rad/s.

        The first (frequency, site, force) is that of w at the sites to forces at the sites, then to those of the
        drives. The second (site, frequency) is g, that of a site in an infinite lattice to a pair of forces at itself.
        """
        omega = middle + self.offset - 1j * self.line.decay
        response = self._compliance().response(omega)
        pairs = self.model.chain.sites.pairs
        alone = {pair: self_response(self.cell, omega, pair) for pair in {*pairs}}
        return response, np.array([alone[pair] for pair in pairs])

    def _compliance(self) -> WaveCompliance | DirectCompliance:
        """Return the compliance of the sites, with the driven masses as points."""
        chain = self.model.chain
        driven = tuple((drive.cell, drive.mass) for drive in self.model.drives)
        if chain.is_damped:
            return DirectCompliance(chain, driven)
        return WaveCompliance(chain, points=driven)

    def _losses(self, driving: np.ndarray) -> WaveLosses | None:
        """Return losses of waves in dashpots; ``driving`` (drive, offset) are the spectra of the drives."""
        compliance = self._compliance()
        driven = fastest_wave(self.cell, self.om, self.model.chain.sites[0].pair)
        if isinstance(compliance, WaveCompliance) or driven is None:
            return None
        return WaveLosses(
            model=self.model,
            line=self.line,
            compliance=compliance,
            middle=self.om,
            driving=driving,
            driven=driven,
            third=self.third,
        )

    def _powers(self, omega: float) -> np.ndarray:
        """Return the power (site, 1) in W/m^2 of the wave at ``omega`` in rad/s over the |w|^2 of each site's pair."""
        waves = [fastest_wave(self.cell, omega, pair) for pair in self.model.chain.sites.pairs]
        return np.array([[wave.power_per_area] for wave in waves if wave])

    def _propagates(self, middle: float) -> np.ndarray:
        """Return whether a wave of each frequency near ``middle`` exists."""
        frequency = bloch(self.cell, np.linspace(0, np.pi, WAVENUMBERS)).frequency
        omega = middle + self.offset
        low = frequency.min(axis=0)
        high = frequency.max(axis=0)
        return np.asarray(((omega[:, None] >= low) & (omega[:, None] <= high)).any(axis=1))

    def _sent(self, between: np.ndarray, source: np.ndarray) -> np.ndarray:
        """Return waves (site, time) that arrive at every site from ``source`` (site, time) while the run goes on."""
        arriving = self.line.backward(np.einsum("jkt,jt->kt", between, self.line.forward(source)))
        return np.where(self.during, arriving, 0)

    def _solve(
        self, between: np.ndarray, factor: np.ndarray, right: np.ndarray, guess: np.ndarray
    ) -> tuple[np.ndarray, bool]:
        """Solve x = right + sent(factor x); returns x, and whether GMRES has converged."""

        def left(x: np.ndarray) -> np.ndarray:
            y = x.reshape(right.shape)
            return np.asarray((y - self._sent(between, factor * y)).ravel())

        size = right.size
        operator = LinearOperator((size, size), left, dtype=complex)
        # SciPy's own relative tolerance, 1e-5, is well below CLOSE, at which the outer iteration ends. Its name is not
        # written: it was `tol` before SciPy 1.12, and is `rtol` alone from 1.14 on.
        x, flag = gmres(operator, right.ravel(), guess.ravel(), atol=0.0, restart=40, maxiter=5)
        return np.asarray(x).reshape(right.shape), flag == 0

    def _over_clearance(self, c: np.ndarray, c3: np.ndarray) -> np.ndarray:
        """Return z (site, time), the amplitudes of both harmonics together over the clearance."""
        return np.asarray((np.abs(c) + np.abs(c3)) / self.clearance[:, None])

    def _energies(
        self, waves: Arriving, sites: SiteResponses, change: float, solved: bool, amplitude: float
    ) -> Composed:
        """Return the energies at the end, of ``waves`` that arrive at the sites under ``amplitude``."""
        c = waves.first
        z = self._over_clearance(c, waves.third)
        step = float(self.time[1])

        state = sites.at(z)
        burst = sites.over_bursts(z.max(axis=1))
        lost = state.lost * burst.lost[:, None]
        into = state.into * burst.into[:, :, None]
        power = self.power * np.abs(c) ** 2 * waves.on
        emitted = power * into
        dissipated = float((power * lost).sum()) * step
        bands = emitted.sum(axis=(1, 2)) * step

        # The work of a site's force on its pair, whose motion is what arrives and what the force itself radiates.
        force = state.fundamental * c * waves.on
        motion = c + self.alone * force
        taken = -0.5 * np.real(force * np.conj(1j * self.om * motion))
        defect = float(taken.sum()) * step - float(bands.sum()) - dissipated

        passed = 1.0
        gain = np.zeros_like(power)
        if self.third:
            absorbed = self._absorbed(emitted.sum(axis=0), waves.on, sites) * step
            total = float(bands.sum())
            if total:
                passed = 1 - absorbed / total
            dissipated = dissipated + absorbed
            gain = self._third_gain(waves, state.third)

        largest = np.abs(c).max(axis=1) / self.clearance
        if self.losses:
            sent = SentPowers(
                bands=emitted * passed,
                spectrum=burst.spectrum,
                third=gain,
                given=power * lost + emitted.sum(axis=0) + gain,
                force=force,
            )
            end = self.losses.at_end(sent, amplitude)
            return Composed(
                into=end.remaining,
                dissipated=dissipated,
                absorbed=end.absorbed,
                z=largest,
                change=change,
                solved=solved,
                defect=defect,
            )

        bands = bands * passed
        if self.third:
            # The gain may be negative, where sites cancel each other's third harmonics; an energy may not.
            bands[self.third.band] = max(bands[self.third.band] + float(gain.sum()) * step, 0.0)
        return Composed(
            into=bands, dissipated=dissipated, absorbed=0.0, z=largest, change=change, solved=solved, defect=defect
        )

    def _third_gain(self, waves: Arriving, third: np.ndarray) -> np.ndarray:
        """Return power (site, time) in W by which third harmonics of the sites give more together than each alone."""
        c = waves.first
        alone = third * np.abs(c) * unit_phase(c) ** 3 * waves.on
        rate = 1j * (3 * self.om + self.offset - 1j * self.line.decay)
        apart = self.line.backward(rate * self.g3 * self.line.forward(alone))
        force = alone - waves.on * waves.third / self.centre
        together = self.line.backward(rate * np.einsum("jkt,jt->kt", self.response3, self.line.forward(force)))
        return np.asarray(0.5 * ((force * together.conj()).real - (alone * apart.conj()).real))

    def _absorbed(self, emitted: np.ndarray, on: np.ndarray, sites: SiteResponses) -> float:
        """Return the sum over time of the power in W that sites take from what others ``emitted`` (site, time)."""
        assert self.third
        rate = self.losses.rate(self.third) if self.losses else 0.0
        cells = self.model.chain.sites.cells
        total = 0.0
        for order in (np.argsort(cells), np.argsort(-cells)):  # waves that go up, and those that go down
            passing = np.zeros(len(self.time))
            last = order[0]
            for k in order:
                lag = abs(cells[k] - cells[last]) / self.third.speed
                passing = np.interp(self.time - lag, self.time, passing, left=0.0) * np.exp(-rate * lag)
                last = k

                # The amplitude of a travelling wave with this power, as if all of it were the third harmonic.
                z = np.sqrt(np.maximum(passing, 0) / self.power3[k]) / self.clearance[k]
                fraction = np.minimum(sites.of_site(k).at(np.maximum(z, WEAK)).lost, 1) * on[k]
                total += float((passing * fraction).sum())
                passing = passing * (1 - fraction) + emitted[k] / 2  # half of it in each direction
        return total


def _half_width(drive: Waveform) -> float:
    """Return the half the width in rad/s of what is followed of a ``drive`` about its frequency."""
    half = WIDTH * 2 * np.pi / drive.duration
    if isinstance(drive, ToneBurst):
        return half
    return half + max(drive.highest - drive.frequency, 0.0)


def _of_sites(values: np.ndarray) -> np.ndarray:
    """Return the ``values`` (site,) as factors of arrays (site, time): one number where all sites have the same."""
    # A product with a number and one with equal numbers in an array differ by rounding.
    if np.all(values == values[0]):
        return values[0]
    return values[:, None]
