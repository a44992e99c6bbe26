r"""Hill's method for condensed motions: which perturbations of a periodic motion grow.

A perturbation exp(lambda t) sum_k d_k exp(i k Om t) of the elongations changes the forces by J d (``ForceSeries``), and
these the elongations by -G(k Om - i lambda) J d, G of outgoing waves (Im omega < 0 where Re lambda > 0): growing ones
are the zeros of

    D(lambda) = det(I + G(k Om - i lambda) J(lambda)),   Re lambda > 0,  |Im lambda| <= Om/2.

D is analytic there, tends to 1 for large Re lambda, is real on the real axis and has the period i Om but for what is
left out: the zeros to the right of Re lambda = ``least`` Om are minus the turns of D along that line (Cauchy's argument
principle). If a motion has odd orders alone and forces are odd, odd orders of perturbations do not meet even ones: D is
the product of two determinants. J is a Toeplitz matrix unless forces dissipate.
Cf. G. W. Hill, Acta Math. 8 (1886) 1; von Groll and Ewins, J. Sound Vib. 241 (2001) 223.
"""

from typing import Protocol

import numpy as np
from scipy.optimize import brentq

from vipetsc.modes.harmonics import ForceSeries

LEAST = 1e-4  # growth rate over Om up to which a motion counts as stable
COARSE, FINEST = 24, 14  # intervals of half a strip; halvings of one in which D turns by more than TURN
TURN = 0.7  # rad
RATES = np.geomspace(LEAST, 3.0, 18)  # over Om: between these real roots are looked for


class At(Protocol):
    """A compliance (frequency, pair, pair) in m/N at complex frequencies in rad/s."""

    def at(self, omegas: np.ndarray) -> np.ndarray:
        """G at ``omegas``."""


class Hill:
    """Of motions at ``omega`` (rad/s) with harmonics up to ``last``, motions being ``odd`` or not; G is kept."""

    def __init__(self, compliance: At, omega: float, last: int, odd: bool) -> None:
        self.compliance, self.omega, self.orders = compliance, omega, np.arange(-last, last + 1)
        self._blocks = [slice(1 - last % 2, None, 2), slice(last % 2, None, 2)] if odd else [slice(None)]
        self._known: dict[complex, np.ndarray] = {}

    def determinants(self, series: ForceSeries, exponents: np.ndarray) -> np.ndarray:
        """D (exponents,) at lambda/Om = ``exponents``; large ones keep their phases."""
        new = [mu for mu in exponents.tolist() if mu not in self._known]
        if new:
            at = (self.orders - 1j * np.array(new)[:, None]) * self.omega
            shape = len(new), len(self.orders)
            for mu, g in zip(
                new, self.compliance.at(at.ravel()).reshape(*shape, *series.potential.shape * 2), strict=True
            ):
                self._known[mu] = g
        jacobian = series.jacobian()
        fixed = np.array_equal(jacobian, series.jacobian(1.0))  # nothing dissipates
        each = ((mu, jacobian if fixed else series.jacobian(mu)) for mu in exponents.tolist())
        return np.array([self._determinant(self._known[mu], of) for mu, of in each])

    def _determinant(self, g: np.ndarray, jacobian: np.ndarray) -> complex:
        value = 1 + 0j
        for block in self._blocks:
            matrix = np.einsum("kij,jkl->ikjl", g[block], jacobian[:, block, block])
            size = matrix.shape[0] * matrix.shape[1]
            phase, log = np.linalg.slogdet(np.eye(size) + matrix.reshape(size, size))
            value *= phase * np.exp(min(log, 300.0))
        return complex(value)

    def unstable(self, series: ForceSeries) -> int:
        """How many perturbations grow faster than ``LEAST`` Om, two for a complex pair; -1 if that cannot be told."""
        shares = np.linspace(0, 0.5, COARSE + 1)
        values = self.determinants(series, LEAST + 1j * shares)
        for _ in range(FINEST):
            turns = np.abs(np.angle(values[1:] / values[:-1]))
            (wide,) = np.nonzero(turns > TURN)
            if not wide.size:
                break
            between = (shares[wide] + shares[wide + 1]) / 2
            values = np.insert(values, wide + 1, self.determinants(series, LEAST + 1j * between))
            shares = np.insert(shares, wide + 1, between)
        turned = -float(np.angle(values[1:] / values[:-1]).sum()) / np.pi
        return round(turned) if abs(turned - round(turned)) < 0.25 else -1

    def growth(self, series: ForceSeries) -> float:
        """The largest growth rate over Om of perturbations that repeat or change sign every period; 0 if none."""
        largest = 0.0
        for line in (0.0, 0.5j):
            values = self.determinants(series, RATES + line).real
            changes = np.nonzero(values[1:] * values[:-1] < 0)[0]
            if changes.size:
                low, high = RATES[changes[-1]], RATES[changes[-1] + 1]
                root = brentq(
                    lambda x, line=line: self.determinants(series, np.array([x + line]))[0].real, low, high, xtol=1e-6
                )
                largest = max(largest, float(root))
        return largest
