"""Branches of conservative motions by harmonic balance, and the states of the lattice that belong to them."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np

from vipetsc.case import NnmCase
from vipetsc.case.nfrc import needs_modes
from vipetsc.case.nnm import NnmTable
from vipetsc.io.branch_kinds import BALANCE
from vipetsc.io.netcdf import Variables
from vipetsc.lattice import Chain, DenseCompliance, WaveCompliance, wave_bands
from vipetsc.modes.balance.conservative import ConservativeMotions
from vipetsc.modes.balance.free_motions import forces_of_system
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.files import stored_states
from vipetsc.modes.branches.losses import dissipation_of, with_loss
from vipetsc.modes.branches.orbits import NnmMethod, guarded_steps, map_of
from vipetsc.modes.continuation.arclength import StepRule
from vipetsc.modes.flow import Dop853Flow
from vipetsc.modes.point import Point
from vipetsc.modes.problem import FlowError, PeriodicProblem
from vipetsc.modes.shooting import Shooting
from vipetsc.modes.stability import Hill
from vipetsc.modes.system import System, elastic_stops
from vipetsc.parallel import StopRequest
from vipetsc.wording import distinct

# Displacements below this fraction of the largest one are rounding, and left out.
NEGLIGIBLE = 1e-16
# Displacements are computed up to this distance from a site, in cells, which is doubled until they are negligible
# there, up to the last value: close to a band edge a breather decays slowly.
FIRST_REACH = 8
LAST_REACH = 2048
# Places up to which Hill's determinant gives the largest multiplier. Its matrix has the harmonics of all of them, and
# hundreds of determinants cost more than the sensitivities of one orbit of all masses.
MOST_OF_HILL = 4


def condensed_system(system: System, options: NnmTable) -> ConservativeMotions:
    """Return the motions of a ``system`` condensed onto its contacts and springs."""
    rows = np.vstack([system.contact_rows, system.spring_rows])
    compliance = DenseCompliance(system.masses, system.stiffness_at_rest, rows)
    return ConservativeMotions(compliance, forces_of_system(system), options)


def _condensed_lattice(case: NnmCase, chain: Chain) -> ConservativeMotions:
    """Return the motions of the lattice ``chain`` of a case condensed onto its sites."""
    stops = elastic_stops(case)
    if needs_modes(chain):
        # Bloch waves are those of equal cells with contacts of the cell's pair: other lattices have all modes.
        return condensed_system(System.from_chain(chain, stops), case.nnm)
    return ConservativeMotions(WaveCompliance(chain), SiteForces(stops), case.nnm)


class BalanceMethod(NnmMethod):
    """Branches of ``ConservativeMotions``."""

    kind = BALANCE

    def __init__(self, case: NnmCase) -> None:
        super().__init__(case)
        # A lattice between its sites, or a system whose linear modes begin branches. ``dofs`` are the masses of a cell,
        # all masses in a system of one's own.
        self.chain: Chain | None = None
        self.system = None
        if case.nnm.system == "condensed":
            self.chain = case.chain()
            self.motions = _condensed_lattice(case, self.chain)
            self.dofs = self.chain.cell.dofs
        else:
            self.system = System.from_case(case)
            self.motions = condensed_system(self.system, case.nnm)
            self.dofs = self.system.dofs
            if case.nnm.system == "chain":
                self.dofs = case.lattice.unit_cell().dofs
        self.unknowns = self.motions.forces.pairs
        self.dissipation = dissipation_of(case)

    def name(self, job: int) -> str:
        """Return the name of the branch of a mode, or of a start frequency."""
        if self.system is None or self.options.start_frequency:
            return f"breather-{distinct(self.options.start_frequency)[job]}"
        return super().name(job)

    def problem(self, job: int) -> ConservativeMotions:
        """Return the equations of the case."""
        return self.motions

    def start(self, problem: PeriodicProblem[Point], job: int, stop: StopRequest | None = None) -> Point:
        """Return motion of a linear mode at a small energy, or of a start frequency with contact at the start sites."""
        if self.system is not None and not self.options.start_frequency:
            omega = float(self.system.linear_modes()[0][job])
            amplitude = np.sqrt(2 * self.energy_of_mode(job)) / omega
            return self.motions.from_mode(self.system.moves(job) * amplitude, omega)
        signs = np.zeros(self.motions.forces.pairs)
        numbers = self.options.start_sites or [1]
        signs[np.abs(numbers) - 1] = np.sign(numbers)
        return self.motions.in_gap(self.options.start_frequency[job], signs)

    def rule(self, problem: PeriodicProblem[Point], start: Point, done: int) -> StepRule[Point]:
        """Return guarded steps; a branch that begins in a gap ends where it leaves it."""
        options = self.options
        if self.chain is not None:
            omega = 2 * np.pi / start.period
            bands = wave_bands(self.chain.cell)
            # In a band the breather radiates; a gap has no end above the highest band and begins at 0 below the lowest.
            low = max((band.high for band in bands if band.high < omega), default=0.0)
            high = min((band.low for band in bands if band.low > omega), default=np.inf)
            bounds = [max(low, options.frequency[0]), min(high, options.frequency[1])]
            options = options.model_copy(update={"frequency": bounds})
        return guarded_steps(problem, options, done)

    def assess(self, problem: PeriodicProblem[Point], point: Point) -> Point:
        """Return the point with its largest multiplier, and its loss if anything dissipates."""
        largest = self._largest_multiplier(point)
        if self.dissipation.acts:
            point = self._with_loss(point)
        return replace(point, multiplier=largest)

    def _with_loss(self, point: Point) -> Point:
        """Return the point with its loss and the force that makes up for it."""
        motions = self.motions
        dissipation = self.dissipation
        balance = motions.balance(point.order)
        contacts = motions.forces.contacts
        count = max(dissipation.damping.shape[0], (dissipation.forced or 0) + 1)
        masses = zip(balance.orders.tolist(), _all_masses(motions, point, self.dofs, count), strict=True)
        return with_loss(point, dissipation, contacts, balance.unpack(point.x)[: len(contacts)], masses)

    def _largest_multiplier(self, point: Point) -> float:
        """Return largest multiplier by Hill's method, or by the orbit's sensitivities; NaN where it is not found."""
        motions = self.motions
        omega = 2 * np.pi / point.period
        has_all_modes = isinstance(motions.compliance, DenseCompliance)
        if motions.forces.pairs <= MOST_OF_HILL or not has_all_modes:
            hill = Hill(motions.compliance, omega, point.order, motions.forces.odd, finite=True)
            fastest = hill.fastest(motions.balance(point.order).series(point.x, omega))
            if fastest is not None:
                return float(np.exp(2 * np.pi * fastest.real))
            if not has_all_modes:
                return np.nan

        u = np.concatenate(list(state_of(motions, point, self.dofs).values()))
        try:
            _, largest = self._orbits.stability(self._orbits.arc(u, point.period))
        except FlowError:
            return np.nan
        return largest

    @cached_property
    def _orbits(self) -> Shooting:
        """Orbits of all masses, with their sensitivities."""
        system = self.system or System.from_chain(self.case.chain(), elastic_stops(self.case))
        return Shooting(Dop853Flow(system), map_of(system))

    def finish(self, problem: PeriodicProblem[Point], branch: Branch[Point]) -> None:
        """Add the states at phase 0 of the first and the last point, and of those asked for."""
        points = [branch.points[0], *self.asked(problem, branch), branch.regular()[-1]]
        branch.extra = states(self.motions, points, self.dofs)


def states(motions: ConservativeMotions, points: list[Point], dofs: int) -> Variables:
    """Return displacements at phase 0, where all is at rest, as variables of the branch's file.

    They are those of the cells in which one of the ``points`` has displacements that are not negligible.
    """
    fields = [state_of(motions, point, dofs) for point in points]
    cells = sorted(set().union(*fields))
    u = np.zeros((len(points), len(cells), dofs))
    for of_point, field in zip(u, fields, strict=True):
        for place, cell in enumerate(cells):
            if cell in field:
                of_point[place] = field[cell]
    return stored_states(points, cells, u)


def state_of(motions: ConservativeMotions, point: Point, dofs: int) -> dict[int, np.ndarray]:
    """Return the displacement (dofs,) in m at phase 0 of every cell (from 0) in which it is not negligible."""
    if isinstance(motions.compliance, DenseCompliance):
        u = np.sum(_system_harmonics(motions, motions.compliance, point), axis=0)
        return dict(enumerate(u.reshape(-1, dofs)))
    total: dict[int, np.ndarray] = {}
    for field in _fields(motions, point):
        for cell, u in field.items():
            total[cell] = total.get(cell, 0.0) + u
    largest = max(np.abs(u).max() for u in total.values())
    return {cell: u for cell, u in total.items() if np.abs(u).max() > NEGLIGIBLE * largest}


def _fields(motions: ConservativeMotions, point: Point) -> Iterator[dict[int, np.ndarray]]:
    """Yield displacements of the cells near the sites, for each harmonic of a motion in turn."""
    assert isinstance(motions.compliance, WaveCompliance)
    omega = 2 * np.pi / point.period
    balance = motions.balance(point.order)
    forces = balance.series(point.x, omega).forces.real
    for k in balance.orders:
        yield _field(motions.compliance, k * omega, forces[:, k])


def _all_masses(motions: ConservativeMotions, point: Point, dofs: int, count: int) -> Iterator[np.ndarray]:
    """Yield the displacement (masses,) in m of at least the first ``count`` masses, for each harmonic of a motion."""
    if isinstance(motions.compliance, DenseCompliance):
        yield from _system_harmonics(motions, motions.compliance, point)
        return
    for field in _fields(motions, point):
        u = np.zeros(count)
        for cell, of_cell in field.items():
            here = u[cell * dofs : (cell + 1) * dofs]
            here[:] = of_cell[: len(here)]
        yield u


def _system_harmonics(motions: ConservativeMotions, compliance: DenseCompliance, point: Point) -> np.ndarray:
    """Return harmonics (order, dofs) in m of a system's displacements, by its linear modes with the added springs."""
    omega = 2 * np.pi / point.period
    balance = motions.balance(point.order)
    shift = balance.shift(omega)
    force = balance.shifted_force(point.x, omega, shift)
    dynamic = compliance.dynamic_stiffness(balance.orders * omega, shift[:, 0, 0])
    modal = np.linalg.solve(dynamic, compliance.parts.T @ force.real)
    return np.asarray(-(compliance.vectors @ modal)[..., 0])


def _field(compliance: WaveCompliance, omega: float, forces: np.ndarray) -> dict[int, np.ndarray]:
    """Return displacement of the cells near the sites that ``forces`` (pairs,) move, as far as it is not negligible."""
    chain = compliance.chain
    reach = FIRST_REACH
    while True:
        near = _cells_near(chain, reach)
        u = compliance.field(omega, forces, near).real
        size = np.abs(u).max(axis=1)
        # The cells at the full distance: while one of them moves, cells beyond may move, too.
        rim = np.min(np.abs(np.subtract.outer(near, chain.sites.cells)), axis=1) == reach
        if reach >= LAST_REACH or not rim.any() or size[rim].max() <= NEGLIGIBLE * size.max():
            return dict(zip(near.tolist(), u, strict=True))
        reach *= 2


def _cells_near(chain: Chain, reach: int) -> np.ndarray:
    """Return numbers of the cells within ``reach`` cells of a site."""
    near = np.unique(np.add.outer(chain.sites.cells, np.arange(-reach, reach + 1)))
    # On a ring the cells on both sides of a site may meet, and are then counted once.
    if chain.ends == "periodic":
        return np.unique(near % chain.cells)
    return near[(near >= 0) & (near < chain.cells)]
