"""A conservative system of masses, springs and contact pairs, with any number of degrees of freedom."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import eigh

from vipetsc.case.nnm import NnmCase
from vipetsc.lattice import Chain, Contact, Spring, UnitCell, contacts, nonlinear_springs, spring_laws
from vipetsc.lattice.cell import nonlinear_energy, nonlinear_force
from vipetsc.modes.stops import Stops

# A contact does not move in a mode if its relative displacement is below this fraction of the mode's largest one: a
# symmetry that keeps it at rest holds to rounding only.
LEAST_REACH = 1e-10


@dataclass(frozen=True)
class ContactPair:
    """Contact between two masses (0-based), with a stop on either side of w = u_resonator - u_host.

    ``host`` is None for a contact with the ground, where w = u_resonator. The stops are at w = ``clearance`` and at
    w = -``clearance_minus`` in m, which is the same distance if it is None. On a side without a stop the clearance is
    inf. A contact that is pressed at rest has a negative clearance on its only side; a static load balances its force.
    """

    host: int | None
    resonator: int
    clearance: float
    law: Contact
    clearance_minus: float | None = None

    @property
    def stops(self) -> Stops:
        """The law and the clearances on both sides."""
        minus = self.clearance if self.clearance_minus is None else self.clearance_minus
        return Stops(self.law, self.clearance, minus)


class SmoothSpring(NamedTuple):
    """A nonlinear spring between two masses (0-based), of elongation z = u_end - u_start; ``start`` None is the ground.

    The ``law`` is a spring of a cell, whose own ``start`` and ``end`` have no meaning here. The part k z belongs to the
    stiffness matrix of the system.
    """

    start: int | None
    end: int
    law: Spring

    @classmethod
    def between(cls, start: int | None, end: int, quadratic: float = 0.0, cubic: float = 0.0) -> Self:
        """Return a spring with the force ``quadratic`` z^2 + ``cubic`` z^3 in N/m^2 and N/m^3."""
        return cls(start, end, Spring(0, 1, stiffness=0.0, quadratic=quadratic, cubic=cubic))


@dataclass(frozen=True, eq=False)
class System:
    """M u'' + K u + contact forces + smooth spring forces = 0, u from the state at rest.

    ``masses`` (n,) in kg, ``stiffness`` (n, n) in N/m, symmetric. Raises ValueError if a mass is not positive, the
    stiffness is not symmetric, an index lies outside the system, a contact touches at rest (no motion about that is
    linear, however small), or a contact dissipates: normal modes exist in conservative systems.
    """

    masses: np.ndarray
    stiffness: np.ndarray
    contacts: tuple[ContactPair, ...] = ()
    springs: tuple[SmoothSpring, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.masses)
        if not (np.all(np.isfinite(self.masses)) and np.all(np.asarray(self.masses) > 0)):
            raise ValueError(f"masses {self.masses!r} must be positive (kg)")
        if self.stiffness.shape != (n, n) or not np.allclose(self.stiffness, self.stiffness.T, rtol=1e-12):
            raise ValueError(f"the stiffness must be a symmetric matrix of shape ({n}, {n})")

        for pair in self.contacts:
            if pair.stops.clearance == 0:
                raise ValueError("clearance 0.0 must be positive (m), or negative of a contact that is pressed at rest")
            if pair.stops.is_pressed and pair.law.is_rigid:
                raise ValueError("a rigid stop has no indentation, and is not pressed at rest")
            if pair.stops.is_pressed and max(pair.stops.plus, pair.stops.minus) < np.inf:
                raise ValueError(
                    f"clearance {pair.stops.clearance!r} is that of a contact pressed at rest, which has one stop"
                )
            if pair.law.restitution != 1:
                raise ValueError(
                    f"restitution {pair.law.restitution!r} dissipates; nonlinear normal modes need restitution = 1"
                )

        ends = [(p.host, p.resonator) for p in self.contacts] + [(s.start, s.end) for s in self.springs]
        for start, end in ends:
            if start == end or not all(i is None or 0 <= i < n for i in (start, end)):
                raise ValueError(f"({start}, {end}) is not a pair of the system's {n} masses")

    @classmethod
    def assemble(
        cls,
        masses: Iterable[float],
        springs: Iterable[tuple[int | None, int, float]],
        contacts: Iterable[ContactPair] = (),
        smooth: Iterable[SmoothSpring] = (),
    ) -> Self:
        """Return a system from linear springs (start, end, stiffness in N/m); start None is the ground."""
        masses = np.asarray(list(masses), float)
        stiffness = np.zeros((len(masses), len(masses)))
        for start, end, k in springs:
            (row,) = elongation_rows([(start, end)], len(masses))
            stiffness += k * np.outer(row, row)
        return cls(masses, stiffness, tuple(contacts), tuple(smooth))

    @classmethod
    def from_case(cls, case: NnmCase) -> Self:
        """Return the system of a case: masses and springs, the reduced model of the lattice's cell, or the lattice."""
        stops = elastic_stops(case)
        table = case.nnm.custom
        if case.nnm.system == "chain":
            return cls.from_chain(case.chain(), stops)
        if table is None:
            return cls.reduced(case.lattice.unit_cell(), *stops)

        mass = [None, *range(len(table.masses))]  # the table counts them from 1, and 0 is the ground
        smooth = table.smooth
        pairs = zip(table.contacts, stops, strict=True)
        return cls.assemble(
            masses=table.masses,
            springs=[(mass[s.start], s.end - 1, s.stiffness) for s in table.springs],
            contacts=[contact_pair(mass[p.host], p.resonator - 1, of_pair) for p, of_pair in pairs],
            smooth=[SmoothSpring.between(mass[s.start], s.end - 1, s.quadratic, s.cubic) for s in smooth],
        )

    @classmethod
    def from_chain(cls, chain: Chain, stops: Sequence[Stops]) -> Self:
        """Return the finite lattice ``chain`` with the ``stops`` of its sites as one system, without its dashpots."""
        pairs = []
        for (host, resonator), of_site in zip(contacts(chain).mass_pairs(), stops, strict=True):
            pairs.append(contact_pair(None if host < 0 else host, resonator, of_site))

        return cls(
            masses=chain.masses(),
            stiffness=chain.stiffness_matrix().toarray(),
            contacts=tuple(pairs),
            springs=tuple(_nonlinear_springs(chain)),
        )

    @classmethod
    def reduced(cls, cell: UnitCell, stops: Stops) -> Self:
        """Return the paper's 2-DoF model of a cell's contact pair (Sec. IV); masses are (host, resonator).

        A spring from the host to another mass of the lattice is divided between the two: fixed at its middle, the
        host's half has twice the stiffness. The paper takes half of the total of these, so that the host is tied to the
        ground by the sum of the springs' own stiffnesses. The same holds for the resonator.
        """
        ground = {cell.host: 0.0, cell.resonator: 0.0}
        between = 0.0
        for mass, offset, other, stiffness, *_ in cell.couplings():
            if offset == 0 and {mass, other} == set(ground):
                between += stiffness / 2  # couplings lists every spring from both ends
            elif mass in ground:
                ground[mass] += 2 * stiffness / 2
        springs = [(None, 0, ground[cell.host]), (0, 1, between), (None, 1, ground[cell.resonator])]
        masses = (cell.masses[cell.host], cell.masses[cell.resonator])
        return cls.assemble(masses, springs, (contact_pair(0, 1, stops),))

    @property
    def dofs(self) -> int:
        """Number of degrees of freedom."""
        return len(self.masses)

    @cached_property
    def contact_rows(self) -> np.ndarray:
        """Rows (contacts, n) with w = rows @ u."""
        return elongation_rows([(p.host, p.resonator) for p in self.contacts], self.dofs)

    @cached_property
    def spring_rows(self) -> np.ndarray:
        """Rows (springs, n) with the smooth springs' elongations z = rows @ u."""
        return elongation_rows([(s.start, s.end) for s in self.springs], self.dofs)

    @cached_property
    def clearances(self) -> np.ndarray:
        """Clearances (contacts, 2) in m on the sides + and -; inf where there is no stop."""
        return np.array([(p.stops.plus, p.stops.minus) for p in self.contacts]).reshape(-1, 2)

    @cached_property
    def is_pressed(self) -> np.ndarray:
        """Mask (contacts,) of the contacts that are pressed at rest."""
        return np.array([pair.stops.is_pressed for pair in self.contacts], bool)

    @cached_property
    def is_rigid(self) -> np.ndarray:
        """Mask (contacts,) of the contacts whose stops do not yield."""
        return np.array([pair.law.is_rigid for pair in self.contacts], bool)

    @property
    def has_rigid_stops(self) -> bool:
        """Whether any contact has stops that do not yield."""
        return bool(self.is_rigid.any())

    @property
    def is_linear_at_rest(self) -> bool:
        """Whether motions about rest are linear up to where contacts open or close."""
        return not self.springs and all(pair.stops.is_linear_at_rest for pair in self.contacts)

    def sides_at(self, w: np.ndarray) -> np.ndarray:
        """Return the sides (..., contacts), 1 or -1, whose stops are the nearest ones at relative displacements ``w``.

        A contact that is pressed at rest has one side, on which it opens.
        """
        plus, minus = self.clearances.T
        return np.where(self.is_pressed, np.where(plus < minus, 1, -1), np.where(w < 0, -1, 1))

    def clearances_at(self, w: np.ndarray) -> np.ndarray:
        """Return clearances (..., contacts) in m on the sides of the relative displacements ``w`` (..., contacts)."""
        plus, minus = self.clearances.T
        return np.where(self.sides_at(w) < 0, minus, plus)

    @property
    def odd(self) -> bool:
        """Whether all forces change sign with the displacement."""
        plus, minus = self.clearances.T
        return np.array_equal(plus, minus) and all(s.law.is_odd for s in self.springs)

    @cached_property
    def stiffness_at_rest(self) -> np.ndarray:
        """Stiffness (n, n) in N/m for small motions, with the slope of each contact that is pressed at rest."""
        if not self.is_pressed.any():
            return self.stiffness
        slopes = np.array([pair.stops.slope_at_rest for pair in self.contacts])
        return np.asarray(self.stiffness + self.contact_rows.T @ (slopes[:, None] * self.contact_rows))

    @cached_property
    def mean_motion(self) -> np.ndarray | None:
        """The matrix (n, n) that takes displacements to those of the centre of mass; None if anything holds the system.

        A system that nothing holds may begin a motion anywhere.
        """
        moved = np.ones(self.dofs)
        pulls = np.abs(self.stiffness_at_rest @ moved).max()
        is_held = pulls > 1e-12 * np.abs(self.stiffness_at_rest).max()
        if is_held or np.any(self.contact_rows @ moved) or np.any(self.spring_rows @ moved):
            return None
        return np.asarray(np.outer(moved, self.masses) / np.sum(self.masses))

    def linear_modes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return frequencies (n,) in rad/s, lowest first, and mass-normalised shapes (n, mode) about rest."""
        return self._small_motions

    @cached_property
    def _small_motions(self) -> tuple[np.ndarray, np.ndarray]:
        squared, shapes = eigh(self.stiffness_at_rest, np.diag(self.masses))
        # eigh leaves the signs open: the largest displacement of each mode is positive.
        signs = np.sign(shapes[np.abs(shapes).argmax(0), range(self.dofs)])
        # A rigid-body motion has an eigenvalue of zero, which rounding may make negative.
        return np.sqrt(np.maximum(squared, 0)), shapes * signs

    def moves(self, mode: int) -> np.ndarray:
        """Return the elongations (contacts + springs,) of contacts and smooth springs in a mass-normalised mode.

        They are 0 where a node of the mode leaves rounding alone.
        """
        shape = self.linear_modes()[1][:, mode]
        elongations = np.vstack([self.contact_rows, self.spring_rows]) @ shape
        return np.where(np.abs(elongations) > LEAST_REACH * np.abs(shape).max(), elongations, 0.0)

    def branch_name(self, mode: int) -> str:
        """Name of the branch of ``mode`` (0-based): in-phase or out-of-phase for two masses, else its number."""
        if self.dofs != 2:
            return f"mode-{mode + 1}"
        first, second = self.linear_modes()[1][:, mode]
        if first * second > 0:
            return "in-phase"
        return "out-of-phase"

    def gaps(self, u: np.ndarray) -> np.ndarray:
        """Return how far contacts are beyond their stops in m at displacements ``u`` (..., n): (..., contacts)."""
        w = u @ self.contact_rows.T
        return self.sides_at(w) * w - self.clearances_at(w)

    def forces(self, u: np.ndarray) -> np.ndarray:
        """Return restoring forces (n,) in N at displacements ``u`` (n,) in m."""
        force = self.stiffness @ u
        for row, pair in zip(self.contact_rows, self.contacts, strict=True):
            force = force + row * pair.stops.force(row @ u)
        for row, spring in zip(self.spring_rows, self.springs, strict=True):
            force = force + row * nonlinear_force(spring.law, row @ u)
        return force

    def energy(self, u: np.ndarray, v: np.ndarray) -> float:
        """Return the kinetic and potential energy in J at displacements ``u`` and velocities ``v`` (n,)."""
        total = 0.5 * (self.masses * v) @ v + 0.5 * u @ self.stiffness @ u
        for row, pair in zip(self.contact_rows, self.contacts, strict=True):
            total += pair.stops.energy(row @ u)
        for row, spring in zip(self.spring_rows, self.springs, strict=True):
            total += nonlinear_energy(spring.law, row @ u)
        return float(total)

    def grazing_energy(self, mode: int) -> float:
        """Return the energy in J at which linear mode ``mode`` (0-based) first closes or opens a contact, or inf."""
        omega, _ = self.linear_modes()
        reach = np.abs(self.moves(mode)[: len(self.contacts)])
        moves = reach > 0
        nearest = np.abs(self.clearances.min(axis=1))
        amplitude = (nearest[moves] / reach[moves]).min(initial=np.inf)
        if not np.isfinite(amplitude):  # times omega = 0 of a rigid-body motion it would be no number
            return np.inf
        return float(0.5 * omega[mode] ** 2 * amplitude**2)

    def nonlinear_energy(self, mode: int, fraction: float) -> float:
        """Return the energy in J at which smooth springs exert a ``fraction`` of the linear force in a mode, or inf.

        At the amplitude a of the mass-normalised shape the linear force is omega^2 a, and the springs exert
        sum_j |r_j| (|q_j| (r_j a)^2 + |c_j| |r_j a|^3), where r_j is the elongation of the spring in the shape.
        """
        omega, _ = self.linear_modes()
        reach = np.abs(self.moves(mode)[len(self.contacts) :])
        quadratic = sum(r**3 * abs(s.law.quadratic) for r, s in zip(reach, self.springs, strict=True))
        cubic = sum(r**4 * abs(s.law.cubic) for r, s in zip(reach, self.springs, strict=True))
        if not (quadratic or cubic):
            return np.inf
        # The positive root of cubic a^2 + quadratic a = fraction omega^2.
        allowed = fraction * omega[mode] ** 2
        amplitude = 2 * allowed / (quadratic + np.sqrt(quadratic**2 + 4 * cubic * allowed))
        return float(0.5 * omega[mode] ** 2 * amplitude**2)

    def closed_frequencies(self) -> np.ndarray:
        """Return frequencies (n,) in rad/s to which those of large motions tend if all contacts have the bilinear law.

        Each contact must have stops on both sides.
        """
        # Where |w| is much larger than the clearance, the clearance does not count: the contact is a spring.
        stiffness = self.stiffness.copy()
        for row, pair in zip(self.contact_rows, self.contacts, strict=True):
            stiffness += pair.law.stiffness * np.outer(row, row)
        return np.sqrt(eigh(stiffness, np.diag(self.masses), eigvals_only=True))


def elastic_stops(case: NnmCase) -> list[Stops]:
    """Return the stops of each contact of a case, and its law without dissipation."""
    return [Stops(law, plus, minus) for law, (plus, minus) in zip(case.elastic_laws(), case.gaps(), strict=True)]


def contact_pair(host: int | None, resonator: int, stops: Stops) -> ContactPair:
    """Return the contact of two masses (from 0; ``host`` None is the ground) with these ``stops``."""
    return ContactPair(host, resonator, stops.plus, stops.law, stops.minus)


def elongation_rows(ends: list[tuple[int | None, int]], dofs: int) -> np.ndarray:
    """Return rows (pairs, n) that turn displacements into the elongations u_end - u_start of pairs (start, end)."""
    rows = np.zeros((len(ends), dofs))
    for row, (start, end) in zip(rows, ends, strict=True):
        row[end] = 1.0
        if start is not None:
            row[start] = -1.0
    return rows


def _nonlinear_springs(chain: Chain) -> Iterator[SmoothSpring]:
    """Yield the springs of a lattice that have more than a linear part, those to its walls among them."""
    for (start, end), law in zip(nonlinear_springs(chain).mass_pairs(), spring_laws(chain), strict=True):
        if end >= 0:
            yield SmoothSpring(None if start < 0 else start, end, law)
        else:
            # From the last mass to the wall the elongation is -u: an even part of the force changes its sign.
            yield SmoothSpring(None, start, replace(law, quadratic=-law.quadratic))
