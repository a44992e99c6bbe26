r"""Forces of contacts and smooth springs in a periodic motion: their harmonics, and the derivatives of these harmonics.

A pair is a contact or a nonlinear spring j, and z_j is its elongation: for a contact the relative displacement, for
which ``vipetsc.lattice.contact`` writes w. At the phase theta = Om t, z_j = Re sum_{k=0..K} Z_jk exp(i k theta), and
the forces f_j have the harmonics F_jk likewise. A prime is a derivative by phase: z' in m/rad, Om z' in m/s.

**From harmonics to harmonics.** As in the alternating frequency-time method (Cameron and Griffin 1989), forces are
evaluated along the motion, and then transformed back. For springs the transform is a sum over uniform samples, which is
exact for their polynomials. The force of a contact has a kink where it closes or opens, which would alias into every
sampled harmonic: its integrals are taken over each contact episode, an interval of phase with contact, from the
onset to the separation.

**Episodes.** Onset and separation are roots of the quintics that interpolate uniform samples of (z, z', z''), found by
``vipetsc.contact.search``, which misses no root of a quintic. A contact so slight that the quintic does not reach the
offset is missed. The quintics differ from the motion by 7e-9 of its last
harmonic (``DENSITY``). Integrals of an elastic force are less in error: an end off by d changes them by the order
d^(n+1), n the exponent of the force, which vanishes there.

**Quadrature.** An episode from a to b is integrated by Gauss's rule in phi, theta = a + (b - a) sin^2 phi, in which
(theta - a)(b - theta) = (b - a)^2 sin^2 phi cos^2 phi: its powers, with which a Hertz force begins and ends, are smooth
in phi. An episode is cut where its indentation has a minimum, since the motion may nearly separate there. With 160
nodes a panel instead of 64, forces change by 1e-10 of their largest harmonic for random motions whose harmonics fall as
0.7^k, and by 1e-6 where they fall as slowly as 0.97^k up to K = 201.

**Dissipation.** The factor of a contact is g = 1 + c z'/z'_minus with its damping c and the slope z'_minus at the
onset. The onset is where z has the value of the clearance: if z changes by dz, it moves by -dz/z', and z'_minus
changes by dz' - (z''/z') dz, all taken at the onset. Where g is clipped at 0, episodes are cut on its zeros. Forces are
continuous: that the ends of episodes move adds nothing else to a derivative.

T. M. Cameron, J. H. Griffin, An alternating frequency/time domain method for calculating the steady-state response of
nonlinear dynamic systems, J. Appl. Mech. 56 (1989) 149-154.
"""

import itertools
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.contact.search import bernstein, first_upcrossing, first_upcrossing_after_start
from vipetsc.lattice import Spring
from vipetsc.lattice.cell import nonlinear_energy, nonlinear_force, nonlinear_slope
from vipetsc.modes.problem import NoMotionError
from vipetsc.modes.stops import Stops

# With K harmonics, and 24 K samples or more, a motion exceeds its samples by (2 pi/24)^2/16 = 0.4 % of its range at
# most, since |z''| <= K^2 range/2 by Bernstein's inequality. No root need be sought where the offset is above the
# samples by this fraction of their range, which is taken much larger than the bound.
OVERSHOOT = 0.1


@kernel
def _crossings(motion: np.ndarray, offset: float, out: np.ndarray) -> int:
    """Write the phases where a motion passes ``offset`` into ``out``, in order, and return their number.

    ``motion`` (samples, 3) holds (z, z', z'') over a period. The first crossing is upwards unless the period begins
    above; then they alternate. A value that equals the offset counts as below.
    """
    # Bernstein coefficients b enclose the quintic: where all have one sign it has no root, and none is sought.
    samples = motion.shape[0]
    h = 2.0 * np.pi / samples
    count = 0
    above = motion[0, 0] > offset
    b = np.empty(6)
    c = np.empty(6)
    for i in range(samples):
        bernstein(motion[i], motion[(i + 1) % samples], h, b)
        stays_below = True
        stays_above = True
        for k in range(6):
            b[k] -= offset
            stays_below &= b[k] <= 0.0
            stays_above &= b[k] > 0.0
        if (stays_below and not above) or (stays_above and above):
            continue

        # The search finds where a polynomial turns positive (2 if nowhere); downcrossings are those of its negative.
        sign = -1.0 if above else 1.0
        for k in range(6):
            c[k] = sign * b[k]
        begin = 0.0
        root = first_upcrossing(c)
        while root <= 1.0 and count < out.size:
            begin += root * (1.0 - begin)
            out[count] = (i + begin) * h
            count += 1
            above = not above
            if begin >= 1.0:
                break

            # De Casteljau's scheme: coefficients on the part of the interval after the root, where the value is 0.
            for k in range(1, 6):
                for j in range(6 - k):
                    c[j] = (1.0 - root) * c[j] + root * c[j + 1]
            c[0] = 0.0
            for k in range(1, 6):
                c[k] = -c[k]
            root = first_upcrossing_after_start(c, 0.0)
    return count


def intervals_above(motion: np.ndarray, offset: float) -> list[tuple[float, float]]:
    """Return intervals of phase (begin, end), begin < end, on which a periodic motion is above ``offset``.

    ``motion`` (samples, 3) holds (z, z', z'') over a period. A motion that is always above has the interval (0, 2 pi).
    An interval that contains phase 0 is not split there: it begins at a negative phase.
    """
    if motion[:, 0].max() + OVERSHOOT * np.ptp(motion[:, 0]) <= offset:
        return []
    # More roots than any motion of the samples has: one with K harmonics passes an offset 2 K times at most.
    out = np.empty(4 * len(motion))
    roots = out[: _crossings(motion, offset, out)]
    if len(roots) % 2 and motion[0, 0] <= offset:
        # The motion comes down to the offset exactly at the period's end, whose value counts as below already.
        roots = np.append(roots, 2 * np.pi)
    begins_above = motion[0, 0] > offset
    if len(roots) < 2:
        if begins_above:
            return [(0.0, 2 * np.pi)]
        return []

    # A period ends as it began, so that crossings are even in number. If it begins above, the first crossing is
    # downwards: the last one, upwards, is moved back by a period and comes first.
    if begins_above:
        roots = np.concatenate([[roots[-1] - 2 * np.pi], roots[:-1]])
    return [(a, b) for a, b in zip(roots[::2].tolist(), roots[1::2].tolist(), strict=True) if b > a]


def minima(slope: np.ndarray) -> np.ndarray:
    """Return phases (minimum,) in rad of the minima of a periodic motion, near enough to cut episodes there.

    ``slope`` (sample,) is its derivative at equal phases of one period. A minimum is where the straight line between
    two samples passes zero upwards.
    """
    after = np.append(slope[1:], slope[:1])
    (before_minimum,) = np.nonzero((slope < 0) & (after >= 0))
    falling = slope[before_minimum]
    change = falling - after[before_minimum]
    return (before_minimum + falling / change) * (2 * np.pi / len(slope))


def cut(a: float, b: float, places: np.ndarray) -> Iterator[tuple[float, float]]:
    """Yield the interval from ``a`` to ``b``, phases in rad, cut at ``places`` (place,) of period 2 pi.

    A whole period stays whole.
    """
    if b - a >= 2 * np.pi:
        yield a, b
        return
    # An interval that contains phase 0 begins at a negative phase (``intervals_above``).
    turns = np.concatenate([places - 2 * np.pi, places])
    inside = np.sort(turns[(turns > a) & (turns < b)]).tolist()
    yield from itertools.pairwise([a, *inside, b])


def common(
    pieces: Sequence[tuple[float, float]], others: Sequence[tuple[float, float]]
) -> Iterator[tuple[float, float]]:
    """Yield the parts of ``pieces`` that lie in one of ``others``, both of period 2 pi."""
    for (a, b), (c, d), turn in itertools.product(pieces, others, (-2 * np.pi, 0.0, 2 * np.pi)):
        low = max(a, c + turn)
        high = min(b, d + turn)
        if high > low:
            yield low, high


# Samples per period of the last harmonic. Quintic Hermite interpolation over a step h has an error of at most
# h^6 max|z^(6)| / (6! 2^6): here (2 pi/24)^6/46080 = 7e-9 of the last harmonic, less of all others.
DENSITY = 24
# Nodes of one panel of Gauss's rule, and the largest s of a factor exp(i s x), -1 <= x <= 1, that a panel integrates.
# The error is 5e-16 at s = 64, 2e-11 at 90 and 2e-4 at 110: s = 64 leaves room for the variation of the force itself.
NODES = 64
SPAN = 64.0
# Orders for which a loss has nodes. It needs f z' alone, over pieces that are cut at every minimum of the indentation:
# with 8 orders or 256 losses along the paper's in-phase branch are the same to 5e-12.
LOSS_ORDERS = 32


class Episode(NamedTuple):
    """One contact episode: the pair, the ``side`` that touches, onset phase and ``length`` in rad, ``approach`` in m/s.

    ``side`` is the sign of z there; ``approach`` is |Om z'_minus|, of a dissipative contact at least the law's floor.
    """

    pair: int
    side: int
    onset: float
    length: float
    approach: float


class _Onset(NamedTuple):
    """How a pair's force depends on z'_minus, the slope at the onset of one episode.

    ``phase`` is that of the onset, ``bend`` is z''/z' there; ``theta`` are the nodes of the episode, and ``weights``
    their weights in a mean over the period, times df/dz'_minus.
    """

    pair: int
    phase: float
    bend: float
    theta: np.ndarray
    weights: np.ndarray


@kernel
def _evaluate(z: np.ndarray, theta: np.ndarray, motion: np.ndarray) -> None:
    """Write z, z', z'' at every ``theta`` into ``motion`` (nodes, 3), from the harmonics ``z`` (K + 1,)."""
    for i in range(theta.size):
        turn = np.exp(1j * theta[i])
        # Horner's scheme for the sums of Z_k, k Z_k and k^2 Z_k times exp(i k theta).
        value = slope = curvature = 0j
        for k in range(z.size - 1, -1, -1):
            value = value * turn + z[k]
            slope = slope * turn + k * z[k]
            curvature = curvature * turn + k * k * z[k]
        motion[i, 0] = value.real
        motion[i, 1] = -slope.imag
        motion[i, 2] = -curvature.real


@kernel
def _transform(theta: np.ndarray, weighted: np.ndarray, out: np.ndarray) -> None:
    """Add sum_i weighted[:, i] exp(-i k theta_i) to ``out`` (rows, orders), k from 0 on."""
    for i in range(theta.size):
        turn = np.exp(-1j * theta[i])
        phasor = 1.0 + 0j
        for k in range(out.shape[1]):
            for row in range(out.shape[0]):
                out[row, k] += weighted[row, i] * phasor
            phasor *= turn


@lru_cache(maxsize=256)
def _factors(order: int) -> np.ndarray:
    """Return factors (4, K + 1) by which harmonics up to an ``order`` become the transforms of z and three derivatives.

    They are those of ``irfft`` over half the number of samples: the mean, which has no conjugate, counts twice.
    """
    factors = (1j * np.arange(order + 1)) ** np.arange(4)[:, None]
    factors[0, 0] = 2.0
    return factors


def _sampled(z: np.ndarray, derivatives: int) -> np.ndarray:
    """Return an elongation of harmonics ``z`` (K + 1,) and its ``derivatives`` by phase (1 + derivatives, samples)."""
    order = len(z) - 1
    # A power of two, which transforms fast; 8 are left for a motion that is constant (K = 0).
    samples = 1 << int(np.ceil(np.log2(DENSITY * order + 8)))
    return np.fft.irfft(z * (samples / 2) * _factors(order)[: derivatives + 1], samples)


@lru_cache(maxsize=256)
def _panels(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes sin^2 phi in [0, 1] and their weights: ``count`` panels of Gauss's rule in phi from 0 to pi/2."""
    x, weight = np.polynomial.legendre.leggauss(NODES)
    phi = (np.pi / 4 / count) * (x + 1 + 2 * np.arange(count)[:, None]).ravel()
    return np.sin(phi) ** 2, np.sin(2 * phi) * np.tile(weight, count) * (np.pi / 4 / count)


def nodes(pieces: Sequence[tuple[float, float]], orders: int) -> tuple[np.ndarray, np.ndarray]:
    """Return phases and weights of a quadrature over ``pieces`` for forces times exp(-i k theta), k <= ``orders``.

    A whole period has uniform nodes, exact for trigonometric polynomials below the order 4 ``orders``.
    """
    theta = [np.empty(0)]
    weights = [np.empty(0)]
    for a, b in pieces:
        if b - a >= 2 * np.pi:
            count = 4 * orders
            return np.arange(count) * (2 * np.pi / count), np.full(count, 2 * np.pi / count)

        # A panel is pi/(2 count) wide in phi, and |dtheta/dphi| <= b - a: s is at most orders (b - a) pi/(4 count).
        place, weight = _panels(1 + int((b - a) * orders * np.pi / 4 / SPAN))
        theta.append(a + (b - a) * place)
        weights.append((b - a) * weight)
    return np.concatenate(theta), np.concatenate(weights)


class _EpisodeForce(NamedTuple):
    """The force of a pair at the nodes of a quadrature over one contact ``episode``.

    ``theta`` (nodes,) in rad have ``weights`` in the integral over the period; ``values`` (4, nodes) are f, df/dz,
    df/dz' and the potential there, ``rate`` (nodes,) is z'. ``onset`` says how f depends on the slope with which the
    episode begins, None where it does not.
    """

    episode: Episode
    theta: np.ndarray
    weights: np.ndarray
    values: np.ndarray
    rate: np.ndarray
    onset: _Onset | None

    @property
    def loss(self) -> float:
        """The energy in J that the contact takes in this episode."""
        return float((self.values[0] * self.rate) @ self.weights)


class ForceSeries:
    """Harmonics of the forces in one motion (module docstring), with K the ``order`` of the highest harmonic of z.

    ``forces`` (pairs, 2K + 1) complex in N: those beyond K show the size of what a motion with K harmonics leaves out.
    ``potential`` (pairs,) is the mean potential energy in J, ``loss`` (pairs,) the dissipated energy in J per period,
    ``closed`` (pairs,) the fraction of the time in contact; ``episodes`` are in the order of pairs and onset phases.
    ``slopes`` (pairs, 2K + 1) in N/m are the Fourier coefficients of df/dz: two orders up to K differ by up to 2K.
    """

    def __init__(self, pairs: int, order: int) -> None:
        self.order = order
        self.forces = np.zeros((pairs, 2 * order + 1), complex)
        self.potential = np.zeros(pairs)
        self.loss = np.zeros(pairs)
        self.closed = np.zeros(pairs)
        self.episodes: list[Episode] = []
        self.slopes = np.zeros((pairs, 2 * order + 1), complex)
        self._rates = np.zeros((pairs, 2 * order + 1), complex)  # those of df/dz'
        self._onsets: list[_Onset] = []

    def add(self, force: _EpisodeForce) -> None:
        """Add the force in one contact episode."""
        pair = force.episode.pair
        out = np.zeros((3, 2 * self.order + 1), complex)
        _transform(force.theta, np.ascontiguousarray(force.values[:3] * force.weights / (2 * np.pi)), out)
        self._include(pair, out)
        self._rates[pair] += out[2]
        self.potential[pair] += force.values[3] @ force.weights / (2 * np.pi)
        self.loss[pair] += force.loss
        # An onset that moves changes z'_minus, and with it the force of the whole episode; at the floor it does not.
        if force.onset is not None:
            self._onsets.append(force.onset)
        self.closed[pair] += force.episode.length / (2 * np.pi)
        self.episodes.append(force.episode)

    def add_spring(self, pair: int, values: np.ndarray) -> None:
        """Add a spring whose f, df/dz and potential are ``values`` (3, samples) at uniform phases of the period."""
        samples = values.shape[1]
        self._include(pair, np.fft.rfft(values[:2], axis=1)[:, : 2 * self.order + 1] / samples)
        self.potential[pair] += values[2].mean()

    def _include(self, pair: int, means: np.ndarray) -> None:
        """Include the means of f exp(-i k theta) and of df/dz exp(-i k theta), the first two rows of ``means``."""
        # The mean of f exp(-i k theta) is F_k/2, but F_0 for k = 0, since f is a real part.
        self.forces[pair] += 2 * means[0]
        self.forces[pair, 0] -= means[0, 0]
        self.slopes[pair] += means[1]

    @property
    def acting(self) -> np.ndarray:
        """Numbers of the pairs whose force a perturbation changes: those in contact at some phase, and springs."""
        changes = np.any(self.slopes, axis=1) | np.any(self._rates, axis=1)
        return np.flatnonzero(changes)

    def add_load(self, pair: int, stops: Stops, z: np.ndarray) -> None:
        """Take off what a static load balances of a contact pressed at rest, and what a spring in its place has.

        ``z`` (K + 1,) are the harmonics in m of the elongation of the ``pair``.
        """
        mean = float(z[0].real)
        self.forces[pair, 0] -= stops.load
        self.potential[pair] -= stops.load * mean + stops.energy_at_rest

        self.forces[pair, : len(z)] -= stops.spring * z
        self.slopes[pair, 0] -= stops.spring
        # The mean of z^2 of a one-sided series.
        squared = mean**2 + float(np.sum(np.abs(z[1:]) ** 2)) / 2
        self.potential[pair] -= stops.spring * squared / 2

    def add_dashpot(self, pair: int, rate: float, z: np.ndarray) -> None:
        """Add a force of ``rate`` z' in N of a pair; z' is the derivative by the phase, and ``rate`` is in N/m.

        ``z`` (K + 1,) are the harmonics in m of its elongation.
        """
        self.forces[pair, : len(z)] += 1j * rate * np.arange(len(z)) * z
        self._rates[pair, 0] += rate

    @property
    def dissipates(self) -> bool:
        """Whether a force depends on a velocity, so that its ``jacobian`` depends on the exponent."""
        return bool(self._onsets) or bool(np.any(self._rates))

    def jacobian(
        self, exponent: complex = 0.0, orders: np.ndarray | None = None, rows: np.ndarray | None = None
    ) -> np.ndarray:
        """Return how f exp(-mu theta) depends on d_k (pairs, rows, orders), z by sum_k d_k exp((i k + mu) theta).

        Columns are the orders k of d_k, within -K..K, all unless given, ``rows`` those of the force, the same unless
        given; ``exponent`` is mu = lambda/Om of Hill's method. If nothing dissipates, an entry is the Fourier
        coefficient of df/dz of the order row minus column.
        """
        if orders is None:
            orders = np.arange(-self.order, self.order + 1)
        return self.jacobians(np.array([exponent]), orders, rows)[0]

    def jacobians(self, exponents: np.ndarray, orders: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Return the ``jacobian`` at each of the ``exponents``: (exponents, pairs, rows, orders)."""
        if rows is None:
            rows = orders
        lag = rows[:, None] - orders + 2 * self.order  # index in the two-sided series from -2K to 2K
        slopes = np.hstack([self.slopes[:, :0:-1].conj(), self.slopes])
        if not self.dissipates:
            return np.repeat(slopes[None, :, lag], len(exponents), axis=0)

        rate = 1j * orders + exponents[:, None]
        rates = np.hstack([self._rates[:, :0:-1].conj(), self._rates])
        matrices = rates[:, lag] * rate[:, None, None, :] + slopes[:, lag]

        # The change of z'_minus by d_k, (i k + mu - z''/z') exp((i k + mu) phase), times the force for a change of 1.
        for pair, phase, bend, theta, weights in self._onsets:
            turns = np.exp(1j * orders * phase)
            decays = weights * np.exp(-exponents[:, None] * (theta - phase))
            # Real and imaginary parts of all exponents in one call, whose phasors are the same for every row.
            out = np.zeros((2 * len(exponents), self.order + 1), complex)
            _transform(theta, np.concatenate([decays.real, decays.imag]), out)
            real, imaginary = np.split(out, 2)
            positive = real + 1j * imaginary
            negative = (real - 1j * imaginary).conj()
            force = np.where(rows < 0, negative[:, np.abs(rows)], positive[:, np.abs(rows)])
            matrices[:, pair] += force[:, :, None] * ((rate - bend) * turns)[:, None, :]
        return matrices


class SiteForces:
    """The pairs of a system, one row each of arrays: contacts with their ``Stops``, then nonlinear springs.

    A spring's force is here what it has beyond k z, which belongs to the stiffness of the system.
    """

    def __init__(self, contacts: Sequence[Stops], springs: Sequence[Spring] = ()) -> None:
        self.contacts = tuple(contacts)
        self.springs = tuple(springs)
        self.pairs = len(contacts) + len(springs)

    @property
    def odd(self) -> bool:
        """Whether all forces change sign with the elongations; those of contacts that are alike on both sides do."""
        both_sides = all(stops.plus == stops.minus for stops in self.contacts)
        return both_sides and all(spring.is_odd for spring in self.springs)

    @property
    def is_linear_at_rest(self) -> bool:
        """Whether motions about rest are linear up to where contacts open or close."""
        return not self.springs and all(stops.is_linear_at_rest for stops in self.contacts)

    def amplitude_scale(self, pair: int, g: float) -> float:
        """Return the amplitude in m at which the ``pair`` with the compliance ``g`` in m/N begins to feel its force.

        That of a contact is the clearance, or the depth by which it is pressed. For a spring |g c| a^2 = 1, with its
        cubic coefficient c, which is not 0: of its force at z = a cos theta only the cubic part has a first harmonic.
        """
        if pair < len(self.contacts):
            return abs(self.contacts[pair].clearance)
        cubic = self.springs[pair - len(self.contacts)].cubic
        return float(1 / np.sqrt(np.abs(g * cubic)))

    def series(self, z: np.ndarray, omega: float) -> ForceSeries:
        """Return the forces of elongations with the harmonics ``z`` (pairs, K + 1) complex in m, at ``omega`` in rad/s.

        Raises NoMotionError where a dissipative contact never separates: it has no onset.
        """
        series = ForceSeries(self.pairs, z.shape[1] - 1)
        for pair, stops in enumerate(self.contacts):
            for force in self._contact_forces(pair, z[pair], omega, 2 * series.order):
                series.add(force)
            if stops.is_pressed:
                series.add_load(pair, stops, z[pair])
            if stops.drag:
                series.add_dashpot(pair, stops.drag * omega, z[pair])

        # Uniform samples are exact for springs: f exp(-i k theta) has orders up to 3K + 2K, the energy up to 4K.
        for pair, spring in enumerate(self.springs, len(self.contacts)):
            x = _sampled(z[pair], derivatives=0)[0]
            values = [part(spring, x) for part in (nonlinear_force, nonlinear_slope, nonlinear_energy)]
            series.add_spring(pair, np.array(values))

        series.episodes.sort(key=lambda e: (e.pair, e.onset))
        return series

    def losses(self, z: np.ndarray, omega: float) -> np.ndarray:
        """Return the energies (contacts,) in J that the contacts take in a period, as the ``loss`` of ``series``.

        Raises NoMotionError where a dissipative contact never separates.
        """
        taken = [self._contact_forces(pair, z[pair], omega, LOSS_ORDERS) for pair in range(len(self.contacts))]
        return np.array([sum(force.loss for force in of_pair) for of_pair in taken])

    def _contact_forces(self, pair: int, z: np.ndarray, omega: float, orders: int) -> Iterator[_EpisodeForce]:
        """Yield the force of a contact, number ``pair``, in each contact episode, with nodes for so many ``orders``.

        ``z`` (K + 1,) are the harmonics of its elongation.
        """
        stops = self.contacts[pair]
        # No motion is larger than the sum of its harmonics: a contact within its clearances needs no samples.
        if stops.clearance >= np.abs(z).sum():
            return
        motion = _sampled(z, derivatives=3).T
        for side, clearance in ((1, stops.plus), (-1, stops.minus)):
            for begin, end in intervals_above(np.ascontiguousarray(side * motion[:, :3]), clearance):
                yield self._force(Episode(pair, side, begin, end - begin, approach=0.0), motion, z, omega, orders)

    def _force(self, episode: Episode, motion: np.ndarray, z: np.ndarray, omega: float, orders: int) -> _EpisodeForce:
        """Return the force in one contact ``episode``, whose approach velocity is found here.

        ``motion`` (samples, 4) is that of the pair and its derivatives, ``z`` (K + 1,) are its harmonics.
        """
        side = episode.side
        stops = self.contacts[episode.pair]
        law = stops.law
        c = law.damping
        if c and episode.length >= 2 * np.pi:
            raise NoMotionError("a dissipative contact never separates, so that it has no approach velocity")

        # The slope z'_minus in m/rad with which it begins, and z''/z' there, 0 where the motion only touches.
        at_onset = np.empty((1, 3))
        _evaluate(z, np.array([episode.onset]), at_onset)
        approach = at_onset[0, 1]
        bend = 0.0
        if approach:
            bend = at_onset[0, 2] / approach
        floored = c > 0 and abs(approach) * omega < law.approach_floor
        if floored:
            approach = side * law.approach_floor / omega

        # Where the force is smooth: between minima of the indentation, and where the contact is not clipped.
        pieces = list(cut(episode.onset, episode.onset + episode.length, minima(side * motion[:, 1])))
        if c and law.adhesion == "clip":
            # g > 0 where side z' > -side z'_minus/c = -|z'_minus|/c.
            pushing = intervals_above(np.ascontiguousarray(side * motion[:, 1:]), -side * approach / c)
            pieces = list(common(pieces, pushing))

        theta, weights = nodes(pieces, orders)
        at_nodes = np.empty((len(theta), 3))
        _evaluate(z, theta, at_nodes)
        # An end that is found to rounding may leave its first node outside the contact.
        x = np.maximum(side * at_nodes[:, 0] - stops.clearance_on(side), 0.0)
        rate = at_nodes[:, 1]

        # f = side elastic(x) g(z'): of its derivatives that by z has the slope of the law, that by z' the slope of g.
        elastic = stops.weight * law.elastic_force(x)
        slope = stops.weight * law.elastic_slope(x)
        g = np.ones_like(rate)
        per_rate = np.zeros_like(rate)
        if c:
            g = 1 + c * rate / approach
            per_rate = side * elastic * c / approach
        values = np.array([side * elastic * g, slope * g, per_rate, stops.weight * law.elastic_energy(x)])

        onset = None
        if c and not floored:
            weighted = -per_rate * rate / approach * weights / (2 * np.pi)
            onset = _Onset(episode.pair, episode.onset, bend, theta, weighted)
        return _EpisodeForce(episode._replace(approach=abs(approach) * omega), theta, weights, values, rate, onset)
