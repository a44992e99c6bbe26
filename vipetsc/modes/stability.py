r"""Stability: which perturbations of a periodic motion grow, and how fast, by shooting and by harmonic balance.

A perturbation exp(lambda t) p(t), with p periodic as the motion, is multiplied by mu = exp(2 pi lambda/Om) in a period,
a Floquet multiplier. A motion is unstable if a multiplier lies outside the unit circle, by more than a threshold:
``LEAST_GROWTH`` for normal modes by every method and for finite systems without damping, less where energy leaves
(``least_growth``). ``Stability`` is the result of Hill's method.

**Half-traces of a shot orbit** (``half_traces``). S = [[A, B], [C, D]] is the derivative of the arc's end by its start,
of displacements before velocities, in coordinates M^1/2 u: the block A becomes M^1/2 A M^-1/2, and so do the others. In
these coordinates S is symplectic, that is

    D^T A - B^T C = 1,    S^-1 = [[D^T, -B^T], [-C^T, A^T]],

and D^T B and C^T A are symmetric. The rest of the period is the arc's mirror image. With R = diag(1, -1), which
reverses time, the multipliers mu are the eigenvalues of the *basic map*, or their squares:

    arc                 basic map             its diagonal block           multipliers
    half, from rest     R S^-1 R S            1 + 2 B^T C (upper)          mu
    half, from centre   R S^-1 R S            1 + 2 C^T B (lower)          mu
    quarter, from rest  -R S^-1 R S           1 - 2 D^T A (upper)          mu^2: the map is over half a period
    whole, from rest    S                     A = 1 + 2 (A - 1)/2 (upper)  mu

The eigenvalues of a basic map Q come in pairs, mu and 1/mu, since Q^-1 = R Q R. (Q + Q^-1)/2 has the two diagonal
blocks of Q and else zeros. The eigenvalues of each block are

    c = (mu + 1/mu)/2,

the *half-traces*, n of them. In (-1, 1) the pair is on the unit circle, mu = exp(+-i arccos c): the orbit is stable;
c = 1 is a fold of the energy or a branch point; c = -1 breaks the symmetry (quarter) or doubles the period (others);
c = 0 doubles the period of a quarter's orbit. One half-trace is 1 for every orbit, that of a shift in time and of a
change of energy. Its left eigenvector l in the product of blocks above is the rate at which the start passes its
section: at rest the acceleration a, at the centre the velocity v. For S takes the state's rate at the start to that at
the end. From rest to rest these are (0, a) and (0, a'), so that B a = 0 and l^T B^T C = 0; from rest to the centre
(0, a) and (v', 0), so that D a = 0; from centre to centre (v, 0) and (v', 0), so that C v = 0. The other half-traces
belong to the space orthogonal to l, into which the product maps.

**Hill's determinant of a condensed motion** (``Hill``). A perturbation exp(lambda t) sum_k d_k exp(i k Om t) of the
elongations changes the forces by J d (``ForceSeries``). The forces change the elongations by -G(k Om - i lambda) J d,
where G is that of outgoing waves (Im omega < 0 where Re lambda > 0). A perturbation that keeps itself going has
d = -G J d: those that grow are the zeros of

    D(lambda) = det(I + G(k Om - i lambda) J(lambda)),   Re lambda > 0,  |Im lambda| <= Om/2.

In the code mu is lambda/Om, and perturbations of Re mu up to ``least`` count as stable. The poles of G (linear modes)
and its branch cuts (pass bands) lie at Re lambda <= 0: to the right of them D is analytic. It tends to 1 for large
Re lambda, and D(lambda*) = D(lambda)*, so that it is real on the real axis. To add i Om to lambda only renumbers the
orders k: with all orders D has the period i Om and is a function of w = exp(-2 pi lambda/Om), analytic inside the
circle of Re lambda = ``least`` Om, whose zeros there are the inverse multipliers. Their number N is minus the turns of
D along that line (Cauchy's argument principle), from Im lambda = -Om/2 to Om/2; by the symmetry it is minus the half
turns from 0 to Om/2, which alone are followed. Their sums of powers are Fourier coefficients on a circle |w| = R
(Delves and Lyness): with w = R exp(-i phi),

    sum_j (w_j/R)^p = -(p/pi) int_0^pi Re[(log D - N log w) exp(-i p phi)] d phi,   p = 1, ..., N.

A real constant in the bracket, such as -N log R, adds nothing to them, and the sign of D moves no zero: the code leaves
both out. Newton's identities turn the sums into the polynomial of the zeros. It is ill-conditioned for large N; what it
gives are guesses, which a secant method corrects on D itself. If a motion has odd orders alone and forces are odd, odd
orders of perturbations do not meet even ones: D is the product of two determinants. J is a Toeplitz matrix unless
forces dissipate. The compliance G (..., order, pair, pair) moves each order by itself; J (..., order pair, order pair)
has a row and a column for every pair at every order, pairs of one order side by side.

**Many harmonics** (``KeptOrders``). The high orders h of a perturbation follow from the lower orders l,
d_h = -(I + G_hh J_hh)^-1 G_hh J_hl d_l. Where nothing dissipates they are eliminated with G at lambda = 0, once for
each motion: their contribution to J falls as k^-4 with Hertz's law, and changes with lambda by the fraction
lambda/(k Om). The elimination divides D by det(I + G_hh J_hh), a constant, so that no zero moves. At lambda = 0 it is
exact. Above the linear modes and pass bands G is even in the frequency, so that the changes for the orders k and -k
have opposite signs. For a motion that is even in time they cancel to first order in lambda: D keeps its double zero at
lambda = 0, which belongs to a shift in time and to the neighbouring motion of the branch.

An order whose frequency is near a linear mode must not be eliminated, since its G changes much with lambda. The same
holds for the modes that the lattice would have if contacts stayed closed: I + G_hh J_hh is nearly singular there. Let
S = diag(max df/dz) be the largest stiffnesses that the forces of the pairs have in a period. With springs of these
stiffnesses the squared frequencies are the eigenvalues of M^-1 (K + B S B^T), where B^T u are the elongations. By
Weyl's inequality they are at most

    omega_h^2 = omega_max^2 + the largest eigenvalue of S^1/2 B^T M^-1 B S^1/2

with the highest linear frequency omega_max. Orders up to ``ABOVE`` omega_h/Om are kept, ``KEPT`` at least. A motion
whose own harmonics end below omega_h has too few orders for its perturbations, and leaves their growth undecided.

Cf. G. W. Hill, Acta Math. 8 (1886) 1; von Groll and Ewins, J. Sound Vib. 241 (2001) 223; L. M. Delves and
J. N. Lyness, Math. Comput. 21 (1967) 543.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.integrate import trapezoid

from vipetsc.modes.balance.harmonic_balance import Compliance
from vipetsc.modes.balance.harmonics import ForceSeries
from vipetsc.modes.flow import Arc, ShootingMap
from vipetsc.modes.point import Point
from vipetsc.modes.problem import NoMotionError
from vipetsc.modes.system import System

# A motion counts as unstable if a perturbation grows faster than the first number times its frequency in rad/s: by more
# than 1 % in a period, or a Floquet multiplier with a modulus beyond the second number. Multipliers of stable motions,
# of modulus 1, come out with the errors of the methods. Files have the threshold beside the numbers.
LEAST_GROWTH = 1.6e-3
UNSTABLE_BEYOND = float(np.exp(2 * np.pi * LEAST_GROWTH))


def half_traces(system: System, shooting_map: ShootingMap, arc: Arc) -> np.ndarray:
    """Return half-traces c (n - 1,) of the basic map of an ``arc``, without the trivial pair, by their real parts.

    They are real, or complex if one of them is not.
    """
    root = np.sqrt(system.masses)
    n = len(root)
    sensitivity = arc.sensitivity
    blocks = sensitivity[:n, :n], sensitivity[:n, n:], sensitivity[n:, :n], sensitivity[n:, n:]
    a, b, c, d = (root[:, None] * block / root for block in blocks)

    # The product of blocks in the table of this module, of which the half-traces are 1 + 2 eigenvalues, or 1 - 2.
    if shooting_map.fraction == 1.0:
        product = (a - np.eye(n)) / 2
    elif shooting_map.quarter:
        product = d.T @ a
    elif shooting_map.starts_at_rest:
        product = b.T @ c
    else:
        product = c.T @ b

    # With two masses one eigenvalue is the trivial one, 0, so that the trace is the other one: more exact than a
    # projection.
    if n == 2:
        eigenvalues = np.array([np.trace(product)])
    else:
        trivial = _start_rate(system, shooting_map, arc) * root
        # The right singular vectors of a row are the row itself, then a basis of what is orthogonal to it.
        basis = np.linalg.svd(trivial[None, :])[2][1:].T
        eigenvalues = np.linalg.eigvals(basis.T @ product @ basis)

    sign = 1
    if shooting_map.quarter:
        sign = -1
    traces = 1 + sign * 2 * eigenvalues
    traces = traces[np.argsort(traces.real)]
    # Pairs of multipliers that leave the unit circle together have complex half-traces; all others are real.
    if np.any(np.abs(traces.imag) != 0):
        return traces
    return traces.real


def _start_rate(system: System, shooting_map: ShootingMap, arc: Arc) -> np.ndarray:
    """Return time derivative (n,) of what is zero at the arc's start: acceleration at rest, velocity at the centre."""
    n = system.dofs
    if not shooting_map.starts_at_rest:
        return arc.start[n:]
    return -system.forces(arc.start[:n]) / system.masses


def multipliers(traces: np.ndarray, quarter: bool) -> np.ndarray:
    """Return multipliers (2n - 2,) over the period from half-traces (n - 1,), those of a ``quarter`` map or not.

    The first half has |mu| >= 1, the second half their inverses.
    """
    c = traces.astype(complex)
    root = np.sqrt(c * c - 1)
    # The larger root of mu^2 - 2 c mu + 1 = 0 without cancellation; the smaller one is its inverse.
    mu = np.where(np.abs(c + root) >= np.abs(c - root), c + root, c - root)
    mu = np.concatenate([mu, 1 / mu])
    # The basic map of a quarter is half a period.
    if quarter:
        return mu**2
    return mu


def real_half_traces(left: Point, right: Point) -> list[int]:
    """Return numbers (from 0) of the half-traces that are real at one of two points or at both.

    A complex one belongs to multipliers off the real axis, which do not come to 1 or -1, whatever its real part does.
    """
    are_complex = (np.imag(left.half_traces) != 0) & (np.imag(right.half_traces) != 0)
    return np.flatnonzero(~are_complex).tolist()


class HalfTraceAbove:
    """Distance of half-trace ``number`` (from 0) of a point above a ``level``."""

    def __init__(self, number: int, level: float) -> None:
        self.number = number
        self.level = level

    def __call__(self, point: Point) -> float:
        """Return the difference at a point."""
        return float(np.real(point.half_traces[self.number])) - self.level

    def is_real(self, point: Point) -> bool:
        """Return whether the half-trace is real at a point; numbers change where two of them become a complex pair."""
        return bool(np.imag(point.half_traces[self.number]) == 0)


def of_pairs(g: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return G (..., order, pair, pair) between some of the ``pairs``."""
    if len(pairs) == g.shape[-1]:
        return g
    return g[..., pairs[:, None], pairs]


def flat(jacobian: np.ndarray) -> np.ndarray:
    """Return J (..., pair, order, order) as a matrix (..., order pair, order pair)."""
    *several, pairs, rows, columns = jacobian.shape
    if pairs == 1:
        return jacobian[..., 0, :, :]
    out = np.zeros((*several, rows, pairs, columns, pairs), jacobian.dtype)
    for i in range(pairs):
        out[..., i, :, i] = jacobian[..., i, :, :]
    return out.reshape(*several, rows * pairs, columns * pairs)


def plus_one(g: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return 1 + G J of a G (..., order, pair, pair) diagonal in orders, and J (..., order pair, order pair)."""
    out = product_of(g, matrix)
    diagonal = np.arange(out.shape[-1])
    out[..., diagonal, diagonal] += 1.0
    return out


def product_of(g: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return G J of G (..., order, pair, pair), which is diagonal in the orders, and J (..., order pair, columns)."""
    count, pairs = g.shape[-3:-1]
    rows = matrix.reshape(*matrix.shape[:-2], count, pairs, -1)
    # Of one pair each order has one number, for which a product of matrices would take twice as long.
    if pairs == 1:
        product = g * rows
    else:
        product = np.matmul(g, rows)
    return product.reshape(*product.shape[:-3], count * pairs, -1)


# Orders of perturbations, to both sides of 0, that are kept at least where nothing dissipates, and the factor of
# omega_h up to which further orders are: growth rates over Om then err by less than 1e-3.
KEPT = 48
ABOVE = 1.25
# The number of orders is a multiple of this one, so that neighbouring states of a curve have compliances in common.
KEPT_TOGETHER = 16
# At this multiple of the highest linear frequency the compliance is that of the masses alone, with an error of 1e-4.
FAR = 100.0


class KeptOrders(NamedTuple):
    """The ``orders`` that are kept, and ``jacobian`` (order pair, order pair), their J with the effect of the others.

    ``jacobian`` is None where forces dissipate: J depends on lambda there, and all orders are kept.
    """

    orders: np.ndarray
    jacobian: np.ndarray | None


def kept_orders(
    compliance: Compliance, omega: float, series: ForceSeries, orders: np.ndarray, acting: np.ndarray, highest: float
) -> KeptOrders:
    """Eliminate the high ones of ``orders``, -K..K or every other one, in a motion at ``omega`` (rad/s).

    The ``series`` has its forces, and ``highest`` is omega_h; the matrices are those of the pairs with the numbers
    ``acting``.
    """
    if series.dissipates:
        return KeptOrders(orders, None)

    pairs = len(acting)
    jacobian = flat(series.jacobian(orders=orders)[acting])
    multiples = int(np.ceil(ABOVE * highest / omega / KEPT_TOGETHER))
    high = np.abs(orders) > max(KEPT, multiples * KEPT_TOGETHER)
    if not high.any():
        return KeptOrders(orders, jacobian)

    g = of_pairs(compliance.at(orders[high] * omega), acting)
    rows = np.repeat(high, pairs)
    inner = plus_one(g, jacobian[np.ix_(rows, rows)])
    moved = np.linalg.solve(inner, product_of(g, jacobian[np.ix_(rows, ~rows)]))
    reduced = jacobian[np.ix_(~rows, ~rows)] - jacobian[np.ix_(~rows, rows)] @ moved
    return KeptOrders(orders[~high], reduced)


def highest_in_contact(compliance: Compliance, omega: float, series: ForceSeries, acting: np.ndarray) -> float:
    """Return omega_h in rad/s of a motion at ``omega`` (rad/s) with the forces ``series`` on the pairs ``acting``."""
    samples = 2 * series.slopes.shape[1]
    slopes = np.fft.irfft(series.slopes[acting], samples) * samples
    root = np.sqrt(np.maximum(slopes.max(axis=1), 0.0))

    # Far above all linear frequencies inertia alone counts: G = -B^T M^-1 B/omega^2.
    far = FAR * max(compliance.highest, series.order * omega)
    inverse_masses = -of_pairs(compliance.at(np.array([far])), acting)[0].real * far**2
    by_forces = np.linalg.eigvalsh(root[:, None] * inverse_masses * root)[-1]
    return float(np.sqrt(compliance.highest**2 + max(by_forces, 0.0)))


# Growth rate over Om up to which a motion counts as stable: 0.06 % a period.
LEAST = 1e-4
# The same for a finite system without damping, 1 % a period, as for all normal modes. D has poles at the exponents of
# the linear modes, which lie at Re lambda = -decay Om or below. The line Re lambda = const on which D is followed keeps
# this distance from them.
LEAST_OF_FINITE = LEAST_GROWTH
# Lines on which the fastest growth is looked for first: far from the poles D has few turns and is cheap to follow.
LINES = (0.1, 0.02)
# Intervals of half a strip, 0 <= Im lambda <= Om/2, at first.
COARSE = 24
# Exponents whose compliances are kept: those of the coarse grids on all lines come to 150.
MOST_KEPT = 256
# Halvings, at most, of an interval in which D turns by more than ``TURN``: the finest is 1e-6 Om long.
FINEST = 14
# Largest turn of D in rad from one position to the next: at pi its sense would be ambiguous.
TURN = 0.7
# Largest change of log|D| from one position to the next. Beside an interval with two zeros in its middle it is 2.2.
STEEP = 1.5
# Exponent at which ``stability_changes`` takes D(0): at 0 itself a lattice that is free to move has no compliance.
AT_ZERO = 1e-9
# Steps, first step and accuracy, over Om, of the secant method.
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
        """Return the number of zeros to the right of the line; -1 if it is undecided."""
        turned = -float(self.logs[-1].imag) / np.pi
        # With all orders D is real at both ends, and it has turned by a whole number of half circles. A number that is
        # far from whole, or below 0, says that orders are left out that matter, and NaN that D is not finite or 0 at a
        # position. It cannot say whether a turn was missed: ``_follow_line`` makes sure that none is.
        count = np.round(turned)
        is_whole = abs(turned - count) < 0.25
        if is_whole and count >= 0:
            return int(count)
        return -1


class _Determinants(NamedTuple):
    """D at some exponents: ``values`` (exponents,), and the ``logs`` (block, exponents) of |D| in each block of orders.

    Where |D| of a block is too large, a value has the right phase, and a modulus that is cut off.
    """

    values: np.ndarray
    logs: np.ndarray


class Stability(NamedTuple):
    """Number of perturbations of a motion that grow, -1 if it is undecided, D where a multiplier is real, the fastest.

    ``at_one`` and ``at_minus_one`` are D at Re lambda = ``least`` Om for Im lambda = 0 and Om/2: real, and zero where a
    multiplier has the size exp(2 pi least) and is positive, or negative. ``fastest`` is lambda/Om of what grows
    fastest, Im lambda >= 0; 0 if nothing does, None where it is not known.
    """

    unstable: int
    at_one: float = np.nan
    at_minus_one: float = np.nan
    fastest: complex | None = 0j


def _turns(values: np.ndarray) -> np.ndarray:
    """Return the angles by which D turns between neighbouring ``values``; NaN where it is 0 or not finite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.angle(values[1:] / values[:-1])


def least_growth(finite: bool, decay: float = 0.0) -> float:
    """Return Re lambda/Om up to which a motion of a ``finite`` system is stable, whose modes decay at least so fast."""
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
        """Return D (exponents,) at lambda/Om = ``exponents``; large ones keep their phases. NaN with too few orders."""
        return self._evaluate(series, exponents).values

    def _evaluate(self, series: ForceSeries, exponents: np.ndarray, units: np.ndarray | float = 0.0) -> _Determinants:
        """Return D at lambda/Om = ``exponents``, its values over the exponentials of the ``units`` (block,)."""
        out = np.ones(len(exponents), complex)
        sizes = np.zeros((len(self._blocks), len(exponents)))
        units = np.broadcast_to(units, len(self._blocks))
        # A pair on which no force acts has a row of J that is zero, and leaves the determinant as it is.
        acting = series.acting
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
                out[part] *= phases * np.exp(np.minimum(logs - units[block], LARGEST_LOG))
        return _Determinants(out, sizes)

    def _reduce(self, series: ForceSeries, acting: np.ndarray) -> list[KeptOrders]:
        """Return the orders kept of each block and their J; none at all if perturbations may have higher orders."""
        highest = highest_in_contact(self.compliance, self.omega, series, acting)
        if highest > series.order * self.omega:
            return []
        return [kept_orders(self.compliance, self.omega, series, orders, acting, highest) for orders in self._blocks]

    def _at(self, block: int, orders: np.ndarray, exponents: Sequence[complex]) -> list[np.ndarray]:
        """Return compliances (order, pair, pair) of a block's ``orders`` at ``exponents``: new ones all in one call."""
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
        """Return D on Re lambda = ``growth`` Om; of the latest motion the line of ``least`` is kept."""
        if growth != self.least:
            return self._follow_line(series, growth)
        if self._least_line is None or self._least_line[0] is not series:
            self._least_line = series, self._follow_line(series, growth)
        return self._least_line[1]

    def _follow_line(self, series: ForceSeries, growth: float) -> ContourLine:
        """Return D on Re lambda = ``growth`` Om, so finely that it turns by ``TURN`` at most between positions.

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

    def stability(self, series: ForceSeries) -> Stability:
        """Return how many perturbations grow faster than ``least`` Om, two for a pair; the fastest is not sought."""
        line = self._line(series, self.least)
        return Stability(line.zeros_beyond(), *line.ends)

    def pairs(self, series: ForceSeries) -> list[complex]:
        """Return lambda/Om, Im lambda > 0, of the complex pairs that grow faster than ``least`` Om, the slowest first.

        Empty also where not all of what grows is found.
        """
        zeros = self._beyond(series, self.least) or []
        return sorted((zero for zero in zeros if REAL < zero.imag < 0.5 - REAL), key=lambda zero: zero.real)

    def near(self, series: ForceSeries, guess: complex) -> complex:
        """Return lambda/Om of the complex pair that the secant method finds from a ``guess`` of a motion near by.

        Raises NoMotionError if it goes to none within 1 of the guess.
        """
        zero = self._zero(series, guess, [])
        if zero is None or not REAL < zero.imag < 0.5 - REAL:
            raise NoMotionError("no complex pair of multipliers is found near that of the state before")
        return zero

    def fastest(self, series: ForceSeries) -> complex | None:
        """Return lambda/Om, Im lambda >= 0, of what grows fastest; 0 if nothing does, None if it is not found."""
        for growth in (*(line for line in LINES if line > self.least), self.least):
            zeros = self._beyond(series, growth)
            if zeros:
                return max(zeros, key=lambda mu: mu.real)
        # All that grows lies to the right of the last line, whether the lines before it were decided or not.
        if zeros is None:
            return None
        return 0j

    def _beyond(self, series: ForceSeries, growth: float) -> list[complex] | None:
        """Return lambda/Om of all that grow faster than ``growth`` Om; None if undecided or if not all are found."""
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
        """Return a zero of D that is none of the ``others``, Im in [0, 1/2], by the secant method."""
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
