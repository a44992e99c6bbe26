r"""Hill's method for condensed motions: which perturbations of a periodic motion grow, and how fast.

A perturbation exp(lambda t) sum_k d_k exp(i k Om t) of the elongations changes the forces by J d (``ForceSeries``). The
forces change the elongations by -G(k Om - i lambda) J d, where G is that of outgoing waves (Im omega < 0 where
Re lambda > 0). A perturbation that keeps itself going has d = -G J d: those that grow are the zeros of

    D(lambda) = det(I + G(k Om - i lambda) J(lambda)),   Re lambda > 0,  |Im lambda| <= Om/2.

A perturbation grows in a period by its multiplier exp(2 pi lambda/Om); in the code mu is lambda/Om, and perturbations
of Re mu up to ``least`` count as stable. The poles of G (linear modes) and its branch cuts (pass bands) lie at
Re lambda <= 0: to the right of them D is analytic. It tends to 1 for large Re lambda, and D(lambda*) = D(lambda)*, so
that it is real on the real axis. To add i Om to lambda only renumbers the orders k: with all orders D has the period
i Om and is a function of w = exp(-2 pi lambda/Om), analytic inside the circle of Re lambda = ``least`` Om, whose zeros
there are the inverse multipliers. Their number N is minus the turns of D along that line (Cauchy's argument principle),
from Im lambda = -Om/2 to Om/2; by the symmetry it is minus the half turns from 0 to Om/2, which alone are followed.
Their sums of powers are Fourier coefficients on a circle |w| = R (Delves and Lyness): with w = R exp(-i phi),

    sum_j (w_j/R)^p = -(p/pi) int_0^pi Re[(log D - N log w) exp(-i p phi)] d phi,   p = 1, ..., N.

A real constant in the bracket, such as -N log R, adds nothing to them, and the sign of D moves no zero: the code leaves
both out. Newton's identities turn the sums into the polynomial of the zeros. It is ill-conditioned for large N; what it
gives are guesses, which a secant method corrects on D itself. If a motion has odd orders alone and forces are odd, odd
orders of perturbations do not meet even ones: D is the product of two determinants. J is a Toeplitz matrix unless
forces dissipate.

**Many harmonics.** Without dissipation orders far above all linear modes, and above those of the lattice with closed
contacts, are eliminated with G at lambda = 0, once for each motion: J is then that of the lower ones, with what the
others do (``high_orders``). It is exact at lambda = 0, where D keeps its double zero.

**Words.** A *pair* is one of masses between which a force acts, as in ``harmonics``; exponents lambda that are not real
come in *complex pairs*.

Cf. G. W. Hill, Acta Math. 8 (1886) 1; von Groll and Ewins, J. Sound Vib. 241 (2001) 223; L. M. Delves and
J. N. Lyness, Math. Comput. 21 (1967) 543.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.integrate import trapezoid

from vipetsc.modes.balance.harmonics import ForceSeries
from vipetsc.modes.balance.high_orders import KeptOrders, highest_in_contact, kept_orders
from vipetsc.modes.balance.order_matrices import FEW_PAIRS, flat, of_pairs, plus_one
from vipetsc.modes.balance.shifted_compliance import Compliance
from vipetsc.modes.point import LEAST_GROWTH
from vipetsc.modes.problem import NoMotionError

# Growth rate over Om up to which a motion counts as stable: 0.06 % a period.
LEAST = 1e-4
# The same for a finite system without damping, 1 % a period, as for all normal modes. D has poles at the exponents of
# the linear modes, which lie at Re lambda = -decay Om or below. The line Re lambda = const on which D is followed keeps
# this distance from them.
LEAST_OF_FINITE = LEAST_GROWTH
# Lines on which the fastest growth is looked for first: far from the poles D has few turns and is cheap to follow. In
# the tests of stability a tenth fewer determinants are taken with them than without.
LINES = (0.1, 0.02)
# Intervals of half a strip, 0 <= Im lambda <= Om/2, at first. With 12 the tests take 4 % fewer determinants in a tenth
# more rounds, with 48 a tenth more, and nothing else changes.
COARSE = 24
# Exponents whose compliances are kept: those of the coarse grids on all lines come to 150. Of 12 contacts with all
# harmonics up to 121 they take 140 MB.
MOST_KEPT = 256
# Halvings, at most, of an interval in which D turns by more than ``TURN``: the finest is 1e-6 Om long.
FINEST = 14
# Largest turn of D in rad from one position to the next: at pi its sense would be ambiguous.
TURN = 0.7
# Largest change of log|D| from one position to the next. Beside an interval with two zeros in its middle it is 2.2. In
# twelve motions (four breathers, six of two masses, one and five equal sites) half of it takes 2 % more determinants
# and twice of it as many, with the same exponents; without a bound the five sites count as three.
STEEP = 1.5
# Exponent at which ``stability_changes`` takes D(0): at 0 itself a lattice that is free to move has no compliance.
AT_ZERO = 1e-9
# Steps, first step and accuracy, over Om, of the secant method. With half and twice of the first two the exponents of
# these motions are the same to 1e-13. It fails for the five equal sites alone.
MOST_STEPS = 30
STEP = 1e-4
ACCURACY = 1e-10
# An exponent is none of a complex pair where |Im lambda| over Om is nearer to 0 or 1/2 than this: rounding leaves an
# error of 1e-8 in a double zero.
REAL = 1e-7
# Entries of the matrices whose determinants are taken at once, 2 MB.
ENTRIES = 1 << 17
# Logarithm at which the size of a determinant is cut off. The product of two such determinants does not overflow.
LARGEST_LOG = 300.0


class ContourLine(NamedTuple):
    """D along Re lambda = const: Im lambda/Om from 0 to 1/2 as ``positions``, and log D with its angles added up.

    ``ends`` are D at the first and the last position, where it is real.
    """

    positions: np.ndarray
    logs: np.ndarray
    ends: tuple[float, float]

    def zeros_beyond(self) -> int:
        """The number of zeros to the right of the line; -1 if it is undecided."""
        turned = -float(self.logs[-1].imag) / np.pi
        # With all orders D is real at both ends, and it has turned by a whole number of half circles. A number that is
        # far from whole, or below 0, says that orders are left out that matter, and NaN that D is not finite or 0 at a
        # position. It cannot say whether a turn was missed: ``_follow_line`` makes sure that none is.
        count = np.round(turned)
        is_whole = abs(turned - count) < 0.25
        if is_whole and count >= 0:
            return int(count)
        return -1


class Perturbations(NamedTuple):
    """The number of perturbations that grow, -1 if it is undecided, and lambda/Om of the ``fastest``, None if unknown.

    ``fastest`` has Im lambda >= 0, and is 0 if none grows. ``response.steady`` makes these of a state for its measures,
    and asks for ``Stability`` where states are compared.
    """

    unstable: int
    fastest: complex | None


class _Determinants(NamedTuple):
    """D at some exponents: ``values`` (exponents,), and the ``logs`` (block, exponents) of |D| in each block of orders.

    Where |D| of a block is too large, a value has the right phase, and a modulus that is cut off.
    """

    values: np.ndarray
    logs: np.ndarray


class Stability(NamedTuple):
    """Number of perturbations of a motion that grow, -1 if it is undecided, and D where a multiplier is real.

    ``at_one`` and ``at_minus_one`` are D at Re lambda = ``least`` Om for Im lambda = 0 and Om/2: real, and zero where a
    multiplier has the size exp(2 pi least) and is positive, or negative.
    """

    unstable: int
    at_one: float
    at_minus_one: float


def _turns(values: np.ndarray) -> np.ndarray:
    """The angles by which D turns between neighbouring ``values``; NaN where it is 0 or not finite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.angle(values[1:] / values[:-1])


def least_growth(finite: bool, decay: float = 0.0) -> float:
    """Re lambda/Om up to which a motion counts as stable, of a ``finite`` system whose modes decay at least so fast."""
    if not finite:
        return LEAST
    return max(LEAST_OF_FINITE - decay, LEAST)


class Hill:
    """Stability of motions at ``omega`` (rad/s) with harmonics up to ``order``, ``odd`` ones alone or all.

    The ``compliance`` at a perturbation's frequencies is kept, for motions that differ in their forces alone. The
    linear modes of a ``finite`` system decay at the rate ``decay`` Om at least.
    """

    def __init__(
        self, compliance: Compliance, omega: float, order: int, odd: bool, finite: bool, decay: float = 0.0
    ) -> None:
        self.compliance = compliance
        self.omega = omega
        self.finite = finite
        self.decay = decay
        self.least = least_growth(finite, decay)
        orders = np.arange(-order, order + 1)
        self._blocks = [orders]
        if odd:
            self._blocks = [orders[1 - order % 2 :: 2], orders[order % 2 :: 2]]
        # Compliances by block, number of its orders and exponent, and the latest forces with their reduced Jacobians.
        self._compliances: dict[tuple[int, int, complex], np.ndarray] = {}
        self._reduced: tuple[ForceSeries, list[KeptOrders]] | None = None
        # The number of perturbations that grow and the fastest one, or the pairs, are asked for one after the other.
        self._least_line: tuple[ForceSeries, ContourLine] | None = None

    def determinants(self, series: ForceSeries, exponents: np.ndarray) -> np.ndarray:
        """D (exponents,) at lambda/Om = ``exponents``; large ones keep their phases. NaN with too few orders."""
        return self._evaluate(series, exponents).values

    def _evaluate(self, series: ForceSeries, exponents: np.ndarray, units: np.ndarray | float = 0.0) -> _Determinants:
        """D at lambda/Om = ``exponents``, its values over the exponentials of the ``units`` (block,)."""
        out = np.ones(len(exponents), complex)
        sizes = np.zeros((len(self._blocks), len(exponents)))
        units = np.broadcast_to(units, len(self._blocks))
        acting = self._acting(series)
        if not acting.size:
            return _Determinants(out, sizes)
        if self._reduced is None or self._reduced[0] is not series:
            self._reduced = series, self._reduce(series, acting)
        # With too few orders for the perturbations D decides nothing.
        if not self._reduced[1]:
            return _Determinants(np.full(len(exponents), np.nan, complex), sizes)

        for block, (low, jacobian) in enumerate(self._reduced[1]):
            compliances = self._at(block, low, exponents.tolist())

            # Many small determinants at once, but no more matrices than the processor's memory holds.
            count = max(1, ENTRIES // (len(low) * len(acting)) ** 2)
            for begin in range(0, len(exponents), count):
                part = slice(begin, begin + count)
                matrix = jacobian
                if matrix is None:
                    matrix = flat(series.jacobians(exponents[part], low)[:, acting])
                g = of_pairs(np.array(compliances[part]), acting)
                # As phase and logarithm, since at large exponents the product of so many pivots overflows.
                phases, logs = np.linalg.slogdet(plus_one(g, matrix))
                sizes[block, part] = logs
                # One by one: products of complex arrays are rounded otherwise on some processors.
                for i, value in enumerate(phases * np.exp(np.minimum(logs - units[block], LARGEST_LOG)), begin):
                    out[i] *= value
        return _Determinants(out, sizes)

    def _reduce(self, series: ForceSeries, acting: np.ndarray) -> list[KeptOrders]:
        """The orders kept of each block and their J; none at all if perturbations may have higher orders."""
        highest = highest_in_contact(self.compliance, self.omega, series, acting)
        if highest > series.order * self.omega:
            return []
        return [kept_orders(self.compliance, self.omega, series, orders, acting, highest) for orders in self._blocks]

    def _acting(self, series: ForceSeries) -> np.ndarray:
        """Numbers of the pairs of which the determinant is taken.

        A pair on which no force acts has a row of J that is zero, and leaves the determinant as it is. Up to
        ``FEW_PAIRS`` pairs are all taken, which costs little, unless no force acts on any of them.
        """
        acting = series.acting
        pairs = len(series.potential)
        if acting.size and pairs <= FEW_PAIRS:
            return np.arange(pairs)
        return acting

    def _at(self, block: int, orders: np.ndarray, exponents: Sequence[complex]) -> list[np.ndarray]:
        """The compliances (order, pair, pair) of a block's ``orders`` at ``exponents``: new ones all in one call."""
        # The number of orders is a part of the key: a state without dissipation needs its low orders alone, one with
        # dissipation all of them.
        keys = [(block, len(orders), mu) for mu in exponents]
        new = [key for key in keys if key not in self._compliances]
        if new:
            at = np.array([mu for *_, mu in new])
            g = self.compliance.at(((orders - 1j * at[:, None]) * self.omega).ravel())
            parts = g.reshape(len(new), len(orders), *g.shape[1:])
            # Copies, since a view would keep the compliances of all new exponents.
            self._compliances |= {key: part.copy() for key, part in zip(new, parts, strict=True)}
        values = [self._compliances[key] for key in keys]

        # Those used last are kept. Exponents of the coarse grid come again with every motion, those of refined
        # intervals and of the secant method mostly do not.
        for key in keys:
            self._compliances[key] = self._compliances.pop(key)
        for key in list(self._compliances)[:-MOST_KEPT]:
            del self._compliances[key]
        return values

    def _line(self, series: ForceSeries, growth: float) -> ContourLine:
        """D on Re lambda = ``growth`` Om; of the latest motion the line of ``least`` is kept."""
        if growth != self.least:
            return self._follow_line(series, growth)
        if self._least_line is None or self._least_line[0] is not series:
            self._least_line = series, self._follow_line(series, growth)
        return self._least_line[1]

    def _follow_line(self, series: ForceSeries, growth: float) -> ContourLine:
        """D on Re lambda = ``growth`` Om, so finely that it turns by ``TURN`` at most from one position to the next.

        Nor does log|D| change by more than ``STEEP`` there. Where a zero is so near to the line that the finest
        interval does not resolve it, it is counted on either side.
        """
        # D varies over the distance from the line to the poles, which are those of the modes of a finite system.
        intervals = COARSE
        if self.finite:
            intervals = max(COARSE, int(0.5 / (growth + self.decay)))
        positions = np.linspace(0, 0.5, intervals + 1)
        values, sizes = self._evaluate(series, growth + 1j * positions)
        for _ in range(FINEST):
            turns = np.abs(_turns(values))
            # Several zeros beside one interval may turn D in it by a whole circle, which the angles do not show; but
            # then |D| changes much in that interval or in the next one.
            steep = np.abs(np.diff(sizes.sum(axis=0))) > STEEP
            near_steep = np.convolve(steep, np.ones(3), "same") > 0
            (wide,) = np.nonzero((turns > TURN) | near_steep)
            if not wide.size:
                break
            middles = (positions[wide] + positions[wide + 1]) / 2
            between = self._evaluate(series, growth + 1j * middles)
            values = np.insert(values, wide + 1, between.values)
            sizes = np.insert(sizes, wide + 1, between.logs, axis=1)
            positions = np.insert(positions, wide + 1, middles)

        turned = np.cumsum(_turns(values))
        return ContourLine(
            positions=positions,
            logs=sizes.sum(axis=0) + 1j * np.insert(turned, 0, 0.0),
            ends=(float(values[0].real), float(values[-1].real)),
        )

    def unstable(self, series: ForceSeries) -> int:
        """Number of perturbations that grow faster than ``least`` Om, two for a complex pair; -1 if it is undecided."""
        return self._line(series, self.least).zeros_beyond()

    def stability(self, series: ForceSeries) -> Stability:
        """The number of perturbations that grow faster than ``least`` Om, and D where multipliers are real."""
        line = self._line(series, self.least)
        return Stability(line.zeros_beyond(), *line.ends)

    def pairs(self, series: ForceSeries) -> list[complex]:
        """lambda/Om, Im lambda > 0, of the complex pairs that grow faster than ``least`` Om, the slowest first.

        Empty also where not all of what grows is found.
        """
        zeros = self._beyond(series, self.least) or []
        return sorted((zero for zero in zeros if REAL < zero.imag < 0.5 - REAL), key=lambda zero: zero.real)

    def near(self, series: ForceSeries, guess: complex) -> complex:
        """lambda/Om of the complex pair to which the secant method goes from a ``guess``, that of a motion near by.

        Raises NoMotionError if it goes to none within 1 of the guess.
        """
        zero = self._zero(series, guess, [])
        if zero is None or not REAL < zero.imag < 0.5 - REAL:
            raise NoMotionError("no complex pair of multipliers is found near that of the state before")
        return zero

    def fastest(self, series: ForceSeries) -> complex | None:
        """lambda/Om, Im lambda >= 0, of what grows fastest; 0 if nothing does, None if it is not found."""
        for growth in (*(line for line in LINES if line > self.least), self.least):
            zeros = self._beyond(series, growth)
            if zeros:
                return max(zeros, key=lambda mu: mu.real)
        # All that grows lies to the right of the last line, whether the lines before it were decided or not.
        if zeros is None:
            return None
        return 0j

    def _beyond(self, series: ForceSeries, growth: float) -> list[complex] | None:
        """lambda/Om of all that grow faster than ``growth`` Om; None if undecided or if not all are found."""
        line = self._line(series, growth)
        count = line.zeros_beyond()
        if count < 0:
            return None

        # Sums of powers by the formula of the module, with phi = ``angle``; the polynomial by Newton's identities.
        angle = 2 * np.pi * line.positions
        regular = line.logs + 1j * count * angle
        sums = [-p * trapezoid((regular * np.exp(-1j * p * angle)).real, angle) / np.pi for p in range(1, count + 1)]
        monic = [1.0]
        for p in range(1, count + 1):
            monic.append(-sum(monic[p - j] * sums[j - 1] for j in range(1, p + 1)) / p)

        zeros: list[complex] = []
        for guess in growth - np.log(np.roots(monic).astype(complex)) / (2 * np.pi):
            if len(zeros) >= count:
                break
            mu = self._zero(series, complex(guess.real, abs(guess.imag)), zeros)
            # A zero may lie a little to the left of the line, and be counted to its right: see ``_follow_line``.
            if mu is None or mu.real <= 0.9 * growth:
                continue
            if REAL < mu.imag < 0.5 - REAL:
                zeros += [mu, mu.conjugate()]
            else:
                zeros.append(mu.real + 0.5j * round(2 * mu.imag))
        if len(zeros) != count:
            return None
        return zeros

    def _zero(self, series: ForceSeries, guess: complex, others: list[complex]) -> complex | None:
        """A zero of D that is none of the ``others``, Im in [0, 1/2], by the secant method."""
        before = guess + STEP * (1 + 1j)
        # A large D in units of its size here: with a phase alone the method would go nowhere.
        units = np.maximum(self._evaluate(series, np.array([before])).logs[:, 0] - LARGEST_LOG, 0.0)

        def value(mu: complex) -> complex:
            # Divided by what vanishes at the zeros found, so that the method does not return to them.
            factors = [1 - np.exp(2 * np.pi * (zero - mu)) for zero in others]
            return complex(self._evaluate(series, np.array([mu]), units).values[0] / np.prod(factors))

        value_before = value(before)
        mu = guess
        for _ in range(MOST_STEPS):
            value_here = value(mu)
            if value_here == value_before:
                return None
            following = mu - value_here * (mu - before) / (value_here - value_before)
            before = mu
            value_before = value_here
            mu = following
            if not abs(mu - guess) < 1:
                return None
            if abs(mu - before) < ACCURACY:
                return complex(mu.real, abs(mu.imag - round(mu.imag)))
        return None
