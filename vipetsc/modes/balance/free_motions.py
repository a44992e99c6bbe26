"""Free motions by harmonic balance: what conservative motions and damped modes have in common.

Nothing drives a free motion, so that its frequency Om is unknown. With the harmonics x (n,) of the motion, in m, of
damped modes with the damping ratio before them, n equations R(x, Om) = 0 leave a curve of solutions. ``FreeMotions``
follows it in the unknowns of a ``FreeFrame``, xi = (x/size, Om/omega), of order one: ``size`` is the largest harmonic
of the motion at which the frame is, ``omega`` that motion's frequency. A ``Point`` of a branch has its tangent as
d(x, period) instead, of any length, with period = 2 pi/Om and so dperiod = -(period^2/2 pi) dOm.
"""

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from typing import Generic, TypeVar

import numpy as np

from vipetsc.case.nnm import NnmTable
from vipetsc.lattice import Contact
from vipetsc.modes.balance.damped import DampedBalance
from vipetsc.modes.balance.harmonic_balance import MORE, BalanceFrame, HarmonicBalance, check_frequency, order_needed
from vipetsc.modes.balance.harmonics import Episode, ForceSeries, SiteForces
from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.point import OrbitProblem, Point
from vipetsc.modes.problem import Attempt, ContinuationError, SpecialKind, unit
from vipetsc.modes.system import System

E = TypeVar("E", HarmonicBalance, DampedBalance)

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


def _between(spans: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the intervals of phase between ``spans``, which are sorted and do not overlap.

    The last interval ends where the first span begins, one turn later.
    """
    after = [*spans[1:], *((begin + 2 * np.pi, stop) for begin, stop in spans[:1])]
    gaps = [(stop, begin) for (_, stop), (begin, _) in zip(spans, after, strict=True)]
    return [(begin, stop) for begin, stop in gaps if stop > begin]


class FreeFrame(BalanceFrame):
    """Unknowns ``xi`` (n + 1,) at and near the motion with the unknowns ``x`` (n,) and ``omega`` in rad/s.

    ``size`` in m is the unit of the harmonics. The ``tangent`` is set after construction, where the motion has one.
    """

    def __init__(
        self,
        equations: HarmonicBalance | DampedBalance,
        newton: DenseNewton,
        tolerance: float,
        x: np.ndarray,
        omega: float,
        size: float,
    ) -> None:
        self.equations = equations
        self.newton = newton
        self.tolerance = tolerance
        self.shift = equations.shift(omega)
        self.size = size
        self.scales = np.append(np.full(len(x), size), omega)
        # A damping ratio is a number already.
        self.scales[: -1 - equations.size] = 1.0
        self.xi = np.append(x, omega) / self.scales

    def motion(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the motion's unknowns (n,) and frequency in rad/s at the unknowns ``xi`` (n + 1,)."""
        of_motion = xi * self.scales
        return of_motion[:-1], float(of_motion[-1])

    def encode(self, point: Point) -> np.ndarray:
        """Return the unknowns (n + 1,) of another motion, which may have another number of harmonics."""
        return np.append(self.equations.resized(point.x), 2 * np.pi / point.period) / self.scales

    def direction(self, point: Point) -> np.ndarray:
        """Return the branch's direction (n + 1,) at another motion, of any length."""
        # dOm = -2 pi/period^2 dperiod.
        by_frequency = -2 * np.pi / point.period**2 * point.tangent[-1]
        return np.append(self.equations.resized(point.tangent[:-1]), by_frequency) / self.scales

    @property
    def along_frequency(self) -> np.ndarray:
        """The row (n + 1,) whose product with the unknowns is the frequency, over that of the frame."""
        return np.append(np.zeros(len(self.xi) - 1), 1.0)

    @property
    def along_motion(self) -> np.ndarray:
        """The row (n + 1,) whose product with the unknowns is the amplitude of the frame's motion."""
        row = np.zeros(len(self.xi))
        row[-1 - self.equations.size : -1] = self.xi[-1 - self.equations.size : -1]
        return unit(row)

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """Return the residual (n,) at the unknowns ``xi`` (n + 1,) over the size; FlowError at another frequency."""
        check_frequency(xi)
        return self.equations.residual(*self.motion(xi), self.shift) / self.size

    def jacobian(self, xi: np.ndarray) -> np.ndarray:
        """Return the derivative (n, n + 1) of the residual."""
        x, omega = self.motion(xi)
        by_x = self.equations.jacobian(x, omega, self.shift)
        by_omega = self.equations.rate(x, omega, self.shift)
        return np.column_stack([by_x, by_omega]) * (self.scales / self.size)

    def measures(self, attempt: Attempt, direction: np.ndarray | None = None) -> Point:
        """Return the point of the branch that an attempt has converged to.

        ``direction`` (n + 1,) is the branch's unit tangent there; without one, None, the point has no slope. Its
        ``energy_tangent`` is dE in J for a unit step along the tangent in this frame's unknowns: from frame to frame
        only the sign can be compared.
        """
        equations = self.equations
        x, omega = self.motion(attempt.xi)
        period = 2 * np.pi / omega
        series = equations.series(x, omega)

        tangent = np.empty(0)
        energy_tangent = slope = np.nan
        if direction is not None:
            along, by_omega = self.motion(direction)
            energy_tangent = equations.energy_change(x, omega, self.shift, along, by_omega)
            by_frequency = by_omega / (2 * np.pi)
            # The slope is df/dE in Hz/J: infinite at a fold of the energy.
            slope = np.inf
            if energy_tangent:
                slope = by_frequency / energy_tangent
            tangent = np.append(along, -by_frequency * period**2)

        return Point(
            x=x,
            period=period,
            energy=equations.energy(x, omega, self.shift),
            residual=float(np.abs(self.residual(attempt.xi)).max()),
            episodes=episodes_in_arc(equations.forces, series.episodes),
            closed=fraction_closed(series),
            # The history has the residual of the guess, too; that of a guess which is not corrected is empty.
            newton=max(len(attempt.history) - 1, 0),
            order=equations.order,
            truncation=equations.truncation(x, omega),
            # At phase 0 all cosines are 1.
            elongations=equations.elongations(x).real.sum(axis=1),
            tangent=tangent,
            energy_tangent=energy_tangent,
            slope=slope,
        )


# Order of the motions with which a branch begins. No point of a branch has a lower one: a case with ``nnm.harmonics``
# below it is refused. With 7 to 63 two breathers of the built-in lattice are the same and take the same CPU time.
FEWEST = 15
# A motion smaller than this fraction of the guess is the state of rest, which solves the equations at every frequency.
AT_REST = 1e-6


class FreeMotions(OrbitProblem, Generic[E]):
    """Branches of free motions under ``forces``, as a ``PeriodicProblem``; a subclass gives the ``new_equations``.

    ``control`` is the table [nnm] of a case: harmonics are taken up to the order ``nnm.harmonics`` at most, and as many
    as the relative ``nnm.truncation`` needs.
    """

    def __init__(self, forces: SiteForces, control: NnmTable) -> None:
        self.forces = forces
        self.control = control
        self.tolerance = control.tolerance
        # Equations and solvers by the order of the highest harmonic: a branch comes back to the same few.
        self._equations: dict[int, E] = {}
        self._newtons: dict[int, DenseNewton] = {}

    @abstractmethod
    def new_equations(self, order: int) -> E:
        """Return the equations of motions with harmonics up to ``order``."""

    def acceleration(self, point: Point) -> float:
        """Return the largest acceleration where a motion rests, over that of a harmonic motion of the same size.

        A motion rests at the phases 0 and pi, of which the smaller value counts. With dashpots its masses rest a little
        apart; near an equilibrium all of them still hardly accelerate there.
        """
        harmonics = self.balance(point.order).unpack(point.x).real
        orders = np.arange(point.order + 1)
        at_zero = np.abs(harmonics @ orders**2).max()
        at_pi = np.abs(harmonics @ (orders**2 * (-1.0) ** orders)).max()
        return float(min(at_zero, at_pi) / np.abs(harmonics).sum(axis=1).max())

    def balance(self, order: int) -> E:
        """Return the equations of motions with harmonics up to ``order``, made once."""
        if order not in self._equations:
            self._equations[order] = self.new_equations(order)
        return self._equations[order]

    @property
    def highest_order(self) -> int:
        """The highest order that is taken: ``nnm.harmonics``, or the odd number below it."""
        return (self.control.harmonics - 1) // 2 * 2 + 1

    def order_near(self, point: Point) -> int:
        """Return the order of the highest harmonic for motions near ``point``."""
        equations = self.balance(point.order)
        order = order_needed(equations, point.x, point.truncation, self.control.truncation, FEWEST)
        return min(order, self.highest_order)

    def frame(self, point: Point, chart: str = "auto") -> FreeFrame:
        """Return the frame at a motion, with the harmonics that motions near it need.

        There is one chart: the name of a ``chart``, which other problems need, is not looked at.
        """
        equations = self.balance(self.order_near(point))
        x = equations.resized(point.x)
        frame = self.frame_at(equations, x, 2 * np.pi / point.period, float(np.abs(x[-equations.size :]).max()))
        if point.tangent.size:
            frame.tangent = unit(frame.direction(point))
            if equations.order != point.order:
                frame.correct_here()
        return frame

    def frame_at(self, equations: E, x: np.ndarray, omega: float, size: float) -> FreeFrame:
        """Return frame of ``equations`` at the unknowns ``x`` (n,), whose harmonics are scaled by ``size`` in m."""
        if len(x) not in self._newtons:
            self._newtons[len(x)] = DenseNewton(len(x) + 1, self.control.max_newton)
        return FreeFrame(equations, self._newtons[len(x)], self.tolerance, x, omega, size)

    def first_tangent(self, start: Point, direction: int) -> np.ndarray:
        """Return the tangent d(x, period) at a corrected motion, towards growing (+1) or falling (-1) energy."""
        frame = self.frame(start)
        # The frame may have other harmonics than the start, which then solves its equations up to the truncation. That
        # is exact enough for a tangent, which predicts the first step and gets corrected.
        null_vector = np.linalg.svd(frame.jacobian(frame.xi))[2][-1]
        point = frame.measures(solution(frame.xi), null_vector)
        # Where the energy is stationary neither sign is towards growing energy: the null vector is taken as it is.
        sign = np.sign(point.energy_tangent) or 1.0
        harmonics = self.balance(start.order).resized(point.tangent[:-1])
        return np.append(harmonics, point.tangent[-1]) * (sign * direction)

    def special_kinds(self, left: Point, right: Point) -> Iterator[SpecialKind[Point]]:
        """Yield folds of the energy and of the frequency, between two motions that are not linear."""
        # Linear motions have one frequency at all energies: the test of a fold of the frequency would be rounding. A
        # step into contact or out of it has a linear motion at one end; folds are then not sought, as in shooting.
        if not self.forces.is_linear_at_rest or (left.episodes and right.episodes):
            yield SpecialKind("fold-energy", lambda p: p.energy_tangent)
            yield SpecialKind("fold-frequency", lambda p: float(p.tangent[-1] / p.period))

    def guess(self, x: np.ndarray, omega: float) -> Point:
        """Return a point to be corrected, of unknowns with the fewest harmonics."""
        frame = self.frame_at(self.balance(FEWEST), x, omega, size=1.0)
        return frame.measures(solution(frame.xi))

    def refined(self, point: Point, keep_frequency: bool = False) -> Point:
        """Return motion of the frequency, or else of the amplitude, of ``point``, with as many harmonics as are needed.

        If the order ``nnm.harmonics`` is not enough, it has all of these. Raises ContinuationError where Newton's
        method fails or ends at the state of rest.
        """
        while True:
            order = point.order
            frame = self.frame(point)
            row = frame.along_motion
            if keep_frequency:
                row = frame.along_frequency
            attempt = frame.solve(frame.xi, row, row @ frame.xi)
            why = f"{attempt.reason}; residuals {attempt.residuals}"
            if attempt.converged and is_at_rest(attempt):
                why = "Newton's method ends at the state of rest"
            elif attempt.converged:
                point = frame.measures(attempt)
                # A guess may need fewer harmonics than the motion: that the order has not changed is not enough.
                has_all = point.order == order == self.highest_order
                if has_all or point.truncation <= MORE * self.control.truncation:
                    return point
                continue
            raise ContinuationError(f"no motion at f = {point.frequency:.9g} Hz ({why}): choose another start")


def forces_of_system(system: System, laws: Sequence[Contact] | None = None) -> SiteForces:
    """Return the forces of contacts and nonlinear springs of a ``system``; ``laws`` may take the place of its own.

    A contact that is pressed at rest is a spring of the linear system: without it a chain of grains would have no
    stiffness.
    """
    stops = [pair.stops._replace(spring=pair.stops.slope_at_rest) for pair in system.contacts]
    if laws is not None:
        stops = [of_pair._replace(law=law) for of_pair, law in zip(stops, laws, strict=True)]
    return SiteForces(stops, [spring.law for spring in system.springs])


def solution(xi: np.ndarray) -> Attempt:
    """Return unknowns ``xi`` as if Newton's method had found them, for ``FreeFrame.measures``."""
    return Attempt(converged=True, reason="", history=[], xi=xi)


def is_at_rest(attempt: Attempt) -> bool:
    """Return whether Newton's method, from a motion whose largest harmonic is 1 in its unknowns, has ended at rest."""
    return bool(np.abs(attempt.xi[:-1]).max() < AT_REST)
