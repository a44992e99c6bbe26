"""Vibro-impact contact: Hertz and bilinear laws on both sides of a clearance, with restitution.

With w = u_resonator - u_host and clearance D, the contact force is
F = kc [(w - D)_+^n - (-w - D)_+^n] g, restoring: -F on the resonator, +F on the host.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

Law = Literal["hertz", "bilinear"]
Adhesion = Literal["allow", "clip"]


def contact_stiffness(modulus: float, radius: float, poisson: float) -> float:
    """kc = 2 E sqrt(R) / (3 (1 - nu^2)) for modulus E in Pa, radius R in m; N/m^(3/2).

    The paper uses the same number, in N/m, for its bilinear law.
    """
    return 2 * modulus * np.sqrt(radius) / (3 * (1 - poisson**2))


@dataclass(frozen=True)
class Contact:
    """A ``law`` F = kc x^n, its ``stiffness`` kc in N/m^n and its ``restitution`` r in [0, 1]; 1 conserves energy.

    ``adhesion``: "allow" lets g become negative (a pull at fast separation), "clip" keeps g >= 0. ``approach_floor``:
    smallest |w'_minus| in m/s used in g; a grazing onset would make g unbounded.
    """

    law: Law
    stiffness: float
    restitution: float = 1.0
    adhesion: Adhesion = "allow"
    approach_floor: float = 0.0

    @property
    def exponent(self) -> float:
        """n of the law, for spheres in elastic contact (Hertz) or a linear stop; raises KeyError for another."""
        return {"hertz": 1.5, "bilinear": 1.0}[self.law]

    @property
    def damping(self) -> float:
        """3 (1 - r) / 2, the factor of w'/w'_minus in g (Hunt and Crossley 1975)."""
        return 1.5 * (1 - self.restitution)

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

    def potential(self, w: ArrayLike, clearance: ArrayLike) -> np.ndarray:
        """Elastic energy kc x^(n+1)/(n+1) in J stored at relative displacement w in m."""
        x = np.maximum(np.abs(np.asarray(w, float)) - clearance, 0)
        return self.stiffness * x ** (self.exponent + 1) / (self.exponent + 1)
