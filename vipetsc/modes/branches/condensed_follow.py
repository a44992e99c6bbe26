"""Branches of condensed motions of a case: their starts, their files with harmonics and states of the lattice."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from vipetsc.case.nnm import NnmTable
from vipetsc.case.resolve import build_chain
from vipetsc.io.netcdf import Variables, open_netcdf, variable
from vipetsc.lattice import DenseCompliance, WaveCompliance, pass_bands
from vipetsc.lattice.moments import SeriesCompliance
from vipetsc.modes.balance.breather import CondensedContinuation, CondensedPoint, CondensedProblem, CondensedSegment
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.balance.hill import Hill
from vipetsc.modes.branches.branch import KINDS, Branch, with_multipliers
from vipetsc.modes.branches.follow import FAILURES, Follower
from vipetsc.modes.lattice.floquet import judge
from vipetsc.modes.lattice.lattice_flow import LatticeFlow
from vipetsc.modes.point import QUANTITIES, Point
from vipetsc.modes.system import System
from vipetsc.parallel import StoppedError

# A field is left out below this share of its largest value; a harmonic's is followed so many cells from a site.
NEGLIGIBLE, FIRST_REACH, LAST_REACH = 1e-16, 8, 2048
FURTHER = {
    "last": ("harmonics_kept", int, "1", "number of the last harmonic"),
    "truncation": ("truncation", float, "1", "estimated size of the harmonics left out, over the motion's"),
}


class CondensedBranch(Branch):
    """A branch whose points are ``CondensedPoint``; ``dofs`` is the number of places."""

    def to_csv(self) -> str:
        """The branch as CSV text, a row a point: w1 ... are the elongations in m at phase 0."""
        names = ["energy", "frequency", "period", *(f"w{i + 1}" for i in range(self.dofs))]
        lines = [",".join([*names, "harmonics", "truncation", "multiplier_max", "slope", "contacts", "region", "kind"])]
        for p, region in zip(self.points, self.regions(), strict=True):
            assert isinstance(p, CondensedPoint)
            numbers = [p.energy, p.frequency, p.period, *p.elongations.tolist()]
            rest = [*map(repr, (p.last, p.truncation, p.multiplier, p.slope, p.episodes)), str(region), p.kind]
            lines.append(",".join([*map(repr, numbers), *rest]))
        return "\n".join(lines) + "\n"

    def unknowns(self) -> Variables:
        """The harmonics of every point, zero beyond the last, and the tangents in them."""
        points = [p for p in self.points if isinstance(p, CondensedPoint)]
        count = max((len(p.x) // self.dofs for p in points), default=0)
        size, odd = (
            (len(points), self.dofs, count),
            all(p.last % 2 and len(p.x) <= p.last // 2 * self.dofs + self.dofs for p in points),
        )
        harmonics, tangent = np.zeros((2, *size))
        for i, p in enumerate(points):
            for part, given in ((harmonics, p.x), (tangent, p.tangent[:-1])):
                if given.size:
                    part[i, :, : len(p.x) // self.dofs] = given.reshape(self.dofs, -1)
        orders = np.arange(count) * 2 + 1 if odd else np.arange(count)
        axes, rates = ("point", "place", "order"), [p.tangent[-1] if p.tangent.size else np.nan for p in points]
        elongations = np.array([p.elongations for p in points]).reshape(size[:2])
        data = {
            "place": variable("place", np.arange(1, self.dofs + 1), "1", "contact, then smooth spring"),
            "order": variable("order", orders, "1", "harmonic of the frequency"),
            "harmonics": variable(axes, harmonics, "m", "cosine of the elongation (of a contact, w)"),
            "tangent": variable(axes, tangent, "m", "tangent of the branch: harmonics"),
            "tangent_period": variable("point", rates, "s", "tangent of the branch: period"),
            "elongation": variable(("point", "place"), elongations, "m", "elongation at phase 0, at rest"),
        }
        for name, (stored, kind, units, text) in FURTHER.items():
            data[stored] = variable("point", np.array([getattr(p, name) for p in points], kind), units, text)
        return data

    @classmethod
    def read(cls, path: Path) -> Self:
        """The branch in an HDF5 file, without its states; raises OSError or ValueError if it holds none."""
        with open_netcdf(path, "branch", ("point", "harmonics", "tangent", "next_step")) as file:
            data, about = file.load(), file.attrs
        layout = QUANTITIES | FURTHER
        columns: dict[str, Any] = {name: data[stored].values.tolist() for name, (stored, *_) in layout.items()}
        del columns["frequency"]  # a property
        columns["kind"] = [KINDS[kind] for kind in data["kind"].values]
        columns["elongations"] = data["elongation"].values
        step = 2 if data["order"].values[:1] == 1 else 1
        points: list[Point] = []
        for i, row in enumerate(zip(*columns.values(), strict=True)):
            told = dict(zip(columns, row, strict=True))
            count = (told["last"] + 1) // 2 if step == 2 else told["last"] + 1
            x, tangent = (data[name].values[i, :, :count].ravel() for name in ("harmonics", "tangent"))
            rate = data["tangent_period"].values[i]
            tangent = np.append(tangent, rate) if np.isfinite(rate) else np.empty(0)
            points.append(CondensedPoint(x=x, tangent=tangent, half_traces=np.empty(0), **told))
        points = with_multipliers(points, data)
        return cls(dofs=data.sizes["place"], points=points, **cls.told(about))


class CondensedFollower(Follower):
    """As ``Follower``, for motions condensed onto contacts and springs."""

    branch_type, continuation = CondensedBranch, CondensedContinuation

    def set_up(self) -> None:
        """Make the problem: the compliance between contacts and springs, and their forces."""
        case, options = self.case, self.options
        if options.system == "condensed":
            self.chain = build_chain(case.lattice, case.contacts)
            compliance: Any = SeriesCompliance(WaveCompliance(self.chain))
            forces = SiteForces([(case.contact(), clearance) for clearance in self.chain.clearances])
        else:
            system = self.system = System.from_case(case)
            self.rows = np.vstack([system.contact_rows, system.spring_rows])
            compliance = DenseCompliance(system.masses, system.stiffness, self.rows)
            contacts = [(pair.law, pair.clearance) for pair in system.contacts]
            forces = SiteForces(contacts, [(s.quadratic, s.cubic) for s in system.springs])
        self.problem = CondensedProblem(compliance, forces, options)
        self.dofs = forces.pairs

    def name_of(self, mode: int) -> str:
        """The name of the branch of ``mode`` (0-based), or of that start frequency."""
        frequencies = self.options.start_frequency
        return f"breather-{frequencies[mode]:g}" if frequencies else self.system.branch_name(mode)

    def _start(self, mode: int) -> Point:
        if not self.options.start_frequency:
            omega, shapes = self.system.linear_modes()
            amplitude = np.sqrt(2 * self.start_energy(mode)) / omega[mode]
            return self.problem.from_mode(self.rows @ shapes[:, mode] * amplitude, float(omega[mode]))
        signs, numbers = np.zeros(self.problem.forces.pairs), self.options.start_sites or [1]
        signs[np.abs(numbers) - 1] = np.sign(numbers)
        return self.problem.from_gap(self.options.start_frequency[mode], signs)

    def judged(self, point: Point) -> Point:
        """The point with its largest multiplier by Hill's method, and with those of Floquet if they are asked for."""
        assert isinstance(point, CondensedPoint)
        problem, omega, wanted = self.problem, 2 * np.pi / point.period, self.options.multipliers
        problem.select(point.last)
        hill = Hill(problem.compliance, omega, point.last, problem.forces.odd, finite=True)
        fastest = hill.fastest(problem.balance.series(point.x, omega))
        if wanted:
            chain, cells = self.chain, state_of(problem, point)
            u = np.array([cells.get(cell, np.zeros(chain.cell.dofs)) for cell in range(chain.cells)]).ravel()
            flow = LatticeFlow(chain, self.case.contact(), self.comm)
            system = System.from_chain(chain, self.case.contact(), dense=False)
            point = judge(flow, system, problem.forces.odd, point, u, wanted)
        return replace(point, multiplier=np.nan if fastest is None else float(np.exp(2 * np.pi * fastest.real)))

    def monitored(self, problem: Any, control: NnmTable) -> Callable[[Point], str | None]:
        """No monitor: what it watches for needs the whole state."""
        return lambda point: None

    def jumps(self, points: list[Point], problem: Any, control: NnmTable) -> Iterator[str]:
        """None are told without half-traces."""
        return iter(())

    def located(
        self, problem: Any, control: NnmTable, left: Point, right: Point, before: Point | None, missed: list[str]
    ) -> list[Point]:
        """The folds between two points."""
        segment, points = CondensedSegment(problem, "", left, right), []
        tests = {"fold-energy": lambda p: p.energy_tangent, "fold-frequency": lambda p: float(p.tangent[-1] / p.period)}
        for kind, test in tests.items() if left.tangent.size and left.episodes else ():
            try:
                points += segment.roots(kind, test, 0.0, before)
            except ArithmeticError as error:
                missed.append(f"a {kind} after point {left.index} (E = {left.energy:.9g} J) is not located: {error}")
        return sorted(points, key=lambda p: p.step)

    def at_energy(self, left: Point, right: Point, energy: float) -> Point:
        """The motion of an ``energy`` in J between two points on both sides of it."""
        return CondensedSegment(self.problem, "", left, right).root("regular", lambda p: p.energy / energy - 1, 5)

    def grow(self, branch: Branch, problem: Any, start: Point, control: NnmTable, direction: int = 1) -> None:
        """As of ``Follower``; a branch that begins in a gap ends where it leaves it."""
        if self.options.system == "condensed":
            omega, bands = 2 * np.pi / start.period, pass_bands(self.chain.cell)
            low = max((band.high for band in bands if band.high < omega), default=0.0) / (2 * np.pi)
            high = min((band.low for band in bands if band.low > omega), default=np.inf) / (2 * np.pi)
            bounds = [max(low, control.frequency[0]), min(high, control.frequency[1])]
            control = control.model_copy(update={"frequency": bounds})
        super().grow(branch, problem, start, control, direction)

    def _follow(self, branch: Branch, mode: int) -> None:
        try:
            super()._follow(branch, mode)
        except (StoppedError, *FAILURES):
            if branch.points:
                self.finish(branch)
            raise

    def finish(self, branch: Branch) -> None:
        """Add the states at phase 0 of the first and the last point, and of those asked for."""
        points = [branch.points[0], *self.asked(branch), branch.regular()[-1]]
        branch.extra = states(self.problem, points)


def states(problem: CondensedProblem, points: list[Point]) -> Variables:
    """Displacements at phase 0, where all is at rest, of the cells in which they are not negligible."""
    fields = [state_of(problem, point) for point in points]
    cells = sorted(set().union(*(field for field in fields)))
    u = np.array([[field.get(cell, 0 * next(iter(field.values()))) for cell in cells] for field in fields])
    return stored_states(points, cells, u)


def stored_states(points: list[Point], cells: Sequence[int], u: np.ndarray) -> Variables:
    """Displacements ``u`` (point, cell, dof) of ``cells``, from 0, at phase 0, where all is at rest."""
    axes = "orbit", "states/cell", "states/dof"
    return {
        "orbit": variable("orbit", np.arange(1, len(points) + 1), "1", "stored motion"),
        "states/cell": variable("states/cell", np.array(cells) + 1, "1", "cell, from 1"),
        "states/dof": variable("states/dof", np.arange(1, u.shape[2] + 1), "1", "mass of the cell, from 1"),
        "states/displacement": variable(axes, u, "m", "displacement at phase 0; cells left out are at rest"),
        "states/velocity": variable(axes, 0 * u, "m/s", "velocity at phase 0"),
        "states/energy": variable("orbit", [p.energy for p in points], "J", "energy"),
        "states/period": variable("orbit", [p.period for p in points], "s", "period"),
        "states/number": variable("orbit", [p.index for p in points], "1", "number of the regular point"),
    }


def state_of(problem: Any, point: Point) -> dict[int, np.ndarray]:
    """Displacement (dofs,) in m at phase 0 of every cell (from 0) in which it is not negligible."""
    assert isinstance(point, CondensedPoint)
    omega, compliance = 2 * np.pi / point.period, problem.compliance
    problem.select(point.last, omega)
    balance = problem.balance
    forces = balance.series(point.x, omega).forces.real
    if isinstance(compliance, DenseCompliance):
        force, shift = balance.shifted_force(point.x, omega)
        parts, gaps = compliance.parts, compliance.squared - (balance.orders * omega)[:, None] ** 2
        dynamic = np.eye(len(gaps[0])) * gaps[:, None] + shift * (parts.T @ parts)
        return {0: -np.sum(compliance.vectors @ np.linalg.solve(dynamic, parts.T @ force.real), axis=0)[:, 0]}
    total: dict[int, np.ndarray] = {}
    for k in problem.balance.orders:
        for cell, u in _field(compliance.compliance, k * omega, forces[:, k]).items():
            total[cell] = total.get(cell, 0.0) + u
    largest = max(np.abs(u).max() for u in total.values())
    return {cell: u for cell, u in total.items() if np.abs(u).max() > NEGLIGIBLE * largest}


def _field(compliance: WaveCompliance, omega: float, forces: np.ndarray) -> dict[int, np.ndarray]:
    """Displacement of the cells around the sites that ``forces`` (pairs,) move, as far as it is not negligible."""
    chain, reach = compliance.chain, FIRST_REACH
    while True:
        near = np.unique(np.add.outer(chain.sites, np.arange(-reach, reach + 1)))
        near = np.unique(near % chain.cells) if chain.ends == "periodic" else near[(near >= 0) & (near < chain.cells)]
        u = compliance.field(omega, forces, near).real
        size = np.abs(u).max(axis=1)
        rim = np.min(np.abs(np.subtract.outer(near, chain.sites)), axis=1) == reach
        if reach >= LAST_REACH or not rim.any() or size[rim].max() <= NEGLIGIBLE * size.max():
            return dict(zip(near.tolist(), u, strict=True))
        reach *= 2
