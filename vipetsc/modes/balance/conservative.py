"""Branches of conservative motions by harmonic balance: their equations, special points, and starts.

*Conservative* means that no force depends on a velocity and that nothing drives the system. A *pair* is a contact or a
smooth spring, contacts first (files of branches call it a place); z (pairs,) are the elongations of all pairs. In a
motion of frequency Om that is at rest at phase 0 each elongation is a sum of cosines,

    z(theta) = sum_k Z_k cos(k theta),    theta = Om t,    k = 0..K,

with real Z_k. K is the *order* of the motion. Motions without an instant of rest, such as travelling waves, are not
among them. Where all forces are odd, symmetric motions alone are sought, z(theta + pi) = -z(theta), which have odd k:
branches of motions that break this symmetry are not found.

**Equations.** The linear part of the system has the compliance G(omega) (pairs, pairs) in m/N: forces f cos(omega t)
that the pairs exert against their elongation give them the elongations -G f cos(omega t). Along z(theta) the pairs
exert against it the force sum_k F_k(Z) cos(k theta) in N (``vipetsc.modes.balance.harmonics``). A motion solves

    Z_k + G_s(k Om) (F_k - s_k Z_k) = 0,    G_s = (1 + s_k G)^-1 G,

which ``vipetsc.modes.balance.harmonic_balance`` derives, with G from masses and stiffnesses. The *shift* s_k in N/m,
one number for each k, is the stiffness of a spring that is added at each pair to the linear part and taken off the
pair's force. Near an eigenfrequency of the linear part G has no bound and F_k vanishes, so that their product cannot
be computed; G_s stays near 1/s_k there. The solutions do not depend on s_k, the residuals do: a ``HarmonicFrame`` keeps
one shift through a step of the continuation. It is

    s_k = +-(k Om)^2 m    (Om^2 m for k = 0),    1/m = (K Om)^2 |trace G(K Om)|/pairs,

where m is the effective mass of a pair, since at high frequencies inertia alone counts, G = -1/(m omega^2). The sign of
s_k is the one with which the smallest singular value of 1 + s_k G(k Om) is larger: with it k Om is farther from the
poles of G_s (``ShiftedCompliance``).

**Unknowns of a step** (``HarmonicFrame``) are numbers of order one, xi = (x/size, Om/omega): x (n,) are the motion's
harmonics in m, and Om is its frequency in rad/s; ``size`` is the largest |x| of the motion at which the frame is,
``omega`` that motion's frequency. A ``Point`` of a branch has its tangent as d(x, period) in m and s instead, of any
length, with period = 2 pi/Om and so dperiod = -(period^2/2 pi) dOm.

**Number of harmonics.** The *truncation* of a motion estimates the harmonics that it leaves out, relative to those that
it has:

    max_i [4/3 sum_{k=K+1..2K} g_i (K/k)^2 |F_ik|] / max_i [sum_{k<=K} |Z_ik|],    g_i = sum_j |G_ij(K Om)|,

for the pairs i. The harmonic k that is left out has the elongations sum_j G_ij F_jk at k Om, where G falls as k^-2 from
its value at K Om. Since G is symmetric, g_i |F_ik| is a bound on the sum of the elongations of all pairs that the force
of the pair i alone causes, and the pair with the largest of these stands for all. The factor 4/3 stands for the
harmonics beyond 2K: where all fall as k^-3, their sum is a third of that from K to 2K. Those of a contact fall as k^-4
(``DECAY``), which would give 8/7. From the truncation at each point the order of the next one is chosen.

**Starts.** A branch begins at a linear mode, or at a frequency in a gap between or beyond the lattice's pass bands. A
motion in a gap, which falls off with the distance from the pairs in contact, is a *breather*. It is found in three
stages.

1. *Each pair alone.* A describing function gives the motion z_p = b_p + a_p cos(Om t) of each pair p that is to have
   contact. With the mean F_p0 and the first harmonic F_p1 of the force along this motion, a_p and b_p solve

       b_p + G_pp(0) F_p0(a_p, b_p) = 0,    a_p + G_pp(Om) F_p1(a_p, b_p) = 0.

   (N. M. Krylov and N. N. Bogoliubov, Introduction to Non-Linear Mechanics, Princeton 1947; ``describing_motion``). The
   first equation gives b_p for every a_p, and a_p is a root above the amplitude at which the pair begins to feel
   its force: for a contact the clearance. If there are several roots, any one of them may be found; for a contact that
   is pressed at rest it is one in the lowest of the brackets that are tried.
2. *All pairs together.* From there Newton's method solves the equations of the mean and the first harmonic, K = 1. A
   solution in which a pair moves with another sign than it is to have is not taken: the third stage then tries from
   the motions of the first.
3. *All harmonics.* Z_k + w G(k Om) F_k = 0 for k > 1, with K = ``FEWEST`` and Om fixed, has the motion of the second
   stage as its solution at w = 0. The weight w grows to 1 in steps in which the motion changes by less than
   ``FURTHEST``. The signs are not looked at again.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from vipetsc.case.nnm import NnmTable
from vipetsc.modes.balance.harmonic_balance import (
    MORE,
    BalanceFrame,
    Compliance,
    HarmonicBalance,
    check_frequency,
    order_needed,
)
from vipetsc.modes.balance.harmonics import Episode, ForceSeries, SiteForces
from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.point import OrbitProblem, Point
from vipetsc.modes.problem import Attempt, ContinuationError, SpecialKind, unit

# An episode centred on an end of the arc counts. Rounding may put its middle outside by up to 1e-9 rad at either end,
# here as a part of the period.
ROUNDING = 1e-9 / (2 * np.pi)


def episodes_in_arc(forces: SiteForces, episodes: Iterable[Episode]) -> int:
    """Return how often contacts close, or open if they are pressed at rest, from phase 0 to where the motion repeats.

    That is half a period for a motion at rest at phase 0, and a quarter if it is symmetric as well: the arcs that
    shooting integrates, with whose counts these are compared. A contact that is pressed at rest and stays closed for
    the whole period, or open, does not count.
    """
    end = 0.5
    if forces.odd:
        end = 0.25
    by_pair: dict[int, list[tuple[float, float]]] = {pair: [] for pair in range(len(forces.contacts))}
    for episode in episodes:
        by_pair[episode.pair].append((episode.onset, episode.onset + episode.length))

    count = 0
    for pair, stops in enumerate(forces.contacts):
        spans = by_pair[pair]
        if stops.is_pressed:
            spans = _between(spans)
        # The middle lies within the arc that is longer by the rounding at both ends, counted from its beginning.
        middles = [(begin + stop) / (4 * np.pi) for begin, stop in spans]
        count += sum((middle + ROUNDING) % 1 < end + 2 * ROUNDING for middle in middles)
    return count


def fraction_closed(series: ForceSeries) -> float:
    """Return the fraction of the period in which one contact or more is closed, as shooting counts it."""
    # The episodes of one contact do not overlap.
    if np.count_nonzero(series.closed) < 2:
        return float(series.closed.max(initial=0.0))

    intervals = []
    for episode in series.episodes:
        begin = episode.onset
        if begin < 0:
            # An episode that contains phase 0 begins before it, at the end of the period.
            intervals.append((begin + 2 * np.pi, 2 * np.pi))
        intervals.append((max(begin, 0.0), episode.onset + episode.length))
    # Sorted by ends and by beginnings apart, the gaps between neighbours are those of the union.
    times = np.sort(np.array(intervals), axis=0)
    gaps = np.maximum(times[1:, 0] - times[:-1, 1], 0.0).sum()
    return float(times[-1, 1] - times[0, 0] - gaps) / (2 * np.pi)


def folds(forces: SiteForces, left: Point, right: Point) -> Iterator[SpecialKind[Point]]:
    """Yield folds of the energy and of the frequency between two motions under ``forces`` that are not linear."""
    # Linear motions have one frequency at all energies: the test of a fold of the frequency would be rounding. A step
    # into contact or out of it has a linear motion at one end; folds are then not sought, as in shooting.
    if not forces.is_linear_at_rest or (left.episodes and right.episodes):
        yield SpecialKind("fold-energy", lambda p: p.energy_tangent)
        yield SpecialKind("fold-frequency", lambda p: float(p.tangent[-1] / p.period))


def _between(spans: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the intervals of phase between ``spans``, which are sorted and do not overlap.

    The last interval ends where the first span begins, one turn later.
    """
    after = [*spans[1:], *((begin + 2 * np.pi, stop) for begin, stop in spans[:1])]
    gaps = [(stop, begin) for (_, stop), (begin, _) in zip(spans, after, strict=True)]
    return [(begin, stop) for begin, stop in gaps if stop > begin]


# Amplitudes are sought up to this multiple of ``SiteForces.amplitude_scale``, the clearance of a contact, and means up
# to this multiple of the amplitude. By Hertz's law amplitudes grow without bound as the compliance goes to 0.
LARGEST = 1e3
# A mean below this fraction of the amplitude is rounding, and taken to be 0.
LEAST_MEAN = 1e-14
# The force of a contact that is pressed at rest softens as it opens and hardens beyond, so that its balance may change
# sign twice. It is evaluated at TRIED_OF_PRESSED amplitudes from this multiple of the depth to ``LARGEST``.
LEAST_OF_PRESSED = 1e-2
TRIED_OF_PRESSED = 41


class PairCompliance(NamedTuple):
    """Compliance in m/N of one pair: ``static``, which the mean of a force meets, and ``dynamic``, at a frequency."""

    static: float
    dynamic: float


class DescribedMotion(NamedTuple):
    """A motion ``mean`` + ``amplitude`` cos(theta) of one pair, in m."""

    mean: float
    amplitude: float


def describing_motion(forces: SiteForces, pair: int, g: PairCompliance, omega: float) -> DescribedMotion:
    """Return the motion z = b + a cos(Om t) of a ``pair`` with one of the ``forces``, of which two harmonics balance.

    ``pair`` is its number, ``g`` are the compliances of the pair at 0 and at ``omega`` (rad/s). The equations are those
    of the module. Raises ContinuationError where they have no solution.
    """
    spring = pair - len(forces.contacts)
    if spring >= 0 and forces.springs[spring].cubic == 0:
        raise ContinuationError(
            f"no breather starts at {omega:g} rad/s on a spring without a cubic part: of a harmonic motion its "
            "quadratic force has a mean and a second harmonic alone; give it a cubic part, or begin at another place"
        )
    is_pressed = pair < len(forces.contacts) and forces.contacts[pair].is_pressed
    z = np.zeros((forces.pairs, 2), complex)

    def force(mean: float, amplitude: float) -> np.ndarray:
        """Return F_0, F_1 and F_2 in N: the motion is even in time, so that they are real."""
        z[pair] = mean, amplitude
        return forces.series(z, omega).forces[pair].real

    def mean_of(amplitude: float) -> float:
        """Return the mean b in m for an amplitude a in m."""

        def static_balance(mean: float) -> float:
            return mean + g.static * float(force(mean, amplitude)[0])

        without = static_balance(0.0)
        if forces.odd or abs(without) <= LEAST_MEAN * amplitude:
            return 0.0
        # A force that grows with the elongation opposes the mean: b lies between 0 and -G(0) F_0(a, 0), the mean that
        # the force at b = 0 would cause. The force of a contact that is pressed at rest softens: its mean may be
        # larger.
        furthest = -without
        while is_pressed and static_balance(furthest) * without > 0 and abs(furthest) < LARGEST * amplitude:
            furthest *= 2
        if static_balance(furthest) * without >= 0:
            # No mean within the bound balances the force. 0 is then a guess: the balance of all harmonics decides.
            return 0.0
        return float(brentq(static_balance, furthest, 0.0))

    def balance(amplitude: float) -> float:
        """Return a + G(Om) F_1 in m."""
        return amplitude + g.dynamic * float(force(mean_of(amplitude), amplitude)[1])

    size = forces.amplitude_scale(pair, g.dynamic)
    sizes = [size, LARGEST * size]
    if is_pressed:
        sizes = (size * np.geomspace(LEAST_OF_PRESSED, LARGEST, TRIED_OF_PRESSED)).tolist()
    for low, high in itertools.pairwise(sizes):
        if balance(low) * balance(high) < 0:
            amplitude = float(brentq(balance, low, high, rtol=1e-12))
            return DescribedMotion(mean=mean_of(amplitude), amplitude=amplitude)

    needs = "a force that hardens needs a negative one of moderate size"
    if is_pressed:
        needs = "the force of a contact that is pressed at rest balances it at no amplitude"
    raise ContinuationError(
        f"no breather starts at {omega:g} rad/s: the compliance of its site is {g.dynamic:.4g} m/N there, and "
        f"{needs}; change nnm.start_frequency"
    )


class HarmonicFrame(BalanceFrame):
    """Unknowns ``xi`` (n + 1,) at and near the motion with the harmonics ``x`` (n,) in m and ``omega`` in rad/s.

    ``size`` in m is the unit of the harmonics. The ``tangent`` is set after construction, where the motion has one.
    """

    def __init__(
        self, balance: HarmonicBalance, newton: DenseNewton, tolerance: float, x: np.ndarray, omega: float, size: float
    ) -> None:
        self.balance = balance
        self.newton = newton
        self.tolerance = tolerance
        self.shift = balance.shift(omega)
        self.size = size
        self.omega = omega
        self.xi = np.append(x / size, 1.0)

    def motion(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Return harmonics (n,) in m and frequency in rad/s at the unknowns ``xi`` (n + 1,)."""
        return xi[:-1] * self.size, float(xi[-1] * self.omega)

    def encode(self, point: Point) -> np.ndarray:
        """Return the unknowns (n + 1,) of another motion, which may have another number of harmonics."""
        x = self.balance.resized(point.x)
        return np.append(x / self.size, 2 * np.pi / point.period / self.omega)

    def direction(self, point: Point) -> np.ndarray:
        """Return the branch's direction (n + 1,) at another motion, of any length."""
        # dOm = -2 pi/period^2 dperiod.
        harmonics = self.balance.resized(point.tangent[:-1]) / self.size
        return np.append(harmonics, -2 * np.pi / point.period**2 * point.tangent[-1] / self.omega)

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """Return the residual (n,) at the unknowns ``xi`` (n + 1,) over the size; FlowError at another frequency."""
        check_frequency(xi)
        return self.balance.residual(*self.motion(xi), self.shift) / self.size

    def jacobian(self, xi: np.ndarray) -> np.ndarray:
        """Return the derivative (n, n + 1) of the residual."""
        x, omega = self.motion(xi)
        jacobian = self.balance.jacobian(x, omega, self.shift)
        by_omega = self.balance.rate(x, omega, self.shift)
        return np.column_stack([jacobian, by_omega * (self.omega / self.size)])

    def measures(self, attempt: Attempt, direction: np.ndarray | None = None) -> Point:
        """Return the point of the branch that an attempt has converged to.

        ``direction`` (n + 1,) is the branch's unit tangent there; without one, None, the point has no slope. Its
        ``energy_tangent`` is dE in J for a unit step along the tangent in this frame's unknowns: from frame to frame
        only the sign can be compared.
        """
        balance = self.balance
        xi = attempt.xi
        x, omega = self.motion(xi)
        period = 2 * np.pi / omega
        series = balance.series(x, omega)

        tangent = np.empty(0)
        energy_tangent = slope = np.nan
        if direction is not None:
            energy_tangent = balance.energy_change(
                x, omega, self.shift, along=direction[:-1] * self.size, by_omega=direction[-1] * self.omega
            )
            by_frequency = direction[-1] * self.omega / (2 * np.pi)
            # The slope is df/dE in Hz/J: infinite at a fold of the energy.
            slope = np.inf
            if energy_tangent:
                slope = by_frequency / energy_tangent
            tangent = np.append(direction[:-1] * self.size, -direction[-1] * self.omega / (2 * np.pi) * period**2)

        return Point(
            x=x,
            period=period,
            energy=balance.energy(x, omega, self.shift),
            residual=float(np.abs(balance.residual(x, omega, self.shift)).max() / self.size),
            episodes=episodes_in_arc(balance.forces, series.episodes),
            closed=fraction_closed(series),
            # The history has the residual of the guess, too; that of a guess which is not corrected is empty.
            newton=max(len(attempt.history) - 1, 0),
            order=balance.order,
            truncation=balance.truncation(x, omega),
            # At phase 0 all cosines are 1.
            elongations=balance.unpack(x).real.sum(axis=1),
            tangent=tangent,
            energy_tangent=energy_tangent,
            slope=slope,
        )


# Order of the motions with which a branch begins. No point of a branch has a lower one: a case with ``nnm.harmonics``
# below it is refused. With 7 to 63 two breathers of the built-in lattice are the same and take the same CPU time.
FEWEST = 15
# A motion smaller than this fraction of the guess is the state of rest, which solves the equations at every frequency.
AT_REST = 1e-6
# A guess whose residual is below this fraction of its size solves the equations of the mean and the first harmonic.
BALANCED = 1e-6
# As the harmonics above the first are brought in: first step of their weight; how far the motion may change in one
# step, over the largest harmonic of the first guess; factors of the step after success and failure; the smallest step.
# Small changes are the safer: a motion that changes much may be another one.
FIRST_WEIGHT = 0.1
FURTHEST = 0.1
LONGER = 1.6
SHORTER = 0.4
SMALLEST_WEIGHT = 1e-4


class ConservativeMotions(OrbitProblem):
    """Branches of conservative motions of ``forces`` at pairs whose ``compliance`` is given, as a ``PeriodicProblem``.

    ``control`` is the table [nnm] of a case: harmonics are taken up to the order ``nnm.harmonics`` at most, and as many
    as the relative ``nnm.truncation`` needs.
    """

    # What is guarded from point to point, besides the changes that all problems have in common, is the truncation: at
    # the highest order the harmonics left out may become too large.
    guards = frozenset({"truncation"})

    def __init__(self, compliance: Compliance, forces: SiteForces, control: NnmTable) -> None:
        self.compliance = compliance
        self.forces = forces
        self.control = control
        self.tolerance = control.tolerance
        # Equations and solvers by the order of the highest harmonic: a branch comes back to the same few.
        self._balances: dict[int, HarmonicBalance] = {}
        self._newtons: dict[int, DenseNewton] = {}

    def balance(self, order: int) -> HarmonicBalance:
        """Return the equations of motions with harmonics up to ``order``."""
        if order not in self._balances:
            self._balances[order] = HarmonicBalance(
                self.compliance, self.forces, order=order, odd=self.forces.odd, cosines=True
            )
        return self._balances[order]

    def newton(self, balance: HarmonicBalance) -> DenseNewton:
        """Return Newton's method for equations of that size."""
        if balance.size not in self._newtons:
            self._newtons[balance.size] = DenseNewton(balance.size + 1, self.control.max_newton)
        return self._newtons[balance.size]

    def acceleration(self, point: Point) -> float:
        """Return the largest acceleration where a motion rests, over that of a harmonic motion of the same size.

        A motion rests at the phases 0 and pi, of which the smaller value counts.
        """
        harmonics = self.balance(point.order).unpack(point.x).real
        orders = np.arange(point.order + 1)
        at_zero = np.abs(harmonics @ orders**2).max()
        at_pi = np.abs(harmonics @ (orders**2 * (-1.0) ** orders)).max()
        return float(min(at_zero, at_pi) / np.abs(harmonics).sum(axis=1).max())

    @property
    def highest_order(self) -> int:
        """The highest order that is taken: ``nnm.harmonics``, or the odd number below it."""
        return (self.control.harmonics - 1) // 2 * 2 + 1

    def order_near(self, point: Point) -> int:
        """Return the order of the highest harmonic for motions near ``point``."""
        balance = self.balance(point.order)
        order = order_needed(balance, point.x, point.truncation, self.control.truncation, FEWEST)
        return min(order, self.highest_order)

    def frame(self, point: Point, chart: str = "auto") -> HarmonicFrame:
        """Return the frame at a motion, with the harmonics that motions near it need.

        There is one chart: the name of a ``chart``, which other problems need, is not looked at.
        """
        balance = self.balance(self.order_near(point))
        x = balance.resized(point.x)
        frame = self._frame_at(balance, x, 2 * np.pi / point.period, float(np.abs(x).max()))
        if point.tangent.size:
            frame.tangent = unit(frame.direction(point))
            if balance.order != point.order:
                frame.correct_here()
        return frame

    def _frame_at(self, balance: HarmonicBalance, x: np.ndarray, omega: float, size: float) -> HarmonicFrame:
        """Return frame of the equations ``balance`` at harmonics ``x`` (n,) in m, which are scaled by ``size`` in m."""
        return HarmonicFrame(balance, self.newton(balance), self.tolerance, x, omega, size)

    def first_tangent(self, start: Point, direction: int) -> np.ndarray:
        """Return the tangent d(x, period) at a corrected motion, towards growing (+1) or falling (-1) energy."""
        frame = self.frame(start)
        # The frame may have other harmonics than the start, which then solves its equations up to the truncation. That
        # is exact enough for a tangent, which predicts the first step and gets corrected.
        _, _, right_vectors = np.linalg.svd(frame.jacobian(frame.xi))
        null_vector = right_vectors[-1]
        point = frame.measures(_solution(frame.xi), null_vector)
        # Where the energy is stationary neither sign is towards growing energy: the null vector is taken as it is.
        sign = np.sign(point.energy_tangent) or 1.0
        harmonics = self.balance(start.order).resized(point.tangent[:-1])
        return np.append(harmonics, point.tangent[-1]) * (sign * direction)

    def special_kinds(self, left: Point, right: Point) -> Iterator[SpecialKind[Point]]:
        """Yield folds of the energy and of the frequency, between two motions that are not linear."""
        return folds(self.forces, left, right)

    def refined(self, point: Point, keep_frequency: bool) -> Point:
        """Return motion of the frequency, or else of the amplitude, of ``point``, with as many harmonics as are needed.

        If the order ``nnm.harmonics`` is not enough, it has all of these. Raises ContinuationError where Newton's
        method fails or ends at the state of rest.
        """
        while True:
            order = point.order
            frame = self.frame(point)
            x = frame.balance.resized(point.x)
            row = unit(np.append(x, 0.0))
            if keep_frequency:
                row = _frequency_row(frame)
            attempt = frame.solve(frame.xi, row, row @ frame.xi)
            if not attempt.converged:
                why = f"{attempt.reason}; residuals {attempt.residuals}"
                raise ContinuationError(f"no motion at f = {point.frequency:.9g} Hz ({why}): choose another start")
            if _is_at_rest(attempt):
                raise ContinuationError(
                    f"no motion at f = {point.frequency:.9g} Hz (Newton's method ends at the state of rest): choose "
                    "another start"
                )
            point = frame.measures(attempt)
            if point.truncation <= MORE * self.control.truncation:
                return point
            # A guess may need fewer harmonics than the motion: that the order has not changed is not enough.
            if point.order == order == self.highest_order:
                return point

    def from_mode(self, z: np.ndarray, omega: float) -> Point:
        """Return motion near a linear mode of frequency ``omega`` (rad/s) with the elongations ``z`` (pairs,) in m."""
        return self.refined(self._guess(self.one_harmonic(z), omega), keep_frequency=False)

    def in_gap(self, omega: float, signs: np.ndarray) -> Point:
        """Return motion of ``omega`` (rad/s) in a gap, with contact at the pairs whose ``signs`` (pairs,) are +1 or -1.

        A pair of the sign -1 moves half a period later than one of +1: its cosine has the other sign, its mean the
        same. Raises ContinuationError where a pair has no motion with one harmonic, or where no motion is reached by
        bringing in the others; ValueError if all ``signs`` are 0.
        """
        if not np.any(signs):
            raise ValueError("signs are 0 for all pairs: a motion in a gap needs contact at one pair at least")
        x = self._pairs_together(self._pairs_alone(omega, signs), omega, signs)
        x = self._bring_in_harmonics(x, omega)
        return self.refined(self._guess(x, omega), keep_frequency=True)

    def _pairs_alone(self, omega: float, signs: np.ndarray) -> np.ndarray:
        """Return the first stage: unknowns (n,) of a mean and one harmonic, by each pair's describing function."""
        # A harmonic motion of forces that are odd has no mean, and the static compliance need not be there.
        static_at = 0.0
        if self.forces.odd:
            static_at = omega
        static, dynamic = self.compliance.at(np.array([static_at, omega]))
        z = np.zeros(len(signs))
        mean = np.zeros(len(signs))
        for pair in np.nonzero(signs)[0].tolist():
            g = PairCompliance(static=float(static[pair, pair]), dynamic=float(dynamic[pair, pair]))
            described = describing_motion(self.forces, pair, g, omega)
            mean[pair] = described.mean
            z[pair] = signs[pair] * described.amplitude
            # The force at this pair p moves a pair j without a force of its own by z_j = G_jp/G_pp z_p. What it adds to
            # the motion of the other pairs with contact, and to all means, is left to the second stage.
            z += np.where(signs == 0, dynamic[:, pair] / g.dynamic * z[pair], 0.0)
        return self.one_harmonic(z, mean)

    def _pairs_together(self, x: np.ndarray, omega: float, signs: np.ndarray) -> np.ndarray:
        """Return the second stage: the unknowns ``x`` (n,) corrected to the solution with a mean and one harmonic.

        They are returned as they are where they solve the equations, or where Newton's method finds no motion with the
        ``signs`` (pairs,): the third stage then tries from them.
        """
        balance = self.balance(1)
        first = balance.resized(x)
        frame = self._frame_at(balance, first, omega, float(np.abs(first).max()))
        if np.abs(frame.residual(frame.xi)).max() < BALANCED:
            return x
        attempt = frame.solve(frame.xi, _frequency_row(frame), 1.0)
        corrected, _ = frame.motion(attempt.xi)
        keeps_signs = np.all(signs * balance.unpack(corrected)[:, 1].real >= 0)
        if attempt.converged and keeps_signs and not _is_at_rest(attempt):
            return self.balance(FEWEST).resized(corrected)
        return x

    def _bring_in_harmonics(self, x: np.ndarray, omega: float) -> np.ndarray:
        """Return the third stage: the solution (n,) with ``FEWEST`` harmonics, from ``x`` with a mean and one harmonic.

        Raises ContinuationError where Newton's method fails, or the motion changes too much, however small the step.
        """
        size = float(np.abs(x).max())
        weight = 0.0
        step = FIRST_WEIGHT
        # The solution changes smoothly with the weight. With all harmonics at once Newton's method would diverge.
        while weight < 1:
            tried = min(weight + step, 1.0)
            # The weight multiplies G itself, and the shift is chosen for the product.
            frame = self._frame_at(self.balance(FEWEST).weighted(tried), x, omega, size)
            attempt = frame.solve(frame.xi, _frequency_row(frame), 1.0)
            # Over ``size``, as the unknowns are.
            moved = np.linalg.norm(attempt.xi[:-1] - x / size)
            if attempt.converged and moved < FURTHEST:
                x, _ = frame.motion(attempt.xi)
                weight = tried
                step = LONGER * step
                continue

            # The step that failed is shorter than ``step`` if it was cut at the weight 1.
            step = SHORTER * min(step, 1.0 - weight)
            if step < SMALLEST_WEIGHT:
                why = f"Newton's method ends ({attempt.reason}); change nnm.start_frequency or raise nnm.max_newton"
                if attempt.converged:
                    why = f"the motion changes by more than {FURTHEST:g} of its size; change nnm.start_frequency"
                raise ContinuationError(
                    f"no breather at {omega:g} rad/s: with {weight:.3g} of the harmonics above the first, {why}"
                )
        return x

    def one_harmonic(self, z: np.ndarray, mean: np.ndarray | float = 0.0) -> np.ndarray:
        """Return unknowns with the fewest harmonics of a motion ``mean`` + z cos(theta), ``z`` (pairs,) in m."""
        balance = self.balance(FEWEST)
        harmonics = z[:, None] * (np.arange(balance.order + 1) == 1)
        harmonics[:, 0] = mean
        return balance.pack(harmonics)

    def _guess(self, x: np.ndarray, omega: float) -> Point:
        """Return a point to be corrected, of unknowns with the fewest harmonics."""
        frame = self._frame_at(self.balance(FEWEST), x, omega, size=1.0)
        return frame.measures(_solution(frame.xi))


def _solution(xi: np.ndarray) -> Attempt:
    """Return unknowns ``xi`` as if Newton's method had found them, for ``HarmonicFrame.measures``."""
    return Attempt(converged=True, reason="", history=[], xi=xi)


def _is_at_rest(attempt: Attempt) -> bool:
    """Return whether Newton's method, from a motion whose largest harmonic is 1 in its unknowns, has ended at rest."""
    return bool(np.abs(attempt.xi[:-1]).max() < AT_REST)


def _frequency_row(frame: HarmonicFrame) -> np.ndarray:
    """Return the row (n + 1,) whose product with the unknowns is the frequency, over that of the ``frame``."""
    return np.append(np.zeros(len(frame.xi) - 1), 1.0)
