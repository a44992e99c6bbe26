"""Follow branches of whole lattices, all ranks together, and judge their stability by their largest multipliers."""

from collections.abc import Callable, Iterator

import numpy as np

from vipetsc.case import NnmCase
from vipetsc.case.nnm import NnmTable
from vipetsc.case.resolve import build_chain
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.condensed_follow import CondensedFollower, stored_states
from vipetsc.modes.branches.follow import Follower
from vipetsc.modes.continuation.special import locate
from vipetsc.modes.lattice.floquet import judge
from vipetsc.modes.lattice.krylov import LatticeShooting
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError, FlowError, StartError
from vipetsc.modes.shooting.shooting import MAPS, Shooting
from vipetsc.modes.system import System


class LatticeFollower(Follower):
    """As ``Follower``, for a lattice on all ranks of ``comm``."""

    shared = True
    # What all ranks meet together; anything else may be one rank's alone, and ends the program on all.
    failures = ContinuationError, FlowError, StartError

    def set_up(self) -> None:
        """Make the problem of the lattice, shared over the ranks."""
        case, options = self.case, self.options
        chain = build_chain(case.lattice, case.contacts)
        self.system = System.from_chain(chain, case.contact(), dense=False)
        shooting_map = MAPS["quarter" if options.map == "auto" else options.map]
        limits = options.tolerance, options.max_newton
        self.lattice = LatticeShooting(self.system, chain, shooting_map, self.comm, *limits)
        self.problem, self.dofs = self.lattice, self.system.dofs

    def name_of(self, mode: int) -> str:
        """The name of the branch of ``mode`` (0-based), or of that start frequency."""
        gaps = self.options.start_frequency
        return f"breather-{gaps[mode]:g}" if gaps else self.system.branch_name(mode)

    def judged(self, point: Point) -> Point:
        """The point with its largest multipliers, if they are asked for."""
        wanted, lattice = self.options.multipliers, self.lattice
        if not wanted:
            return point
        return judge(lattice.lattice_flow, self.system, lattice.map.quarter, point, point.x, wanted)

    def _start(self, mode: int) -> Point:
        gaps = self.options.start_frequency
        return self.lattice.breather(gaps[mode]) if gaps else super()._start(mode)

    def located(
        self, problem: Shooting, control: NnmTable, left: Point, right: Point, before: Point | None, missed: list[str]
    ) -> list[Point]:
        """The folds between two points: half-traces are not known."""
        return locate(problem, left, right, control.chart, False, before, missed)

    def monitored(self, problem: Shooting, control: NnmTable) -> Callable[[Point], str | None]:
        """No monitor: it integrates other orbits, and compares with all linear modes."""
        return lambda point: None

    def jumps(self, points: list[Point], problem: Shooting, control: NnmTable) -> Iterator[str]:
        """None are told without half-traces."""
        return iter(())

    def finish(self, branch: Branch) -> None:
        """Add the states at phase 0 of the first and the last point."""
        points, shape = [branch.points[0], branch.regular()[-1]], (self.lattice.lattice_flow.chain.cells, -1)
        branch.extra = stored_states(points, range(shape[0]), np.array([p.x.reshape(shape) for p in points]))


def follower_of(case: NnmCase) -> type[Follower]:
    """Who follows the branches of a ``case``, for ``follow_all``."""
    if case.krylov:
        return LatticeFollower
    return CondensedFollower if case.condensed else Follower
