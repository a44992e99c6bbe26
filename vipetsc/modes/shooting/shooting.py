"""Shooting: a periodic orbit as a boundary value problem over a part of its period, solved by PETSc's SNES.

Newton's method works in the unknowns xi (n + 1,) of a chart, in place of initial values x (n,) and the period. A chart
is made around a point of the branch; xi is of order one there, so that arclength is dimensionless. Each encodes
(x, period) as xi, decodes it, and gives d(x, period)/d xi (n + 1, n + 1).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from vipetsc.modes.newton import Attempt, BorderedNewton
from vipetsc.modes.problem import FlowError
from vipetsc.modes.shooting.flow import Arc, Flow
from vipetsc.modes.system import System


class Relative:
    """Initial values over the largest one, period over its value; gaps over their clearance.

    Where an arc starts at rest, the resonator's displacement gives way to w = u_resonator - u_host over
    max(|w|, D), or else a large common motion would hide the changes of w that make and break contacts.
    """

    def __init__(self, system: System, x: np.ndarray, period: float, rest: bool = True) -> None:
        self.size, self.period = float(np.abs(x).max()), period
        self.weights = np.eye(len(x)) / self.size
        for row, pair in zip(system.contact_rows, system.contacts, strict=True):
            if rest:
                scale = min(max(abs(row @ x), pair.clearance), self.size)
                self.weights[pair.resonator] = row / scale
        self.inverse = np.linalg.inv(self.weights)
        self._derivative = block_diag(self.inverse, period)

    def encode(self, x: np.ndarray, period: float) -> np.ndarray:
        """The unknowns of initial values and period."""
        return np.append(self.weights @ x, period / self.period)

    def decode(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Initial values and period."""
        return self.inverse @ xi[:-1], float(xi[-1] * self.period)

    def derivative(self, xi: np.ndarray) -> np.ndarray:
        """d(x, period)/d xi."""
        return self._derivative


class Logarithmic:
    """Logarithms of the largest initial value and of the period; the other values over the largest one."""

    def __init__(self, system: System, x: np.ndarray, period: float) -> None:
        self.size, self.period = float(np.abs(x).max()), period
        self.lead = int(np.abs(x).argmax())
        self.sign = float(np.sign(x[self.lead]))

    def encode(self, x: np.ndarray, period: float) -> np.ndarray:
        """The unknowns of initial values and period."""
        xi = np.append(x / x[self.lead], np.log(period / self.period))
        xi[self.lead] = np.log(x[self.lead] / (self.sign * self.size))
        return xi

    def decode(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Initial values and period."""
        lead = self.sign * self.size * np.exp(xi[self.lead])
        x = xi[:-1] * lead
        x[self.lead] = lead
        return x, float(self.period * np.exp(xi[-1]))

    def derivative(self, xi: np.ndarray) -> np.ndarray:
        """d(x, period)/d xi."""
        x, period = self.decode(xi)
        d = np.diag(np.append(np.full(len(x), x[self.lead]), period))
        d[:-1, self.lead] = x
        return d


class Grazing:
    """Relative, with y in place of the displacement of the contact nearest to its clearance: (|w| - D)/D = y |y|.

    An orbit that starts on its largest |w| depends on w - D through a square root (bilinear contact), so that
    this unknown makes the branch smooth through grazing.
    """

    def __init__(self, system: System, x: np.ndarray, period: float) -> None:
        self.size, self.period = float(np.abs(x).max()), period
        nearest = int(np.abs(np.abs(system.contact_rows @ x) / system.clearances - 1).argmin())
        self.row, self.clearance = system.contact_rows[nearest], system.clearances[nearest]
        self.index, self.sign = system.contacts[nearest].resonator, float(np.sign(self.row @ x))

    def encode(self, x: np.ndarray, period: float) -> np.ndarray:
        """The unknowns of initial values and period."""
        xi = np.append(x / self.size, period / self.period)
        q = self.sign * (self.row @ x) / self.clearance - 1
        xi[self.index] = np.sign(q) * np.sqrt(np.abs(q))
        return xi

    def decode(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Initial values and period."""
        x, y = xi[:-1] * self.size, xi[self.index]
        x[self.index] = 0.0
        x[self.index] = self.sign * self.clearance * (1 + y * abs(y)) - self.row @ x
        return x, float(xi[-1] * self.period)

    def derivative(self, xi: np.ndarray) -> np.ndarray:
        """d(x, period)/d xi."""
        d = np.diag(np.append(np.full(len(xi) - 1, self.size), self.period))
        d[self.index, :-1] = -self.row * self.size
        d[self.index, self.index] = self.sign * self.clearance * 2 * max(abs(xi[self.index]), 1e-9)
        return d


Chart = Relative | Logarithmic | Grazing
CHARTS: dict[str, type[Chart]] = {"relative": Relative, "logarithmic": Logarithmic, "grazing": Grazing}


@dataclass(frozen=True)
class ShootingMap:
    """Where an arc starts and ends, and what fraction of the period it takes.

    ``rest`` is v = 0, ``centre`` is u = 0. An odd system's symmetric orbit goes from rest to the centre in a
    quarter period; any reversible one from rest to rest in a half.
    """

    name: str
    start: str
    end: str
    fraction: float

    @property
    def quarter(self) -> bool:
        """Whether it goes from one section to the other; the orbit is then odd about its end."""
        return self.start != self.end


MAPS = {
    "quarter": ShootingMap("quarter", "rest", "centre", 0.25),
    "half": ShootingMap("half", "rest", "rest", 0.5),
    "whole": ShootingMap("whole", "rest", "rest", 1.0),
    "half-centre": ShootingMap("half-centre", "centre", "centre", 0.5),
}


class Shooting:
    """Periodic orbits of ``flow.system``: initial values x (n,) and period, by Newton's method (PETSc SNES).

    x are displacements in m for a map that starts at rest, velocities in m/s for one that starts at the centre.
    Raises ValueError if the map needs an odd system and the system is not. Newton's method solves the n equations and
    one more linear row in the unknowns of a chart; it ends at a scaled residual of ``tolerance``, after a step below
    ``STEP_TOLERANCE``, where rounding allows no more, or after ``max_newton`` steps.
    """

    dense = True  # sensitivities are a matrix

    def __init__(self, flow: Flow, shooting_map: ShootingMap, tolerance: float = 1e-13, max_newton: int = 7) -> None:
        if "centre" in (shooting_map.start, shooting_map.end) and not flow.system.odd:
            raise ValueError(
                f"the {shooting_map.name} map needs forces that change sign with the displacement; "
                "this system's do not: use map = 'half'"
            )
        self.flow, self.system, self.map, self.tolerance = flow, flow.system, shooting_map, tolerance
        n, size = self.system.dofs, self.system.dofs + 1
        # the half of the state that is free at the arc's start, and the half that should vanish at its end
        self.free = slice(0, n) if shooting_map.start == "rest" else slice(n, 2 * n)
        self._zero = slice(n, 2 * n) if shooting_map.end == "rest" else slice(0, n)
        self._newton = self._create_newton(size, max_newton)
        self._chart: Chart
        self._last: tuple[np.ndarray, Arc] | None = None

    def _create_newton(self, size: int, max_newton: int) -> BorderedNewton:
        return BorderedNewton(self._function, self.matrix, size, self.tolerance, max_newton)

    def chart(self, name: str, x: np.ndarray, period: float, **options: bool) -> Chart:
        """The chart of that name at ``x``; ``options`` are the chart's."""
        return CHARTS[name](self.system, x, period, **options)

    def arc(self, x: np.ndarray, period: float) -> Arc:
        """The arc from initial values ``x``; raises FlowError where the flow fails."""
        start = np.zeros(2 * self.system.dofs)
        start[self.free] = x
        return self.flow.arc(start, self.map.fraction * period, period)

    def residual(self, arc: Arc) -> np.ndarray:
        """What should vanish at the arc's end (n,): displacements in m or velocities in m/s."""
        return arc.end[self._zero]

    def jacobian(self, arc: Arc) -> np.ndarray:
        """Derivative (n, n + 1) of the residual with respect to initial values and period."""
        n, masses = self.system.dofs, self.system.masses
        rate = arc.end[n:] if self.map.end == "centre" else -self.system.forces(arc.end[:n]) / masses
        return np.column_stack([arc.sensitivity[self._zero, self.free], self.map.fraction * rate])

    def energy(self, x: np.ndarray) -> float:
        """Energy in J of the orbit with initial values ``x``."""
        zero = np.zeros_like(x)
        return self.system.energy(x, zero) if self.map.start == "rest" else self.system.energy(zero, x)

    def energy_gradient(self, x: np.ndarray) -> np.ndarray:
        """dE/dx (n,) in J over the unit of ``x``."""
        return self.system.forces(x) if self.map.start == "rest" else self.system.masses * x

    def solve(self, chart: Chart, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        """Solve shooting(xi) = 0 and row . xi = value, starting from ``guess`` (n + 1,)."""
        self._chart, self._last, self._newton.tolerance = chart, None, self.tolerance
        attempt = self._newton.solve(guess, row, value)
        return attempt if attempt.left_domain else replace(attempt, arc=self._arc(attempt.xi))

    def matrix(self, xi: np.ndarray) -> np.ndarray:
        """The scaled Jacobian (n, n + 1) of the shooting equations at ``xi``, in the chart of the last attempt."""
        return self.jacobian(self._arc(xi)) @ self._chart.derivative(xi) / self._chart.size

    def tangent(self, xi: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Unit tangent (n + 1,) in the chart of the last attempt, at its ``xi``, turned towards ``reference``."""
        direction = np.linalg.svd(self.matrix(xi))[2][-1]  # the null vector
        return -direction if direction @ reference < 0 else direction

    def null_vector(self, chart: Chart, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Singular values (n,) of the Jacobian in a ``chart``, largest first, and its unit null vector (n + 1,)."""
        matrix = self.jacobian(self.arc(*chart.decode(xi))) @ chart.derivative(xi)
        values, directions = np.linalg.svd(matrix)[1:]
        return values, directions[-1]

    def _arc(self, xi: np.ndarray) -> Arc:
        if self._last is None or not np.array_equal(self._last[0], xi):
            self._last = xi.copy(), self.arc(*self._chart.decode(xi))
        return self._last[1]

    def _function(self, xi: np.ndarray) -> np.ndarray:
        if not np.all(np.isfinite(xi)) or self._chart.decode(xi)[1] <= 0:
            raise FlowError("Newton left the domain: the period is not positive")
        return self.residual(self._arc(xi)) / self._chart.size
