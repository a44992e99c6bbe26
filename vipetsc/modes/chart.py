"""Charts: the unknowns xi (n + 1,) in which a branch is continued, in place of initial values x (n,) and the period.

A chart is made around a point of the branch; xi is of order one there, so that arclength is dimensionless. Each
encodes (x, period) as xi, decodes it, and gives d(x, period)/d xi (n + 1, n + 1).
"""

import numpy as np
from scipy.linalg import block_diag

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

    def encode(self, x: np.ndarray, period: float) -> np.ndarray:
        """The unknowns of initial values and period."""
        return np.append(self.weights @ x, period / self.period)

    def decode(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Initial values and period."""
        return self.inverse @ xi[:-1], float(xi[-1] * self.period)

    def derivative(self, xi: np.ndarray) -> np.ndarray:
        """d(x, period)/d xi."""
        return block_diag(self.inverse, self.period)


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
