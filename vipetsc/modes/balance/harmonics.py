r"""Forces of contacts and smooth springs in a periodic motion: their harmonics, and the derivatives of these.

At the phase theta = Om t the elongations are z_j = Re sum_{k=0..K} Z_jk exp(i k theta), and the forces f_j have the
harmonics F_jk likewise. (Alternating frequency-time method: Cameron and Griffin 1989.) A contact's arcs, from onset to
separation, are searched on uniform samples of (z, z', z''), so dense that their quintic interpolants equal the motion
to rounding: no arc is missed, however short. An arc from a to b is integrated by Gauss's rule in phi, theta = a +
(b - a) sin^2 phi, in which Hertz's powers of (theta - a)(b - theta) are smooth. An arc is cut where its indentation has
a minimum, since the motion may nearly separate there. Nothing is sampled across an onset: coefficients are exact to
rounding, none is aliased.

The dissipation factor is g = 1 + c w'/w'_minus; w'_minus changes by dz' - (z''/z') dz at the onset, which moves.
Where g is clipped, arcs are cut on the zeros of g. Forces are continuous: moving ends add nothing.

T. M. Cameron, J. H. Griffin, An alternating frequency/time domain method for calculating the steady-state response of
nonlinear dynamic systems, J. Appl. Mech. 56 (1989) 149-154.
"""

import itertools
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vipetsc.compiled import allocating, kernel
from vipetsc.contact.search import bernstein, first_upcrossing, first_upcrossing_after_start
from vipetsc.lattice import Contact, Spring

# Samples per period and harmonic: the quintic's error is below (2 pi/24)^6/46080 = 7e-9 of the last harmonic.
DENSITY = 24
# Nodes of one panel of a quadrature, and half of the last harmonic's phase that it may span.
NODES = 64
SPAN = 64.0


class Episode(NamedTuple):
    """A contact's arc: the pair, its ``side`` +1 or -1, onset phase, ``length`` in rad, approach velocity in m/s."""

    pair: int
    side: int
    onset: float
    length: float
    approach: float


class _Onset(NamedTuple):
    """How a pair's force depends on w'_minus: nodes behind the onset phase, their weights times df/dw'_minus."""

    pair: int
    phase: float
    bend: float
    theta: np.ndarray
    weights: np.ndarray


@kernel
def _evaluate(z: np.ndarray, theta: np.ndarray, motion: np.ndarray) -> None:
    """z, z', z'' (derivatives by phase) at every ``theta`` into ``motion`` (nodes, 3)."""
    for i in range(theta.size):
        turn = np.exp(1j * theta[i])
        value = slope = bend = 0j
        for k in range(z.size - 1, -1, -1):
            value = value * turn + z[k]
            slope = slope * turn + k * z[k]
            bend = bend * turn + k * k * z[k]
        motion[i, 0], motion[i, 1], motion[i, 2] = value.real, -slope.imag, -bend.real


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


@allocating
def _crossings(motion: np.ndarray, offset: float, out: np.ndarray) -> int:
    """Phases where the first column of ``motion`` (samples, 3), a period of (w, w', w''), passes ``offset``: number.

    They are written into ``out`` in order; the first one is an upcrossing unless the period begins above.
    """
    samples = motion.shape[0]
    h = 2.0 * np.pi / samples
    count = 0
    above = motion[0, 0] > offset
    b = np.empty(6)
    c = np.empty(6)
    for i in range(samples):
        bernstein(motion[i], motion[(i + 1) % samples], h, b)
        b -= offset
        if (b.max() <= 0.0 and not above) or (b.min() > 0.0 and above):
            continue

        c[:] = b if not above else -b
        begin = 0.0
        root = first_upcrossing(c)
        while root <= 1.0 and count < out.size:
            begin += root * (1.0 - begin)
            out[count] = (i + begin) * h
            count += 1
            above = not above
            if begin >= 1.0:
                break
            for k in range(1, 6):  # de Casteljau: the part of the interval after the root
                for j in range(6 - k):
                    c[j] = (1.0 - root) * c[j] + root * c[j + 1]
            c[:] = -c
            c[0] = 0.0
            root = first_upcrossing_after_start(c, 0.0)
    return count


def arcs(motion: np.ndarray, offset: float) -> list[tuple[float, float]]:
    """Intervals of phase on which a periodic motion (samples, 3) of (w, w', w'') is above ``offset``; none wraps.

    One that holds always is (0, 2 pi); one that holds at phase 0 begins at a negative phase.
    """
    if motion[:, 0].max() + 0.1 * np.ptp(motion[:, 0]) <= offset:
        return []
    out = np.empty(4 * len(motion))
    roots = out[: _crossings(motion, offset, out)]
    if len(roots) < 2:
        return [(0.0, 2 * np.pi)] if motion[0, 0] > offset else []
    if motion[0, 0] > offset:
        roots = np.concatenate([[roots[-1] - 2 * np.pi], roots[:-1]])
    return [(a, b) for a, b in zip(roots[::2].tolist(), roots[1::2].tolist(), strict=True) if b > a]


@lru_cache(maxsize=256)
def _panels(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places in an arc, from 0 to 1, and their weights: ``count`` panels of Gauss's rule in phi, at sin^2 phi."""
    x, weight = np.polynomial.legendre.leggauss(NODES)
    phi = (np.pi / 4 / count) * (x + 1 + 2 * np.arange(count)[:, None]).ravel()
    return np.sin(phi) ** 2, np.sin(2 * phi) * np.tile(weight, count) * (np.pi / 4 / count)


def nodes(pieces: Sequence[tuple[float, float]], orders: int) -> tuple[np.ndarray, np.ndarray]:
    """Phases and weights of a quadrature over ``pieces``, exact up to harmonics of the number ``orders``.

    A whole period has uniform nodes.
    """
    theta = [np.empty(0)]
    weights = [np.empty(0)]
    for a, b in pieces:
        if b - a >= 2 * np.pi:
            count = 4 * orders
            return np.arange(count) * (2 * np.pi / count), np.full(count, 2 * np.pi / count)
        place, weight = _panels(1 + int((b - a) * orders * np.pi / 4 / SPAN))
        theta.append(a + (b - a) * place)
        weights.append((b - a) * weight)
    return np.concatenate(theta), np.concatenate(weights)


class ForceSeries:
    """Harmonics of the forces in one motion (module docstring), with K the ``order`` of the highest harmonic of z.

    ``forces`` (pairs, 2K + 1) complex in N, those beyond K too; ``potential`` (pairs,) mean potential energy in J;
    ``loss`` (pairs,) J per period; ``closed`` (pairs,) fraction of the time in contact; ``episodes`` in order.
    """

    def __init__(self, pairs: int, order: int) -> None:
        self.order = order
        self.forces = np.zeros((pairs, 2 * order + 1), complex)
        self.potential = np.zeros(pairs)
        self.loss = np.zeros(pairs)
        self.closed = np.zeros(pairs)
        self.episodes: list[Episode] = []
        # Fourier coefficients of df/dz and df/dz'.
        self._slopes = np.zeros((pairs, 2 * order + 1), complex)
        self._rates = np.zeros((pairs, 2 * order + 1), complex)
        self._onsets: list[_Onset] = []

    def add(self, pair: int, theta: np.ndarray, weights: np.ndarray, values: np.ndarray, rate: np.ndarray) -> None:
        """Add nodes of a pair with f, df/dz, df/dz' and the potential there (4, nodes) and z' (nodes,)."""
        out = np.zeros((3, 2 * self.order + 1), complex)
        _transform(theta, np.ascontiguousarray(values[:3] * weights / (2 * np.pi)), out)
        self.forces[pair] += 2 * out[0]
        self.forces[pair, 0] -= out[0, 0]
        self._slopes[pair] += out[1]
        self._rates[pair] += out[2]
        self.potential[pair] += values[3] @ weights / (2 * np.pi)
        self.loss[pair] += (values[0] * rate) @ weights

    def add_onset(self, onset: _Onset) -> None:
        """Add how the force of an arc depends on the approach velocity at its onset."""
        self._onsets.append(onset)

    def jacobian(self, exponent: complex = 0.0, orders: np.ndarray | None = None) -> np.ndarray:
        """How f exp(-mu theta) depends on d_k (pairs, orders, orders), if z changes by sum_k d_k exp((i k + mu) theta).

        Rows and columns are ``orders`` of two-sided series, -K..K unless given; ``exponent`` is mu = lambda/Om of
        Hill's method. A Toeplitz matrix of the Fourier coefficients of df/dz if nothing dissipates.
        """
        if orders is None:
            orders = np.arange(-self.order, self.order + 1)
        lag = orders[:, None] - orders + 2 * self.order
        rate = 1j * orders + exponent
        slopes = np.hstack([self._slopes[:, :0:-1].conj(), self._slopes])
        rates = np.hstack([self._rates[:, :0:-1].conj(), self._rates])
        matrix = slopes[:, lag]
        matrix += rates[:, lag] * rate

        for pair, phase, bend, theta, weights in self._onsets:
            decay = weights * np.exp(-exponent * (theta - phase))
            out = np.zeros((2, self.order + 1), complex)
            _transform(theta, np.ascontiguousarray([decay.real, decay.imag]), out)
            up = out[0] + 1j * out[1]  # of the order k
            down = (out[0] - 1j * out[1]).conj()  # of the order -k
            row = np.where(orders < 0, down[np.abs(orders)], up[np.abs(orders)])
            matrix[pair] += np.outer(row, (rate - bend) * np.exp(1j * orders * phase))
        return matrix


class SiteForces:
    """Contact pairs (law, clearance in m), then nonlinear springs, a row each; k z of a spring is not a force."""

    def __init__(self, contacts: Sequence[tuple[Contact, float]], springs: Sequence[Spring] = ()) -> None:
        self.contacts = tuple(contacts)
        self.springs = tuple(springs)
        self.pairs = len(contacts) + len(springs)

    @property
    def odd(self) -> bool:
        """Whether all forces change sign with the elongations."""
        return all(spring.is_odd for spring in self.springs)

    def amplitude_scale(self, place: int, g: float) -> float:
        """Amplitude in m at which a place with the compliance ``g`` in m/N begins to feel its force: the clearance.

        That of a spring, which has none, is where the cubic part balances the lattice.
        """
        if place < len(self.contacts):
            return self.contacts[place][1]
        cubic = self.springs[place - len(self.contacts)].cubic
        return float(1 / np.sqrt(np.abs(g * cubic) or 1.0))

    def series(self, z: np.ndarray, omega: float) -> ForceSeries:
        """The forces of elongations with the harmonics ``z`` (pairs, K + 1) complex in m, at ``omega`` in rad/s.

        Raises ArithmeticError where a dissipative contact never separates: it has no onset.
        """
        order = z.shape[1] - 1
        series = ForceSeries(self.pairs, order)
        motion = self._sampled(z)
        for pair, (_, clearance) in enumerate(self.contacts):
            for side in (1, -1):
                for begin, end in arcs(np.ascontiguousarray(side * motion[pair, :, :3]), clearance):
                    arc = Episode(pair, side, begin, end - begin, approach=0.0)
                    self._add_arc(series, arc, motion[pair], z, omega)

        samples = motion.shape[1]
        theta = np.arange(samples) * (2 * np.pi / samples)
        weights = np.full(samples, 2 * np.pi / samples)
        for pair, spring in enumerate(self.springs, len(self.contacts)):
            x = motion[pair, :, 0]
            rate = motion[pair, :, 1]
            values = [spring.nonlinear_force(x), spring.nonlinear_slope(x), 0 * x, spring.nonlinear_energy(x)]
            series.add(pair, theta, weights, np.array(values), rate)

        series.episodes.sort(key=lambda e: (e.pair, e.onset))
        return series

    def _sampled(self, z: np.ndarray) -> np.ndarray:
        """The elongations and their first three derivatives by phase (pairs, samples, 4) over a period."""
        order = z.shape[1] - 1
        samples = 1 << int(np.ceil(np.log2(DENSITY * order + 8)))
        spectrum = np.zeros((self.pairs, samples // 2 + 1), complex)
        spectrum[:, : order + 1] = z * (samples / 2)
        spectrum[:, 0] = z[:, 0].real * samples
        rates = 1j * np.arange(samples // 2 + 1)
        return np.stack([np.fft.irfft(spectrum * rates**d, samples) for d in range(4)], axis=-1)

    def _add_arc(self, series: ForceSeries, arc: Episode, motion: np.ndarray, z: np.ndarray, omega: float) -> None:
        """Add one arc of contact, whose approach is not known yet, to the ``series``."""
        pair, side, a, length, _ = arc
        law, clearance = self.contacts[pair]
        c = law.damping
        at = np.empty((1, 3))
        _evaluate(z[pair], np.array([a]), at)
        approach = at[0, 1]
        bend = at[0, 2] / at[0, 1] if at[0, 1] else 0.0
        if c and length >= 2 * np.pi:
            raise ArithmeticError("a dissipative contact never separates, so that it has no approach velocity")
        floored = c > 0 and abs(approach) * omega < law.approach_floor
        if floored:
            approach = side * law.approach_floor / omega

        pieces = list(_cut(a, a + length, _minima(side * motion[:, 0], side * motion[:, 1])))
        if c and law.adhesion == "clip":  # where g > 0: -side z' < |z'_minus|/c
            pushing = arcs(np.ascontiguousarray(side * motion[:, 1:]), -side * approach / c)
            pieces = list(_common(pieces, pushing))
        theta, weights = nodes(pieces, 2 * series.order)
        at = np.empty((len(theta), 3))
        _evaluate(z[pair], theta, at)
        x = np.maximum(side * at[:, 0] - clearance, 0.0)
        rate = at[:, 1]

        elastic = law.elastic_force(x)
        slope = law.elastic_slope(x)
        g = np.ones_like(rate)
        per_rate = np.zeros_like(rate)
        if c:
            g = 1 + c * rate / approach
            per_rate = side * elastic * c / approach
        values = np.array([side * elastic * g, slope * g, per_rate, law.potential(at[:, 0], clearance)])
        series.add(pair, theta, weights, values, rate)
        if c and not floored:
            # An onset that moves changes w'_minus, and with it the force of the whole arc.
            weighted = -per_rate * rate / approach * weights / (2 * np.pi)
            series.add_onset(_Onset(pair, a, bend, theta, weighted))
        series.closed[pair] += length / (2 * np.pi)
        series.episodes.append(arc._replace(approach=abs(approach) * omega))


def _minima(value: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Phases of a uniformly sampled periodic motion's minima, by the secant of its slope."""
    after = np.roll(slope, -1)
    at = np.nonzero((slope < 0) & (after >= 0))[0]
    return (at + slope[at] / (slope[at] - after[at])) * (2 * np.pi / len(value))


def _cut(a: float, b: float, places: np.ndarray) -> Iterator[tuple[float, float]]:
    """The interval from ``a`` to ``b``, cut at ``places`` of period 2 pi; a whole period stays whole."""
    turns = np.concatenate([places - 2 * np.pi, places]) if b - a < 2 * np.pi else np.empty(0)
    inside = np.sort(turns[(turns > a) & (turns < b)]).tolist()
    yield from itertools.pairwise([a, *inside, b])


def _common(
    pieces: Sequence[tuple[float, float]], others: Sequence[tuple[float, float]]
) -> Iterator[tuple[float, float]]:
    """The parts of ``pieces`` that lie in one of ``others``, both of period 2 pi."""
    for (a, b), (c, d), turn in itertools.product(pieces, others, (-2 * np.pi, 0.0, 2 * np.pi)):
        low, high = max(a, c + turn), min(b, d + turn)
        if high > low:
            yield low, high
