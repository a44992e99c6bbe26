"""The unit cell: masses, springs within it, to the next cell and to the ground, and the contact pair.

A Bloch wave has u_n = U exp(i kappa n) in cell n. A spring k from mass i of cell n to mass j of cell n + o then pulls
at i with k (U_i - U_j exp(i kappa o)), and such rows make up the Bloch stiffness K(kappa); dashpots make up C(kappa)
likewise. A spring to the ground pulls with k U_i. Every symmetric matrix is one of such springs, of which some have a
negative stiffness (``vipetsc.case.cell_matrices``).
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix

from vipetsc.lattice.sites import Pair

Reading = Literal["printed", "calibrated"]
GROUND = -1
"""The ``start`` of a spring to the ground, and the ``other`` mass of its coupling."""


@dataclass(frozen=True)
class Spring:
    """A spring between two masses (0-based) of one cell, from one cell to the next, or from the ground to a mass.

    Its force at the elongation z is k z + q z^2 + c z^3: ``stiffness`` k in N/m, ``quadratic`` q in N/m^2 and ``cubic``
    c in N/m^3, which bands and modes leave out. ``damping`` in N s/m is that of a dashpot parallel to it. It runs from
    mass ``start`` of a cell, or from the ground (``GROUND``), to mass ``end`` of the cell ``offset`` further, the same
    one (0) or the next one (1). A stiffness or a dashpot may be negative as long as the lattice is stable.
    """

    start: int
    end: int
    stiffness: float
    offset: int = 0
    damping: float = 0.0
    quadratic: float = 0.0
    cubic: float = 0.0

    @property
    def is_linear(self) -> bool:
        """Whether the force has no part beyond k z."""
        return not (self.quadratic or self.cubic)

    @property
    def is_odd(self) -> bool:
        """Whether the force at -z is minus that at z."""
        return self.quadratic == 0

    @property
    def without_force(self) -> float:
        """The smallest elongation in m, of either sign, at which k z + q z^2 + c z^3 vanishes; inf if there is none."""
        roots = np.roots([self.cubic, self.quadratic, self.stiffness])
        real = roots[np.isreal(roots)].real
        if not real.size:
            return np.inf
        return float(real[np.abs(real).argmin()])


# The formulas of a spring's force beyond k z, as NumPy executes them for a ``Spring``, and as ``dynamics.spring_law``
# compiles them for records with the same fields.
def nonlinear_force(law: Any, z: Any) -> Any:
    """Return the part of the force beyond k z in N, at elongations ``z`` (...) in m of a spring with a ``law``."""
    return z * z * (law.quadratic + law.cubic * z)


def nonlinear_slope(law: Any, z: Any) -> Any:
    """Return the derivative (...) in N/m of ``nonlinear_force`` by the elongation."""
    return (2.0 * law.quadratic + 3.0 * law.cubic * z) * z


def nonlinear_energy(law: Any, z: Any) -> Any:
    """Return the integral (...) in J of ``nonlinear_force`` from 0 to the elongation."""
    return z * z * z * (law.quadratic / 3.0 + 0.25 * law.cubic * z)


class Coupling(NamedTuple):
    """A spring as one of its masses sees it: from ``mass`` of a cell to ``other``, which is ``offset`` cells further.

    ``other`` is ``GROUND`` for a spring to the ground.
    ``stiffness`` in N/m and ``damping`` in N s/m are the spring's, ``spring`` is its number in the cell (from 0).
    ``sign`` is 1 where ``mass`` is the spring's start and -1 where it is its end: the elongation is ``sign`` times the
    displacement of the other mass less that of this one.
    """

    mass: int
    offset: int
    other: int
    stiffness: float
    damping: float
    spring: int
    sign: int


@dataclass(frozen=True)
class UnitCell:
    """Masses in kg, springs in N/m, and the contact pair; mass indices are 0-based.

    ``grounding``: dashpots in N s/m from each mass to ground; () where there are none. Raises ValueError with all of
    ``cell_problems``.
    """

    masses: tuple[float, ...]
    springs: tuple[Spring, ...]
    host: int
    resonator: int
    grounding: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        problems = cell_problems(self.masses, self.springs, self.host, self.resonator, self.grounding)
        if problems:
            raise ValueError("; ".join(message for _, message in problems))

    @property
    def dofs(self) -> int:
        """Number of masses in the cell."""
        return len(self.masses)

    @property
    def pair(self) -> Pair:
        """The contact pair."""
        return Pair(self.host, self.resonator)

    @property
    def reduced_mass(self) -> float:
        """Mass in kg of the contact pair's relative motion, 1/(1/m_host + 1/m_resonator)."""
        return 1 / (1 / self.masses[self.host] + 1 / self.masses[self.resonator])

    @property
    def joins_cells(self) -> bool:
        """Whether a spring runs to the next cell, so that linear waves travel through a lattice of such cells.

        Other cells, with springs within them or with none, are joined by contacts alone, as grains are.
        """
        return any(spring.offset for spring in self.springs)

    @property
    def is_grounded(self) -> bool:
        """Whether a spring ties a mass to the ground."""
        return any(spring.start == GROUND for spring in self.springs)

    @property
    def is_damped(self) -> bool:
        """Whether there is a dashpot."""
        return any(self.grounding) or any(spring.damping for spring in self.springs)

    @property
    def is_linear(self) -> bool:
        """Whether no spring has a quadratic or a cubic part."""
        return all(spring.is_linear for spring in self.springs)

    def couplings(self) -> list[Coupling]:
        """Return every spring seen from both its ends; one to the ground has one.

        Sorted by mass and otherwise in the order of ``springs``, which fixes the order of every sum.
        """
        ends = []
        for i, s in enumerate(self.springs):
            for sign, mass, other in ((1, s.start, s.end), (-1, s.end, s.start)):
                if mass == GROUND:
                    continue
                coupling = Coupling(
                    mass=mass,
                    offset=sign * s.offset,
                    other=other,
                    stiffness=s.stiffness,
                    damping=s.damping,
                    spring=i,
                    sign=sign,
                )
                ends.append(coupling)
        # Stable: couplings of one mass stay in the order of the springs.
        return sorted(ends, key=lambda c: c.mass)

    def stiffness_matrix(self, kappa: ArrayLike) -> np.ndarray:
        """Return Bloch stiffness (..., dofs, dofs) in N/m at wavenumber ``kappa`` in rad per cell; Hermitian.

        It follows from the springs. The matrix that the paper prints, Eq. (S1), lacks the -1/2 in row 1, column 2.
        """
        return self._bloch(kappa, [c.stiffness for c in self.couplings()])

    def damping_matrix(self, kappa: ArrayLike) -> np.ndarray:
        """Return Bloch damping (..., dofs, dofs) in N s/m of all dashpots, as ``stiffness_matrix``."""
        grounding = np.diag(self.grounding or [0.0] * self.dofs)
        return self._bloch(kappa, [c.damping for c in self.couplings()]) + grounding

    def _bloch(self, kappa: ArrayLike, values: list[float]) -> np.ndarray:
        """Return the Bloch matrix (..., dofs, dofs) of the couplings' ``values``, at wavenumbers ``kappa`` (...)."""
        kappa = np.asarray(kappa, float)
        # Axes of the wavenumbers come last: at one wavenumber, as in a search, an entry is then a number, which takes
        # a fifth of the time of a view of one.
        k = np.zeros((self.dofs, self.dofs, *kappa.shape), complex)

        # Every spring is met from both its ends, and each time adds to the row of that end alone: u of the other end is
        # exp(i kappa offset) times u of the same mass in this cell.
        for (mass, offset, other, *_), value in zip(self.couplings(), values, strict=True):
            k[mass, mass] += value
            if other == GROUND:
                continue
            if offset:
                k[mass, other] -= value * np.exp(1j * kappa * offset)
            else:
                k[mass, other] -= value
        return np.ascontiguousarray(np.moveaxis(k, (0, 1), (-2, -1)))


def cell_problems(
    masses: tuple[float, ...], springs: tuple[Spring, ...], host: int, resonator: int, grounding: tuple[float, ...] = ()
) -> list[tuple[str, str]]:
    """Return all problems of a cell as (key, message) pairs; empty for a valid cell.

    Messages count masses from 1, as case files do.
    """
    # All of them, not the first: who writes a case file mends it once.
    n = len(masses)
    problems = []
    for i, m in enumerate(masses, 1):
        if not 0 < m < np.inf:
            problems.append((f"masses[{i}]", f"mass {m!r} must be positive (kg)"))
    for i, s in enumerate(springs, 1):
        problems += _spring_problems(s, f"springs[{i}]", n)
    for name, index in (("host", host), ("resonator", resonator)):
        if not 0 <= index < n:
            problems.append(("contact", f"{name} {index + 1} is not one of the cell's {n} masses"))
    problems += _dashpot_problems(grounding, n)

    # A cell of one mass has no pair of its own: its contacts are between cells or with ground, and name their masses.
    if host == resonator and n > 1:
        problems.append(("contact", "host and resonator must be two different masses"))
    return problems


def _spring_problems(spring: Spring, key: str, n: int) -> list[tuple[str, str]]:
    """Return all problems of a ``spring`` in a cell of ``n`` masses, as ``cell_problems``."""
    problems = []
    if not 0 < abs(spring.stiffness) < np.inf:
        problems.append((f"{key}.stiffness", f"stiffness {spring.stiffness!r} must not be zero (N/m)"))
    if not abs(spring.damping) < np.inf:
        problems.append((f"{key}.damping", f"damping {spring.damping!r} must be a number (N s/m)"))
    if not (0 <= spring.start < n or spring.start == GROUND):
        problems.append((key, f"mass {spring.start + 1} is not one of the cell's {n}, nor 0, the ground"))
    if not 0 <= spring.end < n:
        problems.append((key, f"mass {spring.end + 1} is not one of the cell's {n}; the ground, 0, is a start"))
    if spring.offset not in (0, 1):
        problems.append((key, f"offset {spring.offset!r} must be 0 (the same cell) or 1 (the next one)"))
    if spring.start == GROUND and spring.offset:
        problems.append((f"{key}.next_cell", "the ground, start = 0, is in no cell; remove it"))
    if spring.start == spring.end and not spring.offset:
        problems.append((key, f"joins mass {spring.start + 1} to itself; did you mean next_cell = true?"))
    return problems


def _dashpot_problems(grounding: tuple[float, ...], n: int) -> list[tuple[str, str]]:
    """Return all problems of the dashpots to ground in a cell of ``n`` masses, as ``cell_problems``."""
    problems = []
    if len(grounding) not in (0, n):
        problems.append(("grounding", f"give one dashpot for each of the {n} masses, 0 for none"))
    for i, c in enumerate(grounding, 1):
        if not abs(c) < np.inf:
            problems.append((f"grounding[{i}]", f"damping {c!r} must be a number (N s/m)"))
    return problems


@lru_cache
def connected_groups(n: int, pairs: tuple[tuple[int, int], ...]) -> list[int]:
    """Return group (from 0) of each of ``n`` nodes, in their order; ``pairs`` are the nodes (0-based) tied together."""
    # Asked once for each kind of cell: sweeps and searches have thousands of one kind.
    graph = coo_matrix((np.ones(len(pairs)), np.transpose(pairs)), (n, n))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1].tolist()


def diatomic(reading: Reading = "printed") -> UnitCell:
    """Return the paper's diatomic cell (Table I): a host with a resonator inside it.

    The calibrated reading divides both stiffnesses by ten, which brings the onset of contact to the
    amplitudes that the paper reports (0.58 N instead of 5.3 N).
    """
    # Both springs alike: all frequencies scale together, and the bands keep their shape.
    k = {"printed": 9e4, "calibrated": 9e3}[reading]
    springs = (Spring(0, 0, k, offset=1), Spring(0, 1, k))
    return UnitCell(masses=(0.01, 0.08), springs=springs, host=0, resonator=1)


def four_band(reading: Reading = "printed", lam: float = 0.1, eta: float = 0.5) -> UnitCell:
    """Return the paper's four-band cell, Eq. (7), in its Hermitian reading.

    Springs, with masses counted from 1: k = 2e4 N/m from u4 to u1 of the next cell, k2 = 1e4 N/m from u1 to u2 and from
    u2 to u4, and from the host u2 to the resonator u3 one that ``lam`` sets: lam k = 2000 N/m in the printed reading,
    lam k2 = 1000 N/m in the calibrated one, which gives the paper's transfer of 0.30 to 0.35. ``eta`` is the
    resonator's part of the mass of host and resonator together.
    """
    m = 0.005
    k = 2e4
    k2 = 1e4
    k3 = lam * {"printed": k, "calibrated": k2}[reading]
    # eta divides one mass m into the host's and the resonator's part: the cell weighs the same for every eta.
    springs = (Spring(3, 0, k, offset=1), Spring(0, 1, k2), Spring(1, 3, k2), Spring(1, 2, k3))
    return UnitCell(masses=(m, m * (1 - eta), m * eta, m), springs=springs, host=1, resonator=2)
