"""Charts: unknowns xi (n + 1,) of order one in place of the initial values x (n,) and the period T of an orbit.

A chart belongs to a point of the branch, with the initial values x_0 and the period T_0. It encodes (x, T) as xi,
decodes it, and gives d(x, T)/dxi (n + 1, n + 1); ``size`` = max |x_0| is the unit of initial values. Initial values are
displacements in m where an arc starts at rest, velocities in m/s where it starts at the centre. The last unknown is
T/T_0, the others are

    relative       x_i/size; in the place of a site's resonator w/scale, with w = c . x, where the arc starts at rest
    grazing        x_i/size; in the place of one site's resonator y, where y |y| = (sigma w - D)/D

w is the elongation of a contact, c its row with 1 at the resonator and -1 at the other mass, if there is one, and D its
clearance in m on the side sigma. D is not 0: ``System`` refuses contacts that touch at rest, about which no motion is
linear.

**Why grazing needs a chart.** An orbit that starts at rest on its largest sigma w, beyond D, is in contact for the time
2 [2 (sigma w - D)/|w''|]^1/2. The impulse of a force that grows as (sigma w - D)^n then changes the orbit by the order
(sigma w - D)^(n + 1/2). For the bilinear contact, n = 1, its derivative by w is a square root, whose slope at D is
infinite: tangents turn without bound there. In y the change is of the order y^(2 n + 1), and smooth enough.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence

import numpy as np

from vipetsc.modes.system import ContactPair, System

# The chart ``grazing`` is chosen if |w| at the start is within this fraction of the clearance of it. The paper's
# out-of-phase branches up to 100 J (116 points with Hertz's law, 141 with the bilinear one) take up to 12 % more Newton
# steps with values from 0.01 to 0.2.
NEAR_GRAZING = 0.05
# Lower bound of |y| in the derivative of w by y, 2 D |y|, which vanishes at the touch itself. The smallest gap beside 0
# is a rounding error of 1e-16 of D, with a y of 1e-8: the bound acts at the touch alone.
SMALLEST_ROOT = 1e-9


class Chart(ABC):
    """Unknowns for initial values and period at and near one orbit."""

    size: float
    period: float

    @abstractmethod
    def encode(self, x: np.ndarray, period: float) -> np.ndarray:
        """The unknowns (n + 1,) of initial values ``x`` (n,) and period."""

    @abstractmethod
    def decode(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Initial values (n,) and period in s at the unknowns ``xi`` (n + 1,)."""

    @abstractmethod
    def to_changes(self, xi: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Changes of (x, period) that ``changes`` (n + 1,) of the unknowns at ``xi`` make."""

    @abstractmethod
    def to_unknowns(self, xi: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Changes of the unknowns at ``xi`` that make the ``changes`` (n + 1,) or (n + 1, m) of (x, period)."""


class DenseChart(Chart):
    """A chart with the matrix of its derivative."""

    @abstractmethod
    def derivative(self, xi: np.ndarray) -> np.ndarray:
        """The matrix d(x, period)/d xi (n + 1, n + 1) at the unknowns ``xi`` (n + 1,)."""

    def to_changes(self, xi: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Changes of (x, period) that ``changes`` (n + 1,) of the unknowns at ``xi`` make."""
        return self.derivative(xi) @ changes

    def to_unknowns(self, xi: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Changes of the unknowns at ``xi`` that make the ``changes`` (n + 1,) or (n + 1, m) of (x, period)."""
        return np.linalg.solve(self.derivative(xi), changes)


class Relative(DenseChart):
    """Initial values over the largest one, and elongations of contacts over a scale of their own.

    The scale of w is max(|w_0|, |D|), with the smaller clearance D of the contact, and ``size`` at most. Over ``size``
    itself a large common motion would hide the changes of w that make and break contacts. Without ``rest``, where an
    arc starts at the centre, all initial values are over ``size``: they are velocities, and all w are 0.

    Of contacts that form a closed ring one has no unknown of its own: its w is the sum of the others, so that with it
    the chart could not be inverted.
    """

    def __init__(self, system: System, x: np.ndarray, period: float, rest: bool = True) -> None:
        self.size = float(np.abs(x).max())
        self.period = period
        self.weights = np.eye(len(x)) / self.size
        if rest:
            for number in _without_rings(system.contacts):
                row = system.contact_rows[number]
                pair = system.contacts[number]
                scale = min(max(abs(row @ x), abs(pair.stops.clearance)), self.size)
                self.weights[pair.resonator] = row / scale
        self.inverse = np.linalg.inv(self.weights)
        n = len(x)
        self._derivative = np.zeros((n + 1, n + 1))
        self._derivative[:n, :n] = self.inverse
        self._derivative[n, n] = period

    def encode(self, x: np.ndarray, period: float) -> np.ndarray:
        """The unknowns (n + 1,) of initial values ``x`` (n,) and period."""
        return np.append(self.weights @ x, period / self.period)

    def decode(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Initial values (n,) and period in s at the unknowns ``xi`` (n + 1,)."""
        return self.inverse @ xi[:-1], float(xi[-1] * self.period)

    def derivative(self, xi: np.ndarray) -> np.ndarray:
        """d(x, period)/d xi."""
        return self._derivative


class Grazing(DenseChart):
    """Initial values over the largest one, with y for the contact that is nearest to its clearance.

    Nearest is the contact with the smallest |sigma w/D - 1|, sigma being the side of w. If it has no stop on that side,
    y is the root of the gap to the stop on the other side. ``contact`` is the number of the contact, ``sign`` is sigma,
    and ``index`` the place of y among the unknowns.
    """

    def __init__(self, system: System, x: np.ndarray, period: float) -> None:
        self.size = float(np.abs(x).max())
        self.period = period
        w = system.contact_rows @ x
        nearest = int(np.abs(system.sides_at(w) * w / system.clearances_at(w) - 1).argmin())
        self.contact = nearest
        self.row = system.contact_rows[nearest]
        self.index = system.contacts[nearest].resonator
        self.sign = float(system.sides_at(w)[nearest])
        self.clearance = float(system.clearances_at(w)[nearest])
        if self.clearance == np.inf:
            self.sign = -self.sign
            self.clearance = system.contacts[nearest].stops.clearance

    def encode(self, x: np.ndarray, period: float) -> np.ndarray:
        """The unknowns (n + 1,) of initial values ``x`` (n,) and period."""
        xi = np.append(x / self.size, period / self.period)
        gap = self.sign * (self.row @ x) / self.clearance - 1
        xi[self.index] = np.sign(gap) * np.sqrt(np.abs(gap))
        return xi

    def decode(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Initial values (n,) and period in s at the unknowns ``xi`` (n + 1,)."""
        x = xi[:-1] * self.size
        y = xi[self.index]
        x[self.index] = 0.0
        x[self.index] = self.sign * self.clearance * (1 + y * abs(y)) - self.row @ x
        return x, float(xi[-1] * self.period)

    def derivative(self, xi: np.ndarray) -> np.ndarray:
        """d(x, period)/d xi."""
        d = np.diag(np.append(np.full(len(xi) - 1, self.size), self.period))
        d[self.index, :-1] = -self.row * self.size
        d[self.index, self.index] = self.sign * self.clearance * 2 * max(abs(xi[self.index]), SMALLEST_ROOT)
        return d


CHARTS: dict[str, type[Relative | Grazing]] = {"relative": Relative, "grazing": Grazing}


def _without_rings(contacts: Sequence[ContactPair]) -> Iterator[int]:
    """Numbers of the ``contacts`` whose elongations may be unknowns in the places of their resonators, all at once.

    Left out are contacts that close a ring, each from a host to a resonator that is the host of the next.
    """
    # If several contacts have one resonator, the elongation of the last one is the unknown in its place.
    host_of: dict[int, int | None] = {}
    for number, pair in enumerate(contacts):
        mass = pair.host
        while mass is not None and mass != pair.resonator:
            mass = host_of.get(mass)
        if mass is None:
            host_of[pair.resonator] = pair.host
            yield number


def near_grazing(system: System, x: np.ndarray) -> bool:
    """Whether a contact of an orbit that starts at rest at ``x`` (n,) is near its clearance there."""
    w = system.contact_rows @ x
    distance = np.abs(system.sides_at(w) * w / system.clearances_at(w) - 1)
    return bool(distance.min(initial=np.inf) < NEAR_GRAZING)
