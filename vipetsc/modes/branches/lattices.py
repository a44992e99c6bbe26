"""Branches of orbits of whole lattices, all ranks together, judged by their largest multipliers."""

from mpi4py import MPI

import numpy as np

from vipetsc.case import NnmCase
from vipetsc.case.names import distinct
from vipetsc.io.branch_kinds import ORBITS
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.files import stored_states
from vipetsc.modes.branches.losses import dissipation_of, with_lattice_loss
from vipetsc.modes.branches.orbits import NnmMethod, map_of, start_energy
from vipetsc.modes.lattice.floquet import with_multipliers
from vipetsc.modes.lattice.krylov import LatticeShooting
from vipetsc.modes.point import Point
from vipetsc.modes.problem import NoMotionError, PeriodicProblem
from vipetsc.modes.shooting import linear_start
from vipetsc.modes.system import System, elastic_stops
from vipetsc.parallel import StopRequest


class LatticeMethod(NnmMethod):
    """Branches of a lattice by ``LatticeShooting``."""

    kind = ORBITS
    shared = True
    # All ranks raise these together; any other exception may be one rank's alone, and ends the program on all.
    failures = (NoMotionError,)

    def __init__(self, case: NnmCase, comm: MPI.Comm) -> None:
        super().__init__(case, comm)
        options = case.nnm
        chain = case.chain()
        self.system = System.from_chain(chain, elastic_stops(case), dense=False)
        self.dissipation = dissipation_of(case)
        shooting_map = map_of(options, self.system)
        self.lattice = LatticeShooting(self.system, chain, shooting_map, comm, options.tolerance, options.max_newton)

    def new_branch(self, name: str) -> Branch[Point]:
        """A branch without points."""
        return Branch(name, self.case.to_toml(), self.system.dofs, self.kind)

    def name(self, job: int) -> str:
        """The name of the branch of a mode, or of a start frequency."""
        frequencies = self.options.start_frequency
        if frequencies:
            return f"breather-{distinct(frequencies)[job]}"
        return self.system.branch_name(job)

    def problem(self, job: int) -> LatticeShooting:
        """The shooting equations of the lattice."""
        return self.lattice

    def start(self, problem: PeriodicProblem[Point], job: int, stop: StopRequest | None = None) -> Point:
        """The orbit of a linear mode at a small energy, or a breather of a start frequency."""
        if self.options.start_frequency:
            return self.lattice.breather(self.options.start_frequency[job], self.options.start_sites or [1])
        return linear_start(self.lattice, job, start_energy(self.options, self.system, job))

    def assess(self, problem: PeriodicProblem[Point], point: Point) -> Point:
        """The point with its loss, if anything dissipates, and the multipliers that ``nnm.multipliers`` asks for."""
        if self.dissipation.acts:
            point = with_lattice_loss(self.lattice, self.dissipation, point)
        wanted = self.options.multipliers
        if not wanted:
            return point
        return with_multipliers(self.lattice.flow, self.system, self.lattice.map.quarter, point, point.x, wanted)

    def finish(self, problem: PeriodicProblem[Point], branch: Branch[Point]) -> None:
        """Add the states at phase 0 of the first and the last point."""
        points = [branch.points[0], branch.regular()[-1]]
        cells = self.lattice.flow.chain.cells
        u = np.array([p.x.reshape(cells, -1) for p in points])
        branch.extra = stored_states(points, range(cells), u)
