"""The law of a vibro-impact contact: an elastic force on both sides of a clearance, with restitution.

With w = u_resonator - u_host, the clearance D, the elastic force f of the indentation x, and the dissipation factor g,
the contact force is F = [f((w - D)_+) - f((-w - D)_+)] g, restoring: -F on the resonator, +F on the host.

Everything about a shipped elastic law on arrays stands here: its name and parameters with the texts that case files
show, force, slope, energy, and the duration of an impact. ``vipetsc.contact.law`` is its compiled twin. Laws and
dissipation factors of users' modules are those of ``vipetsc.register``, by name.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Literal, NamedTuple, cast

import numpy as np
import scipy
from numpy.typing import ArrayLike

from vipetsc.register import DISSIPATION, LAW, PARTS, DissipationPart, LawPart, reserve

RIGID = "rigid"
LAWS = ("hertz", "bilinear", "power", RIGID)
"""Shipped laws: the force of each is one power of the indentation; stops of the law ``RIGID`` do not yield."""
DAMPINGS = ("paper", "exact", "hunt-crossley", "lankarani-nikravesh", "flores")
"""Names of shipped factors of dissipation."""
Adhesion = Literal["allow", "clip"]
LEAST_RESTITUTION: Mapping[str, float] = {"exact": 0.05, "flores": 0.05}  # their damping grows without bound towards 0

# The power of the indentation with which the force of a law begins; that of "power" is its parameter.
# A rigid stop has no force of an indentation: its motion is smooth between impacts, as after a linear onset.
ONSET_EXPONENTS: Mapping[str, float] = {"hertz": 1.5, "bilinear": 1.0, RIGID: 1.0}
# Phases at which the duration of an impact is summed; relative errors are below 1e-5 where f begins as x^1.5.
PHASES = 32
# Depth in m from which the deepest indentation of an impact is sought: a force may overflow far beyond it.
SHALLOWEST = 1e-15


class LawParameter(NamedTuple):
    """A number that one elastic ``law`` takes in addition to its stiffness.

    It is a field of ``Contact`` and the key of that name in ``[contacts]``. ``unit`` and ``text`` describe the key in
    the manual; a case file may give values from ``least`` to ``most``.
    """

    law: str
    unit: str
    text: str
    least: float
    most: float


def parameter(law: str, unit: str, text: str, least: float, most: float) -> dict[str, LawParameter]:
    """Return metadata of a field of ``Contact`` that is a parameter of a shipped elastic law."""
    return {"parameter": LawParameter(law=law, unit=unit, text=text, least=least, most=most)}


def registered_law(name: str) -> LawPart | None:
    """Return the law that a user's module registers by that ``name``; None for a shipped one."""
    return cast(LawPart | None, PARTS[LAW].get(name))


def registered_factor(name: str) -> DissipationPart | None:
    """Return the dissipation factor that a user's module registers by that ``name``; None for a shipped one."""
    return cast(DissipationPart | None, PARTS[DISSIPATION].get(name))


def least_restitution(factor: str) -> float:
    """Return the smallest restitution that the dissipation ``factor`` of that name takes."""
    registered = registered_factor(factor)
    if registered:
        return registered.least_restitution
    return LEAST_RESTITUTION.get(factor, 0.0)


def contact_stiffness(modulus: float, radius: float, poisson: float) -> float:
    """Return kc = 2 E sqrt(R) / (3 (1 - nu^2)) in N/m^(3/2) for the modulus E in Pa and the radius R in m.

    It is Hertz's stiffness 4/3 E' sqrt(R) of two bodies of one material, 1/E' = 2 (1 - nu^2)/E, with the relative
    curvature 1/R = 1/R1 + 1/R2: R is the radius of a sphere that meets a flat stop, and half the radius of two equal
    spheres. The paper uses the same number, in N/m, for its bilinear law.
    """
    return 2 * modulus * np.sqrt(radius) / (3 * (1 - poisson**2))


def rebound(damping: float, restitution: float) -> float:
    """Return c (1 + e) + log(1 - c e) - log(1 + c): zero where an impact with the damping c has the restitution e.

    For s = w'/w'_minus the motion m w'' = -f (1 + c s) gives s ds/(1 + c s) = -f dx/(m w'_minus^2). The indentation is
    0 at both ends of an impact, and with it the integral of f dx: that of s/(1 + c s) from s = -e to 1 must be 0. It is
    this expression over c^2.
    """
    return float(damping * (1 + restitution) + np.log1p(-damping * restitution) - np.log1p(damping))


@dataclass(frozen=True)
class Contact:
    """An elastic ``law`` f(x) with its ``stiffness`` kc, and a ``restitution`` r in [0, 1]; 1 conserves energy.

    f = kc x^n for spheres in elastic contact (``hertz``, n = 3/2), a linear stop (``bilinear``, n = 1) and any
    ``power`` n; kc in N/m^n. ``exponent`` is n, which the law ``power`` takes and the others set themselves. A
    ``rigid`` stop does not yield: it has no stiffness (0), and impacts that turn w' into -r w' at once.

    ``adhesion``: "allow" lets g become negative (a pull at fast separation), "clip" keeps g >= 0. ``approach_floor``:
    smallest |w'_minus| in m/s used in g; a grazing onset would make g unbounded. ``factor`` names the damping c in
    g = 1 + c w'/w'_minus. ``parameters`` are those of a law that a user's module registers, in its order.
    """

    law: str
    stiffness: float
    restitution: float = 1.0
    adhesion: Adhesion = "allow"
    approach_floor: float = 0.0
    factor: str = "paper"
    exponent: float | None = field(
        default=None, metadata=parameter("power", "", "for the law power: n in F = k x^n", least=1, most=10)
    )
    parameters: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        # ``exponent`` is then the power of every shipped law, not only of the one that takes it as a parameter.
        if self.law in ONSET_EXPONENTS:
            object.__setattr__(self, "exponent", ONSET_EXPONENTS[self.law])

    def __str__(self) -> str:
        if self.is_rigid:
            return f"{self.law}, restitution {self.restitution:g}"
        about = f"restitution {self.restitution:g}, effective {self.effective_restitution:.3f}"
        if self.factor != "paper":
            about += f" ({self.factor})"
        return f"{self.law}, {self.stiffness:.6g} N/m^{self.onset_exponent:g}, {about}"

    @property
    def onset_exponent(self) -> float:
        """The power of the indentation with which the force begins.

        Raises KeyError for a law that does not exist, ValueError for the law ``power`` without an ``exponent``.
        """
        registered = registered_law(self.law)
        if registered:
            return registered.onset_exponent
        if self.law != "power":
            return ONSET_EXPONENTS[self.law]
        if self.exponent is None:
            raise ValueError("the law power needs an exponent")
        return self.exponent

    @property
    def is_rigid(self) -> bool:
        """Whether the stop does not yield: it has impulses in place of a force of the indentation."""
        return self.law == RIGID

    @property
    def is_linear(self) -> bool:
        """Whether the force is proportional to the indentation; what a user's module registers counts as nonlinear."""
        return self.law in LAWS and self.onset_exponent == 1 and not self.is_rigid

    def elastic_force(self, x: ArrayLike) -> np.ndarray:
        """Return f (...) in N at indentations ``x`` (...) in m; zero for x <= 0."""
        x = np.maximum(x, 0.0)
        if self.law not in LAWS:
            return self._registered_values("force", x)
        return self.stiffness * x**self.onset_exponent

    def elastic_slope(self, x: ArrayLike) -> np.ndarray:
        """Return df/dx (...) in N/m at indentations ``x`` (...) in m; for x <= 0 that of a contact just closed."""
        x = np.maximum(x, 0.0)
        n = self.onset_exponent
        if self.law not in LAWS:
            return self._registered_values("slope", x)
        return n * self.stiffness * x ** (n - 1)

    def elastic_energy(self, x: ArrayLike) -> np.ndarray:
        """Return the integral of f (...) in J from 0 to indentations ``x`` (...) in m; zero for x <= 0."""
        x = np.maximum(x, 0.0)
        n = self.onset_exponent
        if self.law not in LAWS:
            return self._registered_values("energy", x)
        return self.stiffness * x ** (n + 1) / (n + 1)

    def _registered_values(self, name: str, x: np.ndarray) -> np.ndarray:
        """Return force, slope or energy, by ``name``, of a law that a user's module registers."""
        # Imported here: who reads a case needs no compiler.
        from vipetsc.lattice.registered_law import compiled_law, evaluate

        law = registered_law(self.law)
        if law is None:
            raise KeyError(f"no law {self.law!r}; the module that registers it is not imported")
        return evaluate(getattr(compiled_law(law), name), self.stiffness, self.parameters, x)

    @property
    def duration_factor(self) -> float:
        """Duration of an impact without loss over depth/speed (Johnson 1985, sec. 11.4); 0 if f is no power of x."""
        if self.law not in LAWS:
            return 0.0
        n = self.onset_exponent
        # Integral of dx / sqrt(1 - x^(n+1)) over [0, 1]: pi/2 for n = 1, 1.4716 for n = 3/2.
        gamma = scipy.special.gamma
        integral = np.sqrt(np.pi) * gamma(1 / (n + 1)) / ((n + 1) * gamma(0.5 + 1 / (n + 1)))
        return float(2 * integral)

    def impact_depth(self, speed: float, reduced_mass: float) -> float:
        """Return the deepest indentation in m of two masses that meet at ``speed`` in m/s, without loss.

        ``reduced_mass`` in kg is m_host m_resonator / (m_host + m_resonator).
        """
        if self.is_rigid:
            return 0.0
        energy = 0.5 * reduced_mass * speed**2
        if self.duration_factor:
            n = self.onset_exponent
            return float((n + 1) * energy / self.stiffness) ** (1 / (n + 1))

        x = SHALLOWEST
        while self.elastic_energy(x) < energy:
            x *= 2
        # From beyond the root Newton's method comes down to it without a bracket: the energy is convex.
        step = x
        while step > 1e-14 * x:
            step = float((self.elastic_energy(x) - energy) / self.elastic_force(x))
            x -= step
        return x

    def impact_time(self, speed: float, reduced_mass: float) -> float:
        """Return the duration in s of an impact without loss, as in ``impact_depth``: the integral of 2 dx/x'."""
        depth = self.impact_depth(speed, reduced_mass)
        # The impact of a rigid stop has no depth, and takes no time.
        if self.duration_factor:
            return self.duration_factor * depth / speed

        # x = depth sin(phase) takes the root out of the integrand, which is smooth then: midpoints do.
        phase = (np.arange(PHASES) + 0.5) * (np.pi / 2 / PHASES)
        kinetic = 0.5 * reduced_mass * speed**2 - self.elastic_energy(depth * np.sin(phase))
        slowness = np.sqrt(0.5 * reduced_mass / kinetic)
        return float(2 * np.sum(depth * np.cos(phase) * slowness) * (np.pi / 2 / PHASES))

    @property
    def damping(self) -> float:
        """The damping c in g = 1 + c w'/w'_minus, by the name in ``factor``.

        3 (1 - r)/2, the paper's: Hunt and Crossley, J. Appl. Mech. 42 (1975) 440. 3 (1 - r^2)/4: Lankarani and
        Nikravesh, J. Mech. Des. 112 (1990) 369. 8 (1 - r)/(5 r): Flores, Machado, Silva and Martins, Multibody Syst.
        Dyn. 25 (2011) 357. ``exact``: the one whose impact has the restitution r.
        """
        e = self.restitution
        if self.is_rigid:
            return 0.0
        registered = registered_factor(self.factor)
        if registered:
            return float(registered.function(e))
        if self.factor == "lankarani-nikravesh":
            return 0.75 * (1 - e**2)
        if self.factor == "flores":
            return 1.6 * (1 - e) / e
        # Close to e = 1 the terms of ``rebound`` cancel, and both dampings are the same to 1e-12.
        if self.factor != "exact" or e > 1 - 1e-6:
            return 1.5 * (1 - e)
        # To first order in c the root is 3 (1 - e^2)/(2 (1 + e^3)). It is above half of that, and below 1/e, where the
        # logarithm diverges.
        return float(scipy.optimize.brentq(rebound, 0.75 * (1 - e**2) / (1 + e**3), (1 - 1e-12) / e, (e,)))

    @property
    def effective_restitution(self) -> float:
        """-w'_plus/w'_minus of two masses that nothing but the contact acts on, above the ``approach_floor``."""
        if self.is_rigid:
            return self.restitution
        c = self.damping
        # Near c = 0 the terms of ``rebound`` cancel: its expansion takes their place.
        if c < 1e-6:
            return 1 - 2 * c / 3
        most = min(1.0, (1 - 1e-12) / c)
        # With strong damping the masses part at the speed at which g vanishes, e = 1/c, to all digits sought.
        if rebound(c, most) > 0:
            return most
        return float(scipy.optimize.brentq(lambda e: rebound(c, e), 0.0, most))

    def dissipation_factor(self, rate: ArrayLike, approach: ArrayLike) -> np.ndarray:
        """Return g = 1 + c w'/w'_minus of relative and approach velocities (...) in m/s, with the ``damping`` c.

        The paper prints a minus sign, which feeds energy in; Hunt and Crossley's law has a plus.
        """
        approach = np.asarray(approach, float)
        floored = np.copysign(np.maximum(np.abs(approach), self.approach_floor), approach)
        g = 1 + self.damping * np.asarray(rate, float) / floored
        return np.maximum(g, 0) if self.adhesion == "clip" else g


PARAMETERS: Mapping[str, LawParameter] = {
    item.name: item.metadata["parameter"] for item in fields(Contact) if "parameter" in item.metadata
}
"""The parameters of elastic laws, by the names of their fields of ``Contact``, which are their keys in case files."""

reserve(LAW, LAWS)
reserve(DISSIPATION, DAMPINGS)
