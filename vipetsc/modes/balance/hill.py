r"""Hill's method for condensed motions: which perturbations of a periodic motion grow, and how fast.

A perturbation exp(lambda t) sum_k d_k exp(i k Om t) of the elongations changes the forces by J d (``ForceSeries``), and
these the elongations by -G(k Om - i lambda) J d, G of outgoing waves (Im omega < 0 where Re lambda > 0): growing ones
are the zeros of

    D(lambda) = det(I + G(k Om - i lambda) J(lambda)),   Re lambda > 0,  |Im lambda| <= Om/2.

D is analytic there, tends to 1 for large Re lambda, is real on the real axis and has the period i Om but for what is
left out: it is a function of w = exp(-2 pi lambda/Om), analytic inside the circle of Re lambda = ``least`` Om, and its
zeros there are the inverse multipliers. Their number N is minus the turns of D along that line (Cauchy's argument
principle), and the Fourier coefficients of log D - N log w on the circle are their sums of powers, from which they are
found, and corrected on D itself. If a motion has odd orders alone and forces are odd, odd orders of perturbations do
not meet even ones: D is the product of two determinants. J is a Toeplitz matrix unless forces dissipate.

**Many harmonics.** Without dissipation the orders beyond ``KEPT``, d_h = -(I + G_hh J_hh)^-1 G_hh J_hl d_l, are
eliminated with G at lambda = 0: their part of J falls as KEPT^-4 with Hertz's law, and changes by lambda/(KEPT Om) of
itself. The double zero at lambda = 0, of a shift in time and of the neighbouring motion, stays exactly there.
Cf. G. W. Hill, Acta Math. 8 (1886) 1; von Groll and Ewins, J. Sound Vib. 241 (2001) 223; L. M. Delves and
J. N. Lyness, Math. Comput. 21 (1967) 543.
"""

from typing import Protocol

import numpy as np
from scipy.integrate import trapezoid

from vipetsc.modes.balance.harmonics import ForceSeries

# Growth rate over Om up to which a motion counts as stable: in a finite system, whose poles lie at Re lambda = 0, D is
# smooth over this length of the line, and 1 % a period is told. Lines on which the fastest growth is looked for first.
LEAST, LEAST_OF_FINITE, LINES = 1e-4, 1.6e-3, (0.1, 0.02)
COARSE, FINEST = 24, 14  # intervals of half a strip; halvings of one in which D turns by more than TURN
TURN = 0.7  # rad
KEPT = 48  # orders of perturbations that are kept where nothing dissipates
# Steps, first step and accuracy, over Om, of the secant method; |Im lambda| of what is no pair is nearer to 0 or 1/2.
MOST_STEPS, STEP, ACCURACY, REAL = 30, 1e-4, 1e-10, 1e-7


class At(Protocol):
    """A compliance (frequency, pair, pair) in m/N at complex frequencies in rad/s."""

    def at(self, omegas: np.ndarray) -> np.ndarray:
        """G at ``omegas``."""


class Hill:
    """Of motions at ``omega`` (rad/s) with harmonics up to ``last``, motions being ``odd`` or not; G is kept."""

    def __init__(self, compliance: At, omega: float, last: int, odd: bool, finite: bool) -> None:
        self.compliance, self.omega, self.finite, orders = compliance, omega, finite, np.arange(-last, last + 1)
        self.least = LEAST_OF_FINITE if finite else LEAST
        self._blocks = [orders[1 - last % 2 :: 2], orders[last % 2 :: 2]] if odd else [orders]
        self._known: dict[tuple[int, complex], np.ndarray] = {}
        self._of: tuple[ForceSeries, list[np.ndarray | None]] | None = None

    def determinants(self, series: ForceSeries, exponents: np.ndarray) -> np.ndarray:
        """D (exponents,) at lambda/Om = ``exponents``; large ones keep their phases."""
        if self._of is None or self._of[0] is not series:
            self._of = series, [self._eliminated(series, orders) for orders in self._blocks]
        out = np.ones(len(exponents), complex)
        for block, (orders, jacobian) in enumerate(zip(self._blocks, self._of[1], strict=True)):
            low = orders if jacobian is None else orders[np.abs(orders) <= KEPT]
            new = [mu for mu in exponents.tolist() if (block, mu) not in self._known]
            if new:
                g = self.compliance.at(((low - 1j * np.array(new)[:, None]) * self.omega).ravel())
                parts = g.reshape(len(new), len(low), *g.shape[1:])
                self._known |= {(block, mu): part for mu, part in zip(new, parts, strict=True)}
            for i, mu in enumerate(exponents.tolist()):
                matrix = _flat(series.jacobian(mu, low)) if jacobian is None else jacobian
                phase, log = np.linalg.slogdet(_plus_one(self._known[block, mu], matrix))
                out[i] *= phase * np.exp(min(log, 300.0))
        return out

    def _eliminated(self, series: ForceSeries, orders: np.ndarray) -> np.ndarray | None:
        """J (order pair, order pair) of the orders kept, with what the others do; None if it depends on lambda."""
        if not np.array_equal(series.jacobian(1.0, orders[:2]), series.jacobian(0.0, orders[:2])):
            return None
        pairs = len(series.potential)
        jacobian, high = _flat(series.jacobian(orders=orders)), np.abs(orders) > KEPT
        if not high.any():
            return jacobian
        g, rows = self.compliance.at(orders[high] * self.omega), np.repeat(high, pairs)
        inner = _plus_one(g, jacobian[np.ix_(rows, rows)])
        moved = np.linalg.solve(inner, _plus_one(g, jacobian[np.ix_(rows, ~rows)], 0.0))
        return jacobian[np.ix_(~rows, ~rows)] - jacobian[np.ix_(~rows, rows)] @ moved

    def _line(self, series: ForceSeries, growth: float) -> tuple[np.ndarray, np.ndarray]:
        """Im lambda/Om from 0 to 1/2 on Re lambda = ``growth`` Om, and log D there with its turns added up."""
        shares = np.linspace(0, 0.5, max(COARSE, int(0.5 / growth) if self.finite else 0) + 1)
        values = self.determinants(series, growth + 1j * shares)
        for _ in range(FINEST):
            turns = np.abs(np.angle(values[1:] / values[:-1]))
            (wide,) = np.nonzero(turns > TURN)
            if not wide.size:
                break
            between = (shares[wide] + shares[wide + 1]) / 2
            values = np.insert(values, wide + 1, self.determinants(series, growth + 1j * between))
            shares = np.insert(shares, wide + 1, between)
        turned = np.cumsum(np.angle(values[1:] / values[:-1]))
        return shares, np.log(np.abs(values)) + 1j * np.insert(turned, 0, 0.0)

    def unstable(self, series: ForceSeries) -> int:
        """How many perturbations grow faster than ``least`` Om, two for a complex pair; -1 if that cannot be told."""
        return _turns(self._line(series, self.least)[1])

    def fastest(self, series: ForceSeries) -> complex | None:
        """lambda/Om, Im lambda >= 0, of what grows fastest; 0 if nothing does, None if it is not found."""
        for growth in (*(line for line in LINES if line > self.least), self.least):
            zeros = self._beyond(series, growth)
            if zeros:
                return max(zeros, key=lambda mu: mu.real)
        return None if zeros is None else 0j

    def _beyond(self, series: ForceSeries, growth: float) -> list[complex] | None:
        """lambda/Om of all that grow faster than ``growth`` Om; None if they cannot be told or are not all found."""
        shares, logs = self._line(series, growth)
        count, angle = _turns(logs), 2 * np.pi * shares
        if count < 0:
            return None
        regular, monic = logs + 1j * count * angle, [1.0]  # log D - N log w on w = exp(-2 pi growth - i angle)
        sums = [-p * trapezoid((regular * np.exp(-1j * p * angle)).real, angle) / np.pi for p in range(1, count + 1)]
        for p in range(1, count + 1):  # Newton's identities
            monic.append(-sum(monic[p - j] * sums[j - 1] for j in range(1, p + 1)) / p)
        zeros: list[complex] = []
        for guess in growth - np.log(np.roots(monic).astype(complex)) / (2 * np.pi):
            mu = self._zero(series, complex(guess.real, abs(guess.imag)), zeros) if len(zeros) < count else None
            if mu is not None and mu.real > 0.9 * growth:
                zeros += [mu, mu.conjugate()] if REAL < mu.imag < 0.5 - REAL else [mu.real + 0.5j * round(2 * mu.imag)]
        return zeros if len(zeros) == count else None

    def _zero(self, series: ForceSeries, guess: complex, known: list[complex]) -> complex | None:
        """A zero of D beside the ``known`` ones, Im in [0, 1/2], by the secant method."""

        def value(mu: complex) -> complex:
            turns = [1 - np.exp(2 * np.pi * (zero - mu)) for zero in known]
            return complex(self.determinants(series, np.array([mu]))[0] / np.prod(turns))

        last, mu = guess + STEP * (1 + 1j), guess
        before = value(last)
        for _ in range(MOST_STEPS):
            here = value(mu)
            if here == before:
                return None
            last, mu, before = mu, mu - here * (mu - last) / (here - before), here
            if not abs(mu - guess) < 1:
                return None
            if abs(mu - last) < ACCURACY:
                imag = abs(mu.imag - round(mu.imag))
                return complex(mu.real, imag)
        return None


def _flat(jacobian: np.ndarray) -> np.ndarray:
    """J (pair, order, order) as a matrix (order pair, order pair)."""
    pairs, rows, columns = jacobian.shape
    out = np.zeros((rows, pairs, columns, pairs), jacobian.dtype)
    for i, part in enumerate(jacobian):
        out[:, i, :, i] = part
    return out.reshape(rows * pairs, columns * pairs)


def _plus_one(g: np.ndarray, matrix: np.ndarray, one: float = 1.0) -> np.ndarray:
    """1 + G J, G (order, pair, pair) being diagonal in the orders."""
    count, pairs = g.shape[:2]
    product = np.einsum("kij,kjn->kin", g, matrix.reshape(count, pairs, -1)).reshape(matrix.shape)
    product[np.diag_indices(min(product.shape))] += one
    return product


def _turns(logs: np.ndarray) -> int:
    """The number of zeros to the right of the line; -1 if it cannot be told."""
    turned = -float(logs[-1].imag) / np.pi
    return round(turned) if abs(turned - round(turned)) < 0.25 else -1
