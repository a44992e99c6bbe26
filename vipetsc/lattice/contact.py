"""Vibro-impact contact: Hertz, bilinear and power laws on both sides of a clearance, with restitution.

With w = u_resonator - u_host and clearance D, the contact force is
F = kc [(w - D)_+^n - (-w - D)_+^n] g, restoring: -F on the resonator, +F on the host.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

Law = Literal["hertz", "bilinear", "power"]
Adhesion = Literal["allow", "clip"]
Damping = Literal["paper", "exact", "hunt-crossley", "lankarani-nikravesh", "flores"]
LEAST_RESTITUTION = 0.05  # where the damping grows without bound towards 0


def contact_stiffness(modulus: float, radius: float, poisson: float) -> float:
    """kc = 2 E sqrt(R) / (3 (1 - nu^2)) for modulus E in Pa, radius R in m; N/m^(3/2).

    The paper uses the same number, in N/m, for its bilinear law.
    """
    return 2 * modulus * np.sqrt(radius) / (3 * (1 - poisson**2))


def rebound(damping: float, restitution: float) -> float:
    """c (1 + e) + log(1 - c e) - log(1 + c): zero where an impact with the damping c has the restitution e."""
    return float(damping * (1 + restitution) + np.log1p(-damping * restitution) - np.log1p(damping))


@dataclass(frozen=True)
class Contact:
    """A ``law`` F = kc x^n, its ``stiffness`` kc in N/m^n and its ``restitution`` r in [0, 1]; 1 conserves energy.

    ``adhesion``: "allow" lets g become negative (a pull at fast separation), "clip" keeps g >= 0. ``approach_floor``:
    smallest |w'_minus| in m/s used in g; a grazing onset would make g unbounded. ``factor`` names the damping c in
    g = 1 + c w'/w'_minus; ``power`` is n of the law "power".
    """

    law: Law
    stiffness: float
    restitution: float = 1.0
    adhesion: Adhesion = "allow"
    approach_floor: float = 0.0
    factor: Damping = "paper"
    power: float | None = None

    def __str__(self) -> str:
        about = f"restitution {self.restitution:g}, effective {self.effective_restitution:.3f}"
        named = "" if self.factor == "paper" else f" ({self.factor})"
        return f"{self.law}, {self.stiffness:.6g} N/m^{self.exponent:g}, {about}{named}"

    @property
    def exponent(self) -> float:
        """n of the law, for spheres in elastic contact (Hertz) or a linear stop; raises KeyError for another."""
        return {"hertz": 1.5, "bilinear": 1.0}[self.law] if self.power is None else self.power

    @property
    def damping(self) -> float:
        """The factor c of w'/w'_minus in g, by its name.

        3 (1 - r)/2, the paper's: Hunt and Crossley, J. Appl. Mech. 42 (1975) 440. 3 (1 - r^2)/4: Lankarani and
        Nikravesh, J. Mech. Des. 112 (1990) 369. 8 (1 - r)/(5 r): Flores, Machado, Silva and Martins, Multibody Syst.
        Dyn. 25 (2011) 357. ``exact``: the one whose impact has the restitution r.
        """
        e = self.restitution
        if self.factor == "lankarani-nikravesh":
            return 0.75 * (1 - e**2)
        if self.factor == "flores":
            return 1.6 * (1 - e) / e
        if self.factor != "exact" or e > 1 - 1e-6:
            return 1.5 * (1 - e)
        return float(brentq(rebound, 0.75 * (1 - e**2) / (1 + e**3), (1 - 1e-12) / e, (e,)))

    @property
    def effective_restitution(self) -> float:
        """-w'_plus/w'_minus of two masses that nothing but the contact acts on, above the ``approach_floor``."""
        c = self.damping
        return 1 - 2 * c / 3 if c < 1e-6 else float(brentq(lambda e: rebound(c, e), 0.0, min(1.0, (1 - 1e-12) / c)))

    def dissipation_factor(self, rate: ArrayLike, approach: ArrayLike) -> np.ndarray:
        """g = 1 + 3 (1 - r)/2 w'/w'_minus for relative velocity and approach velocity in m/s.

        The paper prints a minus sign, which feeds energy in; Hunt and Crossley's law has a plus.
        """
        approach = np.asarray(approach, float)
        floored = np.copysign(np.maximum(np.abs(approach), self.approach_floor), approach)
        g = 1 + self.damping * np.asarray(rate, float) / floored
        return np.maximum(g, 0) if self.adhesion == "clip" else g

    def force(
        self, w: ArrayLike, clearance: ArrayLike, rate: ArrayLike = 0.0, approach: ArrayLike = np.inf
    ) -> np.ndarray:
        """Restoring force F in N for relative displacement w in m; g = 1 unless an approach is given."""
        w = np.asarray(w, float)
        elastic = np.maximum(w - clearance, 0) ** self.exponent - np.maximum(-w - clearance, 0) ** self.exponent
        return self.stiffness * elastic * self.dissipation_factor(rate, approach)

    def slopes(
        self, w: ArrayLike, clearance: ArrayLike, rate: ArrayLike, approach: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of ``force`` by w in N/m and by w' in N s/m."""
        w, approach = np.asarray(w, float), np.asarray(approach, float)
        x, n, g = np.maximum(np.abs(w) - clearance, 0), self.exponent, self.dissipation_factor(rate, approach)
        damping = self.damping / np.copysign(np.maximum(np.abs(approach), self.approach_floor), approach)
        clipped = (g <= 0) if self.adhesion == "clip" else False
        by_rate = np.where(clipped, 0.0, np.sign(w) * x**n * damping)
        return self.stiffness * np.where(x > 0, n * x ** (n - 1), 0) * g, self.stiffness * by_rate

    def potential(self, w: ArrayLike, clearance: ArrayLike) -> np.ndarray:
        """Elastic energy kc x^(n+1)/(n+1) in J stored at relative displacement w in m."""
        x = np.maximum(np.abs(np.asarray(w, float)) - clearance, 0)
        return self.stiffness * x ** (self.exponent + 1) / (self.exponent + 1)
