"""One periodic orbit of a branch of nonlinear normal modes, and its quantities in the branch's file."""

from dataclasses import dataclass, field

import numpy as np

from vipetsc.modes.problem import PeriodicProblem, Solution

# Quantities of a point: name in the files, type, unit, description.
POINT_VARIABLES: dict[str, tuple[str, type, str, str]] = {
    "energy": ("energy", float, "J", "energy"),
    "frequency": ("frequency", float, "Hz", "frequency"),
    "period": ("period", float, "s", "period"),
    "slope": ("slope", float, "Hz/J", "slope df/dE of the branch"),
    "multiplier": ("multiplier_max", float, "1", "largest modulus of a Floquet multiplier"),
    "residual": ("residual", float, "1", "scaled residual of the shooting equations"),
    "closed": ("closed", float, "1", "fraction of the time with a contact closed"),
    "energy_tangent": ("rise", float, "J", "dE along the tangent"),
    "step": ("step", float, "1", "arclength of the step that led here"),
    "episodes": ("contacts", int, "1", "contact episodes in the arc that is shot; openings of pressed ones"),
    "newton": ("newton", int, "1", "Newton steps"),
    "index": ("number", int, "1", "number of the regular point, or of the one after a special point"),
    "resonance": ("resonance", int, "1", "k of the k:1 tongue of an energy fold; else 1 or 0"),
}


# Quantities of motions along which something dissipates: name in the files, unit, description.
OF_LOSSES: dict[str, tuple[str, str]] = {
    "loss": ("J", "energy lost in a period along the motion without loss"),
    "damping_ratio": ("1", "loss over 4 pi times the energy"),
    "force": ("N", "force at the forced mass, a quarter of a period ahead, that makes up for the loss"),
}


# Points compare by identity: the arrays in them have no single truth value that a generated == could return.
@dataclass(frozen=True, eq=False, kw_only=True)
class Point(Solution):
    """A periodic orbit on a branch.

    ``x`` are initial displacements (n,) in m (velocities in m/s for maps from the centre), or the unknowns of harmonic
    balance in m; ``tangent`` is d(x, period). Orbits that are shot have ``half_traces`` (n - 1,). Harmonic balance
    gives the ``order`` of the highest harmonic, the estimated ``truncation``, and ``elongations`` (pairs,) in m at
    phase 0. ``POINT_VARIABLES`` describes the other fields, ``OF_LOSSES`` those that are NaN unless something
    dissipates.
    """

    x: np.ndarray
    period: float
    energy: float
    residual: float
    half_traces: np.ndarray = field(default_factory=lambda: np.empty(0))
    multiplier: float = np.nan
    episodes: int
    closed: float
    newton: int
    tangent: np.ndarray = field(default_factory=lambda: np.empty(0))
    slope: float = np.nan
    energy_tangent: float = np.nan
    index: int = 0
    step: float = 0.0
    next_step: float = np.nan
    kind: str = "regular"
    resonance: int = 0
    order: int = 0
    truncation: float = np.nan
    elongations: np.ndarray = field(default_factory=lambda: np.empty(0))
    loss: float = np.nan
    force: float = np.nan
    zeta: float = np.nan

    @property
    def damping_ratio(self) -> float:
        """Loss over 4 pi times the energy: of a linear mode its damping ratio; of a damped mode ``zeta``."""
        if np.isfinite(self.zeta):
            return self.zeta
        return self.loss / (4 * np.pi * self.energy)

    @property
    def frequency(self) -> float:
        """Frequency in Hz."""
        return 1 / self.period

    def describe(self) -> str:
        """Return the point's number and energy, for messages."""
        return f"point {self.index} (E = {self.energy:.9g} J)"


class OrbitProblem(PeriodicProblem[Point]):
    """Equations whose solutions are orbits with contacts."""

    def grazing(self, point: Point) -> list[int]:
        """Return the numbers, from 1, of contacts that graze in an orbit, where they are looked for.

        Raises FlowError if the arc cannot be integrated.
        """
        return []

    def acceleration(self, point: Point) -> float:
        """Return largest acceleration where an orbit rests, over that of a harmonic motion of the same size and period.

        It is 0 at an equilibrium, and infinite where no rest of the orbit is known.
        """
        return np.inf

    def rests_on_stop(self, point: Point) -> bool:
        """Return whether an orbit begins at rest on a rigid stop, as far as steps resolve it."""
        return False

    def has_corner(self, before: Point, after: Point) -> bool:
        """Return whether the branch has a corner between two points, where no step is short enough for the guards."""
        return False
